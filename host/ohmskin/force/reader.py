# SPDX-License-Identifier: Apache-2.0
"""From a scan to forces: the one way that the whole package takes.

    scan -> estimate (a method, told the untouched skin) -> forces (a calibration) -> contacts

`SkinReader` reads one scan after the other in this way. `CalibratedSkin` is a device with such
readers: one for `latest`, and one for each loop over its scans. They see different scans, so each
of them must follow contacts by itself.
"""

from __future__ import annotations

import threading
import time
from collections.abc import AsyncIterator, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

import numpy as np

from ohmskin.arrays import FULL_SCALE_N, Float, heat_map
from ohmskin.circuit.configurations import is_near
from ohmskin.errors import TareRefused
from ohmskin.estimate.base import Estimate, Estimator
from ohmskin.estimate.knowledge import NO_WIRES, REF_LOG_STD, SkinKnowledge
from ohmskin.estimate.methods import kind_of, make_estimator
from ohmskin.estimate.touched import touched_cells
from ohmskin.files import Closing
from ohmskin.force.calibration import Calibration, Rest
from ohmskin.force.contacts import Contact, ContactTracker, found
from ohmskin.force.focus import FOLLOWING, Focus
from ohmskin.force.geometry import Geometry, required
from ohmskin.link.codes import quantise
from ohmskin.link.device import Device, InThreads, Region
from ohmskin.link.messages import BoardStats, Hello, Scan
from ohmskin.link.protocol import MODES

if TYPE_CHECKING:
    from ohmskin.record.recording import Tare

# The method where neither a calibration nor the user names one: docs/accuracy.md compares methods.
DEFAULT_METHOD: Final = "joint"
# A tare is the mean of the scans of so many seconds [s], unless told. Chosen: the mean of 90 scans
# has a tenth of the noise of one scan, and nobody has to wait for long.
TARE_S: Final = 1.0
# How long a scan of a region waits for a slow machine [s]. Chosen: a whole scan comes twice in it.
LATE_S: Final = 0.1
# A cell that conducts less than this share of what it did at rest counts as open. Chosen: rests
# drift by a third, and an open line leaves a thousandth.
_OPEN_SHARE: Final = 0.1


@dataclass(frozen=True, eq=False, repr=False)
class ForceScan(Scan):
    """A scan, and what it shows.

    force_n: normal force of each cell, (R, C) [N]; NaN everywhere without forces, that is where
        `SkinReader.has_forces` is False: no calibration, or a method that is not its own.
    force_n_std: its standard deviation, (R, C) [N]; NaN without forces, and where
        `ForceModel.predict` gives none.
    contacts: touched cells that adjoin. Without forces, their force is the rise of the level [S; 1
        for `voltage`].
    estimate: the estimate of which all this was made. Its ``message`` says why readings cannot be
        trusted.
    geometry: where the cells are; None: no forces, or the calibration does not say it.
    """

    force_n: Float
    force_n_std: Float
    contacts: tuple[Contact, ...]
    estimate: Estimate
    geometry: Geometry | None = None

    @property
    def touch_force_n(self) -> Float:
        """`force_n` of touched cells and of those around them, and 0 elsewhere, (R, C) [N].

        Its sum is the total force. No force is below 0, so in the sum of `force_n` the noise of all
        other cells adds up: to more than 1 N on an untouched skin of 16x16.
        """
        from scipy.ndimage import binary_dilation

        # Around a touch, one is too weak to count as one by itself, and has a force all the same.
        of_touches = binary_dilation(self.estimate.touched, np.ones((3, 3)))
        return np.where(of_touches | np.isnan(self.force_n), self.force_n, 0.0)

    @property
    def wrench(self) -> tuple[Float, Float]:
        """Net force (3,) [N] and torque (3,) [N m] of `touch_force_n`: `Geometry.wrench`.

        :raises ValueError: there are no forces, or no geometry.
        """
        if self.geometry is None and np.isnan(self.force_n).all():
            raise ValueError("no forces: read scans with a calibration, and by its own method")
        return required(self.geometry).wrench(self.touch_force_n)

    def _repr_html_(self) -> str:
        """A heat map of the forces, in a notebook; of the conductances where there are none."""
        if np.isnan(self.force_n).all():
            return self.estimate._repr_html_()
        return heat_map(self.force_n, FULL_SCALE_N, f"{self!r} [newtons]")


@dataclass(frozen=True, eq=False)
class Untouched:
    """The untouched skin as a tare has read it: a method makes a `Rest` of it.

    ratio: its mean readings, (R, C, 4) [1].
    date: when they were taken, ISO 8601.
    """

    ratio: Float
    date: str


class SkinReader:
    """Reads scan after scan of one skin: the same scans in the same order give the same forces.

    board: the board that scans the skin.
    calibration: gives newtons, as long as the method is that of the calibration.
    method: a name of `LEVEL_METHODS`; by default the calibration's, or `DEFAULT_METHOD`.
    force: take the calibration of another unit.
    ref_log_std: how well both references are known (`SkinKnowledge`). Newtons do not depend on it.

    The attribute `focus` may be set: it is told what scans show, so that the board follows the
    contacts. None: the board does not follow them.

    The latest tare is the rest, whether `tare` took it or a played scan came with it
    (`Scan.rest_ratio`). Only one thread may read scans; all else may be called from any thread.

    :raises ValueError: no such method, or other cells, another mode or unit than were calibrated.
    """

    def __init__(
        self,
        board: Hello,
        calibration: Calibration | None = None,
        *,
        method: str = "",
        force: bool = False,
        ref_log_std: float = REF_LOG_STD,
    ) -> None:
        if calibration is not None:
            calibration.check(board, force=force)
        self.board = board
        self.focus: Focus | None = None
        self._calibration, self._ref_log_std = calibration, ref_log_std
        self._wanted = method or (calibration.method if calibration else DEFAULT_METHOD)
        # Readers that `another` gives have the same three lists and lock as this one: a tare that
        # one takes holds for all, and `calibration` has the wires that any of them has learned.
        #
        # The rest of the calibration, or None where there is no calibration; after it, one rest for
        # each tare that was not undone. The last of them is the rest that holds now.
        self._rests: list[Rest | Untouched | None] = [None]
        if calibration is not None:
            self._rests = [calibration.rest, *filter(None, [calibration.tare])]
        # The estimator that knows the wires best, of those that have read scans; none before.
        self._taught: list[Estimator] = []
        self._recorded: list[Float] = []  # readings of the recorded tares that were taken
        self._lock = threading.Lock()  # two readers may come to the same one in two threads
        self._begin()

    def another(self) -> SkinReader:
        """A reader of the same skin, with the same tares, for another way of reading its scans."""
        other = copy(self)  # both have the same lists and lock
        other.focus = None  # one reader steers the regions of a board
        other._begin()
        return other

    @property
    def method(self) -> str:
        """The method that the last scan was read by; before the first scan, the one to be used."""
        return self._made_for[0]

    @property
    def force_method(self) -> str | None:
        """The method that gives newtons: that of the calibration, if there is one."""
        return None if self._calibration is None else self._calibration.method

    @property
    def has_forces(self) -> bool:
        """Whether scans get newtons: there is a calibration, and the method is its own."""
        return self.method == self.force_method

    @property
    def rest(self) -> Rest | Untouched | None:
        """The rest that holds now; None where it is not known."""
        return self._rests[-1]

    @property
    def is_tared(self) -> bool:
        """Whether there is a tare to undo."""
        return len(self._rests) > 1

    @property
    def calibration(self) -> Calibration | None:
        """The calibration with the latest tare, and the wires if scans have taught them better.

        `save` keeps them.
        """
        calibration, rest = self._calibration, self.rest
        if calibration is None:
            return None
        learned = (*self._taught, self._estimator)[0].wires()
        wires = calibration.nominal_wire_ohm.or_surer(learned)
        if isinstance(rest, Untouched):  # a tare of this session has no level yet; a file needs it
            rest = Rest.of(calibration.method, self._knowledge(rest), rest.date)
        tare = None if rest is calibration.rest else rest
        return replace(calibration, nominal_wire_ohm=wires, tare=tare)

    def warm_up(self) -> None:
        """Estimate a made-up scan of the untouched skin once, with a reader that is not kept.

        The first estimate takes most of a second, because it loads modules. Scans would wait
        meanwhile, and a program that reads every scan would be late for hundreds of them. Without a
        calibration nothing is done: no readings of the untouched skin are known.
        """
        board, calibration = self.board, self.calibration
        if calibration is not None:
            ratio = np.nan_to_num(calibration.untouched.ratio, nan=0.5)  # of mode half, say
            codes = quantise(ratio, board.adc_bits)
            reader = SkinReader(board, calibration, force=True)
            reader.read(Scan(codes, 0, 0, 0.0, 0, mode=board.mode))

    def use(self, method: str) -> None:
        """Use another method from the next scan on.

        :raises ValueError: there is none so named, or it takes no regions and `focus` is set.
        """
        make_estimator(method, self._knowledge(self.rest))  # so that an error comes here, not later
        if self.focus is not None:
            _check_partial(method)
        self._wanted = method

    def tare(self, rest_ratio: Float, *, force: bool = False) -> Tare:
        """Take these readings (R, C, 4) for the rest. Returns what a `Recorder` keeps.

        force: take them even if cells seem touched or open, as where the rest has drifted.

        :raises TareRefused: something touches the skin, or it is not connected.
        """
        # A new estimator judges the readings. The one that reads the scans would begin from the
        # frame before, which may show a touch.
        estimator = make_estimator(self._wanted, self._knowledge(self.rest))
        estimate = estimator.estimate(rest_ratio)
        if estimate.touched.any() and not force:
            remedy = "take everything off the skin; if nothing is on it: ohmskin tare --force"
            raise TareRefused(touched_cells(estimate.touched), remedy)
        if self.rest is not None and not force:
            # By deviations less, where known: a rest may be too small to be measured.
            level_std = np.nan_to_num(estimate.level_std)
            open_level = _OPEN_SHARE * estimator.rest_level() - 2 * level_std
            if np.mean(estimate.level < open_level) > 0.5:
                text = f"most cells conduct less than {_OPEN_SHARE:.0%} of what they did at rest"
                remedy = "connect the skin; if it is connected: ohmskin tare --force"
                raise TareRefused(text, remedy)
        self._rests.append(Untouched(rest_ratio, now()))
        return self._to_record(rest_ratio)

    def tare_by(self, device: Device, seconds: float = TARE_S, *, force: bool = False) -> Tare:
        """`tare` with the mean of the scans of the device in the coming seconds.

        :raises TareRefused: as `tare`.
        :raises DeviceLost: as `Device.mean_ratio`.
        :raises ValueError: as `Device.mean_ratio`; the board scans in another mode than was
            calibrated.
        """
        rest_ratio = device.mean_ratio(seconds)
        check_mode(self.board, device.info.mode)
        return replace(self.tare(rest_ratio, force=force), host_time_s=device.now_s)

    def undo_tare(self) -> Tare | None:
        """Go back to the rest before the last tare. Returns this rest as a tare, for a `Recorder`.

        None: the rest before the last tare is not known.

        :raises TareRefused: there is no tare.
        """
        if not self.is_tared:
            raise TareRefused("there is no tare to undo")
        self._rests.pop()
        return None if self.rest is None else self._to_record(self.rest.ratio)

    def _to_record(self, rest_ratio: Float) -> Tare:
        from ohmskin.record.recording import Tare  # its library is loaded when needed

        return Tare.of(rest_ratio, self.board, time.monotonic())

    def focus_on(self, device: Device, like: Region = FOLLOWING) -> Focus:
        """A `Focus` for this reader: set the attribute `focus` to it, and contacts are followed.

        Raises what `Focus` raises, and ValueError if the method takes no regions.
        """
        _check_partial(self._wanted)
        return Focus(device, like)

    def read(self, scan: Scan) -> ForceScan:
        """What a scan shows.

        :raises ValueError: it is of other cells, or of another mode.
        :raises CommandRefused: as `Focus.follow`, where `focus` is set.
        :raises DeviceLost: as `Focus.follow`, where `focus` is set.
        """
        return self.read_all([scan])[0]

    def read_all(self, scans: Sequence[Scan]) -> list[ForceScan]:
        """`read` of scan after scan by one method, in less time than one by one.

        First come all estimates, then all that follows, in few steps for all scans together: a
        processor keeps the code of either at hand, but not that of both in turn.

        scans: one or more. Raises what `read` does.
        """
        method = self._wanted
        estimated = (self._estimated(scan, method) for scan in scans)
        estimates, at_rest = zip(*estimated, strict=True)
        levels, stds, touched = (
            np.array([getattr(estimate, name) for estimate in estimates])
            for name in ("level", "level_std", "touched")
        )
        geometry, calibration = None, self._calibration if self.has_forces else None
        if calibration is not None:
            levels, stds = calibration.level(estimates)
        rises = np.array([*map(np.subtract, levels, at_rest)])
        if calibration is not None:
            geometry = calibration.geometry
            forces = of_contacts = calibration.forces(rises, stds, touched)
        else:
            forces = (np.full(rises.shape, np.nan),) * 2
            # The rise takes the place of the force in sums and centres of contacts.
            of_contacts = np.maximum(rises, 0.0), stds
        of_scans = zip(scans, estimates, *forces, found(touched, *of_contacts), strict=True)
        shown = []
        for scan, estimate, force_n, force_n_std, unnumbered in of_scans:
            contacts = self._tracker.follow(scan.time_us, unnumbered)
            if geometry is not None:
                contacts = tuple(geometry.placed(contact, force_n) for contact in contacts)
            if (focus := self.focus) is not None:  # another thread may end it
                doubted = not estimate.converged
                focus.follow(estimate.touched, len(contacts), scan, is_doubted=doubted)
            forces_n = {"force_n": force_n, "force_n_std": force_n_std}
            others = {"contacts": contacts, "estimate": estimate, "geometry": geometry}
            shown.append(ForceScan(**vars(scan) | forces_n | others))
        return shown

    def _estimated(self, scan: Scan, method: str) -> tuple[Estimate, Float]:
        """The estimate by this method, and the level at rest, (R, C) or one for all cells, ()."""
        check_mode(self.board, scan.mode)
        if (scan.rows, scan.columns) != (self.board.rows, self.board.columns):
            sizes = f"{self.board.rows}x{self.board.columns} cells, now {scan.rows}x{scan.columns}"
            raise ValueError(f"the board scanned {sizes}: configure it as before, or open it again")
        if scan.rest_ratio is not None:
            self._take_recorded(scan.rest_ratio)
        if self._made_for != (method, self.rest):  # rests are compared by identity
            self._make(method)
        estimate = self._estimator.estimate(scan.ratio, scan.reading_names)
        if self._estimator not in self._taught:
            self._taught[:] = [min([self._estimator, *self._taught], key=_layer_std)]
        # Where rest is unknown, the median cell stands in for it: most cells are untouched.
        at_rest = np.median(estimate.level) if self._rest_level is None else self._rest_level
        return estimate, np.asarray(at_rest)

    def _take_recorded(self, ratio: Float) -> None:
        """Take the tare that a played scan comes with, unless it was taken before.

        Most scans come with one that was: all scans from one recorded tare to the next have the
        same array, and several readers may read them. Arrays are compared by identity, because
        another tare may have equal numbers: undoing a tare records the rest before it once more.
        """
        with self._lock:
            if not any(ratio is recorded for recorded in self._recorded):
                self._recorded.append(ratio)
                self._rests.append(Untouched(ratio, now()))

    def _knowledge(self, rest: Rest | Untouched | None) -> SkinKnowledge:
        """What a method is told of the skin, with this rest, and the wires of the calibration."""
        wires, own = NO_WIRES, None
        if self._calibration is not None:
            wires, own = self._calibration.nominal_wire_ohm, self._calibration.own_lead_ohm
        ratio = None if rest is None else rest.ratio
        return SkinKnowledge.of(self.board, ratio, wires, self._ref_log_std, own)

    def _begin(self) -> None:
        """Begin with no contact, and as if no scan had come before."""
        self._tracker = ContactTracker()
        self._make(self._wanted)

    def _make(self, method: str) -> None:
        """Make the estimator for the method and the rest that holds now."""
        rest = self.rest
        self._estimator = make_estimator(method, self._knowledge(rest))
        self._rest_level: Float | None = None  # (R, C) [S; 1 for `voltage`]; None: unknown
        if isinstance(rest, Rest) and method == self.force_method:
            self._rest_level = rest.level  # the level above which the curves were learned
        elif rest is not None:  # what this method makes of the rest, which may be below 0 by noise
            self._rest_level = np.maximum(self._estimator.rest_level(), 0.0)
        self._made_for = method, rest  # last: a rest that cannot be read raises at each scan


class CalibratedSkin(Closing):
    """A device whose scans carry forces, and which can be tared. Made by ``ohmskin.open``.

    device: the board or recording alone, with all its commands.
    calibration: gives the forces.
    force: take it even if it is of another unit.
    focus: scans follow the contacts while somebody iterates (`focus`); a `Region` says how the
        region is read.

    Iterating and `latest` are as those of `Device`, with forces. If another unit is plugged in at
    the same port, they raise DeviceLost. With `focus`, iterating also raises what `Focus.follow`
    does.

    :raises ValueError: the calibration is of another unit, size or mode; with `focus`: the board
        reads far ends, or the method takes no regions.
    :raises CommandRefused: with `focus`: the board has no regions, or is a recording.
    :raises DeviceLost: with `focus`: the board does not answer.
    """

    def __init__(
        self,
        device: Device,
        calibration: Calibration,
        *,
        force: bool = False,
        focus: bool | Region = False,
    ) -> None:
        self.device = device
        self.name = device.name
        """See `Device.name`."""
        self._reader = SkinReader(device.info, calibration, force=force)
        self._focus: Focus | None = None
        if not isinstance(focus, bool | Region):
            raise TypeError(f"focus is True, False or an ohmskin.Region, not {focus!r}")
        if focus:
            self._focus = self._reader.focus_on(device, FOLLOWING if focus is True else focus)
        device.only_unit = device.info.unit_id
        self._reader.warm_up()
        self._lock = threading.Lock()  # a reader takes one scan at a time, and in their order

    if not TYPE_CHECKING:  # a type checker would take any name for an attribute

        def __getattr__(self, name: str) -> object:
            if not hasattr(Device, name) or hasattr(type(self), name):
                return super().__getattribute__(name)  # raises, with a property's own error
            text = f"'{type(self).__name__}' object has no attribute '{name}': its device has: "
            raise AttributeError(f"{text}skin.device.{name}", name=name, obj=self)

    @property
    def info(self) -> Hello:
        """See `Device.info`."""
        return self.device.info

    @property
    def stats(self) -> BoardStats:
        """See `Device.stats`."""
        return self.device.stats

    @property
    def calibration(self) -> Calibration:
        """What forces are read by, with the latest tare and learned wires; `save` keeps them."""
        calibration = self._reader.calibration
        assert calibration is not None  # the reader was made with one
        return calibration

    def __repr__(self) -> str:
        return f"{repr(self.device)[:-1]}, forces by '{self.calibration.method}'>"

    def start(self) -> None:
        """See `Device.start`."""
        self.device.start()

    def __iter__(self) -> Iterator[ForceScan]:
        """Every scan from now on, with its forces.

        With `focus`, scans of regions that have waited for `LATE_S` are passed over, and counted in
        `missed` of the next one: a region must not follow contacts of long ago.
        """
        reader = self._reader.another()
        reader.focus = self._focus
        return self._read_by(reader, iter(self.device))

    def _read_by(self, reader: SkinReader, scans: Iterator[Scan]) -> Iterator[ForceScan]:
        passed = 0
        try:
            for scan in scans:
                late_s = 0.0 if self.device.waits else self.device.now_s - scan.host_time_s
                if self._focus is not None and not scan.is_whole and late_s > LATE_S:
                    passed += 1 + scan.missed
                    continue
                yield reader.read(replace(scan, missed=scan.missed + passed) if passed else scan)
                passed = 0
        finally:
            if self._focus is not None:
                self._focus.rest()

    def __aiter__(self) -> AsyncIterator[ForceScan]:
        """The same for ``async for``."""
        return InThreads(self.__iter__)

    def latest(self, timeout_s: float | None = None) -> ForceScan:
        """The newest scan, with its forces."""
        with self._lock:
            return self._reader.read(self.device.latest(timeout_s))

    def tare(self, seconds: float = TARE_S, *, force: bool = False) -> Tare:
        """`SkinReader.tare_by`, which says what this raises."""
        return self._reader.tare_by(self.device, seconds, force=force)

    def undo_tare(self) -> Tare:
        """Go back to the rest before the last tare. Returns this rest as a tare, for a `Recorder`.

        :raises TareRefused: there is no tare.
        """
        undone = self._reader.undo_tare()
        assert undone is not None  # a calibration has a rest
        return replace(undone, host_time_s=self.device.now_s)

    def close(self) -> None:
        """Close the device. May be called again."""
        with self.device:  # which is closed, whatever the focus raises
            if self._focus is not None:
                self._focus.close()


def check_mode(board: Hello, mode: str) -> None:
    """Raise ValueError if this board now scans in a mode that its estimator cannot read.

    Several modes read near ends. A rest of one of these is good for all of them.
    """
    if mode != board.mode and not is_near((*MODES[mode], *MODES[board.mode])):
        raise ValueError(f"the board scanned in mode {board.mode}, now in {mode}")


def _check_partial(method: str) -> None:
    """Raise ValueError if this method takes no regions, which focus reads."""
    if not kind_of(method).takes_partial:
        remedy = "leave focus out, or use 'joint' or 'touch'"
        raise ValueError(f"'{method}' takes whole scans, and focus reads parts: {remedy}")


def _layer_std(estimator: Estimator) -> float:
    """How well it knows the layer that it knows less: a deviation of a log."""
    return max(np.inf if std is None else std for std in estimator.wires()[3:5])


def now() -> str:
    """The date and time of the host, ISO 8601, UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")
