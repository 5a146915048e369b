# SPDX-License-Identifier: Apache-2.0
"""A skin that is always read: what comes, once each, through everything that is unplugged."""

import asyncio
import os
import threading
import time
from contextlib import suppress
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path

import pytest

import ohmskin
from calibrations import of_scene
from ohmskin import live
from ohmskin.errors import DeviceLost, OhmskinError
from ohmskin.force.reader import SkinReader
from ohmskin.link.messages import Scan
from ohmskin.live import LiveSkin
from ohmskin.record.recorder import Recorder
from waiting import until

URL = "emulator://8x8?scene=ghost&seed=1&begin=0"
ENOUGH_S = 20.0  # a test waits so long for what comes at once, unless it never comes

pytestmark = pytest.mark.usefixtures("nothing_left")


def drained(skin: LiveSkin, scans: int) -> list[ohmskin.ForceScan]:
    """So many scans or more, from the first, by asking again and again."""
    count, found = 0, []
    while len(found) < scans:
        count, more = skin.since(count, ENOUGH_S)
        assert more, skin.failure
        found += more
        assert len(found) == count
    return found


def test_every_scan_comes_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "LATE_S", ENOUGH_S)  # however busy the machine is
    with LiveSkin(URL, of_scene("ghost")) as skin:
        found = drained(skin, 40)
        assert skin.newest().number >= found[-1].number
        assert skin.since(10**9)[1] == []
    assert all(b.number - a.number == 1 + b.missed for a, b in pairwise(found))
    assert all(len(scan.contacts) == 3 for scan in found[1:])
    assert skin.newest() is skin.since(0)[1][-1]  # as long as somebody wants it


def test_it_goes_on_when_it_was_unplugged_20_times(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "AGAIN_S", 0.01)
    count = 0
    with LiveSkin(f"{URL}&vanish=0.1", of_scene("ghost")) as skin:
        assert skin.status == f"{skin.port} is being opened"
        assert repr(skin) == f"<LiveSkin {skin.port}: is being opened>"
        for times in range(1, 21):
            while skin.opened <= times:
                count, scans = skin.since(count, ENOUGH_S)
                assert scans, skin.failure
                assert all(scan.contacts for scan in scans)
        for said in ("gives scans", "is gone: is the board still plugged in?"):
            until(lambda said=said: skin.status == f"{skin.port} {said}")


def test_a_tare_outlasts_the_plug(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "AGAIN_S", 0.01)
    with LiveSkin(f"{URL}&vanish=1", of_scene("ghost")) as skin:
        assert drained(skin, 1)[0].contacts
        with pytest.raises(ohmskin.TareRefused):
            skin.tare(0.0)
        skin.tare(0.0, force=True)
        count = skin.since(0)[0]
        while skin.opened < 2:
            count, scans = skin.since(count, ENOUGH_S)
            assert scans
        count, scans = skin.since(count, ENOUGH_S)
        assert not scans[-1].contacts


def test_async_for_gives_every_scan() -> None:
    async def read() -> list[int]:
        with LiveSkin(URL, of_scene("ghost")) as skin:
            numbers = []
            async for scan in skin:
                numbers.append(scan.number)
                if len(numbers) == 10:
                    return numbers

    numbers = asyncio.run(read())
    assert numbers == list(range(numbers[0], numbers[0] + 10))


def test_async_for_over_a_skin_that_is_not_there_can_be_given_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The thread that waited for a scan waited for ever, and so the program never ended."""
    monkeypatch.setattr(live, "SILENCE_TIMEOUT_S", 0.05)

    async def read() -> None:
        async with asyncio.timeout(0.2):
            async for _ in skin:
                pass

    def run() -> None:
        with suppress(TimeoutError):
            asyncio.run(read())

    with LiveSkin("/dev/nothing", None) as skin:
        program = threading.Thread(target=run)
        program.start()
        program.join(ENOUGH_S)
        never_ended = program.is_alive()
    program.join()
    assert not never_ended


def test_a_program_waits_for_what_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "AGAIN_S", 0.01)
    with LiveSkin("/dev/nothing", of_scene("ghost")) as skin:
        assert skin.newest() is None
        assert skin.since(0)[0] == 0
        while skin.failure is None:
            skin.since(0, 0.01)
        assert skin.status == "no port /dev/nothing: 'ohmskin ports' lists the ports there are"
        with pytest.raises(DeviceLost, match="is not there: no port /dev/nothing"):
            skin.tare()
    with pytest.raises(ValueError, match=r"no\.json: cannot be read"):
        LiveSkin(URL, "no.json")
    with LiveSkin(Path("/dev/nothing"), None) as skin:  # as `open` takes it
        assert skin.port == "/dev/nothing"
    with pytest.raises(TypeError, match="not NoneType"):  # it was a traceback of the thread
        LiveSkin(None, None)  # type: ignore[arg-type]


def test_a_machine_that_is_too_slow_passes_scans_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "LATE_S", -1.0)  # so that any scan is late
    with LiveSkin(URL, of_scene("ghost")) as skin:
        while skin.skipped < 3:
            skin.since(0, 0.01)
            assert not isinstance(skin.failure, OhmskinError)
        assert skin.newest() is None
        # It said that the port is being opened.
        assert "gives scans, all of them too late: " in skin.status


def test_a_closed_skin_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """It said that it gives scans."""
    read = SkinReader.read

    def slowly(reader: SkinReader, scan: Scan) -> ohmskin.ForceScan:
        skin.closing.wait(ENOUGH_S if skin.newest() else 0.0)
        return read(reader, scan)

    with LiveSkin(URL, of_scene("ghost")) as skin:
        monkeypatch.setattr(SkinReader, "read", slowly)
        until(lambda: skin.newest() is not None)
        time.sleep(0.1)  # scans wait for the thread, which then finds no failure
    assert skin.ended
    assert skin.status == f"{skin.port} was closed"
    with pytest.raises(DeviceLost, match=r"was closed$"):  # it said "is being opened"
        skin.tare()


def test_what_only_shows_a_skin_gets_the_newest_scan(monkeypatch: pytest.MonkeyPatch) -> None:
    read = SkinReader.read

    def slowly(reader: SkinReader, scan: Scan) -> ohmskin.ForceScan:
        time.sleep(0.1)  # nine scans come meanwhile
        return read(reader, scan)

    monkeypatch.setattr(SkinReader, "read", slowly)
    told = threading.Event()
    with LiveSkin(URL, of_scene("ghost"), every=False) as skin:
        skin.watchers.add(told.set)
        found = drained(skin, 5)
        assert told.wait(ENOUGH_S)
    assert all(b.number - a.number > 2 for a, b in pairwise(found))
    with LiveSkin(URL, of_scene("ghost")) as skin:
        found = drained(skin, 2)
    assert found[1].number - found[0].number == 1


def test_an_error_of_a_watcher_is_logged_and_the_skin_goes_on(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """It ended the skin, which said that this was a defect of its own."""
    told = threading.Event()
    with LiveSkin(os.fsencode(URL), of_scene("ghost")) as skin:
        skin.watchers |= {lambda: {}["no such key"], told.set}
        assert len(drained(skin, 5)) >= 5
        assert told.is_set()
        assert skin.failure is None
    assert caplog.text.count("a watcher failed, and is not called any more") == 1
    assert "no such key" in caplog.text


def test_a_watcher_may_close_the_skin() -> None:
    """Closing told the watcher, which closed, and so on."""
    with LiveSkin(URL, of_scene("ghost")) as skin:
        skin.watchers.add(skin.close)
        until(lambda: skin.ended)
        assert skin.status.endswith("was closed")
        with pytest.raises(DeviceLost, match=r"^\S+ was closed$"):
            skin.there()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_defect_ends_who_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SkinReader, "read", lambda reader, scan: 1 / 0)
    monkeypatch.setattr(SkinReader, "warm_up", lambda reader: None)
    with LiveSkin(URL, of_scene("ghost")) as skin:
        assert list(skin) == []
        assert "defect of this program: ZeroDivisionError" in str(skin.failure)


def test_an_iterator_gives_the_last_scans_of_a_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The thread was at the end while a program was busy with a scan: it dropped all after that."""
    monkeypatch.setattr(live, "LATE_S", ENOUGH_S)
    path = tmp_path / "a.mcap"
    with ohmskin.open(URL) as board, Recorder(path, board.info) as recorder:
        for scan in islice(board, 20):
            recorder.add(scan)
    go_on = threading.Event()
    monkeypatch.setattr(SkinReader, "warm_up", lambda reader: go_on.wait(ENOUGH_S))
    with LiveSkin(f"replay://{path}?speed=0", of_scene("ghost")) as skin:
        scans = iter(skin)
        go_on.set()
        found = [next(scans)]
        while not skin.ended:
            time.sleep(0.01)
        found += scans
    assert len(found) == 20


@pytest.mark.parametrize("first", ["before the end", "after it"])
def test_an_iterator_counts_what_it_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, first: str
) -> None:
    """Scans that the buffer could not hold were gone, and none told; of an ended one, all were."""
    monkeypatch.setattr(live, "QUEUE_SCANS", 16)
    path = tmp_path / "a.mcap"
    with ohmskin.open(URL) as board, Recorder(path, board.info) as recorder:
        for scan in islice(board, 60):
            recorder.add(replace(scan, missed=3 if scan.number == 20 else 0))
    go_on = threading.Event()
    monkeypatch.setattr(SkinReader, "warm_up", lambda reader: go_on.wait(ENOUGH_S))
    with LiveSkin(f"replay://{path}?speed=0", of_scene("ghost")) as skin:
        scans = iter(skin)
        go_on.set()
        found = [next(scans)] if first == "before the end" else []
        until(lambda: skin.ended)
        found += scans
    assert len(found) >= 16
    assert found[-1].number == scan.number
    assert sum(1 + scan.missed for scan in found) == 63


def test_close_ends_an_iterator_while_the_port_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "_CLOSE_S", 0.1)
    hangs = threading.Event()

    def never(*_: object, **__: object) -> None:
        hangs.wait(ENOUGH_S)
        raise DeviceLost("unplugged")

    monkeypatch.setattr(live.opening, "open", never)
    skin, found = LiveSkin("/dev/hangs", None), list[ohmskin.ForceScan]()
    reader = threading.Thread(target=lambda: found.extend(skin))
    reader.start()
    skin.close()
    reader.join(2.0)  # without an end, it would wait for 5 s
    still_waits = reader.is_alive()
    hangs.set()
    reader.join()
    skin.close()
    assert not still_waits
    assert not found


def test_a_recording_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "LATE_S", -1.0)  # scans that wait are never too late
    path = tmp_path / "a.mcap"
    with ohmskin.open(URL) as board, Recorder(path, board.info) as recorder:
        for scan in islice(board, 20):
            recorder.add(scan)
    with LiveSkin(f"replay://{path}?speed=0", of_scene("ghost")) as skin:
        assert len(drained(skin, 20)) == 20
        assert list(skin) == []
