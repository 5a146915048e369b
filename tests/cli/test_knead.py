# SPDX-License-Identifier: Apache-2.0
"""``calibrate knead`` and ``weights --anywhere``: emulated skins, and how near to the truth."""

import os
import re
import signal
from contextlib import AbstractContextManager
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from test_first_hour import streamed

import ohmskin
from command_line import Command, Run, assert_one_line, well
from ohmskin.calibrate.coverage import LiveCoverage
from ohmskin.calibrate.sessions import joined
from ohmskin.cli.knead import KneadMap
from ohmskin.emulate.driver import SteppedSkin
from ohmskin.emulate.scenes import Scene
from ohmskin.force.calibration import load_calibration
from ohmskin.link.messages import Scan
from ohmskin.record.recorder import Recorder
from ohmskin.record.recording import ForceSample, Recording, Tare, load_recording
from stepped import stepped

SKIN = "emulator://2x3?speed=0&rate=20"
TRUTH = ("--force-port", "truth")


def errors(path: Path, force_n: float = 3.0, seed: int = 0) -> np.ndarray:
    """By what share the cells' forces are off, were their conductances known (R, C)."""
    model = load_calibration(path).model
    scene = Scene("weights", *model.kind.shape, seed=seed)
    rises = np.empty(model.kind.shape)
    for cell in np.ndindex(rises.shape):
        scene.put((cell, force_n))
        rises[cell] = (scene.skin(0.0).cell_siemens - scene.rest.cell_siemens)[cell]
    return model.predict(rises, np.zeros_like(rises))[0] / force_n - 1


def test_a_skin_is_kneaded_until_every_cell_is_known(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "skin.json"
    done = well(run("calibrate", "knead", f"{SKIN}&scene=knead", str(out), *TRUTH))
    lines = done.out.splitlines()
    assert lines[0].startswith("touch nothing for 2 s, then press everywhere")
    assert re.fullmatch(r"10 s: \d of 6 cells are known to 15 %, the wires need .*", lines[1])
    assert "6 of 6 cells are known to 15 %" in done.out
    assert f"{out}: calibration of unit 0" in lines[-1]
    recording = load_recording(tmp_path / "skin.knead-1.mcap")
    assert recording.scans[-1].host_time_s < 40.0
    off = errors(out)
    assert np.abs(off).max() < 0.3
    assert np.sqrt(np.mean(off**2)) < 0.15
    assert load_calibration(out).indenter_area_m2 is None
    force_n, true_n = streamed(run, "emulator://2x3?scene=ghost&begin=0&speed=0", out)
    np.testing.assert_allclose(force_n[true_n > 0], true_n[true_n > 0], rtol=0.3)
    # Once more: all is known, and nothing is recorded. Where cells are stays in the file.
    well(run("skin", str(out), "--pitch-mm", "10,10"))
    again = well(run("calibrate", "knead", f"{SKIN}&scene=knead", str(out), *TRUTH))
    assert f"cells stay where {out} had them: flat" in again.out
    assert "touch nothing" not in again.out
    assert not (tmp_path / "skin.knead-2.mcap").exists()
    # Where that has failed to teach a calibration, more is recorded; an older one may be there.
    newest_s = (tmp_path / "skin.knead-1.mcap").stat().st_mtime
    os.utime(out, (newest_s - 60, newest_s - 60))
    again = well(run("calibrate", "knead", f"{SKIN}&scene=knead", str(out), *TRUTH))
    assert "skin.knead-2.mcap: " in again.out
    assert out.stat().st_mtime > newest_s


def test_a_dead_cell_is_named_and_not_waited_for(run: Run, tmp_path: Path) -> None:
    """All other cells were known after 10 s, and it never ended by itself."""
    out = tmp_path / "skin.json"
    knead = ("calibrate", "knead", f"{SKIN}&scene=knead&dead=1,1", str(out), *TRUTH)
    done = well(run(*knead, "--seconds", "60"))
    assert "5 of 6 cells are known to 15 %, these never answered: 1,1 ('ohmskin doctor'" in done.out
    assert "the same command goes on" not in done.out.splitlines()[-1]
    assert load_recording(tmp_path / "skin.knead-1.mcap").scans[-1].host_time_s < 40.0
    assert load_calibration(out).model.pooled.tolist() == [[False] * 3, [False, True, False]]
    again = well(run(*knead))  # all is known that can be, and nothing is recorded
    assert "touch nothing" not in again.out


def test_kneading_goes_on_where_it_was_ended(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "skin.json"
    command = ("calibrate", "knead", f"{SKIN}&scene=knead&begin=3", str(out), *TRUTH)
    done = well(run(*command, "--seconds", "7"))
    assert "not all cells are known yet: the same command goes on" in done.out
    known = [int(n) for n in re.findall(r"(\d+) of 6 cells are known", done.out)]
    first = load_calibration(out)
    done = well(run(*command, "--seconds", "7"))
    now = [int(n) for n in re.findall(r"(\d+) of 6 cells are known", done.out)]
    assert known[-1] < now[-1]
    assert len(list(tmp_path.glob("skin.knead-*.mcap"))) == 2
    surer = load_calibration(out).model
    assert (surer.slope_std / surer.slope < first.model.slope_std / first.model.slope).all()


def test_a_touch_at_the_rest_of_an_older_recording_is_named(run: Run, tmp_path: Path) -> None:
    """The newest rest alone was looked at, and the older recording taught what it could not."""
    out, path = tmp_path / "skin.json", tmp_path / "skin.knead-1.mcap"
    command = ("calibrate", "knead", f"{SKIN}&scene=knead&begin=3", str(out), *TRUTH)
    well(run(*command, "--seconds", "9"))
    given = load_recording(path)
    pressed_s = max(given.forces, key=lambda force: force.force_n).host_time_s
    pressed = next(scan for scan in given.scans if scan.host_time_s >= pressed_s)
    path.unlink()
    with Recorder(path, given.hellos[0]) as recorder:
        recorder.add(replace(given.tares[0], rest_ratio=pressed.ratio))
        for message in [*given.scans, *given.forces]:
            recorder.add(message)
    before = out.read_bytes()
    done = run(*command, "--seconds", "11")
    assert_one_line(done._replace(out=""), "skin.knead-1.mcap: ", "touched at rest: move it away")
    assert out.read_bytes() == before
    well(run(*command, "--seconds", "9", "--force"))


def test_a_press_that_is_left_out_is_named_by_its_recording(run: Run, tmp_path: Path) -> None:
    """Its time was that since the first recording began, with pauses that were made up."""
    out = tmp_path / "skin.json"
    command = ("calibrate", "knead", f"{SKIN}&scene=knead&begin=3", str(out), *TRUTH)
    for _ in range(2):
        well(run(*command, "--seconds", "9"))
    path = tmp_path / "skin.knead-2.mcap"
    given = load_recording(path)
    begin_s = given.scans[0].host_time_s
    pressed_s = [f.host_time_s - begin_s for f in given.forces if f.force_n > 1.0]
    at_s = next(time_s for time_s in pressed_s if time_s > 4.0)
    path.unlink()
    with Recorder(path, given.hellos[0]) as recorder:
        for message in [*given.tares, *given.scans]:
            recorder.add(message)
        for force in given.forces:
            beside_n = 5.0 * (abs(force.host_time_s - begin_s - at_s) < 0.3)
            recorder.add(replace(force, force_n=force.force_n + beside_n))
    done = well(run(*command, "--seconds", "3"))
    spans = re.findall(r"left out: (\S+), (\S+) to (\S+) s, force beside", done.out)
    times_s = [(float(begin), float(end)) for name, begin, end in spans if name == path.name]
    assert any(begin_s - 0.1 < at_s < end_s + 0.1 for begin_s, end_s in times_s)
    assert all(float(end) < 12.0 for _, _, end in spans)


def test_what_far_ends_showed_is_known_after_a_short_recording(run: Run, tmp_path: Path) -> None:
    """The wires of the last recording alone were kept: what the one before had shown was gone."""
    out, stds = tmp_path / "skin.json", []
    command = ("calibrate", "knead", f"{SKIN}&scene=knead&begin=3&mode=far", str(out), *TRUTH)
    for seconds in ("11", "2.2"):
        well(run(*command, "--seconds", seconds))
        stds.append(load_calibration(out).nominal_wire_ohm[3:6])
    assert (np.array(stds[1]) < 1.5 * np.array(stds[0])).all()


@pytest.mark.parametrize("ends", [20, 60, 90], ids=["amid the tare", "unpressed", "pressed once"])
def test_an_early_ctrl_c_is_no_error_and_kneading_goes_on(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends: int
) -> None:
    look = KneadMap.look

    def interrupted(shown: KneadMap, scan: Scan) -> None:
        look(shown, scan)
        if scan.number == ends:
            signal.raise_signal(signal.SIGINT)

    out = tmp_path / "skin.json"
    command = ("calibrate", "knead", f"{SKIN}&scene=knead&begin=3", str(out), *TRUTH)
    with monkeypatch.context() as patch:
        patch.setattr(KneadMap, "look", interrupted)
        done = well(run(*command))
    assert re.search(r"no calibration is made \(.+\): the same command goes on\n$", done.out)
    assert not out.exists()
    # A rest that was cut off would be that of all recordings.
    assert (tmp_path / "skin.knead-1.mcap").exists() == (ends != 20)
    assert "--rest" not in done.out
    well(run(*command, "--seconds", "9"))
    assert out.exists()


def test_a_skin_that_cannot_be_read_is_not_known_and_says_why(run: Run, tmp_path: Path) -> None:
    """Its other cells came out as known, and then no press was there to learn from."""
    port, out = "emulator://3x3?speed=0&rate=20&scene=knead&begin=3&open_row=1", tmp_path / "a.json"
    done = run("calibrate", "knead", port, str(out), *TRUTH, "--seconds", "12")
    assert "0 of 9 cells are known to 15 %, the wires need 72 more numbers" in done.out
    why = (
        "no press can be read (row 1 conducted nothing at rest: is it open?): 'ohmskin doctor PORT'"
    )
    assert_one_line(done._replace(out=""), why)


def test_a_scale_that_is_upside_down_teaches_nothing(run: Run, tmp_path: Path) -> None:
    """No press was kept, and it ended with a division by zero."""
    out, path = tmp_path / "skin.json", tmp_path / "skin.knead-1.mcap"
    port = f"{SKIN}&scene=knead&begin=3"
    well(run("calibrate", "knead", port, str(out), *TRUTH, "--seconds", "11"))
    given, turned = load_recording(path), tmp_path / "turned.mcap"
    with Recorder(turned, given.hellos[0]) as recorder:
        for message in [*given.tares, *given.scans]:
            recorder.add(message)
        for force in given.forces:
            recorder.add(replace(force, force_n=-force.force_n))
    done = run("calibrate", "recording", str(turned), str(out), "--total")
    assert_one_line(done, "the total force does not follow the skin")


def test_fingertips_wait_until_somebody_reads() -> None:
    """Else a slow start of the command would measure the rest under them."""
    with ohmskin.open(f"{SKIN}&scene=knead", start=False) as skin:
        assert isinstance(skin, SteppedSkin)
        skin.step(60.0)
        forces_n = [skin.true_force_n(scan).sum() for scan in islice(skin, 200)]
    assert not np.any(forces_n[:119])
    assert np.any(forces_n[119:])


def test_a_rest_during_which_the_scale_moves_is_refused(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "skin.json"
    done = run("calibrate", "knead", f"{SKIN}&scene=knead&begin=0.5", str(out), *TRUTH)
    assert_one_line(done._replace(out=""), "at rest")
    assert "the force moved by" in done.err
    assert list(tmp_path.iterdir()) == []


class TwoBadLines(AbstractContextManager["TwoBadLines"]):
    """In place of a `ForceSensor`: it never says a force, and two lines could not be read."""

    damaged = 2

    def __init__(self, *_: object) -> None:
        pass

    def __exit__(self, *_: object) -> None:
        pass

    def wait(self) -> None:
        pass

    def take(self) -> list[ForceSample]:
        return []


def test_lines_of_the_scale_that_could_not_be_read_are_counted(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ohmskin.cli.record.ForceSensor", TwoBadLines)
    command = ("calibrate", "knead", f"{SKIN}&scene=knead", str(tmp_path / "skin.json"))
    done = run(*command, "--force-port", "scale", "--seconds", "3")
    assert "0 forces, 2 lines that could not be read: 0 of 6 cells" in done.out
    # It was "not enough values to unpack".
    assert_one_line(done._replace(out=""), "no force was recorded while the skin was scanned")


class Weighing(TwoBadLines):
    """In place of a `ForceSensor`, ten numbers a second: at first, something is lifted off it."""

    on_it, lifted, now_s = 0.0, 0.0, 0.0

    def take(self) -> list[ForceSample]:
        self.now_s += 0.1
        left = max(0.0, self.lifted - 300 * self.now_s)
        return [ForceSample(self.on_it + left, self.now_s)]


@pytest.mark.parametrize(
    ("lifted", "words"),
    [
        (0.0, "(the weights agree within 0.0 %), 2 lines that could not be read"),
        (500.0, "without a weight, its numbers moved by 165: weigh again"),
    ],
)
def test_a_scale_is_empty_and_still_before_weights_are_put_on_it(
    run: Run, monkeypatch: pytest.MonkeyPatch, lifted: float, words: str
) -> None:
    def prompt(text: str, **_: object) -> str:
        mass_g = re.search(r"put (\d+) g", text)
        Weighing.on_it = float(mass_g[1]) if mass_g else 0.0
        return ""

    monkeypatch.setattr("typer.prompt", prompt)
    monkeypatch.setattr(Weighing, "on_it", 0.0)
    monkeypatch.setattr(Weighing, "lifted", lifted)
    monkeypatch.setattr("ohmskin.cli.scale.ForceSensor", Weighing)
    done = run("calibrate", "scale", "load cell", "--grams", "200,500")
    assert words in done.out + done.err


def test_wrong_uses_of_knead(run: Run, tmp_path: Path) -> None:
    out = str(tmp_path / "skin.json")
    knead = ("calibrate", "knead", SKIN, out, "--force-port")
    done = run(*knead, "/dev/ttyNONE")
    assert_one_line(done, "no port /dev/ttyNONE")
    assert "goes on" not in done.err
    assert_one_line(run(*knead, "truth", "--method", "rsq"), "no method 'rsq'")
    assert list(tmp_path.iterdir()) == []
    done = run(*knead, "truth", "--seconds", "3")
    assert_one_line(done._replace(out=""), "force_n is 0 throughout: does the sensor")


def test_a_board_that_cannot_be_kneaded_says_so_at_once(run: Run, tmp_path: Path) -> None:
    """It was kneaded until all was known, and then refused."""
    knead, out = ("calibrate", "knead"), str(tmp_path / "skin.json")
    done = run(*knead, f"{SKIN}&scene=knead&mode=half", out, *TRUTH)
    assert_one_line(
        done,
        "all of it, and this board is in mode half: 'ohmskin configure PORT --mode near --save'",
    )
    well(run(*knead, f"{SKIN}&scene=knead", out, *TRUTH, "--seconds", "11"))
    done = run(*knead, f"{SKIN}&scene=knead&mode=far", out, *TRUTH)
    of = "2x3 cells of unit 0 in mode"
    assert_one_line(done, f"recorded before: {of} near; now: {of} far: move the recordings")
    assert not (tmp_path / "skin.knead-2.mcap").exists()


def test_a_recording_that_has_no_scans_spoils_no_other() -> None:
    """An interrupted start took the tare of all that had been recorded before."""
    bench = stepped("emulator://2x3")
    scans = list(islice(bench, 3))
    tare = Tare(scans[0].ratio, scans[0].host_time_s)
    good = Recording([bench.info], scans, [tare], [], [], cut_off=False)
    (only,) = joined([good, Recording([bench.info], [], [], [], [], cut_off=False)])
    assert len(only.scans) == 3
    assert only.tares == [tare]


def test_a_tare_of_another_mode_is_no_rest_of_a_recording() -> None:
    """An older recording was read above its first tare, whatever that had read."""
    bench = stepped("emulator://2x3")
    scans = list(islice(bench, 3))
    tare = Tare(scans[0].ratio, scans[0].host_time_s)
    far = replace(tare, mode="far")
    given = [
        Recording([bench.info], scans, tares, [], [], cut_off=False)
        for tares in ([far, tare], [far], [tare])
    ]
    assert [each.tares for each in joined(given)] == [[tare], [tare]]


def test_the_map_shows_each_cell_and_where_to_press_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    console = Console(width=80, color_system=None)
    with ohmskin.open("emulator://2x3?speed=0") as skin:
        board = skin.info
    coverage = LiveCoverage(board)
    monkeypatch.setattr("ohmskin.calibrate.coverage.NUMBERS_A_CELL", 0)
    coverage.ask_more()
    coverage.log_std[:] = [[0.12, 0.5, 0.1], [0.14, 0.9, 0.2]]
    with Recorder(tmp_path / "a.mcap", board, lambda: 5.0) as recorder, console.capture() as got:
        shown = KneadMap(recorder, coverage)
        console.print(shown.picture())
        recorder.add(Tare(np.full((2, 3, 4), 0.5), 1.0))
        console.print(shown.picture())
    with monkeypatch.context() as patch:
        patch.setattr(LiveCoverage, "is_upside_down", True)
        assert shown.words().endswith("turn the sign of --force-scale")
    lines = [line.split() for line in got.get().splitlines()]
    assert ["touch", "nothing", "yet"] in lines
    assert "3 of 6 cells are known to 15 %, press at row 1, column 1" in got.get()
    assert lines.count(["0", "12", "50", "10"]) == lines.count(["1", "14", "90", "20"]) == 2


def test_weights_are_put_anywhere(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "skin.json"
    grams = ("--anywhere", "--grams", "100,300,700", "--repeats", "3")
    done = well(run("calibrate", "weights", f"{SKIN}&scene=weights", str(out), *grams))
    asked = [line for line in done.out.splitlines() if line.startswith("put ")]
    assert len(asked) == 9
    assert asked[0] == "put 100 g (0.981 N) where none has been yet"
    assert f"{out}: calibration of unit 0" in done.out
    recording = load_recording(tmp_path / "skin.weights-1.mcap")
    forces_n = {round(sample.force_n, 3) for sample in recording.forces}
    assert forces_n == {0.981, 2.942, 6.865}
    assert [mark.text for mark in recording.marks].count(repr(0.980665)) == 3
    assert np.abs(np.median(errors(out))) < 0.15
    # Nothing is missing: it is learned from at once.
    slope = load_calibration(out).model.slope.tolist()
    done = well(run("calibrate", "weights", f"{SKIN}&scene=weights", str(out), *grams))
    assert "put 100" not in done.out
    assert load_calibration(out).model.slope.tolist() == slope
    for words in (("--indenter-mm2", "80"), ("--cells", "0,0"), ("--redo", "0,0")):
        done = run("calibrate", "weights", SKIN, str(out), *grams, *words)
        assert_one_line(done, "--anywhere without --indenter-mm2, --cells, --redo")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--grams", "200"), "all 20 forces are 1.96133 N: press with different forces"),
        (("--grams", "100,200", "--repeats", "2"), "too few presses: 4, 5 are needed"),
    ],
)
def test_weights_that_teach_nothing_are_refused_before_they_are_put_on(
    run: Run, tmp_path: Path, options: tuple[str, ...], words: str
) -> None:
    out = str(tmp_path / "skin.json")
    done = run("calibrate", "weights", "/dev/no_port", out, "--anywhere", *options)
    assert_one_line(done, f"--grams, --repeats: {words}")


def test_a_board_and_a_scale_at_ports_are_enough(
    run: Run, command: Command, tmp_path: Path
) -> None:
    """As users have them; both are emulated, by another process."""
    process = command("emulate", "emulator://2x2?scene=knead&scale_rate=20&begin=3")
    board, scale = process.stdout.readline().strip(), process.stdout.readline().strip()
    out = tmp_path / "skin.json"
    try:
        ports = ("calibrate", "knead", board, str(out), "--force-port", scale)
        done = well(run(*ports, "--seconds", "20"))
    finally:
        process.kill()
        process.communicate()
    assert f"{out}: calibration of unit 0" in done.out
    assert np.abs(errors(out)).max() < 0.5
    sources = {sample.source for sample in load_recording(tmp_path / "skin.knead-1.mcap").forces}
    assert sources == {scale}
