# SPDX-License-Identifier: Apache-2.0
"""``ohmskin calibrate knead``: press a skin anywhere, over a scale, until all cells are known."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from itertools import takewhile
from pathlib import Path
from typing import Final

import numpy as np
from rich.console import Group
from rich.live import Live
from rich.text import Text

import ohmskin
from ohmskin.calibrate.coverage import KNOWN_LOG, LEAST_N, LiveCoverage
from ohmskin.calibrate.rules import check_complete
from ohmskin.calibrate.sessions import check_same, session_paths
from ohmskin.cli.board import TERMINAL, asked_for
from ohmskin.cli.record import FORCE_TARE_S, sensor_at, unread, with_truth
from ohmskin.cli.stream import cell_table
from ohmskin.cli.view import browse, page_server
from ohmskin.ctrl_c import until_ctrl_c
from ohmskin.errors import DeviceLost, TareRefused
from ohmskin.link.device import Device
from ohmskin.link.messages import Scan
from ohmskin.record import recorder as recording
from ohmskin.record.force_sensor import ForceSensor
from ohmskin.record.recorder import Recorder
from ohmskin.record.recording import Recording, load_recording
from ohmskin.view.kneaded import KneadedBoard

# Where no terminal shows the map, a line says how much is known, once in this time [s]. Chosen:
# some lines a minute.
_SAY_EVERY_S: Final = 10.0
_TOUCH_NOTHING: Final = "touch nothing yet"


class KneadMap:
    """How well each cell is known, in the terminal, while it is recorded.

    page: shows it in a browser, too.
    has_rest: whether the rest was measured to its end, and the scale stood still meanwhile.
    """

    def __init__(
        self, recorder: Recorder, coverage: LiveCoverage, page: KneadedBoard | None = None
    ) -> None:
        self._recorder, self._coverage, self._page = recorder, coverage, page
        self._said_s = self._began_s = recorder.now_s()
        self.has_rest = False

    def look(self, scan: Scan) -> None:
        """Look at a scan that was recorded. Without a terminal, say now and then what is known.

        :raises TareRefused: the force moved during the tare.
        """
        self._coverage.look(scan, self._recorder.tare, self._recorder.force)
        moved_n = self._coverage.moved_n
        if self._recorder.tare is not None and moved_n > LEAST_N:
            remedy = "touch nothing for the first seconds, and say it again"
            raise TareRefused(f"the force moved by {moved_n:.1f} N at rest", remedy)
        self.has_rest = self._recorder.tare is not None
        if self._page is not None:
            known = self._coverage.log_std, self._coverage.known, self._coverage.next_cell
            self._page.show(scan, *known, self.words() if self.has_rest else _TOUCH_NOTHING)
        if not TERMINAL.is_terminal and scan.host_time_s - self._said_s >= _SAY_EVERY_S:
            self._said_s = scan.host_time_s
            TERMINAL.print(f"{scan.host_time_s - self._began_s:.0f} s: {self.words()}")

    def words(self) -> str:
        """A line: how many cells are known, and where to press next."""
        if self._coverage.is_upside_down:
            return "the force falls where the skin is pressed: turn the sign of --force-scale"
        known = self._coverage.known
        row, column = self._coverage.next_cell
        text = f"{known.sum()} of {known.size} cells are known to {100 * KNOWN_LOG:.0f} %"
        if left := self._coverage.numbers_left:
            text += f", the wires need {left} more numbers of the scale"
        if silent := np.argwhere(self._coverage.silent).tolist():
            cells = " ".join(f"{row},{column}" for row, column in silent)
            text += f", these never answered: {cells} ('ohmskin doctor' looks for the cause)"
        return text if self._coverage.is_done else f"{text}, press at row {row}, column {column}"

    def picture(self) -> Group:
        """All of it."""
        force, tare = self._recorder.force, self._recorder.tare
        shown = "" if force is None else f"   force {force.force_n:.2f} N"
        doing = _TOUCH_NOTHING if tare is None else self.words()
        percent, known = 100 * self._coverage.log_std, self._coverage.known
        cells = [[Text(f"{each:.0f}") for each in row] for row in percent.tolist()]
        for at in np.ndindex(known.shape):
            cells[at[0]][at[1]].stylize("green" if known[at] else "red")
        row, column = self._coverage.next_cell
        cells[row][column].stylize("reverse")
        return Group(Text(doing + shown), cell_table(cells, "how well each cell is known [%]"))


def kneaded(
    port: str, out: Path, scale: tuple[str, int, float, str, str], seconds: float, *, view: bool
) -> tuple[list[Recording], bool]:
    """What was kneaded before, and now, until all cells are known or Ctrl-C comes.

    scale: as `sensor_at` takes it. view: show the map on a page, too. Returns all recordings, and
    whether all cells that answer are known.
    """
    before, path = session_paths(out, "knead")
    recordings = [load_recording(each) for each in before]
    with ohmskin.open(port, start=False) as skin:
        skin.only_unit = skin.info.unit_id
        check_complete(skin.info)
        check_same(recordings, skin.info)
        coverage = LiveCoverage(skin.info)
        for given in recordings:
            coverage.look_at(given)
        if coverage.is_done and not _is_newer(out, before):  # the fit has failed
            coverage.ask_more()
        if not coverage.is_done:
            try:
                with _page(port, skin) if view else nullcontext() as page:
                    sensor = sensor_at(skin, *scale)
                    goes_on = _knead(skin, path, sensor, coverage, seconds, page)
            except TareRefused:
                path.unlink()
                raise
            except DeviceLost as exc:
                if not path.exists():
                    raise
                raise DeviceLost(f"{exc} (the same command goes on from {path})") from exc
            recordings += [load_recording(path)] if goes_on else []
    return recordings, coverage.is_done


@contextmanager
def _page(port: str, skin: Device) -> Iterator[KneadedBoard]:
    """A page in the browser that shows the map."""
    server = page_server()
    from ohmskin.view.boards import ViewedBoards

    boards, page = ViewedBoards(), KneadedBoard(port, skin.info)
    boards[0] = page

    def started(url: str) -> None:
        TERMINAL.print(url)
        browse(url)

    with server.served(boards, "127.0.0.1", None, started):
        yield page
        page.end("it has ended: see the terminal")


def _is_newer(out: Path, recordings: list[Path]) -> bool:
    """Whether a calibration is there that was written after these recordings."""
    written_ns = [path.stat().st_mtime_ns for path in recordings]
    return out.exists() and out.stat().st_mtime_ns >= max(written_ns, default=0)


def _knead(
    skin: Device,
    path: Path,
    sensor: ForceSensor | None,
    coverage: LiveCoverage,
    seconds: float,
    page: KneadedBoard | None,
) -> bool:
    """Record while somebody kneads. Returns whether it went on after the rest was measured."""
    coverage.begin()
    with ExitStack() as stack:
        if sensor is not None:
            stack.enter_context(sensor).wait()
        recorder = stack.enter_context(Recorder(path, skin.info, lambda: skin.now_s))
        TERMINAL.print(
            f"touch nothing for {FORCE_TARE_S:g} s, then press everywhere, softly and hard, with a "
            "finger or several; Ctrl-C ends it, and the same command goes on"
        )
        shown = KneadMap(recorder, coverage, page)
        if TERMINAL.is_terminal:
            live = Live(get_renderable=shown.picture, console=TERMINAL, transient=True)
            stack.enter_context(live)
        scans = asked_for(until_ctrl_c(skin), 0, seconds)
        if sensor is None:
            scans = with_truth(scans, skin, recorder)
        unknown = takewhile(lambda _: not coverage.is_done, scans)
        recording.record(
            skin, recorder, unknown, tare_s=FORCE_TARE_S, sensor=sensor, beside=shown.look
        )
    read = f"{recorder.scans} scans, {recorder.forces} forces{unread(sensor)}"
    if not shown.has_rest:
        path.unlink()
        TERMINAL.print(f"{read}: it ended while the rest was measured, and nothing is kept")
        return False
    TERMINAL.print(f"{path}: {read}: {shown.words()}")
    return True
