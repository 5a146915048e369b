/* SPDX-License-Identifier: GPL-3.0-or-later
 * Part of ohmskin's skinsim, a separate program that links libsimavr (GPL-3.0-or-later).
 */
#include "skinsim.h"

#include <simavr/sim_cycle_timers.h>

static struct {
    instant due[EVENTS];
    event_handler handler[EVENTS];
    instant armed; /* when simavr will call us */
    bool in_callback;
} queue;

static enum event first(void) {
    enum event earliest = 0;
    for (enum event e = 1; e < EVENTS; e++)
        if (queue.due[e] < queue.due[earliest])
            earliest = e;
    return earliest;
}

static avr_cycle_count_t on_cycle_timer(avr_t *avr, avr_cycle_count_t when, void *param) {
    (void)when;
    (void)param;
    queue.in_callback = true;
    events_until(avr->cycle);
    queue.in_callback = false;
    queue.armed = queue.due[first()];
    return queue.armed == NEVER ? 0 : queue.armed;
}

static void arm(instant due) {
    queue.armed = due;
    avr_cycle_timer_register(cpu, due > cpu->cycle ? due - cpu->cycle : 0, on_cycle_timer, NULL);
}

void events_handle(enum event event, event_handler handler) {
    queue.handler[event] = handler;
    queue.due[event] = NEVER;
}

void events_set(enum event event, instant due) {
    queue.due[event] = due;
    if (due < queue.armed && !queue.in_callback)
        arm(due);
}

void events_until(instant when) {
    for (;;) {
        const enum event event = first();
        const instant due = queue.due[event];
        if (due > when)
            return;
        queue.due[event] = NEVER;
        queue.handler[event](due);
    }
}

/* simavr has just dropped its cycle timers. Events stay due: the line from the host does not stop
 * when the processor is reset; each model withdraws its own. */
void events_reset(void) {
    queue.armed = NEVER;
    const instant due = queue.due[first()];
    if (due != NEVER)
        arm(due);
}
