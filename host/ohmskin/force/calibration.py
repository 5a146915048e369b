# SPDX-License-Identifier: Apache-2.0
"""The calibration file (JSON): one skin's rest and force curves, kept from session to session.

======================== ================= ======================================================
field                    shape             meaning
======================== ================= ======================================================
format, schema                             "ohmskin calibration", 1
unit_id                                    the board's, 0 to 2^32 - 1
date                                       ISO 8601
method                                     the estimator whose conductances were learned from, or
                                           "voltage"
rows, columns                              R, C
mode                                       which readings its scans hold, "near" if absent
nominal_top_wire_ohm                       one wire segment of each layer [ohm]; null: not known
nominal_bottom_wire_ohm
nominal_lead_ohm                           from a multiplexer's common pin to the first crossing of
                                           a line [ohm]; null: not known
top_wire_log_std                           standard deviations of the logarithms of both segments;
bottom_wire_log_std                        null: not measured
lead_std_ohm                               standard deviation of the lead [ohm]; null: not measured
curve_top_wire_ohm                         the wires that the curves are of [ohm], if others were
curve_bottom_wire_ohm                      learned since the presses; absent or null: those above
curve_lead_ohm
own_lead_ohm             R + C             what the leads of rows, then of columns, have above that
                                           [ohm]; absent or null: nothing that is known
indenter_area_m2                           what the skin was pressed with [m^2]; null: anything, by
                                           the total force on the skin, so there is no pressure
rest.date                                  ISO 8601
rest.ratio               R, C, 4           readings of the untouched skin before the presses [1];
                                           null: not read, as in mode half
rest.level               R, C              conductance at rest [S]; `voltage`: `voltage_level` [1]
tare                                       the same of a later date, used in place of rest; null:
                                           there is none
largest_force_n                            of the presses, of all cells together [N]; absent or
                                           null: not known
geometry                                   where the cells are: kind, frame_id, and what `geometry`
                                           says of this kind; absent or null: not known
kind                     R, C              "linear" or "power"
slope, slope_std, ...    R, C              the other arrays of `ForceModel`; null where it has NaN
======================== ================= ======================================================

Forces are `Calibration.forces` of `Calibration.level` above `untouched.level`. Numbers are read
back bit for bit.

A file may come from somebody else. So its size is checked before it is read, its fields and their
types and shapes before anything is made of them, and their ranges when the objects are made.
"""

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields
from datetime import datetime
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Bool, Float
from ohmskin.circuit.configurations import READINGS_PER_CELL, is_near
from ohmskin.estimate.base import Estimate, in_series
from ohmskin.estimate.knowledge import (
    NO_WIRES,
    WIRE_FIELDS,
    SkinKnowledge,
    WireOhm,
    check_own_leads,
    check_ratio,
)
from ohmskin.estimate.methods import LEVEL_METHODS, make_estimator
from ohmskin.files import PathName, naming, read_bounded, whole_file
from ohmskin.force.curve import ForceModel, require
from ohmskin.force.geometry import KINDS, Geometry
from ohmskin.link.messages import Hello
from ohmskin.link.protocol import FRAMES, MODES
from ohmskin.record.readings import check_size

FORMAT: Final = "ohmskin calibration"
# Version of the file's layout, which is described above; a file of another one is refused. Chosen:
# the first layout counts as 1.
SCHEMA: Final = 1
# A larger file is not read. Chosen: `MAX_CELLS` cells with all fields take less than 1 MB.
MAX_FILE_BYTES: Final = 4_000_000
# No number of a file is larger. Chosen: it is far beyond any force, time or conductance in any
# unit, and beyond the slope of any power law in siemens; yet sums of its square do not overflow.
MAX_NUMBER: Final = 1e60
# A touch is taken to be within these deviations of what the curve gives.
_OPEN_STDS: Final = np.linspace(-4.0, 4.0, 41)
# Forces beyond those of the presses are less probable by this power. Chosen: of 2 to 6, it errs
# least on simulated skins, and by little more where later touches are half as hard again.
_BEYOND_POWER: Final = 4
# There are so many unit ids: the link has an integer of a fixed size for them.
UNIT_IDS: Final = FRAMES["hello"].span("unit_id")
# The fields of the file, by where a `Calibration` keeps their values: in itself, with their types;
# in its two rests; and in its model. (Those of its `WireOhm` are `WIRE_FIELDS`.)
_OWN: Final = {"unit_id": int, "date": str, "method": str, "mode": str}
# Numbers that may be null, but not 0 or less.
_ABOVE_0: Final = ("indenter_area_m2", "largest_force_n")
_RESTS: Final = ("rest", "tare")
_MODEL_FIELDS: Final = tuple(field.name for field in fields(ForceModel))
# Those that may have null in place of numbers.
_NULLABLE: Final = ("residual_std", "residual_share", "held_out_rmse", "rest.ratio", "tare.ratio")


@dataclass(frozen=True, eq=False)
class Rest:
    """The untouched skin, as a method reads it. Raises ValueError, naming the field, if it is bad.

    date: when it was read, ISO 8601.
    ratio: its readings, (R, C, 4) [1].
    level: what the method makes of them, (R, C) [S; 1 for `voltage`].
    """

    date: str
    ratio: Float
    level: Float

    def __post_init__(self) -> None:
        _check_date(self.date)
        if self.level.ndim != 2 or 0 in self.level.shape:
            raise ValueError(f"level at rest has shape {self.level.shape}, not (rows, columns)")
        good = np.isfinite(self.level) & (self.level >= 0)
        require("level at rest", good, "not finite and >= 0")
        rows, columns = self.level.shape
        ratio = check_ratio(self.ratio, rows, columns, "ratio at rest")
        is_read = np.asarray(np.isfinite(ratio).any(axis=-1))
        require("ratio at rest", is_read, "without any reading")

    @classmethod
    def of(cls, method: str, knowledge: SkinKnowledge, date: str) -> Self:
        """What `method` makes of the rest readings in `knowledge`."""
        # By noise, a cell that conducts nothing may come out below 0, where no level can be.
        level = np.maximum(make_estimator(method, knowledge).rest_level(), 0.0)
        return cls(date, np.asarray(knowledge.rest_ratio), level)


@dataclass(frozen=True, eq=False)
class Calibration:
    """What a calibration file holds, checked. The module's table has shapes and units.

    Raises ValueError, naming the field, for a value that cannot be.

    unit_id: of the board whose skin it is.
    date: when the skin was calibrated, ISO 8601.
    method: the one that gave the levels, one of `LEVEL_METHODS`.
    rest: the untouched skin before the presses.
    model: the curve of every cell.
    indenter_area_m2: the area of what the skin was pressed with [m^2]; None: it was pressed with
        anything, because the total force was measured.
    nominal_wire_ohm: the wire segments of each layer, and the leads.
    tare: the untouched skin of a later date, which is used in place of `rest`; None: there is none.
    mode: which readings the scans hold, a name of the enum `mode`.
    geometry: where the cells are; None: nobody has said so.
    largest_force_n: the largest force that the skin was pressed with [N]; None: not known.
    own_lead_ohm: what single leads have above the nominal one (`SkinKnowledge`); None: not known.
    """

    unit_id: int
    date: str
    method: str
    rest: Rest
    model: ForceModel
    indenter_area_m2: float | None
    nominal_wire_ohm: WireOhm = NO_WIRES
    tare: Rest | None = None
    mode: str = "near"
    geometry: Geometry | None = None
    largest_force_n: float | None = None
    own_lead_ohm: Float | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.unit_id < UNIT_IDS:
            raise ValueError(f"unit_id is {self.unit_id}, not in 0..{UNIT_IDS - 1}")
        _check_date(self.date)
        _require_one_of("method", self.method, LEVEL_METHODS)
        _require_one_of("mode", self.mode, MODES)
        shape = self.model.kind.shape
        for name, rest in (("rest", self.rest), ("tare", self.tare)):
            if rest is not None and rest.level.shape != shape:
                raise ValueError(f"{name} has shape {rest.level.shape}, the model {shape}")
        check_size(self.rows, self.columns)
        placed = self.geometry
        if placed is not None and (placed.rows, placed.columns) != shape:
            raise ValueError(f"geometry is of {placed.rows}x{placed.columns} cells, not {shape}")
        for name in _ABOVE_0:
            number = getattr(self, name)
            if number is not None and not (np.isfinite(number) and number > 0):
                raise ValueError(f"{name} is {number}, it must be above 0")
        self.nominal_wire_ohm.check()
        if self.own_lead_ohm is not None:
            check_own_leads(self.own_lead_ohm, *shape)

    @property
    def rows(self) -> int:
        """R."""
        return int(self.rest.level.shape[0])

    @property
    def columns(self) -> int:
        """C."""
        return int(self.rest.level.shape[1])

    @property
    def untouched(self) -> Rest:
        """The rest that holds now: the tare, if there is one."""
        return self.rest if self.tare is None else self.tare

    def check(self, board: Hello, *, force: bool = False) -> None:
        """Raise ValueError unless this calibration is of this board's skin.

        force: the skin of another unit will do.
        """
        if (board.rows, board.columns) != (self.rows, self.columns):
            sizes = f"{self.rows}x{self.columns} skin, the board scans {board.rows}x{board.columns}"
            told = f"'ohmskin configure PORT --rows {self.rows} --columns {self.columns} --save'"
            remedy = f"calibrate this skin, or {told} if it is that one"
            raise ValueError(f"this calibration is of a {sizes}: {remedy}")
        if board.mode != self.mode and not is_near((*MODES[board.mode], *MODES[self.mode])):
            told = f"'ohmskin configure PORT --mode {self.mode} --save'"
            remedy = f"take a calibration in mode {board.mode}, or scan by {told}"
            raise ValueError(f"this calibration is of mode {self.mode}, not {board.mode}: {remedy}")
        if board.unit_id != self.unit_id and not force:
            units = f"unit {self.unit_id}, the board is unit {board.unit_id}"
            told = f"'ohmskin configure PORT --unit-id {self.unit_id} --save'"
            remedy = f"calibrate this skin, or {told} if it is that one, with a new board"
            raise ValueError(f"this calibration is of {units}: {remedy}")

    def level(self, estimates: Sequence[Estimate]) -> tuple[Float, Float]:
        """What the forces of n frames of one method are read from, and its deviation, (n, R, C).

        It is `Estimate.level`, with one exception. The curve of a cell has wires in it that its
        presses do not show: the hidden ones. The curve of all presses has those of the pressed
        cells, on average. So for a cell of which presses tell next to nothing (`pooled`), the mean
        of the others takes the place of its own hidden wires; if there are no others, that of all.
        """
        level = np.array([estimate.level for estimate in estimates])
        level_std = np.array([estimate.level_std for estimate in estimates])
        pooled = self.model.pooled
        if not estimates[0].wires or not pooled.any():
            return level, level_std
        cell_ohm = np.array([estimate.cell_ohm for estimate in estimates])
        # By `compress`, whose rows are contiguous: a mean of one frame is bit for bit that of many.
        others = (pooled == pooled.all()).ravel()
        hidden_ohm = np.compress(others, (1.0 / level - cell_ohm).reshape(len(level), -1), axis=1)
        of_all = in_series(cell_ohm, hidden_ohm.mean(axis=1)[:, None, None])
        std = np.where(pooled, (of_all / level) ** 2, 1.0) * level_std
        return np.where(pooled, of_all, level), std

    def forces(self, rise: Float, rise_std: Float, touched: Bool) -> tuple[Float, Float]:
        """Force and its standard deviation [N], (..., R, C), of what cells show, in any scans.

        rise, rise_std: above rest, (..., R, C) [S; 1 for `voltage`]; touched: which cells are.

        They are `model.predict`, F with deviation s. But if s of a touched cell is large, readings
        may allow any hard touch. Then a force q is as probable as others up to the largest force L
        of the presses, and above L by (L / q)^4: twice as hard as ever pressed is a sixteenth as
        probable. Errors upwards reach F + 4 s in four deviations (`Estimate`), and downwards not
        as far, as if those of log F were normal, with deviation w:

            p(log q) ~ exp(-log(q / F)^2 / (2 w^2)) min(1, (L / q)^4) ,   w = log(1 + 4 s / F) / 4 .

        The force is the mean of q where that is below F, and its deviation that of q about it.

        Raises ValueError as `predict` does.
        """
        force_n, std_n = self.model.predict(rise, rise_std)
        largest_n = self.largest_force_n
        if largest_n is None:
            return force_n, std_n
        is_open = touched & (force_n > 0) & (force_n + _OPEN_STDS[-1] * std_n > largest_n)
        if is_open.any():
            force_n[is_open], std_n[is_open] = _likely(force_n[is_open], std_n[is_open], largest_n)
        return force_n, std_n

    def save(self, path: PathName) -> None:
        """Write the file whole or not at all. Raises ValueError if it cannot be written."""
        content: dict[str, Any] = {"format": FORMAT, "schema": SCHEMA}
        for name in (*_OWN, *_ABOVE_0, "rows", "columns"):
            content[name] = getattr(self, name)
        content |= dict(zip(WIRE_FIELDS, self.nominal_wire_ohm, strict=True))
        if self.own_lead_ohm is not None:
            content["own_lead_ohm"] = self.own_lead_ohm
        for name in _RESTS:
            rest = getattr(self, name)
            content[name] = None if rest is None else vars(rest) | {"ratio": _null(rest.ratio)}
        if self.geometry is not None:
            of_kind = {"kind": self.geometry.kind, "frame_id": self.geometry.frame_id}
            content["geometry"] = of_kind | self.geometry.told
        for name in _MODEL_FIELDS:
            array = getattr(self.model, name)
            content[name] = _null(array) if name in _NULLABLE else array
        text = json.dumps(content, allow_nan=False, default=np.ndarray.tolist)
        with whole_file(path) as file:
            file.write(text.encode())


def _likely(force_n: Float, std_n: Float, largest_n: float) -> tuple[Float, Float]:
    """`Calibration.forces` of n touched cells, each (n,), by sums over q."""
    log_std = np.log1p(_OPEN_STDS[-1] * std_n / force_n) / _OPEN_STDS[-1]
    q = force_n[:, None] * np.exp(log_std[:, None] * _OPEN_STDS)
    prior = (largest_n / np.maximum(q, largest_n)) ** _BEYOND_POWER
    share = prior * np.exp(-0.5 * _OPEN_STDS**2)
    share /= share.sum(axis=1, keepdims=True)
    likely_n = np.minimum((share * q).sum(axis=1), force_n)
    return likely_n, np.sqrt((share * (q - likely_n[:, None]) ** 2).sum(axis=1))


def _null(array: Float) -> NDArray[Any]:
    """The array with None in place of NaN."""
    nulled = array.astype(object)
    nulled[np.isnan(array)] = None
    return nulled


def _check_date(date: str) -> None:
    try:
        datetime.fromisoformat(date)
    except ValueError:
        raise ValueError(f"date is {date[:40]!r}, not ISO 8601") from None


def _require_one_of(name: str, value: str, names: Collection[str]) -> None:
    if value not in names:
        raise ValueError(f"{name} is {value[:40]!r}, not one of {', '.join(names)}")


CalibrationLike = Calibration | PathName


def loaded(calibration: CalibrationLike) -> Calibration:
    """The calibration itself, or that of the file. Raises ValueError as `load_calibration`."""
    return calibration if isinstance(calibration, Calibration) else load_calibration(calibration)


def load_calibration(path: PathName) -> Calibration:
    """Read and check a calibration file.

    Raises ValueError, one line that names the file and the field, for whatever is wrong with it.
    """
    with naming(path):
        octets = read_bounded(path, MAX_FILE_BYTES)
        try:
            content = json.loads(octets, object_pairs_hook=_once)
        except UnicodeDecodeError:
            raise ValueError("no calibration file: it is no text") from None
        except (ValueError, RecursionError) as error:
            raise ValueError(f"no calibration file: {error}") from error
        return _from_content(content)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """The fields of a JSON object as a dict. Raises ValueError for a field that stands twice."""
    content: dict[str, Any] = {}
    for name, value in pairs:
        if name in content:
            raise ValueError(f"field '{name[:40]}' stands twice")
        content[name] = value
    return content


def _from_content(content: Any) -> Calibration:
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(f"no calibration: field 'format' is not {FORMAT!r}")
    if type(content.get("schema")) is not int or content["schema"] != SCHEMA:
        raise ValueError(f"field 'schema' is not {SCHEMA}: written by another version of ohmskin")
    # Older files have no mode, no leads, no largest force, and one deviation for both layers.
    of_both = content.pop("wire_log_std", None)
    absent = dict.fromkeys(WIRE_FIELDS[2:]) | dict.fromkeys(WIRE_FIELDS[3:5], of_both)
    absent |= {"mode": "near", "geometry": None, "largest_force_n": None, "own_lead_ohm": None}
    content = absent | content
    numbers = (*_ABOVE_0, *WIRE_FIELDS)  # each may be null
    names = {"format", "schema", "rows", "columns", "geometry", "own_lead_ohm"}
    names |= {*_OWN, *numbers, *_RESTS, *_MODEL_FIELDS}
    _require_fields(content, names)
    shape = tuple(_value(name, content[name], int) for name in ("rows", "columns"))
    own = content["own_lead_ohm"]
    model = ForceModel(**{name: _array(name, content[name], shape) for name in _MODEL_FIELDS})
    area_m2, largest_n, *wires = (
        None if content[name] is None else _value(name, content[name], float) for name in numbers
    )
    return Calibration(
        **{name: _value(name, content[name], wanted) for name, wanted in _OWN.items()},
        rest=_rest("rest", content["rest"], shape),
        tare=None if content["tare"] is None else _rest("tare", content["tare"], shape),
        model=model,
        indenter_area_m2=area_m2,
        largest_force_n=largest_n,
        own_lead_ohm=None if own is None else _array("own_lead_ohm", own, (sum(shape),)),
        nominal_wire_ohm=WireOhm(*wires),
        geometry=None if content["geometry"] is None else _geometry(content["geometry"], *shape),
    )


def _require_fields(content: dict[str, Any], names: set[str], place: str = "") -> None:
    """Raise ValueError unless these are the fields. place: what the error puts before a name."""
    for name in sorted(names - content.keys()):
        raise ValueError(f"no field '{place}{name}'")
    for name in sorted(content.keys() - names):
        raise ValueError(f"unknown field '{place}{name[:40]}'")


def _rest(name: str, content: Any, shape: tuple[int, ...]) -> Rest:
    _require_fields(_value(name, content, dict), {"date", "ratio", "level"}, f"{name}.")
    date = _value(f"{name}.date", content["date"], str)
    ratio = _array(f"{name}.ratio", content["ratio"], (*shape, READINGS_PER_CELL))
    level = _array(f"{name}.level", content["level"], shape)
    with naming(name):
        return Rest(date, ratio, level)


def _geometry(content: Any, rows: int, columns: int) -> Geometry:
    said = _value("geometry", content, dict)
    kind = _value("geometry.kind", said.get("kind"), str)
    _require_one_of("geometry.kind", kind, KINDS)
    _require_fields(said, {"kind", "frame_id", *KINDS[kind]}, "geometry.")
    shapes = {"pitch_m": (2,), "radius_m": ()}
    told = {n: _array(n, said[n], shapes.get(n, (rows, columns, 3))) for n in KINDS[kind]}
    with naming("geometry"):
        return Geometry(kind, _value("frame_id", said["frame_id"], str), rows, columns, told)


def _array(name: str, nested: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """A field's lists in lists as an array of this shape: of bool, of text, or of numbers."""
    cells = np.array(nested, dtype=object)
    if cells.shape != shape:
        raise ValueError(f"{name} has not the shape {shape}")
    wanted = {"pooled": bool, "kind": str}.get(name, float)
    may_be_null = name in _NULLABLE
    values = [
        np.nan if cell is None and may_be_null else _value(name, cell, wanted)
        for cell in cells.flat
    ]
    # Texts are cut to 16 characters: numpy takes as much memory for each cell as for the longest.
    return np.array(values, dtype="U16" if wanted is str else wanted).reshape(shape)


def _value(name: str, value: Any, wanted: type) -> Any:
    """The value, if JSON has it as this type; as float, any number within `MAX_NUMBER`."""
    kind = type(value)
    if kind is not wanted and (kind, wanted) != (int, float):
        raise ValueError(f"{name} holds {kind.__name__}, not {wanted.__name__}")
    if wanted is not float:
        return value
    if not abs(value) <= MAX_NUMBER:  # so that NaN fails too
        raise ValueError(f"{name} holds a number that is not finite, or beyond {MAX_NUMBER:g}")
    return float(value)
