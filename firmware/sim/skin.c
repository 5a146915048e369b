/* SPDX-License-Identifier: GPL-3.0-or-later
 * Part of ohmskin's skinsim, a separate program that links libsimavr (GPL-3.0-or-later).
 */
/* The sense nodes' voltages, from the state of the address and drive pins and the skin's table. */
#include "skinsim.h"

#include <math.h>
#include <string.h>

/* The one table of pins. PINx, DDRx and PORTx follow each other in data space. Of all ports: the
 * pins that a board can use, without the sense pins, the crystal's and the reset pin. */
static const struct port UNO[] = {{0x25, 0x3F}, {0x28, 0x3C}, {0x2B, 0xFF}, {0, 0}};
static const struct port MEGA[] = {{0x22, 0xFF},  {0x25, 0xFF},  {0x28, 0xFF},  {0x2B, 0xFF},
                                   {0x2E, 0xFF},  {0x31, 0xFC},  {0x34, 0x3F},  {0x102, 0xFF},
                                   {0x105, 0xFF}, {0x108, 0xFF}, {0x10B, 0xFF}, {0, 0}};
static const struct board BOARDS[] = {
    /* rows PORTD4-7, columns PORTB0-3, drive PD2 and PD3 */
    {"uno", "atmega328p", 0x2B, 0x25, 0x2B, 4, 0, 2, 3, UNO, {0x2B, 1 << 1}},
    /* rows PORTA0-3, columns PORTC0-3, drive PL0 and PL1 */
    {"megaatmega2560", "atmega2560", 0x22, 0x28, 0x10B, 0, 0, 0, 1, MEGA, {0x2E, 1 << 1}},
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

const struct board *skin_find_board(const char *name) {
    for (size_t i = 0; i < sizeof BOARDS / sizeof *BOARDS; i++)
        if (!strcmp(name, BOARDS[i].name))
            return &BOARDS[i];
    return NULL;
}

static uint8_t configuration(unsigned node) {
    if (skin.undriven)
        return CONFIG_UNDRIVEN;
    if (skin.top_high == skin.bottom_high)
        return CONFIG_NO_CURRENT;
    if (skin.top_high)
        return node == NODE_TOP ? CONFIG_A : CONFIG_B;
    return node == NODE_BOTTOM ? CONFIG_C : CONFIG_D;
}

static double target(unsigned node) {
    const uint8_t config = configuration(node);
    if (config == CONFIG_UNDRIVEN)
        return 0.0;
    if (config == CONFIG_NO_CURRENT)
        return skin.top_high ? 1.0 : 0.0;
    return skin.ratio[skin.row][skin.column][config];
}

double skin_ratio(unsigned node, instant when) {
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

static void on_pins(instant when) {
    const struct board *b = skin.board;
    const uint8_t row = cpu->data[b->row_port] >> b->row_shift & 15;
    const uint8_t column = cpu->data[b->column_port] >> b->column_shift & 15;
    const uint8_t drive = cpu->data[b->drive_port];
    const bool top_high = drive >> b->drive_top_bit & 1,
               bottom_high = drive >> b->drive_bottom_bit & 1;
    const bool undriven =
        !is_output(b->row_port, (uint8_t)(15 << b->row_shift)) ||
        !is_output(b->column_port, (uint8_t)(15 << b->column_shift)) ||
        !is_output(b->drive_port, (uint8_t)(1 << b->drive_top_bit | 1 << b->drive_bottom_bit));
    if (row == skin.row && column == skin.column && top_high == skin.top_high &&
        bottom_high == skin.bottom_high && undriven == skin.undriven)
        return;
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
    for (const struct port *p = skin.board->ports; p->mask; p++)
        for (uint8_t left = p->mask & ~(cpu->data[p->port - 1] | cpu->data[p->port]); left;
             left >>= 1)
            count += left & 1;
    return count;
}

bool skin_tx_pin_is_high(void) {
    const struct port tx = skin.board->tx;
    return is_output(tx.port, tx.mask) && (cpu->data[tx.port] & tx.mask);
}

void skin_start(const struct board *board) {
    skin.board = board;
    skin.undriven = true;
    for (int r = 0; r < SKIN_ROWS; r++)
        for (int c = 0; c < SKIN_COLUMNS; c++) /* nothing connected: no current */
            memcpy(skin.ratio[r][c], (const double[]){1, 0, 1, 0}, sizeof skin.ratio[r][c]);
    const uint16_t ports[] = {board->row_port, board->column_port, board->drive_port};
    for (int i = 0; i < 3; i++) {
        if (i == 2 && (ports[2] == ports[0] || ports[2] == ports[1]))
            continue;
        for (uint16_t offset = 0; offset < 3; offset++) /* PINx too: writing it toggles PORTx */
            cpu_after_write(ports[i] - offset, offset == 2, on_pins);
    }
}

void skin_reset(void) { on_pins(cpu->cycle); }

void skin_set_table(const double *ratio) {
    memcpy(skin.ratio, ratio, sizeof skin.ratio);
    retarget(cpu->cycle);
}

void skin_before_setting(void) { retarget(cpu->cycle); }

struct skin_pins skin_pins(unsigned node) {
    return (struct skin_pins){skin.row, skin.column,
                              node < NODES ? configuration(node) : CONFIG_OTHER};
}
