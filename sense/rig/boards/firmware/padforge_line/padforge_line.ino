// padforge: reads up to sixteen voltages and sends them as lines of text.
//
// For an Arduino Due and its twelve inputs, for an ESP32 with a USB bridge or a Teensy 4 behind one multiplexer
// (CD74HC4067), and for any other board with an ADC once the pins below are its own. A sample is taken every period by
// the board's clock; one that comes too late or cannot be sent is left out, so that its time is missing and the host
// counts it as lost.

#include "lines.h"

using namespace padforge;

// What may be different on your board.
#ifdef ARDUINO_SAM_DUE
#define PORT SerialUSB  // the native port; the other one is too slow
const char NAME[] = "padforge-due";
const uint32_t RATE_HZ = 1000;
const unsigned INPUTS = 12;      // A0, A1, ...
const unsigned CONVERSIONS = 8;  // averaged to a count: 108 with those that are dropped take some 0.5 ms
const unsigned BITS = 16;        // of a count; a mean is finer than a conversion
#else
#define PORT Serial
const char NAME[] = "padforge-line";
const uint32_t RATE_HZ = 500;
const unsigned INPUTS = 16;  // C0, C1, ... of the multiplexer
const unsigned CONVERSIONS = 1;
const unsigned BITS = 12;
const unsigned SETTLE_US = 20;  // from switching the multiplexer to reading it
#ifdef ESP32
const uint8_t SELECT_PINS[4] = {16, 17, 18, 19};  // S0 to S3
const uint8_t ADC_PIN = 34;                       // SIG
#else
const uint8_t SELECT_PINS[4] = {2, 3, 4, 5};
const uint8_t ADC_PIN = A0;
#endif
#endif
const uint32_t BAUD = 921600;  // of a USB bridge; native USB ignores it
const unsigned ADC_BITS = 12;
const char REFERENCE_V[] = "3.3";

const uint32_t PERIOD_US = 1000000 / RATE_HZ;
static_assert(INPUTS <= MAX_INPUTS, "a line has room for 16 inputs");
static_assert(PERIOD_US * RATE_HZ == 1000000, "the period must be a whole number of microseconds");
static_assert(CONVERSIONS <= 16 && BITS <= 16 && ADC_BITS <= 12, "sums and counts must fit");

uint32_t due_us;

#ifdef ARDUINO_SAM_DUE
void prepare_inputs() {
  for (unsigned input = 0; input < INPUTS; input++) pinMode(A0 + input, INPUT);  // a pull-up would change the divider
}

// Return the pin of an input, ready to be read.
uint8_t select_input(unsigned input) {
  const uint8_t pin = static_cast<uint8_t>(A0 + input);
  analogRead(pin);  // dropped: it still holds some charge of the input before
  return pin;
}

// The 128 bit unique identifier of the chip. The second half of the flash returns it in place of its contents for
// a while, which is safe as the program runs from the first.
void add_serial_number(Line &line) {
  const uint32_t key = 0x5Au << 24;  // opens the command register of the flash
  uint8_t bytes[16];
  EFC1->EEFC_FCR = key | EFC_FCMD_STUI;
  while (EFC1->EEFC_FSR & EEFC_FSR_FRDY) {
  }
  memcpy(bytes, reinterpret_cast<const void *>(IFLASH1_ADDR), sizeof bytes);
  EFC1->EEFC_FCR = key | EFC_FCMD_SPUI;
  while (!(EFC1->EEFC_FSR & EEFC_FSR_FRDY)) {
  }
  line.add(" serial=");
  for (uint8_t byte : bytes) line.add_hex(byte, 2);
}
#else
void prepare_inputs() {
  for (uint8_t pin : SELECT_PINS) pinMode(pin, OUTPUT);
  pinMode(ADC_PIN, INPUT);
}

// Return the pin of an input, ready to be read.
uint8_t select_input(unsigned input) {
  for (unsigned bit = 0; bit < 4; bit++) digitalWrite(SELECT_PINS[bit], input >> bit & 1 ? HIGH : LOW);
  delayMicroseconds(SETTLE_US);
  return ADC_PIN;
}

void add_serial_number(Line &line) {
#ifdef ESP32
  line.add(" serial=");
  line.add_hex(ESP.getEfuseMac(), 12);
#else
  (void)line;
#endif
}
#endif

void send(const Line &line) {
  if (PORT.availableForWrite() < static_cast<int>(line.size)) return;  // better a line less than a late clock
  PORT.write(reinterpret_cast<const uint8_t *>(line.text), line.size);
}

void send_header() {
  Line line;
  line.add("# padforge-line 1 name=");
  line.add(NAME);
  add_serial_number(line);
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
    const uint8_t pin = select_input(input);
    uint32_t sum = 0;
    for (unsigned i = 0; i < CONVERSIONS; i++) sum += static_cast<uint32_t>(analogRead(pin));
    counts[input] = mean_count(sum, CONVERSIONS, ADC_BITS, BITS);
  }
  Line line;
  write_sample(line, now_us, counts, INPUTS);
  send(line);
}

void setup() {
#ifdef ESP32
  PORT.setTxBufferSize(4096);  // some 40 lines, in case the host is slow
#endif
  PORT.begin(BAUD);
  analogReadResolution(ADC_BITS);
  prepare_inputs();
  send_header();
  due_us = micros();
}

void loop() {
  while (PORT.available() > 0) {
    if (PORT.read() == '?') send_header();
  }
  const uint32_t now_us = micros();
  const int32_t late_us = static_cast<int32_t>(now_us - due_us);
  if (late_us < 0) return;
  due_us += (late_us / PERIOD_US + 1) * PERIOD_US;
  if (late_us < static_cast<int32_t>(PERIOD_US / 4)) send_sample(now_us);  // a late one is missing, not made up for
}
