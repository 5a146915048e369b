# SPDX-License-Identifier: Apache-2.0
"""Simulated skins whose truth is known: what methods are measured on. Simulation, all of it.

A trial is one skin and frames of touches, drawn from a seed: cells of about 1 MOhm at rest, touches
of 1 to 100 kOhm (log-uniform) at random places, wires that vary by 10 % around 100 and 200 Ohm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin, readings
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.protocol import ADC_BITS
from ohmskin.record.readings import Readings

REST_OHM: Final = 1e6
TOP_WIRE_OHM: Final = 100.0
BOTTOM_WIRE_OHM: Final = 200.0
SPREAD: Final = 0.1  # of the log of rest resistances and wires
TOUCH_OHM: Final = (1e3, 1e5)
# A cell counts as pressed from here on, as a multiple of its conductance at rest.
PRESSED: Final = 1.5
# The paper's programmes: they take minutes for a frame of 8x8 cells.
PAPER_METHODS: Final = ("lsq", "regularized")
# A fingertip: radius of its pressure, range of its peaks, frames of its way round a circle.
FINGER_CELLS: Final = 0.7
FINGER_SIEMENS: Final = (5e-5, 5e-4)
FINGER_FRAMES: Final = 40
JUMP: Final = 1.5  # of all wires


@dataclass(frozen=True, eq=False)
class Trial:
    """Readings, what is told with them, and the truth behind them.

    readings: exact, of F frames. frames: the skin in each of them. rest: the untouched skin.
    """

    readings: Readings
    frames: tuple[Skin, ...]
    rest: Skin

    @property
    def cell_siemens(self) -> Float:
        """The truth, (F, R, C) [S]."""
        return np.array([skin.cell_siemens for skin in self.frames])

    @property
    def pressed(self) -> NDArray[np.bool_]:
        """Cells that conduct half as much again as at rest, or more, (F, R, C)."""
        return np.asarray(self.cell_siemens > PRESSED * self.rest.cell_siemens)

    def rounded(self, bits: int | None) -> Readings:
        """The readings as a converter of so many bits gives them; None: exact."""
        exact = self.readings
        if bits is None:
            return exact
        rest = exact.rest_ratio
        return replace(
            exact,
            ratio=ratio_from_codes(quantise(exact.ratio, bits), bits),
            rest_ratio=None if rest is None else ratio_from_codes(quantise(rest, bits), bits),
            adc_bits=bits,
        )


def uniform_skin(
    shape: tuple[int, int],
    cell_siemens: float = 1 / REST_OHM,
    wire_ohm: tuple[float, float] = (TOP_WIRE_OHM, BOTTOM_WIRE_OHM),
) -> Skin:
    """A skin whose cells are all alike, and so are the segments of a layer."""
    cell, top, bottom = (np.full(shape, each) for each in (cell_siemens, *wire_ohm))
    return Skin(cell, top, bottom)


def skin_at_rest(
    rows: int,
    columns: int,
    random: np.random.Generator,
    *,
    wire_ohm: tuple[float, float] = (TOP_WIRE_OHM, BOTTOM_WIRE_OHM),
    spread: float = SPREAD,
) -> Skin:
    """An untouched skin; every resistance is log-normal with this spread."""
    middles = (1 / REST_OHM, *wire_ohm)
    cell, top, bottom = (
        middle * np.exp(spread * random.standard_normal((rows, columns))) for middle in middles
    )
    return Skin(cell, top, bottom)


def touch(skin: Skin, touches: int, random: np.random.Generator) -> Skin:
    """`skin` with so many cells, at random places, pressed to 1 to 100 kOhm."""
    cell = skin.cell_siemens.copy()
    low, high = np.log(TOUCH_OHM)
    places = random.choice(cell.size, min(touches, cell.size), replace=False)
    cell.flat[places] = 1 / np.exp(random.uniform(low, high, places.size))
    return replace(skin, cell_siemens=cell)


def stretched(skin: Skin, factor: float) -> Skin:
    """`skin` with all wires of so many times their resistance."""
    return replace(
        skin,
        top_wire_ohm=factor * skin.top_wire_ohm,
        bottom_wire_ohm=factor * skin.bottom_wire_ohm,
    )


def knowledge_of(
    rest_ratio: Float, nominal_wire_ohm: tuple[float, float] = (TOP_WIRE_OHM, BOTTOM_WIRE_OHM)
) -> SkinKnowledge:
    """What estimators of 10-bit readings are told: rest (R, C, 4), nominal wires, no more."""
    rows, columns, _ = rest_ratio.shape
    return SkinKnowledge(
        rows,
        columns,
        adc_bits=ADC_BITS,
        rest_ratio=rest_ratio,
        nominal_wire_ohm=WireOhm(*nominal_wire_ohm),
    )


def trial_of(
    rest: Skin,
    frames: list[Skin],
    nominal_wire_ohm: tuple[float, float] = (TOP_WIRE_OHM, BOTTOM_WIRE_OHM),
) -> Trial:
    """A trial whose estimators are told the rest readings and the nominal wires."""
    told = Readings(
        ratio=np.array([readings(skin) for skin in frames]),
        rest_ratio=readings(rest),
        ref_top_ohm=rest.ref_top_ohm,
        ref_bottom_ohm=rest.ref_bottom_ohm,
        nominal_top_wire_ohm=np.array(nominal_wire_ohm[0]),
        nominal_bottom_wire_ohm=np.array(nominal_wire_ohm[1]),
    )
    return Trial(told, tuple(frames), rest)


def random_trial(rows: int, columns: int, touches: int, frames: int, seed: int) -> Trial:
    """Frames of 0 to `touches` touches, each frame touched anew: the hardest for a warm start."""
    random = np.random.default_rng(seed)
    rest = skin_at_rest(rows, columns, random)
    counts = random.integers(0, touches + 1, frames)
    return trial_of(rest, [touch(rest, int(count), random) for count in counts])


def bent_trial(rows: int, columns: int, touches: int, frames: int, seed: int) -> Trial:
    """As `random_trial`, on a skin bent since its rest readings: wires 35 % above nominal."""
    random = np.random.default_rng(seed)
    rest = skin_at_rest(rows, columns, random)
    now = stretched(rest, 1.35)
    counts = random.integers(0, touches + 1, frames)
    return trial_of(rest, [touch(now, int(count), random) for count in counts])


def jump_trial(rows: int, columns: int, touches: int, frames: int, seed: int) -> Trial:
    """As `random_trial`, but from the middle frame on all wires have 1.5 times their resistance."""
    trial = random_trial(rows, columns, touches, frames, seed)
    before, after = trial.frames[: frames // 2], trial.frames[frames // 2 :]
    return trial_of(trial.rest, [*before, *(stretched(skin, JUMP) for skin in after)])


def finger_trial(
    rows: int,
    columns: int,
    frames: int,
    seed: int,
    *,
    sigma_cells: tuple[float, float] = (FINGER_CELLS, FINGER_CELLS),
    peak_siemens: tuple[float, float] = FINGER_SIEMENS,
    wire_ohm: tuple[float, float] = (TOP_WIRE_OHM, BOTTOM_WIRE_OHM),
) -> Trial:
    """Soft fingertips that move in circles: one on skins of an even seed, else two.

    sigma_cells, peak_siemens: least and most of each fingertip. wire_ohm: a segment of each layer.
    """
    random = np.random.default_rng(seed)
    rest = skin_at_rest(rows, columns, random, wire_ohm=wire_ohm)
    row, column = np.indices((rows, columns))
    cells = np.repeat(rest.cell_siemens[None], frames, axis=0)
    for _ in range(1 + seed % 2):
        peak = np.exp(random.uniform(*np.log(peak_siemens)))
        middle = random.uniform(0.3, 0.7, 2) * (rows - 1, columns - 1)
        radius = random.uniform(0.1, 0.3) * (min(rows, columns) - 1)
        start = random.uniform(0, 2 * np.pi)
        low, high = sigma_cells
        sigma = random.uniform(low, high) if low < high else low
        for number, cell in enumerate(cells):
            angle = start + 2 * np.pi * number / FINGER_FRAMES
            away = (row - middle[0] - radius * np.cos(angle)) ** 2
            away = away + (column - middle[1] - radius * np.sin(angle)) ** 2
            cell += peak * np.exp(-away / (2 * sigma**2))
    return trial_of(rest, [replace(rest, cell_siemens=cell) for cell in cells])
