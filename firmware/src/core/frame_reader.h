// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "core/attributes.h"
#include "core/crc16.h"
#include "frames.h"

namespace ohmskin {

// Commands, decoded byte by byte. A damaged, overlong or foreign frame is counted and forgotten;
// the next delimiter starts afresh.
class FrameReader {
  public:
    // Bytes of the longest payload that is taken. Chosen: more than any command has.
    static constexpr uint8_t PAYLOAD_MAX = 24;

    // Feeds one byte from the line; true when it completes a valid frame, which stays readable
    // until the next call.
    OHMSKIN_RARE bool feed(uint8_t octet);

    // The line itself reported an error (framing, overrun): what is being received is damaged.
    void line_error() { damaged_ = true; }

    uint8_t type() const { return content_[0]; }
    uint8_t sequence() const { return content_[1]; }
    const uint8_t *payload() const { return content_ + HEADER_BYTES; }
    uint8_t payload_size() const { return payload_size_; }
    uint16_t errors() const { return errors_; }
    void count_error() { errors_++; }

  private:
    // Bytes before the payload (type, sequence) and after it, and of a frame without payload.
    static constexpr uint8_t HEADER_BYTES = 2;
    static constexpr uint8_t FRAME_BYTES_MIN = HEADER_BYTES + CRC_BYTES;
    static constexpr uint8_t CONTENT_MAX = FRAME_BYTES_MIN + PAYLOAD_MAX;
    // The length byte of a full COBS block: 254 bytes, after which no zero was left out.
    static constexpr uint8_t FULL_BLOCK = 0xFF;

    bool finish();
    void store(uint8_t octet);

    uint8_t content_[CONTENT_MAX] = {};
    uint8_t size_ = 0;          // bytes of content_ decoded so far
    uint8_t payload_size_ = 0;  // of the last valid frame
    uint8_t code_ = 0;          // length byte of the open COBS block; 0: none yet
    uint8_t left_ = 0;          // bytes of the open block still to come
    bool damaged_ = false;      // the frame that is being received, by the line or by its length
    uint16_t errors_ = 0;
};

}  // namespace ohmskin
