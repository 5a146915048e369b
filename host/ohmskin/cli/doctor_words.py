# SPDX-License-Identifier: Apache-2.0
"""The words of ``ohmskin doctor``; those of each kind of finding are in ``doctor_words.toml``."""

import tomllib
from functools import cache
from pathlib import Path
from typing import Any, Final

from ohmskin.doctor.findings import WHOLE_SKIN, Diagnosis, Finding, Kind, Place, WireShare
from ohmskin.doctor.wires import LAYERS, CornerScans
from ohmskin.link.protocol import ENUMS

FIELDS: Final = ("where", "measured", "expected", "what_to_do")
MOST_CELLS: Final = 6  # [cells] More are not named one by one.

_UNTOUCHED: Final = "not known: an untouched skin hides its wires, --press asks for touches"
_NOT_PRESSED: Final = "not known: no three corners of a rectangle were pressed"
_WIDE: Final = "not known: press with something smaller than a cell, further apart"


@cache
def _table() -> dict[str, Any]:
    return tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def words_of(finding: Finding) -> dict[str, str]:
    """What is told of a finding, by the names in `FIELDS`."""
    name, cases, more = _case(finding, finding.values)
    told = _table()[name]
    for case in cases:
        told = told | told.get(case, {})
    words = {"where": named(finding.place), **finding.values, **more}
    return {field: told[field].format(**words) for field in FIELDS}


def _case(finding: Finding, values: Any) -> tuple[str, list[str], dict[str, Any]]:
    """The table of a finding, the cases in it that apply, and words besides the values."""
    name, cases, words = finding.kind.id, [], {}
    place = finding.place
    what, lines = ("row", place.rows) if place.rows else ("column", place.columns)
    if place != WHOLE_SKIN:
        cases.append("one_place")
    match finding.kind:
        case Kind.PORT_UNUSABLE:
            cases += [] if values["remedy"] else ["unknown"]
        case Kind.SELF_TEST:
            side, _, fault = values["name"].partition("_")
            doc = ENUMS["finding"].docs.get(values["name"], "a finding of a newer firmware")
            cases, words = [fault], {"side": side, "doc": doc}
        case Kind.NOTHING_CONDUCTS if values["cell_count"] == 1:
            cases.append("one_cell")
        case Kind.OPEN_ROW | Kind.OPEN_COLUMN:
            name, words = "open", {"line": what, "first": lines[0]}
            cases += ["one_cell"] if values["cells_per_line"] == 1 else []
            # Lines beyond the skin look open, too.
            beyond = lines == tuple(range(lines[0], values["line_count"]))
            cases += ["last_lines"] if beyond else []
        case Kind.SHORT_ROWS | Kind.SHORT_COLUMNS:
            name, words = "short", {"line": what, "joined": " and ".join(map(str, lines))}
        case Kind.REFERENCE_RATIO:
            nominal = values["ref_top_ohm"] / values["ref_bottom_ohm"]
            words = {"percent": abs(values["off_percent"]), "nominal_ratio": nominal}
            cases += ["low"] if values["off_percent"] < 0 else []
        case Kind.RESET_CAUSE:
            cases.append(values["cause"])
        case Kind.RESTARTED:
            words = {"last": ", ".join(values["causes"]) or "unknown"}
        case Kind.LOSS if values["dropped_by_board"] or not values["missed"]:
            cases.append("dropped" if values["missed"] else "few")
        case Kind.HUM:
            words = {"mains": " or ".join(f"{hz:.0f} Hz" for hz in values["mains_hz"])}
        case Kind.WIRES:
            share, ohm = values["share"], dict(zip(LAYERS, values["nominal_ohm"], strict=True))
            words = {"told": _ohm(share, ohm), "nominal": ohm[share.layers[0]], **ohm}
            words["times"] = share.share
            cases += ["both"] if len(share.layers) > 1 else []
            cases += [] if lines else [f"all_{'_'.join(share.layers)}"]
        case Kind.TOUCHED if values["moves"]:
            cases.append("moves")
    return name, cases, words


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
    worse = diagnosis.worse
    if worse:
        first = f"{worse[0].kind.id.replace('_', ' ')} ({words_of(worse[0])['where']})"
        return f"not sound: {len(worse)} finding{'s' if len(worse) > 1 else ''}, first {first}"
    if any(finding.kind is Kind.TOUCHED for finding in diagnosis.findings):
        return "no fault found, but something touches the skin: let go, and run this again"
    if diagnosis.wires_hidden:
        return "sound: nothing is wrong that an untouched skin shows; --press shows its wires"
    return "sound: nothing is wrong"


# ----------------------------------------------------------------------- wires, what to press


def measured_in_words(diagnosis: Diagnosis) -> dict[str, Any]:
    """The figures; and the wires of layers and lines in words, where they were judged."""
    if diagnosis.nominal_ohm is None:
        return diagnosis.measured
    ohm, pressed = dict(zip(LAYERS, diagnosis.nominal_ohm, strict=True)), diagnosis.pressed
    if pressed is None:
        layers = [
            f"{each.layers[0]} {_ohm(each, ohm)}" for each in diagnosis.untouched if each.known
        ]
        told = "; ".join(layers) or _UNTOUCHED
    else:
        told = _ohm(pressed[0], ohm) if pressed else _NOT_PRESSED
    lines = [f"{named(each.place)}: {_times(each)}" for each in (pressed or ())[1:]]
    return {**diagnosis.measured, "wires": told, "wires_of_lines": lines}


def _times(share: WireShare) -> str:
    return f"{share.share:.2f} +- {share.std:.2f} times nominal" if share.known else _WIDE


def _ohm(share: WireShare, nominal_ohm: dict[str, float]) -> str:
    """The wires of one layer, or of both as presses show them."""
    if len(share.layers) == 1:
        ohm = nominal_ohm[share.layers[0]]
        return f"{share.share * ohm:.0f} +- {share.std * ohm:.0f} ohm a segment"
    if not share.known:
        return _WIDE
    top, bottom = (f"{share.share * nominal_ohm[layer]:.0f}" for layer in share.layers)
    return f"{_times(share)}: top {top}, bottom {bottom} ohm a segment, if both changed alike"


def request(presses: CornerScans) -> str:
    """Where to press next."""
    cells = " ".join(map(str, sorted(presses.wanted)))
    return f"{'now' if presses.again else 'press firmly, at once:'} {cells}"


def answer(presses: CornerScans) -> str:
    """What is pressed meanwhile."""
    if presses.hold:
        return "hold still"
    return f"pressed: {' '.join(map(str, presses.pressed)) or 'nothing'}"
