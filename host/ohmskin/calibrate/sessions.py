# SPDX-License-Identifier: Apache-2.0
"""Recordings of one skin that were made one after another, and are learned from together.

A recording cannot be written on, so whoever goes on writes a new one: ``skin.knead-1.mcap``,
``skin.knead-2.mcap`` and so on, beside the calibration ``skin.json``.
"""

from dataclasses import replace
from glob import escape
from pathlib import Path
from typing import Final

import numpy as np

from ohmskin.link.messages import Hello
from ohmskin.record.recording import Recording

# So much time is taken to pass between two recordings [s]. Chosen: longer than any gap across which
# forces or clocks are interpolated.
PAUSE_S: Final = 100.0


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


def joined(recordings: list[Recording]) -> list[Recording]:
    """Those that have scans and a rest, on one clock, with the tares that are good for the scans.

    The rest moves from day to day, so each keeps its own. What the force sensor shows while nothing
    touches the skin, up to the tare, is taken off the forces of each. Forces long before its scans,
    or long after them, would come amid those of another: they are left out. Of several forces of
    one time, the last counts. Raises ValueError if there is no recording, or if they are not of one
    skin in one mode.
    """
    usable = []
    for given in recordings:
        tares = [tare for tare in given.tares if given.scans and tare.is_of(given.scans[-1])]
        if tares:
            usable.append(replace(given, tares=tares))
    if not usable:
        raise ValueError("no recording has a rest, and touches after it")
    check_same(recordings, recordings[-1].hellos[-1])
    whole: list[Recording] = []
    end_s, end_us = 0.0, 0
    for given in usable:
        first_s, last_s = given.scans[0].host_time_s, given.scans[-1].host_time_s
        later_s = end_s + PAUSE_S - first_s
        later_us = end_us + round(1e6 * PAUSE_S) - given.scans[0].time_us
        scans = [
            replace(s, host_time_s=s.host_time_s + later_s, time_us=s.time_us + later_us)
            for s in given.scans
        ]
        at_rest_s = given.tares[0].host_time_s
        zeros_n = [f.force_n for f in given.forces if f.host_time_s <= at_rest_s]
        zero_n = float(np.median(zeros_n or [0.0]))
        forces = [
            replace(f, force_n=f.force_n - zero_n, host_time_s=f.host_time_s + later_s)
            for f in {f.host_time_s: f for f in given.forces}.values()
            if first_s - PAUSE_S / 3 < f.host_time_s < last_s + PAUSE_S / 3
        ]
        whole.append(replace(given, scans=scans, forces=forces))
        end_s, end_us = scans[-1].host_time_s, scans[-1].time_us
    return whole
