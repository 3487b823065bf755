// The line protocol in plain C++ without Arduino; docs/howto-boards.md describes it.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace padforge {

const unsigned MAX_INPUTS = 16;

// CRC-32 as of zlib, PNG and Ethernet.
inline uint32_t crc32(const char *data, size_t size) {
  uint32_t crc = 0xFFFFFFFF;
  for (size_t i = 0; i < size; i++) {
    crc ^= static_cast<uint8_t>(data[i]);
    for (int bit = 0; bit < 8; bit++) crc = crc & 1 ? crc >> 1 ^ 0xEDB88320 : crc >> 1;
  }
  return ~crc;
}

// A line of text that grows to its end, with room for a header or for a sample of all inputs.
class Line {
 public:
  char text[192];
  size_t size = 0;

  void add(char one) {
    if (size < sizeof text) text[size++] = one;
  }
  void add(const char *words) {
    while (*words) add(*words++);
  }
  void add_number(uint32_t value) {
    char digits[10];
    unsigned count = 0;
    do digits[count++] = static_cast<char>('0' + value % 10);
    while (value /= 10);
    while (count) add(digits[--count]);
  }
  void add_hex(uint64_t value, int digits) {
    for (int shift = 4 * (digits - 1); shift >= 0; shift -= 4) add("0123456789abcdef"[value >> shift & 15]);
  }
  void end() {
    const uint32_t check = crc32(text, size);
    add('*');
    add_hex(check, 8);
    add('\n');
  }
};

// The mean of conversions as a count of `bits`, up to 16: its highest stands for that of the converter.
inline uint16_t mean_count(uint32_t sum, unsigned conversions, unsigned adc_bits, unsigned bits) {
  const uint32_t most = conversions * ((1u << adc_bits) - 1);
  return static_cast<uint16_t>((sum * ((1u << bits) - 1) + most / 2) / most);
}

inline void write_sample(Line &line, uint32_t time_us, const uint16_t *counts, unsigned inputs) {
  line.add_number(time_us);
  for (unsigned i = 0; i < inputs; i++) {
    line.add(',');
    line.add_number(counts[i]);
  }
  line.end();
}

}  // namespace padforge
