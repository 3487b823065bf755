// padforge: reads up to sixteen voltages through one multiplexer (CD74HC4067) and sends them as lines of text.
//
// For an ESP32 with a USB bridge or a Teensy 4, and for any other board with an ADC once the pins below are its own. A
// sample is taken every period by the board's clock; one that comes too late or cannot be sent is left out, so that
// its time is missing and the host counts it as lost.

#include "lines.h"

using namespace padforge;

// What may be different on your board.
const char NAME[] = "padforge-line";
const uint32_t BAUD = 921600;  // of a USB bridge; native USB ignores it
const uint32_t RATE_HZ = 500;
const unsigned INPUTS = 16;  // C0, C1, ... of the multiplexer
const unsigned BITS = 12;
const char REFERENCE_V[] = "3.3";
const unsigned SETTLE_US = 20;  // from switching the multiplexer to reading it
#ifdef ESP32
const uint8_t SELECT_PINS[4] = {16, 17, 18, 19};  // S0 to S3
const uint8_t ADC_PIN = 34;                       // SIG
#else
const uint8_t SELECT_PINS[4] = {2, 3, 4, 5};
const uint8_t ADC_PIN = A0;
#endif

const uint32_t PERIOD_US = 1000000 / RATE_HZ;
static_assert(INPUTS <= MAX_INPUTS, "a CD74HC4067 has 16 inputs");
static_assert(PERIOD_US * RATE_HZ == 1000000, "the period must be a whole number of microseconds");

uint32_t due_us;

void send(const Line &line) {
  if (Serial.availableForWrite() < static_cast<int>(line.size)) return;  // better a line less than a late clock
  Serial.write(reinterpret_cast<const uint8_t *>(line.text), line.size);
}

void send_header() {
  Line line;
  line.add("# padforge-line 1 name=");
  line.add(NAME);
#ifdef ESP32
  line.add(" serial=");
  line.add_hex(ESP.getEfuseMac(), 12);
#endif
  line.add(" rate_hz=");
  line.add_number(RATE_HZ);
  line.add(" bits=");
  line.add_number(BITS);
  line.add(" reference_v=");
  line.add(REFERENCE_V);
  line.add(" channels=");
  line.add_number(INPUTS);
  line.add(" check=crc32");
  line.end();
  send(line);
}

void send_sample(uint32_t now_us) {
  uint16_t counts[MAX_INPUTS];
  for (unsigned input = 0; input < INPUTS; input++) {
    for (unsigned bit = 0; bit < 4; bit++) digitalWrite(SELECT_PINS[bit], input >> bit & 1 ? HIGH : LOW);
    delayMicroseconds(SETTLE_US);
    counts[input] = static_cast<uint16_t>(analogRead(ADC_PIN));
  }
  Line line;
  write_sample(line, now_us, counts, INPUTS);
  send(line);
}

void setup() {
#ifdef ESP32
  Serial.setTxBufferSize(4096);  // some 40 lines, in case the host is slow
#endif
  Serial.begin(BAUD);
  analogReadResolution(BITS);
  for (uint8_t pin : SELECT_PINS) pinMode(pin, OUTPUT);
  pinMode(ADC_PIN, INPUT);
  send_header();
  due_us = micros();
}

void loop() {
  while (Serial.available() > 0) {
    if (Serial.read() == '?') send_header();
  }
  const uint32_t now_us = micros();
  const int32_t late_us = static_cast<int32_t>(now_us - due_us);
  if (late_us < 0) return;
  due_us += (late_us / PERIOD_US + 1) * PERIOD_US;
  if (late_us < static_cast<int32_t>(PERIOD_US / 4)) send_sample(now_us);  // a late one is missing, not made up for
}
