// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "core/attributes.h"
#include "frames.h"

namespace ohmskin {

// Commands, decoded byte by byte. A damaged, overlong or foreign frame is counted and forgotten;
// the next delimiter starts afresh.
class FrameReader {
  public:
    static constexpr uint8_t PAYLOAD_MAX = 16;

    // Feeds one byte from the line; true when it completes a valid frame, which stays readable
    // until the next call.
    OHMSKIN_RARE bool feed(uint8_t octet);

    // The line itself reported an error (framing, overrun): what is being received is damaged.
    void line_error() { damaged_ = true; }

    uint8_t type() const { return content_[0]; }
    uint8_t sequence() const { return content_[1]; }
    const uint8_t *payload() const { return content_ + 2; }
    uint8_t payload_size() const { return static_cast<uint8_t>(frame_size_ - 4); }
    uint16_t errors() const { return errors_; }
    void count_error() { errors_++; }

  private:
    static constexpr uint8_t CONTENT_MAX = 2 + PAYLOAD_MAX + 2;

    bool finish();
    void store(uint8_t octet);

    uint8_t content_[CONTENT_MAX] = {};
    uint8_t size_ = 0;        // decoded so far
    uint8_t frame_size_ = 4;  // of the last valid frame, CRC included
    uint8_t code_ = 0;        // length byte of the open COBS block; 0: none yet
    uint8_t left_ = 0;        // bytes of the open block still to come
    bool damaged_ = false;
    uint16_t errors_ = 0;
};

}  // namespace ohmskin
