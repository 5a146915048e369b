# SPDX-License-Identifier: Apache-2.0
"""Make the image of a Pico's flash, as UF2, which its boot loader takes: uf2.py IMAGE.bin OUT.uf2.

The first 252 bytes of the image are boot2; the ROM starts it only with its CRC behind it (RP2040's
data sheet, 2.8.1.3.1). UF2 has blocks of 512 bytes with 256 of flash: github.com/microsoft/uf2.
"""

import struct
import sys
from pathlib import Path

FLASH_AT = 0x10000000
BOOT2_BYTES = 252
BLOCK_BYTES = 256
UF2_BEGIN = (0x0A324655, 0x9E5D5157)
UF2_END = 0x0AB16F30
FAMILY_PRESENT = 0x2000
RP2040_FAMILY = 0xE48BFF56


def crc32(octets: bytes) -> int:
    """CRC-32/MPEG-2: polynomial 04C11DB7, not reflected, begins with ones, no final xor."""
    crc = 0xFFFFFFFF
    for octet in octets:
        crc ^= octet << 24
        for _ in range(8):
            crc = crc << 1 ^ (0x104C11DB7 if crc & 0x80000000 else 0)
    return crc


def with_crc(image: bytes) -> bytes:
    """The image with boot2's CRC in its place."""
    boot2 = image[:BOOT2_BYTES]
    return boot2 + struct.pack("<I", crc32(boot2)) + image[BOOT2_BYTES + 4 :]


def uf2(image: bytes) -> bytes:
    """The blocks that write an image to the flash's begin."""
    image += bytes(-len(image) % BLOCK_BYTES)
    blocks = len(image) // BLOCK_BYTES
    return b"".join(
        struct.pack(
            "<8I476sI",
            *UF2_BEGIN,
            FAMILY_PRESENT,
            FLASH_AT + BLOCK_BYTES * block,
            BLOCK_BYTES,
            block,
            blocks,
            RP2040_FAMILY,
            image[BLOCK_BYTES * block : BLOCK_BYTES * (block + 1)],
            UF2_END,
        )
        for block in range(blocks)
    )


if __name__ == "__main__":
    source, target = map(Path, sys.argv[1:])
    target.write_bytes(uf2(with_crc(source.read_bytes())))
