// SPDX-License-Identifier: Apache-2.0
//
// Unit tests that run natively and on an AVR, in as many files as one likes:
//
//     #include "check.h"
//
//     TEST(a_full_queue_refuses) {
//         CHECK(queue.full());
//         CHECK_EQ(8, queue.size());        // want, got: integers, bools, enums
//         CHECK_BYTES(frame, queue.front(), sizeof frame);
//     }
//
// A failed check is reported and the test goes on; each check is also the bool that says whether it
// held: `if (!CHECK(p)) return;`. main() is in here. Output is in the format of Unity.
#pragma once

#include <stddef.h>
#include <stdint.h>
#include <stdio.h>

#ifdef __AVR__
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/pgmspace.h>
#include <avr/sleep.h>
#include <util/delay.h>
#define CHECK_FLASH PROGMEM
#define CHECK_TEXT(text) ""  // 2 KiB of RAM have no room for it: the line number must do
#else
#define CHECK_FLASH
#define CHECK_TEXT(text) text ": "
#endif

#define TEST(name)                                                                                 \
    static void test_##name();                                                                     \
    static const ::check::Test test_##name##_ CHECK_FLASH = {test_##name, __FILE__, __LINE__,      \
                                                             #name};                               \
    static ::check::Link test_##name##_link(test_##name##_);                                       \
    static void test_##name()

#define CHECK(...)                                                                                 \
    ::check::holds(static_cast<bool>(__VA_ARGS__), CHECK_TEXT(#__VA_ARGS__), __FILE__, __LINE__)
#define CHECK_EQ(want, got)                                                                        \
    ::check::equal(::check::number(want), ::check::number(got), CHECK_TEXT(#got), __FILE__,        \
                   __LINE__)
#define CHECK_BYTES(want, got, size)                                                               \
    ::check::same_bytes(want, got, size, CHECK_TEXT(#got), __FILE__, __LINE__)

namespace check {

struct Test {
    void (*run)();
    const char *file;
    int line;
    char name[64];
};

struct Link {
    explicit Link(const Test &test);
    const Test &test;  // in flash on an AVR
    Link *next;
};

struct State {
    Link *first, *last;
    const char *name;  // of the running test
    int failed_checks;
};

inline State &state() {
    static State zero_before_the_first_constructor;
    return zero_before_the_first_constructor;
}

inline Link::Link(const Test &test_in_flash) : test(test_in_flash), next(nullptr) {
    State &s = state();
    (s.first ? s.last->next : s.first) = this;
    s.last = this;
}

inline bool begin_failure(const char *file, int line, const char *text) {
    if (++state().failed_checks > 5)  // of one test: more would be the same again
        return false;
    printf("%s:%d:%s:FAIL: %s", file, line, state().name, text);
    return true;
}

inline bool holds(bool condition, const char *text, const char *file, int line) {
    if (!condition && begin_failure(file, line, text))
        printf("Does Not Hold\n");
    return condition;
}

template <class T> long number(T value) {
    static_assert(sizeof(T) <= sizeof(long), "compare it in parts");
    return static_cast<long>(value);
}
long number(double) = delete;  // compare real numbers with CHECK and a tolerance
long number(float) = delete;

inline bool equal(long want, long got, const char *text, const char *file, int line) {
    if (want != got && begin_failure(file, line, text))
        printf("Expected %ld Was %ld\n", want, got);
    return want == got;
}

inline bool same_bytes(const void *want, const void *got, size_t size, const char *text,
                       const char *file, int line) {
    const uint8_t *w = static_cast<const uint8_t *>(want);
    const uint8_t *g = static_cast<const uint8_t *>(got);
    size_t i = 0;
    while (i < size && w[i] == g[i])
        ++i;
    if (i < size && begin_failure(file, line, text))
        printf("Byte %u Expected %u Was %u\n", static_cast<unsigned>(i), w[i], g[i]);
    return i == size;
}

#ifdef __AVR__
inline int write(char c, FILE *) {
    loop_until_bit_is_set(UCSR0A, UDRE0);
    UDR0 = static_cast<uint8_t>(c);
    return 0;
}

inline void begin() {
    static FILE uart;
    fdev_setup_stream(&uart, write, nullptr, _FDEV_SETUP_WRITE);
    stdout = &uart;
    UBRR0 = F_CPU / 8 / 115200 - 1;
    UCSR0A = _BV(U2X0);
    UCSR0B = _BV(TXEN0);
}

inline void end() {
    _delay_ms(1);  // the last two bytes leave
    cli();
    sleep_enable();
    sleep_cpu();  // for ever; simavr quits here
}

inline void read(Test &copy, const Test &test) { memcpy_P(&copy, &test, sizeof copy); }
#else
inline void begin() { setvbuf(stdout, nullptr, _IOLBF, BUFSIZ); }  // a crash loses no line
inline void end() {}
inline void read(Test &copy, const Test &test) { copy = test; }
#endif

}  // namespace check

// Weak, so that every file of a test may include this header. The failures are in the output:
// an exit code other than 0 would say that the tests did not end.
__attribute__((weak)) int main() {
    int tests = 0, failures = 0;
    check::begin();
    for (const check::Link *link = check::state().first; link; link = link->next) {
        check::Test test;
        check::read(test, link->test);
        check::state().name = test.name;
        check::state().failed_checks = 0;
        test.run();
        ++tests;
        if (check::state().failed_checks)
            ++failures;
        else
            printf("%s:%d:%s:PASS\n", test.file, test.line, test.name);
    }
    printf("%d Tests %d Failures 0 Ignored\n", tests, failures);
    check::end();
    return 0;
}
