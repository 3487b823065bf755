// Runs the sketch of the line board on a computer by a script from standard input; what it sends comes out of standard
// output.
//
//   host TEXT    the host sends these bytes
//   run N        the main loop turns for N us
//   held N       the main loop is held up for N us
//   room N       N more bytes can be sent, and no others
//
// Input i of the multiplexer reads (256 * i + how often it was read) % 4096, but 4095 where it has not settled.
#include <cstdio>
#include <iostream>
#include <string>

#include "Arduino.h"

uint32_t stub_us = 4294900000u;  // the clock wraps around soon after the start
static StubSerial Serial;
#ifdef ESP32
struct StubEsp {
  uint64_t getEfuseMac() { return 0xa1b2c3d4e5f6; }
};
static StubEsp ESP;
#endif

static int modes[64], levels[64], resolution, reads[16];
static uint32_t switched_us;

void pinMode(int pin, int mode) { modes[pin] = 1 + mode; }
static void digitalWrite(int pin, int level) {
  levels[pin] = level;
  switched_us = stub_us;
}
static void delayMicroseconds(unsigned us) { stub_us += us; }
static void analogReadResolution(int bits) { resolution = bits; }
static int analogRead(int pin);

#include "padforge_line.ino"

static int analogRead(int pin) {
  bool ready = pin == ADC_PIN && modes[ADC_PIN] == 1 + INPUT && resolution == 12 && stub_us - switched_us >= 10;
  unsigned input = 0;
  for (unsigned bit = 0; bit < 4; bit++) {
    ready = ready && modes[SELECT_PINS[bit]] == 1 + OUTPUT;
    input |= static_cast<unsigned>(levels[SELECT_PINS[bit]]) << bit;
  }
  stub_us += 60;
  return ready ? (256 * input + reads[input]++) % 4096 : 4095;
}

int main() {
  setup();
  std::string word;
  while (std::cin >> word) {
    if (word == "host") {
      std::cin >> word;
      Serial.in.insert(Serial.in.end(), word.begin(), word.end());
      loop();
      continue;
    }
    uint32_t count;
    std::cin >> count;
    const uint32_t begun_us = stub_us;
    if (word == "held") stub_us += count;
    if (word == "room") Serial.room = static_cast<int>(count);
    while (word == "run" && stub_us - begun_us < count) {
      loop();
      stub_us += 3;
    }
  }
  fwrite(Serial.out.data(), 1, Serial.out.size(), stdout);
}
