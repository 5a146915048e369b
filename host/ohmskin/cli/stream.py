# SPDX-License-Identifier: Apache-2.0
"""``ohmskin stream``: the skin at a port, live in a terminal or as JSON."""

import json
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text
from typer import Option

import ohmskin
from ohmskin.arrays import FULL_SCALE_N, FULL_SCALE_USIEMENS, Float, numbers, shades
from ohmskin.cli.board import (
    REF_STD,
    Port,
    Scans,
    Seconds,
    asked_for,
    of_a_region,
    warn_of_touched,
)
from ohmskin.cli.terminal import Terminal
from ohmskin.ctrl_c import ends_by_ctrl_c, ends_in_time
from ohmskin.estimate.base import ASSUMED, ASSUMED_WIRES
from ohmskin.estimate.knowledge import REF_LOG_STD
from ohmskin.estimate.methods import METHODS
from ohmskin.force.calibration import load_calibration
from ohmskin.force.contacts import found
from ohmskin.force.reader import ForceScan, SkinReader
from ohmskin.link.device import Device
from ohmskin.link.messages import Scan
from ohmskin.record.replay import Replay

_out = Terminal()
# For tables in a file or pipe, which have no width: 16 columns, or three tables of 8 side by side.
WIDE: Final = Terminal(width=160)
# An untouched cell shows its force, and no "?", if its standard deviation is at most this [N].
# Chosen: the page's scale of forces begins there.
KNOWN_N: Final = 0.1
_COLOURS: Final = ("grey50", "cyan", "green", "yellow", "red")
# Time between two pictures in a terminal [s]. Chosen: an estimate takes time, and nobody reads more
# numbers. Scans in between are counted, and not estimated.
DISPLAY_EVERY_S: Final = 0.1
# Time between two pictures in a file or a pipe [s]. Chosen: pictures are kept there, and ten times
# fewer can still be read.
_PRINT_EVERY_S: Final = 1.0
# What --json tells of an estimate, and of a contact; and where a contact is, if anybody knows.
_OF_ESTIMATE: Final = ("cell_siemens", "cell_siemens_std", "converged", "message", "wires")
_OF_CONTACT: Final = ("identity", "row", "column", "force_n", "force_n_std")
_OF_PLACE: Final = ("position_m", "normal")


def stream(
    port: Port,
    method: Annotated[
        str, Option(help=f"none | {' | '.join(METHODS)}; default: joint, or the calibration's")
    ] = "",
    calibration: Annotated[
        Path | None, Option(envvar="OHMSKIN_CALIBRATION", help="file (.json): show forces")
    ] = None,
    force: Annotated[bool, Option("--force", help="take that of another unit")] = False,
    tare_s: Annotated[float, Option("--tare", min=0, help="touch nothing for so long, in s")] = 0.0,
    ref_std: Annotated[float, REF_STD] = REF_LOG_STD,
    focus: Annotated[
        bool, Option("--focus", help="read contacts often, the rest now and then")
    ] = False,
    as_json: Annotated[bool, Option("--json", help="one JSON object a scan")] = False,
    scans: Scans = 0,
    seconds: Seconds = 0.0,
) -> None:
    """Show the skin at PORT, live, or print every scan as JSON. Ctrl-C ends it."""
    if method not in ("", "none", *METHODS):
        raise ValueError(f"no method '{method}': there are none, {', '.join(METHODS)}")
    if method and str(calibration) == os.environ.get("OHMSKIN_CALIBRATION"):
        calibration = None  # an option of the command counts more than the environment
    if method and calibration is not None:
        raise ValueError("say either --method or --calibration: a calibration has its own method")
    if method == "none" and focus:
        raise ValueError("--focus follows what an estimate shows: leave out --method none")
    if method == "none" and tare_s:
        raise ValueError("--tare is the rest of an estimate: leave out --method none")
    loaded = None if calibration is None else load_calibration(calibration)
    with ohmskin.open(port) as skin, ExitStack() as stack:
        reader = None
        if method != "none":
            reader = SkinReader(skin.info, loaded, method=method, force=force, ref_log_std=ref_std)
            skin.only_unit = None if loaded is None else skin.info.unit_id
            if tare_s:
                # Without a calibration the rest is unknown, and cells may seem touched.
                rest_ratio = skin.mean_ratio(tare_s)
                reader.tare(rest_ratio, force=loaded is None)
                if loaded is None:
                    warn_of_touched(skin.info, rest_ratio)
            if focus:
                reader.focus = stack.enter_context(reader.focus_on(skin))
        with ends_by_ctrl_c(), ends_in_time(_out.show_cursor):
            given = asked_for(skin, scans, seconds)
            if as_json:
                _print_scans(skin, reader, given)
            else:
                _show_scans(skin, reader, given)
    lost = skin.stats
    if isinstance(skin, Replay) and not lost.scans:
        raise ValueError(f"{skin.name}: no scan in it")
    if lost.missed or lost.line.damaged or lost.restarts:
        text = f"missed {lost.missed} scans ({lost.dropped_by_board} dropped by the board), "
        text += f"{lost.line.damaged} damaged frames, {lost.restarts} restarts"
        print(text, file=sys.stderr)  # noqa: T201


def _print_scans(skin: Device, reader: SkinReader | None, scans: Iterator[Scan]) -> None:
    for scan in scans:
        line: dict[str, Any] = {
            "scan": scan.number,
            "time_us": scan.time_us,
            "time_ns": scan.time_ns,
            "host_time_s": round(scan.host_time_s, 6),
            "missed": scan.missed,
            "reading_names": scan.reading_names,
            "ratio": scan.ratio,
        }
        if reader is not None:
            shown = reader.read(scan)
            line["method"] = reader.method
            line |= {name: getattr(shown.estimate, name) for name in _OF_ESTIMATE}
            if reader.has_forces:
                line |= {"force_n": shown.force_n, "force_n_std": shown.force_n_std}
                names = _OF_CONTACT if shown.geometry is None else _OF_CONTACT + _OF_PLACE
                line["contacts"] = [
                    {name: numbers(getattr(contact, name)) for name in names}
                    for contact in shown.contacts
                ]
                if shown.geometry is not None:
                    line["net_force_n"], line["net_torque_nm"] = shown.wrench
                if skin.true_force_n is not None:
                    line["true_force_n"] = skin.true_force_n(scan)
        try:
            print(json.dumps(line, default=numbers), flush=True)  # noqa: T201
        except BrokenPipeError:
            # The reader, such as `head`, has had enough. Python writes what is left when it ends.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return


def _show_scans(skin: Device, reader: SkinReader | None, scans: Iterator[Scan]) -> None:
    drawn_s = float("-inf")  # a skin in stepped time begins at 0
    live = Live(console=_out, auto_refresh=False) if _out.is_terminal else None
    reads_all = reader is not None and reader.focus is not None
    is_due = True

    def draw(scan: Scan) -> None:
        picture = _picture(skin, reader, scan)
        if live:
            live.update(picture, refresh=True)
        else:
            WIDE.print(picture)

    with live or nullcontext():
        for scan in scans:
            is_due = scan.host_time_s - drawn_s >= (DISPLAY_EVERY_S if live else _PRINT_EVERY_S)
            # What a region shows depends on the scans before it, most of all on whole ones.
            reads_all = reads_all or not scan.is_whole
            if reader is not None and (is_due or reads_all):
                scan = reader.read(scan)
            if is_due:
                drawn_s = scan.host_time_s
                draw(scan)
        if isinstance(skin, Replay) and not is_due:  # a recording ends with its last scan
            draw(scan if reader is None or reads_all else reader.read(scan))


def _picture(skin: Device, reader: SkinReader | None, shown: Scan) -> Group:
    """A scan for people. shown: as the reader has read it, if there is one."""
    stats = skin.stats
    caption = (
        f"scan {shown.number}  {skin.info.rate_hz:.1f} Hz  missed {stats.missed}  "
        f"damaged {stats.line.damaged}  restarts {stats.restarts}"
    )
    follows = isinstance(skin, Replay) or (reader is not None and reader.focus is not None)
    if not (skin.info.is_whole or follows):
        caption += f"\n{of_a_region(skin.info)}"
    if reader is None or not isinstance(shown, ForceScan):
        title = f"{skin.name}: reading B in thousandths of Vdd"
        level = 1e3 * shown.ratio[:, :, shown.reading_names.index("b")]
        # Small readings are about as large, in these units, as conductances are in microsiemens.
        return Group(Text(title), coloured(level, FULL_SCALE_USIEMENS), Text(caption))
    if not shown.estimate.converged:
        caption += f"  not converged: {shown.estimate.message}"
    if shown.estimate.wires == ASSUMED:
        caption += f"\n{ASSUMED_WIRES}"
    if reader.has_forces:
        title = f"{skin.name}: force by '{reader.method}' [N], ?: uncertain"
        least_n = np.where(shown.estimate.touched, 0.0, KNOWN_N)
        known = shown.force_n_std <= np.maximum(shown.force_n, least_n)  # no NaN is
        table = coloured(np.where(known, shown.force_n, np.nan), FULL_SCALE_N)
        contacts = (
            f"contact {one.identity}: {one.force_text} at ({one.row:.1f}, {one.column:.1f})"
            for one in shown.contacts
        )
        lines = ["   ".join(contacts) or "no contact"]
        if skin.true_force_n is not None:
            true_n = skin.true_force_n(shown)[None]  # of one scan
            (truth,) = found(true_n > KNOWN_N, true_n, np.zeros_like(true_n))
            of_each = (f"{one.force_n:.2f} N at ({one.row:.1f}, {one.column:.1f})" for one in truth)
            lines.append(f"truth: {'   '.join(of_each) or 'no contact'}")
        caption = "\n".join([*lines, caption])
    else:
        title = f"{skin.name}: cell conductance by '{reader.method}' [microsiemens]"
        table = coloured(1e6 * shown.estimate.cell_siemens, FULL_SCALE_USIEMENS)
    return Group(Text(title), table, Text(caption))


def coloured(values: Float, full_scale: float, title: str = "") -> Table:
    """Values, shape (rows, columns), as a table, coloured on a scale that ends at `full_scale`."""
    last = len(_COLOURS) - 1
    colours = np.minimum((last + 1) * shades(values, full_scale), last).astype(int)
    texts = [
        [Text(_short(value), _COLOURS[colour]) for value, colour in zip(*row, strict=True)]
        for row in zip(values, colours, strict=True)
    ]
    return cell_table(texts, title)


def _short(value: float) -> str:
    if not np.isfinite(value):
        return "?"
    return f"{value:.1f}" if value < 9.95 else f"{value:.0f}"


def cell_table(cells: Sequence[Sequence[str | Text]], title: str) -> Table:
    """A text for each cell, row by row, beside the numbers of rows and columns."""
    # 16 rows of 16 cells of three characters fit into a terminal, with four lines beside them.
    table = Table(title=title, box=SIMPLE_HEAD, padding=0, show_edge=False)
    table.add_column("", justify="right", style="dim")
    for column in range(len(cells[0])):
        width = max(3, *(len(row[column]) for row in cells))
        table.add_column(str(column), justify="right", min_width=width, header_style="dim")
    for row, texts in enumerate(cells):
        table.add_row(str(row), *texts)
    return table
