# SPDX-License-Identifier: Apache-2.0
"""From a port's URL to a device, or to several: the one place that knows the kinds of ports.

==================================  ==========================================================
``/dev/ttyACM0``, ``COM3``          a serial port; ``?baud=1000000`` for the faster line
``emulator://8x8?scene=ghost``      an emulated board, in this process (`ohmskin.emulate`);
                                    ``speed=0``: its time passes as fast as its scans are taken
``simavr://uno?scene=ghost``        the built firmware, run by an AVR simulator in real time
``replay://FILE.mcap?speed=1``      a recording (`ohmskin.record.replay`); 0: as fast as it is taken
==================================  ==========================================================

What only one kind needs is imported when that kind is opened.
"""

from __future__ import annotations

import heapq
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, overload
from urllib.parse import parse_qsl

from ohmskin.errors import DeviceSilent, PortError
from ohmskin.files import Closing, PathName, naming
from ohmskin.force.calibration import Calibration, load_calibration
from ohmskin.force.reader import CalibratedSkin
from ohmskin.link import protocol
from ohmskin.link.clock import BoardClock, line_delay_s, scan_s
from ohmskin.link.device import Device
from ohmskin.link.messages import Scan
from ohmskin.link.serial_port import SerialLink, serial_ports
from ohmskin.link.session import Session

if TYPE_CHECKING:
    from ohmskin.emulate.board import EmulatedBoard
    from ohmskin.emulate.faults import LineFaults, SkinFaults
    from ohmskin.emulate.scenes import Scene

CalibrationLike = Calibration | PathName
_Number = TypeVar("_Number", int, float)

# Noise of an emulated converter, unless told [LSB].
_DEFAULT_NOISE_LSB = 0.3
# Options of ``emulator://`` that are no faults, and of ``simavr://`` that are no settings.
_OF_BOARD = (
    *("scene", "begin", "plate", "seed", "rate", "noise", "unit", "mode", "foreign", "speed"),
)
_NOT_OF_SIMULATOR = ("scene", "begin", "plate", "baud")


@overload
def open(url: PathName, *, start: bool = True) -> Device: ...


@overload
def open(
    url: PathName, *, start: bool = True, calibration: CalibrationLike, force: bool = False
) -> CalibratedSkin: ...


def open(
    url: PathName,
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
    :raises ProtocolError: the board says what cannot be.
    :raises RecordingError: the recording of a ``replay://`` port cannot be read.
    :raises ValueError: the calibration cannot be read, or is of another unit or geometry.
    """
    told = None if calibration is None else _loaded(calibration)
    with ExitStack() as opened:
        device = opened.enter_context(_device(os.fspath(url)))
        skin = device if told is None else CalibratedSkin(device, told, force=force)
        if start:
            device.start()
        opened.pop_all()
        return skin


def _loaded(calibration: CalibrationLike) -> Calibration:
    return calibration if isinstance(calibration, Calibration) else load_calibration(calibration)


def _device(url: str) -> Device:
    """The device of a URL, not started."""
    scheme, place, query = _parts(url)
    if scheme is None:
        baud = _baud(_options(url, query, "baud"))
        return Session(SerialLink(place), baud)
    if scheme == "emulator":
        from ohmskin.emulate.driver import EmulatorLink, SteppedSkin
        from ohmskin.link.host_clock import HostClock, SteppedClock

        board, _, faults = emulated(url)
        if is_stepped(url):
            return SteppedSkin(EmulatorLink(board, url, faults, SteppedClock()))
        return Session(EmulatorLink(board, url, faults, HostClock()))
    if scheme == "simavr":
        from ohmskin.emulate.simavr import SimavrLink

        settings = dict(parse_qsl(query, keep_blank_values=True))
        size, baud = f"{settings.pop('rows', 8)}x{settings.pop('columns', 8)}", _baud(settings)
        with _wrong(url):
            scene = _scene(size, settings)
            own = {name: settings[name] for name in settings if name not in _NOT_OF_SIMULATOR}
            return Session(SimavrLink(place, scene, url, own), baud)
    if scheme == "replay":
        from ohmskin.record.replay import Replay

        options = _options(url, query, "speed")
        with _wrong(url):
            return Replay(place, _number(options, "speed", 1.0), url)
    known = "serial ports by name, emulator://, simavr:// and replay://"
    raise PortError(f"no kind of port '{scheme}://': there are {known}")


def _parts(url: str) -> tuple[str | None, str, str]:
    """Scheme (None: a serial port), place and options of a URL."""
    scheme, separator, rest = url.partition("://")
    place, _, query = (rest if separator else url).partition("?")
    return scheme if separator else None, place, query


def _options(url: str, query: str, *known: str) -> dict[str, str]:
    options = dict(parse_qsl(query, keep_blank_values=True))
    for key in options:
        if key not in known:
            raise PortError(f"{url}: no option '{key}': there are {', '.join(known)}")
    return options


def _number(options: dict[str, str], name: str, default: _Number) -> _Number:
    text = options.get(name, default)
    try:
        return type(default)(text)
    except ValueError:
        kind = {int: "a whole number", float: "a number"}[type(default)]
        raise ValueError(f"{name} must be {kind}, not '{text}'") from None


def _baud(options: dict[str, str]) -> int | None:
    text = options.get("baud")
    known = (protocol.CONSTANTS["baud_default"], protocol.CONSTANTS["baud_fast"])
    if text is None:
        return None
    if text not in map(str, known):
        raise PortError(f"baud={text}: a board knows {known[0]} and {known[1]}")
    return int(text)


@contextmanager
def _wrong(url: str) -> Iterator[None]:
    """A value that cannot be, or a file that cannot be read, is a wrong URL."""
    try:
        yield
    except (ValueError, OSError) as exc:
        raise PortError(f"{url}: {exc}") from exc


# ----------------------------------------------------------------------------- without a board


def emulated(url: str) -> tuple[EmulatedBoard, Scene, LineFaults]:
    """The emulated board of an ``emulator://`` URL, what it reads, and the faults of its line.

    :raises PortError: the URL is wrong.
    """
    from ohmskin.emulate.board import BoardSettings, EmulatedBoard
    from ohmskin.emulate.faults import LINE_FAULTS, SKIN_FAULTS, LineFaults, SkinFaults, faults_of

    scheme, place, query = _parts(url)
    if scheme != "emulator":
        raise PortError(f"{url} is not emulated: write emulator://8x8")
    known = (*_OF_BOARD, *SKIN_FAULTS, *LINE_FAULTS)
    options = _options(url, query, *known)
    with _wrong(url):
        if options.get("speed", "1") not in ("0", "1"):
            raise ValueError("speed must be 1, or 0: as fast as scans are taken")
        seed = _number(options, "seed", 0)
        faults = faults_of(SkinFaults, options)
        scene = _scene(place, options, faults)
        settings = BoardSettings(
            *(scene.rows, scene.columns),
            mode=options.get("mode", "near"),
            rate_hz=_number(options, "rate", 0.0) if "rate" in options else None,
            unit_id=_number(options, "unit", 0),
        )
        board = EmulatedBoard(
            scene.ratio,
            settings,
            noise_lsb=_number(options, "noise", _DEFAULT_NOISE_LSB),
            seed=seed,
            sampled=faults.sampled,
            says={"layout_crc": protocol.LAYOUT_CRC ^ _number(options, "foreign", 0)},
        )
        return board, scene, faults_of(LineFaults, options, seed=seed)


def is_stepped(url: str) -> bool:
    """Whether an emulated board has time only while somebody waits for it: ``speed=0``."""
    return dict(parse_qsl(_parts(url)[2])).get("speed") == "0"


def _scene(size: str, options: dict[str, str], faults: SkinFaults | None = None) -> Scene:
    from ohmskin.circuit.plate import load_plate
    from ohmskin.emulate.scenes import PlateScene, Scene

    match = re.fullmatch(r"(\d{1,2})x(\d{1,2})", size)
    rows, columns = map(int, match.groups()) if match else (0, 0)
    most = (protocol.CONSTANTS["rows_max"], protocol.CONSTANTS["columns_max"])
    if not (1 <= rows <= most[0] and 1 <= columns <= most[1]):
        raise ValueError(f"a size is as 8x8, from 1x1 to {most[0]}x{most[1]}, not '{size}'")
    seed = _number(options, "seed", 0)
    begin_s = _number(options, "begin", 0.0) if "begin" in options else None
    name = options.get("scene", "rest")
    if "plate" not in options:
        return Scene(name, rows, columns, seed=seed, faults=faults, begin_s=begin_s)
    plate = load_plate(options["plate"])
    if plate.shape != (rows, columns):
        cells = "x".join(map(str, plate.shape))
        raise ValueError(f"the plate has {cells} cells, the skin {rows}x{columns}")
    return PlateScene(plate, name, seed=seed, faults=faults, begin_s=begin_s)


# ------------------------------------------------------------------------------ several boards


class BoardScan(NamedTuple):
    """A scan of one of several boards.

    scan: a `Scan`; a `ForceScan` if the boards were opened with calibrations. time_s: when its
    middle was, on `time.monotonic()` [s]; late by what USB delays all scans alike.
    """

    unit_id: int
    scan: Any
    time_s: float


class Boards(Closing, dict[int, Any]):
    """Open boards by unit id: each a `Device`, or a `CalibratedSkin` if calibrations were given.

    Made by `open_all`. ``with`` closes all, and so does `close`.

    :raises PortError: two have the same unit id.
    """

    def __init__(self, devices: Sequence[Device | CalibratedSkin]) -> None:
        for device in devices:
            unit_id = device.info.unit_id
            first = self.setdefault(unit_id, device)
            if first is not device:
                raise PortError(
                    f"{first.name} and {device.name} are both unit {unit_id}: rename one: "
                    f"ohmskin configure {device.name} --unit-id NUMBER --save"
                )

    def scans(self) -> Iterator[BoardScan]:
        """Every scan of every board from now on, in order of their times.

        A scan comes when every other board has sent a later one: about a period of the slowest
        board late. A program for which that is too late reads each device's `latest`.

        :raises DeviceLost: one of the boards went away; its text names the port.
        """
        # All boards begin now: the merge below takes from one after the other.
        begun = [(device, iter(device)) for device in self.values()]
        each = [_timed(device, scans) for device, scans in begun]
        return heapq.merge(*each, key=lambda board_scan: board_scan.time_s)

    def close(self) -> None:
        """Stop all boards and give their ports back. May be called again."""
        with ExitStack() as closing:
            for device in self.values():
                closing.push(device)


def _timed(device: Device | CalibratedSkin, scans: Iterator[Scan]) -> Iterator[BoardScan]:
    clock, unit_id = BoardClock(), device.info.unit_id
    for scan in scans:
        board = device.info
        took_us = 1e6 * scan_s(board)
        clock.add(scan.time_us + took_us, scan.host_time_s - line_delay_s(scan, board))
        yield BoardScan(unit_id, scan, clock.host_s(scan.time_us + took_us / 2))


def open_all(
    urls: Iterable[str] | None = None,
    *,
    calibrations: Iterable[CalibrationLike] | None = None,
    start: bool = True,
) -> Boards:
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
        raise PortError("no skin board found: name ports out of those that 'ohmskin ports' lists")
    by_unit = None if calibrations is None else _by_unit(calibrations)
    with ExitStack() as opened:

        def connect(url: str) -> Device | CalibratedSkin | None:
            try:
                device = opened.enter_context(open(url, start=False))
            except DeviceSilent:
                if searched:
                    return None
                raise
            return device if by_unit is None else _calibrated(device, by_unit)

        # At once, because each takes as long as its board to boot.
        with ThreadPoolExecutor(len(named)) as pool:
            found = [device for device in pool.map(connect, named) if device is not None]
        if not found:
            raise PortError(f"no skin board answers at {', '.join(named)}: are they flashed?")
        boards = Boards(found)
        if start:
            for device in found:
                device.start()
        opened.pop_all()
        return boards


def _calibrated(device: Device, by_unit: dict[int, Calibration]) -> CalibratedSkin:
    unit_id = device.info.unit_id
    with naming(device.name):
        if unit_id not in by_unit:
            raise ValueError(f"no calibration is of its unit, {unit_id}: calibrate this skin")
        return CalibratedSkin(device, by_unit[unit_id])


def _by_unit(calibrations: Iterable[CalibrationLike]) -> dict[int, Calibration]:
    by_unit: dict[int, Calibration] = {}
    for calibration in map(_loaded, calibrations):
        if by_unit.setdefault(calibration.unit_id, calibration) is not calibration:
            raise ValueError(f"two calibrations are of unit {calibration.unit_id}: give one")
    return by_unit
