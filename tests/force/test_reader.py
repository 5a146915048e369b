# SPDX-License-Identifier: Apache-2.0
"""Forces from a board: what open promises with a calibration, tare, and replay bit for bit."""

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ohmskin
from calibrations import NEWTON_SIEMENS, calibration, of_scene
from ohmskin.emulate.driver import SteppedSkin
from ohmskin.emulate.scenes import BEGIN_S, BOTTOM_WIRE_OHM, TOP_WIRE_OHM, Scene
from ohmskin.emulate.urls import emulated
from ohmskin.errors import DeviceLost, TareRefused
from ohmskin.estimate.knowledge import NO_WIRES, WireOhm
from ohmskin.estimate.methods import LEVEL_METHODS
from ohmskin.estimate.prior import LAYER_STD
from ohmskin.force.calibration import load_calibration
from ohmskin.force.reader import CalibratedSkin, ForceScan, SkinReader
from ohmskin.link.codes import quantise
from ohmskin.link.messages import Scan
from ohmskin.record.recorder import Recorder
from ohmskin.record.recording import Tare, load_recording
from recordings import write_recording
from stepped import stepped, stepped_link
from studies.trials import random_trial

GHOST = "emulator://8x8?scene=ghost&begin=0&seed=1"
Record = Callable[[int, int], str]


@pytest.mark.parametrize("method", ["ohm", "matrix", "joint", "touch"])
def test_scans_carry_forces_and_contacts(method: str) -> None:
    skin = Scene("ghost", 8, 8, seed=1).skin(BEGIN_S)
    at_rest = Scene("rest", 8, 8, seed=1).skin(0.0)
    true_n = (skin.cell_siemens - at_rest.cell_siemens) / NEWTON_SIEMENS
    with ohmskin.open(GHOST, calibration=of_scene("ghost", method=method)) as board:
        scan = board.latest()
        (first,) = islice(board, 1)
    for each in (scan, first):
        assert isinstance(each, ForceScan)
        assert each.force_n.shape == each.force_n_std.shape == (8, 8)
        assert each.ratio.shape == (8, 8, 4)
    assert scan.estimate.touched[5, 5] == (method == "ohm")  # the ghost
    assert (len(scan.contacts) == 3) == (method != "ohm")
    if method in ("joint", "touch"):
        assert np.abs(scan.force_n - true_n).max() < 0.05
        assert np.all(np.abs(scan.force_n - true_n) < 4 * scan.force_n_std + 1e-3)
        expected = sorted(true_n[true_n > 0])
        found = sorted(contact.force_n for contact in scan.contacts)
        assert found == pytest.approx(expected, rel=0.03)
        centres = {(contact.row, contact.column) for contact in scan.contacts}
        assert centres == set(map(tuple, np.argwhere(true_n > 0).astype(float).tolist()))


def test_a_cell_without_a_curve_of_its_own_has_the_hidden_wires_of_others() -> None:
    """Of this skin, presses were told twice the wires, and no cell has a curve of its own."""
    wires = WireOhm(2 * TOP_WIRE_OHM, 2 * BOTTOM_WIRE_OHM, 80.0, 0.7, 0.7, 20.0)
    of_skin = of_scene("ghost", method="joint")
    model = replace(of_skin.model, pooled=np.ones((8, 8), dtype=bool))
    of_skin = replace(of_skin, nominal_wire_ohm=wires, model=model)
    with ohmskin.open(GHOST, calibration=of_skin) as board:
        *_, scan = islice(board, 20)
    (level,), _ = of_skin.level([scan.estimate])
    expected_n = np.maximum(level - of_skin.rest.level, 0.0) / NEWTON_SIEMENS
    np.testing.assert_allclose(scan.force_n, expected_n, atol=1e-9)
    assert np.abs(scan.estimate.level / level - 1).max() > 0.01


def test_voltage_is_a_method() -> None:
    assert "voltage" in LEVEL_METHODS
    of_skin = of_scene("ghost", method="voltage", siemens=0.1)
    with ohmskin.open(GHOST, calibration=of_skin) as board:
        scan = board.latest()
    level = (scan.ratio[..., 1] + scan.ratio[..., 3] - scan.ratio[..., 0] - scan.ratio[..., 2]) / 4
    np.testing.assert_allclose(
        scan.force_n, np.maximum((level + 0.5 - of_skin.rest.level) / 0.1, 0), atol=1e-9
    )


def test_another_unit_is_refused_unless_forced() -> None:
    other = of_scene("ghost", unit_id=7)
    with pytest.raises(ValueError, match="of unit 7, the board is unit 0: calibrate this skin"):
        ohmskin.open(GHOST, calibration=other)
    with ohmskin.open(GHOST, calibration=other, force=True) as board:
        assert len(board.latest().contacts) == 3
    for force in (False, True):
        with pytest.raises(ValueError, match="of a 8x8 skin, the board scans 4x16: calibrate this"):
            ohmskin.open("emulator://4x16", calibration=of_scene("rest"), force=force)


@pytest.mark.parametrize(("of", "board"), [("near", "far"), ("far", "near")])
def test_a_calibration_of_another_mode_is_refused_even_if_forced(of: str, board: str) -> None:
    told = replace(of_scene("ghost"), mode=of)
    for force in (False, True):
        with pytest.raises(ValueError, match=f"of mode {of}, not {board}: "):
            ohmskin.open(f"{GHOST}&mode={board}", calibration=told, force=force)


def test_scans_of_another_mode_are_refused() -> None:
    bench = stepped(GHOST)
    reader = SkinReader(bench.info)
    scans = iter(bench)
    reader.read(next(scans))
    with pytest.raises(ValueError, match="scanned in mode near, now in far"):
        reader.read(replace(next(scans), mode="far"))


def test_scans_of_another_size_are_refused() -> None:
    """The error named two shapes of ratios, and nothing to do."""
    words = "board scanned 8x8 cells, now 3x8: configure it as before, or open it again"
    with CalibratedSkin(stepped(GHOST), of_scene("ghost")) as skin:
        assert len(skin.latest().contacts) == 3
        skin.device.configure(rows=3)
        with pytest.raises(ValueError, match=words):
            skin.latest()
        skin.device.configure(rows=8)
        assert skin.latest().force_n.shape == (8, 8)


def test_what_the_other_kind_of_skin_has_is_said_where_it_is_asked_for() -> None:
    """Its AttributeError said only that there is none."""
    device = stepped(GHOST)
    with pytest.raises(AttributeError, match=r"'tare': .* calibration is given: ohmskin\.open"):
        device.tare(1.0)  # type: ignore[attr-defined]
    with CalibratedSkin(device, of_scene("ghost")) as skin:
        with pytest.raises(AttributeError, match=r"'configure': .* has: skin\.device\.configure$"):
            skin.configure(rows=3)  # type: ignore[attr-defined]
        for of in (skin, device):
            with pytest.raises(AttributeError, match=r"object has no attribute 'nothing'$"):
                of.nothing  # type: ignore[attr-defined]  # noqa: B018


def test_an_attribute_that_fails_says_why() -> None:
    """It was said that there is none, and to give a calibration, or to ask the device."""

    class OwnScan(ForceScan):
        @property
        def ratio(self) -> Any:
            return self.codes.nothing  # type: ignore[attr-defined]

        wrench = ratio

    class OwnSkin(CalibratedSkin):
        @property
        def info(self) -> Any:
            return self.device.nothing  # type: ignore[attr-defined]

    with OwnSkin(device := stepped(GHOST), of_scene("ghost")) as skin:
        scan = OwnScan(**vars(skin.latest()))
        for of, name, inner in (
            (scan, "ratio", "numpy.ndarray"),
            (scan, "wrench", "numpy.ndarray"),
            (skin, "info", type(device).__name__),
        ):
            with pytest.raises(AttributeError, match=f"'{inner}' .* no attribute 'nothing'$"):
                getattr(of, name)


def test_a_tare_says_the_mode_of_the_board() -> None:
    bench = stepped("emulator://4x4")
    reader = SkinReader(bench.info)
    assert reader.tare(next(iter(bench)).ratio).mode == "near"


def test_readings_of_another_mode_are_no_tare() -> None:
    with ohmskin.open(GHOST, calibration=of_scene("ghost")) as board:
        board.device.configure(mode="far")
        with pytest.raises(ValueError, match="scanned in mode near, now in far"):
            board.tare(0.1, force=True)
        assert board.calibration.tare is None


def test_tare_is_refused_while_something_touches_the_skin() -> None:
    before = of_scene("ghost")
    with ohmskin.open(GHOST, calibration=before) as board:
        with pytest.raises(TareRefused, match=r"\(2, 2\), \(2, 5\), \(5, 2\) are .* --force"):
            board.tare(0.1)
        assert board.calibration.tare is None
        assert len(board.latest().contacts) == 3
        board.tare(0.1, force=True)
        assert board.latest().contacts == ()
        board.undo_tare()
        assert len(board.latest().contacts) == 3
        with pytest.raises(TareRefused, match="no tare to undo"):
            board.undo_tare()


def taught(scans: int = 30) -> tuple[SkinReader, list[Scan]]:
    """A reader of a skin whose wires nobody has told, and scans of touches that teach them."""
    trial = random_trial(8, 8, 6, scans, seed=2).rounded(10)
    (scan,) = islice(stepped("emulator://8x8"), 1)
    untold = replace(calibration(trial.rest_ratio), nominal_wire_ohm=NO_WIRES)
    reader = SkinReader(stepped("emulator://8x8").info, untold)
    return reader, [replace(scan, codes=quantise(ratio, 10)) for ratio in trial.ratio]


def test_a_skin_that_is_not_connected_is_no_rest_for_a_method_without_deviations() -> None:
    """`lsq` states none, and took it."""
    bench = stepped("emulator://2x2?seed=1")
    reader = SkinReader(bench.info, method="lsq")
    (scan,) = islice(bench, 1)
    reader.tare(scan.ratio, force=True)
    unplugged = np.where(scan.ratio > 0.5, 1023.5 / 1024, 0.5 / 1024)
    with pytest.raises(TareRefused, match="connect the skin"):
        reader.tare(unplugged)


@pytest.mark.parametrize("method", ["joint", "voltage"])
def test_a_skin_that_is_not_connected_is_no_rest(method: str) -> None:
    """The tare was taken, and after that, all 64 cells of the skin were touched."""
    bench = stepped("emulator://8x8?seed=1")
    reader = SkinReader(bench.info, of_scene("rest", method=method, siemens=0.1))
    (scan,) = islice(bench, 1)
    unplugged = np.where(scan.ratio > 0.5, 1023.5 / 1024, 0.5 / 1024)
    with pytest.raises(TareRefused, match=r"most cells conduct less than 10% .*: connect the skin"):
        reader.tare(unplugged)
    assert not reader.is_tared
    reader.tare(unplugged, force=True)
    assert reader.is_tared
    reader.undo_tare()
    reader.tare(scan.ratio)


def test_wires_that_a_session_has_taught_are_kept(tmp_path: Path) -> None:
    reader, scans = taught()
    assert told_wires(reader) == NO_WIRES
    assert [reader.read(scan) for scan in scans][-1].estimate.wires == "learned"
    assert reader.calibration is not None
    reader.calibration.save(tmp_path / "skin.json")
    kept = load_calibration(tmp_path / "skin.json").nominal_wire_ohm
    assert kept.both is not None
    stds = kept.top_log_std, kept.bottom_log_std
    for ohm, true_ohm, std in zip(kept.both, (TOP_WIRE_OHM, BOTTOM_WIRE_OHM), stds, strict=True):
        assert std is not None
        assert std < LAYER_STD
        assert abs(np.log(ohm / true_ohm)) < 3 * std


@pytest.mark.parametrize(
    "told",
    [NO_WIRES, WireOhm(100.0, 200.0), WireOhm(150.0, 150.0, 100.0, 0.06, 0.06, 20.0)],
)
def test_a_tare_leaves_the_wires_as_they_were_told(told: WireOhm) -> None:
    """Wires of a factor of two counted as measured; those of 6 % as of 52 % after three tares."""
    bench = stepped("emulator://8x8?scene=multi&begin=0&seed=1")
    reader = SkinReader(bench.info, replace(of_scene("rest"), nominal_wire_ohm=told))
    scans = list(islice(bench, 5))
    for scan in scans:
        reader.read(scan)
    reader.tare(scans[-1].ratio, force=True)
    reader.read(scans[-1])
    assert told_wires(reader) == told


def test_wires_that_were_taught_outlive_a_tare_and_another_loop() -> None:
    """Whichever estimator read last was asked, though it had seen one scan of an untouched skin."""
    reader, scans = taught()
    for scan in scans:
        reader.read(scan)
    learned = told_wires(reader)
    assert learned.both is not None
    (at_rest,) = islice(stepped("emulator://8x8?scene=rest"), 1)
    reader.another().read(at_rest)
    assert told_wires(reader) == learned
    reader.tare(at_rest.ratio, force=True)
    reader.read(at_rest)
    assert told_wires(reader) == learned
    reader.use("matrix")
    reader.read(at_rest)
    assert told_wires(reader) == learned


def told_wires(reader: SkinReader) -> WireOhm:
    """The wires that a session would keep."""
    assert reader.calibration is not None
    return reader.calibration.nominal_wire_ohm


def test_threads_that_ask_for_the_latest_scan_follow_a_contact_together(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Scans were read in a wrong order: a touch that stayed became a new one every few scans."""
    read, times_us = SkinReader.read, list[int]()

    def slow(reader: SkinReader, scan: Scan) -> ForceScan:
        times_us.append(scan.time_us)
        time.sleep(0.01)
        return read(reader, scan)

    with ohmskin.open(f"{GHOST}&speed=0", calibration=of_scene("ghost")) as board:
        monkeypatch.setattr(SkinReader, "read", slow)
        with ThreadPoolExecutor(3) as pool:
            scans = list(pool.map(lambda _: board.latest(), range(20)))
    assert times_us == sorted(times_us)
    assert {contact.identity for scan in scans for contact in scan.contacts} == {1, 2, 3}


def test_tare_follows_a_drift(tmp_path: Path) -> None:
    scene = Scene("rest", 8, 8, seed=1)
    drifted = replace(of_scene("rest"), rest=calibration(scene.rest_ratio).rest)
    level = drifted.rest.level * 0.9
    drifted = replace(drifted, rest=replace(drifted.rest, level=level))
    with ohmskin.open("emulator://8x8?seed=1", calibration=drifted) as board:
        before_n = board.latest().force_n
        tare = board.tare(0.2)
        after_n = board.latest().force_n
        board.calibration.save(tmp_path / "skin.json")
    np.testing.assert_allclose(tare.rest_ratio, scene.rest_ratio, atol=1 / 1024)
    assert np.median(before_n) > 0.003 > 10 * np.median(after_n)
    with ohmskin.open("emulator://8x8?seed=1", calibration=tmp_path / "skin.json") as board:
        assert np.median(board.latest().force_n) < 0.0003
        board.undo_tare()
        assert np.median(board.latest().force_n) > 0.003
        assert board.calibration.tare is None


def assert_same_forces(first: list[ForceScan], second: list[ForceScan]) -> None:
    assert len(first) == len(second)
    for one, other in zip(first, second, strict=True):
        assert one.number == other.number
        assert one.force_n.tobytes() == other.force_n.tobytes()
        assert one.force_n_std.tobytes() == other.force_n_std.tobytes()
        assert [c.identity for c in one.contacts] == [c.identity for c in other.contacts]
        assert [c.force_n for c in one.contacts] == [c.force_n for c in other.contacts]


@pytest.mark.parametrize("method", ["touch", "joint"])
def test_replay_gives_the_same_forces_bit_for_bit(tmp_path: Path, method: str) -> None:
    port, path = "emulator://8x8?scene=multi&begin=0&seed=1", tmp_path / "skin.mcap"
    of_skin = of_scene("moving", method=method)
    live: list[ForceScan] = []
    with (
        ohmskin.open(port, calibration=of_skin, start=False) as board,
        Recorder(path, board.info) as recorder,
    ):
        for scan in islice(board, 60):
            live.append(scan)
            recorder.add(scan)
            if len(live) == 20:
                recorder.add(board.tare(0.1, force=True))
            if len(live) == 40:
                recorder.add(board.undo_tare())
    assert len(load_recording(path).tares) == 2
    with ohmskin.open(f"replay://{path}?speed=0", calibration=of_skin) as board:
        assert isinstance(board, CalibratedSkin)
        assert_same_forces(live, list(board))
    # The tare was of consequence.
    with ohmskin.open(f"replay://{path}?speed=0") as recording:
        reader = SkinReader(recording.info, of_skin)
        untared = [reader.read(replace(scan, rest_ratio=None)) for scan in recording]
    assert live[10].force_n.tobytes() == untared[10].force_n.tobytes()
    assert live[30].force_n.tobytes() != untared[30].force_n.tobytes()


def test_a_recorded_tare_that_cannot_be_read_is_never_in_force() -> None:
    """The first scan was refused; the next ones were read by the rest before it."""
    bench = stepped(GHOST)
    reader = SkinReader(bench.info, of_scene("ghost"))
    (scan,) = islice(bench, 1)
    bad = replace(scan, rest_ratio=np.full((8, 8, 4), np.nan))
    for _ in range(2):
        with pytest.raises(ValueError, match="rest_ratio of cell"):
            reader.read(bad)


@pytest.mark.parametrize("mode", ["half", "quick"])
def test_a_tare_in_any_mode_of_near_ends_is_kept(mode: str, tmp_path: Path) -> None:
    """'ohmskin tare' ended with "Out of range float values are not JSON compliant"."""
    port, path = f"emulator://8x8?seed=1&speed=0&mode={mode}", tmp_path / "skin.json"
    with ohmskin.open(port, calibration=of_scene("rest")) as board:
        board.tare(0.1)
        board.calibration.save(path)
    for mode_now in (mode, "near"):
        with ohmskin.open(f"{GHOST}&speed=0&mode={mode_now}", calibration=path) as board:
            assert len(board.latest().contacts) == 3


def test_a_tare_is_on_the_clock_of_the_scans() -> None:
    with ohmskin.open(f"{GHOST}&speed=0", calibration=of_scene("ghost")) as skin:
        skin.latest()
        for tare in (skin.tare(0.1, force=True), skin.undo_tare()):
            assert tare.host_time_s == skin.device.now_s < 2


@pytest.fixture
def recorded(tmp_path: Path) -> Record:
    """A function that records so many scans of a ghost, and a tare before one of them."""

    def record(count: int, tare_at: int) -> str:
        path, bench = tmp_path / "skin.mcap", stepped(GHOST)
        scans = list(islice(bench, count))
        tares = [Tare(scan.ratio, scan.host_time_s) for scan in scans[tare_at : tare_at + 1]]
        write_recording(path, bench.info, [*scans[:tare_at], *tares, *scans[tare_at:]])
        return f"replay://{path}"

    return record


def test_latest_follows_the_same_tares(recorded: Record) -> None:
    port = f"{recorded(20, 10)}?speed=0"
    with ohmskin.open(port, calibration=of_scene("ghost")) as board:
        contacts = [len(board.latest().contacts) for _ in range(20)]
    assert contacts == 10 * [3] + 10 * [0]


def test_latest_does_not_miss_a_tare_whose_scan_it_skips(recorded: Record) -> None:
    with ohmskin.open(recorded(90, 20), calibration=of_scene("ghost")) as board:
        first = board.latest()
        assert len(first.contacts) == 3
        time.sleep(0.5)
        later = board.latest()
        assert later.number > first.number + 25
        assert later.contacts == ()


def test_a_tare_at_the_end_of_a_replay_says_so(recorded: Record) -> None:
    port = f"{recorded(5, 5)}?speed=0"
    with ohmskin.open(port, calibration=of_scene("ghost")) as board:
        assert len(list(board)) == 5
        with pytest.raises(DeviceLost, match="gives no more scans"):
            board.tare()


@pytest.mark.parametrize("other", ["8x8?scene=multi&begin=0&unit=77", "4x4?unit=77"])
def test_another_unit_behind_the_same_line_ends_the_forces(other: str) -> None:
    """They were silently those of the calibration of the unit before."""
    link = stepped_link(GHOST)
    with CalibratedSkin(SteppedSkin(link), of_scene("ghost")) as skin:
        scans = iter(skin)
        assert np.nansum(next(scans).force_n) > 0
        link.board.reset()
        link.board, _, _ = emulated(f"emulator://{other}")
        with pytest.raises(DeviceLost, match=r"unit 77 has come in place of unit 0: open it again"):
            deque(scans, maxlen=0)


def test_the_same_unit_goes_on_after_a_reset_and_under_a_new_name() -> None:
    link = stepped_link(GHOST)
    with CalibratedSkin(SteppedSkin(link), of_scene("ghost")) as skin:
        scans = iter(skin)
        next(scans)
        link.board.reset()
        assert len(list(islice(scans, 20))) == 20
        assert skin.stats.restarts == 1
        skin.device.set_unit_id(5)
        assert len(list(islice(scans, 20))) == 20


def test_another_unit_in_a_recording_ends_its_forces(tmp_path: Path) -> None:
    board = stepped(GHOST)
    scans = list(islice(board, 3))
    path = tmp_path / "two.mcap"
    write_recording(path, board.info, [*scans, replace(board.info, unit_id=77), *scans])
    with ohmskin.open(f"replay://{path}?speed=0", calibration=of_scene("ghost")) as skin:
        played = iter(skin)
        with pytest.raises(DeviceLost, match="unit 77 has come in place of unit 0"):
            deque(played, maxlen=0)
