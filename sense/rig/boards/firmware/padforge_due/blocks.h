// From conversions as the ADC stores them to blocks that wait to be sent, in plain C++ without Arduino.
#pragma once

#include "frames.h"

namespace padforge {

// Blocks between the interrupt that fills them and the loop that sends them. One side calls `free_slot` and `push`,
// the other `front` and `pop`; each index has one writer, so no lock is needed on one core.
class BlockQueue {
 public:
  static const unsigned SLOTS = 64;

  void clear() { filled_ = sent_ = 0; }
  Block *free_slot() { return filled_ - sent_ < SLOTS ? &slots_[filled_ % SLOTS] : nullptr; }
  void push() {
    barrier();
    filled_ = filled_ + 1;
  }
  const Block *front() {
    if (filled_ == sent_) return nullptr;
    barrier();
    return &slots_[sent_ % SLOTS];
  }
  void pop() {
    barrier();
    sent_ = sent_ + 1;
  }

 private:
  Block slots_[SLOTS];
  volatile uint32_t filled_ = 0;
  volatile uint32_t sent_ = 0;

  // Keeps the compiler from moving the use of a slot past the count that hands it over.
  static void barrier() { asm volatile("" ::: "memory"); }
};

// The order in which the ADC converts the inputs of a mask, and their columns in a sample.
class Layout {
 public:
  // `adc_channel[i]` is the channel of input Ai. The ADC converts by ascending channel, whatever the inputs.
  void set(uint16_t mask, const uint8_t *adc_channel) {
    uint8_t place[16];
    enabled_ = 0;
    unsigned next = 0;
    for (unsigned input = 0; input < MAX_CHANNELS; input++) {
      if (!(mask >> input & 1)) continue;
      enabled_ |= 1u << adc_channel[input];
      place[adc_channel[input]] = static_cast<uint8_t>(next++);
    }
    count_ = 0;
    for (uint8_t channel = 0; channel < 16; channel++) {
      if (!(enabled_ >> channel & 1)) continue;
      channel_[count_] = channel;
      place_[count_++] = place[channel];
    }
  }

  unsigned count() const { return count_; }
  uint32_t enabled() const { return enabled_; }  // mask of ADC channels

  // Sum conversions (number of the channel in the top four bits) to the samples of `block`. False if the numbers
  // are out of step, which would give one fibre the voltage of another.
  bool sum(const uint16_t *conversions, Block &block) const {
    memset(block.counts, 0, block.samples * count_ * sizeof block.counts[0]);
    for (unsigned sample = 0; sample < block.samples; sample++) {
      uint16_t *counts = block.counts + sample * count_;
      for (unsigned turn = 0; turn < block.averaging; turn++) {
        for (unsigned i = 0; i < count_; i++, conversions++) {
          if (*conversions >> 12 != channel_[i]) return false;
          counts[place_[i]] = static_cast<uint16_t>(counts[place_[i]] + (*conversions & 0x0FFF));
        }
      }
    }
    return true;
  }

 private:
  unsigned count_ = 0;
  uint32_t enabled_ = 0;
  uint8_t channel_[MAX_CHANNELS];
  uint8_t place_[MAX_CHANNELS];
};

}  // namespace padforge
