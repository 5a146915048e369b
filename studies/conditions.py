# SPDX-License-Identifier: Apache-2.0
"""Conditions under which methods fail: seven sweeps of simulated skins, bent, noisy or broken.

A condition is a sweep and one of its values x; `Sweep.build` draws a skin under that condition and
frames of it, all readings rounded to 10 bits, those at rest as well. What a sweep does not vary is
as in `trials`: cells of 1 MOhm, wires of 100 and 200 Ohm, nominal wires told, no fault, and in each
frame a random number of touches, to 10 of 64 cells, anew. "since rest" is a fault that the rest
readings show already; all others come after them.

Not simulated: a skin that changes within a frame, and faults of the board beyond stuck readings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.configurations import READING_OFFSET, READING_SENSES_TOP, READINGS_PER_CELL
from ohmskin.circuit.skin import Skin, readings
from ohmskin.emulate.faults import SkinFaults, joined_readings
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.methods import METHODS
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.protocol import ADC_BITS
from studies.trials import NOMINAL_WIRE_OHM, SPREAD, knowledge_of, skin_at_rest, touch

Random = np.random.Generator
Shape = tuple[int, int]

# The largest share of cells that is touched, where touches are not swept. Chosen: 10 cells of 8x8,
# all fingers of two hands.
TOUCHED_SHARE: Final = 10 / 64
# A touched cell, where wires are swept against it [ohm]. Chosen: a firm touch.
PRESSED_OHM: Final = 5e3
# The share of readings that is stuck at random places. Chosen: 10 of the 256 of 8x8 cells.
STUCK_SHARE: Final = 10 / 256
_SINCE_REST: Final = " since rest"


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame, and the truth behind it.

    ratio: readings (R, C, 4).
    cell_siemens: the cells (R, C) [S]; None: this frame is not judged.
    afresh: whether the estimator forgets the frame before it.
    """

    ratio: Float
    cell_siemens: Float | None
    afresh: bool = False


@dataclass(frozen=True, eq=False)
class Case:
    """One skin.

    knowledge: what the estimator is told.
    frames: in the order in which they are read.
    rest_siemens: the untouched cells, (R, C) [S]; None: only verdicts are of interest.
    pieces: how many parts the frames have that count as a skin each.
    """

    knowledge: SkinKnowledge
    frames: tuple[Frame, ...]
    rest_siemens: Float | None = None
    pieces: int = 1


@dataclass(frozen=True)
class Sweep:
    """A row of conditions that differ in one thing, x.

    name, title: in tables, and above its picture.
    axis: what x is.
    values: of x, numbers or labels.
    build: a case from x, the skin's shape, how many frames are judged, a source of randomness.
    logarithmic: whether x has a logarithmic axis.
    methods: which methods meet it.
    """

    name: str
    title: str
    axis: str
    values: tuple[float, ...] | tuple[str, ...]
    build: Callable[[float | str, Shape, int, Random], Case]
    logarithmic: bool = False
    methods: tuple[str, ...] = METHODS

    @property
    def labelled(self) -> bool:
        """Whether the values are labels, not numbers."""
        return isinstance(self.values[0], str)


# ------------------------------------------------------------------------------------ readings


def converted(exact: Float, random: Random | None = None, noise_lsb: float = 0.0) -> Float:
    """10-bit readings, with this much normal noise before the converter."""
    if random is not None and noise_lsb:
        exact = exact + noise_lsb / 2**ADC_BITS * random.standard_normal(exact.shape)
    return ratio_from_codes(quantise(exact, ADC_BITS), ADC_BITS)


def _case(
    frames: Iterable[Frame],
    rest_ratio: Float,
    wire_ohm: tuple[float, float] = NOMINAL_WIRE_OHM,
) -> Case:
    return Case(knowledge_of(rest_ratio, wire_ohm), tuple(frames))


def _touched(rest: Skin, random: Random) -> Skin:
    """1 to a few touches."""
    most = int(np.ceil(TOUCHED_SHARE * rest.cell_siemens.size))
    return touch(rest, int(random.integers(1, most + 1)), random)


def touched_frames(rest: Skin, frames: int, random: Random) -> list[Skin]:
    """So many frames, touched anew in each."""
    return [_touched(rest, random) for _ in range(frames)]


def _judged(skins: Iterable[Skin]) -> list[Frame]:
    return [Frame(converted(readings(skin)), skin.cell_siemens) for skin in skins]


# ---------------------------------------------------------------------- wires, touches, noise


def _wires(x: float | str, shape: Shape, frames: int, random: Random) -> Case:
    """x: a wire segment's resistance over a touched cell's, both but for their spread."""
    wire_ohm = (float(x) * PRESSED_OHM, float(x) * PRESSED_OHM)
    rest = skin_at_rest(*shape, random, wire_ohm=wire_ohm)
    skins = []
    for skin in touched_frames(rest, frames, random):
        pressed = np.exp(SPREAD * random.standard_normal(shape)) / PRESSED_OHM
        cell = np.where(skin.cell_siemens > rest.cell_siemens, pressed, rest.cell_siemens)
        skins.append(replace(skin, cell_siemens=cell))
    return _case(_judged(skins), converted(readings(rest)), wire_ohm)


def _touches(x: float | str, shape: Shape, frames: int, random: Random) -> Case:
    """x: share of the cells that are touched."""
    rest = skin_at_rest(*shape, random)
    touches = round(float(x) * rest.cell_siemens.size)
    skins = [touch(rest, touches, random) for _ in range(frames)]
    return _case(_judged(skins), converted(readings(rest)))


def _noise(x: float | str, shape: Shape, frames: int, random: Random) -> Case:
    """x: standard deviation of normal noise [LSB], at rest as well."""
    rest = skin_at_rest(*shape, random)
    judged = [
        Frame(converted(readings(skin), random, float(x)), skin.cell_siemens)
        for skin in touched_frames(rest, frames, random)
    ]
    return _case(judged, converted(readings(rest), random, float(x)))


def _nominal(x: float | str, shape: Shape, frames: int, random: Random) -> Case:
    """x: the nominal wires that are told, over the true ones."""
    rest = skin_at_rest(*shape, random)
    judged = _judged(touched_frames(rest, frames, random))
    top_ohm, bottom_ohm = NOMINAL_WIRE_OHM
    return _case(judged, converted(readings(rest)), (float(x) * top_ohm, float(x) * bottom_ohm))


# --------------------------------------------------------------------------- the frame before


def _before(x: float | str, shape: Shape, frames: int, random: Random) -> Case:
    """x: what the estimator reads just before each frame that is judged."""
    rest = skin_at_rest(*shape, random)
    every_cell = rest.cell_siemens.size
    in_order: list[Frame] = []
    for skin in touched_frames(rest, frames, random):
        before: Float | None = None
        match x:
            case "the same":
                before = readings(skin)
            case "untouched":
                before = readings(rest)
            case "other touches":
                before = readings(_touched(rest, random))
            case "all touched":
                before = readings(touch(rest, every_cell, random))
            case "all at 10 Ω":
                before = readings(replace(rest, cell_siemens=np.full(shape, 0.1)))
            case "all open":
                before = readings(replace(rest, cell_siemens=np.zeros(shape)))
            case "random codes":
                before = random.uniform(size=(*shape, READINGS_PER_CELL))
            case "none":
                pass
            case _:
                raise ValueError(f"no frame before '{x}'")
        if before is not None:
            in_order.append(Frame(converted(before), None))
        in_order.append(Frame(converted(readings(skin)), skin.cell_siemens, afresh=before is None))
    return _case(in_order, converted(readings(rest)))


# ------------------------------------------------------------------------------------- faults


def _stuck(x: float | str, shape: Shape, frames: int, random: Random) -> Case:
    """x: which readings are stuck, and at what; which ones is drawn anew for each frame, but for
    faults since rest."""
    rest = skin_at_rest(*shape, random)
    fixed = _place(shape, random) if _since_rest(x) else None
    rest_ratio = readings(rest)
    if fixed:
        _stick(rest_ratio, str(x), fixed, random)
    judged = []
    for skin in touched_frames(rest, frames, random):
        ratio = readings(skin)
        _stick(ratio, str(x), fixed or _place(shape, random), random)
        judged.append(Frame(converted(ratio), skin.cell_siemens))
    return _case(judged, converted(rest_ratio))


def _since_rest(x: float | str) -> bool:
    return str(x).endswith(_SINCE_REST)


def _place(shape: Shape, random: Random) -> tuple[int, int]:
    row, column = random.integers(shape)
    return int(row), int(column)


def _stick(ratio: Float, fault: str, place: tuple[int, int], random: Random) -> None:
    reading = int(random.integers(READINGS_PER_CELL))
    match fault.removesuffix(_SINCE_REST):
        case "one at 0":
            ratio[(*place, reading)] = 0.0
        case "one at 1":
            ratio[(*place, reading)] = 1.0
        case "4 % at 0 or 1":
            count = int(np.ceil(STUCK_SHARE * ratio.size))
            places = random.choice(ratio.size, count, replace=False)
            ratio.flat[places] = random.integers(0, 2, count)
        case "cell at 0":
            ratio[place] = 0.0
        case "cell at 1":
            ratio[place] = 1.0
        case "cell as if open":
            ratio[place] = READING_OFFSET
        case "cell as if 0 Ω":
            ratio[place] = 0.5
        case "all A at 0":
            ratio[..., 0] = 0.0
        case "top sense at 1":
            ratio[..., READING_SENSES_TOP] = 1.0
        case "all at 0":
            ratio[...] = 0.0
        case _:
            raise ValueError(f"no fault of readings '{fault}'")


def _lines(x: float | str, shape: Shape, frames: int, random: Random) -> Case:
    """x: which electrodes or stripes are cut or joined; which one is drawn anew for each frame,
    but for faults since rest. A fault does not come and go with frames: each is read afresh."""
    rest = skin_at_rest(*shape, random)
    fixed = _place(shape, random) if _since_rest(x) else None
    rest_ratio = with_line_fault(rest, str(x), fixed) if fixed else readings(rest)
    judged = []
    for skin in touched_frames(rest, frames, random):
        ratio = with_line_fault(skin, str(x), fixed or _place(shape, random))
        judged.append(Frame(converted(ratio), skin.cell_siemens, afresh=fixed is None))
    return _case(judged, converted(rest_ratio))


def with_line_fault(skin: Skin, fault: str, place: tuple[int, int]) -> Float:
    """Readings with a fault in the row, or the column, of `place`, or between it and the next."""
    rows, columns = skin.shape
    row, column = place
    match fault.removesuffix(_SINCE_REST):
        case "row open":
            faults = SkinFaults(open_row=row)
        case "column open":
            faults = SkinFaults(open_column=column)
        case "row cut midway":
            faults = SkinFaults(broken_row=(row, columns // 2))
        case "two rows shorted":
            faults = SkinFaults(short_rows=(row % (rows - 1), row % (rows - 1) + 1))
        case "two columns shorted":
            first = column % (columns - 1)
            faults = SkinFaults(short_columns=(first, first + 1))
        case "row shorted to column":
            # Electrodes are numbered rows first, and these two are joined by 0.1 ohm.
            ends = np.arange(2 * (rows + columns))
            joined = joined_readings(skin, [(row, rows + column)], ends)
            return joined[..., :READINGS_PER_CELL]
        case _:
            raise ValueError(f"no fault of lines '{fault}'")
    faults = replace(faults, ref_top=skin.ref_top_ohm, ref_bottom=skin.ref_bottom_ohm)
    return faults.readings(faults.damaged(skin))


# -------------------------------------------------------------------------------------- sweeps

SWEEPS: Final = {
    sweep.name: sweep
    for sweep in (
        Sweep(
            "wires",
            "wires against touched cells",
            "wire segment / touched cell",
            (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 3.0, 10.0, 40.0),
            _wires,
            logarithmic=True,
        ),
        Sweep(
            "touches",
            "number of touches",
            "share of the cells that is touched",
            tuple(touches / 64 for touches in (0, 1, 2, 4, 8, 12, 16, 24, 32, 48, 64)),
            _touches,
        ),
        Sweep(
            "noise",
            "noise",
            "noise before the 10-bit converter [LSB]",
            (0.0, 0.25, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0),
            _noise,
        ),
        Sweep(
            "nominal",
            "wrong nominal wires",
            "wires told / true wires",
            (0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.4, 1.7, 2.0),
            _nominal,
            logarithmic=True,
        ),
        Sweep(
            "before",
            "stale start",
            "frame before",
            (
                *("none", "the same", "untouched", "other touches", "all touched"),
                *("all at 10 Ω", "all open", "random codes"),
            ),
            _before,
        ),
        Sweep(
            "stuck",
            "stuck readings",
            "readings that are stuck",
            (
                *("one at 0", "one at 1", "4 % at 0 or 1", "cell at 0", "cell at 1"),
                *("cell as if open", "cell as if 0 Ω", "cell at 0 since rest"),
                *("all A at 0", "top sense at 1", "all at 0"),
            ),
            _stuck,
        ),
        Sweep(
            "lines",
            "open and shorted lines",
            "fault",
            (
                *("row open", "column open", "row cut midway", "row open since rest"),
                *("two rows shorted", "two columns shorted", "two rows shorted since rest"),
                "row shorted to column",
            ),
            _lines,
        ),
    )
}
