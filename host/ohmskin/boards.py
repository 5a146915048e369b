# SPDX-License-Identifier: Apache-2.0
"""Several skin boards at once: all at this machine, by the ids of their skins, on one clock."""

from __future__ import annotations

import heapq
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Generic, NamedTuple, TypeVar, cast, overload

from ohmskin import opening as ports
from ohmskin.errors import DeviceSilent, PortError
from ohmskin.files import Closing
from ohmskin.force.calibrated_device import CalibratedDevice
from ohmskin.force.calibration import Calibration, load_calibration
from ohmskin.force.force_reader import ForceScan
from ohmskin.link.clock import BoardClock
from ohmskin.link.device import Device
from ohmskin.link.messages import Scan
from ohmskin.link.serial_port import serial_ports
from ohmskin.link.timing import line_delay_s, scan_s
from ohmskin.opening import CalibrationLike

DeviceT = TypeVar("DeviceT", bound=Device)
ScanT = TypeVar("ScanT", bound=Scan)


class BoardScan(NamedTuple, Generic[ScanT]):
    """A scan of one of several boards.

    time_s: when its middle was, on `time.monotonic()` [s]; late by what USB delays all scans alike.
    jitter_s: `BoardClock.jitter_s`.
    """

    unit_id: int
    scan: ScanT
    time_s: float
    jitter_s: float


class Boards(Closing, Mapping[int, DeviceT]):
    """Open boards by unit id. Made by `open_all`; closes all with ``with`` or `close`."""

    def __init__(self, devices: Iterable[DeviceT], closing: ExitStack) -> None:
        self._devices = {device.info.unit_id: device for device in devices}
        self._closing = closing

    def __getitem__(self, unit_id: int) -> DeviceT:
        return self._devices[unit_id]

    def __iter__(self) -> Iterator[int]:
        return iter(self._devices)

    def __len__(self) -> int:
        return len(self._devices)

    @overload
    def scans(self: Boards[CalibratedDevice]) -> Iterator[BoardScan[ForceScan]]: ...

    @overload
    def scans(self: Boards[Device]) -> Iterator[BoardScan[Scan]]: ...

    def scans(self: Boards[DeviceT]) -> Iterator[BoardScan[Scan]]:  # type: ignore[misc]
        """Every scan of every board from now on, in order of their times.

        A scan comes when each other board has sent a later one: about a period of the slowest
        board late. What that is too late for reads each device's `latest`.

        :raises DeviceLost: one of the boards went away; its text names the port.
        """
        # All begin now: what follows takes from one after the other.
        begun = [(unit_id, device, iter(device)) for unit_id, device in self.items()]
        each = [_timed(unit_id, device, scans) for unit_id, device, scans in begun]
        return heapq.merge(*each, key=lambda board_scan: board_scan.time_s)

    def close(self) -> None:
        """Stop all boards and give their ports back. May be called again."""
        self._closing.close()


def _timed(unit_id: int, device: Device, scans: Iterator[Scan]) -> Iterator[BoardScan[Scan]]:
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
) -> Boards[CalibratedDevice]: ...


def open_all(
    urls: Iterable[str] | None = None,
    *,
    calibrations: Sequence[CalibrationLike] | None = None,
    start: bool = True,
) -> Boards[Device] | Boards[CalibratedDevice]:
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

        def connect(url: str) -> Device | None:
            try:
                return opened.enter_context(_open(url, by_unit))
            except DeviceSilent:
                if searched:
                    return None
                raise

        # At once, because each takes as long as its board to boot.
        with ThreadPoolExecutor(len(named)) as pool:
            found = [device for device in pool.map(connect, named) if device is not None]
        if not found:
            raise PortError(f"no skin board answers at {', '.join(named)}: are they flashed?")
        _check_units(found)
        if start:
            for device in found:
                device.start()
        closing = opened.pop_all()
    if by_unit is None:
        return Boards(found, closing)
    return Boards(cast(list[CalibratedDevice], found), closing)


def _open(url: str, by_unit: Mapping[int, Calibration] | None) -> Device:
    device = ports.open(url, start=False)
    if by_unit is None:
        return device
    # Which calibration it needs is known only now.
    device.close()
    unit_id = device.info.unit_id
    if unit_id not in by_unit:
        known = ", ".join(map(str, sorted(by_unit))) or "none"
        raise ValueError(
            f"{url} is unit {unit_id}, of which there is no calibration (there are of units: "
            f"{known}): calibrate this skin"
        )
    try:
        return ports.open(url, start=False, calibration=by_unit[unit_id])
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


def _check_units(devices: Sequence[Device]) -> None:
    by_unit: dict[int, Device] = {}
    taken = {device.info.unit_id for device in devices}
    for device in devices:
        first = by_unit.setdefault(device.info.unit_id, device)
        if first is not device:
            free = next(number for number in range(1, len(taken) + 2) if number not in taken)
            raise PortError(
                f"{first.name} and {device.name} are both unit {device.info.unit_id}: rename one: "
                f"ohmskin configure {device.name} --unit-id {free} --save"
            )
