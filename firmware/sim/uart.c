/* SPDX-License-Identifier: GPL-3.0-or-later
 * Part of ohmskin's skinsim, a separate program that links libsimavr (GPL-3.0-or-later).
 */
/* USART0 as a UART, and the line to the host. simavr's own counts a parity bit that 8N1 lacks and
 * has no second transmit stage, no overrun and no framing errors.
 *
 * Not modelled: synchronous and multiprocessor modes, the ninth data bit, generation of parity
 * errors, the phase of the baud generator (a transmission starts when UDR is written).
 */
#include "skinsim.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include <simavr/avr_uart.h>
#include <simavr/sim_interrupts.h>

enum { UCSRA_ = 0xC0, UCSRB_ = 0xC1, UCSRC_ = 0xC2, UBRRL_ = 0xC4, UBRRH_ = 0xC5, UDR_ = 0xC6 };
enum {
    RXC_ = 0x80,
    TXC_ = 0x40,
    UDRE_ = 0x20,
    FE_ = 0x10,
    DOR_ = 0x08,
    UPE_ = 0x04,
    U2X_ = 0x02,
    MPCM_ = 0x01
};
enum { RXEN_ = 0x10, TXEN_ = 0x08, UCSZ2_ = 0x04, RXB8_ = 0x02 };
enum { GARBLED = 0xA5, SENT_MAX = 64 << 20, QUEUE_MAX = 16 << 20, HOST_BITS = 10 };

struct frame {
    uint8_t byte, errors;
};

static struct {
    avr_uart_t *stock; /* its interrupt vectors */
    /* transmitter */
    bool shifting, full;
    uint8_t shift_byte, buffer_byte;
    bool shift_garbled;
    /* receiver */
    struct frame fifo[2], shift;
    unsigned fifo_count;
    bool shift_full, frame_lost;
    bool receiving;
    uint8_t arriving;   /* the bits of a frame seen so far ... */
    unsigned bits_seen; /* ... of start, data and stop */
    double edge;        /* instant at which the frame's start bit began */
    /* line */
    uint32_t host_baud;
    bool on_line;
    uint8_t line_byte;
    double byte_start; /* instant at which its start bit began */
    double line_free;  /* instant at which the line can carry the next byte */
    double host_bit;   /* cycles, of the byte on the line */
    uint8_t *queue;
    size_t queue_head, queue_tail, queue_size;
    uint8_t *sent;
    size_t sent_count, sent_size;
} uart;

/* ---- line */

static unsigned device_bit_cycles(void) {
    const unsigned ubrr = (cpu->data[UBRRH_] & 15u) << 8 | cpu->data[UBRRL_];
    return (cpu->data[UCSRA_] & U2X_ ? 8 : 16) * (ubrr + 1);
}

static unsigned device_frame_bits(void) {
    const uint8_t c = cpu->data[UCSRC_];
    const unsigned data = cpu->data[UCSRB_] & UCSZ2_ ? 9 : 5 + (c >> 1 & 3);
    return 1 + data + (c >> 5 & 1) + 1 + (c >> 3 & 1);
}

static double host_bit_cycles(void) {
    return uart.host_baud ? (double)CPU_HZ / uart.host_baud : device_bit_cycles();
}

static bool rates_differ(double host_bit) {
    return fabs(host_bit / device_bit_cycles() - 1) > 0.04;
}

void uart_set_host_baud(uint32_t baud) { uart.host_baud = baud; }

static bool grow(uint8_t **bytes, size_t *size, size_t needed, size_t limit) {
    if (needed <= *size)
        return true;
    if (needed > limit)
        return false;
    size_t larger = *size ? *size : 4096;
    while (larger < needed)
        larger *= 2;
    uint8_t *moved = realloc(*bytes, larger);
    if (!moved)
        return false;
    *bytes = moved;
    *size = larger;
    return true;
}

static void to_host(uint8_t byte) {
    stats.tx_bytes++;
    if (grow(&uart.sent, &uart.sent_size, uart.sent_count + 1, SENT_MAX))
        uart.sent[uart.sent_count++] = byte;
    else
        stats.tx_undrained_lost++;
}

const uint8_t *uart_sent(size_t *count) {
    *count = uart.sent_count;
    return uart.sent;
}

void uart_drain(size_t count) {
    if (count < uart.sent_count)
        memmove(uart.sent, uart.sent + count, uart.sent_count - count);
    uart.sent_count -= count;
}

size_t uart_host_queue(void) { return uart.queue_tail - uart.queue_head; }

static void schedule_line(void) {
    if (uart.on_line || !uart_host_queue())
        return;
    if (uart.line_free < (double)cpu->cycle)
        uart.line_free = (double)cpu->cycle;
    events_set(EVENT_UART_LINE, (instant)ceil(uart.line_free));
}

bool uart_host_write(const uint8_t *bytes, size_t count) {
    if (!count)
        return true;
    const size_t waiting = uart_host_queue();
    if (uart.queue_head) {
        memmove(uart.queue, uart.queue + uart.queue_head, waiting);
        uart.queue_head = 0;
        uart.queue_tail = waiting;
    }
    if (!grow(&uart.queue, &uart.queue_size, waiting + count, QUEUE_MAX))
        return false;
    memcpy(uart.queue + waiting, bytes, count);
    uart.queue_tail += count;
    schedule_line();
    return true;
}

/* ---- interrupts */

void uart_level(void) {
    const uint8_t a = cpu->data[UCSRA_];
    cpu_level_interrupt(&uart.stock->rxc, a & RXC_);
    cpu_level_interrupt(&uart.stock->udrc, a & UDRE_);
}

/* ---- receiver */

static void show_fifo(void) {
    uint8_t a = cpu->data[UCSRA_] & (uint8_t)~(RXC_ | FE_ | DOR_ | UPE_);
    if (uart.fifo_count)
        a |= RXC_ | uart.fifo[0].errors;
    cpu->data[UCSRA_] = a;
    uart_level();
}

static void shift_to_fifo(void) {
    if (!uart.shift_full || uart.fifo_count == 2)
        return;
    uart.fifo[uart.fifo_count++] = uart.shift;
    uart.shift_full = false;
}

/* Level of the line: a start bit, eight bits, the lowest first, a stop bit. */
static bool line_high(double when) {
    const double bit = floor((when - uart.byte_start) / uart.host_bit);
    return !uart.on_line || bit < 0 || bit > HOST_BITS - 2 ||
           (bit > 0 && uart.line_byte >> ((unsigned)bit - 1) & 1);
}

/* The receiver looks at the middle of each of its own bits after a falling edge. The start bit of
 * a byte that finds both the FIFO and the shift register full costs the byte in the shift register;
 * DOR shows with the next one that survives. */
static void start_frame(double edge) {
    if (uart.shift_full) {
        uart.shift_full = false;
        uart.frame_lost = true;
        stats.rx_overruns++;
    }
    uart.receiving = true;
    uart.edge = edge;
    uart.bits_seen = 0;
    uart.arriving = 0;
    events_set(EVENT_UART_RX, (instant)ceil(edge + 0.5 * device_bit_cycles()));
}

/* A receiver that is free takes the next falling edge for a start bit, wherever in the byte that is
 * on the line it lies. */
static void seek_edge(double when) {
    for (unsigned bit = 0; uart.on_line && bit < HOST_BITS - 1; bit++) {
        const double edge = uart.byte_start + bit * uart.host_bit, half = 0.5 * uart.host_bit;
        if (edge >= when && !line_high(edge + half) && (!bit || line_high(edge - half))) {
            start_frame(edge);
            return;
        }
    }
}

static void on_line(instant due) {
    (void)due;
    uart.on_line = uart_host_queue() > 0;
    if (!uart.on_line)
        return;
    uart.line_byte = uart.queue[uart.queue_head++];
    uart.host_bit = host_bit_cycles();
    uart.byte_start = uart.line_free;
    uart.line_free += HOST_BITS * uart.host_bit;
    events_set(EVENT_UART_LINE, (instant)ceil(uart.line_free));
    if (!(cpu->data[UCSRB_] & RXEN_)) {
        stats.rx_bytes++;
        stats.rx_ignored++;
    } else if (!uart.receiving) {
        start_frame(uart.byte_start);
    }
}

static void end_frame(bool stop_bit) {
    stats.rx_bytes++;
    uart.shift = (struct frame){.byte = uart.arriving};
    if (!stop_bit) {
        uart.shift.errors |= FE_;
        stats.rx_framing_errors++;
    }
    if (uart.frame_lost)
        uart.shift.errors |= DOR_;
    uart.frame_lost = false;
    uart.shift_full = true;
    shift_to_fifo();
    show_fifo();
}

static void on_sample(instant due) {
    (void)due;
    const double bit = device_bit_cycles(), when = uart.edge + (uart.bits_seen + 0.5) * bit;
    const bool high = line_high(when);
    if (uart.bits_seen == HOST_BITS - 1)
        end_frame(high);
    else if (uart.bits_seen)
        uart.arriving |= (uint8_t)(high << (uart.bits_seen - 1));
    if (uart.bits_seen == HOST_BITS - 1 || (!uart.bits_seen && high)) {
        uart.receiving = false;
        seek_edge(when);
        return;
    }
    uart.bits_seen++;
    events_set(EVENT_UART_RX, (instant)ceil(when + bit));
}

static uint8_t read_udr(avr_t *avr, avr_io_addr_t address, void *param) {
    (void)avr, (void)address, (void)param;
    events_until(cpu_read_instant());
    const uint8_t byte = uart.fifo[0].byte;
    if (uart.fifo_count) {
        uart.fifo[0] = uart.fifo[1];
        uart.fifo_count--;
        shift_to_fifo();
        show_fifo();
    }
    return byte;
}

static void flush_receiver(void) {
    uart.fifo_count = 0;
    uart.receiving = false;
    events_set(EVENT_UART_RX, NEVER);
    uart.shift_full = uart.frame_lost = false;
    show_fifo();
}

/* ---- transmitter */

static void start_shifting(uint8_t byte, instant when) {
    uart.shifting = true;
    uart.shift_byte = byte;
    uart.shift_garbled = rates_differ(host_bit_cycles());
    events_set(EVENT_UART_TX, when + device_bit_cycles() * device_frame_bits());
}

static void on_transmitted(instant due) {
    to_host(uart.shift_garbled ? uart.shift_byte ^ GARBLED : uart.shift_byte);
    uart.shifting = false;
    if (uart.full) {
        uart.full = false;
        start_shifting(uart.buffer_byte, due);
        cpu->data[UCSRA_] |= UDRE_;
        uart_level();
    } else {
        avr_raise_interrupt(cpu, &uart.stock->txc);
    }
}

static void write_udr(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    (void)address, (void)param;
    const instant when = cpu_write_instant();
    events_until(when);
    if (!(avr->data[UCSRB_] & TXEN_) || uart.full) {
        stats.tx_ignored++;
        return;
    }
    if (!uart.shifting) {
        start_shifting(value, when);
        return;
    }
    uart.full = true;
    uart.buffer_byte = value;
    avr->data[UCSRA_] &= (uint8_t)~UDRE_;
    uart_level();
}

/* ---- registers */

static void write_ucsra(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    (void)param;
    events_until(cpu_write_instant());
    if (value & TXC_)
        cpu_clear_interrupt(&uart.stock->txc);
    avr->data[address] = (avr->data[address] & (uint8_t)~(U2X_ | MPCM_)) | (value & (U2X_ | MPCM_));
}

static void write_ucsrb(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    (void)param;
    const instant when = cpu_write_instant();
    events_until(when);
    if ((avr->data[address] & ~value & TXEN_) && !skin_tx_pin_is_high())
        stats.tx_let_go++;
    const bool was_on = avr->data[address] & RXEN_;
    avr->data[address] = value & (uint8_t)~RXB8_;
    if (!(value & RXEN_))
        flush_receiver();
    else if (!was_on)
        seek_edge((double)when);
    cpu_retry_interrupt(&uart.stock->txc);
    uart_level();
}

static void write_setting(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    (void)param;
    events_until(cpu_write_instant());
    avr->data[address] = value;
}

static uint8_t read_status(avr_t *avr, avr_io_addr_t address, void *param) {
    (void)param;
    events_until(cpu_read_instant());
    return avr->data[address];
}

void uart_start(void) {
    uart.stock = cpu_find_io("uart", '0');
    uart.stock->io.reset = NULL;
    events_handle(EVENT_UART_TX, on_transmitted);
    events_handle(EVENT_UART_LINE, on_line);
    events_handle(EVENT_UART_RX, on_sample);
    cpu_on_write(UDR_, write_udr, NULL);
    cpu_on_read(UDR_, read_udr, NULL);
    cpu_on_write(UCSRA_, write_ucsra, NULL);
    cpu_on_read(UCSRA_, read_status, NULL);
    cpu_on_write(UCSRB_, write_ucsrb, NULL);
    cpu_on_write(UCSRC_, write_setting, NULL);
    cpu_on_write(UBRRL_, write_setting, NULL);
    cpu_on_write(UBRRH_, write_setting, NULL);
}

/* A byte being sent is cut off; the line from the host goes on, and finds RXEN off. */
void uart_reset(void) {
    cpu->data[UCSRA_] = UDRE_;
    cpu->data[UCSRC_] = 0x06; /* 8N1 */
    uart.shifting = uart.full = false;
    events_set(EVENT_UART_TX, NEVER);
    flush_receiver();
}
