/* SPDX-License-Identifier: GPL-3.0-or-later
 * Part of ohmskin's skinsim, a separate program that links libsimavr (GPL-3.0-or-later).
 */
/* EEPROM with its programming time; simavr's own writes at once. The content is simavr's array,
 * so that the ELF's .eeprom section is there and a reset keeps it. */
#include "skinsim.h"

#include <simavr/avr_eeprom.h>
#include <simavr/sim_interrupts.h>

enum { EECR_ = 0x3F, EEDR_ = 0x40, EEARL_ = 0x41, EEARH_ = 0x42 };
enum { EERE_ = 0x01, EEPE_ = 0x02, EEMPE_ = 0x04, EERIE_ = 0x08, EEPM_ = 0x30 };

static struct {
    avr_eeprom_t *stock;
    instant master_until; /* EEMPE is set until then */
} eeprom;

static uint8_t *addressed_byte(void) {
    const unsigned address = cpu->data[EEARL_] | cpu->data[EEARH_] << 8;
    return &eeprom.stock->eeprom[address % eeprom.stock->size];
}

void eeprom_level(void) { cpu_level_interrupt(&eeprom.stock->ready, !(cpu->data[EECR_] & EEPE_)); }

static void on_written(instant due) {
    (void)due;
    cpu->data[EECR_] &= (uint8_t)~EEPE_;
    eeprom_level();
}

static void program(instant when) {
    const uint8_t mode = (cpu->data[EECR_] & EEPM_) >> 4, value = cpu->data[EEDR_];
    uint8_t *byte = addressed_byte();
    switch (mode) {
    case 1:
        *byte = 0xFF;
        break; /* erase only */
    case 2:
        *byte &= value;
        break; /* write only */
    default:
        *byte = value;
        break;
    }
    const unsigned time_us = mode ? 1800 : 3400;
    cpu->data[EECR_] |= EEPE_;
    events_set(EVENT_EEPROM, when + time_us * (CPU_HZ / 1000000u));
    cpu->cycle += 2; /* the CPU is halted */
}

static void write_control(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    (void)param;
    const instant when = cpu_write_instant();
    events_until(when);
    const uint8_t old = avr->data[address];
    const bool busy = old & EEPE_, enabled = when <= eeprom.master_until;
    if (value & EEMPE_)
        eeprom.master_until = when + 4;
    uint8_t now = (value & (EERIE_ | EEMPE_)) | (old & EEPE_);
    now |= busy ? old & EEPM_ : value & EEPM_;
    avr->data[address] = now;
    if (!busy && enabled && (value & EEPE_)) {
        avr->data[address] &= (uint8_t)~EEMPE_;
        eeprom.master_until = 0;
        program(when);
    } else if (!busy && (value & EERE_)) {
        avr->data[EEDR_] = *addressed_byte();
        avr->cycle += 4; /* the CPU is halted */
    }
    eeprom_level();
}

static uint8_t read_control(avr_t *avr, avr_io_addr_t address, void *param) {
    (void)param;
    const instant when = cpu_read_instant();
    events_until(when);
    if (when > eeprom.master_until)
        avr->data[address] &= (uint8_t)~EEMPE_;
    return avr->data[address];
}

void eeprom_start(void) {
    eeprom.stock = cpu_find_io("eeprom", 0);
    events_handle(EVENT_EEPROM, on_written);
    cpu_on_write(EECR_, write_control, NULL);
    cpu_on_read(EECR_, read_control, NULL);
}

void eeprom_reset(void) {
    eeprom.master_until = 0;
    events_set(EVENT_EEPROM, NEVER);
}

uint8_t *eeprom_content(size_t *size) {
    *size = eeprom.stock->size;
    return eeprom.stock->eeprom;
}
