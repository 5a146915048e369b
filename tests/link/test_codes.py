# SPDX-License-Identifier: Apache-2.0
"""Codes of the converter and the ratios that they stand for."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ohmskin.link.codes import quantise, ratio_from_codes, ratio_std


def test_codes() -> None:
    ratio = [-0.1, 0.0, 1 / 1024 - 1e-12, 1 / 1024, 0.5, 1023 / 1024, 1.0, 1.5]
    assert quantise(ratio).tolist() == [0, 0, 0, 1, 512, 1023, 1023, 1023]
    assert ratio_from_codes([0, 512, 1023]).tolist() == [0.5 / 1024, 512.5 / 1024, 1023.5 / 1024]
    assert quantise([0.5, 1.0], bits=12).tolist() == [2048, 4095]
    assert ratio_std(10) == pytest.approx(1 / 1024 / np.sqrt(12))


@given(st.integers(1, 16), st.floats(0, 1))
def test_a_code_is_within_half_a_step_of_its_ratio(bits: int, ratio: float) -> None:
    assert abs(ratio_from_codes(quantise(ratio, bits), bits) - ratio) <= 0.5 / 2**bits
    codes = np.arange(2**bits)
    np.testing.assert_array_equal(quantise(ratio_from_codes(codes, bits), bits), codes)


@pytest.mark.parametrize("bits", [0, 17, 10.5, True, float("nan"), float("inf")])
def test_impossible_adc_bits_are_refused(bits: int) -> None:
    with pytest.raises(ValueError, match="adc bits"):
        quantise(0.5, bits)


def test_a_ratio_that_is_no_number_has_no_code() -> None:
    with pytest.raises(ValueError, match="not a number"):
        quantise([0.5, np.nan])
