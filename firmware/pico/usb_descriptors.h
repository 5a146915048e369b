// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

// What the board tells a host of itself: USB 2.0, 9.6; CDC 1.2, 5.2.3; PSTN 1.2, 5.3.
namespace usb_serial {

enum Descriptor : uint8_t {
    DESCRIPTOR_DEVICE = 1,
    DESCRIPTOR_CONFIGURATION = 2,
    DESCRIPTOR_STRING = 3,
};

// Endpoints: the two of the port's data, and one for notifications, of which there are none.
constexpr uint8_t NOTIFY_IN = 0x81, DATA_OUT = 0x02, DATA_IN = 0x82;
// Bytes of a packet, of control transfers too: the most that full speed has.
constexpr uint8_t DATA_PACKET = 64;

// pid.codes' ids for trying things out: nobody has asked for ids of our own yet.
constexpr uint16_t VENDOR_ID = 0x1209, PRODUCT_ID = 0x0001;

constexpr uint8_t STRING_MAKER = 1, STRING_PRODUCT = 2, STRING_SERIAL_NUMBER = 3;

struct __attribute__((packed)) LineCoding {
    uint32_t baud;
    uint8_t stop_bits, parity, data_bits;
};

constexpr uint8_t low(uint16_t word) { return static_cast<uint8_t>(word); }
constexpr uint8_t high(uint16_t word) { return static_cast<uint8_t>(word >> 8); }

constexpr uint8_t DEVICE_DESCRIPTOR[] = {
    18,
    DESCRIPTOR_DEVICE,
    0x00,
    0x02,  // USB 2.0
    0xEF,
    2,
    1,  // interfaces that belong together
    DATA_PACKET,
    low(VENDOR_ID),
    high(VENDOR_ID),
    low(PRODUCT_ID),
    high(PRODUCT_ID),
    0x00,
    0x01,  // release 1.00 of the device
    STRING_MAKER,
    STRING_PRODUCT,
    STRING_SERIAL_NUMBER,
    1,  // configuration
};

constexpr uint8_t CONFIGURATION_DESCRIPTOR[] = {
    9,           DESCRIPTOR_CONFIGURATION,
    75,          0,
    2,           1,
    0,           0x80,
    250,  // two interfaces, 500 mA from the bus
    8,           11,
    0,           2,
    2,           2,
    0,           0,  // they belong together
    9,           4,
    0,           0,
    1,           2,
    2,           0,
    0,  // 0: control, CDC-ACM
    5,           0x24,
    0,           0x20,
    0x01,  // header: CDC 1.2
    5,           0x24,
    1,           0,
    1,  // calls: none, data on interface 1
    4,           0x24,
    2,           2,  // line coding and state
    5,           0x24,
    6,           0,
    1,  // union of 0 and 1
    7,           5,
    NOTIFY_IN,   3,
    8,           0,
    16,  // interrupt, every 16 ms
    9,           4,
    1,           0,
    2,           10,
    0,           0,
    0,  // 1: data
    7,           5,
    DATA_OUT,    2,
    DATA_PACKET, 0,
    0,  // bulk
    7,           5,
    DATA_IN,     2,
    DATA_PACKET, 0,
    0,
};
static_assert(sizeof CONFIGURATION_DESCRIPTOR == 75, "its own third byte says so");

constexpr uint8_t LANGUAGES[] = {4, DESCRIPTOR_STRING, 0x09, 0x04};  // English
constexpr uint8_t MAKER[] = {
    16, DESCRIPTOR_STRING, 'o', 0, 'h', 0, 'm', 0, 's', 0, 'k', 0, 'i', 0, 'n', 0};
constexpr uint8_t PRODUCT[] = {26,  DESCRIPTOR_STRING,
                               'o', 0,
                               'h', 0,
                               'm', 0,
                               's', 0,
                               'k', 0,
                               'i', 0,
                               'n', 0,
                               ' ', 0,
                               'p', 0,
                               'i', 0,
                               'c', 0,
                               'o', 0};
constexpr const uint8_t *STRING_DESCRIPTORS[] = {LANGUAGES, MAKER, PRODUCT};
constexpr uint8_t STRINGS = 3;

}  // namespace usb_serial
