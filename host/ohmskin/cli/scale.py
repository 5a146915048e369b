# SPDX-License-Identifier: Apache-2.0
"""``ohmskin calibrate scale``: what a load cell's numbers are in newtons, by known weights."""

import math
from collections import deque
from typing import Annotated, Final

import numpy as np
import typer
from typer import Argument, Option

from ohmskin.calibrate.guide import MIN_READING_SCANS, READING_S, steady
from ohmskin.cli.board import TERMINAL
from ohmskin.cli.record import ForceBaud, ForceColumn, ForceUnit, unread
from ohmskin.record.force_sensor import DEFAULT_BAUD, NEWTONS, ForceSensor
from ohmskin.record.recording import ForceSample

# Weights may disagree by this share about what a number means. Chosen: a load cell is a hundred
# times better, and a finger that helps is worse.
_OFF_SHARE: Final = 0.05
# A lighter weight is refused [g]: it is in kilograms, and would make forces a thousandth of what
# they are. Chosen: no skin feels one.
_LEAST_G: Final = 1.0


def grams_of(text: str, least: int = 1) -> list[float]:
    """The weights that ``--grams`` names [g], rising or not. Raises ValueError."""
    try:
        masses_g = [float(part) for part in text.split(",")]
    except ValueError:
        masses_g = []
    if len(masses_g) < least or not all(0 < mass_g < math.inf for mass_g in masses_g):
        raise ValueError(f"--grams {text!r:.60}: give {least} or more above 0, such as 50,100,200")
    if min(masses_g) < _LEAST_G:
        raise ValueError(f"--grams {text!r:.60}: the least is 1 g: write 200 for 0.2 kg")
    if len(set(masses_g)) < len(masses_g):
        raise ValueError(f"--grams {text!r:.60}: a weight stands twice")
    return masses_g


def scale(
    port: Annotated[str, Argument(help="serial port of the load cell or scale")],
    grams: Annotated[str, Option(help="two known weights or more, in gram, such as 200,500")],
    force_baud: ForceBaud = DEFAULT_BAUD,
    force_unit: ForceUnit = "",
    force_column: ForceColumn = "",
) -> None:
    """Find the --force-scale of a load cell, by known weights: what its numbers are in newtons.

    Skin and plate may lie on it. It asks for one weight after the other.
    """
    masses_g = grams_of(grams, least=2)
    with ForceSensor(port, force_baud, 1.0, force_unit, force_column) as sensor:
        sensor.wait()
        empty, moved = _shown(sensor, "take off what is not always on it")
        asked = (_shown(sensor, f"put {g:g} g on it, alone", empty) for g in masses_g)
        shown = np.array([number for number, _ in asked])
        lost = unread(sensor)
    if moved > _OFF_SHARE * np.abs(shown).min():
        raise ValueError(f"without a weight, its numbers moved by {moved:.6g}: weigh again")
    forces_n = NEWTONS["g"] * np.array(masses_g)
    factor = float(forces_n @ shown / max(shown @ shown, 1e-300))
    off = np.abs(factor * shown / forces_n - 1)
    if not off.max() <= _OFF_SHARE:
        each = ", ".join(f"{g:g} g: {x:.6g}" for g, x in zip(masses_g, shown, strict=True))
        raise ValueError(f"the weights disagree by {100 * off.max():.0f} % ({each}): weigh again")
    TERMINAL.print(
        f"--force-scale {factor:.6g} (the weights agree within {100 * off.max():.1f} %){lost}"
    )


def _shown(sensor: ForceSensor, wish: str, empty: float | None = None) -> tuple[float, float]:
    """Mean number above that of the empty scale when the wish is fulfilled, and it is steady.

    empty: the empty scale's number; None: it is empty, and any change counts as steady, because
    only weights show which one is large. Returns also by how much the number moved meanwhile.
    """
    typer.prompt(f"{wish}, then press Enter", default="", show_default=False, prompt_suffix="")
    sensor.take()
    window: deque[ForceSample] = deque()
    while True:
        sensor.wait()
        window += sensor.take()
        long_s = window[-1].host_time_s - window[0].host_time_s
        if len(window) >= MIN_READING_SCANS and long_s >= READING_S:
            numbers = np.array([sample.force_n for sample in window]) - (empty or 0.0)
            if empty is None or steady(numbers)[1]:
                half = numbers.size // 2
                moved = abs(float(numbers[half:].mean() - numbers[:half].mean()))
                return float(numbers.mean()), moved
            window.clear()
