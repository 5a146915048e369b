/* SPDX-License-Identifier: GPL-3.0-or-later
 * Part of ohmskin's skinsim, a separate program that links libsimavr (GPL-3.0-or-later).
 */
/* What is connected where: as the firmware says it in its ELF file, or as --pins does. */
#include "skinsim.h"

#include <fcntl.h>
#include <gelf.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

/* Where the firmware says it (firmware/src/wiring.h): S0 to S3 of rows and of columns, drive top
 * and bottom, and analog inputs of the sense nodes, a byte each, by Arduino's numbers; then the
 * reference resistors in ohms, top and bottom, four bytes each, little endian. */
#define SECTION ".ohmskin.wiring"
enum { REF_BYTES = 4 };

/* A port's letter and a bit, as D4. */
static bool read_pin(const char *text, struct pin *pin) {
    static const char LETTERS[] = "ABCDEFGHJKL";
    static const uint16_t PORTS[] = {0x22, 0x25,  0x28,  0x2B,  0x2E, 0x31,
                                     0x34, 0x102, 0x105, 0x108, 0x10B};
    const char *letter = text[0] ? strchr(LETTERS, text[0]) : NULL;
    if (!letter || text[1] < '0' || text[1] > '7')
        return false;
    *pin = (struct pin){PORTS[letter - LETTERS], (uint8_t)(text[1] - '0')};
    return true;
}

static bool take_table(const uint8_t *table, size_t size, struct board *board) {
    struct wiring *wiring = &board->wiring;
    const size_t pins = size - NODES - DRIVEN_NODES * REF_BYTES;
    if (pins != 2 * ADDRESS_PINS + 2 && pins != PINS_MAX)
        return false;
    wiring->address_pins = (uint8_t)(pins / 2 - 1);
    for (size_t i = 0; i < pins; i++)
        if (2u * *table >= strlen(board->arduino_pins) ||
            !read_pin(board->arduino_pins + 2 * *table++, &wiring->pins[i]))
            return false;
    for (unsigned node = 0; node < NODES; node++, table++) {
        if (*table > 7)
            return false;
        wiring->channels[node] = *table;
    }
    for (unsigned node = 0; node < DRIVEN_NODES; node++) {
        uint32_t ohm = 0;
        for (unsigned byte = 0; byte < REF_BYTES; byte++)
            ohm |= (uint32_t)*table++ << 8 * byte;
        if (!ohm)
            return false;
        wiring->ref_ohm[node] = ohm;
    }
    wiring->told = true;
    return true;
}

bool wiring_of_firmware(const char *elf_path, struct board *board) {
    const int file = open(elf_path, O_RDONLY);
    elf_version(EV_CURRENT);
    Elf *elf = elf_begin(file, ELF_C_READ, NULL);
    size_t names;
    bool good = true;
    if (elf && !elf_getshdrstrndx(elf, &names))
        for (Elf_Scn *section = NULL; (section = elf_nextscn(elf, section));) {
            GElf_Shdr header;
            const char *name =
                gelf_getshdr(section, &header) ? elf_strptr(elf, names, header.sh_name) : NULL;
            const Elf_Data *data =
                name && !strcmp(name, SECTION) ? elf_getdata(section, NULL) : NULL;
            if (data)
                good = take_table(data->d_buf, data->d_size, board);
        }
    elf_end(elf);
    close(file);
    if (!good)
        fprintf(stderr,
                "skinsim: the wiring in '%s' is none of this board: is it another board's?\n",
                elf_path);
    return good;
}

bool wiring_of_option(const char *text, struct wiring *wiring) {
    unsigned values = 1;
    for (const char *at = text; (at = strchr(at, ',')); at++)
        values++;
    const unsigned pins = values - NODES;
    if (pins != 2 * ADDRESS_PINS + 2 && pins != PINS_MAX) {
        fprintf(stderr,
                "skinsim: --pins has %u values: there should be 4 or 5 pins of rows and as many of "
                "columns, 2 drive pins and 4 channels\n",
                values);
        return false;
    }
    wiring->address_pins = (uint8_t)(pins / 2 - 1);
    for (unsigned i = 0; i < values; i++) {
        const size_t length = strcspn(text, ",");
        const bool is_pin = i < pins;
        if (is_pin ? length != 3 || *text != 'P' || !read_pin(text + 1, &wiring->pins[i])
                   : length != 1 || *text < '0' || *text > '7') {
            fprintf(stderr, "skinsim: --pins: '%.*s' is no %s\n", (int)length, text,
                    is_pin ? "pin: write port and bit, as PD4" : "channel: there are 0 to 7");
            return false;
        }
        if (!is_pin)
            wiring->channels[i - pins] = (uint8_t)(*text - '0');
        text += length + 1;
    }
    return true;
}
