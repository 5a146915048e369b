// SPDX-License-Identifier: Apache-2.0
// A board: the chip's flash, peripherals of avr8js at the addresses of its data sheet, a host at
// its serial line, and a skin behind its pins.
"use strict";

const avr8js = require("avr8js");
const { Converter } = require("./converter");
const { SerialLine } = require("./serial_line");

const CPU_HZ = 16e6;
const REGISTERS_END = 0x100; // avr8js counts what lies above it as SRAM
const MCUSR = 0x54, TIFR1 = 0x36, OCF1B = 0x04;
const POWER_ON = 0x01, EXTERNAL = 0x02, WATCHDOG = 0x08; // bits of MCUSR
const NEVER_CYCLES = 0xffffffff;
const A_TO_H = 8, EQUAL_DRIVE = 8, UNDRIVEN = 9, OTHER_CHANNEL = 10;
// Readings by node: the near ends of row and column, then the far ends.
const TOP_HIGH = "abef", BOTTOM_HIGH = "dchg";

const { timer0Config, timer1Config, usart0Config, eepromConfig, watchdogConfig } = avr8js;

// The Mega's vectors are those of its data sheet, table 14-1, as word addresses. Ports have no pin
// interrupts: avr8js has them where the ATmega328P has them, and the firmware uses none.
const port = (letter) => ({
    ...avr8js[`port${letter}Config`],
    pinChange: undefined,
    externalInterrupts: [],
});
const B = avr8js.portBConfig.PORT, D = avr8js.portDConfig.PORT, G = avr8js.portGConfig.PORT;
const CHIPS = {
    uno: {
        flashBytes: 0x8000,
        ramStart: 0x100,
        ramBytes: 0x800,
        eepromBytes: 1024,
        ports: { B: port("B"), C: port("C"), D: port("D") },
        timer0: timer0Config,
        timer1: timer1Config,
        usart0: usart0Config,
        eeprom: eepromConfig,
        watchdog: watchdogConfig,
        converterVector: 0x2a,
        wires: "PD4,PD5,PD6,PD7,PB0,PB1,PB2,PB3,PD2,PD3,0,1,2,3",
    },
    megaatmega2560: {
        flashBytes: 0x40000,
        ramStart: 0x200,
        ramBytes: 0x2000,
        eepromBytes: 4096,
        ports: Object.fromEntries([..."ABCDEFGHJKL"].map((letter) => [letter, port(letter)])),
        timer0: {
            ...timer0Config,
            ...{ compAInterrupt: 0x2a, compBInterrupt: 0x2c, ovfInterrupt: 0x2e },
            ...{ compPortA: B, compPinA: 7, compPortB: G, compPinB: 5 },
            ...{ externalClockPort: D, externalClockPin: 7 },
        },
        timer1: {
            ...timer1Config,
            ...{ captureInterrupt: 0x20, compAInterrupt: 0x22, compBInterrupt: 0x24 },
            ...{ compCInterrupt: 0x26, ovfInterrupt: 0x28, OCRC: 0x8c, OCFC: 8, OCIEC: 8 },
            ...{ compPinA: 5, compPinB: 6, compPortC: B, compPinC: 7 },
            ...{ externalClockPort: D, externalClockPin: 6 },
        },
        usart0: {
            ...usart0Config,
            ...{ rxCompleteInterrupt: 0x32, dataRegisterEmptyInterrupt: 0x34 },
            ...{ txCompleteInterrupt: 0x36 },
        },
        eeprom: { ...eepromConfig, eepromReadyInterrupt: 0x3c },
        watchdog: { ...watchdogConfig, watchdogInterrupt: 0x18 },
        converterVector: 0x3a,
        wires: "PA0,PA1,PA2,PA3,PC0,PC1,PC2,PC3,PL0,PL1,0,1,2,3",
    },
};

class Board {
    // hex: text of an Intel HEX file, as avrdude writes it into the flash. pins: another wiring, as
    // in README.md.
    constructor(name, hex, pins) {
        this.chip = CHIPS[name];
        const names = Object.keys(CHIPS).join(", ");
        if (!this.chip) throw new Error(`no board '${name}': there are ${names}`);
        this.wires = readWires(pins ?? this.chip.wires);
        this.flash = loadHex(hex, this.chip.flashBytes);
        this.eeprom = new avr8js.EEPROMMemoryBackend(this.chip.eepromBytes);
        this.table = new Float64Array(16 * 16 * A_TO_H);
        this.sent = [];
        this.logging = false;
        this.holds = [];
        this.counters = {
            ...{ resets: 0, conversions: 0, lost_results: 0, ignored_triggers: 0 },
            ...{ rx_overruns: 0, rx_ignored: 0 },
        };
        this.start(POWER_ON);
    }

    // A reset clears every register; flash, EEPROM, RAM and the time stay.
    start(cause) {
        const { chip } = this;
        const before = this.cpu;
        const ramEnd = chip.ramStart + chip.ramBytes;
        const cpu = new avr8js.CPU(new Uint16Array(this.flash.buffer), ramEnd - REGISTERS_END);
        this.cpu = cpu;
        cpu.data[MCUSR] = cause;
        if (before) {
            cpu.cycles = before.cycles;
            cpu.data[MCUSR] |= before.data[MCUSR];
            cpu.data.set(before.data.subarray(chip.ramStart), chip.ramStart);
            this.counters.resets++;
        }
        this.resetCause = 0;
        cpu.reset = () => {
            this.resetCause = WATCHDOG; // by the watchdog alone; done after the instruction
        };
        this.ports = {};
        for (const [letter, config] of Object.entries(chip.ports))
            this.ports[letter] = new avr8js.AVRIOPort(cpu, config);
        this.pinsChanged = -Infinity;
        for (const letter of new Set(this.wires.pins.map(([letter]) => letter)))
            this.ports[letter].addListener(() => {
                this.pinsChanged = cpu.cycles + 2; // an STS writes in its second cycle
            });
        new avr8js.AVRTimer(cpu, chip.timer0);
        const timer1 = new avr8js.AVRTimer(cpu, chip.timer1);
        new avr8js.AVREEPROM(cpu, this.eeprom, chip.eeprom);
        const clock = new avr8js.AVRClock(cpu, CPU_HZ);
        new avr8js.AVRWatchdog(cpu, chip.watchdog, clock);
        this.line = new SerialLine(cpu, chip.usart0, CPU_HZ, this.sent, this.counters);
        const sample = (channel, cycle) => this.sample(channel, cycle);
        const converter = new Converter(cpu, chip.converterVector, sample, this.counters);
        const setFlag = cpu.setInterruptFlag.bind(cpu);
        cpu.setInterruptFlag = (interrupt) => {
            const rises = interrupt === timer1.OCFB && !(cpu.data[TIFR1] & OCF1B);
            setFlag(interrupt);
            if (rises) converter.trigger(matchCycle(timer1));
        };
    }

    run(cycles) {
        const end = this.cpu.cycles + cycles;
        while (this.cpu.cycles < end) this.step();
    }

    step() {
        const { cpu } = this;
        avr8js.avrInstruction(cpu);
        do {
            const before = cpu.cycles;
            cpu.tick(); // at most one event, and one interrupt, in which avr8js spends 2 cycles
            if (cpu.cycles > before) cpu.cycles += cpu.pc22Bits ? 3 : 2;
        } while (cpu.nextClockEvent && cpu.nextClockEvent.cycles <= cpu.cycles);
        if (this.resetCause) this.start(this.resetCause);
    }

    reset() {
        this.start(EXTERNAL);
    }

    jump(byteAddress) {
        this.cpu.pc = byteAddress / 2;
    }

    takeSent() {
        return Buffer.from(this.sent.splice(0));
    }

    // ---- the skin
    setTable(table) {
        this.table.set(table);
    }

    // What some of the pins show, the first one bit 0, and whether all of them are outputs.
    pins(first, count) {
        const { data } = this.cpu;
        let value = 0, driven = true;
        this.wires.pins.slice(first, first + count).forEach(([letter, bit], i) => {
            const { DDR, PORT } = this.chip.ports[letter];
            value |= ((data[PORT] >> bit) & 1) << i;
            driven &&= Boolean((data[DDR] >> bit) & 1);
        });
        return { value, driven };
    }

    sample(channel, cycle) {
        const row = this.pins(0, 4), column = this.pins(4, 4);
        const top = this.pins(8, 1), bottom = this.pins(9, 1);
        const node = this.wires.channels.indexOf(channel);
        let configuration, ratio = 0;
        if (node < 0) {
            configuration = OTHER_CHANNEL;
        } else if (![row, column, top, bottom].every((pin) => pin.driven)) {
            configuration = UNDRIVEN;
        } else if (top.value === bottom.value) {
            configuration = EQUAL_DRIVE;
            ratio = top.value;
        } else {
            const letter = (top.value ? TOP_HIGH : BOTTOM_HIGH)[node];
            configuration = letter.charCodeAt() - "a".charCodeAt();
            ratio = this.table[(row.value * 16 + column.value) * A_TO_H + configuration];
        }
        const code = Math.min(1023, Math.max(0, Math.floor(ratio * 1024)));
        if (this.logging) {
            const settle = Math.min(NEVER_CYCLES, Math.max(0, cycle - this.pinsChanged));
            this.holds.push([cycle, row.value, column.value, configuration, node & 0xff, code, settle]);
        }
        return code;
    }

    stats() {
        return { cycles: this.cpu.cycles, ...this.counters };
    }

    restartCounters() {
        for (const name in this.counters) if (name !== "resets") this.counters[name] = 0;
    }
}

// When the counter reached compare B: avr8js notices after an instruction of several cycles.
// It says so in fields that it does not document: another version may need another function.
function matchCycle(timer) {
    const turn = timer.TOP + 1;
    return timer.lastCycle - ((timer.tcnt - timer.ocrB + turn) % turn) * timer.divider;
}

function readWires(text) {
    const pin = "P([A-HJ-L])([0-7])", wires = new RegExp(`^${Array(10).fill(pin)},${Array(4).fill("([0-7])")}$`);
    const found = wires.exec(text)?.slice(1);
    if (!found) throw new Error(`not a wiring: ${text}`);
    const pins = Array.from({ length: 10 }, (_, i) => [found[2 * i], Number(found[2 * i + 1])]);
    return { pins, channels: found.slice(20).map(Number) };
}

function loadHex(text, flashBytes) {
    const flash = new Uint8Array(flashBytes).fill(0xff);
    let base = 0;
    for (const line of text.split(/\r?\n/).filter((line) => line !== "")) {
        const record = Buffer.from(line.slice(1), "hex");
        const sum = record.reduce((total, octet) => total + octet, 0);
        if (line[0] !== ":" || record.length !== record[0] + 5 || sum & 0xff)
            throw new Error(`not a record of an Intel HEX file: ${line}`);
        const data = record.subarray(4, -1);
        if (record[3] === 0) flash.set(data, base + record.readUInt16BE(1));
        else if (record[3] === 2) base = data.readUInt16BE() * 16;
        else if (record[3] === 4) base = data.readUInt16BE() * 0x10000;
    }
    return flash;
}

module.exports = { Board };
