// SPDX-License-Identifier: Apache-2.0
#include "core/device.h"

#include <string.h>

#include "board.h"
#include "version.h"

namespace ohmskin {

using frames::Result;
using frames::Type;

void Device::begin() {
    settings_source_ = load_settings(&settings_);
    plan_scan(settings_.request, board::CLOCK_HZ, &plan_);
    hello_pending_ = attention_ = true;
}

bool Device::poll() {
    board::keep_alive();
    bool worked = transmit();
    if (board::serial_has_byte()) {
        receive();
        worked = true;
    }
    if (board::scanner.has_group()) {
        take_group();
        return true;
    }
    // Codes cannot wait, because the queue is short. Everything else can.
    if (attention_ || board::scanner.parked())
        worked |= attend();
    return worked;
}

// The work of few passes: see attention_. True when there was some.
bool Device::attend() {
    bool worked = false;
    if (!settings_writer_.idle())
        worked = poll_save();
    if (activity_ != Activity::Idle && board::scanner.parked() && !board::scanner.has_group())
        finish_slots();
    if (groups_left_ == 0)
        send_pending();
    watch_baud();
    // Answers that wait for the end of a scan frame need no pass before it: take_group() sets
    // attention_ there, and begin_scan() sends them if the next scan comes first.
    attention_ = (answers_wait() && groups_left_ == 0) || baud_next_ != 0 || !baud_confirmed_ ||
                 !settings_writer_.idle();
    return worked;
}

// ------------------------------------------------------------------------------- serial line

bool Device::transmit() {
    bool worked = false;
    while (writer_.has_byte() && board::serial_can_write()) {
        board::serial_write(writer_.next_byte());
        worked = true;
    }
    return worked;
}

void Device::receive() {
    uint8_t octet;
    // A byte comes even then, and may be a delimiter, after which the reader is in step again.
    if (!board::serial_read(&octet))
        reader_.line_error();
    if (reader_.feed(octet)) {
        attention_ = true;
        execute();
    }
}

// Sends the answers that wait, as far as the ring has room; those that have none wait on. Not while
// a scan frame is open, because the ring takes one frame after the other.
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
    uint8_t still_waiting = 0;
    for (uint8_t i = 0; i < ack_count_; i++) {
        const Ack ack = acks_[i];
        // An ack comes after the frame that the command asked for.
        if (!ack.ready || hello_pending_ || report_pending_ ||
            writer_.space() < FrameWriter::line_bytes(sizeof(frames::Ack))) {
            acks_[still_waiting++] = ack;
            continue;
        }
        const frames::Ack frame = {ack.command, ack.sequence, static_cast<uint8_t>(ack.result)};
        writer_.begin(Type::Ack);
        writer_.put(&frame, sizeof frame);
        writer_.end();
    }
    ack_count_ = still_waiting;
}

// Changes the line's speed, and changes it back if the host is not heard at the new one: the host
// or its USB bridge may not know that speed, and could never reach the board again.
void Device::watch_baud() {
    if (baud_next_ != 0) {
        if (ack_count_ != 0 || writer_.has_byte() || !board::serial_idle())
            return;  // the ack of set_baud still leaves at the old speed
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

namespace {

struct Command {
    Type type;
    uint8_t payload_size;
    bool while_scanning;  // false: refused then, because it would tear a scan
};

constexpr Command COMMANDS[] = {
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

// The fields of a payload, whose size refusal() has checked. It is copied, because the reader's
// bytes need not lie where a field of several bytes may.
template <class Fields> Fields fields_of(const uint8_t *payload) {
    Fields fields;
    memcpy(&fields, payload, sizeof fields);
    return fields;
}

}  // namespace

// Every command that arrives whole is answered once: refused at once, or when it is carried out.
void Device::execute() {
    baud_confirmed_ = true;  // the host is heard at this speed
    if (ack_count_ == ACKS_MAX) {
        // A host that does not wait for its answers: what cannot be answered is not carried out.
        reader_.count_error();
        return;
    }
    const Result refused = refusal();
    if (refused != Result::Ok)
        return answer(refused);
    carry_out();
}

// Why the command that has arrived cannot be carried out now; Ok if it can.
Result Device::refusal() const {
    const Command *command = nullptr;
    for (const Command &candidate : COMMANDS)
        if (static_cast<uint8_t>(candidate.type) == reader_.type())
            command = &candidate;
    if (command == nullptr)
        return Result::UnknownCommand;
    if (reader_.payload_size() != command->payload_size)
        return Result::BadLength;
    if (activity_ == Activity::SelfTesting && command->type != Type::GetHello)
        return Result::Busy;
    const bool scanning = activity_ == Activity::Scanning || activity_ == Activity::Stopping;
    if (scanning && !command->while_scanning)
        return Result::Scanning;
    return Result::Ok;
}

// Carries out the command that has arrived, and answers it or leaves that to resolve().
void Device::carry_out() {
    const uint8_t *payload = reader_.payload();
    switch (static_cast<Type>(reader_.type())) {
    case Type::GetHello:
        hello_pending_ = true;
        return answer(Result::Ok);
    case Type::Configure:
        return answer(configure(fields_of<frames::Configure>(payload)));
    case Type::Start:
        return answer(start());
    case Type::Stop:
        return stop();
    case Type::SetUnitId:
        settings_.unit_id = fields_of<frames::SetUnitId>(payload).unit_id;
        return answer(Result::Ok);
    case Type::Save:
        return save();
    case Type::LoadDefaults:
        return answer(load_defaults());
    case Type::SelfTest:
        return begin_self_test();
    case Type::SetBaud:
        return answer(set_baud(fields_of<frames::SetBaud>(payload).baud));
    default:
        return answer(Result::UnknownCommand);
    }
}

// Takes all of the request or nothing.
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

Result Device::start() {
    if (activity_ == Activity::Scanning)
        return Result::Ok;
    if (activity_ == Activity::Stopping)
        return Result::Busy;
    // Settings may have been made and saved at a faster line.
    ring_limit_ = ring_limit(settings_.request, plan_, baud_);
    if (ring_limit_ == 0)
        return Result::LineTooSlow;
    scan_number_ = 0;
    dropped_ = 0;
    begin_slots(settings_.request, settings_.request.mode, plan_);
    activity_ = Activity::Scanning;
    return Result::Ok;
}

// Answered by finish_slots(), after the last scan.
void Device::stop() {
    if (activity_ == Activity::Idle)
        return answer(Result::Ok);
    board::scanner.stop_after_scan();
    activity_ = Activity::Stopping;
    defer();
}

// Answered by poll_save(), when the EEPROM has been read back.
void Device::save() {
    if (!settings_writer_.idle())
        return answer(Result::Busy);
    settings_writer_.begin(settings_);
    defer();
}

Result Device::load_defaults() {
    if (configure(DEFAULT_SETTINGS.request) != Result::Ok)
        return Result::LineTooSlow;
    settings_ = DEFAULT_SETTINGS;
    return Result::Ok;
}

// Answered by finish_slots(), after the last of its scans.
void Device::begin_self_test() {
    self_test_.begin(settings_.request);
    begin_self_test_scan();
    activity_ = Activity::SelfTesting;
    defer();
}

// The line changes its speed when the answer has left: see watch_baud().
Result Device::set_baud(uint32_t baud) {
    if (!board::serial_speed_known(baud))
        return Result::BadBaud;
    if (ring_limit(settings_.request, plan_, baud) == 0)
        return Result::LineTooSlow;
    baud_next_ = baud;
    return Result::Ok;
}

// --------------------------------------------------------------------- what commands begin

// pattern: which readings the scans take (scan_sequence.h).
void Device::begin_slots(const ScanRequest &request, uint8_t pattern, const ScanPlan &plan) {
    groups_left_ = 0;
    board::scanner.begin(request.rows, request.columns, pattern, plan.idle_slots);
    const uint8_t cycles_per_us = static_cast<uint8_t>(board::CLOCK_HZ / 1000000);
    // Cycles from now to the first reading. Small slow scans have slots for which 16 bits are few.
    const uint32_t ahead = uint32_t{plan.slot_cycles} * Scanner::FIRST_SLOT;
    scan_time_us_ = board::now_us() + ahead / cycles_per_us;
    scan_time_rest_ = static_cast<uint8_t>(ahead % cycles_per_us);
    board::start_slots(plan, request.adc_prescaler);
}

void Device::begin_self_test_scan() {
    const ScanRequest request = SelfTest::request();
    ScanPlan plan;
    plan_scan(request, board::CLOCK_HZ, &plan);
    begin_slots(request, self_test_.pattern(), plan);
}

// The slots' last scan is over, and all its codes are taken.
void Device::finish_slots() {
    board::stop_slots();
    if (groups_left_ != 0)
        drop_open_scan();
    if (activity_ == Activity::SelfTesting) {
        if (self_test_.next())
            return begin_self_test_scan();
        report_pending_ = true;
        resolve(Type::SelfTest, Result::Ok);
    } else {
        resolve(Type::Stop, Result::Ok);
    }
    activity_ = Activity::Idle;
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
        plan_.slot_cycles,
        board::CLOCK_HZ,
        settings_.request.settle_us,
        settle_us(plan_, settings_.request.adc_prescaler, board::CLOCK_HZ),
        settings_.request.adc_prescaler,
        settings_.request.mode,
        baud_,
        static_cast<uint8_t>(settings_source_),
        board::reset_cause(),
        static_cast<uint8_t>(activity_ == Activity::Scanning),
    };
    writer_.begin(Type::Hello);
    writer_.put(&hello, sizeof hello);
    writer_.end();
}

// ----------------------------------------------------------------------------------- answers

// Answers the command that has arrived.
void Device::answer(Result result) {
    acks_[ack_count_++] = Ack{reader_.type(), reader_.sequence(), result, true};
}

// Leaves the answer to resolve(). Its place is taken now, because the reader forgets the command.
void Device::defer() {
    answer(Result::Ok);
    acks_[ack_count_ - 1].ready = false;
}

// Answers every command of this type that was deferred: a host may have sent `stop` twice.
void Device::resolve(Type command, Result result) {
    for (uint8_t i = 0; i < ack_count_; i++)
        if (acks_[i].command == static_cast<uint8_t>(command) && !acks_[i].ready) {
            acks_[i].result = result;
            acks_[i].ready = true;
        }
}

}  // namespace ohmskin
