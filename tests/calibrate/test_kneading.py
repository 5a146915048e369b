# SPDX-License-Identifier: Apache-2.0
"""``calibrate recording --total``: curves of all cells from the force on the whole skin."""

import json
import tracemalloc
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from command_line import Run, assert_one_line, well
from kneaded_skin import KneadedSkin
from kneaded_skin import Scale as ScaleBelow
from ohmskin.arrays import Float
from ohmskin.calibrate import kneaded_wires, kneading
from ohmskin.calibrate.kneading import Kneading
from ohmskin.calibrate.presses import Calibrator
from ohmskin.calibrate.scale import Scale, fit_scale, printed_s, wrong_numbers
from ohmskin.calibrate.sessions import joined
from ohmskin.calibrate.tables import ForceLog
from ohmskin.calibrate.totals import TotalFit, Totals
from ohmskin.estimate.base import Estimator
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.methods import make_estimator
from ohmskin.force.calibration import load_calibration
from ohmskin.link.messages import Scan
from ohmskin.record.recorder import Recorder
from ohmskin.record.recording import ForceSample, load_recording
from pressed_skin import Plan

STEP_S = 0.02


def presses(seed: int, count: int = 150, cells: int = 12) -> tuple[Float, Float, Float]:
    """Times (n,), which press each scan is of (n,), shares of each cell in the forces (n, cells).

    Presses last 0.4 s, every 0.6 s, on three cells each; none is on the last cell.
    """
    random = np.random.default_rng(seed)
    time_s = np.arange(0.0, 0.6 * count, STEP_S)
    number, phase = np.divmod(time_s, 0.6)
    press = np.where(phase < 0.4, number, -1).astype(np.intp)
    force_n = np.zeros((time_s.size, cells))
    for n in range(count):
        peaks_n = np.zeros(cells)
        peaks_n[random.choice(cells - 1, 3, replace=False)] = random.uniform(0.3, 4.0, 3)
        force_n[press == n] = np.outer(np.sin(np.pi * phase[press == n] / 0.4), peaks_n)
    return time_s, press, force_n


def rises(force_n: Float, gains: Float, exponent: float = 0.7) -> Float:
    """Rises of cells whose force is 3 gain (x / 1e-4)^exponent."""
    return np.asarray(1e-4 * (force_n / (3.0 * gains)) ** (1 / exponent))


def test_a_pole_is_that_of_its_differential_equation() -> None:
    time_s = np.arange(0.0, 3.0, STEP_S)
    force_n = np.interp(time_s, [0.2, 0.5, 1.0, 1.2], [0.0, 4.0, 4.0, 0.0])

    def slope(now_s: float, shown: Float) -> Float:
        return np.asarray((np.interp(now_s, time_s, force_n) - shown) / 0.15)

    exact = solve_ivp(slope, (0, 3), [0.0], t_eval=time_s, max_step=0.01, rtol=1e-6).y[0]
    shown = Scale(0.1, 0.15).shown(time_s, force_n[:, None], time_s + 0.1)[:, 0]
    assert shown == pytest.approx(exact, abs=0.01)


def test_an_average_is_the_mean_of_its_window() -> None:
    time_s = np.arange(0.0, 3.0, STEP_S)
    force_n = np.sin(5 * time_s) ** 2
    shown = Scale(0.2, 0.4, averages=True).shown(time_s, force_n[:, None], np.array([1.6, 2.2]))
    for got, end_s in zip(shown[:, 0], (1.4, 2.0), strict=True):
        window = np.linspace(end_s - 0.4, end_s, 1001)
        assert got == pytest.approx(np.mean(np.interp(window, time_s, force_n)), abs=2e-3)


@pytest.mark.parametrize("scale", [Scale(0.0), Scale(0.2, 0.1), Scale(0.05, 0.3, averages=True)])
def test_a_scale_of_many_columns_takes_little_memory(scale: Scale) -> None:
    """Those of 16x16 cells took half a gigabyte: the grid of the filter has more times."""
    time_s, _, force_n = presses(1, 100, 500)
    at_s = time_s[::2]
    scale.shown(time_s, force_n[:, :1], at_s)  # loads what it needs
    tracemalloc.start()
    try:
        shown = scale.shown(time_s, force_n, at_s)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 4 * shown.nbytes
    for n in (0, 250, 499):
        assert np.array_equal(shown[:, [n]], scale.shown(time_s, force_n[:, [n]], at_s))


@pytest.mark.parametrize("scale", [Scale(0.2, 0.1), Scale(0.05, 0.3, averages=True)])
def test_the_filter_of_a_scale_is_found(scale: Scale) -> None:
    time_s, _, force_n = presses(1, 60)
    total_n = force_n.sum(axis=1)
    at_s = np.arange(1.0, time_s[-1], 0.1)
    shown_n = 1.3 * scale.shown(time_s, total_n[:, None], at_s)[:, 0] - 0.7
    found = fit_scale(time_s, total_n, at_s, shown_n, np.ones_like(at_s))
    assert found.lag_s == pytest.approx(scale.lag_s, abs=0.01)
    assert found.length_s == pytest.approx(scale.length_s, abs=0.04)


def test_a_pause_of_hours_does_not_blur_what_a_scale_shows() -> None:
    """Its filter was computed in steps of 0.3 s, and its length came out as none."""
    scale, (time_s, _, force_n) = Scale(0.1, 0.1), presses(1, 60)
    total_n, at_s = force_n.sum(axis=1), np.arange(1.0, 36.0, 0.1)
    whole_n = scale.shown(time_s, total_n[:, None], at_s)[:, 0]
    far = np.abs(at_s - 18.0) > 1.0
    time_s, at_s = (each + 6 * 3600.0 * (each > 18.0) for each in (time_s, at_s))
    shown_n = scale.shown(time_s, total_n[:, None], at_s)[:, 0]
    assert shown_n[far] == pytest.approx(whole_n[far], abs=0.02)
    found = fit_scale(time_s, total_n, at_s, whole_n, 1.0 * far)
    assert (found.delay_s, found.length_s) == pytest.approx((0.1, 0.1), abs=0.01)


def late(seed: int, count: int, step_s: float) -> tuple[Float, Float]:
    """When numbers were printed, and when they arrived: a busy machine lets most of them wait."""
    random = np.random.default_rng(seed)
    true_s = 70.0 + step_s * np.arange(count)
    load = np.clip(np.sin(true_s / 7) + 0.6, 0.05, None)  # it is busier and less busy
    waits_s = random.exponential(0.1 * load) * (random.random(count) < 0.8)
    return true_s, np.maximum.accumulate(true_s + waits_s) + 1e-6 * np.arange(count)


def test_numbers_of_a_scale_are_where_they_were_printed_on_a_busy_machine() -> None:
    true_s, arrival_s = late(1, 1200, 0.1)
    assert np.quantile(arrival_s - true_s, 0.9) > 0.1
    assert printed_s(arrival_s) == pytest.approx(true_s, abs=0.01)
    # Lines 300 and 301 could not be read, and after 800 lines somebody had lunch.
    arrival_s[800:] += 1800.0
    kept = np.delete(np.arange(1200), [300, 301])
    expected_s = true_s + np.where(np.arange(1200) < 800, 0.0, 1800.0)
    found_s = printed_s(arrival_s[kept])
    far = np.abs(kept - 300) > 60
    assert found_s[far] == pytest.approx(expected_s[kept][far], abs=0.02)


@pytest.mark.parametrize("busy_s", [11.0, 16.0])
def test_times_of_a_scale_never_go_back(busy_s: float) -> None:
    """Numbers that had waited were counted as lost; when they waited less, some were taken back."""
    true_s = 0.1 * np.arange(1200)
    # From 20 s on, a busy machine lets all numbers wait: first for 0.5 s, then for 0.2 s.
    waits_s = np.where((true_s >= 20) & (true_s < 20 + busy_s), 0.5, 0.0)
    waits_s += np.where((true_s >= 20 + busy_s) & (true_s < 20 + 2 * busy_s), 0.2, 0.0)
    waits_s += np.random.default_rng(1).uniform(0, 0.02, true_s.size)
    found_s = printed_s(np.maximum.accumulate(true_s + waits_s))
    assert np.all(np.diff(found_s) >= 0)
    sound = (true_s < 5) | (true_s > 20 + 2 * busy_s + 15)
    assert found_s[sound] == pytest.approx(true_s[sound], abs=0.01)


@pytest.mark.parametrize(("step_s", "press_s"), [(0.1, 0.4), (0.1, 0.15), (0.0125, 0.4)])
def test_wrong_numbers_of_a_scale_are_told_from_presses(step_s: float, press_s: float) -> None:
    """Five of 700 at 50 N made the error of all forces 2 N."""
    random = np.random.default_rng(3)
    time_s = np.arange(0.0, 70.0, step_s)
    number, phase_s = np.divmod(time_s, 0.6)
    peak_n = random.uniform(1, 12, 200)[number.astype(int)]
    force_n = np.where(phase_s < press_s, peak_n * np.sin(np.pi * phase_s / press_s), 0.0)
    force_n += 5.0 + 0.01 * random.standard_normal(time_s.size)
    assert not wrong_numbers(force_n).any()
    bad = [20, 200, 201, 350, time_s.size - 1]
    for wrong_n in (50.0, 1000.0, -1e6):
        force_n[bad] = wrong_n
        assert np.flatnonzero(wrong_numbers(force_n)).tolist() == bad


def test_times_of_a_scale_rise_over_a_stall() -> None:
    """Numbers that waited for 4.5 s, twice, seemed to be from before those that came earlier."""
    true_s = 0.1 * np.arange(400)
    for seed in range(20):
        random = np.random.default_rng(seed)
        arrival_s = true_s + random.exponential(0.005, true_s.size)
        for begin_s in random.uniform(3, 35, 3):
            waits = (true_s > begin_s) & (true_s < begin_s + 4.5)
            arrival_s = np.where(waits, np.maximum(arrival_s, begin_s + 4.5), arrival_s)
        arrival_s = np.maximum.accumulate(arrival_s) + 1e-6 * np.arange(true_s.size)
        assert np.all(np.diff(printed_s(arrival_s)) > 0)


def test_a_scale_that_prints_when_it_likes_keeps_its_times() -> None:
    random = np.random.default_rng(2)
    arrival_s = np.cumsum(random.exponential(0.3, 300))
    np.testing.assert_array_equal(printed_s(arrival_s), arrival_s)


def test_a_clock_that_jumps_takes_no_memory() -> None:
    """A grid of 10 ms, and a zero every 15 s, took petabytes."""
    time_s, press, force_n = presses(2, 40)
    time_s[time_s.size // 2 :] += 1e9
    shown = Scale(0.1, 0.1).shown(time_s, force_n, time_s)
    assert np.isfinite(shown).all()
    none = np.zeros_like(time_s)
    rise = rises(force_n, np.ones(force_n.shape[1]))
    found = TotalFit(Totals((3, 4), time_s, rise, press, none, time_s, force_n.sum(axis=1)))
    assert found.presses == 40


def test_presses_during_which_the_scale_was_silent_do_not_count() -> None:
    time_s, press, force_n = presses(2, 40)
    none, rise = np.zeros_like(time_s), rises(force_n, np.ones(force_n.shape[1]))
    shown = time_s < 12.0
    of_skin, of_scale = (time_s, rise, press, none), (time_s[shown], force_n.sum(axis=1)[shown])
    assert TotalFit(Totals((3, 4), *of_skin, *of_scale)).presses == 20
    few = (of_scale[0][:100], of_scale[1][:100])
    with pytest.raises(ValueError, match="fewer than 5 presses of the skin while it was weighed"):
        TotalFit(Totals((3, 4), *of_skin, *few))


def test_what_is_left_out_ends_at_a_gap_and_pauses_are_no_presses() -> None:
    time_s, press, force_n = presses(2, 60)
    rest_s = np.arange(0.0, 3.0, STEP_S)  # at the end, in which something is beside the skin
    time_s = np.concatenate([time_s, 36.0 + rest_s, 139.0 + rest_s])
    zeros = np.zeros((2 * rest_s.size, force_n.shape[1]))
    force_n = np.concatenate([force_n, zeros])
    press = np.concatenate([press, np.full(2 * rest_s.size, -1)])
    shown_n = force_n.sum(axis=1) + 5.0 * ((time_s > 139.5) & (time_s < 141.5))
    shown_n += 0.01 * np.random.default_rng(4).standard_normal(time_s.size)
    rise = rises(force_n, np.ones(force_n.shape[1]))
    found = TotalFit(
        Totals((3, 4), time_s, rise, press, np.zeros_like(time_s), time_s, shown_n)
    ).fit()
    assert found.left_out == [pytest.approx((139.0, 142.0), abs=0.1)]
    assert (found.presses, found.presses_left_out) == (60, 0)


@pytest.fixture(scope="module")
def fit() -> tuple[TotalFit, Float, list[int]]:
    """Of a slow scale with a zero; every twelfth press is beside the skin, too."""
    time_s, press, force_n = presses(2)
    random = np.random.default_rng(3)
    gains = np.exp(0.2 * random.standard_normal(force_n.shape[1]))
    beside = list(range(5, 150, 12))
    total_n = force_n.sum(axis=1)
    total_n = total_n + np.where(np.isin(press, beside), 0.6 * total_n + 1.0 * (total_n > 0.1), 0.0)
    at_s = np.arange(0.5, time_s[-1], 0.1)
    shown_n = Scale(0.1, 0.1).shown(time_s, total_n[:, None], at_s)[:, 0] + 0.8
    shown_n += 0.02 * random.standard_normal(at_s.size)
    none = np.zeros_like(time_s)
    totals = Totals((3, 4), time_s, rises(force_n, gains), press, none, at_s, shown_n)
    return TotalFit(totals).fit(), gains, beside


def test_curves_are_found_from_sums(fit: tuple[TotalFit, Float, list[int]]) -> None:
    found, gains, _ = fit
    model = found.model()
    for force_n in (1.0, 3.0):
        rise = rises(np.full(12, force_n), gains).reshape(3, 4)
        read_n = model.predict(rise, np.zeros_like(rise))[0]
        assert read_n.ravel()[:-1] == pytest.approx(force_n, rel=0.1)


def test_a_cell_that_nobody_pressed_says_so(fit: tuple[TotalFit, Float, list[int]]) -> None:
    found, gains, _ = fit
    stds = found.gain_std()
    assert stds[:-1].max() < 0.5 * stds[-1]
    assert stds[-1] == pytest.approx(np.std(np.log(gains)), rel=0.3)
    model = found.model()
    assert model.pooled.ravel().tolist() == [False] * 11 + [True]
    rise = rises(np.full(12, 2.0), gains).reshape(3, 4)
    force_n, std_n = model.predict(rise, np.zeros_like(rise))
    assert abs(force_n[-1, -1] - 2.0) < 4 * std_n[-1, -1]


def test_presses_beside_the_skin_are_left_out(fit: tuple[TotalFit, Float, list[int]]) -> None:
    found, _, beside = fit
    middles_s = [0.6 * n + 0.2 for n in beside]
    spans = found.left_out
    assert all(any(begin <= at_s <= end for begin, end in spans) for at_s in middles_s)
    others = [n for n in range(150) if n not in beside]
    wrong = [n for n in others if any(b <= 0.6 * n + 0.2 <= e for b, e in spans)]
    assert len(wrong) <= 1


@pytest.fixture(scope="module")
def skin() -> KneadedSkin:
    return KneadedSkin(Plan((100.0, 200.0), "series", 1, shape=(4, 4), touches=40), scans=2500)


def test_each_skin_has_a_scale_that_drifts_otherwise() -> None:
    """All had the same noise and drift: a median of five skins was that of one scale."""
    off_n = []
    for seed in (1, 2):
        skin = KneadedSkin(Plan((100.0, 200.0), "series", seed, (2, 2), touches=1), scans=500)
        drifts, ideal = ScaleBelow(10.0, noise_n=0.0, drift_n=0.2), ScaleBelow(10.0, noise_n=0.0)
        off_n.append(skin.total(drifts, beside=False)[1] - skin.total(ideal, beside=False)[1])
    assert np.abs(off_n[0]).max() > 0.05
    assert np.abs(off_n[0] - off_n[1]).max() > 0.01


def changed(path: Path, *, scans: list[Scan] | None = None, forces: list[ForceSample]) -> None:
    """Put other scans, or other forces, into a recording."""
    given = load_recording(path)
    path.unlink()
    with Recorder(path, given.hellos[0]) as recorder:
        for message in [*given.tares, *(given.scans if scans is None else scans), *forces]:
            recorder.add(message)


def learned(run: Run, recording: Path, out: Path, *options: str) -> dict[str, Any]:
    """What is said of a calibration that was made of a recording."""
    command = ("calibrate", "recording", str(recording), str(out), "--total", "--json", *options)
    said: dict[str, Any] = json.loads(well(run(*command)).out)
    return said


def test_every_number_of_a_slow_scale_counts(
    skin: KneadedSkin, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a press, every second to fourth scan is used, and numbers beside the others were lost."""
    recording, given = tmp_path / "knead.mcap", []
    skin.record_kneading(recording, ScaleBelow(10.0, 0.1, 0.1))
    usual = TotalFit.__init__

    def noted(fit: TotalFit, totals: Totals, *more: Any, **options: Any) -> None:
        given.append(totals)
        usual(fit, totals, *more, **options)

    monkeypatch.setattr(TotalFit, "__init__", noted)
    learned(run, recording, tmp_path / "skin.json")
    scans, forces = load_recording(recording).scans, load_recording(recording).forces
    ends_s = scans[0].host_time_s, scans[-1].host_time_s
    shown = sum(ends_s[0] <= force.host_time_s <= ends_s[1] for force in forces)
    last = given[-1]
    assert last.time_s.size < 0.8 * len(scans)
    assert last.shown_s.size > 0.97 * shown


@pytest.mark.parametrize("pole_s", [0.1, 0.8])
def test_a_log_of_the_scale_may_be_late_and_untared(
    skin: KneadedSkin, run: Run, tmp_path: Path, pole_s: float
) -> None:
    """Its numbers were taken for the force itself, as known weights are.

    And of a slow scale, the alignment took more of the lag than the fit could give back.
    """
    recording, out, log = tmp_path / "knead.mcap", tmp_path / "skin.json", tmp_path / "scale.csv"
    below = ScaleBelow(10.0, 0.05, pole_s, noise_n=0.01, drift_n=0.1)
    skin.record_kneading(recording, below)
    changed(recording, forces=[])
    time_s, force_n = skin.total(below, beside=True)
    rows = np.column_stack([time_s + 1000.0, force_n + 5.0])
    np.savetxt(log, rows, delimiter=",", header="time_s,force_n", comments="")
    said = learned(run, recording, out, "--forces", str(log))
    assert said["offset_s"] - said["lag_s"] == pytest.approx(-1000.05 - pole_s, abs=0.1)
    assert skin.read_tips(out).rmse_n() < 0.1


def test_forces_while_the_board_was_reset_teach_nothing(
    skin: KneadedSkin, run: Run, tmp_path: Path
) -> None:
    """They were fitted with rises between those before and after it."""
    recording, out = tmp_path / "knead.mcap", tmp_path / "skin.json"
    skin.record_kneading(recording, ScaleBelow(10.0, 0.05, 0.1, 0.01, 0.1))
    given = load_recording(recording)
    scans, begin_us = given.scans, given.scans[1300].time_us
    after = [replace(s, number=n, time_us=s.time_us - begin_us) for n, s in enumerate(scans[1300:])]
    changed(recording, scans=scans[:1200] + after, forces=given.forces)
    learned(run, recording, out)
    assert skin.read_tips(out).rmse_n() < 0.15


def test_a_recording_of_one_scan_has_too_few_presses(
    skin: KneadedSkin, run: Run, tmp_path: Path
) -> None:
    """A step from scan to scan was asked for: 'cannot convert float NaN to integer'."""
    recording, out = tmp_path / "knead.mcap", tmp_path / "skin.json"
    skin.record_kneading(recording, ScaleBelow(10.0))
    given = load_recording(recording)
    changed(recording, scans=given.scans[:1], forces=given.forces)
    done = run("calibrate", "recording", str(recording), str(out), "--total")
    assert_one_line(done, "fewer than 5 presses of the skin while it was weighed")


def test_wires_are_looked_for_among_presses_that_were_weighed(
    skin: KneadedSkin, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Trials took the first presses alone, which were not weighed, and so nothing was learned."""
    for cells in ("FIRST_CELLS", "TRIAL_CELLS"):
        monkeypatch.setattr(kneaded_wires, cells, 1500)  # as on a large skin: a few presses
    recording, out = tmp_path / "knead.mcap", tmp_path / "skin.json"
    skin.record_kneading(recording, ScaleBelow(10.0, 0.05, 0.1, 0.01, 0.1))
    given = load_recording(recording)
    weighed = [force for force in given.forces if not 1.0 < force.host_time_s < 15.0]
    changed(recording, forces=weighed)
    assert learned(run, recording, out)["presses"] > 40


def test_wrong_numbers_of_the_scale_are_left_out(
    skin: KneadedSkin, run: Run, tmp_path: Path
) -> None:
    recording, out = tmp_path / "knead.mcap", tmp_path / "skin.json"
    skin.record_kneading(recording, ScaleBelow(10.0, 0.05, 0.1, 0.01, 0.1))
    forces = load_recording(recording).forces
    for number in (50, 133, 220, 310, 400):
        forces[number] = replace(forces[number], force_n=50.0)
    changed(recording, forces=forces)
    assert learned(run, recording, out)["wrong_numbers"] == 5
    assert skin.read_tips(out).rmse_n() < 0.15


def test_a_skin_that_was_kneaded_reads_forces(
    skin: KneadedSkin, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording, out = tmp_path / "knead.mcap", tmp_path / "skin.json"
    skin.record_kneading(recording)
    told: list[SkinKnowledge] = []

    def spied(method: str, knowledge: SkinKnowledge) -> Estimator:
        told.append(knowledge)
        return make_estimator(method, knowledge)

    monkeypatch.setattr(kneading, "make_estimator", spied)
    said = learned(run, recording, out)
    # The first reading is told nothing. In trials, and in the last one, no scan moves the wires.
    wires = np.array([knowledge.nominal_wire_ohm for knowledge in told], dtype=np.float64)
    assert wires[1:, 3:6].max() < 0.01
    assert np.ptp(wires[1:, 2]) == 0
    # Wires on trial are not sure: cells at the edge of a fingertip must not become too soft.
    assert [knowledge.are_wires_sure for knowledge in told] == [False] * (len(told) - 1) + [True]
    assert wires[-1, :2].tolist() == pytest.approx([said["top"], said["bottom"]])
    assert said["left_out"] == []
    assert abs(said["lag_s"]) < 0.03
    calibration = load_calibration(out)
    assert calibration.indenter_area_m2 is None  # so there is no pressure
    assert calibration.nominal_wire_ohm.top_log_std is not None
    forces = skin.read(out)
    assert forces.rmse_n() < 0.6
    assert forces.within_percent() > 97


def test_a_rest_that_has_moved_between_recordings_is_no_force(
    skin: KneadedSkin, tmp_path: Path
) -> None:
    """Readings were moved to the newest rest, which is not exact beside a touch."""
    path, out, middle_s = tmp_path / "knead.mcap", tmp_path / "skin.json", 25.0
    before = copy(skin)
    times = np.random.default_rng(7).uniform(1.0, 3.0, skin.rest.shape)
    before.rest = replace(skin.rest, cell_siemens=times * skin.rest.cell_siemens)
    both = []
    for half, of_day in enumerate((before, skin)):
        of_day.record_kneading(path, ScaleBelow(10.0, 0.05, 0.1, 0.01, 0.1))
        given = load_recording(path)
        path.unlink()
        given.scans = [each for each in given.scans if each.host_time_s // middle_s == half]
        given.forces = [each for each in given.forces if each.host_time_s // middle_s == half]
        both.append(given)
    whole = joined(both)
    calibrator = Calibrator(whole[-1].hellos[0], whole[-1].tares[0].rest_ratio, "joint", None)
    kneading = Kneading(calibrator, whole)
    forces = [(each.host_time_s, each.force_n) for given in whole for each in given.forces]
    time_s, force_n = np.transpose(forces)
    fit = kneading.learn(ForceLog(time_s, force_n, any_zero=True))
    calibrator.calibration_of(fit.model(), fit.largest_n).save(out)
    assert fit.presses_left_out == 0
    assert skin.read_tips(out).rmse_n() < 0.08  # where the rest stays, it is 0.065


def test_the_power_law_of_a_curve_that_bends_is_right_where_forces_are_large() -> None:
    """It was right for shares of all forces alike, and 7 % too low for the largest."""
    time_s, press, force_n = presses(7, 240)
    contact = rises(force_n, np.ones(12))
    rise = contact / (1 + 0.4 * contact / contact.max())  # something in series
    shown_n = force_n.sum(axis=1)
    zero = np.zeros_like(time_s)
    fit = TotalFit(Totals((3, 4), time_s, rise, press, zero, time_s, shown_n)).fit()
    at_n = np.array([0.5, 2.0, 4.0])
    contact_at = rises(at_n, np.ones(3))
    rise_at = contact_at / (1 + 0.4 * contact_at / contact.max())
    model = fit.model()
    found_n = [model.predict(np.full((3, 4), x), np.zeros((3, 4)))[0][0, 0] for x in rise_at]
    assert found_n[2] == pytest.approx(4.0, rel=0.05)
    assert found_n == pytest.approx(at_n, rel=0.1)
    assert fit.largest_n == pytest.approx(shown_n.max(), rel=0.1)  # of a press, not of a cell


def kneaded_behind_wires() -> tuple[Totals, tuple[np.ndarray, ...]]:
    """Presses with hysteresis and unseen force, and what wires would do, if nobody told them."""
    time_s, press, force_n = presses(5, 240)
    phase = time_s % 0.6
    hold = np.interp(phase, [0.0, 0.15, 0.25, 0.4], [0.0, 1.0, 1.0, 0.0])
    peaks_n = np.array([force_n[press == n].max(axis=0) for n in range(240)])
    force_n = peaks_n[(time_s / 0.6 + 1e-9).astype(int)] * hold[:, None]
    random = np.random.default_rng(6)
    rise = rises(force_n, np.exp(0.15 * random.standard_normal(12)))
    rise *= np.where(np.diff(force_n, axis=0, prepend=0.0) > -1e-9, 0.96, 1.04)
    margin = 4.0 * (hold > 0)  # cells around each press, which has 0.06 N on each of them
    shown_n = force_n.sum(axis=1) + 0.06 * margin + 0.01 * random.standard_normal(time_s.size)
    totals = Totals((3, 4), time_s, rise, press, margin, time_s, shown_n)
    # The further a cell is, and the harder it is pressed, the less it shows with such wires.
    far = np.array([[0, 1, 2, 3] * 3, [0] * 4 + [1] * 4 + [2] * 4])
    slopes = 0.05 * far[:, None, :] * rise / 1e-4
    return totals, (slopes, np.zeros(2), np.full(2, 1.5))


def test_hysteresis_and_unseen_force_are_not_taken_for_wires() -> None:
    totals, given = kneaded_behind_wires()
    found = TotalFit(totals, for_wires=True).fit()
    assert np.abs(found.wires(*given)[0]).max() < 0.35
    assert abs(found.scale_.lag_s) < 2e-3


def test_few_presses_that_are_estimated_wrong_are_not_taken_for_wires() -> None:
    """Two of 240 made the logs of the wires 3 too large, and were no outliers then."""
    totals, given = kneaded_behind_wires()
    usual = TotalFit(totals, for_wires=True).fit().wires(*given)[0]
    hardest = [totals.rise[totals.press == n].sum(axis=1).max() for n in range(240)]
    wrong = np.isin(totals.press, np.argsort(hardest)[-2:])
    rise = totals.rise * np.where(wrong, 1.2, 1.0)[:, None]
    fit = TotalFit(totals._replace(rise=rise), for_wires=True).fit()
    assert fit.presses_left_out == 0
    assert np.abs(fit.wires(*given)[0] - usual).max() < 0.2


def test_total_and_an_indenter_exclude_each_other(run: Run, tmp_path: Path) -> None:
    both = ("--total", "--indenter-mm2", "80")
    paths = str(tmp_path / "a.mcap"), str(tmp_path / "b.json")
    for options in ((), both):
        done = run("calibrate", "recording", *paths, *options)
        assert_one_line(done)


def test_json_without_total_is_refused(run: Run, tmp_path: Path) -> None:
    """It was taken, and words were printed all the same."""
    paths = str(tmp_path / "a.mcap"), str(tmp_path / "b.json")
    done = run("calibrate", "recording", *paths, "--indenter-mm2", "80", "--json")
    assert_one_line(done, "--json is for --total")
