# SPDX-License-Identifier: Apache-2.0
"""The readings file (.npz): frames of readings in, one estimate per frame out.

In (F frames of R x C cells, 4 readings a cell unless named; other arrays are ignored):

======================= ============================ =========================================
array                   shape                        meaning
======================= ============================ =========================================
ratio                   F, R, C, n                   sense voltage / Vdd; NaN where not read
rest_ratio              R, C, n or F, R, C, n        the same untouched (optional)
ref_top_ohm             scalar                       reference resistors, 30 kOhm if absent
ref_bottom_ohm          scalar
nominal_top_wire_ohm    scalar or F                  one wire segment, per layer (optional)
nominal_bottom_wire_ohm scalar or F
nominal_lead_ohm        scalar or F                  from multiplexer to first crossing; 0: nothing
ref_log_std             scalar                       error that both have in common; absent: 0
adc_bits                scalar                       absent: the readings are exact
reading_names           n, text                      names out of a to h; absent: a b c d
======================= ============================ =========================================

Out: attributes of `Estimate` by the same names, NaN where the method does not estimate them.

============================================= ======= ============================================
arrays                                        shape   meaning
============================================= ======= ============================================
cell_ohm, cell_siemens, cell_siemens_std      F, R, C each cell
touched                                       F, R, C whether something presses it
top_wire_ohm, top_wire_ohm_std                F, R, C each segment of the rows' wires
bottom_wire_ohm, bottom_wire_ohm_std          F, R, C each segment of the columns' wires
converged                                     F       whether the method came to an end
message                                       F, text why it did not, or what is wrong with readings
wires                                         F, text how they are known: as in `Estimate`
chi2                                          F       misfit per reading
iterations, seconds                           F       how long it took
============================================= ======= ============================================
"""

import zipfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from io import FileIO
from math import prod
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.configurations import DEFAULT_REF_OHM, NEAR
from ohmskin.estimate.knowledge import WIRE_FIELDS, SkinKnowledge, WireOhm, check_ratio
from ohmskin.estimate.methods import kind_of, make_estimator
from ohmskin.files import PathName, naming, require_file, whole_file
from ohmskin.link.protocol import ENUMS

# The arrays that are read from a file have at most so many bytes together, and so have the readings
# that are written to one. Chosen: any machine has several times as much memory, and it is 36
# minutes of an 8x8 skin at 90 Hz.
MAX_ARRAY_BYTES: Final = 200_000_000
# A number of a file counts as at least so many bytes. Chosen: if shorter numbers counted for less,
# the estimates of a file could take more than ten times as many bytes as its readings.
_LEAST_ITEM_BYTES: Final = 4
# A file has at most so many frames. Chosen: 37 minutes at 90 Hz. What every frame costs besides its
# readings then takes seconds and 100 MB.
MAX_FRAMES: Final = 200_000
# Cells of the largest skin: 32x32. Chosen: four times those of the largest board. The estimators'
# matrices grow with the square of it, and their time with the cube.
MAX_CELLS: Final = 1024
# Rows of the largest skin, and columns. Chosen: four times those of the largest board. The circuit
# of 1x1024 cells has more ports and nodes than others: its matrices take twice those of 32x32.
MAX_LINES: Final = 64
# The archive is read in pieces of at most so many bytes, and its directory must be one piece.
# Chosen: a directory of ten thousand arrays has a tenth of this.
_PIECE_BYTES: Final = 4_000_000
# A name of a reading may have so many bytes. One letter has four; more are read so that an error
# can show a wrong name. Chosen: twenty letters.
_MOST_NAME_BYTES: Final = 80
_NAMES: Final = tuple(ENUMS["reading"].values)
# Arrays that may be given for each frame, and how many dimensions they have if given once for all.
_WIRES: Final = WIRE_FIELDS[:3]
_ONCE_NDIM: Final = {"rest_ratio": 3} | dict.fromkeys(_WIRES, 0)
_SCALARS: Final = {"ref_top_ohm", "ref_bottom_ohm", "ref_log_std", "adc_bits", "unit_id"}
_RATIOS: Final = ("ratio", "rest_ratio")
# The arrays that go out, in this order.
_OF_CELLS: Final = ("cell_ohm", "cell_siemens", "cell_siemens_std", "touched")
_OF_WIRES: Final = ("top_wire_ohm", "bottom_wire_ohm", "top_wire_ohm_std", "bottom_wire_ohm_std")
_OF_FRAMES: Final = ("converged", "message", "wires", "chi2", "iterations", "seconds")
_TEXTS: Final = ("message", "wires")


@dataclass(frozen=True, eq=False)
class Readings:
    """The contents of a readings file, checked. Meanings, shapes and units: the module's table."""

    ratio: Float
    rest_ratio: Float | None = None
    ref_top_ohm: float = DEFAULT_REF_OHM
    ref_bottom_ohm: float = DEFAULT_REF_OHM
    ref_log_std: float = 0.0
    nominal_top_wire_ohm: Float | None = None
    nominal_bottom_wire_ohm: Float | None = None
    nominal_lead_ohm: Float | None = None
    adc_bits: int | None = None
    reading_names: tuple[str, ...] = NEAR

    def __post_init__(self) -> None:
        names, count = self.reading_names, len(self.reading_names)
        if not count or len({*names} & {*_NAMES}) != count:
            raise ValueError(f"reading_names are {' '.join(names):.80}, not some of {_NAMES}")
        if self.ratio.ndim != 4 or self.ratio.shape[-1] != count:
            raise ValueError(f"ratio has shape {self.ratio.shape}, not (F, rows, columns, {count})")
        frames, rows, columns, _ = self.ratio.shape
        if not 1 <= frames <= MAX_FRAMES:
            raise ValueError(f"ratio has {frames} frames, not 1 to {MAX_FRAMES}: cut it into parts")
        check_size(rows, columns)
        if {*names} == {*NEAR} and names != NEAR:
            self._put_in_order()
            names = NEAR
        if not _in_range(self.ratio):  # all frames at once, which is quick and takes no memory
            for frame, ratio in enumerate(self.ratio):
                if not _in_range(ratio):
                    check_ratio(ratio, rows, columns, name=f"ratio, frame {frame},", of=names)
        rest = self.rest_ratio
        if rest is not None and rest.ndim == 4 and len(rest) != frames:
            raise ValueError(f"rest_ratio has {len(rest)} frames, ratio {frames}")
        for name in _WIRES:
            wire_ohm = getattr(self, name)
            if wire_ohm is not None and wire_ohm.shape not in ((), (frames,)):
                raise ValueError(f"{name} has shape {wire_ohm.shape}, not () or ({frames},)")
        wires_ohm, most_ohm = (getattr(self, name) for name in _WIRES), np.finfo(float).max
        each_is_good = _in_range(rest) and all(_in_range(each, most_ohm) for each in wires_ohm)
        for frame in range(1 if each_is_good else frames):
            self.knowledge(frame)  # checks itself

    def _put_in_order(self) -> None:
        """Let readings that a file has in another order be a b c d, as all that follows wants."""
        order = [self.reading_names.index(name) for name in NEAR]
        for name in _RATIOS:
            ratio = getattr(self, name)
            if ratio is not None and ratio.shape[-1:] == (len(NEAR),):
                object.__setattr__(self, name, ratio[..., order])
        object.__setattr__(self, "reading_names", NEAR)

    @property
    def one_skin_per_frame(self) -> bool:
        """Whether rest or wires are given per frame: then each frame is of a skin of its own."""
        return any(np.ndim(getattr(self, name)) > ndim for name, ndim in _ONCE_NDIM.items())

    def knowledge(self, frame: int) -> SkinKnowledge:
        """What an estimator is told before it reads `frame`."""
        rest_ratio, *wires = (self._of_frame(name, frame) for name in _ONCE_NDIM)
        return SkinKnowledge(
            rows=self.ratio.shape[1],
            columns=self.ratio.shape[2],
            ref_top_ohm=self.ref_top_ohm,
            ref_bottom_ohm=self.ref_bottom_ohm,
            adc_bits=self.adc_bits,
            rest_ratio=rest_ratio,
            nominal_wire_ohm=WireOhm(*wires),
            reading_names=self.reading_names,
            ref_log_std=self.ref_log_std,
        )

    def _of_frame(self, name: str, frame: int) -> Any:
        """The value of an array for this frame, given for each frame or once; None if not given."""
        array = getattr(self, name)
        if array is None:
            return None
        return array[frame] if array.ndim > _ONCE_NDIM[name] else array[()]


def check_size(rows: int, columns: int) -> None:
    """Raise ValueError for a skin that has no cell, or more cells than we estimate."""
    if not (1 <= rows <= MAX_LINES and 1 <= columns <= MAX_LINES and rows * columns <= MAX_CELLS):
        can_be = f"at most {MAX_CELLS} cells in {MAX_LINES} rows and columns"
        raise ValueError(f"no skin has {rows}x{columns} cells: {can_be}")


def load_readings(path: PathName) -> Readings:
    """Read a readings file. Nothing in it is executed; the module's constants bound its arrays.

    Raises ValueError, one line that names the file and the array, for whatever is wrong with it.
    """
    arrays = load_arrays(path, Readings.__dataclass_fields__)
    with naming(path):
        if "ratio" not in arrays:
            raise ValueError("no array 'ratio'")
        for name in _SCALARS & arrays.keys():
            arrays[name] = arrays[name].item()
        return Readings(**arrays)


def load_arrays(path: PathName, names: Iterable[str]) -> dict[str, Any]:
    """Those arrays of a file that have one of these names, as they are. Raises as `load_readings`.

    Text becomes a tuple, and readings keep their type; all else is float64.
    """
    arrays: dict[str, Any] = {}
    name = "the archive"
    with naming(path):
        try:
            require_file(path)
            with _Pieces(path) as file, zipfile.ZipFile(file) as archive:
                present = {info.filename: info for info in archive.infolist()}
                left_bytes = MAX_ARRAY_BYTES
                for name in names:
                    info = present.get(f"{name}.npy")
                    if info is not None:
                        arrays[name] = _read_array(archive, info, left_bytes)
                        left_bytes -= arrays[name].nbytes
            name = "reading_names"
            if name in arrays:  # numpy finds only here whether these are letters
                arrays[name] = tuple(arrays[name].ravel().tolist())
        except Exception as error:  # damage may raise nearly anything in zipfile, zlib and numpy
            reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
            raise ValueError(f"{name} cannot be read: {reason}") from error
    return arrays


class _Pieces(FileIO):
    """A file that gives at most a piece at once.

    zipfile asks for the directory in one piece, whose size is whatever the file states.
    """

    def read(self, size: int | None = -1, /) -> bytes:
        is_piece = size is not None and 0 <= size <= _PIECE_BYTES
        return super().read(size if is_piece else _PIECE_BYTES) or b""


def _read_array(archive: zipfile.ZipFile, info: zipfile.ZipInfo, most_bytes: int) -> NDArray[Any]:
    """An array of the archive: text, readings in the type that the file has, or float64.

    What its header states is checked before anything else is read, because numpy reads as much as
    the header states.
    """
    name = info.filename.removesuffix(".npy")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError("it is packed by a method that numpy does not write")  # and is not bounded
    with archive.open(info) as member:
        if np.lib.format.read_magic(member) != (1, 0):  # others may have headers of gigabytes
            raise ValueError("its header is of another version than 1.0")
        shape, _, dtype = np.lib.format.read_array_header_1_0(member)
    count, is_text = prod(shape), name == "reading_names"
    if dtype.kind not in ("U" if is_text else "fiu"):
        raise ValueError(f"it holds {dtype}, not {'text' if is_text else 'real numbers'}")
    if min(shape, default=0) < 0 or (name in _SCALARS and count != 1):
        raise ValueError(f"its shape is {shape}" + ", not one number" * (name in _SCALARS))
    if is_text and (count > len(_NAMES) or dtype.itemsize > _MOST_NAME_BYTES):
        raise ValueError(f"{count} names of {dtype.itemsize} bytes, not some of {_NAMES}")
    if (size := count * max(dtype.itemsize, _LEAST_ITEM_BYTES)) > most_bytes:
        raise ValueError(f"{size} bytes, more than {MAX_ARRAY_BYTES} with those before it")
    with archive.open(info) as member:
        array: NDArray[Any] = np.lib.format.read_array(member, allow_pickle=False)
    # Readings stay as they are until a frame is estimated: float32 takes half of the memory.
    return array if is_text or name in _RATIOS else array.astype(np.float64)


def _in_range(values: Float | None, most: float = 1.0) -> bool:
    return values is None or bool(values.min() >= 0 and values.max() <= most)  # NaN is neither


def estimate_file(
    readings: Readings,
    method: str,
    *,
    cold: bool = False,
    watch: Callable[[Float], Iterable[Float]] = iter,
) -> dict[str, NDArray[Any]]:
    """Estimate all frames in order; the Out arrays of the module's table, by name.

    Each frame starts from the one before, unless `cold`, or unless rest or wires are given per
    frame: then each frame is a skin of its own. watch: a progress bar that passes the frames on.
    Raises ValueError for an unknown method, or one that does not take what the frames have.
    """
    out: dict[str, NDArray[Any]] = {}
    for ratio in readings.ratio:  # before the first frame, which may take minutes
        kind_of(method).check_takes(ratio)
    for frame, ratio in enumerate(watch(readings.ratio)):
        if not frame or readings.one_skin_per_frame:
            estimator = make_estimator(method, readings.knowledge(frame))
        elif cold:
            estimator.reset()
        estimate = estimator.estimate(ratio)
        for name in (*_OF_CELLS, *_OF_WIRES, *_OF_FRAMES):
            value = getattr(estimate, name)
            if not frame:
                like = np.asarray(value, dtype=object if name in _TEXTS else None)
                out[name] = np.empty((len(readings.ratio), *like.shape), like.dtype)
            out[name][frame] = value
    for name in _TEXTS:
        out[name] = out[name].astype(str)
    return out


def save_arrays(path: PathName, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write an .npz, as `whole_file`."""
    with whole_file(path) as file:
        np.savez(file, **dict[str, Any](arrays))
