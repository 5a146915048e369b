# SPDX-License-Identifier: Apache-2.0
"""Several boards at once: all are opened or none, and their scans come in order of one clock."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from itertools import repeat
from os import PathLike
from typing import Any, Generic, NamedTuple, TypeVar, cast, overload

from ohmskin import opening
from ohmskin.errors import DeviceSilent, PortError
from ohmskin.files import Closing, naming
from ohmskin.force.calibration import Calibration, CalibrationLike, loaded
from ohmskin.force.reader import CalibratedSkin, ForceScan
from ohmskin.link.device import Device
from ohmskin.link.messages import Scan
from ohmskin.link.serial_port import serial_ports

_Skin = TypeVar("_Skin", bound=Device | CalibratedSkin)
_Scan = TypeVar("_Scan", bound=Scan)


class BoardScan(NamedTuple, Generic[_Scan]):
    """A scan of one of several boards.

    unit_id: of the board.
    scan: a `Scan`; a `ForceScan` if the boards were opened with calibrations.
    """

    unit_id: int
    scan: _Scan


class Boards(Closing, dict[int, _Skin], Generic[_Skin, _Scan]):
    """Open boards by unit id: each a `Device`, or a `CalibratedSkin` if calibrations were given.

    Made by `open_all`. ``with`` closes all, and so does `close`.

    :raises PortError: two have the same unit id.
    """

    def __init__(self, devices: Sequence[_Skin]) -> None:
        for device in devices:
            unit_id = device.info.unit_id
            first = self.setdefault(unit_id, device)
            if first is not device:
                raise PortError(
                    f"{first.name} and {device.name} are both unit {unit_id}: rename one: "
                    f"ohmskin configure {device.name} --unit-id NUMBER --save"
                )

    def scans(self) -> Iterator[BoardScan[_Scan]]:
        """Every scan of every board from now on, in order of `Scan.time_ns`.

        A scan is given only when every other board has sent a later one. So it comes late, by about
        a period of the slowest board. A program for which this is too late reads each device's
        `latest`.

        :raises DeviceLost: one of the boards went away; its text names the port.
        """
        # The iterators begin here, all boards at once. The merge would begin each of them only when
        # it first takes a scan of its board.
        begun = [map(BoardScan, repeat(unit), iter(device)) for unit, device in self.items()]
        of_boards = cast("list[Iterator[BoardScan[_Scan]]]", begun)
        return heapq.merge(*of_boards, key=lambda board_scan: board_scan.scan.time_ns)

    def close(self) -> None:
        """Stop all boards and give their ports back. May be called again."""
        with ExitStack() as closing:
            for device in self.values():
                closing.push(device)


@overload
def open_all(urls: Iterable[str] | None = None, *, start: bool = True) -> Boards[Device, Scan]: ...


@overload
def open_all(
    urls: Iterable[str] | None = None,
    *,
    calibrations: Iterable[CalibrationLike],
    start: bool = True,
) -> Boards[CalibratedSkin, ForceScan]: ...


def open_all(
    urls: Iterable[str] | None = None,
    *,
    calibrations: Iterable[CalibrationLike] | None = None,
    start: bool = True,
) -> Any:
    """Connect to several boards, all of these or none, and start scanning unless told otherwise.

    urls: as `ohmskin.open` takes them; None: all serial ports whose USB id is that of a board that
        the firmware is made for. Such a port is skipped if no skin answers at it: it is another
        device. A skin that cannot be used, because its port is busy or its firmware is of another
        version, is an error.
    calibrations: each a `Calibration` or a file; each board takes the one of its unit id.

    >>> with open_all(["emulator://8x8?unit=1", "emulator://8x8?unit=2"]) as skins:
    ...     sorted(skins)
    [1, 2]

    :raises PortError: as `ohmskin.open`; no board is found; two have the same unit id.
    :raises DeviceSilent: as `ohmskin.open`, for a port that was named.
    :raises ProtocolMismatch: as `ohmskin.open`.
    :raises ValueError: as `ohmskin.open`; a board has no calibration, or two are of one unit.
    :raises TypeError: one URL or one file in place of a list of them.
    """
    for name, given in (("urls", urls), ("calibrations", calibrations)):
        if isinstance(given, str | PathLike):
            raise TypeError(f"open_all takes a list of {name}, and got one: put {given!r} into []")
    searches = urls is None
    ports = [port.path for port in serial_ports() if port.board] if urls is None else list(urls)
    if not ports:
        raise PortError("no skin board found: name ports out of those that 'ohmskin ports' lists")
    by_unit: dict[int, Calibration] = {}
    for calibration in map(loaded, calibrations or ()):
        if by_unit.setdefault(calibration.unit_id, calibration) is not calibration:
            raise ValueError(f"two calibrations are of unit {calibration.unit_id}: give one")
    with ExitStack() as opened:

        def connect(url: str) -> Device | CalibratedSkin | None:
            try:
                device = opened.enter_context(opening.open(url, start=False))
            except DeviceSilent:
                if searches:
                    return None
                raise
            return device if calibrations is None else _calibrated(device, by_unit)

        # All at the same time, because each takes as long as its board takes to boot.
        with ThreadPoolExecutor(len(ports)) as pool:
            devices = [device for device in pool.map(connect, ports) if device is not None]
        if not devices:
            raise PortError(f"no skin board answers at {', '.join(ports)}: are they flashed?")
        boards: Boards[Any, Any] = Boards(devices)
        if start:
            for device in devices:
                device.start()
        opened.pop_all()
        return boards


def _calibrated(device: Device, by_unit: dict[int, Calibration]) -> CalibratedSkin:
    unit_id = device.info.unit_id
    with naming(device.name):
        if unit_id not in by_unit:
            raise ValueError(f"no calibration is of its unit, {unit_id}: calibrate this skin")
        return CalibratedSkin(device, by_unit[unit_id])
