// SPDX-License-Identifier: Apache-2.0
// The board contract on an ATmega328P (Uno) and an ATmega2560 (Mega), with registers alone: the
// Arduino core's Serial, millis() and delay() would each bring an interrupt that makes the slot
// interrupt late. Besides that there is one other interrupt, a short one, for bytes received, and
// the watchdog's, which does not return.
#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/wdt.h>

#include "avr_pins.h"
#include "board.h"
#include "core/attributes.h"
#include "core/reset_cause.h"

namespace ohmskin {
namespace board {

// ------------------------------------------------------------------ wiring: wiring.h says it
// Sense nodes: top on A0, bottom on A1, far end of the row on A2, of the column on A3. A pull-up
// would draw current through the skin, so they float, as analog inputs. No other pin floats. The
// serial line's RX has its pull-up on. Its TX is an output at 1, which holds the line idle while
// the transmitter is off. Unused pins of the ports that each slot writes as a whole are outputs at
// 0: connect nothing to them. All other unused pins are inputs with pull-ups.
const uint32_t REF_TOP_OHM = wiring::REF_TOP_OHM;
const uint32_t REF_BOTTOM_OHM = wiring::REF_BOTTOM_OHM;
const uint16_t SHORT_CODE = wiring::SHORT_CODE;
const uint16_t WIRING = wiring::CRC;

namespace {
// Channels of the converter, by Sense, and their pins, as bits of port C (Uno) or F (Mega).
constexpr const uint8_t (&CHANNELS)[4] = wiring::SENSE_INPUTS;
constexpr uint8_t CHANNEL_PINS = avr_pins::SENSE_BITS;
}  // namespace

#if !defined(__AVR_ATmega328P__) && !defined(__AVR_ATmega2560__)
#error "no pin table for this chip"
#endif

#if OHMSKIN_OWN_PINS
namespace {
using avr_pins::DRIVE_BOTTOM;
using avr_pins::DRIVE_TOP;
inline void pins_begin() { avr_pins::begin(); }
inline void pins_set(uint8_t row, uint8_t column, uint8_t drive) {
    avr_pins::set(row, column, drive);
}
}  // namespace
#elif defined(__AVR_ATmega328P__)
namespace {
// Row address D4-D7 (PD4-7), drive top D2 (PD2), drive bottom D3 (PD3), column address D8-D11
// (PB0-3). Serial line: RX D0 (PD0), TX D1 (PD1). Outputs at 0: D12, D13 (PB4-5). Pull-ups: A4, A5
// (PC4-5).
constexpr uint8_t DRIVE_TOP = _BV(PD2);
constexpr uint8_t DRIVE_BOTTOM = _BV(PD3);
constexpr uint8_t LINE_IDLE = _BV(PD0) | _BV(PD1);
inline void pins_begin() {
    PORTD = LINE_IDLE;
    PORTB = 0;
    PORTC = 0x3F & ~CHANNEL_PINS;
    DDRD = 0xF0 | DRIVE_TOP | DRIVE_BOTTOM | _BV(PD1);
    DDRB = 0x3F;
}
inline void pins_set(uint8_t row, uint8_t column, uint8_t drive) {
    row = static_cast<uint8_t>(row << 4);  // a swap of nibbles, as a statement of its own
    PORTD = row | drive | LINE_IDLE;
    PORTB = column;
}
}  // namespace
#else
namespace {
// Row address D22-D25 (PA0-3), column address D37-D34 (PC0-3), drive top D49 (PL0), drive bottom
// D48 (PL1). Serial line: RX D0 (PE0), TX D1 (PE1). Outputs at 0: D26-D33 (PA4-7, PC4-7), D42-D47
// (PL2-7), and D13 (PB7), whose pull-up would light the board's lamp.
constexpr uint8_t DRIVE_TOP = _BV(PL0);
constexpr uint8_t DRIVE_BOTTOM = _BV(PL1);
inline void pins_begin() {
    PORTA = PORTC = PORTL = 0;
    DDRA = DDRC = DDRL = 0xFF;
    PORTB = 0x7F;
    DDRB = _BV(PB7);
    PORTD = PORTG = PORTH = PORTJ = PORTK = 0xFF;
    PORTE = 0xFF;
    DDRE = _BV(PE1);
    PORTF = 0xFF & ~CHANNEL_PINS;
}
inline void pins_set(uint8_t row, uint8_t column, uint8_t drive) {
    PORTA = row;
    PORTC = column;
    PORTL = drive;
}
}  // namespace
#endif

// ----------------------------------------------------------------------------------- slots
Scanner scanner;
const uint8_t SLOTS_OF_NEW_LENGTH = 2;
const uint16_t SELF_TEST_SETTLE_US = 50;

namespace {

// What the registers hold for each reading, by Selection::pattern_entry.
struct Registers {
    uint8_t drive;
    uint8_t admux;
};
constexpr Registers registers_of(ReadingDefinition reading) {
    return Registers{
        reading.drive == Drive::Top ? DRIVE_TOP : DRIVE_BOTTOM,
        static_cast<uint8_t>(_BV(REFS0) | CHANNELS[static_cast<uint8_t>(reading.sense)])};
}
constexpr Registers registers_of(uint8_t pattern, uint8_t n) {
    return registers_of(READING_DEFINITIONS[static_cast<uint8_t>(reading_of(pattern, n))]);
}
constexpr uint8_t entries(uint8_t pattern) { return PATTERN_DEFINITIONS[pattern].count; }
static_assert(PATTERNS == 6 && entries(0) == 4 && entries(1) == 4 && entries(2) == 2 &&
                  entries(3) == 1 && entries(4) == 4 && entries(5) == 4,
              "one entry a reading below, and none that is used twice");
constexpr Registers REGISTERS[] = {
    registers_of(0, 0),
    registers_of(0, 1),
    registers_of(0, 2),
    registers_of(0, 3),
    registers_of(1, 0),
    registers_of(1, 1),
    registers_of(1, 2),
    registers_of(1, 3),
    registers_of(2, 0),
    registers_of(2, 1),
    {0, 0},
    {0, 0},
    registers_of(3, 0),
    {0, 0},
    {0, 0},
    {0, 0},
    registers_of(4, 0),
    registers_of(4, 1),
    registers_of(4, 2),
    registers_of(4, 3),
    registers_of(5, 0),
    registers_of(5, 1),
    registers_of(5, 2),
    registers_of(5, 3),
};

// Timer 1 counts a slot. Its compare B triggers the converter. Its compare A makes the interrupt,
// which sets the pins for the next slot as soon as the sample is held. Pins that change earlier
// change the reading; pins that change later have less time to settle. Entering the interrupt takes
// so long that it has to begin before the hold:
//
//     clock cycle of the slot       what happens
//     TRIGGER_AT                    compare B: the converter is triggered
//     interrupt_at()                compare A: the interrupt begins
//     hold = TRIGGER_AT + HOLD_SYNC_CYCLES + HOLD_ADC_CLOCKS
//                                   the sample is held
//     hold + open_cycles()          the sample is held by now, whatever the data sheet leaves open
//     ... + PINS_SPARE              the first pin changes, PINS_AFTER_INTERRUPT after compare A

// Any cycle but the slot's first ones would serve. start_slots() writes the counter, and the data
// sheets ("16-bit Timer/Counter1", "Using the Output Compare Unit") say that no match is
// seen in the cycle after that.
constexpr uint16_t TRIGGER_AT = 8;
// Clock cycles and ADC clocks from the trigger to the hold ("Prescaling and Conversion Timing",
// auto triggered).
constexpr uint16_t HOLD_SYNC_CYCLES = 3, HOLD_ADC_CLOCKS = 2;
// What that leaves open: half an ADC clock. The data sheets give holds and ends of conversions in
// halves, 11.5 ADC clocks from one to the other in each kind of conversion.
constexpr uint16_t open_cycles(uint8_t prescaler) { return prescaler / 2; }
// Clock cycles from compare A to the first change of a pin, at the least: the chip enters the
// interrupt, the compiler's code saves registers, and select() looks the pins up. This number is
// the compiler's: with avr-gcc 5.4 it is 56 on the Uno and 55 on the Mega, with 7.3 it is 55 on
// both. A test measures it in the simulator, and fails where pins change too early: tests/firmware,
// test_pins_change_after_the_hold_and_not_before.
constexpr uint16_t PINS_AFTER_INTERRUPT = 55;
// Clock cycles to spare, for a compiler whose code is a little faster. Chosen.
constexpr uint16_t PINS_SPARE = 3;
constexpr uint16_t interrupt_at(uint8_t prescaler) {
    return static_cast<uint16_t>(TRIGGER_AT + HOLD_SYNC_CYCLES + HOLD_ADC_CLOCKS * prescaler +
                                 open_cycles(prescaler) + PINS_SPARE - PINS_AFTER_INTERRUPT);
}

// The prescaler as the converter's register has it: its logarithm to the base 2.
constexpr uint8_t prescaler_bits(uint8_t accuracy) { return static_cast<uint8_t>(5 + accuracy); }
static_assert(prescaler(0) == 1 << prescaler_bits(0) && prescaler(2) == 1 << prescaler_bits(2),
              "of all accuracies");

// Sets pins and multiplexers, and the converter's channel for its next sample.
inline void select(const Selection &selection) {
    const Registers &registers = REGISTERS[selection.pattern_entry];
    pins_set(selection.row, selection.column, registers.drive);
    ADMUX = registers.admux;
}

}  // namespace

// Once a slot: core/scanner.h says what is in which slot. The converter's own interrupt is not
// used, because two interrupts could make each other late.
ISR(TIMER1_COMPA_vect) {
    // The converter is triggered by a rising edge of this flag, so the flag must be 0 before that.
    TIFR1 = _BV(OCF1B);
    select(scanner.selection());
    // ADIF says whether a conversion has ended since the interrupt before. Writing 1 to it clears
    // it, so writing back what was read does. ADSC must not be written as 1: it reads as 1 during
    // a conversion, and a conversion that ends just now would be followed by another one.
    const uint8_t status = ADCSRA;
    ADCSRA = static_cast<uint8_t>(status & ~_BV(ADSC));
    // The counter is far from its end here, so that any new length of the slot is safe.
    if (scanner.step(ADC, status & _BV(ADIF)))
        ICR1 = static_cast<uint16_t>(scanner.slot_cycles() - 1);
}

void start_slots(uint16_t slot_cycles, uint8_t accuracy) {
    const uint8_t adc_prescaler = prescaler(accuracy);
    select(scanner.selection());
    // The timer stands still until all is set, and its flags are cleared: a flag from before would
    // start a conversion at once.
    TCCR1B = 0;
    TIFR1 = _BV(OCF1A) | _BV(OCF1B);
    ADCSRB = _BV(ADTS2) | _BV(ADTS0);  // auto trigger by timer 1, compare B
    ADCSRA = static_cast<uint8_t>(_BV(ADEN) | _BV(ADATE) | _BV(ADIF) | prescaler_bits(accuracy));
    TCCR1A = 0;
    // The mode in which the counter starts again after ICR1, which can be written in this mode
    // only.
    TCCR1B = _BV(WGM13) | _BV(WGM12);
    ICR1 = static_cast<uint16_t>(slot_cycles - 1);
    OCR1B = TRIGGER_AT;
    OCR1A = interrupt_at(adc_prescaler);
    TCNT1 = 0;
    TIMSK1 = _BV(OCIE1A);
    TCCR1B = _BV(WGM13) | _BV(WGM12) | _BV(CS10);  // from here on it counts every clock cycle
}

void stop_slots() {
    TCCR1B = 0;
    TIMSK1 = 0;
    // The converter stays on, because the first conversion after it is switched on takes twice as
    // long. ADSC is written as 0 for the reason that the interrupt has.
    ADCSRA = static_cast<uint8_t>((ADCSRA & ~(_BV(ADATE) | _BV(ADSC))) | _BV(ADIF));
    pins_set(0, 0, 0);  // no current through the skin
}

// ------------------------------------------------------------------- reset, clock, watchdog
namespace {
uint8_t reset_cause_bits;

// Timer 0 is the clock: a count takes 64 clock cycles, and the counter turns over after 256 counts.
constexpr uint8_t COUNT_US = 4;
constexpr uint16_t TURN_US = 1024;
static_assert(CLOCK_HZ == 16000000, "another clock has other times of a count and of a turn");
uint32_t turns_us;  // time of all turns so far

// What the firmware before this start left (core/reset_cause.h), and what the boot loader passes
// on. The C runtime does not clear these.
__attribute__((section(".noinit"))) Mark mark;
__attribute__((section(".noinit"))) uint8_t loader_status;

// Keeps r2, in which a boot loader passes on the reset flags. It runs before the C runtime's own
// code for memory. No other code uses r2: -ffixed-r2 (firmware/reserve_r2.py).
__attribute__((naked, used, section(".init3"))) void take_loader_status() {
    asm volatile("sts %0, r2\n\tclr r2" ::"i"(&loader_status));
}

void clock_begin() {
    TIMSK0 = 0;  // no interrupt, whatever ran before
    TCCR0A = 0;
    TCCR0B = _BV(CS01) | _BV(CS00);  // clock / 64
    TCNT0 = 0;
    TIFR0 = _BV(TOV0);
}

void converter_begin() {
    DIDR0 = CHANNEL_PINS;
    ADMUX = REGISTERS[0].admux;
    // The first conversion after switching on takes 25 ADC clocks, for which a slot has no room. So
    // it is made now, and nobody reads it.
    constexpr uint8_t USUAL = static_cast<uint8_t>(frames::Accuracy::Usual);
    ADCSRA = static_cast<uint8_t>(_BV(ADEN) | _BV(ADSC) | prescaler_bits(USUAL));
    while (ADCSRA & _BV(ADSC)) {
    }
}
}  // namespace

// The main loop has hung. The watchdog could reset the chip now, but two boot loaders would not
// survive it: those of Megas of before 2012 and of old Nanos leave the watchdog on after its reset,
// which then resets them for ever. So the firmware starts anew from its reset vector. What could
// interrupt that start is switched off, as a reset would; begin() sets the rest. Where this
// interrupt cannot come, because interrupts are off or begin() itself hangs, the chip is reset.
ISR(WDT_vect) {
    wdt_disable();
    TIMSK1 = 0;
    ADCSRA = 0;
    UCSR0B = 0;
    mark = Mark::Hung;
    asm volatile("jmp 0");
}

void begin() {
    reset_cause_bits = ohmskin::reset_cause(MCUSR, mark, loader_status);
    mark = Mark::Ran;
    MCUSR = 0;
    wdt_enable(WDTO_250MS);
    pins_begin();
    clock_begin();
    converter_begin();
    serial_speed(frames::BAUD_DEFAULT);
    WDTCSR |= _BV(WDIE);  // the first time-out interrupts, the second one resets
    sei();
}

uint8_t reset_cause() { return reset_cause_bits; }

void keep_alive() {
    wdt_reset();
    if (TIFR0 & _BV(TOV0)) {
        TIFR0 = _BV(TOV0);
        turns_us += TURN_US;
    }
}

uint32_t now_us() {
    uint8_t count = TCNT0;
    if (TIFR0 & _BV(TOV0)) {  // it may have turned over before or after the count was read
        keep_alive();
        count = TCNT0;
    }
    return turns_us + count * uint16_t{COUNT_US};
}

void mark_pass(bool worked) { GPIOR0 = worked; }

// ----------------------------------------------------------------------------- serial line
bool serial_speed_known(uint32_t baud) {
    return baud == frames::BAUD_DEFAULT || baud == frames::BAUD_FAST;
}

OHMSKIN_RARE void serial_speed(uint32_t baud) {
    UCSR0B = 0;
    UCSR0A = _BV(U2X0);  // the clock is divided by 8, not 16
    UBRR0 = static_cast<uint16_t>(CLOCK_HZ / 8 / baud - 1);
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);  // 8N1
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
}

bool serial_can_write() { return UCSR0A & _BV(UDRE0); }

void serial_write(uint8_t octet) {
    UCSR0A = _BV(U2X0) | _BV(TXC0);  // writing 1 to TXC0 clears it: serial_idle() waits for it
    UDR0 = octet;
}

bool serial_idle() { return UCSR0A & _BV(TXC0); }

// Reception has an interrupt, because at 1 Mbaud the chip's own three bytes are full after 30 us.
// It takes 5 us, once a byte of a command, by which a slot interrupt may come late: pins then
// settle that much shorter, and no reading is lost.
namespace {
// Bytes: a power of two, and more than the longest command takes.
constexpr uint8_t RECEIVED_SIZE = 32;
uint8_t received[RECEIVED_SIZE];
volatile uint8_t received_write, received_read;  // moved by the interrupt, by the main loop
volatile bool received_damage;                   // a byte was damaged or lost
}  // namespace

#if defined(USART0_RX_vect)
ISR(USART0_RX_vect) {
#else
ISR(USART_RX_vect) {
#endif
    const uint8_t status = UCSR0A;  // describes the byte that reading UDR0 takes away
    const uint8_t octet = UDR0;
    const uint8_t at = received_write;
    const uint8_t next = (at + 1) & (RECEIVED_SIZE - 1);
    if ((status & (_BV(FE0) | _BV(DOR0))) || next == received_read)
        received_damage = true;
    if (next == received_read)
        return;
    received[at] = octet;
    __atomic_signal_fence(__ATOMIC_SEQ_CST);  // the byte is there before received_write says so
    received_write = next;
}

bool serial_has_byte() { return received_write != received_read; }

bool serial_read(uint8_t *octet) {
    const uint8_t at = received_read;
    *octet = received[at];
    __atomic_signal_fence(__ATOMIC_SEQ_CST);  // it has been read by now
    received_read = (at + 1) & (RECEIVED_SIZE - 1);
    const bool sound = !received_damage;
    received_damage = false;
    return sound;
}

// ---------------------------------------------------------------------------------- EEPROM
uint8_t eeprom_read(uint16_t address) {
    return eeprom_read_byte(reinterpret_cast<const uint8_t *>(address));
}

bool eeprom_busy() { return EECR & _BV(EEPE); }

void eeprom_write(uint16_t address, uint8_t octet) {
    eeprom_write_byte(reinterpret_cast<uint8_t *>(address), octet);
}

}  // namespace board
}  // namespace ohmskin

// In place of the Arduino core's main(), which would bring init() before setup(), and with it an
// interrupt that counts milliseconds: begin() sets all registers that the firmware needs.
extern "C" void setup();
extern "C" void loop();
int main() {
    setup();
    loop();
}
