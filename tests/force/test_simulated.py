# SPDX-License-Identifier: Apache-2.0
"""A skin that a program presses: what comes out is what went in, as a calibrated skin has it."""

import re
from collections.abc import Callable
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

import ohmskin
from calibrations import NEWTON_SIEMENS, of_scene
from ohmskin.arrays import Float
from ohmskin.estimate.knowledge import WireOhm
from ohmskin.force.curve import POWER


def fingertip(total_n: float, row: float = 4.2, column: float = 3.3) -> Float:
    """A force that is spread over a pitch, (8, 8) [N]."""
    away = (np.arange(8)[:, None] - row) ** 2 + (np.arange(8) - column) ** 2
    pressure = np.exp(-away / 2)
    return np.asarray(total_n * pressure / pressure.sum())


@pytest.mark.parametrize("exponent", [1.0, 0.6, 1.7])
def test_a_rise_is_that_of_the_force(exponent: float) -> None:
    """F = a x^b, by hand."""
    model = of_scene("rest").model
    kind = model.kind if exponent == 1 else np.full((8, 8), POWER)
    model = replace(model, kind=kind, exponent=np.full((8, 8), exponent))
    rise = model.rise(np.full((8, 8), 3.0))
    assert model.slope[0, 0] * rise[0, 0] ** exponent == pytest.approx(3.0)
    assert model.predict(rise, 0 * rise)[0] == pytest.approx(np.full((8, 8), 3.0))
    assert model.rise(np.zeros((8, 8))) == pytest.approx(np.zeros((8, 8)))


@pytest.mark.parametrize("seed", [0, 1])
def test_what_presses_is_read(seed: int) -> None:
    skin = ohmskin.SimulatedSkin(of_scene("rest"), seed=seed)
    untouched = skin.step(np.zeros((8, 8)), 0.0)
    assert not untouched.contacts
    totals_n = 5.5 + 4.5 * np.sin(np.arange(60) / 8)
    read_n = [
        skin.step(fingertip(total_n), 0.1 + k / 90).force_n.sum()
        for k, total_n in enumerate(totals_n)
    ]
    assert np.sqrt(np.mean((read_n - totals_n) ** 2)) < 0.02 * totals_n.mean()


def test_a_scan_has_the_time_of_the_simulation() -> None:
    skin = ohmskin.SimulatedSkin(of_scene("rest"))
    scans = [skin.step(fingertip(3.0), time_s) for time_s in (0.0, 0.01, 0.5)]
    assert [scan.time_ns for scan in scans] == [0, 10_000_000, 500_000_000]
    assert [scan.number for scan in scans] == [1, 2, 3]
    assert [contact.identity for contact in scans[1].contacts] == [1]


def test_its_skin_is_that_of_the_calibration() -> None:
    """A cell of 20 uS a newton, pressed by 1 N, by the estimate of the scan."""
    skin = ohmskin.SimulatedSkin(of_scene("rest"), noise_lsb=0.0)
    force_n = np.zeros((8, 8))
    force_n[2, 5] = 1.0
    scan = skin.step(force_n, 0.0)
    rest = skin.calibration.untouched.level[2, 5]
    assert scan.estimate.cell_siemens[2, 5] - rest == pytest.approx(NEWTON_SIEMENS, rel=0.02)


def test_a_line_with_a_lead_of_its_own_is_read_as_the_others() -> None:
    """3 kohm more at row 2: of 8 N there, 2.8 N are lost where nobody knows it."""
    own_ohm = np.zeros(16)
    own_ohm[2] = 3000.0
    force_n = np.zeros((8, 8))
    force_n[2, 5] = 8.0
    known = replace(of_scene("rest"), own_lead_ohm=own_ohm)
    scan = ohmskin.SimulatedSkin(known, noise_lsb=0.0).step(force_n, 0.0)
    assert scan.force_n[2, 5] == pytest.approx(8.0, rel=0.03)


def test_its_wires_are_those_of_the_curves() -> None:
    """Others were learned since the presses."""
    wires = WireOhm(250.0, 500.0, 80.0, 0.05, 0.05, 20.0, 100.0, 200.0, 80.0)
    skin = ohmskin.SimulatedSkin(replace(of_scene("rest"), nominal_wire_ohm=wires))
    read_n = [skin.step(fingertip(6.0), 0.01 * k).force_n.sum() for k in range(10)]
    assert read_n == pytest.approx(10 * [6.0], rel=0.03)
    assert skin.calibration.nominal_wire_ohm.both == (100.0, 200.0)


def test_it_is_read_in_real_time() -> None:
    skin = ohmskin.SimulatedSkin(of_scene("rest"))
    with skin.opened(lambda _: fingertip(6.0)) as opened:
        read_n = [scan.force_n.sum() for scan in islice(opened, 10)]
    assert read_n == pytest.approx(10 * [6.0], rel=0.03)


@pytest.mark.parametrize("wrong", [-1.0, np.nan, np.inf])
def test_no_such_force(wrong: float) -> None:
    skin = ohmskin.SimulatedSkin(of_scene("rest"))
    with pytest.raises(ValueError, match=r"force_n of cell \(0, 0\) is negative or not finite"):
        skin.step(np.full((8, 8), wrong), 0.0)
    with pytest.raises(ValueError, match="force_n has shape"):
        skin.step(np.zeros((4, 4)), 0.0)


@pytest.mark.filterwarnings("error")
def test_a_force_that_its_curve_does_not_reach() -> None:
    """It was said of the conductances of cells, after a warning."""
    known = of_scene("rest")
    model = replace(known.model, kind=np.full((8, 8), "power"), exponent=np.full((8, 8), 0.25))
    skin = ohmskin.SimulatedSkin(replace(known, model=model))
    with pytest.raises(ValueError, match=r"force_n of cell \(0, 0\) is more than its curve reach"):
        skin.step(np.full((8, 8), 1e90), 0.0)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e303, -1e10])
def test_no_such_time(wrong: float) -> None:
    skin = ohmskin.SimulatedSkin(of_scene("rest"))
    with pytest.raises(ValueError, match=r"time_s is \S+, it must be a time within 9e\+09 s"):
        skin.step(np.zeros((8, 8)), wrong)


@pytest.mark.parametrize(
    ("force_n", "said"),
    [(lambda _: 1 / 0, "ZeroDivisionError"), (lambda _: np.zeros((4, 4)), "force_n has shape")],
)
def test_an_error_of_the_callable_is_said(force_n: Callable[[float], Float], said: str) -> None:
    """It was called a defect of this program."""
    skin = ohmskin.SimulatedSkin(of_scene("rest"))
    with skin.opened(force_n) as opened, pytest.raises(ohmskin.DeviceLost) as raised:
        next(iter(opened))
    assert re.match(rf"simulated skin: force_n\(0\.\d+\) raised .*{said}", str(raised.value))


def test_voltages_know_no_cells() -> None:
    with pytest.raises(ValueError, match="take another method"):
        ohmskin.SimulatedSkin(of_scene("rest", method="voltage", siemens=1.0))
