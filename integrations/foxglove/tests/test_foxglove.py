# SPDX-License-Identifier: Apache-2.0
"""What Foxglove and Rerun are given, read by their own libraries."""

import asyncio
import json
import os
import re
import runpy
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import websockets
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

import ohmskin
from ohmskin import live
from ohmskin.record.recorder import Recorder
from ohmskin_foxglove import COLOUR, CONTACTS, NAMES, POINTS, add_clouds

# Programs are ended as by a keyboard. Where this process was started with SIGINT ignored, as in the
# background of a shell, they would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

HERE = Path(__file__).parents[1]
URL = "emulator://8x8?scene=moving&seed=1&begin=0"


def run(*words: object) -> str:
    done = subprocess.run([sys.executable, *map(str, words)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def skin_json(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("skin") / "skin.json"
    presses = HERE.parents[1] / "examples" / "presses.csv"
    table = ("calibrate", "table", "emulator://8x8", presses, path, "--indenter-mm2", "80")
    told = ("--wires", "100,200", "--leads", "80")
    run("-m", "ohmskin", *table, *told)
    run("-m", "ohmskin", "skin", path, "--pitch-mm", "10,10")
    return path


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recorded") / "a.mcap"
    with (
        ohmskin.open(f"{URL}&speed=0") as skin,
        Recorder(path, skin.info, lambda: skin.now_s) as recorder,
    ):
        for scan in islice(skin, 900):
            recorder.add(scan)
    return path


@pytest.fixture(scope="module")
def both(recorded: Path, skin_json: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("both") / "both.mcap"
    assert add_clouds(recorded, ohmskin.load_calibration(skin_json), out) == 900
    return out


def points(cloud: object) -> np.ndarray:
    """(points, 12), by the message's own fields: 8 floats, and a colour of 4 bytes."""
    kinds = {7: "<f4", 1: "u1"}
    assert [f.name for f in cloud.fields] == [*NAMES, *COLOUR]
    form = np.dtype(
        {
            "names": [f.name for f in cloud.fields],
            "offsets": [f.offset for f in cloud.fields],
            "formats": [kinds[f.type] for f in cloud.fields],
            "itemsize": cloud.point_stride,
        }
    )
    table = np.frombuffer(cloud.data, form)
    return np.stack([table[f.name].astype(float) for f in cloud.fields], axis=-1)


def test_a_recording_with_clouds_plays_as_before(
    recorded: Path, both: Path, skin_json: Path
) -> None:
    of_clouds: dict[str, list] = {POINTS: [], CONTACTS: []}
    with both.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        for schema, channel, message, cloud in reader.iter_decoded_messages([POINTS, CONTACTS]):
            assert schema.name == "foxglove.PointCloud"
            assert message.log_time == cloud.timestamp.ToNanoseconds()
            of_clouds[channel.topic].append(cloud)
    plays = [f"replay://{path}?speed=0" for path in (recorded, both)]
    one, other = (list(ohmskin.open(url, calibration=skin_json)) for url in plays)
    assert len(one) == len(other) == len(of_clouds[POINTS]) == 900
    for before, scan, cells, contacts in zip(one, other, *of_clouds.values(), strict=True):
        assert scan.time_ns == before.time_ns == cells.timestamp.ToNanoseconds()
        np.testing.assert_array_equal(scan.force_n, before.force_n)
        table = points(cells)
        assert table[:, 6] == pytest.approx(scan.force_n.ravel(), abs=1e-3)
        assert table[:, 7] == pytest.approx(scan.force_n_std.ravel(), abs=1e-3, rel=1e-5)
        assert points(contacts)[:, 6] == pytest.approx([c.force_n for c in scan.contacts], abs=1e-3)
    shade = np.hypot(*(table[:, 9:11] - (220, 60)).T)  # from yellow, which is 1 N
    assert (table[table[:, 6] <= 0.1][:, 8:11] == 90).all()
    assert 0.5 < table[np.argmin(shade), 6] < 2
    assert table[table[:, 6] > 5][:, 9].max(initial=0) < 120  # red has little green
    assert (table[:, 11] == 255).all()
    assert table[3 * 8 + 5, :6] == pytest.approx([0.05, 0.03, 0, 0, 0, 1])
    run("-m", "ohmskin", "export", both, both.with_suffix(".csv"))
    times = both.stat().st_size / recorded.stat().st_size
    print(f"figure: size over the recording's: {times:.2f}")
    assert times < 2.5


def test_clouds_are_added_once(both: Path, skin_json: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.mcap"
    run("-m", "ohmskin_foxglove", "add", both, skin_json, again)
    with again.open("rb") as file:
        counts = make_reader(file).get_summary().statistics.channel_message_counts
    assert sorted(counts.values()) == [1, 900, 900, 900]


@pytest.mark.parametrize("zeros", [0, 5000])  # as a system that crashed leaves them
@pytest.mark.parametrize("share", [0.5, 0.503, 0.9])
def test_a_recording_that_was_cut_off_gets_its_clouds(
    recorded: Path, skin_json: Path, tmp_path: Path, share: float, zeros: int
) -> None:
    """It ended in a traceback, and left a file that could not be read."""
    octets, cut = recorded.read_bytes(), tmp_path / "cut.mcap"
    cut.write_bytes(octets[: round(share * len(octets))] + bytes(zeros))
    scans = len(list(ohmskin.open(f"replay://{cut}?speed=0")))
    out = tmp_path / "out.mcap"
    assert run("-m", "ohmskin_foxglove", "add", cut, skin_json, out) == f"{out}: {scans} scans\n"
    with out.open("rb") as file:
        counts = make_reader(file).get_summary().statistics.channel_message_counts
    assert sorted(counts.values()) == [1, scans, scans, scans]
    assert 0 < scans < 900


def test_what_cannot_be_added_is_said_and_leaves_no_file(
    recorded: Path, skin_json: Path, tmp_path: Path
) -> None:
    """The file that was left stood in the way of the next try."""
    odd, damaged, out = (tmp_path / name for name in ("odd.mcap", "damaged.mcap", "out.mcap"))
    odd.write_text("no recording")
    octets = bytearray(recorded.read_bytes())
    octets[len(octets) // 2] ^= 255
    damaged.write_bytes(octets)
    for recording, said in (
        (odd, f"{odd}: no MCAP file"),
        (tmp_path / "none.mcap", "none.mcap: cannot be read"),
        (damaged, f"{damaged}: damaged"),
    ):
        words = ("-m", "ohmskin_foxglove", "add", recording, skin_json, out)
        done = subprocess.run([sys.executable, *map(str, words)], capture_output=True, text=True)
        assert done.returncode == 1
        assert said in done.stderr
        assert done.stderr.count("\n") == 1
        assert not [*tmp_path.glob("out*"), *tmp_path.glob(".*")]
    before = out.write_bytes(b"kept")
    with pytest.raises(FileExistsError, match="is there already: say another file"):
        add_clouds(recorded, ohmskin.load_calibration(skin_json), out)
    assert out.stat().st_size == before


def test_rerun_draws_the_clouds(both: Path, tmp_path: Path) -> None:
    """Its importer makes Points3D of them, by its own program."""
    out = tmp_path / "both.rrd"
    program = Path(sys.executable).with_name("rerun")
    done = subprocess.run([program, "mcap", "convert", both, "-o", out], capture_output=True)
    assert done.returncode == 0, done.stderr
    printed = subprocess.run([program, "rrd", "print", "-v", out], capture_output=True, text=True)
    assert "Points3D:positions" in printed.stdout
    printed = subprocess.run([program, "rrd", "print", "-vvv", out], capture_output=True, text=True)
    colours = {int(each) for each in re.findall(r"\b\d{10}\b", printed.stdout)}
    assert 0x5A5A5AFF in colours  # an untouched cell
    assert len([each for each in colours if each >> 24 > 200 and each % 256 == 255]) > 20
    assert POINTS in printed.stdout


def test_the_rerun_logger_logs(recorded: Path, skin_json: Path, tmp_path: Path) -> None:
    out = tmp_path / "live.rrd"
    said = run(HERE / "rerun_logger.py", f"replay://{recorded}?speed=0", skin_json, out)
    # The last scans were left out where the recording ended before they were asked for.
    last = "900 scans logged; 0 missed on the line; 0 skipped by a busy machine or at the end"
    assert said.splitlines()[-1] == last
    program = Path(sys.executable).with_name("rerun")
    printed = subprocess.run([program, "rrd", "print", "-v", out], capture_output=True, text=True)
    assert "Points3D:positions" in printed.stdout


@pytest.fixture
def served(skin_json: Path, request: pytest.FixtureRequest) -> Iterator[tuple[str, object]]:
    """Serves a board; its port is that which this process gives the next one."""
    port = 20_000 + os.getpid() % 20_000
    url = getattr(request, "param", URL)
    command = [sys.executable, "-m", "ohmskin_foxglove", "live", url, str(skin_json)]
    process = subprocess.Popen(
        [*command, "--ws-port", str(port)], stdout=subprocess.PIPE, text=True
    )
    threading.Timer(120, process.kill).start()
    assert "Foxglove: open" in process.stdout.readline()
    yield f"ws://127.0.0.1:{port}", process
    process.kill()
    process.wait()


Found = list[tuple[str, int, int]]


def gaps_s(found: Found) -> np.ndarray:
    """From each cloud of points to the next."""
    return np.diff([1e-9 * log_ns for topic, log_ns, _ in found if topic == POINTS])


async def received(url: str, enough: Callable[[Found], bool]) -> Found:
    """Topic, log time and time of arrival [ns] of messages, by Foxglove's client protocol."""
    topics, found = {}, []
    async with websockets.connect(url, subprotocols=["foxglove.sdk.v1"], max_size=None) as ws:
        while not enough(found):
            text = await asyncio.wait_for(ws.recv(), 20)
            now_ns = time.time_ns()
            if isinstance(text, bytes) and text[0] == 1:
                number, log_ns = struct.unpack_from("<IQ", text, 1)
                found.append((topics[number], log_ns, now_ns))
            elif isinstance(text, str) and (said := json.loads(text))["op"] == "advertise":
                for channel in said["channels"]:
                    assert channel["schemaName"] == "foxglove.PointCloud"
                    topics[channel["id"]] = channel["topic"]
                    wanted = [{"id": channel["id"], "channelId": channel["id"]}]
                    await ws.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
    return found


def test_a_client_gets_scans_live(served: tuple[str, object]) -> None:
    found = asyncio.run(received(served[0], lambda found: len(found) >= 400))
    times_ns = np.array([log_ns for topic, log_ns, _ in found if topic == POINTS])
    late_ms = [1e-6 * (now - log) for topic, log, now in found[200:] if topic == POINTS]
    # A scan's last byte comes half a period after its middle.
    late_ms = np.median(late_ms) - 1e3 * 0.5 / 90
    print(f"figure: last byte to client, median: {late_ms:.1f} ms")
    # In order, and none twice. (A machine that is too busy for 90 estimates a second skips scans.)
    periods = np.diff(times_ns) / (1e9 / 90)
    assert (periods > 0.9).all()
    settled = periods[len(periods) // 2 :]  # the board's clock is known better by then
    assert settled == pytest.approx(np.round(settled), abs=0.1)


@pytest.mark.parametrize("served", [f"{URL}&vanish=0.3"], indirect=True)
def test_a_board_that_is_plugged_20_times_goes_on(served: tuple[str, object]) -> None:
    """It vanishes 0.3 s after each time it was opened, and is opened again a second later."""
    found = asyncio.run(received(served[0], lambda found: np.sum(gaps_s(found) > 0.5) >= 20))
    assert (gaps_s(found) > 0).all()


def test_the_rerun_logger_goes_on_when_it_is_plugged_20_times(
    skin_json: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In this process, which sees after which plug each scan is logged."""
    logged: set[int] = set()

    class Watched(ohmskin.LiveSkin):
        def since(self, count: int, timeout_s: float = 0.0) -> tuple[int, list]:
            count, scans = super().since(count, timeout_s)
            if scans:
                logged.add(self.opened)
            if len(logged) > 20:
                self.close()
            return count, scans

    monkeypatch.setattr(live, "AGAIN_S", 0.01)
    monkeypatch.setattr(ohmskin, "LiveSkin", Watched)
    out = tmp_path / "plugged.rrd"
    words = ("rerun_logger.py", f"{URL}&vanish=0.1", str(skin_json), str(out))
    monkeypatch.setattr(sys, "argv", list(words))
    runpy.run_path(str(HERE / "rerun_logger.py"))
    assert len(logged) > 20
    assert out.stat().st_size > 0


def said_by(*words: object, seconds: float = 20) -> str:
    """What a program prints until it ends, or Ctrl-C ends it without a traceback."""
    process = subprocess.Popen(
        [sys.executable, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    threading.Timer(seconds, process.send_signal, (signal.SIGINT,)).start()
    said, _ = process.communicate(timeout=60)
    assert "Traceback" not in said
    return said


LIVE = ("-m", "ohmskin_foxglove", "live", "--ws-port", "0")
LOGGER = (HERE / "rerun_logger.py",)


@pytest.mark.parametrize("program", [LIVE, LOGGER])
def test_a_wrong_port_is_said(program: tuple, skin_json: Path, tmp_path: Path) -> None:
    out = () if program == LIVE else (tmp_path / "a.rrd",)
    lines = said_by(*program, "/dev/ttyNone", skin_json, *out, seconds=8).splitlines()
    assert "no port /dev/ttyNone: 'ohmskin ports' lists the ports there are" in lines
    if program == LOGGER:
        assert lines[-1].startswith("0 scans logged; 0 missed on the line; 0 skipped")


@pytest.mark.parametrize("program", [LIVE, LOGGER])
def test_a_calibration_of_another_size_is_refused(
    program: tuple, skin_json: Path, tmp_path: Path
) -> None:
    out = () if program == LIVE else (tmp_path / "a.rrd",)
    said = said_by(*program, "emulator://6x6", skin_json, *out, seconds=50)
    assert "this calibration is of a 8x8 skin, the board scans 6x6" in said.splitlines()[-1]


def test_a_wrong_url_ends_the_server(skin_json: Path) -> None:
    """It was tried again for ever, though no such port can come."""
    process = subprocess.run(
        [sys.executable, *LIVE, "bogus://x", skin_json], capture_output=True, text=True, timeout=20
    )
    assert process.returncode == 1
    assert process.stderr.startswith("ohmskin-foxglove: no kind of port 'bogus://': there are")


def test_a_board_that_went_away_is_said(skin_json: Path) -> None:
    said = said_by(*LIVE, f"{URL}&vanish=1", skin_json, seconds=12)
    assert "is gone: is the board still plugged in?" in said
    assert "gives scans" in said


def test_a_port_that_is_taken_is_said(skin_json: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        said = said_by(*LIVE[:-1], port, URL, skin_json)
    assert f"ohmskin-foxglove: port {port} is not free" in said
    assert "say another --ws-port" in said


@pytest.mark.parametrize("port", [99999, -1])
def test_a_port_that_cannot_be_is_said(port: int, skin_json: Path) -> None:
    """It was a traceback."""
    lines = said_by(*LIVE[:-2], f"--ws-port={port}", URL, skin_json).splitlines()
    assert lines[-1].startswith(f"ohmskin-foxglove: port {port} is not free")
    assert "Traceback" not in lines[0]


def test_what_is_missing_is_said(recorded: Path, skin_json: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare.json"
    content = json.loads(skin_json.read_text())
    del content["geometry"]
    bare.write_text(json.dumps(content))
    said = said_by(*LOGGER, URL, bare, tmp_path / "a.rrd")
    assert said.startswith("rerun_logger: nobody has said where the cells are: ohmskin")
    out = tmp_path / "none" / "a.rrd"
    line = f"rerun_logger: {out}: cannot be written: say a file in a directory there is\n"
    assert said_by(*LOGGER, URL, skin_json, out) == line  # it was a traceback
    words = ("-m", "ohmskin_foxglove", "add", recorded, bare, tmp_path / "out.mcap")
    done = subprocess.run([sys.executable, *map(str, words)], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("ohmskin-foxglove: nobody has said where the cells are: ohmskin")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out.mcap").exists()
