// SPDX-License-Identifier: Apache-2.0
// USART0 with its buffers, and a host at the other end of the line. avr8js has the registers,
// speeds and interrupts. Its transmitter and receiver keep one byte each: at 1 Mbaud, bytes would
// be lost that a chip does not lose.
"use strict";

const { AVRUSART } = require("avr8js");

// Two received bytes wait in the buffer, a third one in the shift register.
const RECEIVED_MAX = 3;

class SerialLine {
    // sent: takes what the board sends, byte by byte. counters: see README.md.
    constructor(cpu, config, clockHz, sent, counters) {
        this.cpu = cpu;
        this.usart = new AVRUSART(cpu, config, clockHz);
        this.sent = sent;
        this.counters = counters;
        this.shifting = false; // a byte is on its way to the host
        this.waiting = null; // the next one, in the transmit buffer
        this.toBoard = []; // bytes that the host has yet to send
        this.arriving = false;
        this.received = [];
        const { RXC, TXC, UDRE } = this.usart;
        const writeStatus = cpu.writeHooks[config.UCSRA];
        cpu.writeHooks[config.UCSRA] = (value, old) => {
            writeStatus(value, old); // clears every flag; a one clears TXC, nothing the others
            const kept = RXC.flagMask | UDRE.flagMask | (TXC.flagMask & ~value);
            cpu.data[config.UCSRA] |= old & kept;
            return true;
        };
        cpu.writeHooks[config.UDR] = (octet) => {
            if (this.shifting) {
                this.waiting = octet;
                cpu.clearInterrupt(UDRE);
            } else {
                this.shift(octet);
            }
        };
        cpu.readHooks[config.UDR] = () => {
            const octet = this.received.shift() ?? 0;
            if (!this.received.length) cpu.clearInterrupt(RXC);
            return octet;
        };
    }

    shift(octet) {
        const { cpu, usart } = this;
        this.shifting = true;
        cpu.addClockEvent(() => {
            this.sent.push(octet);
            const next = this.waiting;
            this.waiting = null;
            if (next === null) {
                this.shifting = false;
                cpu.setInterruptFlag(usart.TXC);
            } else {
                this.shift(next);
                cpu.setInterruptFlag(usart.UDRE);
            }
        }, usart.cyclesPerChar);
    }

    // The host's bytes arrive one after the other at the speed that the board has set.
    write(octets) {
        this.toBoard.push(...octets);
        if (!this.arriving) this.arrive();
    }

    arrive() {
        const { cpu, usart, counters } = this;
        this.arriving = this.toBoard.length > 0;
        if (!this.arriving) return;
        cpu.addClockEvent(() => {
            const octet = this.toBoard.shift();
            if (!usart.rxEnable) {
                counters.rx_ignored++;
            } else if (this.received.length === RECEIVED_MAX) {
                counters.rx_overruns++;
            } else {
                this.received.push(octet);
                cpu.setInterruptFlag(usart.RXC);
            }
            this.arrive();
        }, usart.cyclesPerChar);
    }
}

module.exports = { SerialLine };
