# SPDX-License-Identifier: Apache-2.0
"""From the converter's codes to ratios of its supply, and back."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ohmskin.arrays import Float
from ohmskin.link.protocol import ADC_BITS

# Standard deviation of a ratio that is called exact [V/Vdd]: a circuit solver gives nine digits. It
# is not 0, because estimators divide by it.
EXACT_RATIO_STD: Final = 1e-9


def check_adc_bits(bits: int) -> int:
    """`bits` if it is an integer from 1 to 16, which codes are kept in, else ValueError."""
    if isinstance(bits, bool) or not 1 <= bits <= 16 or int(bits) != bits:
        raise ValueError(f"adc bits must be an integer from 1 to 16, not {bits}")
    return int(bits)


def quantise(ratio: ArrayLike, bits: int = ADC_BITS) -> NDArray[np.uint16]:
    """ADC codes min(2^bits - 1, floor(ratio 2^bits)), same shape; a ratio below 0 gives 0.

    Raises ValueError for a ratio that is not a number.
    """
    full_scale = 1 << check_adc_bits(bits)
    ratios = np.asarray(ratio, dtype=np.float64)
    if np.isnan(ratios).any():
        raise ValueError("a ratio to quantise is not a number")
    return np.clip(np.floor(ratios * full_scale), 0, full_scale - 1).astype(np.uint16)


def ratio_from_codes(codes: ArrayLike, bits: int = ADC_BITS) -> Float:
    """Ratio in the middle of each code's interval, (code + 0.5) / 2^bits, same shape.

    The middle, because a converter rounds down: code / 2^bits would be low by half a code on
    average.
    """
    full_scale = 1 << check_adc_bits(bits)
    return np.asarray((np.asarray(codes, dtype=np.float64) + 0.5) / full_scale, dtype=np.float64)


def ratio_std(bits: int | None) -> float:
    """Standard deviation of a reading by its rounding [V/Vdd]; None: of a reading called exact.

    1 / (2^bits sqrt(12)): that of a value that lies anywhere in the interval of its code.
    """
    return EXACT_RATIO_STD if bits is None else 1.0 / ((1 << check_adc_bits(bits)) * 12**0.5)
