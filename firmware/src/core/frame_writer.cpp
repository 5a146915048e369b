// SPDX-License-Identifier: Apache-2.0
#include "core/frame_writer.h"

#include "board.h"

namespace ohmskin {

constexpr uint16_t FrameWriter::SIZE;

void FrameWriter::delimit() {
    ring_[write_] = frames::DELIMITER;
    write_ = (write_ + 1) & MASK;
    published_ = write_;
}

void FrameWriter::begin(frames::Type type) {
    delimit();
    crc_ = Crc16();
    const uint8_t octets[] = {static_cast<uint8_t>(type), sequence_++};
    put(octets, sizeof octets);
}

// Every code takes this path, so it is written for speed: the state is in registers meanwhile. A
// full block stands for no zero, and the next block opens only when a byte comes: a frame may end
// there.
void FrameWriter::put(const void *octets, uint8_t size) {
    const uint8_t *octet = static_cast<const uint8_t *>(octets);
    Crc16 crc = crc_;
    uint16_t write = write_;
    uint8_t length = length_;
    for (; size != 0; size--, octet++) {
#ifndef OHMSKIN_WITHOUT_LINE  // unit tests have writers that no line is behind (platformio.ini)
        // The chip holds two bytes for the line, and a frame's bytes take longer than these two
        // need to leave. So the line is fed meanwhile: it would idle otherwise.
        if (board::serial_can_write() && has_byte())
            board::serial_write(next_byte());
#endif
        crc.add(*octet);
        if (length == 0) {
            block_ = write;
            write = (write + 1) & MASK;
            length = 1;
        }
        if (*octet != 0) {
            ring_[write] = *octet;
            write = (write + 1) & MASK;
            if (++length != LONGEST_BLOCK)
                continue;
            ring_[block_] = length;
            published_ = write;
            length = 0;
        } else {
            ring_[block_] = length;
            published_ = write;
            block_ = write;
            write = (write + 1) & MASK;
            length = 1;
        }
    }
    crc_ = crc;
    write_ = write;
    length_ = length;
}

void FrameWriter::end() {
    const uint8_t octets[] = {crc_.low(), crc_.high()};
    put(octets, sizeof octets);
    if (length_ != 0) {
        ring_[block_] = length_;
        length_ = 0;
    }
    delimit();
}

void FrameWriter::abandon() {
    write_ = published_;
    length_ = 0;
    delimit();
}

}  // namespace ohmskin
