# SPDX-License-Identifier: Apache-2.0
"""The words of ``ohmskin doctor``: of findings, of the wires, of what to press."""

from __future__ import annotations

from collections.abc import Iterable
from types import SimpleNamespace
from typing import Final, NamedTuple

from ohmskin.doctor.findings import Cell, Diagnosis, Finding, Kind, Wires, WireShare
from ohmskin.doctor.wires import CornerScans
from ohmskin.link.protocol import ENUMS

MOST_CELLS: Final = 6  # cells that are named one by one
_ANSWERS: Final = "a skin board that answers"
_CURRENT: Final = "a current at every cell, also of an untouched skin"
_CABLE: Final = "use another USB cable, without a hub, away from motors' cables"


class Words(NamedTuple):
    """What is told of a finding."""

    where: str
    measured: str
    expected: str
    what_to_do: str


def title(kind: Kind) -> str:
    """A kind in words."""
    return kind.id.replace("_", " ")


def verdict(diagnosis: Diagnosis) -> str:
    """One line: whether the skin is sound."""
    worse = diagnosis.worse
    if worse:
        first = f"{title(worse[0].kind)} ({words_of(worse[0]).where})"
        return f"not sound: {len(worse)} finding{'s' if len(worse) > 1 else ''}, first {first}"
    if any(finding.kind is Kind.TOUCHED for finding in diagnosis.findings):
        return "no fault found, but something touches the skin: let go, and run this again"
    if diagnosis.wires is not None and not diagnosis.wires.known:
        return "sound: nothing is wrong that an untouched skin shows; --press shows its wires"
    return "sound: nothing is wrong"


# ----------------------------------------------------------------------------- kind by kind


def words_of(finding: Finding) -> Words:
    """A finding in words."""
    v = SimpleNamespace(**finding.values)
    lines = finding.rows or finding.columns
    row = "row" if finding.rows else "column"
    where = place(finding.rows, finding.columns, finding.cells)
    match finding.kind:
        case Kind.PORT_UNUSABLE:
            return Words(v.port, v.problem, _ANSWERS, v.remedy or "check its cable and its name")
        case Kind.NOTHING_ANSWERS:
            return Words(
                v.port,
                f"nothing answers: {v.problem}",
                _ANSWERS,
                "check the cable and the port; flash the board with 'ohmskin flash'",
            )
        case Kind.PROTOCOL_MISMATCH:
            return Words(v.port, v.problem, "one protocol layout", v.remedy)
        case Kind.LOST:
            return Words(
                "board",
                v.problem,
                "a board that goes on scanning",
                "check the USB cable and plug, and that the supply is strong enough",
            )
        case Kind.SELF_TEST:
            side, _, fault = v.name.partition("_")
            doc = ENUMS["finding"].docs.get(v.name, "a finding of a newer firmware")
            return Words(
                f"{side} sense node",
                f"{v.name}: {doc}; codes {v.code_min} to {v.code_max}",
                "nothing that no skin can cause",
                f"look for a {_SELF_TEST_CAUSES.get(fault, 'fault of the board')}",
            )
        case Kind.NOTHING_CONDUCTS:
            return Words(
                "every row and column" if v.cell_count > 1 else _ONLY_CELL,
                "no current at any cell",
                _CURRENT,
                "plug in the skin's connectors; check the wires from the multiplexers' common pins",
            )
        case Kind.OPEN_ROW | Kind.OPEN_COLUMN:
            # Lines beyond the skin look open, too.
            beyond = lines == tuple(range(lines[0], v.line_count))
            size = f"; if the skin has no {where}: 'ohmskin configure PORT --{row}s {lines[0]}'"
            return Words(
                where + ("" if v.cells_per_line > 1 else " (or the only cell there is dead)"),
                f"no current at any cell of {where}",
                _CURRENT,
                f"check connector, crimp and solder joint of {where}, then the multiplexer's "
                f"inputs{size if beyond else ''}",
            )
        case Kind.SHORT_ROWS | Kind.SHORT_COLUMNS:
            joined = f"{row}s {' and '.join(map(str, lines))}"
            return Words(
                joined,
                f"{joined} read alike at every cell, and conduct as one",
                "every line has readings of its own",
                f"look for yarn, solder or a wire strand that joins {joined}, at the seam and in "
                "the connector first",
            )
        case Kind.DEAD_CELL:
            return Words(
                where,
                f"{100 * v.share_of_usual:.0f} % of the other cells' conductance or less",
                "cells at rest conduct alike",
                "the layers do not meet there: look for a torn stripe or a seam that holds them "
                "apart",
            )
        case Kind.SATURATED_CELL:
            return Words(
                where,
                f"{v.cell_ohm:.0f} ohm with its wires: the layers are joined",
                f"about {1e-6 * v.rest_ohm:.2g} MOhm at rest",
                "make sure that nothing presses there; then look for yarn or metal through both "
                "layers, or a row that touches a column",
            )
        case Kind.REFERENCE_RATIO:
            nominal = v.ref_top_ohm / v.ref_bottom_ohm
            percent = 100 * (v.ratio / nominal - 1)
            top, bottom = ("large", "small") if percent > 0 else ("small", "large")
            return Words(
                "reference resistors",
                f"top / bottom = {v.ratio:.3f}, {percent:+.1f} % off",
                f"{nominal:.3f}: {v.ref_top_ohm} and {v.ref_bottom_ohm} ohm",
                "measure both with a meter, skin unplugged: the top one is "
                f"{abs(percent):.1f} % too {top}, or the bottom one too {bottom}",
            )
        case Kind.SETTLING:
            return Words(
                where,
                f"readings change by up to {v.change_lsb:.0f} LSB when {v.settle_us} us of "
                f"settling become {v.longer_us} us",
                f"no change by more than {v.most_lsb:.0f} LSB",
                "shorter wires settle sooner; else wait longer, and scan as fast as that lets: "
                f"'ohmskin configure PORT --settle {v.needed_us} --rate 0', then run this again",
            )
        case Kind.RESET_CAUSE:
            return Words(
                "board",
                f"its last reset was by {v.cause.replace('_', '-')}",
                "power-on or the reset pin",
                _BAD_RESETS[v.cause],
            )
        case Kind.RESTARTED:
            causes = ", ".join(v.causes) or "unknown"
            return Words(
                "board",
                f"{v.restarts} restarts meanwhile, the last by: {causes}",
                "none",
                "check the USB cable and the supply; close programs that open the port as well",
            )
        case Kind.LOSS if not v.missed:
            return Words(
                "line",
                f"only {v.received} scans came",
                f"{v.rate_hz:.1f} a second",
                "check the cable, and that no other program uses the port",
            )
        case Kind.LOSS:
            return Words(
                "line",
                f"{v.missed} of {v.made} scans missing, {v.dropped_by_board} of them dropped by "
                "the board",
                "every scan",
                "lower the scan rate, or raise the line's speed (?baud=1000000 behind the port)"
                if v.dropped_by_board
                else "use a shorter cable and no hub; close programs that keep this machine busy",
            )
        case Kind.DAMAGED:
            frames = f"{v.damaged} damaged frames ({v.crc_errors} wrong CRCs)"
            return Words("line", frames, "none", _CABLE)
        case Kind.RECEIVE_ERRORS:
            return Words("line", f"the board got {v.commands} damaged commands", "none", _CABLE)
        case Kind.RATE:
            return Words(
                "board",
                f"{v.rate_hz:.2f} scans/s by the board's clock",
                f"{v.asked_hz:.2f} scans/s",
                "the firmware does not keep its rate: write it anew with 'ohmskin flash'",
            )
        case Kind.HUM:
            mains = " or ".join(f"{hz:.0f} Hz" for hz in v.mains_hz)
            return Words(
                f"most at {where}" if finding.cells else where,
                f"{mains} of amplitude {v.amplitude_lsb:.1f} LSB; at {v.rate_hz:.1f} scans/s it "
                f"looks like {v.seen_hz:.1f} Hz",
                f"below {v.most_lsb} LSB",
                "ground the robot and the board together, keep the skin's wires short and away "
                "from mains cables, run a laptop from its battery to compare",
            )
        case Kind.NOISE:
            return Words(
                where,
                f"{v.noise_lsb:.2f} LSB a reading",
                f"{v.sound_lsb:.2f} LSB: rounding and {v.adc_lsb} LSB of the converter",
                f"check the contacts of {where}: loose ones are noisy"
                if lines or finding.cells
                else "power the board from a clean supply with its capacitors, shorten the skin's "
                "wires, keep motors' cables away; loose contacts are noisy too",
            )
        case Kind.WIRES:
            nominal = [getattr(v, f"{layer}_ohm") for layer in v.layers]
            both = len(nominal) > 1
            return Words(
                where if lines else _LAYERS[v.layers],
                _share_of_both(v.share, v.share_std, *nominal)
                if both
                else f"{_segment(v.share, v.share_std, nominal[0])}, {v.share:.2f} times nominal",
                f"{_tops(*nominal) if both else f'{nominal[0]:.0f}'} ohm a segment",
                "is the skin stretched or bent, a stripe worn or a crimp loose? If it is to stay "
                "so, calibrate anew",
            )
        case Kind.TOUCHED:
            return Words(
                where,
                "readings move" if v.moves else "conducts as if pressed",
                "nothing touches the skin meanwhile",
                "let go and run this again; if nothing is on the skin, look for what presses it "
                "there: a fold, a cable, a seam that is too tight",
            )
        case Kind.VERSION:
            return Words(
                "firmware",
                f"firmware {v.firmware}, host {v.host}",
                "the same version; they do speak the same protocol",
                "'ohmskin flash' writes the firmware of this host",
            )
        case Kind.USB_LATENCY:
            return Words(
                "USB bridge",
                f"latency timer {v.timer_ms} ms: scans may come so much later",
                "1 ms",
                f"echo 1 | sudo tee {v.file} (lasts until it is unplugged; a udev rule lasts)",
            )
        case Kind.SLOW_HOST:
            return Words(
                "host",
                f"{v.host_rate_hz:.1f} scans/s come by this machine's clock",
                f"{v.rate_hz:.1f} scans/s",
                "close what keeps this machine busy; else the board's clock is off",
            )


_ONLY_CELL: Final = "the only cell, its row or its column"
_SELF_TEST_CAUSES: Final = {
    "stuck_low": "short to ground",
    "stuck_high": "short to Vdd",
    "reference_missing": "reference resistor or drive wire that is open",
}
_BAD_RESETS: Final = {
    "brown_out": "the supply dipped: power the board from another port or a stronger supply, and "
    "nothing else from its 5 V pin",
    "watchdog": "the firmware hung: write it anew with 'ohmskin flash', and report it",
}
_LAYERS: Final = {
    ("top",): "all rows (top layer)",
    ("bottom",): "all columns (bottom layer)",
    ("top", "bottom"): "rows and columns",
}


def place(rows: Iterable[int], columns: Iterable[int], cells: Iterable[Cell]) -> str:
    """Lines and cells by name; the whole skin if there are none."""
    places = [f"({row}, {column})" for row, column in cells]
    more = f" and {len(places) - MOST_CELLS} more" if len(places) > MOST_CELLS else ""
    parts = []
    for what, each in (("row", rows), ("column", columns), ("cell", places[:MOST_CELLS])):
        names = [str(name) for name in each]
        if names:
            parts.append(f"{what}{'s' if len(names) > 1 else ''} {', '.join(names)}")
    return ", ".join(parts) + more if parts else "whole skin"


# ----------------------------------------------------------------------- wires, what to press

_UNTOUCHED: Final = "not known: an untouched skin hides its wires, --press asks for touches"
_NOT_PRESSED: Final = "not known: no three corners of a rectangle were pressed"
_WIDE: Final = "not known: press with something smaller than a cell, further apart"


def wires_in_words(wires: Wires) -> tuple[str, list[str]]:
    """The wires of the layers, and those of each line that was measured."""
    lines = [f"{_lines(each)}: {each.share:.2f} +- {each.std:.2f}" for each in wires.untouched[2:]]
    if wires.pressed is None:
        layers = [
            f"{each.layers[0]} {_segment(each.share, each.std, ohm)}"
            for each, ohm in zip(wires.untouched, wires.nominal_ohm, strict=False)
            if each.known
        ]
        return "; ".join(layers) or _UNTOUCHED, lines
    if not wires.pressed:
        return _NOT_PRESSED, lines
    together, *each_pair = wires.pressed
    lines += [
        f"{_lines(each)}: {_times(each.share, each.std) if each.known else _WIDE}"
        for each in each_pair
    ]
    if not together.known:
        return _WIDE, lines
    return _share_of_both(together.share, together.std, *wires.nominal_ohm), lines


def _lines(share: WireShare) -> str:
    return place(share.rows, share.columns, ())


def _segment(share: float, std: float, nominal_ohm: float) -> str:
    return f"{share * nominal_ohm:.0f} +- {std * nominal_ohm:.0f} ohm a segment"


def _times(share: float, std: float) -> str:
    return f"{share:.2f} +- {std:.2f} times nominal"


def _tops(top_ohm: float, bottom_ohm: float) -> str:
    return f"top {top_ohm:.0f}, bottom {bottom_ohm:.0f}"


def _share_of_both(share: float, std: float, top_ohm: float, bottom_ohm: float) -> str:
    ohm = _tops(share * top_ohm, share * bottom_ohm)
    return f"{_times(share, std)}: {ohm} ohm a segment, if both changed alike"


def request(presses: CornerScans) -> str:
    """Where to press next."""
    cells = " ".join(map(str, sorted(presses.wanted)))
    return f"{'now' if presses.again else 'press firmly, at once:'} {cells}"


def answer(presses: CornerScans) -> str:
    """What is pressed meanwhile."""
    if presses.hold:
        return "hold still"
    return f"pressed: {' '.join(map(str, presses.pressed)) or 'nothing'}"
