/* SPDX-License-Identifier: GPL-3.0-or-later
 * Part of ohmskin's skinsim, a separate program that links libsimavr (GPL-3.0-or-later).
 */
/* What a desk adds to the ideal board, by name: the op `O`. README.md says what each one means. */
#include "skinsim.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

struct settings settings;

static const struct setting {
    const char *name;
    double *value;
    double least, most;
    bool by_clock; /* one value an ADC clock */
} SETTINGS[] = {
    {"tau_us", &settings.tau_us, 0, 1e9, false},
    {"sample_pf", &settings.sample_pf, 0, 1e6, false},
    {"input_ohm", &settings.input_ohm, 0, 1e6, false},
    {"node_pf", &settings.node_pf, 0, 1e6, false},
    {"line_pf", &settings.line_pf, 0, 1e6, false},
    {"cell_pf", &settings.cell_pf, 0, 1e6, false},
    {"half_code", &settings.half_code, 0, 1, false},
    {"far_open", &settings.far_open, 0, 1, false},
    {"track_late", &settings.track_late, 0, 1, false},
    {"offset_lsb", settings.offset_lsb, -1024, 1024, true},
    {"gain_lsb", settings.gain_lsb, -1024, 1024, true},
    {"inl_lsb", settings.inl_lsb, -1024, 1024, true},
    {"noise_lsb", settings.noise_lsb, 0, 1024, true},
    {"late_cycles", &settings.late_cycles, 0, 1000, false},
    {"seed", &settings.seed, 0, UINT32_MAX, false},
};
enum { SETTINGS_COUNT = sizeof SETTINGS / sizeof *SETTINGS, CLOCKS = 8 };

/* The first and the last value that a name stands for: "offset_lsb" for all ADC clocks,
 * "offset_lsb_500khz" for one. False if it does not stand for this setting. */
static bool is_named(const struct setting *s, const char *name, size_t *first, size_t *last) {
    const size_t length = strlen(s->name);
    *first = 0;
    *last = s->by_clock ? CLOCKS - 1 : 0;
    if (strncmp(name, s->name, length))
        return false;
    if (!name[length])
        return true;
    for (size_t adps = 1; s->by_clock && adps < CLOCKS; adps++) {
        char clock[16];
        snprintf(clock, sizeof clock, "_%ukhz", CPU_HZ / 1000 >> adps);
        *first = *last = adps;
        if (!strcmp(name + length, clock))
            return true;
    }
    return false;
}

/* What a board on a desk may have; the setting `desk` is this, or none of it. */
static const struct {
    const char *name;
    double value;
} DESK[] = {{"sample_pf", 14}, {"input_ohm", 10e3}, {"node_pf", 100},    {"line_pf", 30},
            {"cell_pf", 2},    {"half_code", 1},    {"offset_lsb", 2},   {"gain_lsb", 2},
            {"inl_lsb", 1.5},  {"noise_lsb", 0.5},  {"late_cycles", 16}, {"far_open", 1}};

static const char *set_desk(bool on) {
    for (size_t i = 0; i < sizeof DESK / sizeof *DESK; i++) {
        char text[40];
        snprintf(text, sizeof text, "%s=%g", DESK[i].name, on ? DESK[i].value : 0);
        settings_set(text);
    }
    return NULL;
}

const char *settings_set(char *text) {
    static char error[600];
    if (!strcmp(text, "desk=1") || !strcmp(text, "desk=0"))
        return set_desk(text[5] == '1');
    if (!strncmp(text, "desk=", 5))
        return "desk must be 0 or 1";
    char *separator = strchr(text, '='), *end;
    if (!separator)
        return "O: write name=number";
    *separator = 0;
    const double value = strtod(separator + 1, &end);
    for (size_t i = 0; i < SETTINGS_COUNT; i++) {
        const struct setting *s = &SETTINGS[i];
        size_t first, last;
        if (!is_named(s, text, &first, &last))
            continue;
        /* Written so that it also refuses what is not a number. */
        if (end == separator + 1 || *end || !(value >= s->least && value <= s->most)) {
            snprintf(error, sizeof error, "%s must be from %g to %g", s->name, s->least, s->most);
            return error;
        }
        skin_before_setting();
        while (first <= last)
            s->value[first++] = value;
        return NULL;
    }
    int at = snprintf(error, sizeof error, "no setting '%.40s': there are desk,", text);
    for (size_t i = 0; i < SETTINGS_COUNT; i++)
        at += snprintf(error + at, sizeof error - (size_t)at, "%s %s", i ? "," : "",
                       SETTINGS[i].name);
    return error;
}
