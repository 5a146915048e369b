/* SPDX-License-Identifier: GPL-3.0-or-later
 * Part of ohmskin's skinsim, a separate program that links libsimavr (GPL-3.0-or-later).
 */
/* What the parts of skinsim know of each other. One process simulates one board, so each part
 * keeps its state to itself, in one static struct.
 *
 * Time: an `instant` counts CPU cycles since power-on and never goes back, whatever is reset.
 */
#ifndef SKINSIM_H
#define SKINSIM_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <simavr/sim_avr.h>

#define CPU_HZ 16000000u
#define NEVER UINT64_MAX

typedef uint64_t instant;

/* ---- cpu.c: the core, register hooks, resets */

extern avr_t *cpu;
struct board;
/* Loads the program, starts every part below and powers the board on. Says on stderr why not.
 * A boot loader (an Intel hex file; NULL or "": none) lies beside the program and runs after each
 * reset. */
bool cpu_start(const struct board *board, const char *elf_path, const char *loader_path);
/* Runs to the first instruction boundary at or after `target`, or to a crash or a final sleep. */
void cpu_run_until(instant target);
bool cpu_alive(void);
bool cpu_has_boot_loader(void);
const char *cpu_state_name(void);
void cpu_external_reset(void);
/* False, and nothing happens, where `address` is no instruction of this chip's flash. */
bool cpu_jump(uint32_t address);
/* What a boot loader leaves: r0 to r31, or MCUSR. False: `address` is none of these. */
bool cpu_poke(uint16_t address, uint8_t value);
/* When the register access being executed takes effect; only valid inside a register hook. */
instant cpu_write_instant(void);
instant cpu_read_instant(void);
/* The bits that the store being executed writes: SBI touches one bit alone in the hardware, while
 * simavr reads the register, sets the bit and writes all eight. */
uint8_t cpu_written_bits(uint8_t value);
/* These replace simavr's own hook of the register. */
void cpu_on_read(uint16_t address, avr_io_read_t hook, void *param);
void cpu_on_write(uint16_t address, avr_io_write_t hook, void *param);
/* Calls `after` when simavr's own write hook of this register has run. In a `strobe` register
 * writing ones does something and zeros do nothing. */
void cpu_after_write(uint16_t address, bool strobe, void (*after)(instant when));
void *cpu_find_io(const char *kind, char name);
void cpu_clear_interrupt(avr_int_vector_t *vector);
/* Level-triggered interrupt: pending for as long as `active`. */
void cpu_level_interrupt(avr_int_vector_t *vector, bool active);
/* Edge-triggered interrupt whose flag may have been set while it was disabled. */
void cpu_retry_interrupt(avr_int_vector_t *vector);

/* ---- events.c: one queue in exact order of time for everything that is modelled here */

enum event {
    EVENT_TIMER0,
    EVENT_TIMER1,
    EVENT_ADC,
    EVENT_UART_TX,
    EVENT_UART_LINE,
    EVENT_UART_RX,
    EVENT_EEPROM,
    EVENTS
};
typedef void (*event_handler)(instant due);
void events_handle(enum event event, event_handler handler);
void events_set(enum event event, instant due);
/* Runs everything due up to and including `when`. Each register hook calls it first. */
void events_until(instant when);
void events_reset(void);

/* ---- skin.c: pins and table to node voltages */

enum { SKIN_ROWS = 32, SKIN_COLUMNS = 32, SKIN_CONFIGURATIONS = 8 };
/* Sense nodes, by the converter's channel: those of the near ends, which are driven, and of the far
 * ends of the selected row and column. */
enum { NODE_TOP, NODE_BOTTOM, DRIVEN_NODES, NODE_FAR_TOP = DRIVEN_NODES, NODE_FAR_BOTTOM, NODES };
/* Configurations A to H as in the table, then what no table entry describes. */
enum { CONFIG_NO_CURRENT = SKIN_CONFIGURATIONS, CONFIG_UNDRIVEN, CONFIG_OTHER };

struct port {
    uint16_t port; /* data-space address of PORTx */
    uint8_t mask;
};
struct pin {
    uint16_t port; /* data-space address of PORTx */
    uint8_t bit;
};
/* Address pins of rows and as many of columns, and the drive pins, top first; the converter's
 * channels, by node; the reference resistors, top and bottom; whether the firmware has told it. */
enum { ADDRESS_PINS = 4, ADDRESS_PINS_MAX = 5, PINS_MAX = 2 * ADDRESS_PINS_MAX + 2 };
struct wiring {
    struct pin pins[PINS_MAX];
    uint8_t channels[NODES];
    uint8_t address_pins;
    double ref_ohm[DRIVEN_NODES];
    bool told;
};
struct board {
    const char *name, *mcu;
    struct wiring wiring;
    const char *arduino_pins; /* port and bit of each, by Arduino's numbers */
    const struct port *ports; /* to a mask of 0 */
    uint16_t analog_port;     /* channels 0 to 7 of the converter are its pins */
    struct port tx;
    const char *loader; /* with which it is sold */
};
const struct board *skin_find_board(const char *name);
const struct wiring *skin_wiring(void);
/* The node at a channel of the converter; NODES: none is. */
unsigned skin_node_at(unsigned channel);
void skin_start(const struct board *board);
void skin_reset(void);
/* Of so many rows and columns; the others carry no current. */
void skin_set_table(size_t rows, size_t columns, const double *ratio);
/* Settings are about to change: the voltages up to now follow from the old ones. */
void skin_before_setting(void);
/* What the converter sees of a node. */
double skin_ratio(unsigned node, instant when);
/* Inputs without a pull-up, besides the sense pins. */
unsigned skin_floating_pins(void);
/* What the line sees while the transmitter is off. */
bool skin_tx_pin_is_high(void);
/* The sample capacitor is joined to this node from now on; NODES: to none. */
void skin_connect(unsigned node, instant when);
enum { SKIN_LINES = SKIN_ROWS + SKIN_COLUMNS, SKIN_ENDS = 2 * SKIN_LINES };
/* Currents into the ends of the lines per potential of each [S]: near ends, rows first, and then
 * the far ends, if has_far; (ends, ends). */
void skin_set_admittance(size_t rows, size_t lines, bool has_far, const double *siemens);
struct skin_pins {
    uint8_t row, column, configuration;
};
struct skin_pins skin_pins(unsigned node);

/* ---- wiring.c: wirings other than the board's own. False: said on stderr why it is none. */

/* As the firmware tells it; where it does not, the wiring stays. */
bool wiring_of_firmware(const char *elf_path, struct board *board);
/* As in PD4,PD5,PD6,PD7,PB0,PB1,PB2,PB3,PD2,PD3,0,1,2,3: with four address pins each for rows and
 * columns, or with five. */
bool wiring_of_option(const char *text, struct wiring *wiring);

/* ---- network.c: C dv/dt = -G v + i */

struct modes;
/* Of n nodes with these capacitances and conductances, (n, n) each; free() it. */
struct modes *modes_make(size_t n, const double *farad, const double *siemens);
void modes_advance(const struct modes *modes, const double *ampere, double seconds, double *volt);

/* ---- settings.c: how far the board is from ideal; all zero at the start */

struct settings {
    double tau_us;
    double sample_pf, input_ohm, node_pf, line_pf, cell_pf;
    double late_cycles, half_code, far_open, track_late;
    /* of the converter, by ADPS, which gives the ADC clock */
    double offset_lsb[8], gain_lsb[8], inl_lsb[8], noise_lsb[8];
    double seed;
};
extern struct settings settings;
/* Takes "name=number" and overwrites it; NULL, or what is wrong with it. */
const char *settings_set(char *text);

/* ---- adc.c */

enum adc_trigger {
    ADC_TRIGGER_FREE = 0,
    ADC_TRIGGER_TIMER1_B = 5,
    ADC_TRIGGER_TIMER1_OVERFLOW = 6
};
void adc_start(void);
void adc_reset(void);
/* A rising edge of the flag that is this trigger source. */
void adc_trigger_edge(enum adc_trigger source, instant when);

/* ---- timer.c: timers 0 and 1 */

void timer_start(void);
void timer_reset(void);
bool timer1_flag(unsigned bit);

/* ---- uart.c */

void uart_start(void);
void uart_reset(void);
void uart_level(void);
void uart_set_host_baud(uint32_t baud); /* 0: whatever the device uses */
bool uart_host_write(const uint8_t *bytes, size_t count);
size_t uart_host_queue(void); /* bytes that the line has not carried yet */
/* Bytes the device has sent and nobody has drained. */
const uint8_t *uart_sent(size_t *count);
void uart_drain(size_t count);

/* ---- eeprom.c */

void eeprom_start(void);
void eeprom_reset(void);
void eeprom_level(void);
uint8_t *eeprom_content(size_t *size);

/* ---- stats.c: counters, hold log, idle marker */

enum { VECTORS = 64 };
struct load {
    uint64_t count, cycles, cycles_max;
};
struct gap {
    uint64_t count, cycles, min, max;
};
struct stats {
    uint64_t conversions, lost_results, undriven, reference_not_avcc, unmodelled_triggers,
        unmodelled_timer_modes;
    uint64_t tx_bytes, tx_ignored, tx_let_go, tx_undrained_lost, rx_bytes, rx_overruns, rx_ignored,
        rx_framing_errors;
    uint64_t pty_dropped, late_slices, hold_log_dropped;
    struct gap settle, channel_settle, after_hold, trigger;
    struct load interrupts, vector[VECTORS];
    uint64_t idle_cycles, passes;
};
extern struct stats stats;

void stats_start(void);
void stats_reset(void);
void stats_cpu_reset(void);
void stats_pins_changed(instant when);
void stats_channel_changed(instant when);
void stats_hold(instant when, unsigned channel, uint16_t code);
void stats_conversion_started(instant when);
void stats_interrupt_entered(uint8_t vector, instant when);
void stats_interrupt_left(uint8_t vector, instant when);
char *stats_json(void); /* the caller frees it */

void hold_log_enable(bool enable);
const uint8_t *hold_log_records(size_t *bytes);
void hold_log_clear(void);

/* ---- control.c and pty.c: the outside world */

enum control_result { CONTROL_OK, CONTROL_GO, CONTROL_END };
void control_start(int in_fd, int out_fd);
enum control_result control_serve_one(bool real_time);
bool control_reply(uint8_t op, const void *payload, size_t length);
int pty_run(void);

#endif
