# SPDX-License-Identifier: Apache-2.0
"""``ohmskin doctor``: one page of findings about the skin board at a port."""

import json
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, Final

from typer import Option

import ohmskin
from ohmskin import errors
from ohmskin.cli import doctor_words as words
from ohmskin.cli.board import Leads, Port, Wires, own_leads_in_words, wires_of
from ohmskin.cli.terminal import Terminal
from ohmskin.doctor.examine import examine, measured_wires
from ohmskin.doctor.findings import WHOLE_SKIN, Diagnosis, Finding, Kind, Severity
from ohmskin.doctor.gather import Report, Step, gather
from ohmskin.estimate.knowledge import WireOhm
from ohmskin.force.calibration import load_calibration

_COLOURS: Final = {Severity.FAULT: "red", Severity.WARNING: "yellow", Severity.NOTE: "cyan"}
_UNANSWERED: Final = {
    errors.DeviceLost: Kind.LOST,
    errors.DeviceSilent: Kind.NOTHING_ANSWERS,
    errors.PortUnusable: Kind.PORT_UNUSABLE,
    errors.ProtocolMismatch: Kind.PROTOCOL_MISMATCH,
}

_out = Terminal(soft_wrap=True, highlight=False)


def doctor(
    port: Port,
    calibration: Annotated[
        Path | None, Option(help="file (.json) of this board: --press compares with its wires")
    ] = None,
    wires: Wires = "",
    leads: Leads = None,
    press: Annotated[bool, Option("--press", help="ask for touches that show the wires")] = False,
    into: Annotated[Path | None, Option(help="calibration that takes these wires (.json)")] = None,
    as_json: Annotated[bool, Option("--json", help="one JSON object")] = False,
) -> None:
    """Say what is wrong with the board at PORT, and what to do. Touch nothing.

    Takes under 10 s, but for --press, and leaves the board as it was. --press measures the wires:
    it says when and where to press. Any rectangle will do: its lines are measured. In mode far, the
    wires of all lines are measured without, and --into takes them. Exit code 0: sound; 1: something
    is wrong, or --press has shown no wires.
    """
    paths = filter(None, (calibration, into))
    known = [load_calibration(path) for path in paths]  # the first one tells the wires
    told, own_lead_ohm = wires_of(wires, leads), known[0].own_lead_ohm if known else None
    if known:  # what is told now has no deviation of what was told before
        before = known[0].nominal_wire_ohm
        if told.lead is None:
            told = told._replace(lead=before.lead, lead_std_ohm=before.lead_std_ohm)
        if told.both is None:
            told = before._replace(lead=told.lead, lead_std_ohm=told.lead_std_ohm)
    with terminal() as report:
        try:
            device = ohmskin.open(port, start=False)
        except errors.OhmskinError as exc:
            diagnosis = Diagnosis([_unanswered(port, exc)])
        else:
            with device:
                for each in known:
                    each.check(device.info)
                if device.info.mode == "far":
                    if press:
                        raise ValueError("mode far shows the wires untouched: leave out --press")
                elif into is not None and not (press and told.both and all(told.both)):
                    raise ValueError(
                        "in mode near, --into needs --press, and nominal wires, as --wires 100,200"
                    )
                evidence = gather(device, report, told, own_lead_ohm=own_lead_ohm, press=press)
            diagnosis = examine(evidence)
    page = as_object(port, diagnosis)
    if as_json:
        print(json.dumps(page, default=asdict))  # noqa: T201
    else:
        print_page(page)
        if own_leads := own_leads_in_words(known[0]) if known else "":
            _out.print(f"{own_leads}, by the presses of {calibration or into}")
    if into is not None:
        _keep_wires(diagnosis, told, into)
    if not diagnosis.sound:
        raise SystemExit(1)


def _keep_wires(diagnosis: Diagnosis, told: WireOhm, into: Path) -> None:
    """Write the wires that presses or far ends showed into a calibration, with their deviation.

    told: the wires that were told. Their leads are kept where only far ends could have shown leads.
    Presses have compared both layers with them, so that neither is known better than their ratio.
    """
    wires = measured_wires(diagnosis)
    if wires is None:
        raise ValueError(f"{into} is as it was: neither presses nor far ends have told the wires")
    if wires.lead is None:
        pairs = zip(wires[3:5], told[3:5], strict=True)
        top_std, bottom_std = (max(std or 0.0, of_told or 0.0) for std, of_told in pairs)
        wires = wires._replace(top_log_std=top_std, bottom_log_std=bottom_std)
        wires = wires._replace(lead=told.lead, lead_std_ohm=told.lead_std_ohm)
    calibration = load_calibration(into)
    wires = wires.for_curves_of(calibration.nominal_wire_ohm)
    replace(calibration, nominal_wire_ohm=wires).save(into)


def _unanswered(port: str, error: errors.OhmskinError) -> Finding:
    """Why there is nothing to examine. Raises what is a wrong use instead, as a wrong URL is."""
    kind = _UNANSWERED.get(type(error))
    if kind is None:
        raise error
    remedy = error.remedy or "check the port's name and its cable"
    values = {"port": port, "problem": error.problem, "remedy": remedy}
    return Finding(kind, WHOLE_SKIN, {name: values[name] for name in kind.names})


@contextmanager
def terminal() -> Iterator[Report]:
    """Says each step of `gather` on a line of the terminal, which changes.

    Elsewhere progress is of no use: each request to a person is printed, once.
    """
    console, said = Terminal(stderr=True, highlight=False), {""}
    status = console.status("connecting") if console.is_terminal else None

    def report(step: Step, detail: Any) -> None:
        doing, request = words.step_in_words(step, detail)
        if status is not None:
            status.update(f"{request}; {doing}" if request else doing)
        elif request not in said:
            said.add(request)
            console.print(request)

    with status or nullcontext():
        yield report


# ----------------------------------------------------------------------------------- the page


def as_object(port: str, diagnosis: Diagnosis) -> dict[str, Any]:
    """What ``--json`` prints, with places and shares that `asdict` takes apart."""
    return {
        "port": port,
        "sound": diagnosis.sound,
        "verdict": words.verdict(diagnosis),
        "findings": [
            {"id": each.kind.id, "severity": each.kind.severity}
            | words.words_of(each)
            | {"place": each.place, "values": each.values}
            for each in diagnosis.findings
        ],
        "measured": words.measured_in_words(diagnosis),
        "lines": diagnosis.lines,
    }


def print_page(page: dict[str, Any]) -> None:
    """What `as_object` has, for people."""
    show = _out.print
    show(f"{page['port']}: {page['verdict']}")
    for number, finding in enumerate(page["findings"], start=1):
        severity, name = finding["severity"], finding["id"].replace("_", " ")
        show(f"\n{number}. ", end="")
        show(f"{severity}, {name}: {finding['where']}", style=_COLOURS[severity])
        for field in words.FIELDS[1:]:
            show(f"   {field.replace('_', ' '):<10}  {finding[field]}")
    if page["measured"]:
        show("")
    for name, value in page["measured"].items():
        shown = ", ".join(map(str, value)) or "none" if isinstance(value, list) else value
        show(f"{name:<18}  {'not known' if shown is None else shown}")
    if page["lines"]:
        show("\nwires [ohm]         end to end    by segment, from the near end; ?: not known")
    for line in page["lines"]:
        show(words.line_wire_in_words(line))
