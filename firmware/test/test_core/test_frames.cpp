// SPDX-License-Identifier: Apache-2.0
// The framing against the golden vectors, which no code of this project made.
#include "../check.h"
#include "../vectors.h"

#include <string.h>

#include "core/crc16.h"
#include "core/frame_reader.h"
#include "core/frame_writer.h"

using namespace ohmskin;

namespace {

uint8_t at(const uint8_t *flash, uint16_t i) { return pgm_read_byte(flash + i); }

// Writes a vector's content as a frame; true when every byte on the line is the vector's.
bool writes(FrameWriter &writer, const vectors::Vector &v) {
    writer.begin(static_cast<frames::Type>(at(v.content, 0)));
    uint16_t out = 0;
    bool same = true;
    for (uint16_t i = 2; i < v.content_size; i++) {
        const uint8_t octet = at(v.content, i);
        writer.put(&octet, 1);
        while (writer.has_byte())
            same = writer.next_byte() == at(v.wire, out++) && same;
    }
    writer.end();
    while (writer.has_byte())
        same = writer.next_byte() == at(v.wire, out++) && same;
    return same && out == v.wire_size;
}

// A writer whose next frame carries the sequence number.
void advance(FrameWriter &writer, uint8_t sequence) {
    for (uint8_t i = 0; i < sequence; i++) {
        writer.begin(frames::Type::Ack);
        writer.end();
        while (writer.has_byte())
            writer.next_byte();
    }
}

bool command_fits(const vectors::Vector &v) {
    return v.content_size >= 2 && v.content_size <= 2 + FrameReader::PAYLOAD_MAX;
}

}  // namespace

TEST(crc_has_the_catalogues_check_value) {
    Crc16 crc;
    for (const char *c = "123456789"; *c; c++)
        crc.add(static_cast<uint8_t>(*c));
    CHECK_EQ(0x29, crc.high());
    CHECK_EQ(0xB1, crc.low());
}

TEST(writer_makes_every_golden_frame) {
    for (const vectors::Vector &v : vectors::ALL) {
        if (v.content_size == 0)
            continue;
        FrameWriter writer;
        advance(writer, at(v.content, 1));
        if (!CHECK(writes(writer, v)))
            printf("    in vector: %s\n", v.name);
    }
}

TEST(reader_takes_every_golden_command_and_rejects_longer_frames) {
    FrameReader reader;
    for (const vectors::Vector &v : vectors::ALL) {
        if (v.content_size == 0)
            continue;
        const uint16_t errors = reader.errors();
        bool complete = false;
        for (uint16_t i = 0; i < v.wire_size; i++) {
            complete = reader.feed(at(v.wire, i));
        }
        CHECK_EQ(command_fits(v), complete);
        CHECK_EQ(errors + !command_fits(v), reader.errors());
        if (!complete)
            continue;
        CHECK_EQ(at(v.content, 0), reader.type());
        CHECK_EQ(at(v.content, 1), reader.sequence());
        if (!CHECK_EQ(v.content_size - 2, reader.payload_size()))
            continue;
        for (uint8_t i = 0; i < reader.payload_size(); i++)
            CHECK_EQ(at(v.content, i + 2), reader.payload()[i]);
    }
}

TEST(reader_counts_damage_and_takes_the_next_frame) {
    const vectors::Vector *good = &vectors::ALL[1];  // "start"
    CHECK_EQ(0x83, at(good->content, 0));
    FrameReader reader;
    for (const vectors::Vector &v : vectors::ALL) {
        if (v.content_size != 0)
            continue;
        const uint16_t errors = reader.errors();
        for (uint16_t i = 0; i < v.wire_size; i++)
            CHECK(!reader.feed(at(v.wire, i)));
        CHECK(reader.errors() > errors);
        bool complete = false;
        for (uint16_t i = 0; i < good->wire_size; i++)
            complete = reader.feed(at(good->wire, i));
        if (!CHECK(complete))
            printf("    after vector: %s\n", v.name);
    }
}

TEST(reader_ignores_idle_delimiters) {
    FrameReader reader;
    for (uint8_t i = 0; i < 5; i++)
        CHECK(!reader.feed(frames::DELIMITER));
    CHECK_EQ(0, reader.errors());
}

TEST(reader_rejects_a_frame_in_which_the_line_failed) {
    const vectors::Vector &good = vectors::ALL[1];
    FrameReader reader;
    bool complete = false;
    for (uint16_t i = 0; i < good.wire_size; i++) {
        complete = reader.feed(at(good.wire, i));
        if (i == 3)
            reader.line_error();
    }
    CHECK(!complete);
    CHECK_EQ(1, reader.errors());
}

TEST(an_abandoned_frame_ends_and_is_not_valid) {
    FrameWriter writer;
    FrameReader reader;
    writer.begin(frames::Type::Ack);
    const uint8_t octets[] = {0, 1};
    writer.put(octets, sizeof octets);
    writer.abandon();
    bool any = false;
    uint8_t last = 1;
    while (writer.has_byte()) {
        last = writer.next_byte();
        any = reader.feed(last) || any;
    }
    CHECK_EQ(frames::DELIMITER, last);
    CHECK(!any);
    writer.begin(frames::Type::Ack);
    writer.end();
    while (writer.has_byte())
        any = reader.feed(writer.next_byte());
    CHECK(any);
}

TEST(line_bytes_is_an_upper_bound) {
    // The worst case of COBS: no zero anywhere.
    FrameWriter writer;
    for (uint16_t payload = 1; payload < 1300; payload += 77) {
        writer.begin(frames::Type::Scan);
        uint16_t out = 0;
        for (uint16_t i = 0; i < payload; i++) {
            const uint8_t octet = 0xFF;
            writer.put(&octet, 1);
            for (; writer.has_byte(); out++)
                writer.next_byte();
        }
        writer.end();
        for (; writer.has_byte(); out++)
            writer.next_byte();
        CHECK(out <= FrameWriter::line_bytes(payload));
        CHECK(out + 4 >= FrameWriter::line_bytes(payload));
    }
}
