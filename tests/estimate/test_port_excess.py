# SPDX-License-Identifier: Apache-2.0
"""What whole frames show too much, by numbers of the module's equations that were worked out."""

import numpy as np
import pytest

from ohmskin.arrays import Float
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.port_excess import Excess

REF_OHM = 60_000.0  # R_s
LSB = 2.0 / REF_OHM / 1024  # [S] of a current that changes a reading by an LSB of 10 bits
B = (1,)


def excess_of(shape: tuple[int, int] = (8, 8)) -> Excess:
    return Excess(SkinKnowledge(*shape, adc_bits=10))


def found_lsb(excess: Excess, *frames: float | Float, kinds: tuple[int, ...] = B) -> float:
    """e [LSB] after frames of one reading [LSB], with a whole one in place of each second one."""
    for number, frame in enumerate(frames):
        current = np.full((8, 8), LSB) * frame
        if number % 2:
            excess.keep(current)
        else:
            after = excess.added(current, kinds)
    # It is added times h.
    return float(np.median((after - current) / (1.0 - REF_OHM * current)) / LSB)


HALF = np.where(np.arange(64).reshape(8, 8) % 2, 3.0, -1.0)
TOUCHED = np.where(np.arange(64).reshape(8, 8) < 40, 0.9 / REF_OHM / LSB, 1.0)


@pytest.mark.parametrize(
    ("frames", "expected_lsb"),
    [
        pytest.param((0, 1, 0), 1.0, id="all cells agree, and the skin stays"),
        pytest.param((0, 1, 2), 0.0, id="the skin changes steadily"),
        # w is 1 / LSB^2, and s_e is 1.024 LSB.
        pytest.param((0, 0, 2), -1.0 / (1.0 + 1.024**-2), id="the skin changes after it"),
        # The median of 64 cells, off by 2 LSB: its variance is 0.216 LSB^2.
        pytest.param((0, HALF, 0), 1.0 / (1.0 + 0.216 / 1.024**2), id="cells disagree"),
        pytest.param((0, 3, 0), 3.0, id="nearly too much"),
        pytest.param((0, 3.1, 0), 0.0, id="too much"),
        pytest.param((0, TOUCHED, 0), 1.0, id="touched cells do not count"),
        # Each whole frame takes a thirtieth off those before it.
        pytest.param((0, *20 * (1, 0), *20 * (0, 0)), 1 / (1 + (30 / 29) ** 20), id="it is gone"),
    ],
)
def test_whole_frames_show_the_excess(
    frames: tuple[float | Float, ...], expected_lsb: float
) -> None:
    assert found_lsb(excess_of(), *frames) == pytest.approx(expected_lsb, abs=0.02)


def test_frames_that_do_not_alternate_show_nothing() -> None:
    excess = excess_of()
    found_lsb(excess, 0, 1)
    excess.keep(np.full((8, 8), LSB))
    assert found_lsb(excess, 0) == 0.0
    assert found_lsb(excess, 0, 1, 0) == pytest.approx(1.0, abs=0.01)
    # Those of other readings may show another excess.
    found_lsb(excess, 0, 1)
    assert found_lsb(excess, 0, kinds=(0, 1)) == 0.0


def test_few_cells_show_nothing() -> None:
    """Of 64, as many as were read in a region."""
    for read, expected_lsb in ((16, 1.0), (15, 0.0)):
        region = np.where(np.arange(64).reshape(8, 8) < read, 0.0, np.nan)
        excess = excess_of()
        found_lsb(excess, region, 1.0)
        after = excess.added(region, B)
        assert np.nanmedian(after) / LSB == pytest.approx(expected_lsb, abs=0.02)
        np.testing.assert_array_equal(np.isnan(after), np.isnan(region))
