// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <avr/io.h>

#include "wiring.h"

// Any wiring on an AVR (wiring.h): ports and bits of Arduino's pins, and what each port holds for a
// row, a column and a drive pin, made when it compiles. Where nothing is wired otherwise,
// board_avr.cpp sets its ports by fewer instructions.
namespace ohmskin {
namespace avr_pins {

// Port and bit of each pin, as the variants of Arduino's AVR core have them (pins_arduino.h).
#if defined(__AVR_ATmega2560__)
constexpr char PORTS[] = "EEEEGEHHHHBBBBJJHHDDDDAAAAAAAACCCCCCCCDGGGLLLLLLLLBBBBFFFFFFFFKKKKKKKK";
constexpr char BITS[] = "0145533456456710103210012345677654321072107654321032100123456701234567";
constexpr uint8_t FIRST_ANALOG_PIN = 54, ANALOG_INPUTS = 8, LAMP_PIN = 13;
constexpr char ANALOG_PORT = 'F';
#else
constexpr char PORTS[] = "DDDDDDDDBBBBBBCCCCCC";
constexpr char BITS[] = "01234567012345012345";
constexpr uint8_t FIRST_ANALOG_PIN = 14, ANALOG_INPUTS = 6, LAMP_PIN = 13;
constexpr char ANALOG_PORT = 'C';
#endif
constexpr uint8_t ALL_PINS = sizeof PORTS - 1;
static_assert(sizeof PORTS == sizeof BITS, "one bit a pin");

// A pin's bit in its port; that where the port is this one, else 0; those of a list of pins.
constexpr uint8_t bit(uint8_t pin) { return static_cast<uint8_t>(1 << (BITS[pin] - '0')); }
constexpr uint8_t bit_in(char port, uint8_t pin) { return PORTS[pin] == port ? bit(pin) : 0; }
constexpr uint8_t bits_of(char port, const uint8_t *list, uint8_t size) {
    return size == 0
               ? 0
               : static_cast<uint8_t>(bit_in(port, list[0]) | bits_of(port, list + 1, size - 1));
}
// What a port holds of a number that the first `n` pins of a list show.
constexpr uint8_t levels(char port, const uint8_t *list, uint8_t number,
                         uint8_t n = wiring::ADDRESS_PINS) {
    return n == 0 ? 0
                  : static_cast<uint8_t>(((number >> (n - 1) & 1) ? bit_in(port, list[n - 1]) : 0) |
                                         levels(port, list, number, n - 1));
}
constexpr uint8_t LINES = 1 << wiring::ADDRESS_PINS;

constexpr bool exist(const uint8_t *list, uint8_t size) {
    return size == 0 || (list[0] > 1 && list[0] < ALL_PINS && exist(list + 1, size - 1));
}
static_assert(exist(wiring::PINS, wiring::PIN_COUNT),
              "there is no such pin, or it is the serial line's: 0, 1");
constexpr bool inputs_exist(const uint8_t *list, uint8_t size) {
    return size == 0 || (list[0] < ANALOG_INPUTS && inputs_exist(list + 1, size - 1));
}
static_assert(
    inputs_exist(wiring::SENSE_INPUTS, 4),
    "OHMSKIN_SENSE_INPUTS: there is no such input (a Mega's A8 to A15 are not supported)");
constexpr bool senses(uint8_t pin) {
    return pin >= FIRST_ANALOG_PIN && pin < FIRST_ANALOG_PIN + ANALOG_INPUTS &&
           wiring::count(wiring::SENSE_INPUTS, 4, pin - FIRST_ANALOG_PIN) != 0;
}
constexpr bool none_senses(const uint8_t *list, uint8_t size) {
    return size == 0 || (!senses(list[0]) && none_senses(list + 1, size - 1));
}
static_assert(none_senses(wiring::PINS, wiring::PIN_COUNT), "a pin drives and senses");

// Bits of the analog port that sense.
constexpr uint8_t SENSE_BITS = 1 << wiring::SENSE_INPUTS[0] | 1 << wiring::SENSE_INPUTS[1] |
                               1 << wiring::SENSE_INPUTS[2] | 1 << wiring::SENSE_INPUTS[3];

// Of one port: its outputs, and what it holds besides rows, columns and drive. Its other pins are
// inputs with pull-ups, so that none floats; the lamp's would light it, so it is an output at 0.
template <char PORT> struct Port {
    static constexpr uint8_t SCANNED = bits_of(PORT, wiring::PINS, wiring::PIN_COUNT);
    static constexpr uint8_t LAMP = bit_in(PORT, LAMP_PIN);
    static constexpr uint8_t SENSING = PORT == ANALOG_PORT ? SENSE_BITS : 0;
    static constexpr uint8_t TX = bit_in(PORT, 1);
    static constexpr uint8_t OUTPUTS = SCANNED | LAMP | TX;
    static constexpr uint8_t FIXED = static_cast<uint8_t>(~(SCANNED | LAMP | SENSING));
    static constexpr bool HAS_ROWS = bits_of(PORT, wiring::ROW_PINS, wiring::ADDRESS_PINS) != 0;
    static constexpr bool HAS_COLUMNS =
        bits_of(PORT, wiring::COLUMN_PINS, wiring::ADDRESS_PINS) != 0;
    static const uint8_t ROWS[LINES];
    static const uint8_t COLUMNS[LINES];
    static inline uint8_t held(uint8_t row, uint8_t column, bool top, bool bottom) {
        uint8_t bits = FIXED;
        if (HAS_ROWS)
            bits |= ROWS[row];
        if (HAS_COLUMNS)
            bits |= COLUMNS[column];
        if (bit_in(PORT, wiring::DRIVE_TOP_PIN) && top)
            bits |= bit_in(PORT, wiring::DRIVE_TOP_PIN);
        if (bit_in(PORT, wiring::DRIVE_BOTTOM_PIN) && bottom)
            bits |= bit_in(PORT, wiring::DRIVE_BOTTOM_PIN);
        return bits;
    }
};
#define OHMSKIN_FOUR(list, n)                                                                      \
    levels(PORT, list, n), levels(PORT, list, n + 1), levels(PORT, list, n + 2),                   \
        levels(PORT, list, n + 3)
#define OHMSKIN_SIXTEEN(list, n)                                                                   \
    OHMSKIN_FOUR(list, n), OHMSKIN_FOUR(list, n + 4), OHMSKIN_FOUR(list, n + 8),                   \
        OHMSKIN_FOUR(list, n + 12)
#if OHMSKIN_LINES_MAX > 16
#define OHMSKIN_LINES(list) OHMSKIN_SIXTEEN(list, 0), OHMSKIN_SIXTEEN(list, 16)
#else
#define OHMSKIN_LINES(list) OHMSKIN_SIXTEEN(list, 0)
#endif
template <char PORT> const uint8_t Port<PORT>::ROWS[LINES] = {OHMSKIN_LINES(wiring::ROW_PINS)};
template <char PORT>
const uint8_t Port<PORT>::COLUMNS[LINES] = {OHMSKIN_LINES(wiring::COLUMN_PINS)};
#undef OHMSKIN_LINES
#undef OHMSKIN_FOUR
#undef OHMSKIN_SIXTEEN

// Drive pins, as a value that pins_set() takes: one of them high, or none.
constexpr uint8_t DRIVE_TOP = 1, DRIVE_BOTTOM = 2;

#if defined(__AVR_ATmega2560__)
#define OHMSKIN_EACH_PORT(DO) DO(A) DO(B) DO(C) DO(D) DO(E) DO(F) DO(G) DO(H) DO(J) DO(K) DO(L)
#else
#define OHMSKIN_EACH_PORT(DO) DO(B) DO(C) DO(D)
#endif
#define OHMSKIN_LETTER(name) (#name)[0]

inline void begin() {
#define OHMSKIN_BEGIN(name)                                                                        \
    PORT##name = Port<OHMSKIN_LETTER(name)>::FIXED;                                                \
    DDR##name = Port<OHMSKIN_LETTER(name)>::OUTPUTS;
    OHMSKIN_EACH_PORT(OHMSKIN_BEGIN)
#undef OHMSKIN_BEGIN
}

inline void set(uint8_t row, uint8_t column, uint8_t drive) {
    const bool top = drive & DRIVE_TOP, bottom = drive & DRIVE_BOTTOM;
#define OHMSKIN_SET(name)                                                                          \
    if (Port<OHMSKIN_LETTER(name)>::SCANNED != 0)                                                  \
        PORT##name = Port<OHMSKIN_LETTER(name)>::held(row, column, top, bottom);
    OHMSKIN_EACH_PORT(OHMSKIN_SET)
#undef OHMSKIN_SET
}

}  // namespace avr_pins
}  // namespace ohmskin
