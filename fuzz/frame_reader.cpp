// SPDX-License-Identifier: Apache-2.0
//
// The firmware's frame reader under sanitizers, against a decoder that is written another way:
//
//     frame_reader STREAMS SEED    seeded mutations of right streams
//
// With clang, -fsanitize=fuzzer -DLIBFUZZER makes libFuzzer's program of it.
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#include <random>
#include <vector>

#include "core/frame_reader.h"

using Octets = std::vector<uint8_t>;

namespace {

uint16_t crc_of(const uint8_t *octets, size_t size) {
    uint16_t crc = 0xFFFF;
    for (size_t i = 0; i < size; i++)
        for (int bit = 7; bit >= 0; bit--) {
            const bool carry = ((crc >> 15) ^ (octets[i] >> bit)) & 1;
            crc = static_cast<uint16_t>(crc << 1) ^ (carry ? 0x1021 : 0);
        }
    return crc;
}

// The content of a stretch without zeros; false where it is no COBS.
bool decoded(const Octets &stretch, Octets &content) {
    size_t at = 0;
    while (at < stretch.size()) {
        const size_t end = at + stretch[at];
        if (end > stretch.size())
            return false;
        content.insert(content.end(), stretch.begin() + at + 1, stretch.begin() + end);
        if (stretch[at] != 0xFF && end < stretch.size())
            content.push_back(0);
        at = end;
    }
    return true;
}

Octets encoded(const Octets &content) {
    Octets out(1, 0);
    size_t code = 1;
    out.push_back(1);
    for (uint8_t octet : content) {
        if (octet != 0) {
            out.push_back(octet);
            out[code]++;
        }
        if (octet == 0 || out[code] == 0xFF) {
            code = out.size();
            out.push_back(1);
        }
    }
    out.push_back(0);
    return out;
}

void require(bool holds, const char *what) {
    if (holds)
        return;
    fprintf(stderr, "frame_reader: %s\n", what);
    abort();
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t *octets, size_t size) {
    ohmskin::FrameReader reader;
    const size_t most = 2 + ohmskin::FrameReader::PAYLOAD_MAX + 2;
    Octets stretch;
    uint16_t errors = 0;
    for (size_t i = 0; i < size; i++) {
        const bool complete = reader.feed(octets[i]);
        if (octets[i] != 0) {
            require(!complete, "a frame ends without a delimiter");
            stretch.push_back(octets[i]);
            continue;
        }
        Octets content;
        bool valid = decoded(stretch, content) && content.size() >= 4 && content.size() <= most;
        const size_t body = content.size() - 2;
        valid = valid && crc_of(content.data(), body) == (content[body] | content[body + 1] << 8);
        errors += !valid && !stretch.empty();
        require(complete == valid, "another answer than the oracle's");
        require(reader.errors() == errors, "another count of errors");
        if (valid) {
            require(reader.type() == content[0] && reader.sequence() == content[1], "type");
            require(reader.payload_size() == body - 2, "size of the payload");
            for (size_t k = 2; k < body; k++)
                require(reader.payload()[k - 2] == content[k], "payload");
        }
        stretch.clear();
    }
    return 0;
}

#ifndef LIBFUZZER
int main(int count, char **arguments) {
    if (count != 3)
        return 2;
    std::mt19937 dice(static_cast<uint32_t>(atol(arguments[2])));
    size_t octets = 0;
    for (long n = atol(arguments[1]); n > 0; n--) {
        Octets stream;
        for (uint32_t frames = 1 + dice() % 3; frames > 0; frames--) {
            Octets content(2 + dice() % 20);
            for (uint8_t &octet : content)
                octet = dice() % 3 ? static_cast<uint8_t>(dice()) : 0;
            const uint16_t crc = crc_of(content.data(), content.size());
            content.push_back(static_cast<uint8_t>(crc));
            content.push_back(static_cast<uint8_t>(crc >> 8));
            const Octets wire = encoded(content);
            stream.insert(stream.end(), wire.begin(), wire.end());
        }
        for (uint32_t changes = dice() % 4; changes > 0; changes--) {
            const auto at = stream.begin() + dice() % stream.size();
            switch (dice() % 4) {
            case 0:
                *at = static_cast<uint8_t>(dice());
                break;
            case 1:
                stream.insert(at, static_cast<uint8_t>(dice() % 2 ? 0xFF : 0));
                break;
            case 2:
                stream.insert(at, dice() % 600, static_cast<uint8_t>(1 + dice() % 255));
                break;
            default:
                stream.erase(at);
                break;
            }
        }
        LLVMFuzzerTestOneInput(stream.data(), stream.size());
        octets += stream.size();
    }
    printf("%s streams, %zu bytes\n", arguments[1], octets);
    return 0;
}
#endif
