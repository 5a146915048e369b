# SPDX-License-Identifier: Apache-2.0
"""The readings file (.npz): frames of readings in, one estimate per frame out.

In (F frames of R x C cells, 4 readings a cell unless named; other arrays are ignored):

======================= ============================ =========================================
array                   shape                        meaning
======================= ============================ =========================================
ratio                   F, R, C, 4                   sense voltage / Vdd
rest_ratio              R, C, 4 or F, R, C, 4        the same untouched (optional)
ref_top_ohm             scalar                       reference resistors, 30 kOhm if absent
ref_bottom_ohm          scalar
nominal_top_wire_ohm    scalar or F                  one wire segment, per layer (optional)
nominal_bottom_wire_ohm scalar or F
nominal_lead_ohm        scalar or F                  from multiplexer to first crossing; 0: nothing
adc_bits                scalar                       absent: the readings are exact
reading_names           4, text                      names out of a to h; absent: a b c d
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
chi2                                          F       misfit per reading
iterations, seconds                           F       how long it took
============================================= ======= ============================================
"""

import zipfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.skin import DEFAULT_REF_OHM, NEAR
from ohmskin.estimate.base import Estimate
from ohmskin.estimate.knowledge import WIRE_FIELDS, SkinKnowledge, WireOhm, check_ratio
from ohmskin.estimate.methods import make_estimator
from ohmskin.files import PathName, naming, whole_file
from ohmskin.link.protocol import ENUMS

# Largest array that is read or written. Chosen: it fits into the memory of any machine several
# times, and is 18 minutes of a 16x16 skin.
MAX_ARRAY_BYTES: Final = 200_000_000
# Cells of the largest skin. The estimators' matrices grow with the square: 4096 cells make 134 MB.
MAX_CELLS: Final = 4096
_NAMES: Final = tuple(ENUMS["reading"].values)
# What may be given for each frame, and how many dimensions it has where it is given once.
_WIRES: Final = WIRE_FIELDS[:3]
_ONCE_NDIM: Final = {"rest_ratio": 3} | dict.fromkeys(_WIRES, 0)
# The arrays that go out, in this order.
_OF_CELLS: Final = ("cell_ohm", "cell_siemens", "cell_siemens_std", "touched")
_OF_WIRES: Final = ("top_wire_ohm", "bottom_wire_ohm", "top_wire_ohm_std", "bottom_wire_ohm_std")
_OF_FRAMES: Final = ("converged", "message", "chi2", "iterations", "seconds")


@dataclass(frozen=True, eq=False)
class Readings:
    """The contents of a readings file, checked. Meanings, shapes and units: the module's table."""

    ratio: Float
    rest_ratio: Float | None = None
    ref_top_ohm: float = DEFAULT_REF_OHM
    ref_bottom_ohm: float = DEFAULT_REF_OHM
    nominal_top_wire_ohm: Float | None = None
    nominal_bottom_wire_ohm: Float | None = None
    nominal_lead_ohm: Float | None = None
    adc_bits: int | None = None
    reading_names: tuple[str, ...] = NEAR

    def __post_init__(self) -> None:
        names, count = self.reading_names, len(self.reading_names)
        if len({*names} & {*_NAMES}) != count:
            raise ValueError(f"reading_names are {' '.join(names):.80}, not some of {_NAMES}")
        if self.ratio.ndim != 4 or self.ratio.shape[-1] != count:
            raise ValueError(f"ratio has shape {self.ratio.shape}, not (F, rows, columns, {count})")
        frames, rows, columns, _ = self.ratio.shape
        if frames < 1 or not 1 <= rows * columns <= MAX_CELLS:
            given = f"{frames} frames of {rows}x{columns} cells"
            raise ValueError(f"ratio has {given}: at least 1 frame and 1 to {MAX_CELLS} cells")
        # All at once, because a check of each frame takes a minute for a file of a million.
        good = ((self.ratio >= 0) & (self.ratio <= 1)).all(axis=(1, 2, 3))
        for frame in np.flatnonzero(~good).tolist():
            check_ratio(self.ratio[frame], rows, columns, name=f"ratio, frame {frame},", of=names)
        rest = self.rest_ratio
        if rest is not None and rest.ndim == 4 and len(rest) != frames:
            raise ValueError(f"rest_ratio has {len(rest)} frames, ratio {frames}")
        for name in _WIRES:
            wire_ohm = getattr(self, name)
            if wire_ohm is not None and wire_ohm.shape not in ((), (frames,)):
                raise ValueError(f"{name} has shape {wire_ohm.shape}, not () or ({frames},)")
        for frame in range(frames if self.one_skin_per_frame else 1):
            self.knowledge(frame)  # checks itself

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
        )

    def _of_frame(self, name: str, frame: int) -> Any:
        """What an array says of this frame, be it given once or for each; None if not given."""
        array = getattr(self, name)
        if array is None:
            return None
        return array[frame] if array.ndim > _ONCE_NDIM[name] else array[()]


def load_readings(path: PathName) -> Readings:
    """Read a readings file. Nothing in it is executed; no array may exceed 2e8 bytes.

    Raises ValueError, one line that names the file and the array, for whatever is wrong with it.
    """
    arrays: dict[str, Any] = {}
    name = "the archive"
    with naming(path):
        try:
            with zipfile.ZipFile(path) as archive:
                present = {info.filename: info for info in archive.infolist()}
                for name in Readings.__dataclass_fields__:
                    info = present.get(f"{name}.npy")
                    if info is not None:
                        arrays[name] = _read_array(archive, info)
        except Exception as error:  # damage may raise nearly anything in zipfile, zlib and numpy
            reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
            raise ValueError(f"{name} cannot be read: {reason}") from error
        if "ratio" not in arrays:
            raise ValueError("no array 'ratio'")
        for name in ("ref_top_ohm", "ref_bottom_ohm", "adc_bits"):
            if name in arrays:
                if arrays[name].size != 1:
                    raise ValueError(f"{name} has shape {arrays[name].shape}, not one number")
                arrays[name] = arrays[name].item()
        if "reading_names" in arrays:
            arrays["reading_names"] = tuple(arrays["reading_names"].ravel().tolist())
        return Readings(**arrays)


def _read_array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    """An array of the archive, as float64 or as text.

    zipfile never yields more than the size that the archive states, so the first check bounds what
    is unpacked.
    """
    if info.file_size > MAX_ARRAY_BYTES:
        raise ValueError(f"{info.file_size} bytes, more than {MAX_ARRAY_BYTES}")
    with archive.open(info) as member:
        array: NDArray[Any] = np.lib.format.read_array(member, allow_pickle=False)
    if info.filename == "reading_names.npy" and array.dtype.kind == "U":
        return array
    if array.dtype.kind not in "fiu":
        raise ValueError(f"it holds {array.dtype}, not real numbers")
    if 8 * array.size > MAX_ARRAY_BYTES:
        raise ValueError(f"{8 * array.size} bytes as float64, more than {MAX_ARRAY_BYTES}")
    return array.astype(np.float64, copy=False)


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
    Raises ValueError for an unknown method.
    """
    estimator = make_estimator(method, readings.knowledge(0))
    estimates: list[Estimate] = []
    for frame, ratio in enumerate(watch(readings.ratio)):
        if frame and readings.one_skin_per_frame:
            estimator = make_estimator(method, readings.knowledge(frame))
        elif cold:
            estimator.reset()
        estimates.append(estimator.estimate(ratio))
    names = (*_OF_CELLS, *_OF_WIRES, *_OF_FRAMES)
    return {name: np.array([getattr(one, name) for one in estimates]) for name in names}


def save_arrays(path: PathName, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write an .npz, as `whole_file`. Raises ValueError also for an array of Python objects."""
    for name, array in arrays.items():
        if array.dtype.hasobject:
            raise ValueError(f"{name} holds Python objects, which no .npz of ours may")
    with whole_file(path) as file:
        np.savez(file, **dict[str, Any](arrays))
