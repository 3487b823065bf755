// Runs the sketch of the line board on a computer by a script from standard input; what it sends comes out of standard
// output.
//
//   host TEXT    the host sends these bytes
//   run N        the main loop turns for N us
//   held N       the main loop is held up for N us
//   room N       N more bytes can be sent, and no others
//
// Input i of the multiplexer reads (256 * i + how often it was read) % 4096, but 4095 where it has not settled; so does
// input i of a Due, whose first conversion after that of another input has not.
#include <cstdio>
#include <cstring>
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
#ifdef ARDUINO_SAM_DUE
#define SerialUSB Serial
// A flash controller that is busy at every other look.
struct Toggle {
  uint32_t value = 0;
  operator uint32_t() { return value ^= 1; }
};
struct Efc {
  uint32_t EEFC_FCR;
  Toggle EEFC_FSR;
};
static Efc stub_efc;
#define EFC1 (&stub_efc)
#define IFLASH1_ADDR reinterpret_cast<uintptr_t>("serial-of-a-chip")
const uint32_t EFC_FCMD_STUI = 0x0E, EFC_FCMD_SPUI = 0x0F, EEFC_FSR_FRDY = 1;
#endif

static int modes[80], resolution, reads[16];

void pinMode(int pin, int mode) { modes[pin] = 1 + mode; }
#ifndef ARDUINO_SAM_DUE
static int levels[80];
static uint32_t switched_us;
static void digitalWrite(int pin, int level) {
  levels[pin] = level;
  switched_us = stub_us;
}
static void delayMicroseconds(unsigned us) { stub_us += us; }
#endif
static void analogReadResolution(int bits) { resolution = bits; }
static int analogRead(int pin);

#include "padforge_line.ino"

#ifdef ARDUINO_SAM_DUE
static int analogRead(int pin) {
  static int last_pin = 0;
  const bool ready = pin == last_pin && modes[pin] == 1 + INPUT && resolution == 12;
  last_pin = pin;
  stub_us += 4;
  return ready ? (256 * (pin - A0) + reads[pin - A0]++) % 4096 : 4095;
}
#else
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
#endif

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
