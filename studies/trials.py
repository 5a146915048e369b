# SPDX-License-Identifier: Apache-2.0
"""Skins whose truth is known: what methods are measured on.

A trial is one skin and frames of it. Most are simulated, drawn from a seed: cells of about 1 MOhm
at rest, touches of 1 to 100 kOhm (log-uniform) at random places, wires that vary by 10 % around 100
and 200 Ohm. `reference_trial` gives the skins of tests/data, which ngspice has solved. No skin has
leads, and estimators are told so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin, all_readings, end_admittance, readings
from ohmskin.emulate.scenes import BOTTOM_WIRE_OHM, REST_OHM, TOP_WIRE_OHM
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.protocol import ADC_BITS, ENUMS, MODES
from ohmskin.record.readings import Readings, load_readings

DATA: Final = Path(__file__).parents[1] / "tests" / "data"
NOMINAL_WIRE_OHM: Final = (TOP_WIRE_OHM, BOTTOM_WIRE_OHM)
# Standard deviation of the log of cells at rest and of wire segments. Chosen: as the emulator's
# scenes have it.
SPREAD: Final = 0.1
# The hardest touch and the lightest one [ohm]. Chosen: the two decades from one below a cell at
# rest.
TOUCH_OHM: Final = (1e3, 1e5)
# A cell counts as pressed if it conducts so many times as much as at rest. Chosen: cells at rest
# vary by less, and the lightest touch conducts ten times as much.
PRESSED: Final = 1.5
# The paper's programmes: they take minutes for a frame of 8x8 cells.
PAPER_METHODS: Final = ("lsq", "regularized")
# Standard deviation of the noise before the converter [LSB], where readings have any. It is that of
# emulator:// boards.
NOISE_LSB: Final = 0.3
# Wires of a bent skin over those of the flat one. Chosen: a bit more than the 30 % by which `joint`
# expects a layer of wires to be off.
BEND: Final = 1.35
# Wires after a sudden change over those before. Chosen: harder than a bend.
JUMP: Final = 1.5
FINGER_CELLS: Final = 0.7  # standard deviation of a fingertip's pressure. Chosen: some 15 cells.
FINGER_SIEMENS: Final = (5e-5, 5e-4)  # least and largest peak of a fingertip. Chosen.
PALM_SHARE: Final = 0.6  # of the cells. Chosen.
FIRM_SIEMENS: Final = 2.5e-4  # conductance in the middle of a firm palm. Chosen.
FINGER_FRAMES: Final = 40  # a fingertip's way round its circle. Chosen: it moves in each frame.
# What else than fingers presses a skin: an edge across it, in any direction; a ring, as of a cup;
# something flat on half of it, as a book, or on all of it.
OBJECTS: Final = ("edge", "ring", "half", "whole")
OBJECT_FRAMES: Final = 6  # for which an object is on the skin. Chosen.
OBJECT_SIEMENS: Final = (3e-5, 3e-4)  # least and largest peak under an object. Chosen.


@dataclass(frozen=True, eq=False)
class Trial:
    """One skin: its readings, what is told with them, and the truth behind them.

    readings: exact, of F frames, with the rest readings and the nominal wires that are told.
    frames: the skin in each frame.
    rest: the untouched skin.
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

    def rounded(self, bits: int | None, *, mode: str = "near", wires_told: bool = True) -> Readings:
        """The readings as a board with a converter of so many bits gives them; None: exact.

        mode: the board's, "near" or "far". Without `wires_told`, nobody knows the nominal wires.
        """
        exact = self._exact(mode)
        if not wires_told:
            exact = without_wires(exact)
        return exact if bits is None else rounded(exact, bits)

    def _exact(self, mode: str) -> Readings:
        given, names = self.readings, MODES[mode]
        if given.reading_names == names:
            return given
        if set(names) <= set(given.reading_names):
            of_all, ratio, rest_ratio = given.reading_names, given.ratio, given.rest_ratio
            assert rest_ratio is not None
        else:
            of_all = tuple(ENUMS["reading"].values)
            rest_ratio, *frames = (
                all_readings(skin, end_admittance(skin)) for skin in (self.rest, *self.frames)
            )
            ratio = np.array(frames)
        chosen = [of_all.index(name) for name in names]
        return replace(
            given,
            ratio=ratio[..., chosen],
            rest_ratio=rest_ratio[..., chosen],
            reading_names=names,
        )


def rounded(exact: Readings, bits: int = ADC_BITS) -> Readings:
    """Exact readings as a converter of so many bits gives them, those at rest as well."""
    rest = exact.rest_ratio
    return replace(
        exact,
        ratio=ratio_from_codes(quantise(exact.ratio, bits), bits),
        rest_ratio=None if rest is None else ratio_from_codes(quantise(rest, bits), bits),
        adc_bits=bits,
    )


def without_wires(given: Readings) -> Readings:
    """These readings, where nobody knows the nominal wires; that there are no leads is told."""
    return replace(given, nominal_top_wire_ohm=None, nominal_bottom_wire_ohm=None)


def without_leads(given: Readings) -> Readings:
    """These readings, where nobody knows that there are no leads: as of a board that tells none."""
    return replace(given, nominal_lead_ohm=None)


def skin_at_rest(
    rows: int,
    columns: int,
    random: np.random.Generator,
    *,
    wire_ohm: tuple[float, float] = NOMINAL_WIRE_OHM,
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
    rest_ratio: Float, nominal_wire_ohm: tuple[float, float] = NOMINAL_WIRE_OHM
) -> SkinKnowledge:
    """What estimators of 10-bit readings are told: rest (R, C, 4), nominal wires, no leads."""
    rows, columns, _ = rest_ratio.shape
    return SkinKnowledge(
        rows,
        columns,
        adc_bits=ADC_BITS,
        rest_ratio=rest_ratio,
        nominal_wire_ohm=WireOhm(*nominal_wire_ohm, lead=0.0),
    )


def trial_of(
    rest: Skin,
    frames: list[Skin],
    nominal_wire_ohm: tuple[float, float] = NOMINAL_WIRE_OHM,
) -> Trial:
    """A trial whose estimators are told the rest readings, the nominal wires, and no leads."""
    told = Readings(
        ratio=np.array([readings(skin) for skin in frames]),
        rest_ratio=readings(rest),
        ref_top_ohm=rest.ref_top_ohm,
        ref_bottom_ohm=rest.ref_bottom_ohm,
        nominal_top_wire_ohm=np.array(nominal_wire_ohm[0]),
        nominal_bottom_wire_ohm=np.array(nominal_wire_ohm[1]),
        nominal_lead_ohm=np.array(0.0),
    )
    return Trial(told, tuple(frames), rest)


def reference_trial(name: str, frames: slice | NDArray[np.intp] = slice(None)) -> Trial:
    """The skin of a file of tests/data, solved by ngspice; `tests/data/README.md` describes them.

    frames: which of them; all, unless others are chosen. In the paper's sweeps wires change from
    frame to frame, so all of their frames are to be taken; `rest` has the wires of the first.
    """
    path = DATA / f"{name}.npz"
    given = load_readings(path)
    given = replace(given, ratio=given.ratio[frames], nominal_lead_ohm=np.array(0.0))
    with np.load(path, allow_pickle=False) as file:
        cell_ohm, rest_siemens = file["cell_ohm"], 1 / file["rest_ohm"]
        cell_siemens, top, bottom = (
            np.broadcast_to(array, cell_ohm.shape)[frames]
            for array in (1 / cell_ohm, file["top_wire_ohm"], file["bottom_wire_ohm"])
        )
    references = given.ref_top_ohm, given.ref_bottom_ohm
    skins = (Skin(*layers, *references) for layers in zip(cell_siemens, top, bottom, strict=True))
    return Trial(given, tuple(skins), Skin(rest_siemens, top[0], bottom[0], *references))


def random_trial(
    rows: int,
    columns: int,
    touches: int,
    frames: int,
    seed: int,
    *,
    wire_ohm: tuple[float, float] = NOMINAL_WIRE_OHM,
) -> Trial:
    """Frames of 0 to `touches` touches, each frame touched anew: the hardest for a warm start.

    wire_ohm: the middle of the segments of each layer; these nominal wires are told.
    """
    random = np.random.default_rng(seed)
    rest = skin_at_rest(rows, columns, random, wire_ohm=wire_ohm)
    counts = random.integers(0, touches + 1, frames)
    return trial_of(rest, [touch(rest, int(count), random) for count in counts], wire_ohm)


def bent_trial(rows: int, columns: int, touches: int, frames: int, seed: int) -> Trial:
    """As `random_trial`, on a skin bent since its rest readings: wires 35 % above nominal."""
    trial = random_trial(rows, columns, touches, frames, seed)
    return trial_of(trial.rest, [stretched(skin, BEND) for skin in trial.frames])


def jump_trial(rows: int, columns: int, touches: int, frames: int, seed: int) -> Trial:
    """As `random_trial`, but from the middle frame on all wires have 1.5 times their resistance."""
    trial = random_trial(rows, columns, touches, frames, seed)
    before, after = trial.frames[: frames // 2], trial.frames[frames // 2 :]
    return trial_of(trial.rest, [*before, *(stretched(skin, JUMP) for skin in after)])


def palm(rest: Skin, frames: int, random: np.random.Generator, peak_siemens: float) -> list[Skin]:
    """A palm over 60 % of the cells that comes and goes; peaks of cells vary by 30 %."""
    rows, columns = rest.shape
    i, j = np.indices(rest.shape)
    middle = [random.uniform(0.35, 0.65) * (lines - 1) for lines in (rows, columns)]
    away = ((i - middle[0]) / rows) ** 2 + ((j - middle[1]) / columns) ** 2
    most = np.quantile(away, PALM_SHARE)
    peak = peak_siemens * np.clip(3 * (most - away) / most, 0, 1)
    peak = peak * np.exp(0.3 * random.standard_normal(rest.shape))
    pressures = np.sin(np.pi * np.linspace(0.05, 0.95, frames))
    return [replace(rest, cell_siemens=rest.cell_siemens + at * peak) for at in pressures]


def palm_trial(rows: int, columns: int, frames: int, seed: int) -> Trial:
    """A firm palm that comes and goes."""
    random = np.random.default_rng(seed)
    rest = skin_at_rest(rows, columns, random)
    return trial_of(rest, palm(rest, frames, random, FIRM_SIEMENS))


def object_trial(rows: int, columns: int, frames: int, seed: int, what: str) -> Trial:
    """One of `OBJECTS`. It comes and goes, at another place each time; cells vary by 20 %."""
    random = np.random.default_rng(seed)
    rest, size = skin_at_rest(rows, columns, random), min(rows, columns)
    row, column = (np.indices(rest.shape).T - np.subtract(rest.shape, 1) / 2).T  # from the middle
    skins = []
    for number in range(frames):
        if number % OBJECT_FRAMES == 0:
            angle, sigma = random.uniform(0, np.pi), random.uniform(0.5, 0.9)
            across = row * np.cos(angle) + column * np.sin(angle) - random.uniform(-0.3, 0.3) * size
            away = {
                "edge": across,
                "ring": np.hypot(row, column) - random.uniform(0.25, 0.4) * size,
                "half": np.maximum(across, 0.0),
                "whole": np.zeros(rest.shape),
            }[what]
            peak = np.exp(random.uniform(*np.log(OBJECT_SIEMENS)))
            texture = 0.2 * random.standard_normal(rest.shape)
            rise = peak * np.exp(texture - away**2 / (2 * sigma**2))
        pressure = np.sin(np.pi * (number % OBJECT_FRAMES + 1) / (OBJECT_FRAMES + 1))
        skins.append(replace(rest, cell_siemens=rest.cell_siemens + pressure * rise))
    return trial_of(rest, skins)


def finger_trial(
    rows: int,
    columns: int,
    frames: int,
    seed: int,
    *,
    sigma_cells: tuple[float, float] = (FINGER_CELLS, FINGER_CELLS),
    peak_siemens: tuple[float, float] = FINGER_SIEMENS,
    wire_ohm: tuple[float, float] = NOMINAL_WIRE_OHM,
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
