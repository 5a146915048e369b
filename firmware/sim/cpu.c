/* SPDX-License-Identifier: GPL-3.0-or-later
 * Part of ohmskin's skinsim, a separate program that links libsimavr (GPL-3.0-or-later).
 */
/* The core: loading, running, resets, and the register hooks of the peripherals modelled here. */
#include "skinsim.h"

#include <errno.h>
#include <fcntl.h>
#include <gelf.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <simavr/avr_extint.h>
#include <simavr/avr_timer.h>
#include <simavr/avr_uart.h>
#include <simavr/avr_watchdog.h>
#include <simavr/sim_core.h>
#include <simavr/sim_cycle_timers.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_interrupts.h>

enum {
    MCUSR_ = 0x54,
    WDTCSR_ = 0x60,
    WDCE_ = 0x10,
    WDE_ = 8,
    PORF_ = 1,
    EXTRF_ = 2,
    WDRF_ = 8,
    CHAINED_MAX = 64
};

avr_t *cpu;
static avr_run_t run_instructions;
static instant stop_at;
static uint8_t external_interrupts;
static avr_watchdog_t *watchdog;
static instant watchdog_reset_at = NEVER;

/* ---- register hooks */

static uint16_t opcode(void) {
    return (uint16_t)(cpu->flash[cpu->pc] | cpu->flash[cpu->pc + 1] << 8);
}

/* OUT takes effect at the end of its only cycle, STS, ST, SBI and CBI of their second. */
instant cpu_write_instant(void) { return cpu->cycle + ((opcode() & 0xF800) == 0xB800 ? 1 : 2); }

/* IN, SBIC, SBIS, SBI and CBI read in their first cycle, LDS and LD in their second. */
instant cpu_read_instant(void) {
    const bool in = (opcode() & 0xF800) == 0xB000, bit = (opcode() & 0xFC00) == 0x9800;
    return cpu->cycle + (in || bit ? 0 : 1);
}

uint8_t cpu_written_bits(uint8_t value) {
    const bool sbi = (opcode() & 0xFF00) == 0x9A00;
    return sbi ? (uint8_t)(1 << (opcode() & 7)) : value;
}

void cpu_on_read(uint16_t address, avr_io_read_t hook, void *param) {
    cpu->io[AVR_DATA_TO_IO(address)].r.c = hook;
    cpu->io[AVR_DATA_TO_IO(address)].r.param = param;
}

void cpu_on_write(uint16_t address, avr_io_write_t hook, void *param) {
    cpu->io[AVR_DATA_TO_IO(address)].w.c = hook;
    cpu->io[AVR_DATA_TO_IO(address)].w.param = param;
}

static struct chained {
    avr_io_write_t hook;
    void *param;
    bool strobe;
    void (*after)(instant when);
} chained[CHAINED_MAX];
static size_t chained_count;

static void write_chained(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    const struct chained *c = param;
    const instant when = cpu_write_instant();
    events_until(when);
    c->hook(avr, address, c->strobe ? cpu_written_bits(value) : value, c->param);
    c->after(when);
}

void cpu_after_write(uint16_t address, bool strobe, void (*after)(instant when)) {
    if (chained_count == CHAINED_MAX)
        abort(); /* the board table grew: enlarge CHAINED_MAX */
    struct chained *c = &chained[chained_count++];
    c->hook = cpu->io[AVR_DATA_TO_IO(address)].w.c;
    c->param = cpu->io[AVR_DATA_TO_IO(address)].w.param;
    c->strobe = strobe;
    c->after = after;
    cpu_on_write(address, write_chained, c);
}

void *cpu_find_io(const char *kind, char name) {
    for (avr_io_t *io = cpu->io_port; io; io = io->next) {
        if (strcmp(io->kind, kind))
            continue;
        if (!name || (!strcmp(kind, "uart") && ((avr_uart_t *)io)->name == name) ||
            (!strcmp(kind, "timer") && ((avr_timer_t *)io)->name == name))
            return io;
    }
    fprintf(stderr, "skinsim: libsimavr models no %s %c of this chip\n", kind, name ? name : ' ');
    exit(1);
}

/* ---- interrupts */

/* simavr leaves a cleared interrupt in its queue of 64, which then fills up while interrupts are
 * off, and one raised into a full queue is lost for good. */
void cpu_clear_interrupt(avr_int_vector_t *vector) {
    avr_int_pending_t *queue = &cpu->interrupts.pending;
    uint16_t kept = queue->read;
    for (uint16_t i = queue->read; i != queue->write; i = (i + 1) % avr_int_pending_fifo_size)
        if (queue->buffer[i] != vector) {
            queue->buffer[kept] = queue->buffer[i];
            kept = (kept + 1) % avr_int_pending_fifo_size;
        }
    queue->write = kept;
    avr_clear_interrupt(cpu, vector);
}

void cpu_level_interrupt(avr_int_vector_t *vector, bool active) {
    if (active && avr_regbit_get(cpu, vector->enable))
        avr_raise_interrupt(cpu, vector);
    else if (vector->pending)
        cpu_clear_interrupt(vector);
}

void cpu_retry_interrupt(avr_int_vector_t *vector) {
    if (avr_regbit_get(cpu, vector->raised) && avr_regbit_get(cpu, vector->enable))
        avr_raise_interrupt(cpu, vector);
}

/* simavr enters an interrupt in no time; the hardware takes 4 cycles, 5 with a 3-byte PC. RETI
 * takes as long, and simavr does count that. */
static void on_interrupt(struct avr_irq_t *irq, uint32_t running, void *param) {
    (void)irq;
    const avr_int_vector_t *vector = param;
    const unsigned cycles = cpu->address_size + 2u;
    if (running) {
        stats_interrupt_entered(vector->vector, cpu->cycle);
        cpu->cycle += cycles;
        cpu->run_cycle_count = cpu->run_cycle_count > cycles ? cpu->run_cycle_count - cycles : 1;
    } else {
        stats_interrupt_left(vector->vector, cpu->cycle + cycles);
        uart_level();
        eeprom_level();
    }
}

/* In interrupt and reset mode an interrupt that nobody took by the next time-out becomes a reset;
 * simavr would wait for ever. */
static void on_watchdog_pending(struct avr_irq_t *irq, uint32_t pending, void *param) {
    (void)irq, (void)param;
    const bool resets = pending && (cpu->data[WDTCSR_] & WDE_);
    watchdog_reset_at = resets ? cpu->cycle + watchdog->cycle_count : NEVER;
}

/* simavr's own waits for the wall clock. */
static void on_sleep(avr_t *avr, avr_cycle_count_t how_long) { (void)avr, (void)how_long; }

/* ---- resets */

static avr_cycle_count_t on_stop(avr_t *avr, avr_cycle_count_t when, void *param) {
    (void)avr, (void)when, (void)param;
    return 0;
}

/* Without it the core would run up to 1000 cycles beyond. */
static void arm_stop(void) {
    if (stop_at > cpu->cycle)
        avr_cycle_timer_register(cpu, stop_at - cpu->cycle, on_stop, NULL);
}

static void on_reset(avr_io_t *io) {
    (void)io;
    events_reset();
    arm_stop();
    skin_reset();
    adc_reset();
    timer_reset();
    uart_reset();
    eeprom_reset();
    stats_cpu_reset();
}

/* Reset flags accumulate in MCUSR until the firmware clears them; simavr clears all registers. */
static void reset_with(uint8_t flag, avr_run_t reset) {
    const uint8_t flags = cpu->data[MCUSR_] | flag;
    reset(cpu);
    cpu->run = run_instructions;
    cpu->data[MCUSR_] = flags;
    watchdog_reset_at = NEVER;
    for (uint8_t i = 0; i < external_interrupts;
         i++) /* a low INTn pin is polled every cycle otherwise */
        avr_extint_set_strict_lvl_trig(cpu, i, 0);
}

/* A shorter time-out counts from the write that sets it; simavr lets the longer one end first. */
static void on_watchdog_setting(instant when) {
    static uint8_t before;
    (void)when;
    const uint8_t now = cpu->data[WDTCSR_];
    if (now != before && !(now & WDCE_))
        avr_ioctl(cpu, AVR_IOCTL_WATCHDOG_RESET, NULL);
    before = now;
}

void cpu_external_reset(void) { reset_with(EXTRF_, avr_reset); }

bool cpu_jump(uint32_t address) {
    if (address % 2 || address > cpu->flashend)
        return false;
    cpu->pc = address;
    return true;
}

bool cpu_poke(uint16_t address, uint8_t value) {
    if (address >= 0x20 && address != MCUSR_)
        return false;
    cpu->data[address] = value;
    return true;
}

/* ---- running */

bool cpu_has_boot_loader(void) { return cpu->reset_pc != 0; }

bool cpu_alive(void) { return cpu->state == cpu_Running || cpu->state == cpu_Sleeping; }

const char *cpu_state_name(void) {
    return cpu_alive() ? "running" : cpu->state == cpu_Done ? "done" : "crashed";
}

void cpu_run_until(instant target) {
    stop_at = target;
    arm_stop();
    while (cpu->cycle < target) {
        cpu->run(cpu);
        /* After SEI and RETI the hardware runs one more instruction; simavr counts down from -2. */
        if (cpu->interrupt_state == -1)
            cpu->interrupt_state = (int8_t)avr_has_pending_interrupts(cpu);
        if (cpu->run != run_instructions) /* simavr's watchdog wants its reset */
            reset_with(WDRF_, cpu->run);
        if (cpu->cycle >= watchdog_reset_at)
            reset_with(WDRF_, avr_reset);
        if (!cpu_alive())
            return;
    }
    /* simavr enters an interrupt after the events of an instruction. What is due while it does so
     * has happened when the run ends: the host may change the skin next. */
    events_until(cpu->cycle);
}

static void log_errors(struct avr_t *avr, const int level, const char *format, va_list arguments) {
    (void)avr;
    if (level <= LOG_ERROR)
        vfprintf(stderr, format, arguments);
}

static bool fits(const char *what, uint32_t base, uint32_t size, uint32_t end) {
    if (base <= end && size <= end - base)
        return true;
    fprintf(stderr, "skinsim: the %s does not fit this chip\n", what);
    return false;
}

/* simavr notices an access beyond the memories, says crashed, and then makes the access. */
static bool enlarge_memories(void) {
    enum { DATA_SPACE = 1 << 16, FLASH_SPACE = 1 << 24, SLACK = 16 };
    uint8_t *data = calloc(1, DATA_SPACE + SLACK), *flash = calloc(1, FLASH_SPACE + SLACK);
    if (!data || !flash)
        return false;
    memcpy(data, cpu->data, cpu->ramend + 1u);
    memcpy(flash, cpu->flash, cpu->flashend + 1u);
    free(cpu->data);
    free(cpu->flash);
    cpu->data = data;
    cpu->flash = flash;
    return true;
}

/* One record of an Intel hex file: its bytes, or -1 where it is none. */
static int hex_record(const char *line, uint8_t bytes[300]) {
    int count = 0, used;
    unsigned byte, sum = 0;
    if (*line++ != ':')
        return -1;
    for (; count < 300 && sscanf(line, "%2x%n", &byte, &used) == 1 && used == 2; line += 2) {
        bytes[count++] = (uint8_t)byte;
        sum += byte;
    }
    return count >= 5 && count == bytes[0] + 5 && !(sum & 0xFF) ? count : -1;
}

/* The boot section, which BOOTRST makes the start, begins where the loader does. simavr's own
 * reader of such files stops at a record of the start address, which Arduino's loaders have. */
static bool load_boot_loader(const char *path, uint32_t program_end) {
    enum { DATA = 0, SEGMENT = 2, LINEAR = 4, ADDRESS = 1, TYPE = 3, CONTENT = 4 };
    FILE *file = fopen(path, "r");
    if (!file) {
        fprintf(stderr,
                "skinsim: cannot read '%s': %s (Debian's arduino-core-avr has the boards')\n", path,
                strerror(errno));
        return false;
    }
    uint32_t base = 0, start = UINT32_MAX;
    bool good = true;
    char line[700];
    while (good && fgets(line, sizeof line, file)) {
        uint8_t record[300] = {0};
        good = hex_record(line, record) > 0;
        if (!good)
            break;
        const uint32_t content = (uint32_t)record[CONTENT] << 8 | record[CONTENT + 1];
        const uint32_t at = base + ((uint32_t)record[ADDRESS] << 8 | record[ADDRESS + 1]);
        if (record[TYPE] == SEGMENT)
            base = content << 4;
        else if (record[TYPE] == LINEAR)
            base = content << 16;
        else if (record[TYPE] == DATA) {
            /* Debian's Optiboot is 20 bytes too long for its chip: they are lost as on a board. */
            for (uint32_t i = 0; i < record[0] && at + i <= cpu->flashend; i++) {
                cpu->flash[at + i] = record[CONTENT + i];
                start = at < start ? at : start;
            }
        }
    }
    fclose(file);
    if (!good || start == UINT32_MAX) {
        fprintf(stderr, "skinsim: '%s' is no Intel hex file for this chip\n", path);
        return false;
    }
    cpu->reset_pc = start;
    return fits("program below the boot loader", 0, program_end, start);
}

/* simavr's own reader takes any long file: it finds no program in it, and runs an empty flash. */
static bool is_avr_elf(const char *path) {
    const int file = open(path, O_RDONLY);
    elf_version(EV_CURRENT);
    Elf *elf = elf_begin(file, ELF_C_READ, NULL);
    GElf_Ehdr header;
    const bool is = gelf_getehdr(elf, &header) && header.e_machine == EM_AVR;
    elf_end(elf);
    close(file);
    return is;
}

bool cpu_start(const struct board *board, const char *elf_path, const char *loader_path) {
    const char *mcu = board->mcu;
    static elf_firmware_t firmware;
    static avr_io_t resets = {.kind = "skinsim", .reset = on_reset};

    avr_global_logger_set(log_errors);
    if (!is_avr_elf(elf_path) || elf_read_firmware(elf_path, &firmware) || !firmware.flash) {
        fprintf(stderr, "skinsim: cannot load '%s' as an AVR ELF file\n", elf_path);
        return false;
    }
    cpu = avr_make_mcu_by_name(mcu);
    if (!cpu) {
        fprintf(stderr, "skinsim: libsimavr does not know %s\n", mcu);
        return false;
    }
    if (avr_init(cpu) || !enlarge_memories()) {
        fprintf(stderr, "skinsim: out of memory\n");
        return false;
    }
    if (!fits("ELF's program", firmware.flashbase, firmware.flashsize, cpu->flashend + 1) ||
        !fits("ELF's EEPROM section", 0, firmware.eesize, cpu->e2end + 1u))
        return false;
    firmware.frequency = CPU_HZ;
    strcpy(firmware.mmcu, mcu);
    avr_load_firmware(cpu, &firmware);
    if (loader_path && *loader_path &&
        !load_boot_loader(loader_path, firmware.flashbase + firmware.flashsize))
        return false;
    cpu->log = LOG_ERROR;
    cpu->gdb_port = 0;
    cpu->sleep = on_sleep;
    cpu->run_cycle_limit = CPU_HZ;
    run_instructions = cpu->run;
    external_interrupts = strcmp(mcu, "atmega2560") ? 2 : 8;
    for (int i = 0; i < cpu->interrupts.vector_count; i++) {
        avr_int_vector_t *vector = cpu->interrupts.vector[i];
        avr_irq_register_notify(&vector->irq[AVR_INT_IRQ_RUNNING], on_interrupt, vector);
    }
    watchdog = cpu_find_io("watchdog", 0);
    avr_irq_register_notify(&watchdog->watchdog.irq[AVR_INT_IRQ_PENDING], on_watchdog_pending,
                            NULL);
    adc_start();
    timer_start();
    uart_start();
    eeprom_start();
    skin_start(board);
    cpu_after_write(WDTCSR_, false, on_watchdog_setting);
    avr_register_io(cpu, &resets);
    reset_with(PORF_, avr_reset);
    cpu->data[MCUSR_] = PORF_;
    stats_start();
    return true;
}
