/* SPDX-License-Identifier: GPL-3.0-or-later
 * Part of ohmskin's skinsim, a separate program that links libsimavr (GPL-3.0-or-later).
 */
/* Timers 0 and 1 counting up: normal, CTC and the flags of fast PWM. No output pins, no input
 * capture, no phase-correct modes.
 *
 * A match sets its flag one timer clock after the counter took the value, as in the datasheet's
 * timing diagrams: with prescaler 1 and a counter at zero at instant t, OCF is set at t + OCR + 1.
 */
#include "skinsim.h"

#include <simavr/avr_timer.h>
#include <simavr/sim_interrupts.h>

enum { FLAG_OVERFLOW, FLAG_A, FLAG_B, FLAG_C, FLAG_ICR = 5, FLAGS };

struct timer {
    enum event event;
    bool wide; /* 16 bits, accessed through TEMP */
    uint16_t control_a, control_b, count_reg, top_reg, compare_reg[3], flag_reg, mask_reg;
    avr_int_vector_t *vector[FLAGS];
    unsigned prescaler; /* 0: stopped */
    uint32_t maximum, top;
    bool overflow_at_top;
    uint32_t count; /* TCNT ... */
    uint64_t tick;  /* ... at this clock of the prescaler */
    uint8_t temp;   /* TEMP, the shared high byte */
};

static struct timer timers[] = {
    {.event = EVENT_TIMER0,
     .control_a = 0x44,
     .control_b = 0x45,
     .count_reg = 0x46,
     .compare_reg = {0x47, 0x48},
     .flag_reg = 0x35,
     .mask_reg = 0x6E,
     .maximum = 0xFF},
    {.event = EVENT_TIMER1,
     .wide = true,
     .control_a = 0x80,
     .control_b = 0x81,
     .count_reg = 0x84,
     .top_reg = 0x86,
     .compare_reg = {0x88, 0x8A, 0x8C},
     .flag_reg = 0x36,
     .mask_reg = 0x6F,
     .maximum = 0xFFFF},
};
enum { TIMERS = sizeof timers / sizeof *timers };

static instant prescaler_origin; /* both timers share one prescaler, at zero after a reset */

static uint32_t wide_register(const struct timer *t, uint16_t address) {
    return cpu->data[address] | (t->wide ? cpu->data[address + 1] << 8 : 0);
}

/* Ticks until something happens: the counter passes a compare value or turns over. */
static uint32_t ticks_to_next(const struct timer *t) {
    uint32_t last = t->count <= t->top ? t->top : t->maximum;
    for (int i = 0; i < 3; i++) {
        if (!t->compare_reg[i])
            continue;
        const uint32_t compare = wide_register(t, t->compare_reg[i]);
        if (compare >= t->count && compare < last)
            last = compare;
    }
    return last - t->count + 1;
}

static void schedule(const struct timer *t) {
    events_set(t->event, t->prescaler
                             ? prescaler_origin + (t->tick + ticks_to_next(t)) * t->prescaler
                             : NEVER);
}

static void set_flag(struct timer *t, unsigned flag, instant when) {
    const bool rising = !(cpu->data[t->flag_reg] >> flag & 1);
    cpu->data[t->flag_reg] |= (uint8_t)(1 << flag);
    if (t->vector[flag])
        avr_raise_interrupt(cpu, t->vector[flag]);
    if (!rising || t->event != EVENT_TIMER1)
        return;
    if (flag == FLAG_B)
        adc_trigger_edge(ADC_TRIGGER_TIMER1_B, when);
    else if (flag == FLAG_OVERFLOW)
        adc_trigger_edge(ADC_TRIGGER_TIMER1_OVERFLOW, when);
}

/* The counter leaves `value` at `when`. */
static void leave(struct timer *t, uint32_t value, instant when) {
    for (unsigned i = 0; i < 3; i++)
        if (t->compare_reg[i] && wide_register(t, t->compare_reg[i]) == value)
            set_flag(t, FLAG_A + i, when);
    const bool at_top = value == t->top, at_maximum = value == t->maximum;
    t->count = at_top || at_maximum ? 0 : value + 1;
    if (t->overflow_at_top ? at_top : at_maximum)
        set_flag(t, FLAG_OVERFLOW, when);
    if (at_top && t->top_reg && t->top == wide_register(t, t->top_reg) && t->top != t->maximum)
        set_flag(t, FLAG_ICR, when);
}

static void advance(struct timer *t, instant when) {
    if (!t->prescaler)
        return;
    const uint64_t target = (when - prescaler_origin) / t->prescaler;
    while (t->tick < target) {
        const uint32_t next = ticks_to_next(t);
        if (next > target - t->tick) {
            t->count += (uint32_t)(target - t->tick);
            t->tick = target;
            return;
        }
        t->tick += next;
        leave(t, t->count + next - 1, prescaler_origin + t->tick * t->prescaler);
    }
}

static void on_event0(instant due) {
    advance(&timers[0], due);
    schedule(&timers[0]);
}

static void on_event1(instant due) {
    advance(&timers[1], due);
    schedule(&timers[1]);
}

static void configure(struct timer *t, instant when) {
    enum { NORMAL = 0, CTC_A, CTC_ICR, PWM_FF, PWM_1FF, PWM_3FF, PWM_A, PWM_ICR, NO };
    static const uint8_t modes0[8] = {NORMAL, NO, CTC_A, PWM_FF, NO, NO, NO, PWM_A};
    static const uint8_t modes1[16] = {NORMAL, NO, NO, NO, CTC_A,   PWM_FF, PWM_1FF, PWM_3FF,
                                       NO,     NO, NO, NO, CTC_ICR, NO,     PWM_ICR, PWM_A};
    static const unsigned prescalers[8] = {0, 1, 8, 64, 256, 1024, 0, 0};
    const uint8_t a = cpu->data[t->control_a] & 3, b = cpu->data[t->control_b];
    const unsigned mode = t->wide ? modes1[(b >> 3 & 3) << 2 | a] : modes0[(b >> 3 & 1) << 2 | a];
    const unsigned prescaler = prescalers[b & 7];
    switch (mode) {
    case CTC_A:
    case PWM_A:
        t->top = wide_register(t, t->compare_reg[0]);
        break;
    case CTC_ICR:
    case PWM_ICR:
        t->top = wide_register(t, t->top_reg);
        break;
    case PWM_FF:
        t->top = 0xFF;
        break;
    case PWM_1FF:
        t->top = 0x1FF;
        break;
    case PWM_3FF:
        t->top = 0x3FF;
        break;
    default:
        t->top = t->maximum;
        break;
    }
    t->overflow_at_top = mode >= PWM_FF && mode != NO;
    if (mode == NO && prescaler)
        stats.unmodelled_timer_modes++;
    if (prescaler != t->prescaler) {
        t->prescaler = prescaler;
        t->tick = prescaler ? (when - prescaler_origin) / prescaler : 0;
    }
    schedule(t);
}

static instant catch_up(struct timer *t) {
    const instant when = cpu_write_instant();
    events_until(when);
    advance(t, when);
    return when;
}

static void write_setting(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    struct timer *t = param;
    const instant when = catch_up(t);
    avr->data[address] = value;
    if (t->wide && address >= t->count_reg) /* the low byte of OCR or ICR commits both */
        avr->data[address + 1] = t->temp;
    configure(t, when);
}

static void write_count(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    struct timer *t = param;
    (void)avr, (void)address;
    catch_up(t);
    t->count = value | (t->wide ? t->temp << 8 : 0);
    schedule(t);
}

static void write_temp(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    (void)avr, (void)address;
    ((struct timer *)param)->temp = value;
}

static void write_flags(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    struct timer *t = param;
    catch_up(t);
    const uint8_t written = cpu_written_bits(value);
    for (unsigned flag = 0; flag < FLAGS; flag++)
        if ((written >> flag & 1) && t->vector[flag])
            cpu_clear_interrupt(t->vector[flag]);
    avr->data[address] &= (uint8_t)~written;
}

static void write_mask(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    struct timer *t = param;
    catch_up(t);
    avr->data[address] = value;
    for (unsigned flag = 0; flag < FLAGS; flag++)
        if (t->vector[flag])
            cpu_retry_interrupt(t->vector[flag]);
}

static uint8_t read_count(avr_t *avr, avr_io_addr_t address, void *param) {
    struct timer *t = param;
    (void)avr, (void)address;
    const instant when = cpu_read_instant();
    events_until(when);
    advance(t, when);
    t->temp = (uint8_t)(t->count >> 8);
    return (uint8_t)t->count;
}

static uint8_t read_temp(avr_t *avr, avr_io_addr_t address, void *param) {
    (void)avr, (void)address;
    return ((struct timer *)param)->temp;
}

static uint8_t read_flags(avr_t *avr, avr_io_addr_t address, void *param) {
    (void)param;
    events_until(cpu_read_instant());
    return avr->data[address];
}

static void attach(struct timer *t) {
    avr_timer_t *stock = cpu_find_io("timer", t->wide ? '1' : '0');
    stock->io.reset = NULL;
    t->vector[FLAG_OVERFLOW] = &stock->overflow;
    for (int i = 0; i < 3; i++) {
        if (!stock->comp[i].r_ocr) {
            t->compare_reg[i] = 0;
            continue;
        }
        t->vector[FLAG_A + i] = &stock->comp[i].interrupt;
        cpu_on_write(t->compare_reg[i], write_setting, t);
        if (t->wide)
            cpu_on_write(t->compare_reg[i] + 1, write_temp, t);
    }
    if (t->wide) {
        t->vector[FLAG_ICR] = &stock->icr;
        cpu_on_write(t->top_reg, write_setting, t);
        cpu_on_write(t->top_reg + 1, write_temp, t);
        cpu_on_write(t->count_reg + 1, write_temp, t);
        cpu_on_read(t->count_reg + 1, read_temp, t);
    }
    cpu_on_write(t->control_a, write_setting, t);
    cpu_on_write(t->control_b, write_setting, t);
    cpu_on_write(t->count_reg, write_count, t);
    cpu_on_read(t->count_reg, read_count, t);
    cpu_on_write(t->flag_reg, write_flags, t);
    cpu_on_read(t->flag_reg, read_flags, t);
    cpu_on_write(t->mask_reg, write_mask, t);
}

void timer_start(void) {
    events_handle(EVENT_TIMER0, on_event0);
    events_handle(EVENT_TIMER1, on_event1);
    for (int i = 0; i < TIMERS; i++)
        attach(&timers[i]);
}

void timer_reset(void) {
    prescaler_origin = cpu->cycle;
    for (int i = 0; i < TIMERS; i++) {
        timers[i].prescaler = 0;
        timers[i].count = 0;
        timers[i].temp = 0;
        timers[i].tick = 0;
        configure(&timers[i], cpu->cycle);
    }
}

bool timer1_flag(unsigned bit) { return cpu->data[timers[1].flag_reg] >> bit & 1; }
