// padforge: reads up to twelve voltages with an Arduino Due (SAM3X8E) and sends them over the native USB port.
//
// A timer starts every conversion, the ADC converts all inputs in turn, and the peripheral DMA stores the results in
// one of two buffers while the other is being summed: no program runs between the quartz and the sample, so its
// instants do not jitter. The interrupt comes once a block. The index of a sample counts on through blocks that
// cannot be sent, so a gap always shows.

#include "blocks.h"
#include "frames.h"

using namespace padforge;

const uint8_t VERSION[3] = {1, 0, 0};
const char NAME[16] = "padforge-due";
const uint8_t BITS = 12;
const uint8_t ADC_CHANNEL[MAX_CHANNELS] = {7, 6, 5, 4, 3, 2, 1, 0, 10, 11, 12, 13};  // of A0 to A11

const uint32_t TICKS_PER_US = 42;  // the timer counts half the master clock of 84 MHz
// At the ADC's clock of 8.4 MHz tracking (16 periods) and converting (about 24) one input take less than 5 us. A trigger
// that came too soon would be ignored without a flag, hence the reserve.
const uint32_t MIN_TICKS_PER_CONVERSION = 6 * TICKS_PER_US;
const uint32_t MAX_PERIOD_NS = 1000000000;
const uint32_t BLOCK_NS = 20000000;  // a block is sent after so much time at the latest, or with a single sample
const int WATCHDOG_MS = 10000;       // more than the host ever keeps a write waiting
const uint32_t FLASH_KEY = 0x5Au << 24;  // opens the command register of the flash

Settings settings = {1000000, 0xFF, 1};
Layout layout;
BlockQueue queue;
CommandReader commands;
uint8_t serial_number[16];
uint8_t wire[MAX_FRAME];

bool running = false;
volatile bool halted = false;  // conversions were lost: the place in the sequence is unknown
uint16_t conversions[2][MAX_SAMPLES * MAX_AVERAGING * MAX_CHANNELS];
uint8_t filling;  // buffer the DMA is at
uint8_t block_samples;
uint16_t sequence;
uint32_t next_index;
uint32_t overruns;

// The core disables the watchdog before setup() unless this function is defined here.
void watchdogSetup(void) {}

uint32_t timer_ticks(const Settings &wanted) {
  const uint64_t ticks = static_cast<uint64_t>(wanted.period_ns) * TICKS_PER_US;
  const uint32_t divisor = 1000u * wanted.averaging;
  return static_cast<uint32_t>((ticks + divisor / 2) / divisor);
}

uint32_t buffer_size() { return static_cast<uint32_t>(block_samples) * settings.averaging * layout.count(); }

void send(const Payload &payload) { SerialUSB.write(wire, encode(payload, wire)); }

void acknowledge(uint8_t command, uint8_t status) {
  Payload payload;
  write_ack(payload, command, status, settings);
  send(payload);
}

uint8_t judge(const Settings &wanted) {
  if (wanted.mask == 0 || wanted.mask >> MAX_CHANNELS) return BAD_SETTINGS;
  if (wanted.averaging == 0 || wanted.averaging > MAX_AVERAGING) return BAD_SETTINGS;
  if (wanted.period_ns == 0 || wanted.period_ns > MAX_PERIOD_NS) return BAD_SETTINGS;
  return timer_ticks(wanted) < MIN_TICKS_PER_CONVERSION * channels(wanted.mask) ? TOO_FAST : OK;
}

// Take over settings, with the period the timer can really keep.
void apply(const Settings &wanted) {
  settings = wanted;
  const uint64_t ticks = static_cast<uint64_t>(timer_ticks(wanted)) * wanted.averaging;
  settings.period_ns = static_cast<uint32_t>((ticks * 1000 + TICKS_PER_US / 2) / TICKS_PER_US);
  const uint32_t samples = BLOCK_NS / settings.period_ns;
  block_samples = static_cast<uint8_t>(samples < 1 ? 1 : samples > MAX_SAMPLES ? MAX_SAMPLES : samples);
  layout.set(settings.mask, ADC_CHANNEL);
  for (unsigned input = 0; input < MAX_CHANNELS; input++) {
    if (settings.mask >> input & 1) pinMode(A0 + input, INPUT);  // without the pull-up, which would change the divider
  }
}

void stop_sampling() {
  TC0->TC_CHANNEL[0].TC_CCR = TC_CCR_CLKDIS;
  NVIC_DisableIRQ(ADC_IRQn);
  ADC->ADC_IDR = 0xFFFFFFFF;
  ADC->ADC_PTCR = ADC_PTCR_RXTDIS;
  ADC->ADC_MR &= ~ADC_MR_TRGEN_EN;
  queue.clear();
  running = false;
  halted = false;
}

void start_adc() {
  ADC->ADC_CR = ADC_CR_SWRST;
  // 84 MHz / (2 * (4 + 1)) = 8.4 MHz, and tracking as long as possible: the fibres are sources of some kilohms.
  ADC->ADC_MR = ADC_MR_TRGEN_EN | ADC_MR_TRGSEL_ADC_TRIG1 | ADC_MR_LOWRES_BITS_12 | ADC_MR_PRESCAL(4) |
                ADC_MR_STARTUP_SUT64 | ADC_MR_SETTLING_AST3 | ADC_MR_TRACKTIM(15) | ADC_MR_TRANSFER(1);
  ADC->ADC_EMR = ADC_EMR_TAG;  // the number of the channel with every result
  ADC->ADC_CHDR = 0xFFFF;
  ADC->ADC_CHER = layout.enabled();
  ADC->ADC_RPR = reinterpret_cast<uintptr_t>(conversions[0]);
  ADC->ADC_RCR = buffer_size();
  ADC->ADC_RNPR = reinterpret_cast<uintptr_t>(conversions[1]);
  ADC->ADC_RNCR = buffer_size();
  (void)ADC->ADC_LCDR;
  (void)ADC->ADC_ISR;
  ADC->ADC_PTCR = ADC_PTCR_RXTEN;
  ADC->ADC_IER = ADC_IER_ENDRX | ADC_IER_RXBUFF | ADC_IER_GOVRE;
  NVIC_ClearPendingIRQ(ADC_IRQn);
  NVIC_EnableIRQ(ADC_IRQn);
}

void start_timer() {
  const uint32_t ticks = timer_ticks(settings);
  TcChannel &timer = TC0->TC_CHANNEL[0];
  timer.TC_CCR = TC_CCR_CLKDIS;
  timer.TC_IDR = 0xFFFFFFFF;
  timer.TC_CMR = TC_CMR_WAVE | TC_CMR_WAVSEL_UP_RC | TC_CMR_TCCLKS_TIMER_CLOCK1 | TC_CMR_ACPA_CLEAR | TC_CMR_ACPC_SET;
  timer.TC_RA = ticks / 2;
  timer.TC_RC = ticks;  // TIOA0 rises here, and that is the trigger
  timer.TC_CCR = TC_CCR_CLKEN | TC_CCR_SWTRG;
}

void start_sampling() {
  filling = 0;
  sequence = 0;
  next_index = 0;
  overruns = 0;
  queue.clear();
  running = true;
  start_adc();
  start_timer();
}

// Hand a full buffer of conversions on as a block, or count its samples as lost if the host is too slow.
void finish_block(const uint16_t *full, uint32_t now_us) {
  Block *block = queue.free_slot();
  if (block == nullptr) {
    overruns += block_samples;
  } else {
    block->samples = block_samples;
    block->averaging = settings.averaging;
    block->mask = settings.mask;
    block->sequence = sequence++;
    block->first = next_index;
    block->time_us = now_us;
    block->overruns = overruns;
    if (layout.sum(full, *block)) {
      queue.push();
    } else {
      halted = true;
    }
  }
  next_index += block_samples;
}

void ADC_Handler(void) {
  const uint32_t now_us = micros();
  const uint32_t status = ADC->ADC_ISR;
  if (status & (ADC_ISR_RXBUFF | ADC_ISR_GOVRE)) {  // both buffers are full, or a result was overwritten
    halted = true;
    ADC->ADC_IDR = 0xFFFFFFFF;
  } else if (status & ADC_ISR_ENDRX) {
    const uint16_t *full = conversions[filling];
    filling ^= 1;
    finish_block(full, now_us);
    ADC->ADC_RNPR = reinterpret_cast<uintptr_t>(full);
    ADC->ADC_RNCR = buffer_size();  // also takes back ENDRX
  }
}

void identify() {
  Payload payload;
  write_identity(payload, VERSION, BITS, NAME, serial_number);
  send(payload);
}

void obey() {
  Settings wanted;
  if (commands.read_settings(wanted)) {
    const uint8_t status = running ? RUNNING : judge(wanted);
    if (status == OK) apply(wanted);
    acknowledge(SETTINGS, status);
  } else if (commands.size == 1 && commands.payload[0] == IDENTIFY) {
    identify();
  } else if (commands.size == 1 && commands.payload[0] == START) {
    if (!running) start_sampling();
    acknowledge(START, OK);
  } else if (commands.size == 1 && commands.payload[0] == STOP) {
    stop_sampling();
    acknowledge(STOP, OK);
  }
}

void send_block() {
  const Block *block = queue.front();
  if (block == nullptr) return;
  Payload payload;
  write_block(payload, *block);
  queue.pop();
  send(payload);
}

// The 128 bit unique identifier of the chip. The second half of the flash returns it in place of its contents for
// a while, which is safe as the program runs from the first.
void read_serial_number() {
  EFC1->EEFC_FCR = FLASH_KEY | EFC_FCMD_STUI;
  while (EFC1->EEFC_FSR & EEFC_FSR_FRDY) {
  }
  memcpy(serial_number, reinterpret_cast<const void *>(IFLASH1_ADDR), sizeof serial_number);
  EFC1->EEFC_FCR = FLASH_KEY | EFC_FCMD_SPUI;
  while (!(EFC1->EEFC_FSR & EEFC_FSR_FRDY)) {
  }
}

void setup() {
  watchdogEnable(WATCHDOG_MS);
  SerialUSB.begin(115200);
  pmc_enable_periph_clk(ID_ADC);
  pmc_enable_periph_clk(ID_TC0);
  read_serial_number();
  apply(settings);
}

void loop() {
  watchdogReset();
  while (SerialUSB.available() > 0) {
    if (commands.take(static_cast<uint8_t>(SerialUSB.read()))) obey();
  }
  if (running && !SerialUSB.dtr()) stop_sampling();  // the host has closed the port
  if (halted) {
    stop_sampling();
    acknowledge(STOP, HALTED);
  }
  send_block();
}
