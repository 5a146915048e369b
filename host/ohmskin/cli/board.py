# SPDX-License-Identifier: Apache-2.0
"""``ohmskin ports``, ``info`` and ``configure``: which boards there are, and how they scan."""

import json
from dataclasses import asdict
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

import ohmskin
from ohmskin.link.protocol import ENUMS
from ohmskin.link.serial_port import serial_ports

_out = Console()

Port = Annotated[str, typer.Argument(help="serial port or URL; 'ohmskin ports' lists them")]


def ports(as_json: Annotated[bool, typer.Option("--json", help="one JSON array")] = False) -> None:
    """List the serial ports of this machine, and the kinds of ports that need no board."""
    found = serial_ports()
    if as_json:
        print(json.dumps([asdict(port) for port in found]))  # noqa: T201
        return
    table = Table(box=None)
    for heading in ("port", "board", "description"):
        table.add_column(heading)
    for port in found:
        table.add_row(port.path, port.board or "?", port.description)
    _out.print(table if found else "no serial ports: is the board plugged in?")
    _out.print(
        "without a board: emulator://8x8?scene=ghost, simavr://uno?scene=ghost, replay://FILE.mcap"
    )


def info(
    port: Port,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object")] = False,
    self_test: Annotated[
        bool, typer.Option("--self-test", help="also test sense nodes and reference resistors")
    ] = False,
) -> None:
    """Say what board is at PORT and how it scans."""
    with ohmskin.open(port, start=False) as skin:
        facts: dict[str, Any] = {**asdict(skin.info), "rate_hz": round(skin.info.rate_hz, 4)}
        if self_test:
            facts.update(asdict(skin.self_test()))
    if as_json:
        print(json.dumps(facts))  # noqa: T201
        return
    table = Table(box=None, show_header=False)
    for name, value in facts.items():
        table.add_row(name, _text(name, value))
    _out.print(table)
    for finding in facts.get("findings", ()):
        _out.print(f"[red]{finding}[/]: {ENUMS['finding'].docs[finding]}")
    if facts.get("findings"):
        raise SystemExit(1)


def _text(name: str, value: object) -> str:
    if name == "layout_crc":
        return f"0x{value:04X}"
    if isinstance(value, tuple):
        return ", ".join(map(str, value)) or "none"
    return str(value)


def configure(
    port: Port,
    rows: Annotated[int | None, typer.Option(help="rows to scan, 1 to 16")] = None,
    columns: Annotated[int | None, typer.Option(help="columns to scan, 1 to 16")] = None,
    rate_hz: Annotated[
        float | None, typer.Option("--rate", help="scans a second; 0: as fast as possible")
    ] = None,
    settle_us: Annotated[
        int | None,
        typer.Option("--settle", help="least settle time in us; 0: as long as the rate allows"),
    ] = None,
    adc_prescaler: Annotated[
        str | None, typer.Option("--adc", help=" | ".join(ENUMS["adc_prescaler"].values))
    ] = None,
    unit_id: Annotated[int | None, typer.Option(help="name this skin")] = None,
    defaults: Annotated[bool, typer.Option(help="return to the defaults first")] = False,
    save: Annotated[bool, typer.Option(help="keep it in the board's EEPROM")] = False,
) -> None:
    """Change how the board scans; what is not given stays. Lasts until its reset, or --save."""
    with ohmskin.open(port, start=False) as skin:
        if defaults:
            skin.load_defaults()
        now = skin.configure(
            rows=rows,
            columns=columns,
            rate_hz=rate_hz,
            settle_us=settle_us,
            adc_prescaler=adc_prescaler,
        )
        if unit_id is not None:
            skin.set_unit_id(unit_id)
        if save:
            skin.save()
    _out.print(
        f"{now.rows}x{now.columns} at {now.rate_hz:.2f} Hz, settle time {now.settle_us} us or more"
        f"{', saved' if save else ', until its next reset'}"
    )
