// Runs a sketch that needs no more than an ADC: `run N`, `held N` and `host TEXT` as in line.cpp. Input i reads 100 * i.
#include <cstdio>
#include <iostream>
#include <string>

#include "Arduino.h"

uint32_t stub_us = 4294900000u;  // the clock wraps around soon after the start
static StubSerial Serial;
static int analogRead(int pin) {
  stub_us += 100;
  return 100 * (pin - A0);
}

#include "sketch.ino"

int main() {
  setup();
  std::string word;
  while (std::cin >> word) {
    if (word == "host") {
      std::cin >> word;
      Serial.in.insert(Serial.in.end(), word.begin(), word.end());
      continue;
    }
    uint32_t count;
    std::cin >> count;
    const uint32_t begun_us = stub_us;
    if (word == "held") stub_us += count;
    while (word == "run" && stub_us - begun_us < count) {
      loop();
      stub_us += 3;
    }
  }
  fwrite(Serial.out.data(), 1, Serial.out.size(), stdout);
}
