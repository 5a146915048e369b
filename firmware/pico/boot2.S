// SPDX-License-Identifier: Apache-2.0
// The second stage of the boot. The chip's ROM loads these 252 bytes and their CRC (firmware/pico/
// uf2.py computes it) from the flash to RAM, and runs them there. They copy the firmware to RAM,
// too, and start it. Nothing runs from the flash after that: a scan never waits for the flash, and
// settings are written to it while the scan goes on.
//
// The flash is read by its slowest command, 03h, which every chip has had since before RP2040.
    .syntax unified
    .cpu cortex-m0plus
    .thumb
    .section .boot2, "ax"
    .global boot2
boot2:
    ldr r3, =0x18000000         // SSI
    movs r0, #0
    str r0, [r3, #0x08]         // SSIENR: off, to be set
    movs r0, #2
    str r0, [r3, #0x14]         // BAUDR: half the ring oscillator's, which is at most 12 MHz
    ldr r0, =0x001F0300         // CTRLR0: frames of 32 bits, a command before each read
    str r0, [r3, #0x00]
    movs r0, #0
    str r0, [r3, #0x04]         // CTRLR1: one frame a read
    ldr r0, =0x03000218         // SPI_CTRLR0: command 03h of 8 bits, address of 24 bits
    ldr r1, =0x180000F4
    str r0, [r1]
    movs r0, #1
    str r0, [r3, #0x10]         // SER: the flash
    str r0, [r3, #0x08]         // SSIENR: on
    ldr r0, =image_in_flash
    ldr r1, =image_start
    ldr r2, =image_end
1:  ldmia r0!, {r3}
    stmia r1!, {r3}
    cmp r1, r2
    blo 1b
    ldr r0, =image_start        // the vector table: stack pointer, and where to begin
    ldr r1, =0xE000ED08         // VTOR
    str r0, [r1]
    ldmia r0!, {r1, r2}
    msr msp, r1
    bx r2
    .ltorg
