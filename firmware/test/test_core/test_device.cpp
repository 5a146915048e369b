// SPDX-License-Identifier: Apache-2.0
// The device on a fake board: every command's answer, settings, self-test, and whole scans.
#ifndef __AVR_ATmega328P__  // 2 KiB of RAM do not hold the device, its board and its host
#include "../check.h"
#include "fake_board.h"
#include "requests.h"

#include "core/device.h"
#include "core/frame_writer.h"

using namespace ohmskin;
using frames::Result;
using frames::Type;

namespace {

struct Frame {
    uint8_t type, sequence;
    uint8_t payload[200];
    uint16_t size;
};

// Decodes what the board has sent since the last call, without the code under test.
class Host {
  public:
    explicit Host(Device &device) : device_(device) {}

    // Sends a command and lets the device work.
    OHMSKIN_APART void send(Type type, const void *payload = nullptr, uint8_t size = 0) {
        FrameWriter writer;
        for (uint8_t i = 0; i < sequence_; i++) {  // the writer counts from 0
            writer.begin(type);
            writer.end();
            while (writer.has_byte())
                writer.next_byte();
        }
        writer.begin(type);
        if (size)
            writer.put(payload, size);
        writer.end();
        uint8_t wire[40], n = 0;
        while (writer.has_byte())
            wire[n++] = writer.next_byte();
        fake::receive(wire, n);
        work();
    }

    OHMSKIN_APART void work(uint16_t passes = 400) {
        while (passes--)
            device_.poll();
    }

    // The next frame sent; false when there is none.
    OHMSKIN_APART bool next(Frame *frame) {
        uint8_t decoded[200];
        uint16_t n = 0;
        while (at_ < fake::state.sent_size && fake::state.sent[at_] == 0)
            at_++;
        if (!memchr(fake::state.sent + at_, 0, fake::state.sent_size - at_))
            return false;
        while (at_ < fake::state.sent_size) {
            const uint8_t code = fake::state.sent[at_++];
            if (code == 0)
                break;
            for (uint8_t i = 1; i < code; i++)
                decoded[n++] = fake::state.sent[at_++];
            if (code != 255)
                decoded[n++] = 0;
        }
        if (n < 5)
            return false;
        n--;  // the zero that no block stood for
        frame->type = decoded[0];
        frame->sequence = decoded[1];
        frame->size = static_cast<uint16_t>(n - 4);
        memcpy(frame->payload, decoded + 2, frame->size);
        return true;
    }

    Result answer_to(Type type, const void *payload = nullptr, uint8_t size = 0) {
        send(type, payload, size);
        return answer(type);
    }

    OHMSKIN_APART Result answer(Type type) {
        Frame frame;
        while (next(&frame))
            if (frame.type == static_cast<uint8_t>(Type::Ack)) {
                CHECK_EQ(static_cast<uint8_t>(type), frame.payload[0]);
                memcpy(&last_ack, frame.payload, sizeof last_ack);
                return static_cast<Result>(frame.payload[2]);
            }
        return static_cast<Result>(0xEE);
    }
    frames::Ack last_ack;  // of answer()

    OHMSKIN_APART frames::Hello hello() {
        send(Type::GetHello);
        Frame frame;
        frames::Hello hello;
        memset(&hello, 0, sizeof hello);
        while (next(&frame))
            if (frame.type == static_cast<uint8_t>(Type::Hello))
                memcpy(&hello, frame.payload, sizeof hello);
        rewind();
        return hello;
    }

    // Room for more: what was sent has been read.
    void rewind() { fake::state.sent_size = at_ = 0; }

  private:
    Device &device_;
    uint8_t sequence_ = 0;
    uint16_t at_ = 0;
};

struct Bench {
    Bench() : host(device) {
        fake::reset();
        boot();
    }
    OHMSKIN_APART void boot() {
        memset(static_cast<void *>(&device), 0, sizeof device);  // as at power-on
        device.begin();
        host.work();
        host.rewind();
    }
    // Runs slots like the hardware: a pass of the main loop or more after each.
    OHMSKIN_APART void slots(uint16_t count, uint16_t (*code_of)(const Selection &),
                             uint8_t converted = 1) {
        while (count--) {
            const uint16_t code = result;
            result = code_of(pins);
            pins = board::scanner.selection();
            board::scanner.step(code, converted);
            host.work(2);
        }
        host.work();
    }
    Device device;
    Host host;
    Selection pins = {0, 0, 0};
    uint16_t result = 0;
};

// A Uno has no room for two of them, so all tests share one.
OHMSKIN_APART Bench &fresh() {
    static Bench bench;
    fake::reset();
    bench.pins = Selection{0, 0, 0};
    bench.boot();
    return bench;
}

uint16_t ramp(const Selection &s) {
    return static_cast<uint16_t>(s.row * 40 + s.column * 4 + s.pattern_entry);
}

bool same(const frames::Hello &a, const frames::Hello &b) { return memcmp(&a, &b, sizeof a) == 0; }

}  // namespace

TEST(boot_sends_hello_with_defaults_from_a_blank_eeprom) {
    fresh();
    static Device device;
    fake::reset();
    memset(static_cast<void *>(&device), 0, sizeof device);
    device.begin();
    Host host(device);
    host.work();
    Frame frame;
    if (!CHECK(host.next(&frame)))
        return;
    CHECK_EQ(Type::Hello, static_cast<Type>(frame.type));
    frames::Hello hello;
    memcpy(&hello, frame.payload, sizeof hello);
    CHECK_EQ(sizeof hello, frame.size);
    CHECK_EQ(frames::LAYOUT_CRC, hello.layout_crc);
    CHECK_EQ(frames::Settings::DefaultsBlank, static_cast<frames::Settings>(hello.settings));
    CHECK_EQ(8, hello.rows);
    CHECK_EQ(90000, hello.rate_asked_mhz);
    CHECK_EQ(689, hello.slot_cycles);
    CHECK_EQ(258 * 689UL, hello.scan_cycles);
    CHECK_EQ(0xFF, hello.row_mask);
    CHECK_EQ(0x1234, hello.wiring);
    CHECK_BYTES(board::NAME, hello.board, sizeof board::NAME);
    CHECK_EQ(16, hello.rows_max);
    CHECK_EQ(4700, hello.ref_bottom_ohm);
    CHECK(!host.next(&frame));
}

TEST(mode_far_reads_both_ends_under_one_drive) {
    const char *const orders[] = {"abcd", "aebf"};
    for (uint8_t mode = 0; mode < 2; mode++)
        for (uint8_t n = 0; n < 4; n++) {
            const char name = orders[mode][n];
            const uint8_t reading = static_cast<uint8_t>(reading_of(mode, n));
            CHECK_EQ(name - 'a', reading);
            const ReadingDefinition definition = READING_DEFINITIONS[reading];
            CHECK_EQ(strchr("cd", name) ? Drive::Bottom : Drive::Top, definition.drive);
            const Sense near = strchr("ad", name) ? Sense::Top : Sense::Bottom;
            CHECK_EQ(name == 'e'   ? Sense::FarTop
                     : name == 'f' ? Sense::FarBottom
                                   : near,
                     definition.sense);
        }
}

TEST(mode_far_leaves_35_us_at_rate_zero) {
    for (uint8_t accuracy = 0; accuracy < 3; accuracy++) {
        const ScanPlan plan = plan_of(scan_request(8, 8, 0, 0, accuracy, 1));
        CHECK_EQ((32 << accuracy) * 23 / 2 + 560, plan.slot_cycles);
        ScanPlan none;
        CHECK_EQ(Result::BadMode, plan_of(scan_request(8, 8, 0, 0, accuracy, 4), &none));
    }
}

TEST(configure_changes_all_or_nothing) {
    Host &host = fresh().host;
    const frames::Configure good = scan_request(4, 6, 120000, 0, 1);
    CHECK_EQ(Result::Ok, host.answer_to(Type::Configure, &good, sizeof good));
    const frames::Hello before = host.hello();
    CHECK_EQ(4, before.rows);
    CHECK_EQ(6, before.columns);
    CHECK_EQ(1, before.accuracy);
    const struct {
        frames::Configure request;
        Result result;
    } bad[] = {
        {scan_request(0, 6, 120000, 0, 1), Result::BadRows},
        {scan_request(17, 6, 120000, 0, 1), Result::BadRows},
        {scan_request(4, 0, 120000, 0, 1), Result::BadColumns},
        {scan_request(4, 17, 120000, 0, 1), Result::BadColumns},
        {scan_request(4, 6, 999, 0, 1), Result::BadRate},
        {scan_request(4, 6, 50000001, 0, 1), Result::BadRate},
        {scan_request(4, 6, 120000, 3001, 1), Result::BadSettle},
        {scan_request(4, 6, 120000, 0, 3), Result::BadAccuracy},
        {scan_request(16, 16, 90000), Result::TooFast},
    };
    for (const auto &b : bad) {
        CHECK_EQ(b.result, host.answer_to(Type::Configure, &b.request, sizeof b.request));
        host.rewind();
        CHECK(same(before, host.hello()));
    }
    CHECK_EQ(Result::BadLength, host.answer_to(Type::Configure, &good, sizeof good - 1));
    host.rewind();
    CHECK_EQ(Result::BadLength, host.answer_to(Type::Start, &good, 1));
    host.rewind();
    CHECK_EQ(Result::UnknownCommand, host.answer_to(static_cast<Type>(0xA0)));
    host.rewind();
    CHECK(same(before, host.hello()));
}

TEST(an_answer_says_the_rate_of_its_own_request_or_none) {
    Bench &bench = fresh();
    Host &host = bench.host;
    const frames::Configure slow = scan_request(4, 4, 20000),
                            too_fast = scan_request(16, 16, 90000);
    CHECK_EQ(Result::Ok, host.answer_to(Type::Configure, &slow, sizeof slow));
    CHECK(host.last_ack.rate_mhz > 19990 && host.last_ack.rate_mhz < 20010);
    CHECK_EQ(Result::BadLength, host.answer_to(Type::Configure, &slow, sizeof slow - 1));
    CHECK_EQ(0, host.last_ack.rate_mhz);
    CHECK_EQ(Result::TooFast, host.answer_to(Type::Configure, &too_fast, sizeof too_fast));
    CHECK(host.last_ack.rate_mhz > 20000 && host.last_ack.rate_mhz < 90000);
    CHECK_EQ(Result::Ok, host.answer_to(Type::Start));
    CHECK_EQ(0, host.last_ack.rate_mhz);
    CHECK_EQ(Result::Scanning, host.answer_to(Type::Configure, &too_fast, sizeof too_fast));
    CHECK_EQ(0, host.last_ack.rate_mhz);
}

TEST(a_scan_frame_holds_every_code_in_order) {
    Bench &bench = fresh();
    const frames::Configure size = scan_request(3, 1, 90000);  // 12 codes: 15 bytes
    CHECK_EQ(Result::Ok, bench.host.answer_to(Type::Configure, &size, sizeof size));
    fake::state.now_us = 5000;
    CHECK_EQ(Result::Ok, bench.host.answer_to(Type::Start));
    CHECK(fake::state.slots_running);
    bench.host.rewind();
    bench.slots(2 + 2 * 12 + plan_of(size).idle_slots + 1, ramp);
    const ScanPlan plan = plan_of(size);
    for (uint8_t scan = 0; scan < 2; scan++) {
        Frame frame;
        if (!CHECK(bench.host.next(&frame)))
            return;
        CHECK_EQ(Type::Scan, static_cast<Type>(frame.type));
        frames::Scan header;
        memcpy(&header, frame.payload, sizeof header);
        CHECK_EQ(sizeof header + 15, frame.size);
        CHECK_EQ(scan, header.scan);
        CHECK_EQ(5000 + (2 * plan.slot_cycles + scan * plan.scan_cycles()) / 16, header.time_us);
        CHECK_EQ(0, header.dropped);
        CHECK_EQ(3, header.rows);
        for (uint8_t i = 0; i < 12; i++) {
            const uint8_t *octets = frame.payload + sizeof header + i * 10 / 8;
            const uint16_t code = ((octets[0] | octets[1] << 8) >> i * 10 % 8) & 0x3FF;
            // A and B of three cells, then C and D.
            CHECK_EQ(i % 6 / 2 * 40 + i / 6 * 2 + i % 2, code);
        }
    }
}

TEST(stop_is_answered_after_the_last_whole_scan) {
    Bench &bench = fresh();
    const frames::Configure size = scan_request(1, 2, 90000);
    bench.host.answer_to(Type::Configure, &size, sizeof size);
    bench.host.answer_to(Type::Start);
    bench.host.rewind();
    bench.slots(8, ramp);
    bench.host.send(Type::Stop);
    bench.host.send(Type::Start);
    bench.slots(12, ramp);
    Frame frame;
    const Type order[] = {Type::Scan, Type::Ack, Type::Ack};
    for (Type type : order) {
        if (!CHECK(bench.host.next(&frame)))
            return;
        CHECK_EQ(type, static_cast<Type>(frame.type));
    }
    CHECK(!bench.host.next(&frame));
    CHECK(!fake::state.slots_running);
}

TEST(time_stamps_of_small_skins_are_exact_at_any_rate) {
    // The slots of small slow skins are long: two of them take more cycles than 16 bits count.
    const uint8_t sizes[][2] = {{1, 1}, {1, 2}, {2, 2}};
    Bench &bench = fresh();
    for (const auto &size : sizes)
        for (uint32_t rate = 1000; rate <= 700000; rate = rate * 3 / 2 + 7) {
            const frames::Configure request = scan_request(size[0], size[1], rate);
            bench.host.rewind();
            CHECK_EQ(Result::Ok, bench.host.answer_to(Type::Configure, &request, sizeof request));
            const uint32_t started_us = fake::state.now_us = rate * 977;  // wraps now and then
            bench.host.answer_to(Type::Start);
            const ScanPlan plan = plan_of(request);
            const uint16_t readings = static_cast<uint16_t>(4 * size[0] * size[1]);
            bench.slots(static_cast<uint16_t>(2 + readings + plan.slots()), ramp);
            bench.host.send(Type::Stop);
            bench.slots(static_cast<uint16_t>(2 * plan.slots() + 4), ramp);
            // The first reading is held in the third slot, and the next scan a period later.
            uint64_t cycles = 2ull * plan.slot_cycles;
            uint8_t scans = 0;
            Frame frame;
            while (bench.host.next(&frame)) {
                if (frame.type != static_cast<uint8_t>(Type::Scan))
                    continue;
                frames::Scan header;
                memcpy(&header, frame.payload, sizeof header);
                CHECK_EQ(static_cast<uint32_t>(started_us + cycles / 16), header.time_us);
                cycles += plan.scan_cycles();
                scans++;
            }
            CHECK(scans >= 2);
        }
}

TEST(commands_that_would_tear_a_scan_are_refused) {
    Bench &bench = fresh();
    const frames::Configure size = scan_request(1, 1, 90000);
    bench.host.answer_to(Type::Configure, &size, sizeof size);
    bench.host.answer_to(Type::Start);
    const frames::SetBaud baud = {frames::BAUD_FAST};
    CHECK_EQ(Result::Scanning, bench.host.answer_to(Type::Configure, &size, sizeof size));
    CHECK_EQ(Result::Scanning, bench.host.answer_to(Type::LoadDefaults));
    CHECK_EQ(Result::Scanning, bench.host.answer_to(Type::SelfTest));
    CHECK_EQ(Result::Scanning, bench.host.answer_to(Type::SetBaud, &baud, sizeof baud));
    CHECK_EQ(Result::Ok, bench.host.answer_to(Type::Start));
}

TEST(a_line_that_takes_nothing_drops_whole_scans_and_counts_them) {
    Bench &bench = fresh();
    const frames::Configure size = scan_request(4, 4, 90000);
    bench.host.answer_to(Type::Configure, &size, sizeof size);
    bench.host.answer_to(Type::Start);
    bench.host.rewind();
    fake::state.line_stuck = true;
    const uint16_t slots = 64 + plan_of(size).idle_slots;
    bench.slots(20 * slots, ramp);
    fake::state.line_stuck = false;
    bench.slots(3 * slots, ramp);
    Frame frame;
    uint32_t last = 0;
    uint16_t dropped = 0, scans = 0, torn = 0;
    while (bench.host.next(&frame)) {
        frames::Scan header;
        memcpy(&header, frame.payload, sizeof header);
        // The one that had begun to fit when the line stopped is cut off: a host sees a wrong CRC.
        if (frame.size < sizeof header + 80 && !torn++)
            continue;
        CHECK_EQ(sizeof header + 80, frame.size);
        if (scans++)
            CHECK_EQ(header.dropped - dropped, header.scan - last - 1);
        last = header.scan;
        dropped = header.dropped;
    }
    CHECK(dropped > 10);
    CHECK(scans >= 4);
}

TEST(settings_survive_a_restart_and_damage_is_named) {
    Bench &bench = fresh();
    const frames::Configure size = scan_request(5, 7, 60000);
    const frames::SetUnitId id = {0xABCD1234};
    bench.host.answer_to(Type::Configure, &size, sizeof size);
    bench.host.answer_to(Type::SetUnitId, &id, sizeof id);
    CHECK_EQ(Result::Ok, bench.host.answer_to(Type::Save));
    bench.host.rewind();
    bench.boot();
    frames::Hello hello = bench.host.hello();
    CHECK_EQ(frames::Settings::Stored, static_cast<frames::Settings>(hello.settings));
    CHECK_EQ(0xABCD1234, hello.unit_id);
    CHECK_EQ(7, hello.columns);
    for (uint8_t i = 32; i < 32 + sizeof(SettingsRecord); i++) {
        fake::state.eeprom[i] ^= 0x10;
        bench.boot();
        hello = bench.host.hello();
        CHECK_EQ(frames::Settings::DefaultsDamaged, static_cast<frames::Settings>(hello.settings));
        CHECK_EQ(0, hello.unit_id);
        CHECK_EQ(8, hello.rows);
        fake::state.eeprom[i] ^= 0x10;
    }
}

TEST(what_was_saved_at_the_faster_line_survives_a_restart) {
    Bench &bench = fresh();
    const frames::SetBaud fast = {frames::BAUD_FAST};
    const frames::Configure quick = scan_request(2, 2, 1200000);
    CHECK_EQ(Result::LineTooSlow, bench.host.answer_to(Type::Configure, &quick, sizeof quick));
    bench.host.answer_to(Type::SetBaud, &fast, sizeof fast);
    CHECK_EQ(Result::Ok, bench.host.answer_to(Type::Configure, &quick, sizeof quick));
    CHECK_EQ(Result::Ok, bench.host.answer_to(Type::Save));
    bench.host.rewind();
    const frames::Hello before = bench.host.hello();
    bench.boot();
    frames::Hello after = bench.host.hello();
    CHECK_EQ(frames::Settings::Stored, static_cast<frames::Settings>(after.settings));
    CHECK_EQ(2, after.rows);
    CHECK_EQ(1200000, after.rate_asked_mhz);
    CHECK_EQ(before.scan_cycles, after.scan_cycles);
    CHECK_EQ(Result::LineTooSlow, bench.host.answer_to(Type::Start));
    bench.host.answer_to(Type::SetBaud, &fast, sizeof fast);
    CHECK_EQ(Result::Ok, bench.host.answer_to(Type::Start));
}

TEST(load_defaults_keeps_the_eeprom) {
    Bench &bench = fresh();
    const frames::Configure size = scan_request(5, 7, 60000);
    bench.host.answer_to(Type::Configure, &size, sizeof size);
    bench.host.answer_to(Type::Save);
    CHECK_EQ(Result::Ok, bench.host.answer_to(Type::LoadDefaults));
    bench.host.rewind();
    CHECK_EQ(8, bench.host.hello().rows);
    bench.boot();
    CHECK_EQ(5, bench.host.hello().rows);
}

TEST(a_worn_out_eeprom_is_reported) {
    Bench &bench = fresh();
    fake::state.eeprom_worn_out = true;
    CHECK_EQ(Result::EepromFailed, bench.host.answer_to(Type::Save));
}

TEST(an_unconfirmed_speed_falls_back) {
    Bench &bench = fresh();
    const frames::SetBaud wrong = {115200}, fast = {frames::BAUD_FAST};
    CHECK_EQ(Result::BadBaud, bench.host.answer_to(Type::SetBaud, &wrong, sizeof wrong));
    CHECK_EQ(0, fake::state.baud);
    CHECK_EQ(Result::Ok, bench.host.answer_to(Type::SetBaud, &fast, sizeof fast));
    CHECK_EQ(frames::BAUD_FAST, fake::state.baud);
    fake::state.now_us += frames::BAUD_CONFIRM_MS * 1000UL + 1;
    bench.host.work();
    CHECK_EQ(frames::BAUD_DEFAULT, fake::state.baud);
    CHECK_EQ(Result::Ok, bench.host.answer_to(Type::SetBaud, &fast, sizeof fast));
    bench.host.answer_to(Type::GetHello);
    fake::state.now_us += frames::BAUD_CONFIRM_MS * 5000UL;
    bench.host.work();
    CHECK_EQ(frames::BAUD_FAST, fake::state.baud);
}

TEST(no_scan_starts_while_the_line_waits_for_its_new_speed) {
    Bench &bench = fresh();
    const frames::Configure size = scan_request(2, 2, 90000);
    const frames::SetBaud fast = {frames::BAUD_FAST};
    fake::state.line_stuck = true;  // the answer to set_baud cannot leave yet
    bench.host.send(Type::SetBaud, &fast, sizeof fast);
    bench.host.send(Type::Configure, &size, sizeof size);
    bench.host.send(Type::Start);
    CHECK_EQ(0, fake::state.baud);
    fake::state.line_stuck = false;
    bench.host.work();
    CHECK_EQ(frames::BAUD_FAST, fake::state.baud);
    CHECK_EQ(Result::Ok, bench.host.answer(Type::SetBaud));
    CHECK_EQ(Result::Busy, bench.host.answer(Type::Configure));
    CHECK_EQ(Result::Busy, bench.host.answer(Type::Start));
    CHECK(!fake::state.slots_running);
    CHECK_EQ(Result::Ok, bench.host.answer_to(Type::Start));
}

TEST(hello_says_the_rate_that_the_line_of_now_carries) {
    Bench &bench = fresh();
    const frames::Configure fastest = scan_request(2, 2, 0, 1);  // as fast as the line carries it
    CHECK_EQ(Result::Ok, bench.host.answer_to(Type::Configure, &fastest, sizeof fastest));
    bench.host.rewind();
    const uint32_t slow = bench.host.hello().scan_cycles;
    const frames::SetBaud fast = {frames::BAUD_FAST};
    bench.host.answer_to(Type::SetBaud, &fast, sizeof fast);
    bench.host.rewind();
    const uint32_t quick = bench.host.hello().scan_cycles;
    CHECK(quick < slow);
    bench.host.answer_to(Type::Start);
    bench.slots(200, ramp);
    bench.host.rewind();
    CHECK_EQ(quick, bench.host.hello().scan_cycles);
    bench.host.send(Type::Stop);
    bench.slots(200, ramp);
    bench.host.rewind();
    CHECK_EQ(Result::Ok, bench.host.answer_to(Type::SetBaud, &fast, sizeof fast));
    fake::state.now_us += frames::BAUD_CONFIRM_MS * 1000UL + 1;
    bench.host.work();
    bench.host.rewind();
    const frames::Hello after = bench.host.hello();
    CHECK_EQ(frames::BAUD_DEFAULT, after.baud);
    CHECK_EQ(slow, after.scan_cycles);
}

namespace {
// The codes of A to D, which in mode near are pattern entries 0 to 3.
const uint16_t *nodes;
uint16_t of_nodes(const Selection &s) { return nodes[s.pattern_entry]; }

OHMSKIN_APART bool self_test_of(Bench &bench, frames::SelfTestReport *report) {
    Frame frame;
    if (!CHECK(!fake::state.slots_running) || !CHECK(bench.host.next(&frame)))
        return false;
    CHECK_EQ(Type::SelfTestReport, static_cast<Type>(frame.type));
    memcpy(report, frame.payload, sizeof *report);
    CHECK_EQ(Result::Ok, bench.host.answer(Type::SelfTest));
    return true;
}
}  // namespace

TEST(self_test_names_what_no_skin_can_cause) {
    using frames::Finding;
    // By the resistors of fake_board.cpp, 2.2 kOhm at the top and 4.7 kOhm at the bottom. Where all
    // cells are a short, A and B read 697, C and D 326.
    const struct {
        uint16_t codes[4];
        Finding finding;
    } cases[] = {
        {{1020, 4, 1018, 2}, {}},    // 1 MOhm
        {{744, 597, 426, 279}, {}},  // 1 kOhm and two multiplexers
        {{697, 697, 326, 326}, {}},  // a short
        {{650, 744, 279, 373}, {}},  // the same, with resistors that are off by a quarter
        {{993, 0, 0, 29}, Finding::BottomStuckLow},
        {{1023, 1023, 1023, 2}, Finding::BottomStuckHigh},
        {{0, 0, 1018, 0}, Finding::TopStuckLow},
        {{1023, 30, 1023, 1023}, Finding::TopStuckHigh},
        {{0, 0, 1020, 1020}, Finding::TopReferenceMissing},
        {{1020, 1020, 0, 0}, Finding::BottomReferenceMissing},
    };
    for (const auto &c : cases) {
        Bench &bench = fresh();
        nodes = c.codes;
        bench.host.send(Type::SelfTest);
        CHECK(fake::state.slots_running);
        bench.slots(1 + 1024 + 4, of_nodes);
        frames::SelfTestReport report;
        if (!self_test_of(bench, &report))
            return;
        CHECK_EQ(static_cast<uint16_t>(c.finding), report.findings);
        CHECK_EQ(c.codes[2], report.code_max[2]);
    }
}

// As where the board is too slow: then C and D are not read.
TEST(self_test_judges_no_reading_that_it_has_not_taken) {
    Bench &bench = fresh();
    const uint16_t codes[] = {1020, 4, 1018, 2};
    nodes = codes;
    bench.host.send(Type::SelfTest);
    bench.slots(40, of_nodes);
    bench.slots(1024, of_nodes, 0);
    frames::SelfTestReport report;
    if (!self_test_of(bench, &report))
        return;
    CHECK_EQ(0, report.findings);
    CHECK_EQ(1020, report.code_max[0]);
    CHECK(report.code_min[2] > report.code_max[2]);
}

TEST(a_self_test_ends_though_no_conversion_ends_in_time) {
    Bench &bench = fresh();
    const frames::Configure far = scan_request(8, 8, 0, 0, 0, 1);
    CHECK_EQ(Result::Ok, bench.host.answer_to(Type::Configure, &far, sizeof far));
    bench.host.rewind();
    bench.host.send(Type::SelfTest);
    bench.slots(3 * 2 * 1024 + 20, ramp, 0);  // two scans of each pattern
    frames::SelfTestReport report;
    if (!self_test_of(bench, &report))
        return;
    CHECK_EQ(0, report.findings);
    for (uint8_t i = 0; i < frames::READINGS; i++)
        CHECK(report.code_min[i] > report.code_max[i]);
    CHECK_EQ(Result::Ok, bench.host.answer_to(Type::Start));
}

TEST(scans_that_never_fit_the_line_are_refused) {
    Bench &bench = fresh();
    // 16x16 in a burst of 27 ms needs 50 kB/s and more ring than there is at half that speed; at
    // 500 kbaud it just fits, and so does everything smaller.
    const frames::Configure largest = scan_request(16, 16, 0);
    CHECK_EQ(Result::Ok, bench.host.answer_to(Type::Configure, &largest, sizeof largest));
    CHECK_EQ(Result::Ok, bench.host.answer_to(Type::Start));
}

#endif
