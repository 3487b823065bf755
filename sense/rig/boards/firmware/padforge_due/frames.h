// The wire format of the Due board in plain C++ without Arduino; README.md describes it.
//
// A frame on the wire is `00 coded check 00`: `coded` is the payload with its zeros taken out by COBS, `check` the
// CRC-16/CCITT-FALSE of `coded` in three bytes without a zero. Numbers are little-endian.
#pragma once

#include <stddef.h>
#include <stdint.h>
#include <string.h>

namespace padforge {

const uint8_t IDENTIFY = 0x01;
const uint8_t SETTINGS = 0x02;
const uint8_t START = 0x03;
const uint8_t STOP = 0x04;
const uint8_t IDENTITY = 0x81;
const uint8_t ACK = 0x82;
const uint8_t BLOCK = 0x90;

const uint8_t OK = 0;
const uint8_t BAD_SETTINGS = 1;
const uint8_t TOO_FAST = 2;
const uint8_t RUNNING = 3;
const uint8_t HALTED = 4;

const unsigned MAX_CHANNELS = 12;
const unsigned MAX_SAMPLES = 16;
const unsigned MAX_AVERAGING = 16;
const unsigned CHECK_BYTES = 3;
const size_t MAX_PAYLOAD = 19 + 2 * MAX_SAMPLES * MAX_CHANNELS;
const size_t MAX_FRAME = MAX_PAYLOAD + MAX_PAYLOAD / 254 + 1 + CHECK_BYTES + 2;  // with the zeros at both ends
const size_t MAX_COMMAND = 16;                                                   // longer frames are no commands

struct Settings {
  uint32_t period_ns;  // from sample to sample
  uint16_t mask;       // bit i is input Ai
  uint8_t averaging;   // conversions summed to a sample
};

struct Block {
  uint8_t samples;
  uint8_t averaging;
  uint16_t mask;
  uint16_t sequence;
  uint32_t first;
  uint32_t time_us;
  uint32_t overruns;
  uint16_t counts[MAX_SAMPLES * MAX_CHANNELS];  // sample by sample, inputs ascending
};

inline unsigned channels(uint16_t mask) {
  unsigned count = 0;
  for (; mask; mask &= mask - 1) count++;
  return count;
}

inline uint16_t crc16(const uint8_t *data, size_t size) {
  uint16_t crc = 0xFFFF;
  for (size_t i = 0; i < size; i++) {
    crc ^= static_cast<uint16_t>(data[i] << 8);
    for (int bit = 0; bit < 8; bit++) {
      crc = static_cast<uint16_t>(crc & 0x8000 ? (crc << 1) ^ 0x1021 : crc << 1);
    }
  }
  return crc;
}

inline void make_check(const uint8_t *coded, size_t size, uint8_t *check) {
  const uint16_t crc = crc16(coded, size);
  check[0] = 0x80 | crc >> 14;
  check[1] = 0x80 | (crc >> 7 & 0x7F);
  check[2] = 0x80 | (crc & 0x7F);
}

// Payloads are written number by number, so that neither padding nor the order of bytes in a struct matters.
class Payload {
 public:
  uint8_t bytes[MAX_PAYLOAD];
  size_t size = 0;

  void u8(uint8_t value) { bytes[size++] = value; }
  void u16(uint16_t value) {
    u8(value & 0xFF);
    u8(value >> 8);
  }
  void u32(uint32_t value) {
    u16(value & 0xFFFF);
    u16(value >> 16);
  }
  void raw(const void *data, size_t count) {
    memcpy(bytes + size, data, count);
    size += count;
  }
};

inline void write_settings(Payload &payload, const Settings &settings) {
  payload.u32(settings.period_ns);
  payload.u16(settings.mask);
  payload.u8(settings.averaging);
}

// `name` and `serial` are 16 bytes each.
inline void write_identity(Payload &payload, const uint8_t version[3], uint8_t bits, const char *name,
                           const uint8_t *serial) {
  payload.u8(IDENTITY);
  payload.raw(version, 3);
  payload.u8(bits);
  payload.u8(MAX_CHANNELS);
  payload.raw(name, 16);
  payload.raw(serial, 16);
}

inline void write_ack(Payload &payload, uint8_t command, uint8_t status, const Settings &settings) {
  payload.u8(ACK);
  payload.u8(command);
  payload.u8(status);
  write_settings(payload, settings);
}

inline void write_block(Payload &payload, const Block &block) {
  payload.u8(BLOCK);
  payload.u8(block.samples);
  payload.u8(block.averaging);
  payload.u16(block.mask);
  payload.u16(block.sequence);
  payload.u32(block.first);
  payload.u32(block.time_us);
  payload.u32(block.overruns);
  const unsigned counts = block.samples * channels(block.mask);
  for (unsigned i = 0; i < counts; i++) payload.u16(block.counts[i]);
}

// Write the frame of a payload to `frame`, of MAX_FRAME bytes; returns how many it takes.
inline size_t encode(const Payload &payload, uint8_t *frame) {
  size_t count_at = 1;  // where the count of the run under way will stand
  size_t at = 2;
  frame[0] = 0;
  for (size_t i = 0; i < payload.size; i++) {
    if (payload.bytes[i] != 0) frame[at++] = payload.bytes[i];
    const size_t count = at - count_at;
    if (payload.bytes[i] == 0 || count == 255) {
      frame[count_at] = static_cast<uint8_t>(count);
      count_at = at++;
    }
  }
  frame[count_at] = static_cast<uint8_t>(at - count_at);
  make_check(frame + 1, at - 1, frame + at);
  at += CHECK_BYTES;
  frame[at++] = 0;
  return at;
}

// Finds commands in the bytes from the host; damaged frames are passed over, the host asks again.
class CommandReader {
 public:
  uint8_t payload[MAX_COMMAND];
  size_t size = 0;  // of `payload`

  // Take one byte; true when it completes an intact frame, whose payload is then in `payload`.
  bool take(uint8_t byte) {
    if (byte != 0) {
      if (length_ <= MAX_COMMAND) piece_[length_++] = byte;  // a full buffer is damaged whatever follows
      return false;
    }
    const size_t length = length_;
    length_ = 0;
    return length > CHECK_BYTES && length <= MAX_COMMAND && sound(length - CHECK_BYTES);
  }

  // Read `payload` as settings; false if it is none.
  bool read_settings(Settings &settings) const {
    if (size != 8 || payload[0] != SETTINGS) return false;
    settings.period_ns = payload[1] | payload[2] << 8 | payload[3] << 16 | static_cast<uint32_t>(payload[4]) << 24;
    settings.mask = static_cast<uint16_t>(payload[5] | payload[6] << 8);
    settings.averaging = payload[7];
    return true;
  }

 private:
  uint8_t piece_[MAX_COMMAND + 1];
  size_t length_ = 0;

  bool sound(size_t coded) {
    uint8_t check[CHECK_BYTES];
    make_check(piece_, coded, check);
    if (memcmp(check, piece_ + coded, CHECK_BYTES) != 0) return false;
    size = 0;
    for (size_t at = 0; at < coded;) {
      const size_t end = at + piece_[at];
      if (end > coded) return false;
      for (at++; at < end; at++) payload[size++] = piece_[at];
      if (end < coded) payload[size++] = 0;  // a command is too short for a count of 255, after which no zero stands
    }
    return size > 0;
  }
};

}  // namespace padforge
