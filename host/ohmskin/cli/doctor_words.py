# SPDX-License-Identifier: Apache-2.0
"""The words of ``ohmskin doctor``; those of each kind of finding are in ``doctor_words.toml``."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from ohmskin.doctor.findings import WHOLE_SKIN, Diagnosis, Finding, Kind, LineWire, Place, WireShare
from ohmskin.doctor.gather import Step
from ohmskin.doctor.limits import KNOWN_STD
from ohmskin.doctor.wires import CornerScans
from ohmskin.link.protocol import ENUMS

FIELDS: Final = ("where", "measured", "expected", "what_to_do")
# [cells] More cells are counted, and not named. Chosen: they fill a line of a terminal.
MOST_CELLS: Final = 6

_TABLES: Final = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
_UNTOUCHED: Final = "not known: an untouched skin hides its wires, --press asks for touches"
_NOT_PRESSED: Final = "not known: no three corners of a rectangle were pressed"
_LINES_DIFFER: Final = (
    "not known: the lines that were pressed differ: look at their crimps, calibrate anew"
)
_WIDE: Final = "not known: tell --leads, or press with what is smaller than a cell, further apart"


def words_of(finding: Finding) -> dict[str, str]:
    """What is told of a finding, by the names in `FIELDS`."""
    kind, place, values = finding.kind, finding.place, finding.values
    line, lines = ("row", place.rows) if place.rows else ("column", place.columns)
    words: dict[str, Any] = {"where": named(place), "one_place": place != WHOLE_SKIN, "line": line}
    words |= {"across": "column" if place.rows else "row", "joined": " and ".join(map(str, lines))}
    words |= {**values, **_words(kind, lines, values)}
    table = _TABLES[words.get("table", kind.id)]
    said = dict(table)
    for case in table.keys() - FIELDS:
        if words.get(case) or case in words.values():
            said |= table[case]
    return {field: said[field].format(**words) for field in FIELDS}


def _words(kind: Kind, lines: tuple[int, ...], values: Mapping[str, Any]) -> dict[str, Any]:
    """Words and cases of a kind of finding, about these lines, that its values do not have."""
    match kind:
        case Kind.SELF_TEST:
            side, _, fault = values["name"].replace("far_", "far ").partition("_")
            doc = ENUMS["finding"].docs.get(values["name"], "a finding of a newer firmware")
            return {"side": side, "fault": fault, "doc": doc}
        case Kind.OPEN_ROW | Kind.OPEN_COLUMN:
            # Lines beyond the skin look open, too.
            beyond = lines == tuple(range(lines[0], values["line_count"]))
            cases = {"one_cell": values["cells_per_line"] == 1, "last_lines": beyond}
            return {"table": "open", "first": lines[0], **cases}
        case Kind.SHORT_ROWS | Kind.SHORT_COLUMNS:
            return {"table": "short"}
        case Kind.REFERENCE_RATIO:
            return {"nominal_ratio": values["ref_top_ohm"] / values["ref_bottom_ohm"]}
        case Kind.OPEN_JOINT | Kind.BRIDGE | Kind.WRONG_RESISTOR:
            plate_ohm = values["plate_ohm"]
            return {"cell": kilohm(values["cell_ohm"]), "plate": plate_ohm and kilohm(plate_ohm)}
        case Kind.LINEARITY:
            bad = values["readings"]
            lines_said = (f"{name}: {line_in_words(values['lines'][name])}" for name in bad)
            return {"names": ", ".join(bad), "told": "; ".join(lines_said)}
        case Kind.ADC_NOISE:
            return {"told": ", ".join(f"{c}: {lsb:.2f} LSB" for c, lsb in values["clocks"].items())}
        case Kind.RESTARTED:
            return {"last": ", ".join(values["causes"]) or "unknown"}
        case Kind.LOSS:
            missed = values["missed"]
            return {"dropped": missed and values["dropped_by_board"], "few": not missed}
        case Kind.HUM:
            return {"mains": " or ".join(f"{hz:.0f} Hz" for hz in values["mains_hz"])}
        case Kind.LINE_WIRE:
            return {"negative": values["ohm"] < -2 * values["std_ohm"]}
        case Kind.WIRES:
            top, bottom = nominal_ohm = values["nominal_ohm"]
            return {"told": _ohm(values["share"], nominal_ohm), "top": top, "bottom": bottom}
    return {}


def kilohm(ohm: float) -> str:
    """A resistance with three digits or more."""
    return f"{ohm / 1e3:#.4g} kOhm"


def line_in_words(line: dict[str, float]) -> str:
    """The line that is fitted to the readings of a configuration."""
    text = "slope {slope:.4f}, offset {offset_lsb:+.2f} LSB, residual {residual_lsb:.2f} LSB"
    return text.format(**line)


def named(place: Place) -> str:
    """Lines and cells by name."""
    cells = [f"({row}, {column})" for row, column in place.cells]
    more = f" and {len(cells) - MOST_CELLS} more" if len(cells) > MOST_CELLS else ""
    names = {"row": place.rows, "column": place.columns, "cell": cells[:MOST_CELLS]}
    parts = []
    for what, several in names.items():
        if several:
            listed = ", ".join(map(str, several))
            parts.append(f"{what}{'s' if len(several) > 1 else ''} {listed}")
    return ", ".join(parts) + more if parts else "whole skin"


def verdict(diagnosis: Diagnosis) -> str:
    """One line: whether the skin is sound."""
    worse, notes = diagnosis.worse, len(diagnosis.findings) - len(diagnosis.worse)
    if worse:
        first = f"{worse[0].kind.id.replace('_', ' ')} ({words_of(worse[0])['where']})"
        counts = f"{len(worse)} finding{'s' if len(worse) > 1 else ''}"
        counts += f" and {notes} note{'s' if notes > 1 else ''}" if notes else ""
        return f"not sound: {counts}, first {first}"
    if any(finding.kind is Kind.TOUCHED for finding in diagnosis.findings):
        return "no fault found, but something touches the skin: let go, and run this again"
    if diagnosis.pressed == []:
        return "no fault found, but nobody pressed three corners of a rectangle: run this again"
    if diagnosis.pressed and diagnosis.wires_hidden:
        return "no fault found, but these presses do not show the wires: see 'wires'"
    pairs = [f"two {name}" for name in ("rows", "columns") if diagnosis.measured.get(name) == 2]
    hidden = f" ({' and '.join(pairs)} hardly show shorts and exchanged ends)" if pairs else ""
    if diagnosis.wires_hidden:
        is_line = 1 in (diagnosis.measured.get("rows"), diagnosis.measured.get("columns"))
        press = "" if is_line else "; --press shows its wires"
        return f"sound: nothing is wrong that an untouched skin shows{hidden}{press}"
    return f"sound: nothing is wrong{hidden}"


def measured_in_words(diagnosis: Diagnosis) -> dict[str, Any]:
    """The figures; and the wires in words, unless touches or faults hide them."""
    if diagnosis.nominal_ohm is None:
        return diagnosis.measured
    wires, pressed = _UNTOUCHED, diagnosis.pressed
    if pressed is not None:
        wires = _ohm(pressed[0], diagnosis.nominal_ohm) if pressed else _NOT_PRESSED
        if not (diagnosis.is_told or diagnosis.wires_hidden):
            wires += ". Nobody has told what is nominal: say --wires"
    lines = [f"{named(share.place)}: {_times(share)}" for share in (pressed or ())[1:]]
    return {**diagnosis.measured, "wires": wires, "wires_of_lines": lines}


def _times(share: WireShare) -> str:
    return f"{share.share:.2f} +- {share.std:.2f} times nominal" if share.known else _WIDE


def _ohm(share: WireShare, nominal_ohm: tuple[float, float]) -> str:
    if not share.known:
        return _LINES_DIFFER if share.std <= KNOWN_STD * share.share else _WIDE
    top, bottom = (f"{share.share * ohm:.0f}" for ohm in nominal_ohm)
    return f"{_times(share)}: top {top}, bottom {bottom} ohm a segment, if both changed alike"


def line_wire_in_words(line: LineWire) -> str:
    """A line of the table of wires."""
    pairs = zip(line.segment_ohm, line.segment_std_ohm, strict=True)
    texts = (f"{ohm:6.0f}" if std < KNOWN_STD * ohm else "     ?" for ohm, std in pairs)
    return f"{named(line.place):<18}{line.ohm:6.0f} +- {line.std_ohm:<4.0f}{' '.join(texts)}"


def step_in_words(step: Step, detail: Any) -> tuple[str, str]:
    """What is being done, and what a person is asked to do meanwhile, if anything."""
    if step is not Step.PRESSES:
        request = "keep pressing" if step is Step.PRESSED_SETTLING else ""
        return _TABLES["steps"][step.name].format(detail), request
    presses: CornerScans = detail
    cells = " ".join(map(str, sorted(presses.wanted)))
    request = f"{'now' if presses.read else 'press firmly, at once:'} {cells}"
    if presses.hold:
        return "hold still", request
    return f"pressed: {' '.join(map(str, presses.pressed)) or 'nothing'}", request
