// A stand-in for the Arduino core: just what the sketches use, for a test on a computer.
#pragma once

#include <stdint.h>

#include <deque>
#include <string>
#include <vector>

enum { INPUT, OUTPUT, LOW = 0, HIGH = 1, A0 = 54 };

extern uint32_t stub_us;

inline uint32_t micros() { return stub_us; }
void pinMode(int pin, int mode);

struct StubSerial {
  std::deque<uint8_t> in;
  std::vector<uint8_t> out;
  int room = 1 << 20;  // bytes that can be sent before the host takes some

  void begin(int) {}
  void setTxBufferSize(size_t) {}
  int available() { return static_cast<int>(in.size()); }
  int availableForWrite() { return room; }
  int read() {
    if (in.empty()) return -1;
    const int byte = in.front();
    in.pop_front();
    return byte;
  }
  size_t write(const uint8_t *data, size_t size) {
    out.insert(out.end(), data, data + size);
    room -= static_cast<int>(size);
    return size;
  }
  void print(const std::string &text) { write(reinterpret_cast<const uint8_t *>(text.data()), text.size()); }
  void print(char one) { print(std::string(1, one)); }
  void print(int number) { print(std::to_string(number)); }
  void print(uint32_t number) { print(std::to_string(number)); }
  void println(const std::string &text = "") { print(text + "\r\n"); }
};
