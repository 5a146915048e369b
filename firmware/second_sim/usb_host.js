// SPDX-License-Identifier: Apache-2.0
// A host at the USB controller of an RP2040: it enumerates a serial port (CDC-ACM) as Linux does,
// opens it, and exchanges bytes. That of rp2040js takes each packet at once, gives empty ones, and
// looks at no DATA0 and DATA1; this one has the bus's time.
"use strict";

const BUFFER_CONTROLS = 0x80, BUFFER_CONTROLS_END = 0x100, CONTROL_BUFFER = 0x100;
const FULL = 1 << 15, DATA1 = 1 << 13, STALL = 1 << 11, AVAILABLE = 1 << 10, LENGTH = 0x3ff;
const DEVICE = 1, CONFIGURATION = 2, STRING = 3, ENDPOINT = 5;
const BULK = 2;
// A packet of n bytes takes so many bytes' time at 12 Mbit/s: sync, token, CRC, handshake, gaps.
const PACKET_OVERHEAD = 13, BYTE_NS = 8e3 / 12;
const RESET_NS = 10e6, SETTLE_NS = 1e6;

const request = (kind, number, value, index, length) => {
    const packet = Buffer.alloc(8);
    packet.set([kind, number]);
    packet.writeUInt16LE(value, 2);
    packet.writeUInt16LE(index, 4);
    packet.writeUInt16LE(length, 6);
    return packet;
};
const describe = (kind, index, length) => request(0x80, 6, (kind << 8) | index, kind === STRING ? 0x409 : 0, length);

class UsbHost {
    // sent: takes what the board sends, byte by byte. counters: what is counted here.
    constructor(sent, counters) {
        this.sent = sent;
        this.counters = counters;
        this.toBoard = [];
    }

    // The controller of a processor that starts.
    attach(mcu) {
        this.mcu = mcu;
        this.usb = mcu.usbCtrl;
        this.clock = mcu.clock;
        this.busFreeNs = 0;
        this.armed = new Map(); // buffer controls that are the controller's: offset -> value
        this.carrying = new Set(); // offsets of packets on the bus: those of before have been lost
        this.toggles = new Map(); // what the next packet of an offset has to be: 0 or DATA1
        this.control = null; // the control transfer at hand
        this.endpoints = { in: -1, out: -1 };
        this.descriptors = {};
        this.open = false;
        this.toBoard.length = 0;
        this.usb.onUSBEnabled = () => this.after(RESET_NS, () => this.reset());
        this.usb.onResetReceived = () => this.after(SETTLE_NS, () => this.enumerate());
        this.usb.DPRAMUpdated = (offset, value) => this.updated(offset, value);
    }

    after(ns, what) {
        this.clock.createAlarm(what).schedule(ns);
    }

    reset() {
        this.usb.resetAlarm.callback();
    }

    write(octets) {
        this.toBoard.push(...octets);
        this.serve();
    }

    // What the board has said of itself, in hexadecimal digits, by what was asked.
    said() {
        const digits = ([name, octets]) => [name, octets.toString("hex")];
        return Object.fromEntries(Object.entries(this.descriptors).map(digits));
    }

    setOpen(open, done = () => {}) {
        this.transfer(request(0x21, 0x22, open ? 3 : 0, 0, 0), null, () => {
            this.open = open;
            this.serve();
            done();
        });
    }

    // Both ends begin with DATA0 again, as where a driver clears a halt of the endpoint `address`.
    clearHalt(address) {
        const offset = this.endpoints[address & 0x80 ? "in" : "out"];
        this.transfer(request(2, 1, 0, address, 0), null, () => this.toggles.set(offset, 0));
    }

    // ---- enumeration, and the port's opening
    enumerate() {
        const found = this.descriptors;
        const ask = (name, packet, then) =>
            this.transfer(packet, null, (octets) => {
                found[name] = octets;
                then(octets);
            });
        ask("begin", describe(DEVICE, 0, 64), () =>
            this.transfer(request(0, 5, 7, 0, 0), null, () =>
                ask("device", describe(DEVICE, 0, 18), () =>
                    ask("head", describe(CONFIGURATION, 0, 9), (head) =>
                        ask("configuration", describe(CONFIGURATION, 0, head.readUInt16LE(2)), () =>
                            ask("languages", describe(STRING, 0, 255), () =>
                                ask("serial_number", describe(STRING, 3, 255), () =>
                                    this.configure())))))));
    }

    configure() {
        const { configuration } = this.descriptors;
        for (let at = 0; at < configuration.length; at += configuration[at]) {
            if (configuration[at + 1] !== ENDPOINT || configuration[at + 3] !== BULK) continue;
            const address = configuration[at + 2];
            const offset = BUFFER_CONTROLS + 8 * (address & 15) + (address & 0x80 ? 0 : 4);
            this.endpoints[address & 0x80 ? "in" : "out"] = offset;
            this.toggles.set(offset, 0);
        }
        this.transfer(request(0, 9, 1, 0, 0), null, () => {
            const coding = Buffer.from([0x20, 0xa1, 0x07, 0, 0, 0, 8]); // 500 kbaud, 8N1
            this.transfer(request(0x21, 0x20, 0, 0, 7), coding, () => this.setOpen(true));
        });
    }

    // ---- control transfers, one after the other
    transfer(setup, data, done) {
        this.control = { setup, data, done, received: [], stage: "data" };
        this.toggles.set(BUFFER_CONTROLS, DATA1);
        this.toggles.set(BUFFER_CONTROLS + 4, DATA1);
        this.armed.delete(BUFFER_CONTROLS);
        this.armed.delete(BUFFER_CONTROLS + 4);
        this.usb.sendSetupPacket(setup);
    }

    finish(result) {
        const { done } = this.control;
        this.control = null;
        done(result);
    }

    controlPacketIn(octets) {
        const { control } = this;
        const isIn = control.setup[0] & 0x80;
        if (!isIn) return this.finish(Buffer.alloc(0)); // the empty packet that ends it
        control.received.push(...octets);
        const wanted = control.setup.readUInt16LE(6);
        if (octets.length < 64 || control.received.length >= wanted) {
            control.stage = "status";
            this.toggles.set(BUFFER_CONTROLS + 4, DATA1);
        }
    }

    // ---- packets
    updated(offset, value) {
        if (offset < BUFFER_CONTROLS || offset >= BUFFER_CONTROLS_END) return;
        if (value & STALL && offset < BUFFER_CONTROLS + 8 && this.control) {
            this.counters.stalls++;
            this.finish(Buffer.alloc(0));
        }
        if (!(value & AVAILABLE)) this.armed.delete(offset);
        else this.armed.set(offset, value);
        this.serve();
    }

    serve() {
        for (const offset of [...this.armed.keys()]) if (this.wants(offset)) this.carry(offset);
    }

    // Whether there is a packet to carry for a buffer that is armed.
    wants(offset) {
        if (this.carrying.has(offset)) return false;
        if (offset === BUFFER_CONTROLS) return this.control !== null && this.control.stage === "data" && this.ready(offset);
        if (offset === BUFFER_CONTROLS + 4)
            return this.control !== null && (this.control.stage === "status" || this.control.data !== null);
        if (!this.open) return false;
        return offset === this.endpoints.in || (offset === this.endpoints.out && this.toBoard.length > 0);
    }

    // A transfer with data for the board has that data first.
    ready() {
        return this.control.data === null;
    }

    carry(offset) {
        const isOut = offset & 4;
        const value = this.armed.get(offset);
        const toBoard = isOut ? this.takeOut(offset, value & LENGTH) : null;
        const count = isOut ? toBoard.length : value & LENGTH;
        this.carrying.add(offset);
        const begin = Math.max(this.clock.nanos, this.busFreeNs);
        this.busFreeNs = begin + (PACKET_OVERHEAD + count) * BYTE_NS;
        const { mcu } = this;
        this.after(this.busFreeNs - this.clock.nanos, () => {
            this.carrying.delete(offset);
            if (mcu === this.mcu && this.armed.get(offset) === value) this.carried(offset, value, toBoard);
            this.serve();
        });
    }

    takeOut(offset, length) {
        if (offset === this.endpoints.out) return this.toBoard.splice(0, length);
        const data = this.control.stage === "status" ? [] : [...this.control.data];
        if (this.control.stage === "data") this.control.data = null;
        return data;
    }

    carried(offset, value, toBoard) {
        const { usb, mcu, counters } = this;
        const endpoint = (offset - BUFFER_CONTROLS) >> 3;
        this.armed.delete(offset);
        if ((value & DATA1) !== (this.toggles.get(offset) ?? 0)) counters.wrong_toggles++;
        this.toggles.set(offset, (value & DATA1) ^ DATA1);
        const control = mcu.usbDPRAMView.getUint32(8 * endpoint + (toBoard ? 4 : 0), true);
        const buffer = endpoint === 0 ? CONTROL_BUFFER : control & 0xffc0;
        let octets = [];
        let left = value & ~AVAILABLE;
        if (toBoard) {
            mcu.usbDPRAM.set(toBoard, buffer);
            left = (left & ~LENGTH) | FULL | toBoard.length;
        } else {
            octets = mcu.usbDPRAM.slice(buffer, buffer + (value & LENGTH));
            left &= ~FULL;
        }
        mcu.usbDPRAMView.setUint32(offset, left, true);
        usb.indicateBufferReady(endpoint, Boolean(toBoard));
        if (offset === BUFFER_CONTROLS) this.controlPacketIn(octets);
        else if (offset === BUFFER_CONTROLS + 4 && this.control?.stage === "status")
            this.finish(Buffer.from(this.control.received));
        else if (offset === this.endpoints.in) {
            counters.usb_packets++;
            this.sent.push(...octets);
        }
    }
}

module.exports = { UsbHost };
