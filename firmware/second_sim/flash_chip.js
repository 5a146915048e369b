// SPDX-License-Identifier: Apache-2.0
// The flash chip of a Pico (W25Q16JV) behind the SSI and the pin QSPI_SS, as far as a program needs
// it that writes to it. rp2040js reads the flash as memory, and has nothing of the rest.
"use strict";

const SSI_SSIENR = 0x08, SSI_RXFLR = 0x24, SSI_DR0 = 0x60;
const SS_CTRL = 0x0c, OUTOVER_SHIFT = 8, OUTOVER_LOW = 2;
const QUEUE = 16; // bytes in each direction
const PROGRAM = 0x02, READ = 0x03, READ_STATUS = 0x05, ENABLE_WRITE = 0x06;
const ERASE_SECTOR = 0x20, READ_UNIQUE_ID = 0x4b;
const WRITING = 1, WRITE_ENABLED = 2; // bits of the status
const PAGE = 256, SECTOR = 4096;
// Data sheet of the W25Q16JV, 9.6, typical: a page's first bytes, a sector.
const PROGRAM_NS = 0.4e6, ERASE_NS = 45e6;

class FlashChip {
    // memory: its bytes, which stay. random(): for what a cut of the supply leaves, 0 to 1.
    constructor(memory, random) {
        this.memory = memory;
        this.random = random;
        this.counters = { programs: 0, erases: 0, refused: 0 };
        this.work = null;
    }

    // The chip of a processor that starts: its registers. clock: of rp2040js. onDirect: called when
    // the program gives up reading the flash as memory.
    attach(mcu, onDirect) {
        this.clock = mcu.clock;
        this.done = mcu.clock.createAlarm(() => this.finish());
        if (this.work) this.done.schedule(Math.max(0, this.work.endNs - mcu.clock.nanos));
        this.selected = false;
        this.received = [];
        const ssi = mcu.peripherals[0x18000];
        const read = ssi.readUint32.bind(ssi), write = ssi.writeUint32.bind(ssi);
        ssi.readUint32 = (offset) => {
            if (offset === SSI_RXFLR) return this.received.length;
            return offset === SSI_DR0 ? this.received.shift() ?? 0 : read(offset);
        };
        ssi.writeUint32 = (offset, value) => {
            if (offset === SSI_DR0) this.exchange(value & 0xff);
            else write(offset, value);
            if (offset === SSI_SSIENR && value === 0 && this.attached) onDirect();
            if (offset === SSI_SSIENR && value === 1) this.attached = true;
        };
        this.attached = false;
        const pins = mcu.peripherals[0x40018];
        pins.readUint32 = () => 0;
        pins.writeUint32 = (offset, value) => {
            if (offset === SS_CTRL) this.select(((value >> OUTOVER_SHIFT) & 3) === OUTOVER_LOW);
        };
    }

    select(selected) {
        if (selected && !this.selected) this.sent = [];
        if (!selected && this.selected) this.execute(this.sent);
        this.selected = selected;
    }

    // A byte each way at once. Its time is not modelled.
    exchange(octet) {
        if (!this.selected || this.received.length >= QUEUE) {
            this.counters.refused++;
            return;
        }
        this.sent.push(octet);
        this.received.push(this.answer());
    }

    answer() {
        const { sent } = this;
        const [command] = sent;
        if (command === READ_STATUS && sent.length > 1)
            return (this.work ? WRITING : 0) | (this.enabled ? WRITE_ENABLED : 0);
        if (this.work) return 0xff;
        if (command === READ && sent.length > 4) return this.memory[this.address() + sent.length - 5];
        if (command === READ_UNIQUE_ID && sent.length > 5) return 0xd0 + sent.length - 6;
        return 0xff;
    }

    address() {
        return (this.sent[1] << 16) | (this.sent[2] << 8) | this.sent[3];
    }

    execute(sent) {
        const [command] = sent;
        if (this.work && command !== READ_STATUS) {
            this.counters.refused++;
        } else if (command === ENABLE_WRITE) {
            this.enabled = true;
        } else if (command === PROGRAM || command === ERASE_SECTOR) {
            if (!this.enabled) this.counters.refused++;
            else this.begin(command, this.address(), sent.slice(4));
            this.enabled = false;
        }
    }

    begin(command, address, octets) {
        const ns = command === PROGRAM ? PROGRAM_NS : ERASE_NS;
        this.work = { command, address, octets, endNs: this.clock.nanos + ns };
        this.done.schedule(ns);
    }

    // Programming only ever makes ones into zeros.
    finish() {
        const { command, address, octets } = this.work;
        this.work = null;
        if (command === PROGRAM) {
            this.counters.programs++;
            const page = address & ~(PAGE - 1);
            octets.forEach((octet, i) => (this.memory[page + ((address + i) % PAGE)] &= octet));
        } else {
            this.counters.erases++;
            const sector = address & ~(SECTOR - 1);
            this.memory.fill(0xff, sector, sector + SECTOR);
        }
    }

    // The supply fails: of what was being written, each bit may or may not have changed.
    cut() {
        if (!this.work) return;
        const { command, address, octets } = this.work;
        this.work = null;
        this.done.cancel();
        const share = this.random();
        const some = () => [...Array(8)].reduce((bits) => (bits << 1) | (this.random() < share), 0);
        if (command === PROGRAM) {
            octets.forEach((octet, i) => (this.memory[address + i] &= octet | ~some()));
        } else {
            const sector = address & ~(SECTOR - 1);
            for (let at = sector; at < sector + SECTOR; at++) this.memory[at] |= some();
        }
    }
}

module.exports = { FlashChip };
