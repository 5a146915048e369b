// SPDX-License-Identifier: Apache-2.0
// A Pico: the RP2040 of rp2040js, its flash chip, a host at its USB, and a skin behind its pins.
"use strict";

const { RP2040 } = require("rp2040js");
const { FlashChip } = require("./flash_chip");
const { UsbHost } = require("./usb_host");

// Counts of time are in this clock, that of the firmware's slots, as the other boards' are in theirs.
const NS_PER_COUNT = 62.5;
const FLASH_AT = 0x10000000, FLASH_BYTES = 2 << 20, RAM_AT = 0x20000000;
const BOOT2_AT = 0x20041f00, BOOT2_BYTES = 252;
const ROSC_HZ = 6.5e6; // at which the chip starts (data sheet, 2.17)
const CHIP_RESET = 8, POWER_ON = 1 << 8, RUN_PIN = 1 << 16;
const CONVERSION_NS = 2000; // 96 clocks of 48 MHz (4.9.2)
const GPIO_SIO = 5;
const NEVER_COUNTS = 0xffffffff;
const A_TO_H = 8, EQUAL_DRIVE = 8, UNDRIVEN = 9, OTHER_CHANNEL = 10;
const TOP_HIGH = "abef", BOTTOM_HIGH = "dchg";
const WIRES = "2,3,4,5,6,7,8,9,10,11,0,1,2,3"; // pins, and inputs of the converter

class Pico {
    // uf2: what a Pico is given in place of a hex file. pins: another wiring, as WIRES.
    constructor(uf2, pins = WIRES) {
        const numbers = pins.split(",").map(Number);
        const fits = numbers.every((number) => Number.isInteger(number) && number >= 0 && number < 26);
        if (numbers.length !== 14 || !fits) throw new Error(`not a wiring: ${pins}`);
        const part = (begin, end) => numbers.slice(begin, end);
        this.wires = { row: part(0, 4), column: part(4, 8), top: part(8, 9), bottom: part(9, 10) };
        this.channels = part(10, 14);
        this.memory = new Uint8Array(FLASH_BYTES).fill(0xff);
        loadUf2(uf2, this.memory);
        this.random = generator(1);
        this.flash = new FlashChip(this.memory, this.random);
        this.table = new Float64Array(16 * 16 * A_TO_H);
        this.tableCounts = -1; // when it was set
        this.sent = [];
        this.logging = false;
        this.holds = [];
        this.counters = {
            ...{ resets: 0, conversions: 0, undriven: 0, changed_while_converting: 0 },
            ...{ settle_cycles_min: NEVER_COUNTS, channel_settle_cycles_min: NEVER_COUNTS },
            ...{ usb_packets: 0, wrong_toggles: 0, stalls: 0, warnings: 0 },
        };
        this.line = new UsbHost(this.sent, this.counters);
        this.eeprom = { memory: this.memory.subarray(FLASH_BYTES - 8192) };
        this.start(POWER_ON, 0);
    }

    // chipReset: what the register CHIP_RESET says; reason, scratch: the watchdog's registers REASON
    // and SCRATCH0 to SCRATCH7.
    start(chipReset, reason, scratch = []) {
        const before = this.mcu;
        const mcu = new RP2040();
        this.mcu = mcu;
        if (before) {
            mcu.clock.nanosCounter = before.clock.nanos;
            mcu.sram.set(before.sram);
            this.counters.resets++;
        }
        const warn = (name, text) => {
            this.counters.warnings++;
            if (process.env.OHMSKIN_SIM_WARN) console.error(name, text);
        };
        mcu.logger = { debug() {}, info() {}, warn, error: warn };
        mcu.flash.set(this.memory);
        mcu.clkSys = ROSC_HZ;
        this.nextReset = null;
        this.chipReset = chipReset;
        mcu.peripherals[0x40064].readUint32 = (offset) => (offset === CHIP_RESET ? chipReset : 0);
        const watchdog = mcu.peripherals[0x40058];
        watchdog.reason = reason;
        watchdog.scratchData.set(scratch);
        watchdog.onWatchdogTrigger = () => {
            watchdog.timer.enable = false; // else it triggers for ever
            this.nextReset = () => this.start(this.chipReset, 1, watchdog.scratchData);
        };
        // Nothing may run from the flash once it is no memory any more: it reads as breakpoints.
        this.flash.attach(mcu, () => mcu.flash.fill(0xbe, 0, FLASH_BYTES));
        this.line.attach(mcu);
        mcu.adc.onADCRead = (channel) => this.sample(channel);
        this.watchPins();
        wakeAsChipsDo(mcu.core);
        this.boot();
    }

    // What the ROM does: it loads boot2, if its CRC is right, and runs it.
    boot() {
        const { mcu, memory } = this;
        const said = new DataView(memory.buffer).getUint32(BOOT2_BYTES, true);
        if (crc32(memory.subarray(0, BOOT2_BYTES)) !== said) throw new Error("boot2's CRC is wrong");
        mcu.sram.set(memory.subarray(0, 256), BOOT2_AT - RAM_AT);
        mcu.core.SP = BOOT2_AT;
        mcu.core.PC = BOOT2_AT;
    }

    // ---- time
    get counts() {
        return Math.round(this.mcu.clock.nanos / NS_PER_COUNT);
    }

    run(counts) {
        const endNs = this.mcu.clock.nanos + counts * NS_PER_COUNT;
        while (this.mcu.clock.nanos < endNs) {
            this.runUntil(endNs);
            if (this.nextReset) this.nextReset();
        }
    }

    // Until a time, or until a reset is due.
    runUntil(endNs) {
        const { mcu } = this;
        const { core, clock } = mcu;
        while (clock.nanosCounter < endNs && this.nextReset === null) {
            if (core.waiting && core.pendingInterrupts & core.enabledInterrupts) core.waiting = false;
            if (core.waiting) clock.tick(Math.min(clock.nextAlarm?.nanos ?? endNs, endNs) - clock.nanos);
            else clock.tick((core.executeInstruction() * 1e9) / mcu.clkSys);
        }
    }

    reset() {
        this.start(RUN_PIN, 0);
    }

    cutPower() {
        this.flash.cut();
        this.start(POWER_ON, 0);
    }

    // The ROM has taken a UF2 file: it says so in SCRATCH4, and has the watchdog restart the chip.
    restartByRom() {
        const { scratchData } = this.mcu.peripherals[0x40058];
        this.start(this.chipReset, 1, scratchData.map((word, n) => (n === 4 ? 0 : word)));
    }

    jump(address) {
        this.mcu.core.PC = address;
    }

    takeSent() {
        return Buffer.from(this.sent.splice(0));
    }

    // ---- the skin
    setTable(table) {
        this.table.set(table);
        this.tableCounts = this.counts;
    }

    watchPins() {
        const { sio, adc, clock } = this.mcu;
        const pins = Object.values(this.wires).flat();
        const mask = pins.reduce((bits, pin) => bits | (1 << pin), 0);
        this.pinsChangedNs = this.channelChangedNs = -Infinity;
        const write = sio.writeUint32.bind(sio);
        sio.writeUint32 = (offset, value) => {
            const before = sio.gpioValue;
            write(offset, value);
            if (((before ^ sio.gpioValue) & mask) === 0) return;
            this.pinsChangedNs = clock.nanos;
            if (adc.busy) this.counters.changed_while_converting++;
        };
        const writeAdc = adc.writeUint32.bind(adc);
        adc.writeUint32 = (offset, value) => {
            const before = adc.activeChannel;
            const busy = adc.busy;
            writeAdc(offset, value);
            if (adc.activeChannel === before) return;
            this.channelChangedNs = clock.nanos;
            if (busy) this.counters.changed_while_converting++;
        };
    }

    pins(numbers) {
        const { sio, gpio } = this.mcu;
        let value = 0, driven = true;
        numbers.forEach((pin, bit) => {
            value |= ((sio.gpioValue >> pin) & 1) << bit;
            driven &&= Boolean((sio.gpioOutputEnable >> pin) & 1) && gpio[pin].functionSelect === GPIO_SIO;
        });
        return { value, driven };
    }

    // The data sheet does not say when a conversion samples: here it is when it begins, and pins
    // that change before its end are counted.
    sample(channel) {
        const { adc, clock } = this.mcu;
        const { wires } = this;
        const row = this.pins(wires.row), column = this.pins(wires.column);
        const top = this.pins(wires.top), bottom = this.pins(wires.bottom);
        const node = this.channels.indexOf(channel);
        let configuration, ratio = 0;
        if (node < 0) {
            configuration = OTHER_CHANNEL;
        } else if (![row, column, top, bottom].every((pin) => pin.driven)) {
            configuration = UNDRIVEN;
            this.counters.undriven++;
        } else if (top.value === bottom.value) {
            configuration = EQUAL_DRIVE;
            ratio = top.value;
        } else {
            const letter = (top.value ? TOP_HIGH : BOTTOM_HIGH)[node];
            configuration = letter.charCodeAt() - "a".charCodeAt();
            ratio = this.table[(row.value * 16 + column.value) * A_TO_H + configuration];
        }
        const code = Math.min(4095, Math.max(0, Math.floor(ratio * 4096)));
        const since = (ns) => Math.min(NEVER_COUNTS, Math.floor((clock.nanos - ns) / NS_PER_COUNT));
        const settle = since(this.pinsChangedNs), channelSettle = since(this.channelChangedNs);
        const { counters } = this;
        counters.conversions++;
        counters.settle_cycles_min = Math.min(counters.settle_cycles_min, settle);
        counters.channel_settle_cycles_min = Math.min(counters.channel_settle_cycles_min, channelSettle);
        // A count is several instructions: a hold after a new table comes a count after it, too.
        const count = Math.max(this.counts, this.tableCounts + 1);
        if (this.logging)
            this.holds.push([count, row.value, column.value, configuration, node & 0xff, code, settle]);
        adc.channelValues[channel] = code;
        adc.currentChannel = channel;
        adc.sampleAlarm.schedule(CONVERSION_NS);
    }

    stats() {
        const { programs, erases, refused } = this.flash.counters;
        const flash = { flash_programs: programs, flash_erases: erases, flash_refused: refused };
        return { state: "running", cycles: this.counts, ...this.counters, ...flash };
    }

    restartCounters() {
        for (const name in this.counters)
            if (name !== "resets") this.counters[name] = name.endsWith("_min") ? NEVER_COUNTS : 0;
    }
}

// rp2040js takes an interrupt that ends WFI even while interrupts are off. A chip goes on, and takes
// it when they are on again.
function wakeAsChipsDo(core) {
    core.setInterrupt = (interrupt, isSet) => {
        const bit = 1 << interrupt;
        if (isSet && !(core.pendingInterrupts & bit)) core.interruptsUpdated = true;
        if (isSet) core.pendingInterrupts |= bit;
        else core.pendingInterrupts &= ~bit;
    };
}

function loadUf2(uf2, memory) {
    const BLOCK = 512;
    if (uf2.length === 0 || uf2.length % BLOCK) throw new Error("not a UF2 file: no whole blocks");
    for (let at = 0; at < uf2.length; at += BLOCK) {
        const [first, second, , address, bytes, , , family] = Array.from({ length: 8 }, (_, i) =>
            uf2.readUInt32LE(at + 4 * i));
        const whole = first === 0x0a324655 && second === 0x9e5d5157;
        if (!whole || uf2.readUInt32LE(at + 508) !== 0x0ab16f30 || family !== 0xe48bff56)
            throw new Error("not a UF2 file for an RP2040");
        memory.set(uf2.subarray(at + 32, at + 32 + bytes), address - FLASH_AT);
    }
}

// CRC-32/MPEG-2, bit by bit.
function crc32(octets) {
    let crc = 0xffffffff;
    for (const octet of octets)
        for (let bit = 7; bit >= 0; bit--) {
            const one = ((crc >>> 31) ^ (octet >> bit)) & 1;
            crc = (crc << 1) ^ (one ? 0x04c11db7 : 0);
        }
    return crc >>> 0;
}

// Numbers from 0 to 1, the same for a seed (mulberry32, public domain).
function generator(seed) {
    let state = seed;
    return () => {
        state = (state + 0x6d2b79f5) | 0;
        let mixed = Math.imul(state ^ (state >>> 15), 1 | state);
        mixed = (mixed + Math.imul(mixed ^ (mixed >>> 7), 61 | mixed)) ^ mixed;
        return ((mixed ^ (mixed >>> 14)) >>> 0) / 4294967296;
    };
}

module.exports = { Pico };
