# SPDX-License-Identifier: Apache-2.0
"""What a board would read of a skin, and what is told of the skin, for several test files."""

from ohmskin.arrays import Float
from ohmskin.estimate.base import NO_WIRES, SkinKnowledge, WireOhm
from ohmskin.link.codes import quantise, ratio_from_codes


def ten_bits(ratio: Float) -> Float:
    """Readings as a converter of 10 bits gives them."""
    return ratio_from_codes(quantise(ratio))


def told(rest_ratio: Float, *, wires: bool = True) -> SkinKnowledge:
    """Knowledge of a board of 10 bits: exact readings of the untouched skin, perhaps its wires."""
    return SkinKnowledge(
        *rest_ratio.shape[:2],
        adc_bits=10,
        rest_ratio=ten_bits(rest_ratio),
        nominal_wire_ohm=WireOhm(100.0, 200.0) if wires else NO_WIRES,
    )
