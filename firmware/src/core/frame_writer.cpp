// SPDX-License-Identifier: Apache-2.0
#include "core/frame_writer.h"

namespace ohmskin {

constexpr uint16_t FrameWriter::SIZE;

void FrameWriter::open_block() {
    block_ = write_;
    write_ = (write_ + 1) & MASK;
    length_ = 1;
}

void FrameWriter::close_block() {
    ring_[block_] = length_;
    published_ = write_;
    length_ = 0;
}

void FrameWriter::delimit() {
    ring_[write_] = frames::DELIMITER;
    write_ = (write_ + 1) & MASK;
    published_ = write_;
}

void FrameWriter::encode(uint8_t octet) {
    if (length_ == 0)
        open_block();
    if (octet == 0) {
        close_block();
        open_block();
        return;
    }
    ring_[write_] = octet;
    write_ = (write_ + 1) & MASK;
    // A full block stands for its bytes alone, without a zero; the next opens when a byte comes.
    if (++length_ == LONGEST_BLOCK)
        close_block();
}

void FrameWriter::begin(frames::Type type) {
    delimit();
    crc_ = Crc16();
    put(static_cast<uint8_t>(type));
    put(sequence_++);
}

void FrameWriter::put(uint8_t octet) {
    crc_.add(octet);
    encode(octet);
}

// The path every code takes: put() of each byte, with the state in registers meanwhile.
void FrameWriter::put(const void *octets, uint8_t size) {
    const uint8_t *octet = static_cast<const uint8_t *>(octets);
    Crc16 crc = crc_;
    uint16_t write = write_;
    uint8_t length = length_;
    for (; size != 0; size--, octet++) {
        crc.add(*octet);
        if (*octet != 0 && length != 0 && length != LONGEST_BLOCK - 1) {
            ring_[write] = *octet;
            write = (write + 1) & MASK;
            length++;
            continue;
        }
        write_ = write;
        length_ = length;
        encode(*octet);
        write = write_;
        length = length_;
    }
    crc_ = crc;
    write_ = write;
    length_ = length;
}

void FrameWriter::end() {
    encode(crc_.low());
    encode(crc_.high());
    if (length_ != 0)
        close_block();
    delimit();
}

void FrameWriter::abandon() {
    write_ = published_;
    length_ = 0;
    delimit();
}

}  // namespace ohmskin
