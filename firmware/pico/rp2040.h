// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <stdint.h>

// Registers of the RP2040 that this firmware uses, by the names of its data sheet. Each block also
// answers at three other addresses, where a write sets, clears or flips bits alone.
namespace rp2040 {

inline volatile uint32_t &at(uint32_t address) {
    return *reinterpret_cast<volatile uint32_t *>(address);
}
inline void set_bits(uint32_t address, uint32_t bits) { at(address + 0x2000) = bits; }
inline void clear_bits(uint32_t address, uint32_t bits) { at(address + 0x3000) = bits; }

enum Clocks : uint32_t {
    CLK_REF_CTRL = 0x40008030,
    CLK_REF_SELECTED = 0x40008038,
    CLK_SYS_CTRL = 0x4000803C,
    CLK_SYS_SELECTED = 0x40008044,
    CLK_USB_CTRL = 0x40008054,
    CLK_ADC_CTRL = 0x40008060,
    XOSC_CTRL = 0x40024000,
    XOSC_STATUS = 0x40024004,
    XOSC_STARTUP = 0x4002400C,
    PLL_SYS = 0x40028000,
    PLL_USB = 0x4002C000,
};
enum PllOffset : uint32_t { PLL_CS = 0, PLL_PWR = 4, PLL_FBDIV_INT = 8, PLL_PRIM = 12 };

enum Chip : uint32_t {
    RESETS = 0x4000C000,
    RESET_DONE = 0x4000C008,
    PSM_WDSEL = 0x40010008,
    WATCHDOG_CTRL = 0x40058000,
    WATCHDOG_LOAD = 0x40058004,
    WATCHDOG_REASON = 0x40058008,
    WATCHDOG_SCRATCH4 = 0x4005801C,
    WATCHDOG_TICK = 0x4005802C,
    CHIP_RESET = 0x40064008,
    TIMER_ALARM0 = 0x40054010,
    TIMERAWL = 0x40054028,
    TIMER_INTR = 0x40054034,
    TIMER_INTE = 0x40054038,
    NVIC_ISER = 0xE000E100,
    NVIC_ICER = 0xE000E180,
    NVIC_ICPR = 0xE000E280,
    NVIC_IPR0 = 0xE000E400,
    NVIC_IPR1 = 0xE000E404,
};
// Bits of RESETS.
enum Block : uint32_t {
    BLOCK_ADC = 1u << 0,
    BLOCK_IO_BANK0 = 1u << 5,
    BLOCK_IO_QSPI = 1u << 6,
    BLOCK_PADS_BANK0 = 1u << 8,
    BLOCK_PLL_SYS = 1u << 12,
    BLOCK_PLL_USB = 1u << 13,
    BLOCK_PWM = 1u << 14,
    BLOCK_TIMER = 1u << 21,
    BLOCK_USBCTRL = 1u << 24,
};

enum Pins : uint32_t {
    GPIO0_CTRL = 0x40014004,  // the next pin's is 8 bytes further
    PADS_GPIO0 = 0x4001C004,  // the next pin's is 4 bytes further
    SIO_GPIO_OUT = 0xD0000010,
    SIO_GPIO_OUT_CLR = 0xD0000018,
    SIO_GPIO_OUT_XOR = 0xD000001C,
    SIO_GPIO_OE_SET = 0xD0000024,
};

enum Converter : uint32_t { ADC_CS = 0x4004C000, ADC_RESULT = 0x4004C004 };
enum ConverterBits : uint32_t { ADC_EN = 1, ADC_START_ONCE = 1u << 2, ADC_READY = 1u << 8 };

enum Pwm : uint32_t {  // of slice 0
    PWM_CSR = 0x40050000,
    PWM_DIV = 0x40050004,
    PWM_CTR = 0x40050008,
    PWM_TOP = 0x40050010,
    PWM_INTR = 0x400500A4,
    PWM_INTE = 0x400500A8,
};

enum Ssi : uint32_t {
    SSI_CTRLR0 = 0x18000000,
    SSI_SSIENR = 0x18000008,
    SSI_SER = 0x18000010,
    SSI_BAUDR = 0x18000014,
    SSI_RXFLR = 0x18000024,
    SSI_DR0 = 0x18000060,
    QSPI_SS_CTRL = 0x4001800C,
};

enum Usb : uint32_t {
    USB_DPRAM = 0x50100000,
    USB_ADDR_ENDP = 0x50110000,
    USB_MAIN_CTRL = 0x50110040,
    USB_SIE_CTRL = 0x5011004C,
    USB_SIE_STATUS = 0x50110050,
    USB_BUFF_STATUS = 0x50110058,
    USB_EP_STALL_ARM = 0x50110068,
    USB_MUXING = 0x50110074,
    USB_PWR = 0x50110078,
    USB_INTE = 0x50110090,
};

}  // namespace rp2040
