// SPDX-License-Identifier: Apache-2.0
// Settings in EEPROM: what a save that is cut short leaves, versions, wear.
#ifndef __AVR_ATmega328P__  // 2 KiB of RAM do not hold the fake board
#include "../check.h"
#include "fake_board.h"

#include "core/settings.h"

using namespace ohmskin;
using State = SettingsWriter::State;
using Source = frames::Settings;

namespace {

// Nearly every byte differs.
const Settings ONE = {0x11121314, {6, 7, 0, 0x05, 0x48, 0x00015F90, 0x0041, 0, 2, 0x0102}};
const Settings TWO = {0x21222324, {7, 8, 1, 0x62, 0x81, 0x00001203, 0x0142, 1, 3, 0x0304}};
const Settings THREE = {0x31323334, {8, 6, 2, 0x93, 0x24, 0x00001504, 0x0203, 2, 1, 0x0506}};

// Made with Python's struct and a textbook CRC: version, sequence, settings, CRC.
const uint8_t RECORD[] = {0x03, 0xC8, 0x34, 0x12, 0xCD, 0xAB, 0x05, 0x07, 0x60, 0xEA,
                          0x00, 0x00, 0x14, 0x00, 0x01, 0x03, 0x12, 0x00, 0x00, 0x00,
                          0x60, 0x00, 0x00, 0x00, 0x02, 0x07, 0x09, 0xA6, 0xA2};
const uint8_t OF_LATER_VERSION[] = {0x04, 0x09, 0x34, 0x12, 0xCD, 0xAB, 0x05, 0x07, 0x60, 0xEA,
                                    0x00, 0x00, 0x14, 0x00, 0x01, 0x03, 0x12, 0x00, 0x00, 0x00,
                                    0x60, 0x00, 0x00, 0x00, 0x02, 0x07, 0x09, 0x0F, 0xE3};
// Of the version before there were regions.
const uint8_t WITHOUT_REGION[] = {0x02, 0xC8, 0x34, 0x12, 0xCD, 0xAB, 0x05, 0x07, 0x60,
                                  0xEA, 0x00, 0x00, 0x14, 0x00, 0x40, 0x01, 0xEB, 0x0B};
// Of the version before there were modes, one after the other.
const uint8_t WITHOUT_MODE[] = {0x01, 0xC8, 0x34, 0x12, 0xCD, 0xAB, 0x05, 0x07, 0x60,
                                0xEA, 0x00, 0x00, 0x14, 0x00, 0x40, 0x8F, 0x61};
const uint8_t EARLIER_WITHOUT_MODE[] = {0x01, 0xC7, 0x74, 0x73, 0x72, 0x71, 0x06, 0x05, 0x50,
                                        0xC3, 0x00, 0x00, 0x1E, 0x00, 0x80, 0x08, 0xE3};
// With some protocol's layout CRC at its start, and at address 0.
const uint8_t OLD_RECORD[] = {0xBE, 0xEF, 0x34, 0x12, 0xCD, 0xAB, 0x05, 0x07, 0x60,
                              0xEA, 0x00, 0x00, 0x14, 0x00, 0x40, 0x18, 0x54};
const Settings RECORDED = {0xABCD1234, {5, 7, 1, 0x12, 0x60, 60000, 20, 3, 2, 0x0907}};
const Settings RECORDED_FAR = {0xABCD1234, {5, 7, 1, 0x1F, 0x7F, 60000, 20, 1, 0, 0}};
const Settings RECORDED_NEAR = {0xABCD1234, {5, 7, 1, 0x1F, 0x7F, 60000, 20, 0, 0, 0}};
// 16x16 at 90 Hz, which does not fit.
const uint8_t IMPOSSIBLE[] = {0x01, 0x03, 0x4D, 0x00, 0x00, 0x00, 0x10, 0x10, 0x90,
                              0x5F, 0x01, 0x00, 0x00, 0x00, 0x20, 0xB4, 0xB5};

template <size_t SIZE> void put(uint8_t at, const uint8_t (&record)[SIZE]) {
    memcpy(fake::state.eeprom + at, record, SIZE);
}

Settings defaults() {
    Settings settings;
    take_defaults(&settings);
    return settings;
}

bool same(const Settings &a, const Settings &b) {
    return a.unit_id == b.unit_id && memcmp(&a.request, &b.request, sizeof a.request) == 0;
}

OHMSKIN_APART Settings loaded(Source *source = nullptr) {
    Settings settings;
    Routes routes;
    const Source from = load_settings(&settings, 320, &routes);
    if (source)
        *source = from;
    return settings;
}

OHMSKIN_APART State save(const Settings &settings) {
    SettingsWriter writer;
    writer.begin(settings);
    for (uint16_t polls = 0; polls < 500; polls++) {
        const State state = writer.poll();
        if (state == State::Done || state == State::Failed)
            return state;
    }
    return State::Writing;
}

// A save in which the power fails at write number `cut_at`; true where it was done before that.
bool save_cut(const Settings &settings, uint8_t cut_at) {
    fake::state.eeprom_cut_at = cut_at;
    const bool done = save(settings) == State::Done;
    fake::state.eeprom_cut_at = 0;
    fake::state.eeprom_worn_out = false;
    fake::state.eeprom_busy_polls = 0;
    return done;
}

// What the byte may hold that was being written: EEPROM bits are erased to 1 and then written to 0.
uint8_t erased(uint8_t, uint8_t) { return 0xFF; }
uint8_t not_begun(uint8_t before, uint8_t) { return before; }
uint8_t half_erased(uint8_t before, uint8_t) { return before | 0x5A; }
uint8_t half_written(uint8_t, uint8_t wanted) { return wanted | 0x96; }
uint8_t written(uint8_t, uint8_t wanted) { return wanted; }

// What was saved before: nothing, by older firmware, in each of the two places, and by firmware
// without modes in one place and in both.
void start_from(uint8_t start) {
    fake::reset();
    if (start == 1)
        put(0, OLD_RECORD);
    if (start > 4)
        put(64, WITHOUT_MODE);
    if (start > 5)
        put(32, EARLIER_WITHOUT_MODE);
    for (uint8_t saves = 1; saves < start && start < 5; saves++)
        CHECK_EQ(State::Done, save(saves & 1 ? ONE : TWO));
}

}  // namespace

// Of the second saves, so many are left out each time where the processor is a slow one.
#ifdef __AVR__
constexpr uint8_t AGAIN_STEP = 13;
#else
constexpr uint8_t AGAIN_STEP = 1;
#endif

TEST(a_save_cut_at_any_byte_leaves_the_old_settings_or_the_new) {
    uint8_t (*const torn[])(uint8_t, uint8_t) = {half_written, erased, not_begun, half_erased,
                                                 written};
#ifdef __AVR__
    constexpr uint8_t KINDS = 1;  // a slow processor; all of them are tried natively
#else
    constexpr uint8_t KINDS = sizeof torn / sizeof *torn;
#endif
    for (uint8_t start = 0; start < 7; start++)
        for (uint8_t kind = 0; kind < KINDS; kind++) {
            uint8_t cuts = 0;
            for (;; cuts++) {
                start_from(start);
                fake::state.eeprom_torn = torn[kind];
                const Settings old = loaded();
                const bool done = save_cut(THREE, cuts + 1);
                Source source;
                const Settings after = loaded(&source);
                CHECK(same(after, old) || same(after, THREE));
                CHECK(source == Source::Stored || (start == 0 && same(after, defaults())));
                if (done) {
                    CHECK(same(after, THREE));
                    break;
                }
                // The next save may be cut too, over what the first one left.
                static uint8_t left[sizeof fake::state.eeprom];
                memcpy(left, fake::state.eeprom, sizeof left);
                const Settings &next = start & 1 ? ONE : TWO;
                for (uint8_t again = 1; again < 30;
                     again = static_cast<uint8_t>(again + AGAIN_STEP)) {
                    memcpy(fake::state.eeprom, left, sizeof left);
                    const bool next_done = save_cut(next, again);
                    const Settings last = loaded();
                    CHECK(same(last, after) || same(last, next));
                    CHECK(!next_done || same(last, next));
                }
            }
            CHECK(cuts >= 13);  // nearly every byte changes
        }
}

TEST(a_record_is_read_whatever_the_protocol_has_become) {
    fake::reset();
    put(64, RECORD);
    Source source;
    CHECK(same(RECORDED, loaded(&source)));
    CHECK_EQ(Source::Stored, source);
}

TEST(a_record_without_region_is_of_the_whole_skin) {
    const uint8_t places[] = {32, 64};
    for (uint8_t at : places) {
        fake::reset();
        put(at, WITHOUT_REGION);
        Source source;
        CHECK(same(RECORDED_FAR, loaded(&source)));
        CHECK_EQ(Source::Stored, source);
        CHECK_EQ(State::Done, save(RECORDED));
        CHECK(same(RECORDED, loaded()));
        CHECK_BYTES(WITHOUT_REGION, fake::state.eeprom + at, sizeof WITHOUT_REGION);
    }
}

TEST(a_record_without_mode_is_of_mode_near_until_another_is_saved) {
    const uint8_t places[] = {32, 64};
    for (uint8_t at : places) {
        fake::reset();
        put(at, WITHOUT_MODE);
        fake::state.eeprom[at + sizeof WITHOUT_MODE] = 0x01;  // behind it, where a mode ends
        Source source;
        CHECK(same(RECORDED_NEAR, loaded(&source)));
        CHECK_EQ(Source::Stored, source);
        CHECK_EQ(State::Done, save(RECORDED));
        CHECK(same(RECORDED, loaded()));
        CHECK_BYTES(WITHOUT_MODE, fake::state.eeprom + at, sizeof WITHOUT_MODE);
        CHECK_EQ(State::Done, save(RECORDED_NEAR));
        CHECK(same(RECORDED_NEAR, loaded()));
    }
}

TEST(the_one_record_of_older_firmware_is_read_until_another_is_saved) {
    fake::reset();
    put(0, OLD_RECORD);
    Source source;
    CHECK(same(RECORDED_NEAR, loaded(&source)));
    CHECK_EQ(Source::Stored, source);
    CHECK_EQ(State::Done, save(ONE));
    CHECK(same(ONE, loaded()));
    CHECK_BYTES(OLD_RECORD, fake::state.eeprom, sizeof OLD_RECORD);
}

TEST(a_record_of_another_version_is_ignored_and_kept) {
    const uint8_t places[] = {32, 64};
    for (uint8_t at : places) {
        fake::reset();
        put(at, OF_LATER_VERSION);
        Source source;
        CHECK(same(defaults(), loaded(&source)));
        CHECK_EQ(Source::DefaultsDamaged, source);
        CHECK_EQ(State::Done, save(ONE));
        CHECK_BYTES(OF_LATER_VERSION, fake::state.eeprom + at, sizeof OF_LATER_VERSION);
        CHECK(same(ONE, loaded()));
        // The second save needs the place: the settings of now come first.
        CHECK_EQ(State::Done, save(TWO));
        CHECK(same(TWO, loaded()));
    }
}

TEST(the_unit_id_outlives_a_scan_that_this_firmware_cannot_make) {
    fake::reset();
    put(32, IMPOSSIBLE);
    Source source;
    const Settings settings = loaded(&source);
    Settings expected = defaults();
    expected.unit_id = 77;
    CHECK(same(expected, settings));
    CHECK_EQ(Source::DefaultsDamaged, source);
}

TEST(the_newest_of_many_saves_is_loaded_and_no_byte_wears_with_each) {
    fake::reset();
    const uint16_t saves = 600;  // the sequence wraps twice
    for (uint16_t i = 0; i < saves; i++) {
        Settings settings = ONE;
        settings.unit_id = i;
        CHECK_EQ(State::Done, save(settings));
        CHECK(same(settings, loaded()));
        CHECK_EQ(State::Done, save(settings));  // writes nothing
    }
    uint16_t most = 0, bytes = 0;
    for (uint16_t wear : fake::state.eeprom_wear) {
        most = wear > most ? wear : most;
        bytes += wear != 0;
    }
    CHECK_EQ(saves / 2, most);
    CHECK_EQ(2 * sizeof(SettingsRecord), bytes);
}

#endif
