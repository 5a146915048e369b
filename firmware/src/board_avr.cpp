// SPDX-License-Identifier: Apache-2.0
// The board contract on an ATmega328P (Uno) and an ATmega2560 (Mega), with registers alone: the
// Arduino core's Serial, millis() and delay() would each bring an interrupt that makes the slot
// interrupt late. Besides that there is one other interrupt, a short one, for bytes received, and
// the watchdog's, which does not return.
#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/wdt.h>

#include "board.h"
#include "core/reset_cause.h"

namespace ohmskin {
namespace board {

// ------------------------------------------------------------- wiring: the one table that says it
// Sense nodes: top on A0, bottom on A1, far end of the row on A2, of the column on A3. A pull-up
// would draw current through the skin, so they float, as analog inputs. No other pin floats. The
// serial line's RX has its pull-up on. Its TX is an output at 1, which holds the line idle while
// the transmitter is off. Unused pins of the ports that each slot writes as a whole are outputs at
// 0: connect nothing to them. All other unused pins are inputs with pull-ups.
const uint32_t CLOCK_HZ = F_CPU;
const uint32_t REF_TOP_OHM = 30000;
const uint32_t REF_BOTTOM_OHM = 30000;

namespace {
// By Sense.
constexpr uint8_t CHANNELS[] = {0, 1, 2, 3};
constexpr uint8_t CHANNEL_PINS = 0x0F;  // of port C (Uno) or F (Mega)
}  // namespace

#if defined(__AVR_ATmega328P__)
const frames::Board KIND = frames::Board::Uno;
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
#elif defined(__AVR_ATmega2560__)
const frames::Board KIND = frames::Board::Megaatmega2560;
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
#else
#error "no pin table for this chip"
#endif

// ----------------------------------------------------------------------------------- slots
Scanner scanner;

namespace {

// Readings as register values, by Selection::reading.
struct Registers {
    uint8_t drive;
    uint8_t admux;
};
constexpr Registers registers_of(Configuration c) {
    return Registers{c.drive == Drive::Top ? DRIVE_TOP : DRIVE_BOTTOM,
                     static_cast<uint8_t>(_BV(REFS0) | CHANNELS[static_cast<uint8_t>(c.sense)])};
}
constexpr Registers registers_of(uint8_t order, uint8_t n) {
    return registers_of(CONFIGURATIONS[static_cast<uint8_t>(reading_of(order, n))]);
}
static_assert(frames::READINGS_PER_CELL == 4 && ORDERS == 4, "one entry a reading below");
constexpr Registers REGISTERS[] = {
    registers_of(0, 0), registers_of(0, 1), registers_of(0, 2), registers_of(0, 3),
    registers_of(1, 0), registers_of(1, 1), registers_of(1, 2), registers_of(1, 3),
    registers_of(2, 0), registers_of(2, 1), registers_of(2, 2), registers_of(2, 3),
    registers_of(3, 0), registers_of(3, 1), registers_of(3, 2), registers_of(3, 3),
};

// Timer 1 counts a slot. Compare B triggers the conversion, whose sample is held 2 ADC clocks and 3
// cycles of synchronisation later. Compare A interrupts so that the pins, which change 59 cycles or
// more into the interrupt, do so an ADC clock and some cycles after the hold: the data sheet leaves
// some of that clock open.
constexpr uint16_t TRIGGER_AT = 8;
constexpr uint16_t interrupt_at(uint8_t prescaler) {
    return static_cast<uint16_t>(TRIGGER_AT + 3u * prescaler + 3 - 52);
}
uint8_t prescaler_bits(uint8_t prescaler) {
    uint8_t bits = 0;
    while (prescaler >>= 1)
        bits++;
    return bits;
}

inline void select(const Selection &selection) {
    const Registers &registers = REGISTERS[selection.reading];
    pins_set(selection.row, selection.column, registers.drive);
    ADMUX = registers.admux;
}

}  // namespace

ISR(TIMER1_COMPA_vect) {
    TIFR1 = _BV(OCF1B);  // the next trigger is the flag's next rising edge
    select(scanner.selection());
    const uint8_t status = ADCSRA;
    ADCSRA = static_cast<uint8_t>(status & ~_BV(ADSC));  // clears ADIF if it is set
    scanner.step(ADC, status & _BV(ADIF));
}

void start_slots(const ScanPlan &plan, uint8_t adc_prescaler) {
    const uint8_t bits = prescaler_bits(adc_prescaler);
    select(scanner.selection());
    // A trigger flag from before must not start a conversion: the timer stands still first.
    TCCR1B = 0;
    TIFR1 = _BV(OCF1A) | _BV(OCF1B);
    ADCSRB = _BV(ADTS2) | _BV(ADTS0);  // auto trigger by timer 1, compare B
    ADCSRA = static_cast<uint8_t>(_BV(ADEN) | _BV(ADATE) | _BV(ADIF) | bits);
    TCCR1A = 0;
    TCCR1B = _BV(WGM13) | _BV(WGM12);  // clear at ICR1, which can be written in such a mode only
    ICR1 = plan.slot_cycles - 1;
    OCR1B = TRIGGER_AT;
    OCR1A = interrupt_at(adc_prescaler);
    TCNT1 = 0;
    TIMSK1 = _BV(OCIE1A);
    TCCR1B = _BV(WGM13) | _BV(WGM12) | _BV(CS10);
}

void stop_slots() {
    TCCR1B = 0;
    TIMSK1 = 0;
    // The converter stays on, because its first conversion after that takes twice as long. ADSC
    // would start one more, if one ends just now.
    ADCSRA = static_cast<uint8_t>((ADCSRA & ~(_BV(ADATE) | _BV(ADSC))) | _BV(ADIF));
    pins_set(0, 0, 0);  // no current through the skin
}

// ------------------------------------------------------------------- reset, clock, watchdog
namespace {
uint8_t reset_cause_bits;
uint32_t overflows_us;

// The C runtime does not clear these.
__attribute__((section(".noinit"))) Mark mark;
__attribute__((section(".noinit"))) uint8_t loader_status;

// Runs before the C runtime's own code for memory. No other code uses r2: -ffixed-r2.
__attribute__((naked, used, section(".init3"))) void take_loader_status() {
    asm volatile("sts %0, r2\n\tclr r2" ::"i"(&loader_status));
}

void clock_begin() {
    TIMSK0 = 0;  // the Arduino core counts milliseconds in this interrupt
    TCCR0A = 0;
    TCCR0B = _BV(CS01) | _BV(CS00);  // clock / 64: 4 us a count, 1024 us a turn
    TCNT0 = 0;
    TIFR0 = _BV(TOV0);
}

void converter_begin() {
    DIDR0 = CHANNEL_PINS;
    ADMUX = REGISTERS[0].admux;
    // A conversion nobody reads: the first one after switching on takes 25 ADC clocks.
    ADCSRA = static_cast<uint8_t>(_BV(ADEN) | _BV(ADSC) | prescaler_bits(32));
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
}

uint8_t reset_cause() { return reset_cause_bits; }

void keep_alive() {
    wdt_reset();
    if (TIFR0 & _BV(TOV0)) {
        TIFR0 = _BV(TOV0);
        overflows_us += 1024;
    }
}

uint32_t now_us() {
    uint8_t count = TCNT0;
    if (TIFR0 & _BV(TOV0)) {  // it may have turned just before the count was read
        keep_alive();
        count = TCNT0;
    }
    return overflows_us + count * 4u;
}

void mark_pass(bool worked) { GPIOR0 = worked; }

// ----------------------------------------------------------------------------- serial line
bool serial_speed_known(uint32_t baud) {
    return baud == frames::BAUD_DEFAULT || baud == frames::BAUD_FAST;
}

void serial_speed(uint32_t baud) {
    UCSR0B = 0;
    UCSR0A = _BV(U2X0);
    UBRR0 = static_cast<uint16_t>(CLOCK_HZ / 8 / baud - 1);
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
}

bool serial_can_write() { return UCSR0A & _BV(UDRE0); }

void serial_write(uint8_t octet) {
    UCSR0A = _BV(U2X0) | _BV(TXC0);  // writing the flag clears it
    UDR0 = octet;
}

bool serial_idle() { return UCSR0A & _BV(TXC0); }

// Reception has an interrupt, because at 1 Mbaud the chip's own three bytes are full after 30 us.
// It takes 5 us, once a byte of a command, by which a slot interrupt may come late: pins then
// settle that much shorter, and no reading is lost.
namespace {
constexpr uint8_t RECEIVED_SIZE = 32;  // more than the longest command
uint8_t received[RECEIVED_SIZE];
volatile uint8_t received_write, received_read;
volatile bool received_damage;
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
