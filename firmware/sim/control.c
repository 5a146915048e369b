/* SPDX-License-Identifier: GPL-3.0-or-later
 * Part of ohmskin's skinsim, a separate program that links libsimavr (GPL-3.0-or-later).
 */
/* Requests and replies on two pipes: u8 op, u32 length, payload; little endian. See README.md.
 * Every length is checked; a stream that cannot be trusted any more ends the program. */
#include "skinsim.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "the pipe protocol and its payloads are copied as little endian"
#endif

enum {
    REQUEST_MAX = 4 << 20,
    ADMITTANCE_BYTES = SKIN_ENDS * SKIN_ENDS * sizeof(double),
    HAS_FAR = 0x80, /* in the count of rows */
    TABLE_BYTES = SKIN_ROWS * SKIN_COLUMNS * SKIN_CONFIGURATIONS * sizeof(double),
    SMALL_TABLE_BYTES = TABLE_BYTES / 4
};
static const uint64_t RUN_MAX = (uint64_t)CPU_HZ * 3600;

static int in, out;
static uint8_t payload[REQUEST_MAX];

static bool read_all(void *bytes, size_t count) {
    for (uint8_t *at = bytes; count;) {
        const ssize_t got = read(in, at, count);
        if (got < 0 && errno == EINTR)
            continue;
        if (got <= 0)
            return false;
        at += got;
        count -= (size_t)got;
    }
    return true;
}

static bool write_all(const void *bytes, size_t count) {
    for (const uint8_t *at = bytes; count;) {
        const ssize_t put = write(out, at, count);
        if (put < 0 && errno == EINTR)
            continue;
        if (put <= 0)
            return false;
        at += put;
        count -= (size_t)put;
    }
    return true;
}

bool control_reply(uint8_t op, const void *bytes, size_t length) {
    uint8_t header[5] = {op};
    const uint32_t length32 = (uint32_t)length;
    memcpy(header + 1, &length32, sizeof length32);
    return write_all(header, sizeof header) && write_all(bytes, length);
}

static bool refuse(const char *text) { return control_reply('!', text, strlen(text)); }

static bool reply_dead(void) {
    char text[80];
    snprintf(text, sizeof text, "cpu %s at pc 0x%05x, cycle %llu", cpu_state_name(),
             (unsigned)cpu->pc, (unsigned long long)cpu->cycle);
    return refuse(text);
}

/* Zero cycles only drain, and do so on a dead processor too. */
static bool run(uint64_t cycles) {
    if (cycles > RUN_MAX)
        return refuse("R: more than one hour");
    if (cycles && cpu_alive())
        cpu_run_until(cpu->cycle + cycles);
    if (cycles && !cpu_alive())
        return reply_dead();
    size_t count;
    const uint8_t *sent = uart_sent(&count);
    if (!control_reply('R', sent, count))
        return false;
    uart_drain(count);
    return true;
}

static bool set_table(size_t length) {
    static double ratio[TABLE_BYTES / sizeof(double)];
    memcpy(ratio, payload, length);
    for (size_t i = 0; i < length / sizeof *ratio; i++)
        if (!isfinite(ratio[i]))
            return refuse("T: a ratio is not finite");
    if (length == TABLE_BYTES)
        skin_set_table(SKIN_ROWS, SKIN_COLUMNS, ratio);
    else if (length == SMALL_TABLE_BYTES)
        skin_set_table(SKIN_ROWS / 2, SKIN_COLUMNS / 2, ratio);
    else
        return refuse("T: a table of 16 or of 32 rows and columns");
    return control_reply('T', NULL, 0);
}

static bool set_admittance(size_t length) {
    static double siemens[SKIN_ENDS * SKIN_ENDS];
    const size_t rows = payload[0] & ~HAS_FAR;
    const bool has_far = payload[0] & HAS_FAR;
    size_t ends = 0;
    while (1 + ends * ends * sizeof *siemens < length)
        ends++;
    const size_t lines = has_far ? ends / 2 : ends;
    if (1 + ends * ends * sizeof *siemens != length || (has_far && ends % 2) || rows > SKIN_ROWS ||
        lines < rows || lines - rows > SKIN_COLUMNS)
        return refuse("C: rows, then a square matrix of up to 32 rows and 32 columns");
    memcpy(siemens, payload + 1, length - 1);
    for (size_t i = 0; i < ends * ends; i++)
        if (!isfinite(siemens[i]))
            return refuse("C: an admittance is not finite");
    skin_set_admittance(rows, lines, has_far, siemens);
    return control_reply('C', NULL, 0);
}

static bool set_setting(size_t length) {
    payload[length] = 0;
    const char *error = settings_set((char *)payload);
    return error ? refuse(error) : control_reply('O', NULL, 0);
}

static bool set_baud(void) {
    uint32_t baud;
    memcpy(&baud, payload, sizeof baud);
    if (baud && (baud < 50 || baud > 2000000))
        return refuse("B: baud must be 0 or from 50 to 2000000");
    uart_set_host_baud(baud);
    return control_reply('B', NULL, 0);
}

static bool send_stats(void) {
    char *json = stats_json();
    if (!json)
        return refuse("S: out of memory");
    const bool ok = control_reply('S', json, strlen(json));
    free(json);
    return ok;
}

static bool hold_log(uint8_t action) {
    if (action > 2)
        return refuse("L: 0 off, 1 on, 2 drain");
    if (action < 2) {
        hold_log_enable(action);
        return control_reply('L', NULL, 0);
    }
    size_t bytes;
    const uint8_t *records = hold_log_records(&bytes);
    if (!control_reply('L', records, bytes))
        return false;
    hold_log_clear();
    return true;
}

static bool read_eeprom(void) {
    size_t size;
    const uint8_t *content = eeprom_content(&size);
    return control_reply('E', content, size);
}

static bool write_eeprom(size_t length) {
    size_t size;
    uint8_t *content = eeprom_content(&size);
    uint16_t offset;
    memcpy(&offset, payload, sizeof offset);
    const size_t count = length - sizeof offset;
    if (offset > size || count > size - offset)
        return refuse("e: beyond the end of the EEPROM");
    memcpy(content + offset, payload + sizeof offset, count);
    return control_reply('e', NULL, 0);
}

static bool serve(uint8_t op, size_t length, bool real_time) {
    static const struct {
        uint8_t op;
        uint32_t shortest, longest;
        bool lock_step_only;
    } OPS[] = {{'R', 8, 8, true},         {'W', 0, REQUEST_MAX, true},
               {'B', 4, 4, false},        {'T', SMALL_TABLE_BYTES, TABLE_BYTES, false},
               {'O', 1, 80, false},       {'C', 1, 1 + ADMITTANCE_BYTES, false},
               {'S', 0, 0, false},        {'Z', 0, 0, false},
               {'L', 1, 1, false},        {'E', 0, 0, false},
               {'e', 2, 2 + 4096, false}, {'X', 0, 0, false},
               {'J', 4, 4, false},        {'D', 3, 3, false}};
    size_t i = 0;
    while (i < sizeof OPS / sizeof *OPS && OPS[i].op != op)
        i++;
    if (i == sizeof OPS / sizeof *OPS)
        return refuse("unknown op");
    if (length < OPS[i].shortest || length > OPS[i].longest)
        return refuse("payload of the wrong length");
    if (real_time && OPS[i].lock_step_only)
        return refuse("this op needs lock-step, without --pty");
    uint64_t cycles;
    uint32_t address;
    switch (op) {
    case 'R':
        memcpy(&cycles, payload, sizeof cycles);
        return run(cycles);
    case 'W':
        return uart_host_write(payload, length) ? control_reply('W', NULL, 0)
                                                : refuse("W: the line's queue is full");
    case 'B':
        return set_baud();
    case 'T':
        return set_table(length);
    case 'C':
        return set_admittance(length);
    case 'O':
        return set_setting(length);
    case 'S':
        return send_stats();
    case 'Z':
        stats_reset();
        return control_reply('Z', NULL, 0);
    case 'L':
        return hold_log(payload[0]);
    case 'E':
        return read_eeprom();
    case 'e':
        return write_eeprom(length);
    case 'J':
        memcpy(&address, payload, sizeof address);
        return cpu_jump(address) ? control_reply('J', NULL, 0) : refuse("J: no such instruction");
    case 'D':
        return cpu_poke((uint16_t)(payload[0] | payload[1] << 8), payload[2])
                   ? control_reply('D', NULL, 0)
                   : refuse("D: no such register");
    default:
        cpu_external_reset();
        return control_reply('X', NULL, 0);
    }
}

void control_start(int in_fd, int out_fd) {
    in = in_fd;
    out = out_fd;
}

enum control_result control_serve_one(bool real_time) {
    uint8_t header[5];
    uint32_t length;
    if (!read_all(header, sizeof header))
        return CONTROL_END;
    memcpy(&length, header + 1, sizeof length);
    if (length > REQUEST_MAX) {
        refuse("request too long");
        return CONTROL_END;
    }
    if (!read_all(payload, length))
        return CONTROL_END;
    if (header[0] == 'Q') {
        control_reply('Q', NULL, 0);
        return CONTROL_END;
    }
    if (header[0] == 'G' && real_time && length == 0)
        return control_reply('G', NULL, 0) ? CONTROL_GO : CONTROL_END;
    return serve(header[0], length, real_time) ? CONTROL_OK : CONTROL_END;
}
