# SPDX-License-Identifier: Apache-2.0
"""What kneading shows of each cell, against fits of many simulated skins."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

import ohmskin
from ohmskin.calibrate.coverage import CONTACT_STD, GAIN_STD, Coverage, LiveCoverage
from ohmskin.calibrate.sessions import joined, session_paths
from ohmskin.link.device import scans_for
from ohmskin.record.recorder import Recorder, record
from ohmskin.record.recording import ForceSample, Recording, load_recording

CELLS = 12


def presses(random: np.random.Generator) -> np.ndarray:
    """Rises (n, CELLS) [S]: neighbours along a line, the last cell never."""
    places = random.uniform(0, CELLS - 2, 90)[:, None]
    near = np.exp(-((np.arange(CELLS) - places) ** 2)) * random.uniform(1e-5, 3e-4, (90, 1))
    near[:, -1] = 0.0
    return np.where(near > 1e-6, near, 0.0)


def test_deviations_are_those_of_errors_of_fits() -> None:
    """Independent skins, whose gains are fitted by another optimiser to noisy totals."""
    random = np.random.default_rng(1)
    rises, errors = presses(random), []
    for _ in range(150):
        gains = GAIN_STD * random.standard_normal(CELLS)
        gains += -gains.mean() + 0.5 * random.standard_normal()
        shares = 1e3 * rises**0.6
        force_n = (shares @ np.exp(gains)) * np.exp(CONTACT_STD * random.standard_normal(90))

        def off(trial: np.ndarray, shares: np.ndarray = shares, force_n: np.ndarray = force_n):
            by_noise = np.log(shares @ np.exp(trial) / force_n) / CONTACT_STD
            return np.concatenate([by_noise, (trial - trial.mean()) / GAIN_STD])

        errors.append(least_squares(off, np.zeros(CELLS)).x - gains)
    coverage = Coverage(CELLS)
    for number, rise in enumerate(rises):
        coverage.add(float(number), rise, 1e9)
    stated = coverage.log_std()
    np.testing.assert_allclose(stated, np.std(errors, axis=0), rtol=0.25)
    assert stated[-1] > 0.9 * GAIN_STD  # nobody has pressed it
    assert stated[:-1].max() < 0.7 * GAIN_STD


def test_a_number_that_comes_at_once_or_is_small_is_no_news() -> None:
    coverage = Coverage(2)
    assert coverage.is_news(5.0, 1.0)
    assert not coverage.is_news(5.0, 0.1)
    coverage.add(5.0, np.array([1e-5, 0.0]), 1.0)
    assert not coverage.is_news(5.05, 1.0)
    assert coverage.is_news(5.2, 1.0)
    assert coverage.is_news(3.0, 1.0)  # another recording, by another clock


def test_every_number_of_a_scale_that_prints_ten_a_second_is_news() -> None:
    """Three of ten came after a little less than 0.1 s, and were lost."""
    random, coverage = np.random.default_rng(1), Coverage(2)
    for at_s in 0.1 * np.arange(300) + 0.004 * random.standard_normal(300):
        assert coverage.is_news(at_s, 1.0)
        coverage.add(at_s, np.array([1e-5, 0.0]), 1.0)


def record_kneading(path: Path, seconds: float, seed: int, more: str = "") -> Recording:
    """A skin of 2x3 that is kneaded over a sensor whose zero is at 3 N."""
    url = f"emulator://2x3?scene=knead&begin=1.5&speed=0&seed={seed}&rate=40{more}"
    with ohmskin.open(url) as skin, Recorder(path, skin.info, lambda: skin.now_s) as recorder:

        def beside(scan: ohmskin.Scan) -> None:
            force_n = 3.0 + float(skin.true_force_n(scan).sum())
            recorder.add(ForceSample(force_n, scan.host_time_s))

        record(skin, recorder, scans_for(skin, seconds), tare_s=1.0, beside=beside)
    return load_recording(path)


def test_a_recording_is_looked_at_as_it_was_live(tmp_path: Path) -> None:
    given = record_kneading(tmp_path / "a.mcap", 8.0, 1)
    live, later = LiveCoverage(given.hellos[0]), LiveCoverage(given.hellos[0])
    news = [
        live.look(scan, given.tares[0] if scan.host_time_s > 1.2 else None, force)
        for scan, force in zip(given.scans, given.forces, strict=True)
    ]
    assert 20 < sum(news) < 80
    later.look_at(given)
    np.testing.assert_allclose(later.log_std, live.log_std, rtol=0.1)
    before = later.log_std.copy()
    later.look_at(record_kneading(tmp_path / "b.mcap", 8.0, 2))
    assert (later.log_std < before).all()
    assert later.next_cell == np.unravel_index(later.log_std.argmax(), (2, 3))
    assert (later.known == (later.log_std <= 0.15)).all()
    assert not live.is_done
    assert live.numbers_left > 0  # it has seen some presses alone


def test_a_cell_is_silent_when_much_was_pressed_since_all_others_are_known(tmp_path: Path) -> None:
    """A cell that nobody has pressed yet is no dead one."""
    given = record_kneading(tmp_path / "a.mcap", 24.0, 1, "&dead=1,1")
    live, since = LiveCoverage(given.hellos[0]), 0
    for scan, force in zip(given.scans, given.forces, strict=True):
        assert not live.silent.any()
        assert not live.is_done
        is_news = live.look(scan, given.tares[0] if scan.host_time_s > 1.2 else None, force)
        since = since + is_news if live.known.sum() == 5 else 0
        if since > 0:
            assert live.next_cell == (1, 1) or live.silent.any()
        if live.silent.any():
            break
    assert since == 51  # numbers, the first of which has made the other cells known
    assert np.argwhere(live.silent).tolist() == [[1, 1]]
    assert live.is_done == (live.numbers_left == 0)
    assert live.next_cell != (1, 1)
    live.look_at(record_kneading(tmp_path / "b.mcap", 12.0, 1))  # it was mended
    assert live.is_done
    assert not live.silent.any()


def test_numbers_of_a_gap_of_the_scans_tell_nothing(tmp_path: Path) -> None:
    """All 600 of a minute counted as of the scan after it, and no more were asked for."""
    given = record_kneading(tmp_path / "a.mcap", 8.0, 1)
    gap_s = max(given.forces, key=lambda force: force.force_n).host_time_s
    before, after = LiveCoverage(given.hellos[0]), LiveCoverage(given.hellos[0])
    before.look_at(given)
    for each in (given.scans, given.forces):
        each[:] = [
            replace(one, host_time_s=one.host_time_s + 60.0 * (one.host_time_s >= gap_s))
            for one in each
        ]
    meanwhile = [ForceSample(8.0, gap_s + 0.1 * number) for number in range(600)]
    given.forces = sorted([*given.forces, *meanwhile], key=lambda force: force.host_time_s)
    after.look_at(given)
    assert after.numbers_left == pytest.approx(before.numbers_left, abs=1)
    np.testing.assert_allclose(after.log_std, before.log_std, rtol=0.05)


def test_a_scale_that_is_upside_down_is_noticed(tmp_path: Path) -> None:
    """No number counted, and whoever kneaded waited for ever."""
    recording = record_kneading(tmp_path / "a.mcap", 12.0, 1)
    live = LiveCoverage(recording.hellos[0])
    live.look_at(recording)
    assert not live.is_upside_down
    recording.forces = [replace(force, force_n=-force.force_n) for force in recording.forces]
    live.look_at(recording)
    assert live.is_upside_down


def test_recordings_are_joined_on_one_clock_and_zero(tmp_path: Path) -> None:
    out = tmp_path / "skin.json"
    assert session_paths(out, "knead") == ([], tmp_path / "skin.knead-1.mcap")
    both = [record_kneading(tmp_path / f"skin.knead-{n}.mcap", 4.0, n) for n in (1, 2)]
    paths, following = session_paths(out, "knead")
    assert [path.name for path in paths] == ["skin.knead-1.mcap", "skin.knead-2.mcap"]
    assert following.name == "skin.knead-3.mcap"
    whole = joined(both)
    scans = [scan for given in whole for scan in given.scans]
    assert len(scans) == sum(len(given.scans) for given in both)
    for name in ("host_time_s", "time_us"):
        assert (np.diff([getattr(scan, name) for scan in scans]) > 0).all()
    first = len(both[0].scans)
    assert scans[first].host_time_s - scans[first - 1].host_time_s == 100.0
    shown = np.array([sample.force_n for given in whole for sample in given.forces])
    assert np.abs(shown[[0, first]]).max() < 1e-9
    assert shown.max() == pytest.approx(
        max(sample.force_n for given in both for sample in given.forces) - 3.0
    )
    assert [given.tares for given in whole] == [given.tares for given in both]


@pytest.mark.parametrize("scale_s", [(-150.0, 0.0), (5.0, 150.0)], ids=["before", "after"])
def test_forces_without_scans_are_not_amid_those_of_another_recording(
    tmp_path: Path, scale_s: tuple[float, float]
) -> None:
    """They were, and the log was refused: "time_s ... must be later than the one before"."""
    both = [record_kneading(tmp_path / f"{n}.mcap", 4.0, n) for n in (1, 2)]
    expected = [len(given.forces) for given in both]
    for given in both:
        alone = [ForceSample(3.0, at_s) for at_s in np.arange(*scale_s, 0.5).tolist()]
        given.forces = sorted([*given.forces, *alone], key=lambda force: force.host_time_s)
    whole = joined(both)
    time_s = [force.host_time_s for given in whole for force in given.forces]
    assert (np.diff(time_s) > 0).all()
    for given, count in zip(whole, expected, strict=True):
        assert count < len(given.forces) < count + 2 * 34  # those within 33 s of the scans stay


def test_a_recording_that_was_removed_hides_no_later_one(tmp_path: Path) -> None:
    for number in (2, 3, 10):
        (tmp_path / f"skin[1].knead-{number}.mcap").touch()
    for name in ("skin[1].knead-x.mcap", "skin[1].weights-1.mcap", "skin1.knead-1.mcap"):
        (tmp_path / name).touch()
    paths, following = session_paths(tmp_path / "skin[1].json", "knead")
    names = [path.name for path in (*paths, following)]
    assert names == [f"skin[1].knead-{number}.mcap" for number in (2, 3, 10, 11)]


def test_calibrations_whose_names_begin_alike_share_no_recording(tmp_path: Path) -> None:
    """All after the last point was taken for an ending, as of left.a and left.b."""
    (tmp_path / "left.a.knead-1.mcap").touch()
    assert session_paths(tmp_path / "left.b", "knead") == ([], tmp_path / "left.b.knead-1.mcap")
    assert session_paths(tmp_path / "left", "knead") == ([], tmp_path / "left.knead-1.mcap")
    for out in ("left.a", "left.a.json"):
        assert session_paths(tmp_path / out, "knead")[1].name == "left.a.knead-2.mcap"


def test_recordings_of_two_skins_are_not_joined(tmp_path: Path) -> None:
    one = record_kneading(tmp_path / "a.mcap", 2.0, 1)
    with ohmskin.open("emulator://2x2?speed=0") as skin:
        other = Recording([skin.info], [], [], [], [], cut_off=False)
    with pytest.raises(ValueError, match="recorded before: 2x3 cells"):
        joined([one, other])
