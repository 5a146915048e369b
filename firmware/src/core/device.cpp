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
    // Cells cannot wait, the rest can.
    if (attention_ || board::scanner.parked())
        worked |= attend();
    return worked;
}

// What is not there most of the time.
bool Device::attend() {
    bool worked = false;
    if (!settings_writer_.idle())
        worked = poll_save();
    if (mode_ != Mode::Idle && board::scanner.parked() && !board::scanner.has_group())
        finish_slots();
    if (groups_left_ == 0)
        send_pending();
    watch_baud();
    // Answers that wait for the end of a frame are sent there, by begin_scan().
    const bool answers = hello_pending_ || report_pending_ || ack_count_ != 0;
    attention_ = (answers && groups_left_ == 0) || baud_next_ != 0 || !baud_confirmed_ ||
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
    if (!board::serial_read(&octet))
        reader_.line_error();
    if (reader_.feed(octet)) {
        attention_ = true;
        execute();
    }
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
    if (ack_count_ == ACKS_MAX) {
        // A host that does not wait for its answers: what cannot be answered is not carried out.
        reader_.count_error();
        return;
    }
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
        return answer(start());
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
    case Type::SelfTest:
        self_test_.begin(settings_.request);
        begin_self_test_scan();
        mode_ = Mode::SelfTesting;
        return defer();
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

Result Device::start() {
    if (mode_ == Mode::Scanning)
        return Result::Ok;
    // Settings may have been made and saved at a faster line.
    ring_limit_ = ring_limit(settings_.request, plan_, baud_);
    if (ring_limit_ == 0)
        return Result::LineTooSlow;
    scan_number_ = 0;
    dropped_ = 0;
    begin_slots(settings_.request, plan_);
    mode_ = Mode::Scanning;
    return Result::Ok;
}

void Device::begin_slots(const ScanRequest &request, const ScanPlan &plan) {
    groups_left_ = 0;
    board::scanner.begin(request.rows, request.columns, request.mode, plan.idle_slots);
    const uint8_t cycles_per_us = static_cast<uint8_t>(board::CLOCK_HZ / 1000000);
    const uint32_t ahead = uint32_t{plan.slot_cycles} * Scanner::FIRST_SLOT;  // beyond 16 bits
    scan_time_us_ = board::now_us() + ahead / cycles_per_us;
    scan_time_rest_ = static_cast<uint8_t>(ahead % cycles_per_us);
    board::start_slots(plan, request.adc_prescaler);
}

void Device::begin_self_test_scan() {
    ScanRequest request = SelfTest::request();
    ScanPlan plan;
    plan_scan(request, board::CLOCK_HZ, &plan);
    request.mode = self_test_.order();
    begin_slots(request, plan);
}

void Device::finish_slots() {
    board::stop_slots();
    if (groups_left_ != 0)
        drop_open_scan();
    if (mode_ == Mode::SelfTesting) {
        if (self_test_.next())
            return begin_self_test_scan();
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
        plan_.slot_cycles,
        board::CLOCK_HZ,
        settings_.request.settle_us,
        settle_us(plan_, settings_.request.adc_prescaler, board::CLOCK_HZ),
        settings_.request.adc_prescaler,
        settings_.request.mode,
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

}  // namespace ohmskin
