// SPDX-License-Identifier: Apache-2.0
#include "core/frame_writer.h"

#include "core/crc16.h"

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
    crc_ = frames::CRC_INITIAL;
    put(static_cast<uint8_t>(type));
    put(sequence_++);
}

void FrameWriter::put(uint8_t octet) {
    crc_ = crc16_update(crc_, octet);
    encode(octet);
}

void FrameWriter::put(const void *octets, uint8_t size) {
    const uint8_t *octet = static_cast<const uint8_t *>(octets);
    while (size--)
        put(*octet++);
}

void FrameWriter::end() {
    const uint16_t crc = crc_;
    encode(static_cast<uint8_t>(crc));
    encode(static_cast<uint8_t>(crc >> 8));
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
