/* SPDX-License-Identifier: GPL-3.0-or-later
 * Part of ohmskin's skinsim, a separate program that links libsimavr (GPL-3.0-or-later).
 */
/* The sense nodes' voltages, from the state of the address and drive pins and the skin's table. */
#include "skinsim.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* Of Debian's arduino-core-avr. */
#define LOADERS "/usr/share/arduino/hardware/arduino/avr/bootloaders/"

/* A reference resistor of docs/build.md. */
#define REF_OHM 30e3

/* The one table of pins. PINx, DDRx and PORTx follow each other in data space. Of all ports: the
 * pins that a board can use, without the crystal's and the reset pin. */
static const struct port UNO[] = {{0x25, 0x3F}, {0x28, 0x3F}, {0x2B, 0xFF}, {0, 0}};
static const struct port MEGA[] = {{0x22, 0xFF},  {0x25, 0xFF},  {0x28, 0xFF},  {0x2B, 0xFF},
                                   {0x2E, 0xFF},  {0x31, 0xFF},  {0x34, 0x3F},  {0x102, 0xFF},
                                   {0x105, 0xFF}, {0x108, 0xFF}, {0x10B, 0xFF}, {0, 0}};
static const struct board BOARDS[] = {
    /* rows PORTD4-7, columns PORTB0-3, drive PD2 and PD3 */
    {.name = "uno",
     .mcu = "atmega328p",
     .wiring = {{{0x2B, 4},
                 {0x2B, 5},
                 {0x2B, 6},
                 {0x2B, 7},
                 {0x25, 0},
                 {0x25, 1},
                 {0x25, 2},
                 {0x25, 3},
                 {0x2B, 2},
                 {0x2B, 3}},
                {0, 1, 2, 3},
                ADDRESS_PINS,
                {REF_OHM, REF_OHM},
                false},
     .arduino_pins = "D0D1D2D3D4D5D6D7B0B1B2B3B4B5C0C1C2C3C4C5",
     .ports = UNO,
     .analog_port = 0x28,
     .tx = {0x2B, 1 << 1},
     .loader = LOADERS "optiboot/optiboot_atmega328.hex"},
    /* rows PORTA0-3, columns PORTC0-3, drive PL0 and PL1 */
    {.name = "megaatmega2560",
     .mcu = "atmega2560",
     .wiring = {{{0x22, 0},
                 {0x22, 1},
                 {0x22, 2},
                 {0x22, 3},
                 {0x28, 0},
                 {0x28, 1},
                 {0x28, 2},
                 {0x28, 3},
                 {0x10B, 0},
                 {0x10B, 1}},
                {0, 1, 2, 3},
                ADDRESS_PINS,
                {REF_OHM, REF_OHM},
                false},
     .arduino_pins = "E0E1E4E5G5E3H3H4H5H6B4B5B6B7J1J0H1H0D3D2D1D0A0A1A2A3A4A5A6A7"
                     "C7C6C5C4C3C2C1C0D7G2G1G0L7L6L5L4L3L2L1L0B3B2B1B0"
                     "F0F1F2F3F4F5F6F7K0K1K2K3K4K5K6K7",
     .ports = MEGA,
     .analog_port = 0x31,
     .tx = {0x2E, 1 << 1},
     .loader = LOADERS "stk500v2/stk500boot_v2_mega2560.hex"},
};

struct node {
    double start, target; /* V/Vdd at `since`, and where it is heading */
    instant since;
};

static struct {
    const struct board *board;
    double ratio[SKIN_ROWS][SKIN_COLUMNS][SKIN_CONFIGURATIONS];
    uint8_t row, column;
    bool top_high, bottom_high, undriven;
    struct node node[NODES];
} skin;

/* With any capacitance set, the nodes are part of a circuit, and its voltages are kept here: of
 * the lines' near ends (rows first), their far ends, the nodes and the sample capacitor. */
enum { SAMPLE = SKIN_ENDS + NODES, STATES };
enum { MATRICES = CONFIG_OTHER };
#define MUX_OHM 1.0
/* Where nothing else is: it settles in 0.3 ns. */
#define STRAY_PF 0.01

static struct {
    double siemens[SKIN_ENDS][SKIN_ENDS];
    bool has_far;        /* else a line's capacitance is all at its near end */
    double volt[STATES]; /* V/Vdd ... */
    instant since;       /* ... then */
    unsigned connected;  /* node at the sample capacitor */
    struct modes *modes[SKIN_ROWS][SKIN_COLUMNS][MATRICES][NODES + 1];
} circuit;

const struct board *skin_find_board(const char *name) {
    for (size_t i = 0; i < sizeof BOARDS / sizeof *BOARDS; i++)
        if (!strcmp(name, BOARDS[i].name))
            return &BOARDS[i];
    return NULL;
}

const struct wiring *skin_wiring(void) { return &skin.board->wiring; }

unsigned skin_node_at(unsigned channel) {
    for (unsigned node = 0; node < NODES; node++)
        if (skin.board->wiring.channels[node] == channel)
            return node;
    return NODES;
}

static uint8_t configuration(unsigned node) {
    static const char NAMES[2][NODES + 1] = {"dchg", "abef"}; /* by top_high */
    if (skin.undriven)
        return CONFIG_UNDRIVEN;
    if (skin.top_high == skin.bottom_high)
        return CONFIG_NO_CURRENT;
    return (uint8_t)(NAMES[skin.top_high][node] - 'a');
}

static double target(unsigned node) {
    const uint8_t config = configuration(node);
    if (config == CONFIG_UNDRIVEN)
        return 0.0;
    if (config == CONFIG_NO_CURRENT)
        return skin.top_high ? 1.0 : 0.0;
    return skin.ratio[skin.row][skin.column][config];
}

static bool is_circuit(void) {
    return settings.line_pf > 0 || settings.node_pf > 0 || settings.sample_pf > 0;
}

static double ref_ohm(unsigned node) { return skin.board->wiring.ref_ohm[node % DRIVEN_NODES]; }

/* Whether a node's own drive pin is high; a far node has that of its line's near end. */
static bool is_high(unsigned node) {
    return node % DRIVEN_NODES == NODE_TOP ? skin.top_high : skin.bottom_high;
}

/* Without lines, each node hangs on a source with the table's voltage. Of the reference resistor R
 * and the skin behind it, R (1 - R I) is the parallel, and 1 - R I is A, C, 1 - B or 1 - D. What
 * the wires add to a far end is left out. A node at a rail is not nearer to it than this. */
#define LEAST_SHARE 0.01
static double source_ohm(unsigned node) {
    const double share = is_high(node) ? target(node) : 1 - target(node);
    return ref_ohm(node) * fmin(1, fmax(LEAST_SHARE, share));
}

/* The states of the circuit: lines that carry something, if lines have a capacitance, and the rest.
 */
static size_t list_states(size_t states[STATES]) {
    size_t n = 0;
    for (size_t i = 0; i < STATES; i++)
        if (i >= SKIN_ENDS || (settings.line_pf > 0 && circuit.siemens[i][i] > 0))
            states[n++] = i;
    return n;
}

static void join(double a[STATES][STATES], size_t i, size_t j, double value) {
    a[i][i] += value;
    a[j][j] += value;
    a[i][j] -= value;
    a[j][i] -= value;
}

static struct modes *make_modes(size_t n, const size_t states[n]) {
    static double farad[STATES][STATES], siemens[STATES][STATES];
    memset(farad, 0, sizeof farad);
    memset(siemens, 0, sizeof siemens);
    const size_t of_node[NODES] = {skin.row, SKIN_ROWS + skin.column, SKIN_LINES + skin.row,
                                   SKIN_LINES + SKIN_ROWS + skin.column};
    for (unsigned node = 0; node < NODES; node++) {
        const size_t at = SKIN_ENDS + node, line = of_node[node];
        farad[at][at] = 1e-12 * fmax(settings.node_pf, STRAY_PF);
        if (settings.line_pf <= 0)
            siemens[at][at] = 1 / source_ohm(node);
        else if (!skin.undriven && node < DRIVEN_NODES)
            siemens[at][at] = 1 / ref_ohm(node);
        const bool is_joined = node < DRIVEN_NODES || settings.far_open < 0.5;
        if (is_joined && settings.line_pf > 0 && circuit.siemens[line][line] > 0)
            join(siemens, at, line, 1 / MUX_OHM);
    }
    farad[SAMPLE][SAMPLE] = 1e-12 * fmax(settings.sample_pf, STRAY_PF);
    if (circuit.connected < NODES && settings.sample_pf > 0)
        join(siemens, SAMPLE, SKIN_ENDS + circuit.connected, 1 / fmax(settings.input_ohm, 1));
    const double at_end = circuit.has_far ? 0.5e-12 : 1e-12;
    double c[n][n], g[n][n];
    for (size_t i = 0; i < n; i++) {
        const size_t line = states[i];
        if (line >= SKIN_ENDS)
            continue;
        farad[line][line] += at_end * settings.line_pf;
        for (size_t j = 0; j < i; j++) /* a row and a column cross, at their ends of one side */
            if (line % SKIN_LINES >= SKIN_ROWS && states[j] % SKIN_LINES < SKIN_ROWS &&
                line / SKIN_LINES == states[j] / SKIN_LINES)
                join(farad, line, states[j], at_end * settings.cell_pf);
        for (size_t j = 0; j < SKIN_ENDS; j++)
            siemens[line][j] += circuit.siemens[line][j];
    }
    for (size_t i = 0; i < n; i++)
        for (size_t j = 0; j < n; j++) {
            c[i][j] = farad[states[i]][states[j]];
            g[i][j] = siemens[states[i]][states[j]];
        }
    return modes_make(n, *c, *g);
}

static void forget_modes(void) {
    struct modes **all = &circuit.modes[0][0][0][0];
    for (size_t i = 0; i < sizeof circuit.modes / sizeof *all; i++) {
        free(all[i]);
        all[i] = NULL;
    }
}

/* Brings the circuit's voltages to `when`, before anything about it changes. */
static void advance(instant when) {
    if (!is_circuit() || when <= circuit.since)
        return;
    size_t states[STATES];
    const size_t n = list_states(states);
    /* With lines, what drives the circuit is no part of its matrix. */
    const unsigned matrix = settings.line_pf > 0 ? skin.undriven : configuration(NODE_TOP);
    struct modes **modes = &circuit.modes[skin.row][skin.column][matrix][circuit.connected];
    if (!*modes)
        *modes = make_modes(n, states);
    double volt[n], ampere[n];
    for (size_t i = 0; i < n; i++) {
        volt[i] = circuit.volt[states[i]];
        ampere[i] = 0;
    }
    for (unsigned node = 0; node < NODES; node++) {
        const bool driven = node < DRIVEN_NODES && !skin.undriven;
        ampere[n - 1 - NODES + node] = settings.line_pf <= 0 ? target(node) / source_ohm(node)
                                       : driven              ? is_high(node) / ref_ohm(node)
                                                             : 0;
    }
    modes_advance(*modes, ampere, (double)(when - circuit.since) / CPU_HZ, volt);
    for (size_t i = 0; i < n; i++)
        circuit.volt[states[i]] = volt[i];
    circuit.since = when;
}

void skin_connect(unsigned node, instant when) {
    advance(when);
    circuit.connected = node < NODES ? node : NODES;
}

static size_t end_of(size_t i, size_t rows, size_t lines) {
    const size_t line = i % lines, far = i / lines;
    return far * SKIN_LINES + (line < rows ? line : SKIN_ROWS + line - rows);
}

void skin_set_admittance(size_t rows, size_t lines, bool has_far, const double *siemens) {
    const size_t ends = has_far ? 2 * lines : lines;
    advance(cpu->cycle);
    memset(circuit.siemens, 0, sizeof circuit.siemens);
    circuit.has_far = has_far;
    for (size_t i = 0; i < ends; i++)
        for (size_t j = 0; j < ends; j++)
            circuit.siemens[end_of(i, rows, lines)][end_of(j, rows, lines)] = *siemens++;
    forget_modes();
}

double skin_ratio(unsigned node, instant when) {
    if (is_circuit()) {
        advance(when);
        const bool sampled = settings.sample_pf > 0 && circuit.connected == node;
        return circuit.volt[sampled ? SAMPLE : SKIN_ENDS + node];
    }
    const struct node *n = &skin.node[node];
    const double tau_cycles = settings.tau_us * (CPU_HZ / 1e6);
    if (tau_cycles <= 0 || when < n->since)
        return n->target;
    return n->target + (n->start - n->target) * exp(-(double)(when - n->since) / tau_cycles);
}

/* From `when` on each node heads for the value that pins and table now give it. */
static void retarget(instant when) {
    for (unsigned i = 0; i < NODES; i++) {
        const double now = skin_ratio(i, when);
        skin.node[i] = (struct node){.start = now, .target = target(i), .since = when};
    }
}

static bool is_output(uint16_t port, uint8_t mask) { return (cpu->data[port - 1] & mask) == mask; }

/* What some of the pins show, the first one bit 0. */
static uint8_t number_at(unsigned first, unsigned count) {
    uint8_t number = 0;
    for (unsigned i = 0; i < count; i++) {
        const struct pin pin = skin.board->wiring.pins[first + i];
        number |= (uint8_t)((cpu->data[pin.port] >> pin.bit & 1) << i);
    }
    return number;
}

static void on_pins(instant when) {
    const unsigned n = skin.board->wiring.address_pins, pins = 2 * n + 2;
    const uint8_t row = number_at(0, n), column = number_at(n, n);
    const bool top_high = number_at(2 * n, 1), bottom_high = number_at(2 * n + 1, 1);
    bool undriven = false;
    for (unsigned i = 0; i < pins; i++) {
        const struct pin pin = skin.board->wiring.pins[i];
        undriven |= !is_output(pin.port, (uint8_t)(1 << pin.bit));
    }
    if (row == skin.row && column == skin.column && top_high == skin.top_high &&
        bottom_high == skin.bottom_high && undriven == skin.undriven)
        return;
    advance(when);
    skin.row = row;
    skin.column = column;
    skin.top_high = top_high;
    skin.bottom_high = bottom_high;
    skin.undriven = undriven;
    retarget(when);
    stats_pins_changed(when);
}

unsigned skin_floating_pins(void) {
    unsigned count = 0;
    uint8_t sensing = 0;
    for (unsigned node = 0; node < NODES; node++)
        sensing |= (uint8_t)(1 << skin.board->wiring.channels[node]);
    for (const struct port *p = skin.board->ports; p->mask; p++) {
        uint8_t left = p->mask & ~(cpu->data[p->port - 1] | cpu->data[p->port]);
        if (p->port == skin.board->analog_port)
            left &= (uint8_t)~sensing;
        for (; left; left >>= 1)
            count += left & 1;
    }
    return count;
}

bool skin_tx_pin_is_high(void) {
    const struct port tx = skin.board->tx;
    return is_output(tx.port, tx.mask) && (cpu->data[tx.port] & tx.mask);
}

/* No cell carries a current. */
static void connect_nothing(void) {
    for (int r = 0; r < SKIN_ROWS; r++)
        for (int c = 0; c < SKIN_COLUMNS; c++)
            memcpy(skin.ratio[r][c], (const double[]){1, 0, 1, 0, 1, 0, 1, 0},
                   sizeof skin.ratio[r][c]);
}

void skin_start(const struct board *board) {
    skin.board = board;
    skin.undriven = true;
    connect_nothing();
    for (unsigned i = 0; i < 2u * board->wiring.address_pins + 2; i++) {
        const uint16_t port = board->wiring.pins[i].port;
        bool hooked = false;
        for (unsigned j = 0; j < i; j++)
            hooked |= board->wiring.pins[j].port == port;
        for (uint16_t offset = 0; offset < 3 && !hooked; offset++) /* PINx too: it toggles PORTx */
            cpu_after_write(port - offset, offset == 2, on_pins);
    }
}

void skin_reset(void) { on_pins(cpu->cycle); }

void skin_set_table(size_t rows, size_t columns, const double *ratio) {
    advance(cpu->cycle);
    forget_modes();
    connect_nothing();
    for (size_t r = 0; r < rows; r++, ratio += columns * SKIN_CONFIGURATIONS)
        memcpy(skin.ratio[r], ratio, columns * sizeof skin.ratio[r][0]);
    retarget(cpu->cycle);
}

void skin_before_setting(void) {
    retarget(cpu->cycle);
    forget_modes();
    if (is_circuit())
        return;
    circuit.since = cpu->cycle; /* it may become one, and begins with these voltages */
    for (unsigned i = 0; i < NODES; i++)
        circuit.volt[SKIN_ENDS + i] = skin.node[i].start;
}

struct skin_pins skin_pins(unsigned node) {
    return (struct skin_pins){skin.row, skin.column,
                              node < NODES ? configuration(node) : CONFIG_OTHER};
}
