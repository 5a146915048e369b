// SPDX-License-Identifier: Apache-2.0
#include "core/device.h"

#include <string.h>

#include "board.h"
#include "version.h"

namespace ohmskin {

using frames::Result;
using frames::Type;

namespace {

constexpr uint8_t BITS_PER_BYTE_8N1 = 10;
// What Hello, a report and the acks may take between two scans.
constexpr uint16_t ANSWERS_SPACE = FrameWriter::line_bytes(sizeof(frames::Hello)) +
                                   FrameWriter::line_bytes(sizeof(frames::Ack));

uint16_t scan_payload(uint8_t rows, uint8_t columns) {
    return static_cast<uint16_t>(
        sizeof(frames::Scan) + (readings_in(rows, columns) * uint32_t{frames::ADC_BITS} + 7) / 8);
}

uint16_t cycles_per_byte(uint32_t baud) {
    return static_cast<uint16_t>(board::CLOCK_HZ / baud * BITS_PER_BYTE_8N1);
}

}  // namespace

void Device::begin() {
    settings_source_ = load_settings(&settings_);
    plan_scan(settings_.request, board::CLOCK_HZ, &plan_);
    hello_pending_ = true;
}

bool Device::poll() {
    board::feed_watchdog();
    board::now_us();
    bool worked = serve_line();
    worked |= take_code();
    worked |= serve_line();
    worked |= poll_save();
    if (mode_ != Mode::Idle && board::scanner.parked())
        finish_slots();
    if (codes_left_ == 0 && (hello_pending_ || report_pending_ || ack_count_ != 0))
        send_pending();
    watch_baud();
    return worked;
}

// ------------------------------------------------------------------------------- serial line

bool Device::serve_line() {
    bool worked = false;
    if (writer_.has_byte() && board::serial_can_write()) {
        board::serial_write(writer_.next_byte());
        worked = true;
    }
    uint8_t octet;
    switch (board::serial_read(&octet)) {
    case board::Received::Nothing:
        return worked;
    case board::Received::Damaged:
        reader_.line_error();
        break;
    case board::Received::Byte:
        break;
    }
    if (reader_.feed(octet))
        execute();
    return true;
}

void Device::send_pending() {
    if (hello_pending_ && writer_.space() >= FrameWriter::line_bytes(sizeof(frames::Hello))) {
        hello_pending_ = false;
        send_hello();
    }
    if (report_pending_ &&
        writer_.space() >= FrameWriter::line_bytes(sizeof(frames::SelfTestReport))) {
        report_pending_ = false;
        const frames::SelfTestReport report = self_test_.report();
        writer_.begin(Type::SelfTestReport);
        writer_.put(&report, sizeof report);
        writer_.end();
    }
    uint8_t waiting = 0;
    for (uint8_t i = 0; i < ack_count_; i++) {
        const Ack ack = acks_[i];
        // An ack comes after the frame it stands for.
        if (!ack.ready || hello_pending_ || report_pending_ ||
            writer_.space() < FrameWriter::line_bytes(sizeof(frames::Ack))) {
            acks_[waiting++] = ack;
            continue;
        }
        const frames::Ack frame = {ack.command, ack.sequence, static_cast<uint8_t>(ack.result)};
        writer_.begin(Type::Ack);
        writer_.put(&frame, sizeof frame);
        writer_.end();
    }
    ack_count_ = waiting;
}

void Device::watch_baud() {
    if (baud_next_ != 0) {
        if (ack_count_ != 0 || writer_.has_byte() || !board::serial_idle())
            return;
        baud_ = baud_next_;
        baud_next_ = 0;
        board::serial_speed(baud_);
        baud_changed_us_ = board::now_us();
        baud_confirmed_ = false;
    } else if (!baud_confirmed_ &&
               board::now_us() - baud_changed_us_ > frames::BAUD_CONFIRM_MS * 1000UL) {
        baud_ = frames::BAUD_DEFAULT;
        board::serial_speed(baud_);
        baud_confirmed_ = true;
    }
}

// ---------------------------------------------------------------------------------- commands

void Device::execute() {
    struct Command {
        Type type;
        uint8_t size;
        bool while_scanning;
    };
    static const Command COMMANDS[] = {
        {Type::GetHello, 0, true},
        {Type::Configure, sizeof(frames::Configure), false},
        {Type::Start, 0, true},
        {Type::Stop, 0, true},
        {Type::SetUnitId, sizeof(frames::SetUnitId), true},
        {Type::Save, 0, true},
        {Type::LoadDefaults, 0, false},
        {Type::SelfTest, 0, false},
        {Type::SetBaud, sizeof(frames::SetBaud), false},
    };
    baud_confirmed_ = true;
    const Command *command = nullptr;
    for (const Command &candidate : COMMANDS)
        if (static_cast<uint8_t>(candidate.type) == reader_.type())
            command = &candidate;
    if (command == nullptr)
        return answer(Result::UnknownCommand);
    if (reader_.payload_size() != command->size)
        return answer(Result::BadLength);
    if (mode_ == Mode::SelfTesting && command->type != Type::GetHello)
        return answer(Result::Busy);
    if ((mode_ == Mode::Scanning || mode_ == Mode::Stopping) && !command->while_scanning)
        return answer(Result::Scanning);

    switch (command->type) {
    case Type::GetHello:
        hello_pending_ = true;
        return answer(Result::Ok);
    case Type::Configure: {
        ScanRequest request;
        memcpy(&request, reader_.payload(), sizeof request);
        return answer(configure(request));
    }
    case Type::Start:
        if (mode_ == Mode::Stopping)
            return answer(Result::Busy);
        start();
        return answer(Result::Ok);
    case Type::Stop:
        if (mode_ == Mode::Idle)
            return answer(Result::Ok);
        board::scanner.stop_after_scan();
        mode_ = Mode::Stopping;
        return defer();
    case Type::SetUnitId:
        memcpy(&settings_.unit_id, reader_.payload(), sizeof settings_.unit_id);
        return answer(Result::Ok);
    case Type::Save:
        if (!settings_writer_.idle())
            return answer(Result::Busy);
        settings_writer_.begin(settings_);
        return defer();
    case Type::LoadDefaults:
        if (configure(DEFAULT_SETTINGS.request) != Result::Ok)
            return answer(Result::LineTooSlow);
        settings_ = DEFAULT_SETTINGS;
        return answer(Result::Ok);
    case Type::SelfTest: {
        ScanPlan plan;
        plan_scan(SelfTest::request(), board::CLOCK_HZ, &plan);
        self_test_.begin();
        begin_slots(SelfTest::request(), plan);
        mode_ = Mode::SelfTesting;
        return defer();
    }
    case Type::SetBaud:
        return answer(set_baud(reader_.payload()));
    default:
        return answer(Result::UnknownCommand);
    }
}

Result Device::configure(const ScanRequest &request) {
    ScanPlan plan;
    const Result result = plan_scan(request, board::CLOCK_HZ, &plan);
    if (result != Result::Ok)
        return result;
    if (ring_limit(request, plan, baud_) == 0)
        return Result::LineTooSlow;
    settings_.request = request;
    plan_ = plan;
    return Result::Ok;
}

Result Device::set_baud(const uint8_t *payload) {
    frames::SetBaud wanted;
    memcpy(&wanted, payload, sizeof wanted);
    if (!board::serial_speed_known(wanted.baud))
        return Result::BadBaud;
    if (ring_limit(settings_.request, plan_, wanted.baud) == 0)
        return Result::LineTooSlow;
    baud_next_ = wanted.baud;
    return Result::Ok;
}

void Device::start() {
    if (mode_ == Mode::Scanning)
        return;
    scan_number_ = 0;
    dropped_ = 0;
    ring_limit_ = ring_limit(settings_.request, plan_, baud_);
    begin_slots(settings_.request, plan_);
    mode_ = Mode::Scanning;
}

void Device::begin_slots(const ScanRequest &request, const ScanPlan &plan) {
    lost_seen_ = 0;
    codes_left_ = 0;
    board::scanner.begin(request.rows, request.columns, plan.idle_slots);
    scan_time_us_ = board::now_us();
    scan_time_rest_ = 0;
    board::start_slots(plan, request.adc_prescaler);
}

void Device::finish_slots() {
    // The codes of the last scan are still in the queue until take_code() finds none.
    if (take_code())
        return;
    board::stop_slots();
    if (codes_left_ != 0)
        drop_open_scan();
    if (mode_ == Mode::SelfTesting) {
        report_pending_ = true;
        resolve(Type::SelfTest, Result::Ok);
    } else {
        resolve(Type::Stop, Result::Ok);
    }
    mode_ = Mode::Idle;
}

bool Device::poll_save() {
    switch (settings_writer_.poll()) {
    case SettingsWriter::State::Idle:
        return false;
    case SettingsWriter::State::Writing:
        return true;
    case SettingsWriter::State::Done:
        resolve(Type::Save, Result::Ok);
        return true;
    case SettingsWriter::State::Failed:
        resolve(Type::Save, Result::EepromFailed);
        return true;
    }
    return false;
}

void Device::send_hello() {
    const frames::Hello hello = {
        frames::LAYOUT_CRC,
        VERSION_MAJOR,
        VERSION_MINOR,
        VERSION_PATCH,
        static_cast<uint8_t>(board::KIND),
        settings_.unit_id,
        settings_.request.rows,
        settings_.request.columns,
        frames::READINGS_PER_CELL,
        frames::ADC_BITS,
        board::REF_TOP_OHM,
        board::REF_BOTTOM_OHM,
        settings_.request.rate_mhz,
        plan_.scan_cycles(),
        board::CLOCK_HZ,
        settings_.request.settle_us,
        settle_us(plan_, board::CLOCK_HZ),
        settings_.request.adc_prescaler,
        baud_,
        static_cast<uint8_t>(settings_source_),
        board::reset_cause(),
        static_cast<uint8_t>(mode_ == Mode::Scanning),
    };
    writer_.begin(Type::Hello);
    writer_.put(&hello, sizeof hello);
    writer_.end();
}

// ----------------------------------------------------------------------------------- answers

void Device::answer(Result result) {
    if (ack_count_ == ACKS_MAX) {
        // A host that does not wait for its answers: the command was carried out, but not answered.
        reader_.count_error();
        return;
    }
    acks_[ack_count_++] = Ack{reader_.type(), reader_.sequence(), result, true};
}

void Device::defer() {
    answer(Result::Ok);
    acks_[ack_count_ - 1].ready = false;
}

void Device::resolve(Type command, Result result) {
    for (uint8_t i = 0; i < ack_count_; i++)
        if (acks_[i].command == static_cast<uint8_t>(command) && !acks_[i].ready) {
            acks_[i].result = result;
            acks_[i].ready = true;
        }
}

// ------------------------------------------------------------------------------- scan frames

bool Device::take_code() {
    uint16_t code;
    if (!board::scanner.take(&code))
        return false;
    if (mode_ == Mode::SelfTesting) {
        self_test_.take(code & ~Scanner::FIRST);
        board::scanner.stop_after_scan();  // one scan is enough
        return true;
    }
    if (code & Scanner::FIRST)
        begin_scan();
    if (codes_left_ != 0)
        put_code(code & ~Scanner::FIRST);
    return true;
}

void Device::begin_scan() {
    if (codes_left_ != 0)
        drop_open_scan();
    account_for_lost_scans();
    if (hello_pending_ || report_pending_ || ack_count_ != 0)
        send_pending();
    const uint8_t rows = settings_.request.rows, columns = settings_.request.columns;
    if (writer_.used() <= ring_limit_) {
        const frames::Scan header = {scan_number_, scan_time_us_,       dropped_,
                                     reader_.errors(), rows, columns};
        writer_.begin(Type::Scan);
        writer_.put(&header, sizeof header);
        codes_left_ = readings_in(rows, columns);
        phase_ = carry_ = 0;
    } else {
        dropped_++;
    }
    count_scan();
}

// Codes are missing because the main loop was late. That cannot happen within the limits of
// plan_scan(), but if it does, the scan is lost as a whole.
void Device::drop_open_scan() {
    writer_.abandon();
    codes_left_ = 0;
    dropped_++;
}

// Scan numbers and times go on for scans that never reached the queue.
void Device::account_for_lost_scans() {
    const uint8_t lost = board::scanner.lost_scans();
    while (lost_seen_ != lost) {
        lost_seen_++;
        dropped_++;
        count_scan();
    }
}

void Device::count_scan() {
    const uint8_t cycles_per_us = static_cast<uint8_t>(board::CLOCK_HZ / 1000000);
    const uint32_t cycles = plan_.scan_cycles() + scan_time_rest_;
    scan_number_++;
    scan_time_us_ += cycles / cycles_per_us;
    scan_time_rest_ = static_cast<uint8_t>(cycles % cycles_per_us);
}

// 10-bit codes, least significant bit first: 4 codes make 5 bytes.
void Device::put_code(uint16_t code) {
    static_assert(frames::ADC_BITS == 10, "the shifts below");
    const uint8_t low = static_cast<uint8_t>(code), high = static_cast<uint8_t>(code >> 8);
    switch (phase_) {
    case 0:
        writer_.put(low);
        carry_ = high;
        break;
    case 1:
        writer_.put(static_cast<uint8_t>(carry_ | low << 2));
        carry_ = static_cast<uint8_t>(low >> 6 | high << 2);
        break;
    case 2:
        writer_.put(static_cast<uint8_t>(carry_ | low << 4));
        carry_ = static_cast<uint8_t>(low >> 4 | high << 4);
        break;
    default:
        writer_.put(static_cast<uint8_t>(carry_ | low << 6));
        writer_.put(static_cast<uint8_t>(low >> 2 | high << 6));
    }
    phase_ = (phase_ + 1) & 3;
    if (--codes_left_ != 0)
        return;
    if (phase_ != 0)
        writer_.put(carry_);
    writer_.end();
}

// A scan's bytes come in at a known pace and leave at a known pace, so the most the ring can hold
// during a scan is known when it begins: max(used, one open block) + what comes in faster than it
// leaves. A scan begins only where that fits, hence none is ever torn. 0: it never fits.
uint16_t Device::ring_limit(const ScanRequest &request, const ScanPlan &plan,
                            uint32_t baud) const {
    const uint16_t frame = FrameWriter::line_bytes(scan_payload(request.rows, request.columns));
    const uint32_t duration =
        static_cast<uint32_t>(plan.slot_cycles) * readings_in(request.rows, request.columns);
    uint32_t leaves = duration / cycles_per_byte(baud);
    leaves -= leaves / 32;  // the main loop may be a little late for the line
    const uint32_t excess = frame > leaves ? frame - leaves : 0;
    const uint16_t most = FrameWriter::SIZE - 1 - ANSWERS_SPACE;
    if (excess + FrameWriter::LONGEST_BLOCK > most)
        return 0;
    return static_cast<uint16_t>(most - excess);
}

}  // namespace ohmskin
