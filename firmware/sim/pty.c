/* SPDX-License-Identifier: GPL-3.0-or-later
 * Part of ohmskin's skinsim, a separate program that links libsimavr (GPL-3.0-or-later).
 */
/* Real time: the UART on a pseudo-terminal, the processor in slices of 1 ms of CLOCK_MONOTONIC. */
#define _GNU_SOURCE /* ppoll, cfmakeraw */
#include "skinsim.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

enum {
    SLICE_NS = 1000000,
    SLICE_CYCLES = CPU_HZ / 1000,
    LATE_NS = 100000000,
    HOST_QUEUE_MAX = 4096
};

static int64_t now_ns(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

/* The slave side stays open here, so that a reader may come and go. */
static int open_pty(char *path, size_t path_size) {
    const int master = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (master < 0 || grantpt(master) || unlockpt(master) || ptsname_r(master, path, path_size))
        return -1;
    const int slave = open(path, O_RDWR | O_NOCTTY | O_CLOEXEC);
    struct termios raw;
    if (slave < 0 || tcgetattr(slave, &raw))
        return -1;
    cfmakeraw(&raw);
    return tcsetattr(slave, TCSANOW, &raw) ? -1 : master;
}

/* The host's end of the line has the speed that a program gave the terminal; 0, which follows the
 * device, if it is none of the firmware's. */
static uint32_t line_baud(int master) {
    struct termios now;
    if (tcgetattr(master, &now))
        return 0;
    switch (cfgetospeed(&now)) {
    case B500000:
        return 500000;
    case B1000000:
        return 1000000;
    default:
        return 0;
    }
}

/* What the terminal does not take now is lost, as with a host that does not read. */
static void device_to_pty(int master) {
    size_t count;
    const uint8_t *sent = uart_sent(&count);
    if (!count)
        return;
    const ssize_t put = write(master, sent, count);
    stats.pty_dropped += count - (put > 0 ? (size_t)put : 0);
    uart_drain(count);
}

static void pty_to_device(int master) {
    uint8_t bytes[1024];
    const ssize_t got = read(master, bytes, sizeof bytes);
    if (got > 0 && !uart_host_write(bytes, (size_t)got))
        stats.pty_dropped += (uint64_t)got;
}

int pty_run(void) {
    char path[128];
    const int master = open_pty(path, sizeof path);
    if (master < 0) {
        fprintf(stderr, "skinsim: no pseudo-terminal: %s\n", strerror(errno));
        return 1;
    }
    if (!control_reply('P', path, strlen(path)))
        return 0;
    /* Opening the terminal throws away what it holds: the board waits until that is done. */
    enum control_result said;
    while ((said = control_serve_one(true)) != CONTROL_GO)
        if (said == CONTROL_END)
            return 0;
    if (cpu_has_boot_loader()) /* DTR has been pulled as the port was opened */
        cpu_external_reset();
    int64_t due = now_ns();
    for (;;) {
        const int64_t wait = due - now_ns();
        const struct timespec timeout = {.tv_sec = 0, .tv_nsec = wait > 0 ? wait : 0};
        struct pollfd fds[] = {
            {.fd = STDIN_FILENO, .events = POLLIN},
            {.fd = uart_host_queue() < HOST_QUEUE_MAX ? master : -1, .events = POLLIN}};
        if (ppoll(fds, 2, &timeout, NULL) > 0) {
            if (fds[0].revents && control_serve_one(true) == CONTROL_END)
                return 0;
            if (fds[1].revents & POLLIN)
                pty_to_device(master);
        }
        const int64_t now = now_ns();
        if (now < due)
            continue;
        if (now - due >
            LATE_NS) { /* the machine cannot follow: time is dropped, not caught up in a burst */
            stats.late_slices += (uint64_t)((now - due) / SLICE_NS);
            due = now;
        }
        due += SLICE_NS;
        uart_set_host_baud(line_baud(master));
        if (cpu_alive())
            cpu_run_until(cpu->cycle + SLICE_CYCLES);
        device_to_pty(master);
    }
}
