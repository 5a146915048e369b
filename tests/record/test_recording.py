# SPDX-License-Identifier: Apache-2.0
"""Recordings: what is written is read again, and replayed.

Files are read here by the `mcap` library's own readers as well, not by ours alone.
"""

import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.reader import make_reader

import ohmskin
from command_line import Command, Done, Run, assert_one_line, finish, python, well
from ohmskin.emulate.urls import emulated
from ohmskin.errors import CommandRefused, DeviceLost, PortError, RecordingEnded, RecordingError
from ohmskin.force.tables import export
from ohmskin.link.device import Region
from ohmskin.link.messages import Hello, Scan
from ohmskin.record.readings import estimate_file, load_readings
from ohmskin.record.recorder import Recorder, record
from ohmskin.record.recording import (
    SCHEMAS,
    ForceSample,
    Mark,
    Tare,
    load_recording,
    messages,
)
from recordings import URL, assert_same, replayed, scan, write_recording
from stepped import stepped
from waiting import until

pytestmark = pytest.mark.usefixtures("nothing_left")


def test_everything_is_read_again(path: Path, hello: Hello) -> None:
    scans = list(islice(stepped(URL), 50))
    tare = Tare(np.mean([each.ratio for each in scans], axis=0), 0.5)
    others = [Mark("pressed \u00fc", 1.5), ForceSample(0.25, 2.5, "scale")]
    write_recording(path, hello, [*scans, tare, *others])
    found = load_recording(path)
    assert not found.cut_off
    assert found.hellos == [hello]
    assert_same(found.scans, scans)
    np.testing.assert_array_equal(found.tares[0].rest_ratio, tare.rest_ratio)
    assert [*found.marks, *found.forces] == others


def test_scans_keep_their_mode(tmp_path: Path, path: Path, hello: Hello) -> None:
    """Two scans of each mode: read, replayed, exported, and read by methods that know but one."""
    modes = ["near", "near", "far", "far"]
    scans = [replace(scan(n), mode=mode) for n, mode in enumerate(modes)]
    far = replace(hello, mode="far")
    write_recording(path, hello, [*scans[:2], far, *scans[2:]])
    assert [each.mode for each in load_recording(path).hellos] == ["near", "far"]
    for found in (load_recording(path).scans, replayed(path)):
        assert [each.mode for each in found] == modes
    export(path, tmp_path / "both.npz")
    both = np.load(tmp_path / "both.npz")
    assert both["reading_names"].tolist() == list("abcdef")
    np.testing.assert_array_equal(both["ratio"][:2, ..., :4], [each.ratio for each in scans[:2]])
    far_ratio = both["ratio"][2:][..., [0, 4, 1, 5]]
    np.testing.assert_array_equal(far_ratio, [each.ratio for each in scans[2:]])
    assert np.isnan(both["ratio"][:2, ..., 4:]).all()
    assert np.isnan(both["ratio"][2:, ..., 2:4]).all()
    for out in (tmp_path / "far.npz", tmp_path / "far.csv"):
        export(path, out, begin_s=0.004)
    readings = load_readings(tmp_path / "far.npz")
    assert readings.reading_names == ("a", "e", "b", "f")
    np.testing.assert_array_equal(readings.ratio, [each.ratio for each in scans[2:]])
    with pytest.raises(ValueError, match="'matrix' takes the readings a b c d, not a e b f"):
        estimate_file(readings, "matrix")
    assert len(estimate_file(readings, "joint")["cell_siemens"]) == len(scans[2:])
    header = (tmp_path / "far.csv").read_text().splitlines()[0].split(",")
    assert header[4:8] == ["r0c0a", "r0c0e", "r0c0b", "r0c0f"]


def test_other_programs_read_it(path: Path, hello: Hello) -> None:
    """The library's seeking reader, with the index; each message fits its schema's properties."""
    before_ns = time.time_ns()
    write_recording(path, hello, [scan(n, at_s=time.monotonic()) for n in range(20)])
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary.statistics.message_count == 21
        topics = {channel.topic for channel in summary.channels.values()}
        assert topics == {f"/skin/{name}" for name in ("hello", "scan", "tare", "mark", "force")}
        for schema, channel, message in reader.iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            definition, content = json.loads(schema.data), json.loads(message.data)
            assert definition["type"] == "object"
            assert list(content) == definition["required"] == list(definition["properties"])
            kinds = {"integer": int, "number": float, "string": str, "array": list}
            for name, value in content.items():
                assert type(value) is kinds[definition["properties"][name]["type"]]
            assert before_ns - 1e6 < message.log_time < time.time_ns() + 1e6
            if channel.topic == "/skin/scan":
                expected = scan(content["number"])
                assert content["codes"] == expected.codes.reshape(-1).tolist()


def test_all_that_a_stepped_skin_gave_is_on_one_clock(path: Path, run: Run) -> None:
    """Its time has nothing to do with the machine's: three seconds of it pass at once."""
    before_ns = time.time_ns()
    port = "emulator://2x2?rate=50&speed=0"
    well(run("record", port, str(path), "--tare", "1", "--mark", "begin", "--seconds", "3"))
    recorded = load_recording(path)
    begin_s, (tare,), (mark,) = recorded.scans[0].host_time_s, recorded.tares, recorded.marks
    assert mark.host_time_s <= begin_s
    assert tare.host_time_s == pytest.approx(begin_s + 1)
    with path.open("rb") as file:
        times_ns = [message.log_time for *_, message in make_reader(file).iter_messages()]
    assert before_ns - 1e9 < min(times_ns) < before_ns + 60e9
    assert max(times_ns) - min(times_ns) == pytest.approx(3e9, abs=0.1e9)


def test_a_scan_that_waited_is_recorded_behind_its_own_hello(path: Path) -> None:
    """The newest one was recorded before all scans that still waited when somebody configured."""
    bench = stepped("emulator://3x4?rate=50")
    with Recorder(path, bench.info) as recorder:
        scans = iter(bench)
        bench.step(0.2)
        before, after = bench.info, bench.configure(rate_hz=100)
        bench.step(0.2)
        record(bench, recorder, islice(scans, 20))
    found = [each for each in messages(path) if isinstance(each, Hello | Scan)]
    waited = found.index(after) - 1
    assert 9 <= waited <= 10
    assert [each for each in found if isinstance(each, Hello)] == [before, after]
    numbers = [each.number for each in found if isinstance(each, Scan)]
    assert numbers == [*range(waited), *range(20 - waited)]  # they begin anew with the board
    assert [each.board for each in replayed(path)] == waited * [before] + (20 - waited) * [after]


def test_size_on_disk(path: Path, hello: Hello) -> None:
    """At most 40 kB/s for 8x8 at 90 Hz, half a second in each chunk."""
    board, _, _ = emulated("emulator://8x8?scene=moving&noise=1")
    with Recorder(path, hello) as recorder:
        for number in range(450):
            recorder.add(
                Scan(board.codes_at(3 + number / 90), number, 11_111 * number, number / 90, 0)
            )
            if number % 45 == 44:
                recorder.flush()
    assert path.stat().st_size < 5 * 40_000


def test_what_is_no_message_is_refused(path: Path, hello: Hello) -> None:
    """It was a StopIteration, which ends a generator as if all were well."""
    words = r"a recording has .*Scan, .*, and no str$"
    with Recorder(path, hello) as recorder, pytest.raises(TypeError, match=words):
        recorder.add("a mark")  # type: ignore[arg-type]


def test_an_existing_file_is_left_alone(tmp_path: Path, path: Path, hello: Hello) -> None:
    path.write_text("mine")
    with pytest.raises(RecordingError, match="there already"):
        Recorder(path, hello)
    assert path.read_text() == "mine"
    with pytest.raises(RecordingError, match="No such file"):
        Recorder(tmp_path / "nowhere" / "a.mcap", hello)


@pytest.mark.parametrize(
    ("tare_s", "scans", "tared"),
    [
        (0.0, 7, None),
        (0.01, 20, slice(0, 5)),  # at 400 Hz, and the one that comes then
        (0.03, 20, slice(10, 13)),  # of the later size
        (1.0, 15, slice(10, 15)),
    ],
)
def test_the_record_loop(
    path: Path, hello: Hello, tare_s: float, scans: int, tared: slice | None
) -> None:
    """Its board is configured anew after ten scans."""
    board = SimpleNamespace(info=hello)
    given = [scan(n, rows=3 if n < 10 else 2) for n in range(20)]
    seen: list[Scan] = []

    def scanned() -> Iterator[Scan]:
        for each in given[:scans]:
            if each.number == 10:
                board.info = replace(hello, rows=2, row_mask=3)
            yield each

    with Recorder(path, hello) as recorder:
        record(board, recorder, scanned(), tare_s=tare_s, beside=seen.append)
    found = load_recording(path)
    assert_same(found.scans, given[:scans])
    assert [each.number for each in seen] == list(range(scans))
    assert [each.rows for each in found.hellos] == ([3, 2] if scans > 10 else [3])
    assert len(found.tares) == (tared is not None)
    if tared is not None:
        expected = np.mean([each.ratio for each in given[tared]], axis=0)
        np.testing.assert_allclose(found.tares[0].rest_ratio, expected, rtol=1e-12)


@pytest.mark.parametrize("how", ["stop", "configure"])
def test_a_fast_replay_that_pauses_loses_nothing(path: Path, hello: Hello, how: str) -> None:
    """Also the scan that was played before the pause, and that nobody had taken yet."""
    write_recording(path, hello, scans := [scan(n) for n in range(4)])
    with ohmskin.open(f"replay://{path}?speed=0") as skin:
        found = [skin.latest()]
        until(lambda: skin.stats.scans == 2)
        if how == "stop":
            skin.stop()
        else:
            with pytest.raises(CommandRefused):
                skin.configure(rate_hz=10)
        assert_same(found + [skin.latest() for _ in scans[1:]], scans, host_time=False)


def test_replay_is_the_recording_bit_for_bit(path: Path, hello: Hello) -> None:
    scans = list(islice(stepped(f"{URL}&drop=0.05"), 300))
    assert any(each.missed for each in scans)
    write_recording(path, hello, scans)
    assert_same(replayed(path), scans, host_time=False)
    assert_same(replayed(path, speed=4), scans, host_time=False)


def test_a_slow_reader_of_a_fast_replay_loses_nothing(path: Path, hello: Hello) -> None:
    scans = [scan(n, rows=1, columns=1) for n in range(3000)]
    write_recording(path, hello, scans)
    with ohmskin.open(f"replay://{path}?speed=0") as skin:
        time.sleep(0.1)
        found = iter(skin)
        first = [next(found)]
        time.sleep(0.3)
        first += found
        assert skin.stats.overflowed == 0
    assert_same(first, scans, host_time=False)


def test_latest_of_a_fast_replay_gives_each(path: Path, hello: Hello) -> None:
    scans = [scan(n) for n in range(40)]
    write_recording(path, hello, scans)
    with ohmskin.open(f"replay://{path}?speed=0") as skin:
        assert_same([skin.latest() for _ in scans], scans, host_time=False)
        with pytest.raises(RecordingEnded, match="played to its end"):
            skin.latest()
        for _ in range(2):
            assert list(skin) == []
            skin.stop()
    with pytest.raises(DeviceLost, match="was closed"):
        skin.stop()


def test_replay_takes_the_recorded_time(path: Path, hello: Hello) -> None:
    write_recording(path, hello, [scan(n, at_s=7 + n / 10) for n in range(6)])
    begin_s = time.monotonic()
    found = replayed(path, speed=1)
    assert time.monotonic() - begin_s >= 0.5
    assert found[-1].host_time_s - found[0].host_time_s == pytest.approx(0.5, abs=0.4)


def test_replay_shortens_long_pauses(
    path: Path, hello: Hello, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ohmskin.record.replay.LONGEST_PAUSE_S", 0.1)
    write_recording(path, hello, [scan(0, at_s=0), scan(1, at_s=3600), scan(2, at_s=10)])
    begin_s = time.monotonic()
    assert len(replayed(path, speed=1)) == 3
    assert time.monotonic() - begin_s < 5


def test_a_recording_stays_as_it_is(path: Path, hello: Hello) -> None:
    scans = [scan(n) for n in range(30)]
    write_recording(path, hello, scans)
    with ohmskin.open(f"replay://{path}?speed=0") as skin:
        assert (skin.info.rows, skin.info.columns, skin.info.board) == (3, 4, "emulated")
        first = [skin.latest()]
        uses: list[Callable[[], object]] = [
            lambda: skin.configure(rows=2),
            skin.save,
            skin.self_test,
            skin.load_defaults,
            lambda: skin.set_unit_id(1),
        ]
        for use in uses:
            with pytest.raises(CommandRefused, match="is a recording"):
                use()
        skin.stop()
        skin.start()
        rest = list(skin)
    # What had come before the pause may be forgotten, as with any board; nothing comes twice.
    numbers = [each.number for each in first + rest]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == 29


def test_a_recording_keeps_what_was_read(path: Path, regions: list[Scan]) -> None:
    assert {(each.mode, each.is_whole) for each in regions} == {
        ("near", True),
        ("quick", False),
        ("half", False),
    }
    assert_same(load_recording(path).scans, regions)
    for each, before in zip(replayed(path), regions, strict=True):
        np.testing.assert_array_equal(each.read, before.read)
        np.testing.assert_array_equal(each.ratio, before.ratio)
        # A tare in mode near serves the others, too.
        assert each.rest_ratio is None or each.rest_ratio.shape == (4, 4, 4)
    assert each.rest_ratio is not None


def test_a_change_of_size_is_replayed(tmp_path: Path, path: Path, hello: Hello) -> None:
    scans = [scan(n, rows=3 if n < 5 else 2) for n in range(10)]
    tare = Tare(np.full((3, 4, 4), 0.25), 1.0)
    write_recording(path, hello, [tare, *scans[:5], replace(hello, rows=2, row_mask=3), *scans[5:]])
    with ohmskin.open(f"replay://{path}?speed=0") as skin:
        played = list(skin)
        assert_same(played, scans, host_time=False)
        assert [each.rest_ratio is None for each in played] == 5 * [False] + 5 * [True]
        assert skin.info.rows == 2
    with pytest.raises(RecordingError, match="the cells change after "):
        export(path, tmp_path / "a.npz")


def test_wrong_replays(tmp_path: Path, path: Path, hello: Hello) -> None:
    write_recording(path, hello, [scan(0)])
    for query in ("speed=-1", "speed=nan", "speed=fast", "baud=9600"):
        with pytest.raises(PortError, match="speed"):
            ohmskin.open(f"replay://{path}?{query}")
    with pytest.raises(RecordingError, match="No such file"):
        ohmskin.open(f"replay://{tmp_path}/none.mcap")
    path.unlink()
    beyond = scan(1)
    beyond.codes[0, 0, 0] = 1024
    write_recording(path, hello, [scan(0), beyond])
    with pytest.raises(RecordingError, match="codes: one is out of range"):
        replayed(path)


def test_a_skin_larger_than_any_board_is_replayed(path: Path, hello: Hello) -> None:
    write_recording(path, hello, [scan(0, rows=20)])
    assert replayed(path)[0].codes.shape == (20, 4, 4)


def test_scans_carry_the_tare_in_force(path: Path, hello: Hello) -> None:
    tares = [Tare(np.full((3, 4, 4), ratio), 1.0) for ratio in (0.25, 0.75)]
    write_recording(path, hello, [scan(0), tares[0], scan(1), scan(2), tares[1], scan(3)])
    rests = [each.rest_ratio for each in replayed(path)]
    assert rests[0] is None
    assert rests[1] is rests[2]
    for found, tare in ((rests[2], tares[0]), (rests[3], tares[1])):
        np.testing.assert_array_equal(found, tare.rest_ratio)


def test_a_tare_is_not_that_of_a_board_that_comes_later(
    tmp_path: Path, path: Path, hello: Hello
) -> None:
    """Forces of the other skin were wrong by newtons."""
    tare, other = Tare(np.full((3, 4, 4), 0.25), 0.0), replace(hello, unit_id=hello.unit_id + 1)
    write_recording(path, hello, [tare, scan(0), hello, scan(1), other, scan(2, at_s=1.0)])
    assert [each.rest_ratio is None for each in replayed(path)] == [False, False, True]
    export(path, tmp_path / "a.npz", begin_s=0.5)
    assert load_readings(tmp_path / "a.npz").rest_ratio is None


def test_a_tare_is_the_rest_of_scans_of_its_mode_alone(
    tmp_path: Path, path: Path, hello: Hello
) -> None:
    far = replace(hello, mode="far")
    tares = [Tare(np.full((3, 4, 4), 0.25), 1.0), Tare(np.full((3, 4, 4), 0.75), 1.0, "far")]
    of_far = [replace(scan(n), mode="far") for n in (1, 2)]
    between = [tares[0], scan(0), far, of_far[0], tares[1], of_far[1]]
    write_recording(path, hello, [*between, hello, scan(3)])
    assert [each.mode for each in load_recording(path).tares] == ["near", "far"]
    first, other, last, again = (each.rest_ratio for each in replayed(path))
    assert other is None
    np.testing.assert_array_equal([first, last], [each.rest_ratio for each in tares])
    assert again is first
    export(path, tmp_path / "far.npz", begin_s=0.004, end_s=0.006)
    np.testing.assert_array_equal(load_readings(tmp_path / "far.npz").rest_ratio, last)
    write_recording(tmp_path / "near.mcap", far, [tares[0], *of_far])
    export(tmp_path / "near.mcap", tmp_path / "none.npz")
    assert load_readings(tmp_path / "none.npz").rest_ratio is None


def test_a_tare_that_says_no_mode_is_of_mode_near(path: Path, hello: Hello) -> None:
    """As recordings had them before tares said theirs."""
    properties = SCHEMAS["tare"]
    mode = properties.pop("mode")
    try:
        write_recording(path, hello, [Tare(np.full((3, 4, 4), 0.25), 1.0)])
    finally:
        properties["mode"] = mode
    assert [each.mode for each in load_recording(path).tares] == ["near"]


def test_a_tare_is_recorded_with_the_mode_of_its_scans(tmp_path: Path) -> None:
    bench = stepped("emulator://3x4?mode=far")
    with Recorder(tmp_path / "far.mcap", bench.info) as recorder:
        record(bench, recorder, islice(bench, 20), tare_s=0.1)
    [tare] = load_recording(tmp_path / "far.mcap").tares
    assert tare.mode == "far"


def test_a_tare_of_whole_scans_in_between_has_their_mode(tmp_path: Path) -> None:
    """Modes near and far have as many readings."""
    bench = stepped("emulator://3x4")
    bench.set_region(Region([1], mode="near", rate_hz=50, whole_every=4, whole_mode="far"))
    with Recorder(tmp_path / "far.mcap", bench.info) as recorder:
        record(bench, recorder, islice(bench, 20), tare_s=0.2)
    found = load_recording(tmp_path / "far.mcap")
    assert found.tares[0].mode == "far"
    whole = [each for each in found.scans if each.is_whole]
    assert whole
    for each in whole:
        assert found.tares[0].is_of(each)
        np.testing.assert_allclose(found.tares[0].rest_ratio, each.ratio, atol=0.01)


def test_typed_lines_become_marks(path: Path, command: Command) -> None:
    far, near = os.openpty()
    process = command("record", URL, str(path), stdin=near)
    os.close(near)
    with os.fdopen(far, "wb", buffering=0) as keyboard:
        until(path.exists)
        keyboard.write(b"left hand\nright")
        time.sleep(0.3)
        keyboard.write(b" hand\n")
        until(lambda: len(load_recording(path).marks) == 2)
        process.send_signal(signal.SIGINT)
        assert finish(process).code == 0
    assert [mark.text for mark in load_recording(path).marks] == ["left hand", "right hand"]


def test_a_recording_goes_on_in_the_background_of_a_shell(path: Path) -> None:
    """Whoever reads the terminal from there is stopped, unless it ignores the signal."""
    spawn = "import os, pty, sys; sys.exit(os.waitstatus_to_exitcode(pty.spawn(sys.argv[1:])))"
    shell = ("bash", "-mc", '"$@" & wait %1', "shell", sys.executable, "-m", "ohmskin")
    done = python("-c", spawn, *shell, "record", URL, path, "--scans", "60", TERM="dumb")
    assert f"{path}: 60 scans, missed 0" in done.out
    assert done.code == 0


def test_true_forces_of_a_board_that_is_reset_stay_in_order(path: Path, run: Run) -> None:
    """After the reset, scans and forces had times from before it."""
    url = "emulator://2x3?speed=0&rate=20&reset=2"
    well(run("record", url, str(path), "--scans", "100", "--force-port", "truth"))
    recorded = load_recording(path)
    assert any(b.time_us < a.time_us for a, b in pairwise(recorded.scans))
    assert all(a.host_time_s < b.host_time_s for a, b in pairwise(recorded.scans))
    assert all(a.host_time_s < b.host_time_s for a, b in pairwise(recorded.forces))


def test_the_commands(tmp_path: Path, command: Command, run: Run) -> None:
    path, out = tmp_path / "a.mcap", tmp_path / "a.npz"
    quiet = "emulator://3x4?scene=rest"
    process = command(
        "record", quiet, str(path), "--scans", "60", "--tare", "0.2", "--mark", "left hand"
    )
    assert well(finish(process)).out.startswith(f"{path}: 60 scans, missed 0, ")
    assert [mark.text for mark in load_recording(path).marks] == ["left hand"]
    assert sum(isinstance(message, Tare) for message in messages(path)) == 1
    assert run("export", str(path), str(out)) == Done(0, f"{out}: 60 scans\n", "")
    done = run("stream", f"replay://{path}?speed=0", "--json", "--method", "none")
    assert (done.code, done.out.count("\n"), done.err) == (0, 60, "")
    path.write_bytes(path.read_bytes()[:100])
    out.unlink()
    assert_one_line(run("export", str(path), str(out)), "cut off")
    assert not out.exists()
