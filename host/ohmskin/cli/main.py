# SPDX-License-Identifier: Apache-2.0
"""The command line: ``ohmskin --help``. An error is one line that says what to do, exit code 2."""

from __future__ import annotations

import json
import signal
import sys
from collections import Counter
from contextlib import ExitStack, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from threadpoolctl import threadpool_limits

import ohmskin
from ohmskin.cli import demo as demonstration
from ohmskin.cli import record as recordings
from ohmskin.cli import stream as streaming
from ohmskin.cli.calibrate import calibrate
from ohmskin.cli.doctor import doctor
from ohmskin.cli.flash import flash
from ohmskin.cli.tare import tare
from ohmskin.cli.view import view
from ohmskin.emulate.line_faults import FAULTS
from ohmskin.emulate.pty_server import PtyServer
from ohmskin.emulate.scenes import SCENES
from ohmskin.emulate.skin_faults import SKIN_FAULTS
from ohmskin.errors import OhmskinError
from ohmskin.estimate.methods import METHODS
from ohmskin.link.protocol import ENUMS
from ohmskin.link.serial_port import serial_ports
from ohmskin.opening import emulated
from ohmskin.record.readings import estimate_file, load_readings, save_arrays

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Reads resistive tactile skins: boards, scans, and the conductance of every cell.",
    epilog="PORT is a serial port (/dev/ttyACM0, COM3) or a URL: emulator://8x8?scene=ghost, "
    "simavr://uno?scene=ghost, replay://FILE.mcap?speed=1.",
)
_out = Console()
_MESSAGES = 8  # of different ones that are printed for a file
_WIDTH = 160

Port = Annotated[str, typer.Argument(help="serial port or URL; 'ohmskin ports' lists them")]


def main() -> None:
    """Run the command line; the process's exit code says how it went."""
    run(app, "ohmskin")


def run(commands: typer.Typer, program: str) -> None:
    """Run these commands. An error is one line that begins with the program's name."""
    try:
        # Matrices of a skin's size are slower on several threads.
        with threadpool_limits(limits=1):
            # Typer returns the code of an Exit, such as 130 for Ctrl-C.
            code = commands(prog_name=program, standalone_mode=False)
        if code:
            sys.exit(code)
    except (OhmskinError, ValueError, OSError) as exc:
        _fail(program, str(exc))
    except typer.Abort:
        sys.exit(130)
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as exc:
        if _is_ctrl_c(exc):
            sys.exit(130)
        if not hasattr(exc, "format_message"):
            raise
        if text := exc.format_message():  # a wrong use of the command line
            _fail(program, text)
        sys.exit(2)  # no command at all: the help is the answer


def _is_ctrl_c(exc: BaseException | None) -> bool:
    """Whether this is what became of Ctrl-C inside CasADi, which makes other errors of it."""
    while exc is not None:
        if isinstance(exc, KeyboardInterrupt) or "KeyboardInterrupt" in str(exc):
            return True
        exc = exc.__cause__ or exc.__context__
    return False


def _fail(program: str, text: str) -> None:
    print(f"{program}: {' '.join(text.split())}", file=sys.stderr)  # noqa: T201
    sys.exit(2)


# ------------------------------------------------------------------------------------- boards


@app.command()
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


@app.command()
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


@app.command()
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


app.command()(flash)

# -------------------------------------------------------------------------------------- scans

app.command()(streaming.stream)
app.command()(view)
app.command()(tare)
app.command()(doctor)
app.add_typer(calibrate, name="calibrate")


@app.command()
def estimate(
    readings: Annotated[Path, typer.Argument(help="readings file (.npz)")],
    method: Annotated[str, typer.Option(help=" | ".join(METHODS))],
    out: Annotated[Path, typer.Option(help="file to write (.npz)")],
    cold: Annotated[bool, typer.Option(help="start every frame afresh")] = False,
) -> None:
    """Estimate every cell of every frame of a readings file."""
    given = load_readings(readings)
    errors = Console(stderr=True)
    with Progress(console=errors, transient=True, disable=not errors.is_terminal) as progress:
        task = progress.add_task(method, total=len(given.ratio))

        def show_progress(done: int, _: int) -> None:
            progress.update(task, completed=done)

        answers = estimate_file(given, method, cold=cold, progress=show_progress)
    save_arrays(out, answers)
    frames = len(answers["converged"])
    _out.print(
        f"{out}: {frames} frames, {int(answers['converged'].sum())} converged, "
        f"median {1e3 * float(np.median(answers['seconds'])):.2f} ms a frame"
    )
    for message, count in Counter(answers["message"].tolist()).most_common(_MESSAGES):
        if message:
            _out.print(f"  {count} of {frames}: {message}")


app.command()(recordings.record)
app.command()(recordings.export)

# ---------------------------------------------------------------------------- without a board


@app.command(
    epilog=f"Scenes: {'; '.join(f'{k}: {v}' for k, v in SCENES.items())}. "
    f"Faults of the line: {'; '.join(f'{k}: {v}' for k, v in FAULTS.items())}. "
    f"Faults of the skin: {'; '.join(f'{k}: {v}' for k, v in SKIN_FAULTS.items())}."
)
def emulate(
    url: Annotated[str, typer.Argument(help="emulator://8x8?scene=ghost&seed=1")] = (
        "emulator://8x8?scene=ghost"
    ),
    link: Annotated[
        Path | None, typer.Option(help="also make this symbolic link to the pseudo-terminal")
    ] = None,
    seconds: Annotated[float, typer.Option(help="stop after so long; 0: never")] = 0.0,
) -> None:
    """Serve an emulated board at a pseudo-terminal, for any program. Ctrl-C ends it."""
    board, _, faults = emulated(url)
    with ExitStack() as stack:
        server = stack.enter_context(PtyServer(board, faults))
        if link is not None:
            if link.is_symlink():
                link.unlink()
            link.symlink_to(server.path)
            stack.callback(link.unlink, missing_ok=True)
        print(server.path, flush=True)  # noqa: T201
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # the link goes then, too
        with suppress(KeyboardInterrupt):
            server.serve(seconds or float("inf"))


@app.command()
def demo(
    seconds: Annotated[float, typer.Option(help="how long to scan")] = 3.0,
    port: Annotated[str, typer.Option(help="an emulator:// URL")] = demonstration.URL,
    picture: Annotated[Path, typer.Option(help="PNG to write")] = Path("ohmskin-demo.png"),
) -> None:
    """Scan an emulated skin, and show what a ghost is and how it goes. Needs no board."""
    result = demonstration.run(port, seconds)
    # Three tables stand side by side where nothing says how wide the output is.
    wide = Console(width=_WIDTH) if not _out.is_terminal else _out
    demonstration.report(result, wide)
    try:
        demonstration.save_picture(picture, result.panels, result.title)
    except OhmskinError as exc:
        _out.print(f"no picture: {exc}", markup=False)
    else:
        _out.print(f"picture: {picture}")
