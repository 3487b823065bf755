// Runs the sketch on a computer by a script from standard input; what it sends comes out of standard output.
//
//   host HEX     the host sends these bytes
//   loop N       the main loop turns N times
//   trigger N    the timer fires N times; input conversions are (256 * ADC channel + number of the trigger) % 4096
//   masked N     as trigger, with interrupts held back until all N are done
//   slip         the next conversion is lost
//   close        the host closes its port
#include <cstdio>
#include <iostream>
#include <string>

#include "due.h"

Tc stub_tc;
Adc stub_adc;
Efc stub_efc;
uint32_t stub_us = 4294000000u;  // the clock wraps around soon after the start
bool stub_adc_irq = false;
const char stub_flash[17] = "serial-of-a-chip";
StubSerial SerialUSB;

void pinMode(int, int) {}

#include "padforge_due.ino"

static uint32_t triggers = 0;
static bool slip = false;

static void interrupt() {
  if (stub_adc.ADC_RNCR == 0 && stub_adc_irq) {
    stub_adc.ADC_ISR = ADC_ISR_ENDRX | (stub_adc.ADC_RCR == 0 ? ADC_ISR_RXBUFF : 0);
    ADC_Handler();
  }
}

// The DMA: store a result, and go on to the next buffer when one is full.
static void store(uint16_t result) {
  if (slip || stub_adc.ADC_RCR == 0 || stub_adc.ADC_PTCR != ADC_PTCR_RXTEN) {
    slip = false;
    return;
  }
  *reinterpret_cast<uint16_t *>(stub_adc.ADC_RPR) = result;
  stub_adc.ADC_RPR = stub_adc.ADC_RPR + 2;
  stub_adc.ADC_RCR = stub_adc.ADC_RCR - 1;
  if (stub_adc.ADC_RCR == 0) {
    stub_adc.ADC_RPR = stub_adc.ADC_RNPR;
    stub_adc.ADC_RCR = stub_adc.ADC_RNCR;
    stub_adc.ADC_RNCR = 0;
  }
}

static void trigger(bool masked) {
  if (stub_tc.TC_CHANNEL[0].TC_CCR != (TC_CCR_CLKEN | TC_CCR_SWTRG) || !(stub_adc.ADC_MR & ADC_MR_TRGEN_EN)) return;
  stub_us += stub_tc.TC_CHANNEL[0].TC_RC / TICKS_PER_US;
  for (uint32_t channel = 0; channel < 16; channel++) {
    if (!(stub_adc.ADC_CHER >> channel & 1)) continue;
    store(static_cast<uint16_t>(channel << 12 | ((256 * channel + triggers) & 0xFFF)));
    if (!masked) interrupt();
  }
  triggers++;
}

int main() {
  setup();
  std::string word;
  while (std::cin >> word) {
    if (word == "host") {
      std::cin >> word;
      for (size_t i = 0; i < word.size(); i += 2) {
        SerialUSB.in.push_back(static_cast<uint8_t>(std::stoi(word.substr(i, 2), nullptr, 16)));
      }
      loop();
    } else if (word == "slip") {
      slip = true;
    } else if (word == "close") {
      SerialUSB.open = false;
      loop();
    } else {
      unsigned count;
      std::cin >> count;
      for (unsigned i = 0; i < count; i++) {
        if (word == "loop") loop();
        if (word == "trigger") trigger(false);
        if (word == "masked") trigger(true);
      }
      if (word == "masked") interrupt();
    }
  }
  fwrite(SerialUSB.out.data(), 1, SerialUSB.out.size(), stdout);
}
