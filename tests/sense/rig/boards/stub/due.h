// What the Due has beyond other boards: its timers, converter and flash, as far as the sketch uses them.
#pragma once

#include "Arduino.h"

typedef volatile uint32_t Reg;
typedef volatile uintptr_t PointerReg;

struct TcChannel {
  Reg TC_CCR, TC_CMR, TC_RA, TC_RC, TC_IDR;
};
struct Tc {
  TcChannel TC_CHANNEL[3];
};
struct Adc {
  Reg ADC_CR, ADC_MR, ADC_EMR, ADC_CHDR, ADC_CHER, ADC_IER, ADC_IDR, ADC_ISR, ADC_LCDR;
  PointerReg ADC_RPR, ADC_RNPR;
  Reg ADC_RCR, ADC_RNCR, ADC_PTCR;
};
// A flash controller that is busy at every other look.
struct Toggle {
  uint32_t value = 0;
  operator uint32_t() { return value ^= 1; }
};
struct Efc {
  Reg EEFC_FCR;
  Toggle EEFC_FSR;
};

extern Tc stub_tc;
extern Adc stub_adc;
extern Efc stub_efc;
extern bool stub_adc_irq;
extern const char stub_flash[17];

#define TC0 (&stub_tc)
#define ADC (&stub_adc)
#define EFC1 (&stub_efc)
#define IFLASH1_ADDR reinterpret_cast<uintptr_t>(stub_flash)

const uint32_t TC_CCR_CLKEN = 1, TC_CCR_CLKDIS = 2, TC_CCR_SWTRG = 4;
const uint32_t TC_CMR_WAVE = 1u << 15, TC_CMR_WAVSEL_UP_RC = 2u << 13, TC_CMR_TCCLKS_TIMER_CLOCK1 = 0;
const uint32_t TC_CMR_ACPA_CLEAR = 2u << 16, TC_CMR_ACPC_SET = 1u << 18;
const uint32_t ADC_CR_SWRST = 1, ADC_MR_TRGEN_EN = 1, ADC_MR_TRGSEL_ADC_TRIG1 = 1u << 1, ADC_MR_LOWRES_BITS_12 = 0;
const uint32_t ADC_MR_STARTUP_SUT64 = 4u << 16, ADC_MR_SETTLING_AST3 = 0, ADC_EMR_TAG = 1u << 24;
#define ADC_MR_PRESCAL(value) (static_cast<uint32_t>(value) << 8)
#define ADC_MR_TRACKTIM(value) (static_cast<uint32_t>(value) << 24)
#define ADC_MR_TRANSFER(value) (static_cast<uint32_t>(value) << 28)
const uint32_t ADC_PTCR_RXTEN = 1, ADC_PTCR_RXTDIS = 2;
const uint32_t ADC_IER_GOVRE = 1u << 25, ADC_IER_ENDRX = 1u << 27, ADC_IER_RXBUFF = 1u << 28;
const uint32_t ADC_ISR_GOVRE = 1u << 25, ADC_ISR_ENDRX = 1u << 27, ADC_ISR_RXBUFF = 1u << 28;
const uint32_t EFC_FCMD_STUI = 0x0E, EFC_FCMD_SPUI = 0x0F, EEFC_FSR_FRDY = 1;
enum { ADC_IRQn, ID_ADC, ID_TC0 };

inline void NVIC_EnableIRQ(int) { stub_adc_irq = true; }
inline void NVIC_DisableIRQ(int) { stub_adc_irq = false; }
inline void NVIC_ClearPendingIRQ(int) {}
inline void pmc_enable_periph_clk(int) {}
inline void watchdogEnable(int) {}
inline void watchdogReset() {}

extern StubSerial SerialUSB;
