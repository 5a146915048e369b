// SPDX-License-Identifier: Apache-2.0
// The board contract on an RP2040 (Raspberry Pi Pico), with registers alone. Section numbers are
// those of its data sheet. It has run in a simulator only: no hardware has been tried.
//
// One interrupt, once a slot; USB and flash are looked after in the main loop's passes. Two other
// interrupts, which any slot interrupts, only wake the processor for them. All code runs from RAM
// (boot2.S), so nothing waits for the flash.
#include "board.h"
#include "flash_store.h"
#include "rp2040.h"
#include "usb_serial.h"
#include "wiring.h"

namespace ohmskin {
namespace board {

using namespace rp2040;

// ------------------------------------------------------------------ wiring: wiring.h says it
// Sense nodes: top on A0 (GP26), bottom on A1 (GP27), far end of the row on A2 (GP28), of the
// column on A3 (GP29), which a Pico has not on its edge: other boards do. They float, as analog
// inputs. All other pins keep the chip's pull-downs.
const uint16_t WIRING = wiring::CRC;
const uint32_t REF_TOP_OHM = wiring::REF_TOP_OHM;
const uint32_t REF_BOTTOM_OHM = wiring::REF_BOTTOM_OHM;
const uint16_t SHORT_CODE = wiring::SHORT_CODE;

namespace {
using wiring::COLUMN_PINS;
using wiring::DRIVE_BOTTOM_PIN;
using wiring::DRIVE_TOP_PIN;
using wiring::ROW_PINS;
// Channels of the converter, by Sense.
constexpr const uint8_t (&CHANNELS)[4] = wiring::SENSE_INPUTS;
// The switch of a Pico's supply: high, its ripple is smaller (Pico's data sheet, "Powerchain").
constexpr uint8_t SUPPLY_MODE_PIN = 23;
constexpr uint8_t FIRST_ANALOG_PIN = 26;

constexpr uint32_t bit(uint8_t pin) { return uint32_t{1} << pin; }
// The levels of four pins that show a number, bit 0 first.
constexpr uint32_t levels(const uint8_t *pins, uint8_t number) {
    return (number & 1 ? bit(pins[0]) : 0) | (number & 2 ? bit(pins[1]) : 0) |
           (number & 4 ? bit(pins[2]) : 0) | (number & 8 ? bit(pins[3]) : 0);
}
constexpr bool exist(const uint8_t *list, uint8_t size, uint8_t end) {
    return size == 0 || (list[0] < end && exist(list + 1, size - 1, end));
}
static_assert(exist(wiring::PINS, wiring::PIN_COUNT, FIRST_ANALOG_PIN),
              "there is no such pin, or it is an analog input: 0 to 25 may be outputs");
static_assert(wiring::count(wiring::PINS, wiring::PIN_COUNT, SUPPLY_MODE_PIN) == 0,
              "pin 23 is the supply's on a Pico");
static_assert(exist(CHANNELS, 4, 4), "OHMSKIN_SENSE_INPUTS: there are 0 to 3");
constexpr uint32_t SCAN_PINS =
    levels(ROW_PINS, 15) | levels(COLUMN_PINS, 15) | bit(DRIVE_TOP_PIN) | bit(DRIVE_BOTTOM_PIN);

// ---------------------------------------------------------------------------------- clocks
// clk_sys [Hz]: 12 MHz * 128 / (6 * 2). Chosen: it is within the chip's 133 MHz, and a slot's clock
// is an eighth of it.
constexpr uint32_t SYS_HZ = 128000000;
constexpr uint32_t PLL_SYS_FEEDBACK = 128, PLL_SYS_DIVIDERS = 6u << 16 | 2u << 12;
// clk_usb and clk_adc: 12 MHz * 100 / (5 * 5) = 48 MHz (2.18.2, "PLL settings").
constexpr uint32_t PLL_USB_FEEDBACK = 100, PLL_USB_DIVIDERS = 5u << 16 | 5u << 12;
// Clock cycles of a slot's clock, which a plan counts in: with 16 bits, slots are up to 4 ms.
constexpr uint32_t SLOT_CLOCK_DIVIDER = 8;
constexpr uint32_t CRYSTAL_MHZ = 12;
// 1 ms for the crystal to start, in 256 of its clocks (2.16.3).
constexpr uint32_t CRYSTAL_STARTUP = 47;
}  // namespace

static_assert(CLOCK_HZ == SYS_HZ / SLOT_CLOCK_DIVIDER, "pico_numbers.h has that of a slot");

namespace {

void start_pll(uint32_t pll, uint32_t feedback, uint32_t dividers) {
    at(pll + PLL_CS) = 1;  // the crystal, undivided
    at(pll + PLL_FBDIV_INT) = feedback;
    clear_bits(pll + PLL_PWR, 1u << 5 | 1u << 0);  // VCO and PLL on
    while (!(at(pll + PLL_CS) & 1u << 31)) {       // locked
    }
    at(pll + PLL_PRIM) = dividers;
    clear_bits(pll + PLL_PWR, 1u << 3);  // post dividers on
}

void release(uint32_t blocks) {
    clear_bits(RESETS, blocks);
    while (~at(RESET_DONE) & blocks) {
    }
}

void clocks_begin() {
    at(XOSC_STARTUP) = CRYSTAL_STARTUP;
    at(XOSC_CTRL) = 0xFABAA0;  // on; 1 to 15 MHz
    while (!(at(XOSC_STATUS) & 1u << 31)) {
    }
    // After a reset by the watchdog, the clocks are as after power-on: they are reset, too.
    at(CLK_REF_CTRL) = 2;  // the crystal
    while (at(CLK_REF_SELECTED) != 1u << 2) {
    }
    release(BLOCK_PLL_SYS | BLOCK_PLL_USB);
    start_pll(PLL_SYS, PLL_SYS_FEEDBACK, PLL_SYS_DIVIDERS);
    start_pll(PLL_USB, PLL_USB_FEEDBACK, PLL_USB_DIVIDERS);
    at(CLK_SYS_CTRL) = 1;  // PLL_SYS, the auxiliary source's first
    while (at(CLK_SYS_SELECTED) != 1u << 1) {
    }
    at(CLK_USB_CTRL) = at(CLK_ADC_CTRL) = 1u << 11;  // on; PLL_USB
    at(WATCHDOG_TICK) = 1u << 9 | CRYSTAL_MHZ;       // 1 us, for timer and watchdog
}

// -------------------------------------------------------------------------------------- pins
// What the registers hold for each reading, by Selection::pattern_entry.
struct Registers {
    uint32_t drive;    // levels of the drive pins
    uint32_t channel;  // ADC_CS
};
Registers registers[PATTERNS * frames::READINGS_MAX];
uint32_t row_levels[ROWS_MAX], column_levels[COLUMNS_MAX];

void pins_begin() {
    for (uint8_t n = 0; n < ROWS_MAX; n++)
        row_levels[n] = levels(ROW_PINS, n);
    for (uint8_t n = 0; n < COLUMNS_MAX; n++)
        column_levels[n] = levels(COLUMN_PINS, n);
    for (uint8_t entry = 0; entry < sizeof registers / sizeof *registers; entry++) {
        const ReadingDefinition reading =
            READING_DEFINITIONS[static_cast<uint8_t>(reading_of(entry / 4, entry % 4))];
        registers[entry] = {bit(reading.drive == Drive::Top ? DRIVE_TOP_PIN : DRIVE_BOTTOM_PIN),
                            ADC_EN | uint32_t{CHANNELS[static_cast<uint8_t>(reading.sense)]} << 12};
    }
    const uint32_t outputs = SCAN_PINS | bit(SUPPLY_MODE_PIN);
    for (uint8_t pin = 0; pin < FIRST_ANALOG_PIN; pin++)
        if (outputs & bit(pin))
            at(GPIO0_CTRL + 8u * pin) = 5;  // SIO: the processor's pins
    at(SIO_GPIO_OUT_CLR) = SCAN_PINS;
    at(SIO_GPIO_OUT_XOR) = ~at(SIO_GPIO_OUT) & bit(SUPPLY_MODE_PIN);
    at(SIO_GPIO_OE_SET) = outputs;
    for (uint8_t channel : CHANNELS)
        at(PADS_GPIO0 + 4u * (FIRST_ANALOG_PIN + channel)) = 1u << 7;  // analog, no pull
    at(ADC_CS) = ADC_EN;
    while (!(at(ADC_CS) & ADC_READY)) {
    }
}

// Where the pins stand for a reading, and the converter's channel for it.
struct Stand {
    uint32_t levels, channel;
};
inline Stand stand_of(const Selection &selection) {
    const Registers &reading = registers[selection.pattern_entry];
    return {row_levels[selection.row] | column_levels[selection.column] | reading.drive,
            reading.channel};
}
inline void select(const Stand &stand) {
    at(SIO_GPIO_OUT_XOR) = (at(SIO_GPIO_OUT) ^ stand.levels) & SCAN_PINS;
    at(ADC_CS) = stand.channel;
}

// -------------------------------------------------------------------------------------- slots
// Slice 0 of the PWM counts a slot, and makes the interrupt in which all happens: the conversion of
// this slot, which takes 2 us, and then the pins of the next. When a conversion samples is not in
// the data sheet (4.9), so the pins wait for its end.
uint16_t code_before;         // of the slot before
bool converted_before;        // whether there was one
constexpr uint32_t WRAP = 1;  // of slice 0
constexpr uint32_t INTERRUPT_TIMER = 1u << 0, INTERRUPT_PWM = 1u << 4, INTERRUPT_USB = 1u << 5;
// How often a conversion's end is asked for, at the most. Chosen: 16 us, 8 times as long as it
// takes.
constexpr uint32_t CONVERSION_ASKED_MAX = 256;
// Cycles of a slot's clock from start_slots() to the first conversion. Chosen, as on the AVR.
constexpr uint16_t FIRST_AFTER = 8;

}  // namespace

Scanner scanner;
const uint8_t SLOTS_OF_NEW_LENGTH = 1;
const uint16_t SELF_TEST_SETTLE_US = 50;

extern "C" void slot_interrupt() {
    // The channel has been set in the slot before, with the pins.
    set_bits(ADC_CS, ADC_START_ONCE);
    at(PWM_INTR) = WRAP;
    const Stand next = stand_of(scanner.selection());
    // While the converter works. The counter takes another end with the next slot.
    if (scanner.step(code_before, converted_before))
        at(PWM_TOP) = scanner.slot_cycles() - 1u;
    uint32_t asked = 0;
    while (!(at(ADC_CS) & ADC_READY) && asked < CONVERSION_ASKED_MAX)
        asked++;
    code_before = static_cast<uint16_t>(at(ADC_RESULT));
    converted_before = asked < CONVERSION_ASKED_MAX;
    select(next);
}

void start_slots(uint16_t slot_cycles, uint8_t) {
    converted_before = false;
    select(stand_of(scanner.selection()));
    at(PWM_TOP) = slot_cycles - 1u;
    at(PWM_CTR) = slot_cycles - uint32_t{FIRST_AFTER};
    at(PWM_INTR) = WRAP;
    at(PWM_INTE) = WRAP;
    at(NVIC_ICPR) = INTERRUPT_PWM;
    at(NVIC_ISER) = INTERRUPT_PWM;
    at(PWM_CSR) = 1;
}

void stop_slots() {
    at(PWM_CSR) = 0;
    at(PWM_INTE) = 0;
    at(NVIC_ICER) = INTERRUPT_PWM;
    at(SIO_GPIO_OUT_CLR) = SCAN_PINS;  // no current through the skin
}

// ----------------------------------------------------------------- reset, clock, watchdog
namespace {
// The watchdog's time [us]: two counts a microsecond (erratum RP2040-E1).
constexpr uint32_t WATCHDOG_US = 250000, WATCHDOG_COUNTS_PER_US = 2;
// Priority of an interrupt that a slot interrupts. NVIC_IPR0 has those of interrupts 0 to 3, a byte
// each, NVIC_IPR1 those of 4 to 7.
constexpr uint32_t LEAST_URGENT = 0xC0;
constexpr uint32_t ALARM0 = 1;
// The longest sleep [us]. Chosen: short beside the 1 ms in which USB counts.
constexpr uint32_t SLEEP_US = 100;
// All but the two oscillators: the watchdog resets these.
constexpr uint32_t PSM_ALL = 0x1FFFC;
// What this firmware leaves in SCRATCH4, which the watchdog's reset keeps. Chosen: none of the
// ROM's words, 0 and B007C0D3h.
constexpr uint32_t RAN = 0x6F686D73;
uint8_t reset_cause_bits;

// The chip's records survive the watchdog's reset, so the watchdog's is asked first. The ROM's boot
// loader restarts the chip by it, too, when it has taken a file or been told to: then SCRATCH4 is
// its own, and nothing has hung.
uint8_t read_reset_cause() {
    constexpr uint32_t BY_TIMER = 1, HAD_POWER_ON = 1u << 8, HAD_RUN_PIN = 1u << 16;
    const uint32_t reason = at(WATCHDOG_REASON);
    if (reason != 0)
        return reason & BY_TIMER && at(WATCHDOG_SCRATCH4) == RAN
                   ? static_cast<uint8_t>(frames::ResetCause::Watchdog)
                   : uint8_t{0};
    const uint32_t had = at(CHIP_RESET);
    if (had & HAD_RUN_PIN)
        return static_cast<uint8_t>(frames::ResetCause::External);
    return had & HAD_POWER_ON ? static_cast<uint8_t>(frames::ResetCause::PowerOn) : uint8_t{0};
}
}  // namespace

void begin() {
    reset_cause_bits = read_reset_cause();
    clocks_begin();
    release(BLOCK_ADC | BLOCK_IO_BANK0 | BLOCK_IO_QSPI | BLOCK_PADS_BANK0 | BLOCK_PWM |
            BLOCK_TIMER | BLOCK_USBCTRL);
    at(PSM_WDSEL) = PSM_ALL;
    at(WATCHDOG_LOAD) = WATCHDOG_US * WATCHDOG_COUNTS_PER_US;
    at(WATCHDOG_SCRATCH4) = RAN;
    at(WATCHDOG_CTRL) = 1u << 30;
    at(PWM_DIV) = SLOT_CLOCK_DIVIDER << 4;
    pins_begin();
    flash_store::begin();
    usb_serial::begin();
    at(TIMER_INTE) = ALARM0;
    at(NVIC_IPR0) = LEAST_URGENT;
    at(NVIC_IPR1) = LEAST_URGENT << 8;
    at(NVIC_ISER) = INTERRUPT_TIMER | INTERRUPT_USB;
}

uint8_t reset_cause() { return reset_cause_bits; }

void keep_alive() {
    at(WATCHDOG_LOAD) = WATCHDOG_US * WATCHDOG_COUNTS_PER_US;
    usb_serial::poll(now_us());
}

uint32_t now_us() { return at(TIMERAWL); }

// Sleeps until the next interrupt where there is nothing to do, but not for long: the flash has no
// interrupt. Interrupts are off meanwhile: one that comes just before the instruction that sleeps
// ends it at once. USB's is asked for only then: what has come since poll() looked makes it at
// once, and if it were taken before the sleep, nothing would end that.
void mark_pass(bool worked) {
    if (worked)
        return;
    at(TIMER_ALARM0) = now_us() + SLEEP_US;
    asm volatile("cpsid i" ::: "memory");
    usb_serial::wake_at_news();
    if (!scanner.has_group())
        asm volatile("wfi");
    asm volatile("cpsie i" ::: "memory");
}

extern "C" void wake_interrupt() {
    usb_serial::wake_no_more();
    at(TIMER_INTR) = ALARM0;
}

// --------------------------------------------------------------------- serial line: USB
// The line's speed is that of USB, whatever it is called.
bool serial_speed_known(uint32_t baud) {
    return baud == frames::BAUD_DEFAULT || baud == frames::BAUD_FAST;
}
void serial_speed(uint32_t) {}
bool serial_can_write() { return usb_serial::can_write(); }
void serial_write(uint8_t octet) { usb_serial::write(octet); }
bool serial_idle() { return usb_serial::idle(); }
bool serial_has_byte() { return usb_serial::has_byte(); }
bool serial_read(uint8_t *octet) {
    *octet = usb_serial::read();
    return true;  // USB repeats what was damaged
}

// ------------------------------------------------------------------ EEPROM: in the flash
uint8_t eeprom_read(uint16_t address) { return flash_store::read(address); }
bool eeprom_busy() { return flash_store::busy(); }
void eeprom_write(uint16_t address, uint8_t octet) { flash_store::write(address, octet); }

}  // namespace board
}  // namespace ohmskin
