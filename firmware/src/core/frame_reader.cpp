// SPDX-License-Identifier: Apache-2.0
#include "core/frame_reader.h"

namespace ohmskin {

bool FrameReader::feed(uint8_t octet) {
    if (octet == frames::DELIMITER)
        return finish();
    if (left_ != 0) {
        left_--;
        store(octet);
        return false;
    }
    // A new block begins; the one before it stood for a zero, unless it was full or the first.
    if (code_ != 0 && code_ != FULL_BLOCK)
        store(0);
    code_ = octet;
    left_ = static_cast<uint8_t>(octet - 1);
    return false;
}

void FrameReader::store(uint8_t octet) {
    if (size_ == CONTENT_MAX) {
        damaged_ = true;
        return;
    }
    content_[size_++] = octet;
}

bool FrameReader::finish() {
    const bool empty = code_ == 0 && !damaged_;
    const bool valid =
        !damaged_ && left_ == 0 && size_ >= FRAME_BYTES_MIN && ends_in_crc(content_, size_);
    // A delimiter alone is how a host flushes the line: not an error.
    if (!valid && !empty)
        errors_++;
    payload_size_ = valid ? static_cast<uint8_t>(size_ - FRAME_BYTES_MIN) : 0;
    size_ = code_ = left_ = 0;
    damaged_ = false;
    return valid;
}

}  // namespace ohmskin
