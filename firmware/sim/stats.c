/* SPDX-License-Identifier: GPL-3.0-or-later
 * Part of ohmskin's skinsim, a separate program that links libsimavr (GPL-3.0-or-later).
 */
/* Counters, the hold log and the idle time between GPIOR0 markers. */
#define _GNU_SOURCE /* open_memstream */
#include "skinsim.h"

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { GPIOR0_ = 0x3E, HOLD_LOG_MAX = 1 << 20, NESTING_MAX = 16 };

struct stats stats;

struct __attribute__((packed)) hold_record {
    uint64_t cycle;
    uint8_t row, column, configuration, channel;
    uint16_t code;
    uint32_t settle; /* cycles since row, column or drive changed; UINT32_MAX: never, or longer */
};

static struct {
    instant since; /* start of the window of the resettable counters */
    uint64_t resets;
    instant last_change, last_channel_change, last_hold, last_start;
    bool changed, channel_changed, held, started; /* the four above are valid */
    struct {
        uint8_t vector;
        instant entered;
    } nested[NESTING_MAX];
    unsigned depth;
    uint64_t interrupt_cycles; /* of outermost interrupts, never reset */
    bool marked;
    instant marker;
    uint64_t marker_interrupt_cycles;
    bool log_enabled;
    struct hold_record *log;
    size_t log_count, log_size;
} state;

static void add_gap(struct gap *gap, uint64_t cycles) {
    if (!gap->count || cycles < gap->min)
        gap->min = cycles;
    if (cycles > gap->max)
        gap->max = cycles;
    gap->count++;
    gap->cycles += cycles;
}

static void add_load(struct load *load, uint64_t cycles) {
    load->count++;
    load->cycles += cycles;
    if (cycles > load->cycles_max)
        load->cycles_max = cycles;
}

/* ---- conversions */

void stats_pins_changed(instant when) {
    if (state.held && when >= state.last_hold)
        add_gap(&stats.after_hold, when - state.last_hold);
    state.held = false; /* only the first change after a hold counts */
    state.last_change = when;
    state.changed = true;
}

void stats_channel_changed(instant when) {
    state.last_channel_change = when;
    state.channel_changed = true;
}

void stats_hold(instant when, unsigned channel, uint16_t code) {
    const struct skin_pins pins = skin_pins(channel);
    stats.conversions++;
    if (pins.configuration == CONFIG_UNDRIVEN)
        stats.undriven++;
    if (state.changed && when >= state.last_change)
        add_gap(&stats.settle, when - state.last_change);
    if (state.channel_changed && when >= state.last_channel_change)
        add_gap(&stats.channel_settle, when - state.last_channel_change);
    state.last_hold = when;
    state.held = true;
    uint32_t settle = UINT32_MAX;
    if (state.changed && when >= state.last_change && when - state.last_change < UINT32_MAX)
        settle = (uint32_t)(when - state.last_change);
    if (!state.log_enabled)
        return;
    if (state.log_count == HOLD_LOG_MAX) {
        stats.hold_log_dropped++;
        return;
    }
    if (state.log_count == state.log_size) {
        const size_t size = state.log_size ? 2 * state.log_size : 4096;
        struct hold_record *moved = realloc(state.log, size * sizeof *moved);
        if (!moved) {
            stats.hold_log_dropped++;
            return;
        }
        state.log = moved;
        state.log_size = size;
    }
    state.log[state.log_count++] = (struct hold_record){.cycle = when,
                                                        .row = pins.row,
                                                        .column = pins.column,
                                                        .configuration = pins.configuration,
                                                        .channel = (uint8_t)channel,
                                                        .code = code,
                                                        .settle = settle};
}

void stats_conversion_started(instant when) {
    if (state.started)
        add_gap(&stats.trigger, when - state.last_start);
    state.last_start = when;
    state.started = true;
}

void hold_log_enable(bool enable) { state.log_enabled = enable; }

const uint8_t *hold_log_records(size_t *bytes) {
    *bytes = state.log_count * sizeof *state.log;
    return (const uint8_t *)state.log;
}

void hold_log_clear(void) { state.log_count = 0; }

/* ---- processor time */

void stats_interrupt_entered(uint8_t vector, instant when) {
    if (state.depth < NESTING_MAX) {
        state.nested[state.depth].vector = vector;
        state.nested[state.depth].entered = when;
    }
    state.depth++;
}

void stats_interrupt_left(uint8_t vector, instant when) {
    if (!state.depth)
        return;
    state.depth--;
    if (state.depth >= NESTING_MAX || state.nested[state.depth].vector != vector)
        return;
    const uint64_t cycles = when - state.nested[state.depth].entered;
    add_load(&stats.vector[vector % VECTORS], cycles);
    if (state.depth)
        return; /* the outer interrupt's time contains this one's */
    add_load(&stats.interrupts, cycles);
    state.interrupt_cycles += cycles;
}

/* Firmware writes GPIOR0 at the end of each pass of its main loop: 1 if the pass did work. */
static void write_marker(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    (void)param;
    const instant when = cpu_write_instant();
    avr->data[address] = value;
    if (state.marked) {
        stats.passes++;
        const uint64_t in_interrupts = state.interrupt_cycles - state.marker_interrupt_cycles;
        const uint64_t span = when - state.marker;
        if (!value && span > in_interrupts)
            stats.idle_cycles += span - in_interrupts;
    }
    state.marked = true;
    state.marker = when;
    state.marker_interrupt_cycles = state.interrupt_cycles;
}

void stats_start(void) {
    cpu_on_write(GPIOR0_, write_marker, NULL);
    stats_reset();
    state.resets = 0;
}

/* The window's first span begins here, not at the marker before. */
void stats_reset(void) {
    memset(&stats, 0, sizeof stats);
    state.since = cpu->cycle;
    state.held = state.started = false;
    state.marker = cpu->cycle;
    state.marker_interrupt_cycles = state.interrupt_cycles;
}

void stats_cpu_reset(void) {
    state.resets++;
    state.depth = 0;
    state.marked = state.held = state.started = false;
    state.changed = state.channel_changed = false;
}

/* ---- text */

static void print_gap(FILE *out, const char *name, const struct gap *gap) {
    if (gap->count)
        fprintf(out, "\"%s_min\": %" PRIu64 ", \"%s_mean\": %.3f, \"%s_max\": %" PRIu64 ", ", name,
                gap->min, name, (double)gap->cycles / (double)gap->count, name, gap->max);
    else
        fprintf(out, "\"%s_min\": null, \"%s_mean\": null, \"%s_max\": null, ", name, name, name);
}

static void print_load(FILE *out, const struct load *load) {
    fprintf(out, "{\"count\": %" PRIu64 ", \"cycles\": %" PRIu64 ", \"cycles_max\": %" PRIu64 "}",
            load->count, load->cycles, load->cycles_max);
}

char *stats_json(void) {
    char *text = NULL;
    size_t length = 0;
    FILE *out = open_memstream(&text, &length);
    if (!out)
        return NULL;
    const uint64_t window = cpu->cycle - state.since;
    fprintf(out, "{\"state\": \"%s\", \"pc\": %u, \"resets\": %" PRIu64 ", ", cpu_state_name(),
            (unsigned)cpu->pc, state.resets);
    fprintf(out, "\"cycles\": %" PRIu64 ", \"simulated_s\": %.9f, \"window_cycles\": %" PRIu64 ", ",
            cpu->cycle, (double)cpu->cycle / CPU_HZ, window);
#define COUNT(field) fprintf(out, "\"" #field "\": %" PRIu64 ", ", stats.field)
    COUNT(conversions);
    COUNT(lost_results);
    COUNT(undriven);
    COUNT(reference_not_avcc);
    COUNT(unmodelled_triggers);
    COUNT(unmodelled_timer_modes);
    COUNT(tx_bytes);
    COUNT(tx_ignored);
    COUNT(tx_let_go);
    COUNT(tx_undrained_lost);
    COUNT(rx_bytes);
    COUNT(rx_overruns);
    COUNT(rx_ignored);
    COUNT(rx_framing_errors);
    COUNT(pty_dropped);
    COUNT(late_slices);
    COUNT(hold_log_dropped);
    COUNT(idle_cycles);
    COUNT(passes);
#undef COUNT
    const struct wiring *wiring = skin_wiring();
    fprintf(out, wiring->told ? "\"ref_ohm\": [%.0f, %.0f], " : "\"ref_ohm\": null, ",
            wiring->ref_ohm[NODE_TOP], wiring->ref_ohm[NODE_BOTTOM]);
    fprintf(out, "\"floating_pins\": %u, ", skin_floating_pins());
    print_gap(out, "settle_cycles", &stats.settle);
    print_gap(out, "channel_settle_cycles", &stats.channel_settle);
    print_gap(out, "change_after_hold_cycles", &stats.after_hold);
    print_gap(out, "trigger_gap_cycles", &stats.trigger);
    fprintf(out, "\"cpu_percent\": %.4f, ",
            window ? 100 * (1 - (double)stats.idle_cycles / (double)window) : 0.0);
    fprintf(out, "\"interrupts\": ");
    print_load(out, &stats.interrupts);
    fprintf(out, ", \"vectors\": {");
    const char *separator = "";
    for (unsigned v = 0; v < VECTORS; v++) {
        if (!stats.vector[v].count)
            continue;
        fprintf(out, "%s\"%u\": ", separator, v);
        print_load(out, &stats.vector[v]);
        separator = ", ";
    }
    fprintf(out, "}}");
    fclose(out);
    return text;
}
