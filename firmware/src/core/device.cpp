// SPDX-License-Identifier: Apache-2.0
#include "core/device.h"

#include <stddef.h>
#include <string.h>

#include "board.h"
#include "version.h"

namespace ohmskin {

using frames::Result;
using frames::Type;

void Device::begin() {
    baud_ = frames::BAUD_DEFAULT;
    baud_confirmed_ = true;
    // What was saved at the faster line is kept, be it too fast for this one. Then `hello` says how
    // the board would scan at that line, and start() is refused at this one.
    const uint16_t fast = board::cycles_per_byte(frames::BAUD_FAST);
    settings_source_ = load_settings(&settings_, fast, &next_);
    plan(settings_.request, &next_);
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
    // Where no conversion ends in time, no group comes; the scans are counted before their number
    // wraps, and the self-test ends with its second scan.
    if (activity_ == Activity::Scanning &&
        static_cast<uint8_t>(board::scanner.scans() - scan_number_) > Scanner::SCAN_NUMBERS / 2)
        count_silent_scans();
    else if (activity_ == Activity::SelfTesting && board::scanner.scans() > 1)
        board::scanner.stop_after_scan();
    // Codes cannot wait, because the queue is short. Everything else can.
    if (attention_ || board::scanner.parked())
        worked |= attend();
    return worked;
}

void Device::keep_pace() {
    board::keep_alive();
    transmit();
    while (board::scanner.has_group())
        take_group();
}

// The work of few passes: see attention_. True when there was some.
bool Device::attend() {
    bool worked = false;
    if (!settings_writer_.idle())
        worked = poll_save();
    if (activity_ != Activity::Idle && board::scanner.parked() && !board::scanner.has_group())
        finish_slots();
    if (codes_left_ == 0)
        send_pending();
    watch_baud();
    // Answers that wait for the end of a scan frame need no pass before it: take_group() sets
    // attention_ there, and begin_scan() sends them if the next scan comes first.
    attention_ = (answers_wait() && codes_left_ == 0) || baud_next_ != 0 || !baud_confirmed_ ||
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
        heard_us_ = board::now_us();
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
        // What was refused for another reason was not planned: then the rate is that of an earlier
        // request.
        const bool planned = ack.result == Result::Ok || ack.result == Result::TooFast ||
                             ack.result == Result::LineTooSlow;
        const bool asks = ack.command == static_cast<uint8_t>(Type::Configure) ||
                          ack.command == static_cast<uint8_t>(Type::SetRegion);
        const frames::Ack frame = {ack.command, ack.sequence, static_cast<uint8_t>(ack.result),
                                   ack.time_us, asks && planned ? rate_mhz_ : 0};
        writer_.begin(Type::Ack);
        writer_.put(&frame, sizeof frame);
        writer_.end();
    }
    ack_count_ = still_waiting;
}

// Changes the line's speed, and changes it back if the host is not heard at the new one: the host
// or its USB bridge may not know that speed, and could never reach the board again.
void Device::watch_baud() {
    const bool asked = baud_next_ != 0;
    if (asked) {
        if (ack_count_ != 0 || writer_.has_byte() || !board::serial_idle())
            return;  // the ack of set_baud still leaves at the old speed
        baud_ = baud_next_;
        baud_next_ = 0;
    } else {
        if (baud_confirmed_ ||
            board::now_us() - baud_changed_us_ <= frames::BAUD_CONFIRM_MS * 1000UL)
            return;
        baud_ = frames::BAUD_DEFAULT;
    }
    board::serial_speed(baud_);
    baud_changed_us_ = board::now_us();
    baud_confirmed_ = !asked;
    // Where the request is too fast for this line, the plan for the faster one stays: see begin().
    plan(settings_.request, &next_);
}

// ---------------------------------------------------------------------------------- commands

namespace {

// Bytes of a command's payload; NO_COMMAND where there is none of this type.
constexpr uint8_t NO_COMMAND = 0xFF;
uint8_t payload_size_of(Type command) {
    switch (command) {
    case Type::GetHello:
    case Type::Start:
    case Type::Stop:
    case Type::Save:
    case Type::LoadDefaults:
    case Type::SelfTest:
        return 0;
    case Type::Configure:
        return sizeof(frames::Configure);
    case Type::SetUnitId:
        return sizeof(frames::SetUnitId);
    case Type::SetBaud:
        return sizeof(frames::SetBaud);
    case Type::SetRegion:
        return sizeof(RegionRequest);
    default:
        return NO_COMMAND;
    }
}

// Whether it would tear a scan in progress.
bool tears_scan(Type command) {
    return command == Type::Configure || command == Type::LoadDefaults ||
           command == Type::SelfTest || command == Type::SetBaud;
}

// The fields of a payload, whose size refusal() has checked. It is copied, because the reader's
// bytes need not lie where a field of several bytes may.
template <class Fields> Fields fields_of(const uint8_t *payload) {
    Fields fields;
    memcpy(&fields, payload, sizeof fields);
    return fields;
}

}  // namespace

// Every command that arrives whole is answered once: refused at once, or when it is carried out.
// But while ACKS_MAX answers wait, a further one is neither carried out nor answered.
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
    const Type command = static_cast<Type>(reader_.type());
    const uint8_t size = payload_size_of(command);
    if (size == NO_COMMAND)
        return Result::UnknownCommand;
    if (reader_.payload_size() != size)
        return Result::BadLength;
    // While the line's speed waits for its change, a scan would be planned for the old one, and
    // would fill the ring, so that the change never came.
    if ((activity_ == Activity::SelfTesting || baud_next_ != 0) && command != Type::GetHello)
        return Result::Busy;
    const bool scanning = activity_ == Activity::Scanning || activity_ == Activity::Stopping;
    if (scanning && tears_scan(command))
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
    case Type::SetRegion:
        return set_region(fields_of<RegionRequest>(payload));
    default:
        return answer(Result::UnknownCommand);
    }
}

// Clock cycles in which the line carries a byte.
uint16_t Device::cycles_per_byte() const { return board::cycles_per_byte(baud_); }

// What can be kept of a request, or why it cannot. The answer at hand says the rate.
Result Device::plan(const ScanRequest &request, Routes *routes) {
    return plan_scan(request, cycles_per_byte(), routes, &rate_mhz_);
}

// Takes all of the request or nothing.
Result Device::configure(const ScanRequest &request) {
    const Result result = plan(request, &next_);
    if (result == Result::Ok)
        settings_.request = request;
    return result;
}

// Takes all of the request or nothing. While scanning, it is answered by take_change(), when the
// scanner has begun the first scan of it.
void Device::set_region(const RegionRequest &region) {
    if (activity_ == Activity::Stopping || changing_)
        return answer(Result::Busy);
    ScanRequest request = settings_.request;
    static_assert(sizeof request == offsetof(ScanRequest, row_mask) + sizeof region,
                  "the fields of set_region are the last ones of configure");
    memcpy(&request.row_mask, &region, sizeof region);
    const Result result = configure(request);
    if (result != Result::Ok || activity_ == Activity::Idle)
        return answer(result);
    board::scanner.change(next_);
    changing_ = true;
    defer();
}

Result Device::start() {
    if (activity_ == Activity::Scanning)
        return Result::Ok;
    if (activity_ == Activity::Stopping)
        return Result::Busy;
    // Settings may have been made and saved at a faster line.
    const Result result = plan(settings_.request, &next_);
    if (result != Result::Ok)
        return result;
    routes_ = next_;
    turns_.begin();
    whole_ = turns_.next_is_whole(routes_.whole_every);
    scan_number_ = 0;
    seen_ = false;
    dropped_ = 0;
    board::scanner.begin(routes_);
    begin_slots(route().plan, settings_.request.accuracy);
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
    Settings defaults;
    take_defaults(&defaults);
    if (configure(defaults.request) != Result::Ok)
        return Result::LineTooSlow;
    settings_ = defaults;
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
    baud_next_ = baud;
    return Result::Ok;
}

// --------------------------------------------------------------------- what commands begin

// The scanner has begun.
void Device::begin_slots(const ScanPlan &plan, uint8_t accuracy) {
    codes_left_ = 0;
    // Cycles from now to the first reading. Small slow scans have slots for which 16 bits are few.
    const uint32_t ahead = uint32_t{plan.slot_cycles} * Scanner::FIRST_SLOT;
    scan_time_rest_ = 0;
    scan_time_us_ = board::now_us() + us_of(ahead, &scan_time_rest_);
    board::start_slots(plan.slot_cycles, accuracy);
}

void Device::begin_self_test_scan() {
    const Route of_test = self_test_.route(cycles_per_byte());
    board::scanner.begin(of_test);
    begin_slots(of_test.plan, static_cast<uint8_t>(frames::Accuracy::Usual));
}

// The region that was asked for while scanning is in force.
void Device::take_change() {
    routes_ = next_;
    changing_ = false;
    resolve(Type::SetRegion, Result::Ok);
}

// The slots' last scan is over, and all its codes are taken.
void Device::finish_slots() {
    board::stop_slots();
    if (codes_left_ != 0)
        drop_open_scan();
    if (changing_)
        take_change();
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
    if (activity_ == Activity::Scanning)
        count_silent_scans();
    const ScanRequest &asked = settings_.request;
    frames::Hello hello = {
        frames::LAYOUT_CRC,
        VERSION_MAJOR,
        VERSION_MINOR,
        VERSION_PATCH,
        {},  // the board's name
        board::WIRING,
        settings_.unit_id,
        ROWS_MAX,
        COLUMNS_MAX,
        asked.rows,
        asked.columns,
        board::ADC_BITS,
        board::REF_TOP_OHM,
        board::REF_BOTTOM_OHM,
        asked.rate_mhz,
        next_.region.plan.scan_cycles(),
        next_.region.plan.slot_cycles,
        next_.whole_every != 0 ? next_.whole.plan.scan_cycles() : 0,
        CLOCK_HZ,
        asked.settle_us,
        settle_us(next_.region.plan, asked.accuracy),
        asked.accuracy,
        asked.mode,
        asked.row_mask,
        asked.column_mask,
        asked.whole_mode,
        asked.whole_every,
        baud_,
        static_cast<uint8_t>(settings_source_),
        board::reset_cause(),
        static_cast<uint8_t>(activity_ == Activity::Scanning),
        dropped_,
        board::scanner.late_codes(),
    };
    static_assert(sizeof board::NAME <= sizeof hello.board, "a name");
    memcpy(hello.board, board::NAME, sizeof board::NAME);
    writer_.begin(Type::Hello);
    writer_.put(&hello, sizeof hello);
    writer_.end();
}

// ----------------------------------------------------------------------------------- answers

// Answers the command that has arrived.
void Device::answer(Result result) {
    acks_[ack_count_++] = Ack{reader_.type(), reader_.sequence(), result, true, heard_us_};
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
