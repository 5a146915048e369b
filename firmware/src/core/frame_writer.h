// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "board_numbers.h"
#include "core/crc16.h"
#include "frames.h"

namespace ohmskin {

// Writes frames byte by byte, straight into the ring that the serial line is fed from.
//
// A COBS block starts with its length, so a block leaves for the line only when it is complete: at
// a zero byte, after 254 others, or at the frame's end. Nothing larger is ever held back. So a
// 16x16 scan of 1.3 kB streams through a ring of 512 bytes.
class FrameWriter {
  public:
    // Bytes of the ring.
    static constexpr uint16_t SIZE = board::RING_SIZE;
    static_assert((SIZE & (SIZE - 1)) == 0, "indices are masked");
    // Bytes of the longest COBS block, its length byte included, and without it.
    static constexpr uint16_t LONGEST_BLOCK = 255;
    static constexpr uint16_t BLOCK_CONTENT_MAX = LONGEST_BLOCK - 1;
    // Bytes of a frame besides payload and length bytes: type, sequence; CRC; two delimiters.
    static constexpr uint8_t OVERHEAD = 2 + 2 + 2;

    // Bytes on the line for a frame of `payload` bytes, at most.
    static constexpr uint16_t line_bytes(uint16_t payload) {
        return static_cast<uint16_t>(payload + OVERHEAD + 1 +
                                     (payload + OVERHEAD) / BLOCK_CONTENT_MAX);
    }

    void begin(frames::Type type);
    void put(const void *octets, uint8_t size);
    void end();
    // Ends a frame that cannot be completed so that the host rejects it and stays in step.
    void abandon();

    uint16_t used() const { return (write_ - read_) & MASK; }
    uint16_t space() const { return static_cast<uint16_t>(SIZE - 1 - used()); }

    bool has_byte() const { return read_ != published_; }
    uint8_t next_byte() {
        const uint8_t octet = ring_[read_];
        read_ = (read_ + 1) & MASK;
        return octet;
    }

  private:
    static constexpr uint16_t MASK = SIZE - 1;

    void delimit();

    uint8_t ring_[SIZE] = {};
    uint16_t read_ = 0;       // next byte for the line
    uint16_t published_ = 0;  // end of what may leave
    uint16_t write_ = 0;      // end of what is encoded
    uint16_t block_ = 0;      // where the open block's length goes
    uint8_t length_ = 0;      // of the open block, its own byte included; 0: none is open
    uint8_t sequence_ = 0;
    Crc16 crc_ = Crc16::none();
};

}  // namespace ohmskin
