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
} SETTINGS[] = {
    {"tau_us", &settings.tau_us, 0, 1e9},
    {"sample_pf", &settings.sample_pf, 0, 1e6},
    {"input_ohm", &settings.input_ohm, 0, 1e6},
    {"node_pf", &settings.node_pf, 0, 1e6},
    {"line_pf", &settings.line_pf, 0, 1e6},
    {"cell_pf", &settings.cell_pf, 0, 1e6},
    {"late_cycles", &settings.late_cycles, 0, 1000},
    {"seed", &settings.seed, 0, 4294967295.0},
};
enum { SETTINGS_COUNT = sizeof SETTINGS / sizeof *SETTINGS };

const char *settings_set(char *text) {
    static char error[600];
    char *separator = strchr(text, '='), *end;
    if (!separator)
        return "O: write name=number";
    *separator = 0;
    const double value = strtod(separator + 1, &end);
    for (size_t i = 0; i < SETTINGS_COUNT; i++) {
        const struct setting *s = &SETTINGS[i];
        if (strcmp(s->name, text))
            continue;
        /* Written so that it also refuses what is not a number. */
        if (end == separator + 1 || *end || !(value >= s->least && value <= s->most)) {
            snprintf(error, sizeof error, "%s must be from %g to %g", s->name, s->least, s->most);
            return error;
        }
        skin_before_setting();
        *s->value = value;
        return NULL;
    }
    int at = snprintf(error, sizeof error, "no setting '%.40s': there are", text);
    for (size_t i = 0; i < SETTINGS_COUNT; i++)
        at += snprintf(error + at, sizeof error - (size_t)at, "%s %s", i ? "," : "",
                       SETTINGS[i].name);
    return error;
}
