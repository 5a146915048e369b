# SPDX-License-Identifier: Apache-2.0
"""From a port's URL to a device, or to several: the one place that knows the kinds of ports.

==================================  ==========================================================
``/dev/ttyACM0``, ``COM3``          a serial port; ``?baud=1000000`` for the faster line
``emulator://8x8?scene=ghost``      an emulated board, in this process (`ohmskin.emulate`)
``simavr://uno?scene=ghost``        the built firmware, run by an AVR simulator in real time
``replay://FILE.mcap?speed=1``      a recording (`ohmskin.record.replay`); 0: as fast as it is taken
==================================  ==========================================================

What only one kind needs is imported when that kind is opened.
"""

from __future__ import annotations

import heapq
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar, overload
from urllib.parse import parse_qsl

from ohmskin.arrays import Float
from ohmskin.errors import DeviceSilent, PortError
from ohmskin.files import Closing
from ohmskin.force.calibration import Calibration, load_calibration
from ohmskin.force.reader import CalibratedSkin, ForceScan
from ohmskin.link import protocol
from ohmskin.link.clock import BoardClock, line_delay_s, scan_s
from ohmskin.link.device import Device
from ohmskin.link.messages import Scan
from ohmskin.link.serial_port import Link, SerialLink, serial_ports
from ohmskin.link.session import Session

if TYPE_CHECKING:
    from ohmskin.emulate.board import EmulatedBoard
    from ohmskin.emulate.line_faults import Faults
    from ohmskin.emulate.scenes import Scene
    from ohmskin.emulate.skin_faults import SkinFaults

CalibrationLike = Calibration | str | os.PathLike[str]
SkinT = TypeVar("SkinT", bound=Device | CalibratedSkin)
ScanT = TypeVar("ScanT", bound=Scan)

_SCENE_KEYS = ("scene", "seed")
_BOARD_KEYS = ("readings", "rate", "noise", "unit", "foreign")
# Noise of an emulated converter, unless told [LSB].
_DEFAULT_NOISE_LSB = 0.3


@overload
def open(url: str, *, start: bool = True) -> Device: ...


@overload
def open(
    url: str, *, start: bool = True, calibration: CalibrationLike, force: bool = False
) -> CalibratedSkin: ...


def open(
    url: str,
    *,
    start: bool = True,
    calibration: CalibrationLike | None = None,
    force: bool = False,
) -> Device | CalibratedSkin:
    """Connect to a board, and start scanning unless told otherwise.

    calibration: a `Calibration` or the path of its file; scans then carry forces. force: take it
    even if it is of another unit.

    >>> with open("emulator://8x8?scene=ghost") as skin:
    ...     skin.latest().ratio.shape
    (8, 8, 4)

    :raises PortError: the port is unknown, busy or not permitted, or the URL is wrong.
    :raises DeviceSilent: nothing that is a skin board answers.
    :raises ProtocolMismatch: the board was built from another protocol definition.
    :raises RecordingError: the recording of a ``replay://`` port cannot be read.
    :raises ValueError: the calibration cannot be read, or is of another unit or geometry.
    """
    if calibration is None:
        return open_device(url, start=start)
    if not isinstance(calibration, Calibration):
        calibration = load_calibration(calibration)
    return _calibrated(open_device(url, start=False), calibration, start=start, force=force)


def _calibrated(
    device: Device, calibration: Calibration, *, start: bool, force: bool = False
) -> CalibratedSkin:
    try:
        skin = CalibratedSkin(device, calibration, force=force)
        if start:
            device.start()
    except BaseException:
        device.close()
        raise
    return skin


def open_device(url: str, *, start: bool = True) -> Device:
    """The device of a URL.

    :raises PortError: as `open`, and so are the other errors.
    """
    scheme, separator, rest = url.partition("://")
    place, _, query = rest.partition("?")
    if scheme == "replay" and separator:
        from ohmskin.record.replay import Replay

        options = _options(url, query, ("speed",))
        try:
            device: Device = Replay(place, float(options.get("speed", "1")), url)
        except ValueError as exc:
            raise PortError(f"{url}: {exc}") from exc
    else:
        device = Session(*open_link(url))
    try:
        if start:
            device.start()
    except BaseException:
        device.close()
        raise
    return device


def open_link(url: str) -> tuple[Link, int | None]:
    """The link of the board at a URL, and the line speed that the URL asks for, if any.

    :raises PortError: as `open`.
    """
    scheme, separator, rest = url.partition("://")
    if not separator:
        path, _, query = url.partition("?")
        baud = _baud(_options(url, query, ("baud",)))
        return SerialLink(path), baud
    place, _, query = rest.partition("?")
    if scheme == "emulator":
        from ohmskin.emulate.board import EmulatorLink

        return EmulatorLink(*emulated(url)), None
    if scheme == "simavr":
        return _simavr(url, place, query)
    raise PortError(
        f"no kind of port '{scheme}://': there are serial ports by name, emulator://, simavr:// "
        "and replay://"
    )


# ----------------------------------------------------------------------------- without a board


def emulated(url: str) -> tuple[EmulatedBoard, str, Faults]:
    """The emulated board of an ``emulator://`` URL, its name, and the faults of its line.

    :raises PortError: the URL is wrong.
    """
    from ohmskin.emulate.board import EmulatedBoard
    from ohmskin.emulate.line_faults import FAULTS, Faults
    from ohmskin.emulate.skin_faults import SKIN_FAULTS, SkinFaults

    scheme, _, rest = url.partition("://")
    place, _, query = rest.partition("?")
    if scheme != "emulator":
        raise PortError(f"{url} is not emulated: write emulator://8x8")
    options = _options(url, query, (*_SCENE_KEYS, *_BOARD_KEYS, *SKIN_FAULTS, *FAULTS))
    try:
        seed = int(options.pop("seed", "0"))
        skin_faults = SkinFaults.from_texts(options)
        for name in SKIN_FAULTS:
            options.pop(name, None)
        ratio_at, rows, columns = _skin(place, options, seed, skin_faults)
        board = EmulatedBoard(
            ratio_at,
            rows,
            columns,
            rate_hz=float(options.pop("rate")) if "rate" in options else None,
            noise_lsb=float(options.pop("noise", str(_DEFAULT_NOISE_LSB))),
            seed=seed,
            unit_id=int(options.pop("unit", "0")),
            layout_crc=protocol.LAYOUT_CRC ^ int(options.pop("foreign", "0")),
            sampled=skin_faults.sampled if skin_faults.of_sampling else None,
        )
        faults = Faults(seed=seed, **{name: float(value) for name, value in options.items()})
    except (ValueError, OSError) as exc:
        raise PortError(f"{url}: {exc}") from exc
    return board, url, faults


def _skin(
    place: str, options: dict[str, str], seed: int, faults: SkinFaults
) -> tuple[Callable[[float], Float], int, int]:
    path = options.pop("readings", None)
    if path is None:
        scene = _scene(place, options, seed, faults)
        return scene.ratio, scene.rows, scene.columns
    if "scene" in options:
        raise ValueError("say either scene or readings")
    if faults.of_resistances:
        raise ValueError("readings of a file have no resistances that could be at fault")
    from ohmskin.emulate.board import DEFAULT_RATE_HZ
    from ohmskin.record.readings import load_readings

    ratio = load_readings(path).ratio
    rate_hz = float(options.setdefault("rate", str(DEFAULT_RATE_HZ)))
    # Half a scan on, because a scan begins a rounding error before its frame's time.
    return lambda time_s: ratio[int(time_s * rate_hz + 0.5) % len(ratio)], *ratio.shape[1:3]


def _scene(
    place: str, options: dict[str, str], seed: int, faults: SkinFaults | None = None
) -> Scene:
    from ohmskin.emulate.scenes import Scene

    size = re.fullmatch(r"(\d{1,2})x(\d{1,2})", place)
    if size is None:
        raise ValueError(f"the size '{place}' is not of the form 8x8")
    rows, columns = int(size[1]), int(size[2])
    most = (protocol.CONSTANTS["rows_max"], protocol.CONSTANTS["columns_max"])
    if not (1 <= rows <= most[0] and 1 <= columns <= most[1]):
        raise ValueError(f"a board scans 1x1 to {most[0]}x{most[1]} cells, not {place}")
    return Scene(options.pop("scene", "rest"), rows, columns, seed=seed, faults=faults)


def _simavr(url: str, place: str, query: str) -> tuple[Link, int | None]:
    from ohmskin.emulate.simavr import SimavrLink

    options = _options(url, query, (*_SCENE_KEYS, "rows", "columns", "elf", "baud", "tau_us"))
    try:
        seed = int(options.pop("seed", "0"))
        size = f"{options.pop('rows', '8')}x{options.pop('columns', '8')}"
        scene = _scene(size, options, seed)
        elf = options.pop("elf", None)
        baud = _baud(options)
        tau_us = float(options.pop("tau_us", "0"))
        link = SimavrLink(place, scene, None if elf is None else Path(elf), tau_us, url)
    except (ValueError, OSError) as exc:
        raise PortError(f"{url}: {exc}") from exc
    return link, baud


def _baud(options: dict[str, str]) -> int | None:
    text = options.pop("baud", None)
    known = (protocol.CONSTANTS["baud_default"], protocol.CONSTANTS["baud_fast"])
    if text is None:
        return None
    if not text.isdecimal() or int(text) not in known:
        raise PortError(f"baud={text}: a board knows {known[0]} and {known[1]}")
    return int(text)


def _options(url: str, query: str, known: Iterable[str]) -> dict[str, str]:
    options = dict(parse_qsl(query, keep_blank_values=True))
    for key in options:
        if key not in known:
            raise PortError(f"{url}: no option '{key}': there are {', '.join(known)}")
    return options


# ------------------------------------------------------------------------------ several boards


class BoardScan(NamedTuple, Generic[ScanT]):
    """A scan of one of several boards.

    time_s: when its middle was, on `time.monotonic()` [s]; late by what USB delays all scans alike.
    jitter_s: `BoardClock.jitter_s`.
    """

    unit_id: int
    scan: ScanT
    time_s: float
    jitter_s: float


class Boards(Closing, Mapping[int, SkinT]):
    """Open boards by unit id. Made by `open_all`; closes all with ``with`` or `close`."""

    def __init__(self, devices: Iterable[SkinT], closing: ExitStack) -> None:
        self._devices = {device.info.unit_id: device for device in devices}
        self._closing = closing

    def __getitem__(self, unit_id: int) -> SkinT:
        return self._devices[unit_id]

    def __iter__(self) -> Iterator[int]:
        return iter(self._devices)

    def __len__(self) -> int:
        return len(self._devices)

    @overload
    def scans(self: Boards[CalibratedSkin]) -> Iterator[BoardScan[ForceScan]]: ...

    @overload
    def scans(self: Boards[Device]) -> Iterator[BoardScan[Scan]]: ...

    def scans(self: Boards[SkinT]) -> Iterator[BoardScan[Scan]]:  # type: ignore[misc]
        """Every scan of every board from now on, in order of their times.

        A scan comes when every other board has sent a later one: about a period of the slowest
        board late. A program for which that is too late reads each device's `latest`.

        :raises DeviceLost: one of the boards went away; its text names the port.
        """
        # All boards begin now: the merge below takes from one after the other.
        begun = [(unit_id, device, iter(device)) for unit_id, device in self.items()]
        each = [_timed(unit_id, device, scans) for unit_id, device, scans in begun]
        return heapq.merge(*each, key=lambda board_scan: board_scan.time_s)

    def close(self) -> None:
        """Stop all boards and give their ports back. May be called again."""
        self._closing.close()


def _timed(
    unit_id: int, device: Device | CalibratedSkin, scans: Iterator[Scan]
) -> Iterator[BoardScan[Scan]]:
    clock = BoardClock()
    for scan in scans:
        board = device.info
        took_us = 1e6 * scan_s(board)
        clock.add(scan.time_us + took_us, scan.host_time_s - line_delay_s(scan, board))
        time_s = clock.host_s(scan.time_us + took_us / 2)
        yield BoardScan(unit_id, scan, time_s, clock.jitter_s)


@overload
def open_all(
    urls: Iterable[str] | None = None, *, calibrations: None = None, start: bool = True
) -> Boards[Device]: ...


@overload
def open_all(
    urls: Iterable[str] | None = None,
    *,
    calibrations: Sequence[CalibrationLike],
    start: bool = True,
) -> Boards[CalibratedSkin]: ...


def open_all(
    urls: Iterable[str] | None = None,
    *,
    calibrations: Sequence[CalibrationLike] | None = None,
    start: bool = True,
) -> Boards[Any]:
    """Connect to several boards, all of these or none, and start scanning unless told otherwise.

    urls: as `ohmskin.open` takes them; None: all serial ports whose USB id is that of an Uno or a
    Mega 2560. Of these, what does not answer as a skin is skipped: it is another device. A skin
    that cannot be used, for its port is busy or its firmware of another version, is an error.
    calibrations: `Calibration` or files, for each board the one of its unit id; there may be more.

    >>> with open_all(["emulator://8x8?unit=1", "emulator://8x8?unit=2"]) as skins:
    ...     sorted(skins)
    [1, 2]

    :raises PortError: as `ohmskin.open`; no board is found; two have the same unit id.
    :raises DeviceSilent: as `ohmskin.open`, for a port that was named.
    :raises ProtocolMismatch: as `ohmskin.open`.
    :raises ValueError: as `ohmskin.open`; a board has no calibration, or two are of one unit.
    """
    searched = urls is None
    named = [port.path for port in serial_ports() if port.board] if urls is None else list(urls)
    if not named:
        raise PortError(
            "no skin board found: 'ohmskin ports' lists the ports there are; name those of boards "
            "that it does not know"
        )
    by_unit = None if calibrations is None else _by_unit(calibrations)
    with ExitStack() as opened:

        def connect(url: str) -> Device | CalibratedSkin | None:
            try:
                device = _open(url, by_unit)
            except DeviceSilent:
                if searched:
                    return None
                raise
            opened.callback(device.close)
            return device

        # At once, because each takes as long as its board to boot.
        with ThreadPoolExecutor(len(named)) as pool:
            found = [device for device in pool.map(connect, named) if device is not None]
        if not found:
            raise PortError(f"no skin board answers at {', '.join(named)}: are they flashed?")
        _check_units(found)
        if start:
            for device in found:
                device.start()
        return Boards(found, opened.pop_all())


def _open(url: str, by_unit: Mapping[int, Calibration] | None) -> Device | CalibratedSkin:
    device = open_device(url, start=False)
    if by_unit is None:
        return device
    unit_id = device.info.unit_id
    if unit_id not in by_unit:
        device.close()
        known = ", ".join(map(str, sorted(by_unit))) or "none"
        raise ValueError(
            f"{url} is unit {unit_id}, of which there is no calibration (there are of units: "
            f"{known}): calibrate this skin"
        )
    try:
        return _calibrated(device, by_unit[unit_id], start=False)
    except ValueError as exc:
        raise ValueError(f"{url}: {exc}") from exc


def _by_unit(calibrations: Sequence[CalibrationLike]) -> dict[int, Calibration]:
    by_unit: dict[int, Calibration] = {}
    names: dict[int, str] = {}
    for index, given in enumerate(calibrations):
        if isinstance(given, Calibration):
            calibration, name = given, f"calibration {index}"
        else:
            calibration, name = load_calibration(given), os.fspath(given)
        unit_id = calibration.unit_id
        if unit_id in by_unit:
            raise ValueError(f"{names[unit_id]} and {name} are both of unit {unit_id}: give one")
        by_unit[unit_id], names[unit_id] = calibration, name
    return by_unit


def _check_units(devices: Sequence[Device | CalibratedSkin]) -> None:
    by_unit: dict[int, Device | CalibratedSkin] = {}
    taken = {device.info.unit_id for device in devices}
    for device in devices:
        first = by_unit.setdefault(device.info.unit_id, device)
        if first is not device:
            free = next(number for number in range(1, len(taken) + 2) if number not in taken)
            raise PortError(
                f"{first.name} and {device.name} are both unit {device.info.unit_id}: rename one: "
                f"ohmskin configure {device.name} --unit-id {free} --save"
            )
