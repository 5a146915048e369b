# SPDX-License-Identifier: Apache-2.0
"""The search for the wires of a kneaded skin, behind paths whose resistances are known exactly."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy.integrate import quad

from ohmskin.arrays import Float
from ohmskin.calibrate.kneaded_wires import (
    LIKELY,
    TRIAL_CELLS,
    Shown,
    WireSearch,
    likely_wires,
)
from ohmskin.calibrate.scale import Scale
from ohmskin.calibrate.totals import TotalFit, Totals
from ohmskin.estimate.knowledge import NO_WIRES, WireOhm

SHAPE, PRESSES, STEP_S, PERIOD_S = (4, 5), 160, 0.02, 0.6
ROW, COLUMN = np.indices(SHAPE).reshape(2, -1)
TOP_SEGMENTS, BOTTOM_SEGMENTS = COLUMN + 1, ROW + 1
LEADS = np.vstack([np.arange(4)[:, None] == ROW, np.arange(5)[:, None] == COLUMN])  # of each cell
EVEN = np.zeros(9)


@dataclass
class Skin:
    """Presses of three cells each, whose contacts are in series with their paths alone.

    An estimator that believes other wires sees what is left of the measured resistance of each cell
    without the path that it believes in. Nothing of it is the package's.
    """

    top_ohm: float
    bottom_ohm: float
    noise: float = 0.02
    siemens_at_1n: float = 4e-5
    own_lead_ohm: Float = field(default_factory=lambda: EVEN)
    believed: list[tuple[float, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        random, cells = np.random.default_rng(7), SHAPE[0] * SHAPE[1]
        self._time_s = np.arange(0.0, PERIOD_S * PRESSES, STEP_S)
        number, phase_s = np.divmod(self._time_s, PERIOD_S)
        is_pressed = phase_s < 0.4
        self._press = np.where(is_pressed, number, -1).astype(np.intp)
        peaks_n = np.zeros((PRESSES, cells))
        for peak_n in peaks_n:
            peak_n[random.choice(cells, 3, replace=False)] = random.uniform(0.5, 5.0, 3)
        wave = np.where(is_pressed, np.sin(np.pi * phase_s / 0.4), 0.0)
        force_n = peaks_n[number.astype(int)] * wave[:, None]
        siemens = self.siemens_at_1n * np.exp(0.15 * random.standard_normal(cells)) * force_n**1.5
        self._rise = siemens / (
            1 + siemens * self._path(self.top_ohm, self.bottom_ohm, self.own_lead_ohm)
        )
        factors = 1 + self.noise * random.standard_normal(PRESSES)
        total_n = force_n.sum(axis=1) * factors[number.astype(int)]
        self._shown_s = np.arange(0.5, self._time_s[-1], 0.1)
        self._shown_n = Scale(0.05, 0.1).shown(self._time_s, total_n[:, None], self._shown_s)[:, 0]
        self._shown_n += 0.01 * random.standard_normal(self._shown_s.size)

    @staticmethod
    def _path(top_ohm: float, bottom_ohm: float, own_ohm: Float) -> Float:
        return np.asarray(TOP_SEGMENTS * top_ohm + BOTTOM_SEGMENTS * bottom_ohm + own_ohm @ LEADS)

    def seen(self, top_ohm: float, bottom_ohm: float, own_ohm: Float) -> Float:
        """What an estimator that believes these wires sees of the contacts [S]."""
        path_ohm = self._path(top_ohm, bottom_ohm, own_ohm)
        return np.asarray(self._rise / np.maximum(1 - self._rise * path_ohm, 0.02))

    def show(self, wires: WireOhm, own_ohm: Float, most_cells: int) -> Shown:
        assert most_cells >= 60_000
        both = wires.top or 150.0, wires.bottom or 150.0  # such scans teach nothing of wires
        self.believed.append(both)
        rise = self.seen(*both, own_ohm)
        by_paths = [TOP_SEGMENTS * both[0], BOTTOM_SEGMENTS * both[1], *LEADS]
        slopes = rise * np.array(by_paths)[:, None, :]
        none = np.zeros_like(self._time_s)
        of_skin = self._time_s, rise, self._press, none
        totals = Totals(SHAPE, *of_skin, self._shown_s, self._shown_n)
        return Shown(totals, slopes, np.arange(rise.shape[0]), wires)


@pytest.mark.parametrize("ohm", [(20.0, 40.0), (100.0, 200.0), (60.0, 900.0), (1000.0, 2000.0)])
def test_wires_are_found_from_a_start_far_away(ohm: tuple[float, float]) -> None:
    skin = Skin(*ohm)
    with_leads = WireSearch(NO_WIRES, SHAPE, skin.show).found()
    assert with_leads.own_lead_ohm is None
    found = with_leads.wires
    assert found.both is not None
    assert found.top_log_std is not None
    assert found.bottom_log_std is not None
    off = np.abs(np.log(np.array(found.both) / ohm))
    stated = np.array([found.top_log_std, found.bottom_log_std])
    assert (off < np.maximum(3 * stated, 0.1)).all(), (found, len(skin.believed))
    longest_ohm = np.array([TOP_SEGMENTS.max(), BOTTOM_SEGMENTS.max()]) * (
        np.array(found.both) - ohm
    )
    assert np.abs(longest_ohm).max() < 350  # what a hard press has
    assert len(skin.believed) < 12


@pytest.mark.parametrize(("line", "own_ohm"), [(1, 1500.0), (7, 2500.0)])
def test_a_lead_unlike_the_others_is_found(line: int, own_ohm: float) -> None:
    """A row's and a column's. It passed for other wires, and forces erred ten times as much."""
    odd_ohm = EVEN.copy()
    odd_ohm[line] = own_ohm
    found = WireSearch(NO_WIRES, SHAPE, Skin(100.0, 200.0, own_lead_ohm=odd_ohm).show).found()
    assert found.own_lead_ohm is not None
    assert np.flatnonzero(found.own_lead_ohm).tolist() == [line]
    assert found.own_lead_ohm[line] == pytest.approx(own_ohm, rel=0.3)
    off = np.abs(np.log(np.array(found.wires.both) / (100.0, 200.0)))
    assert (off < 2 * np.array(found.wires[3:5])).all()


def test_a_step_that_is_too_long_is_halved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where presses told little of the wires, one step led to 1.4 kohm, and to no way back."""
    skin, usual = Skin(100.0, 200.0), TotalFit.wires

    def overdone(fit: TotalFit, *given: Float) -> tuple[Float, Float]:
        change, covariance = usual(fit, *given)
        return (5 if change.size == 2 else 1) * change, covariance  # of both layers

    monkeypatch.setattr(TotalFit, "wires", overdone)
    found = WireSearch(NO_WIRES, SHAPE, skin.show).found().wires
    assert max(bottom for _, bottom in skin.believed) > 350  # a step went too far
    assert found.top == pytest.approx(100, rel=0.4)
    assert found.bottom == pytest.approx(200, rel=0.4)


def test_a_step_that_was_too_long_is_not_taken_with_more_scans(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It was refused, halved and refused, and then taken whole, with nothing to compare it with."""
    skin, usual, usual_misfit = Skin(100.0, 200.0), TotalFit.wires, TotalFit.misfit
    cells: list[int] = []
    misfits: list[float] = []

    def overdone(fit: TotalFit, *given: Float) -> tuple[Float, Float]:
        change, covariance = usual(fit, *given)
        return (8 if change.size == 2 else 1) * change, covariance

    def noted(fit: TotalFit) -> float:
        misfits.append(usual_misfit(fit))
        return misfits[-1]

    def show(wires: WireOhm, own_ohm: Float, most_cells: int) -> Shown:
        cells.append(most_cells)
        return skin.show(wires, own_ohm, most_cells)

    monkeypatch.setattr(TotalFit, "wires", overdone)
    monkeypatch.setattr(TotalFit, "misfit", noted)
    WireSearch(NO_WIRES, SHAPE, show).found()
    more = cells.index(TRIAL_CELLS) - 1  # before the first trial, the scans alone are asked
    assert max(misfits[:more]) > min(misfits[:more]) + 0.3  # a step went too far
    assert misfits[more] < min(misfits[:more]) + LIKELY / PRESSES


def test_wires_that_presses_hardly_tell_are_unclear() -> None:
    """Deviations of 150 % were told without a word of what to press."""
    assert WireSearch(NO_WIRES, SHAPE, Skin(100.0, 200.0).show).found().unclear == ()
    soft = Skin(1000.0, 1500.0, noise=0.5, siemens_at_1n=1e-6)  # so soft that wires hardly count
    assert "top" in WireSearch(NO_WIRES, SHAPE, soft.show).found().unclear


def test_wires_that_were_told_are_evidence() -> None:
    """Presses that hardly tell them leave them as they were told; sure presses correct them."""
    told = WireOhm(150.0, 300.0, top_log_std=0.05, bottom_log_std=0.05)
    vague = WireSearch(told, SHAPE, Skin(100.0, 200.0, noise=0.5).show).found().wires
    assert vague.top == pytest.approx(150, rel=0.25)
    loose = told._replace(top_log_std=0.7, bottom_log_std=0.7)
    sure = WireSearch(loose, SHAPE, Skin(100.0, 200.0, noise=0.005).show).found().wires
    assert sure.top == pytest.approx(100, rel=0.15)
    assert sure.bottom == pytest.approx(200, rel=0.15)


def test_a_layer_that_was_told_alone_is_held_as_told_at_first() -> None:
    """It began at 50 ohm, like one that nobody has told."""
    skin = Skin(1000.0, 200.0)
    WireSearch(WireOhm(top=1000.0, top_log_std=0.05), SHAPE, skin.show).found()
    assert skin.believed[1] == pytest.approx((1000, 50))


def test_scans_teach_wires_and_lead_before_presses_do() -> None:
    """An emulated skin had leads of 0 to 245 ohm, by which trial was the last; it has 80."""
    skin, told = Skin(100.0, 200.0, noise=0.3), []

    def show(wires: WireOhm, own_ohm: Float, most_cells: int) -> Shown:
        shown = skin.show(wires, own_ohm, most_cells)
        told.append(wires)
        taught = WireOhm(120.0, 180.0, 70.0, 0.1, 0.1, 20.0)
        return shown if len(told) > 1 else shown._replace(wires=taught)

    found = WireSearch(NO_WIRES, SHAPE, show).found().wires
    assert skin.believed[1] == pytest.approx((120, 180))
    assert {wires.lead for wires in told[1:]} == {70.0}
    assert (found.lead, found.lead_std_ohm) == (70.0, 20.0)
    assert found.both == pytest.approx((120, 180), rel=0.2)  # presses tell less than that


@pytest.mark.parametrize(
    ("log_std", "lead_std_ohm", "is_sure"),
    [(0.6, 20.0, True), (0.2, 140.0, True), (0.6, 140.0, False)],
)
def test_scans_are_believed_that_are_sure_of_the_lead_or_of_both_layers(
    log_std: float, lead_std_ohm: float, is_sure: bool
) -> None:
    skin = Skin(100.0, 200.0)

    def show(wires: WireOhm, own_ohm: Float, most_cells: int) -> Shown:
        taught = WireOhm(120.0, 180.0, 70.0, log_std, log_std, lead_std_ohm)
        return skin.show(wires, own_ohm, most_cells)._replace(wires=taught)

    WireSearch(NO_WIRES, SHAPE, show).found()
    assert skin.believed[1] == pytest.approx((120, 180) if is_sure else (50, 50))


def test_the_filter_of_the_scale_is_kept_near_the_wires_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Kept from far off, it led to 1.6 kohm where 2 were true, and 5 times the error."""
    scales: list[Scale | None] = []
    usual = TotalFit.__init__

    def noted(fit: TotalFit, totals: Totals, scale: Scale | None = None, **options: bool) -> None:
        scales.append(scale)
        usual(fit, totals, scale, **options)

    monkeypatch.setattr(TotalFit, "__init__", noted)
    WireSearch(NO_WIRES, SHAPE, Skin(100.0, 200.0).show).found()
    assert scales[0] is None
    assert scales[-1] is not None
    scales.clear()
    far = np.array([0.0, 5.0]), np.eye(2)  # each step is a long one
    even = np.zeros(3), np.eye(3)  # and no lead is unlike the others
    monkeypatch.setattr(TotalFit, "wires", lambda *given: far if given[-1].size == 2 else even)
    WireSearch(NO_WIRES, SHAPE, Skin(100.0, 200.0).show).found()
    assert set(scales) == {None}


@pytest.mark.parametrize("told_ohm", [None, 150.0])
def test_scans_take_no_place_of_what_was_told(told_ohm: float | None) -> None:
    """What they taught was taken for told again, which widened the prior."""
    skin, told = Skin(100.0, 200.0), WireOhm(150.0, told_ohm, top_log_std=0.05)

    def show(wires: WireOhm, own_ohm: Float, most_cells: int) -> Shown:
        taught = WireOhm(900.0, 900.0, 0.0, 0.01, 0.01, 1.0)
        return skin.show(wires, own_ohm, most_cells)._replace(wires=taught)

    WireSearch(told, SHAPE, show).found()
    assert skin.believed[1] == pytest.approx((150, told_ohm or 50))


@pytest.mark.parametrize(("ohm", "std_ohm"), [(100.0, 5.0), (500.0, 250.0), (200.0, 400.0)])
def test_wires_are_a_mean_of_what_presses_do_not_exclude(ohm: float, std_ohm: float) -> None:
    """Two layers of which presses tell this in ohms, and whose logs were expected about 150 ohm."""
    held, centre, std = np.log(180.0), np.log(150.0), 1.5
    precision = (180.0 / std_ohm) ** 2  # of the share by which a segment differs from that
    covariance = 1 / (precision + std**-2)
    step = covariance * (precision * (ohm / 180.0 - 1) + (centre - held) / std**2)
    alike = np.ones(2)
    mean, deviation = likely_wires(
        held * alike, step * alike, covariance * np.eye(2), centre * alike, std * alike
    )

    def density(log_ohm: float) -> float:
        return float(
            np.exp(-0.5 * ((np.exp(log_ohm) - ohm) / std_ohm) ** 2)
            * np.exp(-0.5 * ((log_ohm - centre) / std) ** 2)
        )

    powers = [
        quad(lambda log_ohm, n=n: density(log_ohm) * log_ohm**n, -3, 10, points=[4, 5, 6])[0]
        for n in range(3)
    ]
    expected = powers[1] / powers[0]
    assert mean == pytest.approx(expected, abs=0.02)
    assert deviation == pytest.approx(np.sqrt(powers[2] / powers[0] - expected**2), rel=0.05)
