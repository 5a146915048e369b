# SPDX-License-Identifier: Apache-2.0
"""From a port's URL to a `Link`: the one place that knows the kinds of ports.

==================================  ==========================================================
``/dev/ttyACM0``, ``COM3``          a serial port; ``?baud=1000000`` for the faster line
``emulator://8x8?scene=ghost``      an emulated board, in this process (`ohmskin.emulate.board`)
``simavr://uno?scene=ghost``        the built firmware, run by an AVR simulator in real time
``replay://FILE.mcap?speed=1``      a recording (`ohmskin.record.replay`); 0: as fast as it is taken
==================================  ==========================================================
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import overload
from urllib.parse import parse_qsl

from ohmskin.arrays import Float
from ohmskin.emulate.board import DEFAULT_RATE_HZ, EmulatedBoard, EmulatorLink
from ohmskin.emulate.line_faults import FAULTS, Faults
from ohmskin.emulate.scenes import Scene
from ohmskin.emulate.simavr import SimavrLink
from ohmskin.emulate.skin_faults import SKIN_FAULTS, SkinFaults
from ohmskin.errors import PortError
from ohmskin.force.calibrated_device import CalibratedDevice
from ohmskin.force.calibration import Calibration, load_calibration
from ohmskin.link import protocol
from ohmskin.link.device import Device
from ohmskin.link.serial_port import Link, SerialLink
from ohmskin.record.readings import load_readings
from ohmskin.record.replay import ReplayLink

CalibrationLike = Calibration | str | os.PathLike[str]

_SCENE_KEYS = ("scene", "seed")
_BOARD_KEYS = ("readings", "rate", "noise", "unit", "foreign")
_EMULATOR_KEYS = (*_SCENE_KEYS, *_BOARD_KEYS, *SKIN_FAULTS, *FAULTS)
_DEFAULT_NOISE_LSB = 0.3


@overload
def open(url: str, *, start: bool = True) -> Device: ...


@overload
def open(
    url: str, *, start: bool = True, calibration: CalibrationLike, force: bool = False
) -> CalibratedDevice: ...


def open(
    url: str,
    *,
    start: bool = True,
    calibration: CalibrationLike | None = None,
    force: bool = False,
) -> Device:
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
        link, baud = open_link(url)
        return Device(link, start=start, baud=baud)
    if not isinstance(calibration, Calibration):
        calibration = load_calibration(calibration)
    link, baud = open_link(url)
    recorded = link if isinstance(link, ReplayLink) else None
    return CalibratedDevice(
        link, calibration, start=start, baud=baud, force=force, recorded=recorded
    )


def open_link(url: str) -> tuple[Link, int | None]:
    """The link of a URL, and the line speed it asks for, if any.

    :raises PortError: as `open`.
    """
    scheme, separator, rest = url.partition("://")
    if not separator:
        path, _, query = url.partition("?")
        baud = _baud(_options(url, query, ("baud",)))
        return SerialLink(path), baud
    place, _, query = rest.partition("?")
    if scheme == "emulator":
        return EmulatorLink(*emulated(url)), None
    if scheme == "simavr":
        return _simavr(url, place, query)
    if scheme == "replay":
        options = _options(url, query, ("speed",))
        try:
            return ReplayLink(place, float(options.get("speed", "1")), url), None
        except ValueError as exc:
            raise PortError(f"{url}: {exc}") from exc
    raise PortError(
        f"no kind of port '{scheme}://': there are serial ports by name, emulator://, simavr:// "
        "and replay://"
    )


def emulated(url: str) -> tuple[EmulatedBoard, str, Faults]:
    """The emulated board of an ``emulator://`` URL, its name, and the faults of its line.

    :raises PortError: the URL is wrong.
    """
    scheme, _, rest = url.partition("://")
    place, _, query = rest.partition("?")
    if scheme != "emulator":
        raise PortError(f"{url} is not emulated: write emulator://8x8")
    options = _options(url, query, _EMULATOR_KEYS)
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
    ratio = load_readings(path).ratio
    rate_hz = float(options.setdefault("rate", str(DEFAULT_RATE_HZ)))
    # Half a scan on, because a scan begins a rounding error before its frame's time.
    return lambda time_s: ratio[int(time_s * rate_hz + 0.5) % len(ratio)], *ratio.shape[1:3]


def _scene(
    place: str, options: dict[str, str], seed: int, faults: SkinFaults | None = None
) -> Scene:
    size = re.fullmatch(r"(\d{1,2})x(\d{1,2})", place)
    if size is None:
        raise ValueError(f"the size '{place}' is not of the form 8x8")
    rows, columns = int(size[1]), int(size[2])
    most = (protocol.CONSTANTS["rows_max"], protocol.CONSTANTS["columns_max"])
    if not (1 <= rows <= most[0] and 1 <= columns <= most[1]):
        raise ValueError(f"a board scans 1x1 to {most[0]}x{most[1]} cells, not {place}")
    return Scene(options.pop("scene", "rest"), rows, columns, seed=seed, faults=faults)


def _simavr(url: str, place: str, query: str) -> tuple[Link, int | None]:
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
