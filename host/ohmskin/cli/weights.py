# SPDX-License-Identifier: Apache-2.0
"""Leads a person who puts known weights on a skin, on cell after cell or anywhere."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from ohmskin.arrays import Float
from ohmskin.calibrate.guide import Cells, Guide, Press, State, Step
from ohmskin.calibrate.presses import Calibrator
from ohmskin.calibrate.rules import check_cell
from ohmskin.calibrate.tables import PRESS, PressTable, load_press_table, save_press_table
from ohmskin.cli.board import TERMINAL
from ohmskin.ctrl_c import until_ctrl_c
from ohmskin.link.device import Device, mean_ratio
from ohmskin.link.messages import Hello, Scan
from ohmskin.link.protocol import MODES
from ohmskin.record.force_sensor import NEWTONS
from ohmskin.record.readings import load_arrays, load_readings, save_arrays
from ohmskin.record.recorder import Recorder
from ohmskin.record.recording import ForceSample, Mark, Recording

# The source of forces in a recording that are known weights.
WEIGHTS: Final = "weights"
# The cell of a press that may be anywhere: the skin is taken for one cell.
ANYWHERE: Final = (0, 0)
# Where a weight is awaited for so long [s], it may lie there, too light to be seen. Chosen.
UNSEEN_S: Final = 15.0
# By these columns of the table, the readings of a press are found.
_KEYS: Final = ("row", "column", "conductance")
# Conductances are the same if they differ by less than this share. Chosen: a spreadsheet program
# may keep six digits of a number.
_SAME_SHARE: Final = 1e-5


class KeptPresses:
    """A table of presses, and the readings under each of them, with their files.

    Both files are written anew, and whole, at each change: the readings first. If the program is
    killed in between, the readings have one press more than the table; then the table counts.
    Each of the readings is found by cell and conductance, because people delete rows of a table by
    hand, and mend its forces.

    ratios: mean readings under each press, (n, R, C, 4); None: they are not known of all, as of a
        table that somebody else has made.
    reading_names: which readings they are.
    unit_id: of the board whose presses these are, kept beside the readings; None: it is not known.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._readings_path = path, path.with_suffix(".npz")
        self.table: PressTable = load_press_table(path) if path.exists() else np.empty(0, PRESS)
        self.ratios: Float | None = None
        self.reading_names = MODES["near"]
        self.unit_id: float | None = None
        if self._readings_path.exists() and self.table.size:
            readings = load_readings(self._readings_path)
            ratios, self.reading_names = readings.ratio, readings.reading_names
            of_rows = _rows_of(self.table, load_arrays(self._readings_path, _KEYS), len(ratios))
            self.ratios = None if of_rows is None else ratios[of_rows]
            if units := load_arrays(self._readings_path, ("unit_id",)):
                self.unit_id = units["unit_id"].item()

    def go_on(self, board: Hello) -> None:
        """Go on with presses of this board. Raises ValueError if those of before are another's."""
        now, kept = f"the board is unit {board.unit_id}", None
        names = MODES[board.mode]
        if self.unit_id not in (None, board.unit_id):
            kept = f"unit {self.unit_id:.0f}"
        elif self.ratios is not None:
            skin = f"{board.rows}x{board.columns} cells, readings {' '.join(names)}"
            rows, columns = self.ratios.shape[1:3]
            before = f"{rows}x{columns} cells, readings {' '.join(self.reading_names)}"
            now, kept = f"the board scans {skin}", None if before == skin else before
        if kept:
            remedy = "write another calibration file, or move this table away"
            raise ValueError(f"{self.path}: presses of {kept}, {now}: {remedy}")
        self.unit_id, self.reading_names = board.unit_id, names

    @property
    def presses(self) -> list[Press]:
        """Cell and force of each."""
        return [Press((row, column), force_n) for row, column, force_n, *_ in self.table.tolist()]

    def add(self, step: Step, rest: Float, window: Iterable[Scan]) -> None:
        """Keep one more press, which `step` has read from these scans.

        rest: of the cells, (R, C) [S].
        """
        press = step.wanted
        assert press is not None
        assert step.rise is not None
        # The table has no conductance below 0.
        siemens = max(step.rise + rest[press.cell], 0.0)
        one = np.array([(*press.cell, press.force_n, siemens, step.rise_std)], PRESS)
        ratio = mean_ratio(list(window))
        if not self.table.size:
            self.ratios = ratio[None]
        elif self.ratios is not None:
            self.ratios = np.concatenate([self.ratios, ratio[None]])
        self.table = np.concatenate([self.table, one])
        self._save()

    def keep_those(self, wanted: list[bool]) -> None:
        """Keep these presses alone."""
        self.table = self.table[wanted]
        if self.ratios is not None:
            self.ratios = self.ratios[wanted]
        self._save()

    def _save(self) -> None:
        if not self.table.size:
            self.path.unlink(missing_ok=True)
            self._readings_path.unlink(missing_ok=True)
            return
        if self.ratios is None:
            self._readings_path.unlink(missing_ok=True)  # they are of some presses only
        else:
            keys = {name: self.table[name] for name in _KEYS}
            more = {"ratio": self.ratios, "reading_names": np.array(self.reading_names)}
            if self.unit_id is not None:
                more["unit_id"] = np.array(self.unit_id)
            save_arrays(self._readings_path, more | keys)
        save_press_table(self.path, self.table)


def _rows_of(table: PressTable, keys: dict[str, Float], count: int) -> list[int] | None:
    """Which of so many readings is of each press of a table; None: they are not known of all.

    keys: arrays of `_KEYS`, by which the readings are known. Files of before have none.
    """
    if not keys:
        return [*range(count)] if count == table.size else None
    if [each.shape for each in keys.values()] != [(count,)] * len(_KEYS):
        return None
    found: list[int] = []
    for press in table:
        same = np.ones(count, dtype=bool)
        same[found] = False  # each is of one press alone
        for name, values in keys.items():
            same &= np.isclose(values, press[name], rtol=_SAME_SHARE, atol=0.0)
        if not same.any():
            return None
        found.append(int(same.argmax()))
    return found


class KeptAnywhere:
    """Keeps weights that are put anywhere, in a recording of all scans meanwhile.

    Every weight that was read is a mark: its force.
    """

    def __init__(self, recorder: Recorder) -> None:
        self.recorder = recorder

    def add(self, step: Step, _: Float, window: Iterable[Scan]) -> None:
        """Keep the press of a step which has read it from these scans."""
        assert step.wanted is not None
        force_n = step.wanted.force_n
        # Scans that came in one read have the same time, of which there is one force.
        for time_s in sorted({scan.host_time_s for scan in window}):
            self.recorder.add(ForceSample(force_n, time_s, source=WEIGHTS))
        self.recorder.add(Mark(repr(force_n), self.recorder.now_s()))


Kept = KeptPresses | KeptAnywhere


def put_anywhere(recordings: Iterable[Recording]) -> list[Press]:
    """What `KeptAnywhere` has kept in recordings."""
    return [Press(ANYWHERE, float(mark.text)) for given in recordings for mark in given.marks]


def guided(
    skin: Device, calibrator: Calibrator, kept: Kept, missing: list[Press], total: int
) -> int:
    """Ask for the missing presses. Returns how many still are, after an interruption.

    Lines say what to do next. A terminal also gets a bar, and a bell for each press.
    """
    guide, rest = Guide(missing), calibrator.rest_level
    anywhere = isinstance(kept, KeptAnywhere)
    places = np.random.default_rng(0).uniform(0, np.array(rest.shape) - 1, (total + 1, 2)).tolist()
    done, last_line, since_us = total - len(missing), "", math.inf
    columns = BarColumn(20), MofNCompleteColumn(), TextColumn("{task.description}", markup=False)
    bar = Progress(*columns, console=TERMINAL, transient=True, disable=not TERMINAL.is_terminal)
    task = bar.add_task("", total=total)
    with bar:
        for scan in until_ctrl_c(iter(skin.latest, None)):
            if isinstance(kept, KeptAnywhere):
                kept.recorder.add(scan)
            frame = calibrator.estimator.estimate(scan.ratio)
            rise, touched = frame.level - rest, frame.touched
            if anywhere:
                rise = np.sum(rise, where=touched, keepdims=True)
                touched = np.array([[touched.any()]])
            step = guide.feed(1e-6 * scan.time_us, rise, touched, scan)
            if skin.put is not None:  # a simulated skin: nobody else puts a weight on it
                put = None if step.state is State.TAKE_OFF else step.wanted
                skin.put(put if put is None or not anywhere else (places[done], put.force_n))
            if step.wanted is not None and step.rise is not None:
                kept.add(step, rest, step.scans)
                done += 1
                TERMINAL.bell()
            if step.state is not State.PUT or scan.time_us < since_us:
                since_us = scan.time_us
            line, now = _step_in_words(step, anywhere)
            if step.state is State.PUT and scan.time_us - since_us > 1e6 * UNSEEN_S:
                line = (
                    "no weight is seen yet: if it lies there, it is too light: take a heavier one"
                )
            if line and line != last_line:
                counted = f"{done} of {total}: " if step.rise is not None else ""
                TERMINAL.print(counted + line, highlight=False)
                last_line = line
            bar.update(task, completed=done, description=now)
            if step.state is State.DONE:
                break
    return total - done


def _step_in_words(step: Step, anywhere: bool) -> tuple[str, str]:
    """What the person has to do next, empty where nothing changes, and what goes on meanwhile."""
    press, line, now = step.wanted, "", step.state.value
    if press is None:
        return "", ""
    if step.rise is not None:
        rise = f"{1e6 * step.rise:.2f} +- {1e6 * step.rise_std:.2f} microsiemens above rest"
        line = f"{rise}: take it off"
    elif step.state is State.PUT:
        weight = f"{press.force_n / NEWTONS['g']:.6g} g ({press.force_n:.3f} N)"
        row, column = press.cell
        line = f"put {weight} on cell {press.cell}, row {row}, column {column}"
        if anywhere:
            line = f"put {weight} where none has been yet"
    elif step.state is State.WRONG:
        cells = ", ".join(map(str, step.cells))
        pressed = f"cells {cells} are" if len(step.cells) > 1 else f"cell {cells} is"
        line = f"{pressed} pressed: put the weight on {press.cell} alone"
    elif step.change is not None:
        now = f"not steady yet: changes by {100 * step.change:.0f} % in half a second"
    return line, now


def cells_of(text: str, shape: tuple[int, int]) -> Cells:
    """The cells that a text names, each once, in its order."""
    cells = []
    for part in text.split():
        row, comma, column = part.partition(",")
        if not (comma and row.isdecimal() and column.isdecimal()):
            raise ValueError(f"'{part:.40}' is no cell: write row,column, such as 0,1")
        cells.append(check_cell(int(row), int(column), shape))
    return tuple(dict.fromkeys(cells))
