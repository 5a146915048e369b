# SPDX-License-Identifier: Apache-2.0
"""Where the cells of a skin are in space: a flat grid, a cylinder, or a table of positions.

Symbols

====== ========= =============================================================== ======
symbol shape     meaning                                                         unit
====== ========= =============================================================== ======
p      (R, C, 3) position of a cell's centre in the frame of the skin            m
n      (R, C, 3) unit normal there, out of the skin                              1
F      (R, C)    force normal to the skin; it pushes against n                   N
====== ========= =============================================================== ======

In the calibration file, `Geometry.told` says where the cells are, by kind:

``flat``      x = column * pitch_m[0], y = row * pitch_m[1], n along z
``cylinder``  the same, bent: along a row, cells go round the axis y at radius_m, from
              (0, y, radius_m)
``table``     position_m and normal of every cell
"""

import re
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Final, Self
from xml.etree import ElementTree

import numpy as np

from ohmskin.arrays import Float
from ohmskin.files import PathName, naming, read_bounded
from ohmskin.force.contacts import Contact

# What the file says of each kind. A pitch is two numbers; a table has (R, C, 3) numbers of each.
KINDS: Final = {
    "flat": ("pitch_m",),
    "cylinder": ("pitch_m", "radius_m"),
    "table": ("position_m", "normal"),
}
# No cell is farther from the origin of its frame [m], and no pitch or radius is larger. Chosen:
# robots are smaller.
_FARTHEST_M: Final = 100.0
# No skin is longer along any axis [m]. Chosen: it covers a robot's arm, and one whose places are in
# millimetres is longer.
_LONGEST_M: Final = 3.0
# No cylinder is thinner, and no pitch is less [m]. Chosen: no textile bends round less.
_LEAST_M: Final = 1e-4
# A frame's name has at most so many characters. Chosen: names of links in URDF files are shorter.
_LONGEST_NAME: Final = 100
# A larger file of taxels is not read. Chosen: `MAX_CELLS` taxels with their meshes' names fit.
_MAX_FILE_BYTES: Final = 1_000_000
# A line of such a file. Numbers are separated by white space, so that a line matches in one way
# alone, and no line makes the search slow.
_SIX_NUMBERS: Final = r"\s*[-+.\deE]+" + r"\s+[-+.\deE]+" * 5 + r"\s*"


@dataclass(frozen=True, eq=False)
class Geometry:
    """Where the cells of a rows x columns skin are, with the symbols of the module's table.

    kind: one of `KINDS`.
    frame_id: the name of the frame, as in ROS.
    rows, columns: R and C.
    told: what the file says, by name.

    Raises ValueError, naming the field, for what no skin has.
    """

    kind: str
    frame_id: str
    rows: int
    columns: int
    told: dict[str, Float]
    position_m: Float = field(init=False)
    """p, (R, C, 3) [m]."""
    normal: Float = field(init=False)
    """n, (R, C, 3) [1]."""

    def __post_init__(self) -> None:
        if not (0 < len(self.frame_id) <= _LONGEST_NAME and self.frame_id.isprintable()):
            raise ValueError(f"frame_id must be a name of 1 to {_LONGEST_NAME} characters")
        if self.kind not in KINDS:
            raise ValueError(f"no kind '{self.kind:.40}': there are {', '.join(KINDS)}")
        if self.told.keys() != {*KINDS[self.kind]}:
            fields = " and ".join(KINDS[self.kind])
            raise ValueError(f"kind '{self.kind}' has {fields}, not {', '.join(self.told)[:80]}")
        shapes = {"pitch_m": (2,), "radius_m": ()}
        for name, numbers in self.told.items():
            if np.shape(numbers) != (shape := shapes.get(name, (self.rows, self.columns, 3))):
                raise ValueError(f"{name} has not the shape {shape}")
            if not (np.abs(numbers) <= _FARTHEST_M).all():  # so that NaN fails too
                raise ValueError(f"{name} holds a number beyond {_FARTHEST_M:g}: is it in metres?")
        position_m, normal = self._cells()
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        if not (length > 0).all():
            raise ValueError("normal has the length 0")
        all_m = position_m.reshape(-1, 3)
        if (long_m := np.ptp(all_m, axis=0).max()) > _LONGEST_M:
            raise ValueError(f"cells lie {long_m:g} m apart: are these millimetres, not metres?")
        places, counts = np.unique(all_m, axis=0, return_counts=True)
        if (most := counts.max()) > 1:
            raise ValueError(f"{most} cells are at one place, {places[counts.argmax()].tolist()} m")
        object.__setattr__(self, "position_m", position_m)
        object.__setattr__(self, "normal", normal / length)

    def _cells(self) -> tuple[Float, Float]:
        """p and n; the normals do not have the length 1 yet."""
        if self.kind == "table":
            return self.told["position_m"], self.told["normal"]
        across_m, along_m = self.told["pitch_m"]
        for pitch_m, cells in ((across_m, self.columns), (along_m, self.rows)):
            if cells > 1 and not abs(pitch_m) >= _LEAST_M:
                raise ValueError(f"pitch_m holds {pitch_m:g}: cells are {_LEAST_M:g} or more apart")
        x, y = np.meshgrid(across_m * np.arange(self.columns), along_m * np.arange(self.rows))
        zero = np.zeros_like(x)
        if self.kind == "flat":
            return np.stack([x, y, zero], -1), np.stack([zero, zero, zero + 1], -1)
        radius_m = self.told["radius_m"]
        if not radius_m >= _LEAST_M:
            raise ValueError(f"radius_m is {radius_m:g}, it must be {_LEAST_M:g} or more")
        if np.ptp(x) >= 2 * np.pi * radius_m:
            around = f"{self.columns} columns of {across_m:g} m go round more than once"
            raise ValueError(f"radius_m is {radius_m:g}: {around}: a larger radius, or less pitch")
        normal = np.stack([np.sin(x / radius_m), zero, np.cos(x / radius_m)], -1)
        return radius_m * normal + np.stack([zero, y, zero], -1), normal

    def placed(self, contact: Contact, force_n: Float) -> Contact:
        """The contact with its position, sum F_e p_e / sum F_e, and its normal. force_n: (R, C)."""
        weights = force_n[contact.cells] if contact.force_n > 0 else np.ones(contact.cells.sum())
        position_m = weights @ self.position_m[contact.cells] / weights.sum()
        normal = weights @ self.normal[contact.cells]
        # Normals of a contact that reaches round a thin finger may cancel.
        normal /= np.linalg.norm(normal) or 1.0
        return replace(contact, position_m=position_m, normal=normal)

    def wrench(self, force_n: Float) -> tuple[Float, Float]:
        """Net force -sum F_e n_e [N] and torque -sum p_e x F_e n_e about the frame's origin [N m].

        Both are (..., 3).

        force_n: (..., R, C); cells without a force do not count, and where none has one, both are
            NaN. Raises ValueError for another shape.
        """
        force_n = np.asarray(force_n, np.float64)
        if force_n.shape[-2:] != self.normal.shape[:2]:
            raise ValueError(f"force_n has shape {force_n.shape}, the skin {self.normal.shape[:2]}")
        lacks = np.isnan(force_n)
        known = np.where(lacks & ~lacks.all((-2, -1), keepdims=True), 0.0, force_n)
        on_cells = -known[..., None] * self.normal
        return on_cells.sum((-3, -2)), np.cross(self.position_m, on_cells).sum((-3, -2))

    @classmethod
    def of_file(cls, path: PathName, rows: int, columns: int, frame_id: str) -> Self:
        """The geometry in a file that lists the cells row by row, as other robots' tools write it.

        Lines ``x y z nx ny nz`` [m], one a taxel, as for iCub's skin (other lines are passed over);
        or URDF, whose ``<array>`` or ``<taxel idx= xyz= rpy=>`` are those of the package
        urdf_tactile, in the frame of their sensor: where the robot has it is not read. Raises
        ValueError, naming the file, if it says no rows x columns cells of one sensor.
        """
        with naming(path):
            text = read_bounded(path, _MAX_FILE_BYTES).decode(errors="replace")
            taxels = _of_urdf(text, rows, columns) if "<" in text else _of_lines(text)
            if len(taxels) != rows * columns:
                raise ValueError(f"{len(taxels)} taxels, the skin has {rows}x{columns} cells")
            position_m, normal = np.split(taxels.reshape(rows, columns, 6), 2, axis=-1)
            told = {"position_m": position_m, "normal": normal}
            return cls("table", frame_id, rows, columns, told)


def required(geometry: Geometry | None) -> Geometry:
    """The geometry of a calibration. Raises ValueError, which says what to do, if it has none."""
    if geometry is None:
        raise ValueError("nobody has said where the cells are: ohmskin skin FILE --pitch-mm 10,10")
    return geometry


def _numbers(text: str, count: int, of: str) -> Float:
    """So many numbers. Raises ValueError, which says what the text is of, if it is no such text."""
    with suppress(ValueError):
        found = np.array(text.split(), dtype=np.float64)
        if found.size == count and np.isfinite(found).all():
            return found
    raise ValueError(f"{of}'{text[:40]}' is not {count} numbers")


def _of_lines(text: str) -> Float:
    """Position and normal of each taxel, (n, 6)."""
    lines = [line for line in text.splitlines() if re.fullmatch(_SIX_NUMBERS, line)]
    return np.array([_numbers(line, 6, "") for line in lines]).reshape(-1, 6)


def _of_urdf(text: str, rows: int, columns: int) -> Float:
    """Position and normal of each taxel, (n, 6)."""
    from scipy.spatial.transform import Rotation  # takes long to load, and few files need it

    if "<!" in text.replace("<!--", ""):
        raise ValueError("its XML declares types or entities, which no URDF needs")
    try:
        tree = ElementTree.fromstring(text)
    except ElementTree.ParseError as exc:
        raise ValueError(f"no XML: {exc}") from exc

    def numbers(taxel: ElementTree.Element, name: str, count: int, absent: str = "0 0 0") -> Float:
        return _numbers(taxel.get(name, absent), count, f"{name}=")

    of_skins = [s for s in tree.iter("sensor") if s.findall(".//array") or s.findall(".//taxel")]
    if len(of_skins) > 1:
        raise ValueError(f"{len(of_skins)} sensors with taxels: leave only this skin's in the file")
    if grids := tree.findall(".//array"):
        if tree.findall(".//taxel"):
            raise ValueError("an <array> and <taxel>s: leave only one kind in the file")
        grid, size = grids[0], f"{rows}x{columns}"
        if (of_grid := f"{grid.get('rows', rows)}x{grid.get('cols', columns)}") != size:
            raise ValueError(f"an <array> of {of_grid[:40]} taxels, the skin has {size} cells")
        if len(grids) > 1:
            raise ValueError(f"{len(grids)} <array>s: leave only this skin's in the file")
        if (order := grid.get("order", "row-major")) != "row-major":
            raise ValueError(f"order='{order[:40]}' of its <array>: only row-major is read")
        # urdf_tactile has x along rows: its taxel_info_iterator.cpp.
        spacing_m = numbers(grid, "spacing" if grid.get("spacing") else "size", 2, "")
        at_m = np.argwhere(np.ones((rows, columns))) * spacing_m - numbers(grid, "offset", 2, "0 0")
        return np.array([[*each_m, 0.0, 0.0, 0.0, 1.0] for each_m in at_m])
    by_index: dict[int, list[float]] = {}
    for place, taxel in enumerate(tree.iter("taxel")):  # without idx, in their order
        if not re.fullmatch(r"\s*\d{1,9}\s*", index := taxel.get("idx", f"{place}")):
            raise ValueError(f"idx='{index[:40]}' is no whole number from 0")
        if int(index) in by_index:
            raise ValueError(f"two taxels have idx='{int(index)}'")
        turned = Rotation.from_euler("xyz", numbers(taxel, "rpy", 3))
        by_index[int(index)] = [*numbers(taxel, "xyz", 3), *turned.apply([0.0, 0.0, 1.0])]
    return np.array([taxel for _, taxel in sorted(by_index.items())]).reshape(-1, 6)
