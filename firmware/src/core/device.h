// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

#include "core/attributes.h"
#include "core/frame_reader.h"
#include "core/frame_writer.h"
#include "core/scan_plan.h"
#include "core/scanner.h"
#include "core/self_test.h"
#include "core/settings.h"

namespace ohmskin {

// The board as the host sees it: answers commands, and turns the scanner's codes into scan frames.
// All of it runs in the main loop, in short passes; only Scanner::step() runs in an interrupt.
class Device {
  public:
    OHMSKIN_RARE void begin();
    // One pass; true when there was something to do.
    bool poll();
    // What of a pass cannot wait where a command takes longer.
    OHMSKIN_RARE void keep_pace();

  private:
    // What the slots run for.
    enum class Activity : uint8_t {
        Idle,        // no slots run
        Scanning,    // scans are sent
        Stopping,    // the same, until the scan at hand is over: `stop` is answered then
        SelfTesting  // the self-test takes the scans; none is sent
    };

    // The answer to a command, which waits until it may be sent: never inside a scan frame.
    struct Ack {
        uint8_t command;
        uint8_t sequence;
        frames::Result result;
        bool ready;        // false: the command is still being carried out, resolve() comes later
        uint32_t time_us;  // when the command's last byte was read
    };
    // Answers that can wait. Four are chosen: hosts wait for each answer, and this is what a host
    // may send at once that does not.
    static constexpr uint8_t ACKS_MAX = 4;

    OHMSKIN_RARE bool attend();

    // ---- serial line
    OHMSKIN_APART bool transmit();
    OHMSKIN_RARE void receive();
    OHMSKIN_RARE void send_pending();
    OHMSKIN_RARE void watch_baud();

    // ---- commands
    OHMSKIN_RARE void execute();
    frames::Result refusal() const;
    void carry_out();
    OHMSKIN_RARE uint16_t cycles_per_byte() const;
    OHMSKIN_RARE frames::Result plan(const ScanRequest &request, Routes *routes);
    OHMSKIN_RARE frames::Result configure(const ScanRequest &request);
    OHMSKIN_RARE void set_region(const RegionRequest &region);
    OHMSKIN_RARE frames::Result start();
    void stop();
    void save();
    frames::Result load_defaults();
    void begin_self_test();
    OHMSKIN_RARE frames::Result set_baud(uint32_t baud);

    // ---- what commands begin
    OHMSKIN_RARE void begin_slots(const ScanPlan &plan, uint8_t accuracy);
    OHMSKIN_RARE void take_change();
    OHMSKIN_RARE void begin_self_test_scan();
    OHMSKIN_RARE void finish_slots();
    OHMSKIN_RARE bool poll_save();
    OHMSKIN_RARE void send_hello();

    // ---- scan frames (device_scan.cpp)
    OHMSKIN_APART void take_group();
    OHMSKIN_RARE void begin_scan();
    OHMSKIN_RARE void drop_open_scan();
    void put_group(const uint16_t *code, uint8_t count);
    OHMSKIN_RARE void count_scan();
    OHMSKIN_RARE void account_for_lost_scans(uint8_t number);
    OHMSKIN_RARE void count_silent_scans();
    const Route &route() const { return whole_ ? routes_.whole : routes_.region; }

    // ---- answers
    OHMSKIN_RARE void answer(frames::Result result);
    OHMSKIN_RARE void defer();
    OHMSKIN_RARE void resolve(frames::Type command, frames::Result result);
    bool answers_wait() const { return hello_pending_ || report_pending_ || ack_count_ != 0; }

    // All are zeros until begin(): static objects with other initial values take as much flash as
    // RAM.
    FrameWriter writer_{};
    FrameReader reader_{};
    Settings settings_{};
    SettingsWriter settings_writer_{};
    SelfTest self_test_{};
    Routes routes_{};        // of the scan in progress
    Routes next_{};          // for settings_.request; while no change is under way, the same
    bool changing_ = false;  // the scanner has been told of next_, and has not begun a scan of it
    uint32_t rate_mhz_ = 0;  // of the last request: what is kept, or could be
    uint32_t heard_us_ = 0;  // when the last byte of it was read
    Activity activity_ = Activity::Idle;

    // Whether attend() may find something to do. Most passes find nothing, so they skip it.
    //
    // It must be set wherever something begins that attend() has to go on with: at boot (hello),
    // after each command, and at the end of a scan frame, for which answers have waited. Without
    // it, that would wait until the next command. attend() itself keeps it set as long as work is
    // left that no such event ends: a byte of the EEPROM, a new line speed. That the slots have
    // stopped needs no flag, because poll() asks the scanner.
    bool attention_ = false;

    frames::Settings settings_source_{};
    bool hello_pending_ = false;
    bool report_pending_ = false;  // of the self-test
    Ack acks_[ACKS_MAX] = {};
    uint8_t ack_count_ = 0;

    // The scan in progress.
    uint16_t codes_left_ = 0;  // of the scan whose frame is open; 0: none is
    bool whole_ = false;       // it is a whole one in between
    bool seen_ = false;        // a code of the scan of this number has come
    Turns turns_{};
    uint32_t scan_number_ = 0;
    uint32_t scan_time_us_ = 0;
    UsRest scan_time_rest_ = 0;  // parts of a microsecond beyond scan_time_us_
    uint16_t dropped_ = 0;       // scans since the start that were made and not sent

    // The line's speed. A new one is given up again unless the host confirms it by a command.
    uint32_t baud_ = 0;
    uint32_t baud_next_ = 0;  // to be taken once the ack has left; 0: none
    bool baud_confirmed_ = false;
    uint32_t baud_changed_us_ = 0;
};

}  // namespace ohmskin
