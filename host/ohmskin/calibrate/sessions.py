# SPDX-License-Identifier: Apache-2.0
"""Recordings of one skin that were made one after another, and are learned from together.

A recording cannot be written on, so whoever goes on writes a new one: ``skin.knead-1.mcap``,
``skin.knead-2.mcap`` and so on, beside the calibration ``skin.json``.
"""

from dataclasses import dataclass, field, fields, replace
from glob import escape
from pathlib import Path
from typing import Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.configurations import node_ratio
from ohmskin.link.messages import Hello, Scan
from ohmskin.record.recording import ForceSample, Recording, Tare

# So much time is taken to pass between two recordings [s]. Chosen: longer than any gap across which
# forces or clocks are interpolated.
PAUSE_S: Final = 100.0
# No port has less of the supply's voltage [V/Vdd]. Chosen: a step of the converter.
_LEAST_V: Final = 1e-3


def beside(out: Path, ending: str) -> Path:
    """A file beside a calibration: its whole name, less ``.json``, with this ending."""
    return out.with_name(out.name.removesuffix(".json") + ending)


def session_paths(out: Path, what: str) -> tuple[list[Path], Path]:
    """The recordings beside a calibration that are there, in order; and the name of the next.

    Numbers may be missing, because people remove recordings that are bad.
    """
    begin = beside(out, f".{what}-").name
    there = {
        int(number): path
        for path in out.parent.glob(f"{escape(begin)}*.mcap")
        if (number := path.stem.removeprefix(begin)).isdecimal()
    }
    following = max(there, default=0) + 1
    return [there[number] for number in sorted(there)], beside(out, f".{what}-{following}.mcap")


def check_same(recordings: list[Recording], board: Hello) -> None:
    """Raise ValueError if one of them is not of this board's skin, or not in its mode."""
    now = _kind(board)
    for given in recordings:
        if (before := _kind(given.hellos[-1])) != now:
            raise ValueError(
                f"recorded before: {before}; now: {now}: move the recordings of before away, or "
                "use the board as it was"
            )


def _kind(board: Hello) -> str:
    return f"{board.rows}x{board.columns} cells of unit {board.unit_id} in mode {board.mode}"


def joined(recordings: list[Recording]) -> Recording:
    """One recording of all, on one clock. The rest is that of the newest one with a tare.

    The rest moves from day to day, so the readings of the others are moved from their own rest to
    this one. What the force sensor shows while nothing touches the skin, up to the tare, is taken
    off the forces of each. Of several forces of one time, the last counts. Raises ValueError if
    they are not of one skin in one mode.
    """
    check_same(recordings, recordings[-1].hellos[-1])
    last = next(
        (each for each in reversed(recordings) if each.scans and each.tares), recordings[-1]
    )
    board = last.hellos[-1]
    whole = Recording([board], [], last.tares[:1], [], [], last.cut_off)
    end_s, end_us = 0.0, 0
    for given in recordings:
        if not (given.scans and given.tares):
            continue
        later_s = end_s + PAUSE_S - given.scans[0].host_time_s
        later_us = end_us + round(1e6 * PAUSE_S) - given.scans[0].time_us
        moved = [
            s if given is last else _moved(s, given.tares[0], last.tares[0]) for s in given.scans
        ]
        whole.scans += [
            replace(s, host_time_s=s.host_time_s + later_s, time_us=s.time_us + later_us)
            for s in moved
        ]
        zero_n = _zero_n(given.forces, given.tares[0].host_time_s)
        whole.forces += [
            replace(f, force_n=f.force_n - zero_n, host_time_s=f.host_time_s + later_s)
            for f in {f.host_time_s: f for f in given.forces}.values()
        ]
        end_s, end_us = whole.scans[-1].host_time_s, whole.scans[-1].time_us
    return whole


@dataclass(frozen=True, eq=False, repr=False)
class _Moved(Scan):
    """A scan whose readings are as they would be if the skin had another rest.

    The rise of the ports' conductances above rest stays. With v the voltage of a port over Vdd, its
    conductance is (1/v - 1) / (R_top + R_bottom), and all readings of the port change with v.
    Beside a touch, this is not exact: there, a port reads more of the cells at rest than its own.

    own, other: readings (R, C, 4) of the rest that the skin had, and of the other one.
    """

    own: Float = field(kw_only=True)
    other: Float = field(kw_only=True)

    @property
    def ratio(self) -> Float:
        """The moved readings (R, C, 4)."""
        ratio = super().ratio
        v, v_own, v_other = map(self._port_v, (ratio, self.own, self.other))
        v_moved = 1 / np.maximum(1 / v + 1 / v_other - 1 / v_own, 1.0)
        share = (v * v_moved / (v_own * v_other))[..., None]
        return np.asarray((ratio + share * (self.other - self.own)).clip(0.0, 1.0))

    def _port_v(self, ratio: Float) -> Float:
        row, column = (node_ratio(ratio, self.reading_names, node) for node in "ab")
        return np.maximum(row - column, _LEAST_V)


def _moved(scan: Scan, own: Tare, other: Tare) -> Scan:
    """The scan, moved from its own rest to another one, if both tares are good for it."""
    if not (scan.is_complete and own.mode == other.mode == scan.mode):
        return scan
    values = {each.name: getattr(scan, each.name) for each in fields(scan)}
    return _Moved(**values, own=own.rest_ratio, other=other.rest_ratio)


def _zero_n(forces: list[ForceSample], until_s: float) -> float:
    """What the sensor shows until then [N]; 0 where it shows nothing."""
    shown = [sample.force_n for sample in forces if sample.host_time_s <= until_s]
    return float(np.median(shown)) if shown else 0.0
