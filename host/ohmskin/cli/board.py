# SPDX-License-Identifier: Apache-2.0
"""``ohmskin ports``, ``info``, ``configure`` and ``flash``: boards, and how they scan."""

import json
import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from rich.table import Table
from rich.text import Text
from typer import Argument, Option

import ohmskin
from ohmskin.arrays import Float
from ohmskin.cli import pico
from ohmskin.cli.terminal import Terminal
from ohmskin.emulate.board import DEFAULT_RATE_HZ
from ohmskin.errors import DeviceLost, OhmskinError, PortError
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.estimate.touched import touched_at_rest, touched_cells
from ohmskin.force.calibration import Calibration
from ohmskin.link.device import SILENCE_TIMEOUT_S, scans_for
from ohmskin.link.messages import Hello, Scan
from ohmskin.link.protocol import ENUMS, MODES, lines_of
from ohmskin.link.serial_port import SerialPort, serial_ports

# How each board is flashed: avrdude's options, and its boot loaders by their names in PlatformIO,
# with their speeds [baud]. Nanos were sold with two boot loaders. Two attempts, of 5 s each, show
# that it is the other one; avrdude's ten would take a minute.
_BOARDS: Final = {
    "uno": ("-p atmega328p -c arduino", {"uno": 115200}),
    "nano": ("-p atmega328p -c arduino -x attempts=2", {"nano": 115200, "nano_old": 57600}),
    "megaatmega2560": ("-p atmega2560 -c wiring", {"megaatmega2560": 115200}),
}
# What avrdude says, of all that it and PlatformIO do, where no boot loader answers.
_NO_ANSWER: Final = ("not in sync", "not respond", "unable to open programmer", "timeout communi")
_ROOT: Final = Path(__file__).parents[3]
_FIRMWARE: Final = Path(__file__).parents[1] / "firmware"  # there is none but in a wheel
# Time between two tries to open a board that was flashed [s]. Chosen: short beside the 3 s that it
# may be in its boot loader.
_RETRY_S: Final = 0.2

# More ohms a segment, or a lead, are no yarn's: somebody has told another unit. Chosen.
MOST_TOLD_OHM: Final = 1e5

# Where commands print what people read. No line is broken, so that a pipe gets messages whole.
TERMINAL: Final = Terminal(soft_wrap=True)

Port = Annotated[str, Argument(envvar="OHMSKIN_PORT", help="serial port or URL")]
Wires = Annotated[str, Option(help="nominal ohms of a wire segment, TOP,BOTTOM: 100,200")]
Leads = Annotated[
    float | None,
    Option(help="nominal ohms from the multiplexer to a line's first crossing; 0: none"),
]
REF_STD: Final = Option(min=0, max=1, help="how well the references are known: 0.05 is 5 %")

Scans = Annotated[int, Option(min=0, help="stop after so many; 0: never")]
Seconds = Annotated[float, Option(min=0, help="stop after so long; 0: never")]


def asked_for(scans: Iterable[Scan], count: int, seconds: float) -> Iterator[Scan]:
    """The scans that the options `Scans` and `Seconds` ask for."""
    return islice(scans_for(scans, seconds or math.inf), min(count, sys.maxsize) or None)


def warn_of_touched(board: Hello, rest_ratio: Float) -> None:
    """Say which cells seem touched in what was measured as the rest, (R, C, 4), if any do."""
    touched = touched_at_rest(SkinKnowledge.of(board, rest_ratio))
    if touched.any():
        text = f"{touched_cells(touched)} at rest: if something is on the skin, take it off, and"
        print(f"{text} begin anew", file=sys.stderr)  # noqa: T201


def wires_of(text: str, lead_ohm: float | None) -> WireOhm:
    """What `--wires` and `--leads` say; nothing: they are not known."""
    try:
        top, bottom = map(float, text.split(",")) if text else (None, None)
    except ValueError:
        raise ValueError(f"--wires wants two numbers, as 100,200, not '{text}'") from None
    for option, ohm in (("--wires", top), ("--wires", bottom), ("--leads", lead_ohm)):
        if ohm is not None and not 0 <= ohm <= MOST_TOLD_OHM:
            raise ValueError(f"{option} says {ohm:g} ohm: from 0 to {MOST_TOLD_OHM:g} are likely")
    return WireOhm(top, bottom, lead_ohm)


def line_name(line: int, rows: int) -> str:
    """What a line is called of which columns follow the rows."""
    return f"row {line}" if line < rows else f"column {line - rows}"


def own_leads_in_words(calibration: Calibration) -> str:
    """Which lines have a lead of their own, and how much more than others; empty if none has."""
    own_ohm = calibration.own_lead_ohm
    if own_ohm is None:
        return ""
    odd = [
        f"{line_name(line, calibration.rows)} {own_ohm[line]:+.0f} ohm"
        for line in np.flatnonzero(own_ohm).tolist()
    ]
    return f"leads unlike the others': {', '.join(odd)}"


def ports(as_json: Annotated[bool, Option("--json", help="one JSON array")] = False) -> None:
    """List serial ports, and the kinds of ports that need no board."""
    there = serial_ports()
    if as_json:
        print(json.dumps([asdict(port) for port in there]))  # noqa: T201
        return
    table = Table("port", "board", "description", box=None)
    for port in there:
        table.add_row(port.path, port.board or "?", port.description)
    TERMINAL.print(table if there else "no serial ports: is the board plugged in?")
    TERMINAL.print(
        "without a board: emulator://8x8?scene=ghost, simavr://uno?scene=ghost, replay://FILE.mcap"
    )
    TERMINAL.print("of another computer: socket://robot:4000, rfc2217://robot:4000")


def info(
    port: Port,
    as_json: Annotated[bool, Option("--json", help="one JSON object")] = False,
    self_test: Annotated[bool, Option("--self-test", help="also test the board itself")] = False,
) -> None:
    """Say what board is at PORT and how it scans."""
    with ohmskin.open(port, start=False) as skin:
        board = skin.info
        tested = skin.self_test() if self_test else None
    findings = tested.findings if tested else ()
    if as_json:
        facts: dict[str, Any] = {**asdict(board), "rate_hz": round(board.rate_hz, 4)}
        print(json.dumps(facts | (asdict(tested) if tested else {})))  # noqa: T201
        raise SystemExit(bool(findings))
    table = Table(box=None, show_header=False)
    for name, text in _board_in_words(board).items():
        table.add_row(name, text)
    if tested is not None:
        ranges = zip("abcdefgh", tested.code_min, tested.code_max, strict=True)
        taken = {name: f"{low} to {high}" for name, low, high in ranges if low <= high}
        table.add_row("codes", ", ".join(f"{n.upper()} {codes}" for n, codes in taken.items()))
        all_came = {*MODES["near"], *MODES[board.mode]} <= taken.keys()
        none = "none" if all_came else "none, but other readings came too late to be judged"
        table.add_row("findings", ", ".join(findings) or none)
    TERMINAL.print(table)
    if not board.is_whole:
        TERMINAL.print(of_a_region(board))
    for finding in findings:
        doc = ENUMS["finding"].docs.get(finding, "a finding of a newer firmware")
        TERMINAL.print(Text(finding, "red") + f": {doc}")
    if findings:
        raise SystemExit(1)


def of_a_region(board: Hello) -> str:
    """What is said of a board that does not scan all cells, and how it does again."""
    options = f"--rows {board.rows} --columns {board.columns}"
    if board.mode not in ("near", "far"):
        options += " --mode near"
    if board.rate_asked_mhz > 1000 * DEFAULT_RATE_HZ:
        options += " --rate 0"
    return f"not all cells are scanned: 'ohmskin configure PORT {options} --save' changes that"


def _board_in_words(board: Hello) -> dict[str, str]:
    """What a board says of itself, in people's units, by what it is called."""
    rate = f"{1e-3 * board.rate_asked_mhz:.2f} Hz" if board.rate_asked_mhz else "the fastest"
    rows = " ".join(map(str, lines_of(board.row_mask, board.rows)))
    columns = " ".join(map(str, lines_of(board.column_mask, board.columns)))
    region = "all cells" if board.is_whole else f"rows {rows}, columns {columns}"
    if board.whole_every:
        region += f"; one scan in {board.whole_every} is of all, in mode {board.whole_mode}"
    kept = f"{board.rate_hz:.2f} Hz"
    if board.whole_every and board.whole_scan_cycles:
        cycles = (board.whole_every - 1) * board.scan_cycles + board.whole_scan_cycles
        made_hz = board.whole_every * board.clock_hz / cycles
        kept += f" between whole scans, {made_hz:.2f} Hz with them"
    us = board.settle_asked_us
    settle = f"{us} us" if us else "as long as the rate allows"
    return {
        "board": f"{board.board}, firmware {board.version}, layout 0x{board.layout_crc:04X}",
        "wiring": f"another one, 0x{board.wiring:04X}"
        if board.wiring
        else "as docs/build.md has it",
        "unit id": str(board.unit_id),
        "cells": f"{board.rows} rows, {board.columns} columns",
        "region": region,
        "mode": f"{board.mode}: readings {' '.join(MODES[board.mode])} of each cell",
        "rate": f"{kept} (asked: {rate})",
        "settle time": f"{board.settle_us} us or more (asked: {settle})",
        "converter": f"{board.adc_bits} bits, {board.accuracy}",
        "references": f"{board.ref_top_ohm} Ohm top, {board.ref_bottom_ohm} Ohm bottom",
        "line": f"{board.baud} baud",
        "settings": ENUMS["settings"].docs.get(board.settings, board.settings),
        "last reset": ", ".join(board.reset_cause) or "of no known cause",
    }


def configure(
    port: Port,
    rows: Annotated[int | None, Option(help="rows to scan, 1 to 16; on a wide Mega, to 32")] = None,
    columns: Annotated[
        int | None, Option(help="columns to scan, 1 to 16; on a wide Mega, to 32")
    ] = None,
    rate_hz: Annotated[float | None, Option("--rate", help="scans a second; 0: the most")] = None,
    settle_us: Annotated[
        int | None, Option("--settle", help="least settle time in us; 0: as long as the rate lets")
    ] = None,
    accuracy: Annotated[
        str | None, Option("--adc", help=" | ".join(ENUMS["accuracy"].values))
    ] = None,
    mode: Annotated[str | None, Option(help=" | ".join(MODES))] = None,
    unit_id: Annotated[int | None, Option(help="name this skin")] = None,
    defaults: Annotated[bool, Option("--defaults", help="return to these first")] = False,
    save: Annotated[bool, Option("--save", help="keep it in the board's EEPROM")] = False,
) -> None:
    """Change how the board scans, until its reset or for good (--save)."""
    with ohmskin.open(port, start=False) as skin:
        if defaults:
            skin.load_defaults()
        now = skin.configure(
            rows=rows,
            columns=columns,
            rate_hz=rate_hz,
            settle_us=settle_us,
            accuracy=accuracy,
            mode=mode,
        )
        if unit_id is not None:
            skin.set_unit_id(unit_id)
        if save:
            skin.save()
    part = "" if now.is_whole else ", a region of it (see 'ohmskin info'),"
    done = f"{now.rows}x{now.columns}{part} at {now.rate_hz:.2f} Hz, mode {now.mode}, settle time "
    kept = "saved" if save else "until its next reset"
    TERMINAL.print(f"{done}{now.settle_us} us or more, {kept}")


def flash(
    board: Annotated[str, Argument(help=" | ".join((*_BOARDS, "pico")))] = "",
    port: Annotated[str, Option(help="serial port of the board; of a Pico, its drive")] = "",
) -> None:
    """Write the firmware to a board, and check that it answers.

    In a checkout, PlatformIO builds it; an installed wheel has it, and needs avrdude. Without
    arguments: to the one board that is attached. A Pico is plugged in while its button BOOTSEL is
    held; nobody has tried that yet.
    """
    if board == "pico":
        built = _ROOT / "firmware" / "pico" / "build" / "ohmskin.uf2"
        firmware = built if (_ROOT / "platformio.ini").is_file() else _FIRMWARE / "pico.uf2"
        TERMINAL.print(f"copied to {pico.copy_firmware(firmware, port)}")
        port, hello = _answer(pico.port_of_pico, pico.APPEARS_S)
        TERMINAL.print(f"{port}: pico, firmware {hello.version}, answers")
        return
    board, port = _chosen(board, port, serial_ports())
    packages = _ROOT / ".pio" / "core"  # where `make setup` puts them
    environment = {"PLATFORMIO_CORE_DIR": str(packages)} if packages.is_dir() else {}
    for baud, command in _uploads(board, port).items():
        TERMINAL.print(f"flashing {board} at {port}, {baud} baud")
        call = partial(subprocess.run, command, env=environment | os.environ, text=True)
        done = call(stdout=subprocess.PIPE, stderr=subprocess.STDOUT, errors="replace")
        if not done.returncode:
            break
    else:
        if any(words in done.stdout for words in _NO_ANSWER):
            hint = f"is it a {board}, does no other program have its port, is its cable whole?"
            raise OhmskinError(f"no boot loader answers at {port}: {hint}")
        TERMINAL.print(done.stdout)
        raise OhmskinError(f"flashing {board} at {port} failed: the lines above say why")
    port, hello = _answer(lambda: port, SILENCE_TIMEOUT_S)
    if hello.board != ("uno" if board == "nano" else board):  # the same chip, and the same wiring
        raise OhmskinError(f"{port} answers as '{hello.board}', not as {board}: flash that one")
    TERMINAL.print(f"{port}: {board}, firmware {hello.version}, answers")


def _uploads(board: str, port: str) -> dict[int, list[str]]:
    """The commands that may flash a board, by the speed of the boot loader that they try [baud]."""
    options, loaders = _BOARDS[board]
    if (_ROOT / "platformio.ini").is_file():
        pio = shutil.which("pio", path=str(Path(sys.executable).parent)) or shutil.which("pio")
        if pio is None:
            raise OhmskinError("no PlatformIO: run pip install '.[flash]' in the checkout")
        upload = [pio, "run", "-d", str(_ROOT), "-t", "upload", "--upload-port", port, "-e"]
        return {baud: [*upload, name] for name, baud in loaders.items()}
    firmware, avrdude = _FIRMWARE / f"{board}.hex", shutil.which("avrdude")
    if not firmware.is_file():
        raise OhmskinError("no firmware is in this package: take the wheel of 'make wheel'")
    if avrdude is None:
        raise OhmskinError(
            "no avrdude: apt install avrdude, brew install avrdude, or the Arduino IDE's on PATH"
        )
    config = Path(avrdude).parents[1] / "etc" / "avrdude.conf"  # the Arduino IDE's: it must be told
    upload = [avrdude, *(["-C", str(config)] if config.is_file() else []), *options.split()]
    upload += ["-D", "-P", port, "-U", f"flash:w:{firmware}:i", "-b"]
    return {baud: [*upload, str(baud)] for baud in loaders.values()}


def _chosen(board: str, port: str, attached: list[SerialPort]) -> tuple[str, str]:
    """The board and the port to flash, of which either may be empty where USB ids tell it.

    :raises PortError: it is not clear which board or which port is meant.
    """
    if "://" in port:
        raise PortError(f"flash takes no URL, but the port of a board: not {port}")
    if board and board not in _BOARDS:
        raise PortError(f"no board '{board}': there are {', '.join(_BOARDS)}")
    real = os.path.realpath(port)  # a link of udev's has no USB id of its own
    possible = [one for one in attached if not port or os.path.realpath(one.path) == real]
    if port and not possible and not os.path.exists(port):
        raise PortError(f"no port {port}", "'ohmskin ports' lists the ports there are")
    fitting = [one for one in possible if one.board in ((board,) if board else _BOARDS)]
    if len(fitting) == 1:
        return fitting[0].board, fitting[0].path
    if port and possible and (found := possible[0].board):
        what = f", not a {board}: say which you mean" if board else f": run 'ohmskin flash {found}'"
        raise PortError(f"{port} is a {found}{what}")
    if board and port:
        return board, port
    ports = ", ".join(f"{one.path} ({one.board or one.description or '?'})" for one in possible)
    raise PortError(
        f"{len(fitting) or 'no'} {board or 'known'} boards are found by their USB ids: say which "
        f"is where: ohmskin flash {' | '.join(_BOARDS)} --port PORT: {ports or 'there is no port'}"
    )


def _answer(find_port: Callable[[], str], seconds: float) -> tuple[str, Hello]:
    """The port of the flashed board, and what the board says of itself.

    seconds: how long it may take until the port is there, and the board answers [s].

    As after every reset, it is in its boot loader for up to 3 s, and its port may be gone
    meanwhile.
    """
    deadline_s = time.monotonic() + seconds
    while True:
        try:
            port = find_port()
            with ohmskin.open(port, start=False) as skin:
                return port, skin.info
        except (PortError, DeviceLost):
            if time.monotonic() > deadline_s:
                raise
            time.sleep(_RETRY_S)
