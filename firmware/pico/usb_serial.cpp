// SPDX-License-Identifier: Apache-2.0
#include "usb_serial.h"

#include "flash_store.h"
#include "rp2040.h"
#include "usb_descriptors.h"

// Chapter 9 of USB 2.0, the class CDC-ACM (PSTN 1.2), and the data sheet's 4.1. In the controller's
// memory, each endpoint and direction has a word of buffer control, and its buffers. A buffer that
// is AVAILABLE is the controller's, until the host has taken or filled it.
namespace usb_serial {

using namespace rp2040;

namespace {

// Bits of USB_SIE_STATUS.
constexpr uint32_t SETUP_RECEIVED = 1u << 17, BUS_RESET = 1u << 19;
// Bits of a buffer control.
constexpr uint32_t FULL = 1u << 15, DATA1 = 1u << 13, STALL = 1u << 11, AVAILABLE = 1u << 10;
constexpr uint32_t LENGTH = 0x3FF;
// Bits of an endpoint control.
constexpr uint32_t ENABLED = 1u << 31, EACH_BUFFER = 1u << 29, BULK = 2u << 26,
                   INTERRUPT = 3u << 26;
// Offsets in the controller's memory.
constexpr uint32_t SETUP = 0x00, NOTIFY_CONTROL = 0x08, IN_CONTROL = 0x10, OUT_CONTROL = 0x14;
constexpr uint32_t CONTROL_BUFFER = 0x100, NOTIFY_BUFFER = 0x180, OUT_BUFFER = 0x1C0;
constexpr uint32_t IN_BUFFERS[] = {0x200, 0x240};
constexpr uint8_t PACKET = DATA_PACKET;

// One direction of an endpoint.
struct Endpoint {
    uint8_t index;  // of its bit in USB_BUFF_STATUS: twice its number, and 1 more for OUT
    uint32_t pid;   // of the next packet: 0 or DATA1
    bool armed;     // its buffer is the controller's

    uint32_t buffer_control() const { return USB_DPRAM + 0x80 + 4u * index; }

    // Gives the buffer to the controller: `control` is a length, with FULL where it goes out.
    void arm(uint32_t control) {
        control |= pid;
        pid ^= DATA1;
        armed = true;
        at(buffer_control()) = control;
        // The controller's clock is slower: AVAILABLE comes when the rest has arrived (4.1.2.5.1).
        // The compiler, too, has to have put the packet's bytes into the buffer by then.
        for (uint8_t i = 0; i < 4; i++)
            asm volatile("nop\n nop\n nop" ::: "memory");
        at(buffer_control()) = control | AVAILABLE;
    }
    // The next packet is DATA0, be it the one that the controller has already.
    void begin_again() {
        pid = 0;
        const uint32_t control = at(buffer_control());
        if (armed && (control & AVAILABLE))
            arm(control & (FULL | LENGTH));
    }
    uint8_t length() const { return static_cast<uint8_t>(at(buffer_control()) & LENGTH); }
    void reset() {
        pid = 0;
        armed = false;
        at(buffer_control()) = 0;
    }
};
Endpoint control_in = {0, 0, false}, control_out = {1, 0, false};
Endpoint data_in = {4, 0, false}, data_out = {5, 0, false};

uint8_t *memory(uint32_t offset) { return reinterpret_cast<uint8_t *>(USB_DPRAM + offset); }

void copy(uint8_t *to, const uint8_t *from, uint16_t count) {
    for (uint16_t i = 0; i < count; i++)
        to[i] = from[i];
}

// ------------------------------------------------------------------------- control transfers
struct SetupPacket {
    uint8_t kind, request;
    uint16_t value, index, length;
};
SetupPacket setup;

// The answer of the transfer at hand, what of it is left, and whether an empty packet ends it.
const uint8_t *reply_at;
uint16_t reply_left;
bool reply_ends_empty;
uint8_t new_address;  // to be taken when the transfer is over; 0: none
uint8_t configuration;
bool line_coding_comes;
LineCoding line_coding = {500000, 0, 0, 8};
uint8_t short_reply[2];
uint8_t serial_number[2 + 2 * 16];

bool port_open;       // a program has it, says the line DTR
bool opened = false;  // since the start

void send_reply() {
    const uint8_t count = reply_left < PACKET ? static_cast<uint8_t>(reply_left) : PACKET;
    if (count == 0 && !reply_ends_empty)
        return;
    reply_ends_empty = reply_ends_empty && count == PACKET;
    copy(memory(CONTROL_BUFFER), reply_at, count);
    reply_at += count;
    reply_left = static_cast<uint16_t>(reply_left - count);
    control_in.arm(FULL | count);
}

// Answers with bytes, as many as were asked for at the most.
void reply(const void *octets, uint16_t count) {
    reply_at = static_cast<const uint8_t *>(octets);
    reply_left = count < setup.length ? count : setup.length;
    reply_ends_empty = count < setup.length && count % PACKET == 0;
    send_reply();
    control_out.pid = DATA1;
    control_out.arm(0);  // the host's empty packet ends the transfer
}

void acknowledge() {
    reply_left = 0;
    reply_ends_empty = true;
    send_reply();
}

void refuse() {
    set_bits(USB_EP_STALL_ARM, 3);
    at(control_in.buffer_control()) = STALL;
    at(control_out.buffer_control()) = STALL;
}

void reply_descriptor() {
    const uint8_t index = static_cast<uint8_t>(setup.value);
    switch (setup.value >> 8) {
    case DESCRIPTOR_DEVICE:
        return reply(&DEVICE_DESCRIPTOR, sizeof DEVICE_DESCRIPTOR);
    case DESCRIPTOR_CONFIGURATION:
        return reply(&CONFIGURATION_DESCRIPTOR, sizeof CONFIGURATION_DESCRIPTOR);
    case DESCRIPTOR_STRING:
        if (index == STRING_SERIAL_NUMBER)
            return reply(serial_number, sizeof serial_number);
        if (index < STRINGS)
            return reply(STRING_DESCRIPTORS[index], STRING_DESCRIPTORS[index][0]);
        return refuse();
    default:
        return refuse();
    }
}

// The host has chosen the configuration: the endpoints begin, with DATA0.
void configure(uint8_t chosen) {
    configuration = chosen;
    data_in.reset();
    data_out.reset();
    port_open = false;
    if (chosen == 0)
        return;
    at(USB_DPRAM + NOTIFY_CONTROL) = ENABLED | EACH_BUFFER | INTERRUPT | NOTIFY_BUFFER;
    at(USB_DPRAM + IN_CONTROL) = ENABLED | EACH_BUFFER | BULK | IN_BUFFERS[0];
    at(USB_DPRAM + OUT_CONTROL) = ENABLED | EACH_BUFFER | BULK | OUT_BUFFER;
    data_out.arm(PACKET);
}

// The requests that change something and have no data.
void carry_out() {
    constexpr uint16_t DTR = 1, ENDPOINT_HALT = 0;
    switch (setup.kind << 8 | setup.request) {
    case 0x0005:  // SET_ADDRESS
        new_address = static_cast<uint8_t>(setup.value & 0x7F);
        return acknowledge();
    case 0x0009:  // SET_CONFIGURATION
        configure(static_cast<uint8_t>(setup.value));
        return acknowledge();
    case 0x010B:  // SET_INTERFACE: there is one setting
        return acknowledge();
    case 0x0201:  // CLEAR_FEATURE of an endpoint: its packets begin with DATA0 again
        if (setup.value == ENDPOINT_HALT && setup.index == DATA_IN)
            data_in.begin_again();
        if (setup.value == ENDPOINT_HALT && setup.index == DATA_OUT)
            data_out.begin_again();
        return acknowledge();
    case 0x2122:  // SET_CONTROL_LINE_STATE
        port_open = setup.value & DTR;
        opened |= port_open;
        return acknowledge();
    case 0x2123:  // SEND_BREAK
        return acknowledge();
    default:
        return refuse();
    }
}

void take_setup() {
    const uint32_t low = at(USB_DPRAM + SETUP), high = at(USB_DPRAM + SETUP + 4);
    setup = {static_cast<uint8_t>(low), static_cast<uint8_t>(low >> 8),
             static_cast<uint16_t>(low >> 16), static_cast<uint16_t>(high),
             static_cast<uint16_t>(high >> 16)};
    control_in.reset();
    control_out.reset();
    control_in.pid = control_out.pid = DATA1;
    new_address = 0;
    line_coding_comes = false;
    short_reply[0] = short_reply[1] = 0;
    switch (setup.kind << 8 | setup.request) {
    case 0x8006:  // GET_DESCRIPTOR
        return reply_descriptor();
    case 0x8008:  // GET_CONFIGURATION
        return reply(&configuration, 1);
    case 0x8000:  // GET_STATUS of device, interface, endpoint: nothing to say
    case 0x8100:
    case 0x8200:
        return reply(short_reply, 2);
    case 0xA121:  // GET_LINE_CODING
        return reply(&line_coding, sizeof line_coding);
    case 0x2120:  // SET_LINE_CODING: it follows
        line_coding_comes = setup.length == sizeof line_coding;
        return line_coding_comes ? control_out.arm(PACKET) : refuse();
    default:
        return carry_out();
    }
}

void control_in_done() {
    control_in.armed = false;
    if (new_address != 0) {
        at(USB_ADDR_ENDP) = new_address;
        new_address = 0;
    }
    send_reply();
}

void control_out_done() {
    control_out.armed = false;
    if (!line_coding_comes)
        return;
    line_coding_comes = false;
    copy(reinterpret_cast<uint8_t *>(&line_coding), memory(CONTROL_BUFFER), sizeof line_coding);
    acknowledge();
}

void bus_reset() {
    at(USB_ADDR_ENDP) = 0;
    configure(0);
    new_address = 0;
}

// ------------------------------------------------------------------------------ the port's data
// A packet that is not full leaves when its first byte has waited this long [us]. Chosen: short
// beside a scan, and a host is not woken for a handful of bytes.
constexpr uint32_t WAIT_US = 250;

uint8_t filling;     // which of IN_BUFFERS takes bytes; the other one may be the controller's
uint8_t filled;      // bytes in it
uint32_t filled_us;  // when the first of them came, about
bool ended_full;     // the last packet was full: the host takes the next, be it empty, as the end
uint32_t now;        // [us], of the last poll()
uint8_t taken, arrived;  // of the packet from the host: bytes read, and there

void send_packet() {
    at(USB_DPRAM + IN_CONTROL) = ENABLED | EACH_BUFFER | BULK | IN_BUFFERS[filling];
    data_in.arm(FULL | filled);
    ended_full = filled == PACKET;
    filling ^= 1;
    filled = 0;
    filled_us = now;
}

void send_what_waits() {
    if (data_in.armed)
        return;
    const bool waited = now - filled_us >= WAIT_US;
    if (filled == PACKET || ((filled != 0 || ended_full) && waited))
        send_packet();
}

}  // namespace

void begin() {
    for (uint32_t offset = 0; offset < 4096; offset += 4)
        at(USB_DPRAM + offset) = 0;
    uint8_t id[8];
    flash_store::read_unique_id(id);
    serial_number[0] = sizeof serial_number;
    serial_number[1] = DESCRIPTOR_STRING;
    for (uint8_t i = 0; i < 16; i++)
        serial_number[2 + 2 * i] =
            static_cast<uint8_t>("0123456789ABCDEF"[id[i / 2] >> (i & 1 ? 0 : 4) & 15]);
    at(USB_MUXING) = 1u << 3 | 1u << 0;  // the controller has the pins
    at(USB_PWR) = 1u << 3 | 1u << 2;     // there is a host: a Pico does not sense its voltage
    at(USB_MAIN_CTRL) = 1;
    at(USB_SIE_CTRL) = 1u << 29 | 1u << 16;  // each buffer of endpoint 0; pull-up: a device is here
}

void poll(uint32_t now_us) {
    now = now_us;
    const uint32_t happened = at(USB_SIE_STATUS);
    if (happened & BUS_RESET) {
        at(USB_SIE_STATUS) = BUS_RESET;
        bus_reset();
    }
    const uint32_t done = at(USB_BUFF_STATUS);
    if (done != 0) {
        at(USB_BUFF_STATUS) = done;
        if (done & 1u << control_in.index)
            control_in_done();
        if (done & 1u << control_out.index)
            control_out_done();
        if (done & 1u << data_in.index)
            data_in.armed = false;
        if (done & 1u << data_out.index && data_out.armed) {
            data_out.armed = false;
            taken = 0;
            arrived = data_out.length();
        }
    }
    if (happened & SETUP_RECEIVED) {
        at(USB_SIE_STATUS) = SETUP_RECEIVED;
        take_setup();
    }
    if (configuration == 0)
        return;
    if (taken == arrived && !data_out.armed)
        data_out.arm(PACKET);
    if (opened)
        send_what_waits();
}

void wake_at_news() {
    constexpr uint32_t SETUP_REQUEST = 1u << 16, RESET_SEEN = 1u << 12, BUFFERS = 1u << 4;
    at(USB_INTE) = SETUP_REQUEST | RESET_SEEN | BUFFERS;
}

void wake_no_more() { at(USB_INTE) = 0; }

bool can_write() { return (opened && !port_open) || filled < PACKET; }

void write(uint8_t octet) {
    if (opened && !port_open)
        return;  // nobody reads
    if (filled == 0)
        filled_us = now;
    memory(IN_BUFFERS[filling])[filled++] = octet;
    if (filled == PACKET && !data_in.armed && configuration != 0 && opened)
        send_packet();
}

bool idle() { return (opened && !port_open) || (filled == 0 && !data_in.armed); }

bool has_byte() { return taken < arrived && !data_out.armed; }

uint8_t read() { return memory(OUT_BUFFER)[taken++]; }

}  // namespace usb_serial
