# SPDX-License-Identifier: Apache-2.0
"""Seeded mutations, for the short run of `make test`, which needs no atheris."""

import random
from collections.abc import Iterator, Sequence

# Numbers and words at which readers stumble.
_WORDS = (
    *(
        b"0",
        b"-1",
        b"1e308",
        b"-1e999",
        b"NaN",
        b"9" * 400,
        b"null",
        b"true",
        b'"',
        b"[" * 99,
        b"{}",
    ),
    *(b"\0", b"\xff" * 8, b"\n", b",", b"\x80\x81", b"&", b"="),
)


def mutated(inputs: Sequence[bytes], count: int, seed: int) -> Iterator[bytes]:
    """`count` mutations of these inputs, the same for a seed."""
    dice = random.Random(seed)
    for _ in range(count):
        octets = bytearray(dice.choice(inputs))
        for _ in range(1 << dice.randrange(4)):
            at = dice.randrange(len(octets) + 1)
            end = at + dice.choice((0, 1, 2, 8, 64))
            match dice.randrange(4):
                case 0:
                    octets[at:end] = dice.randbytes(end - at)
                case 1:
                    octets[at:end] = dice.choice(_WORDS)
                case 2:
                    other = dice.choice(inputs)
                    begin = dice.randrange(len(other) + 1)
                    octets[at:end] = other[begin : begin + dice.choice((1, 8, 64))]
                case _:
                    del octets[at:end]
        yield bytes(octets)
