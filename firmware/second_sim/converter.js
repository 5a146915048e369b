// SPDX-License-Identifier: Apache-2.0
// The analog-to-digital converter after the data sheet of the ATmega328P, chapter "ADC". That of
// avr8js samples when a conversion begins, and knows neither free running nor a trigger.
//
//     conversion          sample held    ended       ADC clocks after its begin
//     first after ADEN    13.5           25
//     single, free run     1.5           13
//     triggered            2             13.5        3 CPU cycles after the trigger it begins
"use strict";

const ADCL = 0x78, ADCH = 0x79, ADCSRA = 0x7a, ADCSRB = 0x7b, ADMUX = 0x7c;
const ADEN = 0x80, ADSC = 0x40, ADATE = 0x20, ADIF = 0x10, ADIE = 0x08, ADPS = 0x07;
const ADTS = 0x07, FREE_RUNNING = 0, TIMER1_COMPARE_B = 5;
const MUX = 0x1f, MUX5 = 0x08;
const SYNCHRONISATION_CYCLES = 3;

class Converter {
    // sample(channel, cycle): the code of a channel, at the instant of the hold. counters: what is
    // counted here, under the names of README.md.
    constructor(cpu, vector, sample, counters) {
        this.cpu = cpu;
        this.sample = sample;
        this.counters = counters;
        this.interrupt = {
            address: vector,
            flagRegister: ADCSRA,
            flagMask: ADIF,
            enableRegister: ADCSRA,
            enableMask: ADIE,
        };
        this.first = true; // the next conversion is the first after ADEN
        this.clockOrigin = 0; // a cycle at which an ADC clock began
        this.steps = []; // of the conversion in progress: [cycle, what happens then]
        this.channel = 0;
        this.code = 0;
        this.locked = false; // ADCL was read, and ADCH not yet
        this.unread = false;
        this.wake = () => this.advance(cpu.cycles);
        cpu.writeHooks[ADCSRA] = (value, old) => this.control(value, old);
        cpu.readHooks[ADCL] = () => {
            this.locked = true;
            return cpu.data[ADCL];
        };
        cpu.readHooks[ADCH] = () => {
            this.locked = this.unread = false;
            return cpu.data[ADCH];
        };
    }

    get divider() {
        return 1 << Math.max(1, this.cpu.data[ADCSRA] & ADPS);
    }

    triggeredBy(source) {
        const { data } = this.cpu;
        return (data[ADCSRA] & ADEN) && (data[ADCSRA] & ADATE) && (data[ADCSRB] & ADTS) === source;
    }

    control(value, old) {
        const { cpu, interrupt } = this;
        const now = cpu.cycles;
        this.advance(now);
        const kept = ADSC | ADIF;
        cpu.data[ADCSRA] = (value & ~kept) | (cpu.data[ADCSRA] & kept);
        cpu.clearInterruptByFlag(interrupt, value);
        cpu.updateInterruptEnable(interrupt, value);
        if (!(value & ADEN)) {
            this.steps = [];
            cpu.data[ADCSRA] &= ~ADSC;
        } else if (!(old & ADEN)) {
            this.first = true;
            this.clockOrigin = now;
        }
        if ((value & ADEN) && (value & ADSC) && !this.steps.length) {
            const clocks = Math.ceil((now - this.clockOrigin) / this.divider);
            this.begin(this.clockOrigin + clocks * this.divider, 1.5, 13);
        }
        return true;
    }

    // The trigger's rising edge came at this cycle, some cycles of an instruction ago.
    trigger(cycle) {
        this.advance(cycle);
        if (!this.triggeredBy(TIMER1_COMPARE_B)) return;
        if (this.steps.length) {
            this.counters.ignored_triggers++;
            return;
        }
        this.clockOrigin = cycle + SYNCHRONISATION_CYCLES;
        this.begin(this.clockOrigin, 2, 13.5);
        this.advance(this.cpu.cycles);
    }

    begin(cycle, holdClocks, allClocks) {
        const { cpu, divider } = this;
        if (this.first) [holdClocks, allClocks] = [13.5, 25];
        this.first = false;
        cpu.data[ADCSRA] |= ADSC;
        this.steps = [
            [cycle, () => this.lockChannel()],
            [cycle + holdClocks * divider, (at) => this.hold(at)],
            [cycle + allClocks * divider, (at) => this.finish(at)],
        ];
        for (const [at] of this.steps) cpu.addClockEvent(this.wake, at - cpu.cycles);
    }

    // Instructions take several cycles: steps are done late, but in order and with their own time.
    advance(now) {
        while (this.steps.length && this.steps[0][0] <= now) {
            const [at, step] = this.steps.shift();
            step(at);
        }
    }

    lockChannel() {
        const { data } = this.cpu;
        this.channel = (data[ADMUX] & MUX) | ((data[ADCSRB] & MUX5) << 2);
    }

    hold(at) {
        this.counters.conversions++;
        this.code = this.sample(this.channel, at);
    }

    finish(at) {
        const { cpu } = this;
        if (this.locked || this.unread) this.counters.lost_results++;
        if (!this.locked) {
            cpu.data[ADCL] = this.code & 0xff;
            cpu.data[ADCH] = this.code >> 8;
            this.unread = true;
        }
        cpu.data[ADCSRA] &= ~ADSC;
        cpu.setInterruptFlag(this.interrupt);
        if (this.triggeredBy(FREE_RUNNING)) this.begin(at, 1.5, 13);
    }
}

module.exports = { Converter };
