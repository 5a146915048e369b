# SPDX-License-Identifier: Apache-2.0
"""``ohmskin doctor``: one page of findings about the skin board at a port."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, Final

from rich.console import Console
from typer import Option

import ohmskin
from ohmskin import errors
from ohmskin.cli import doctor_words as words
from ohmskin.cli.board import Port, Wires, wires_of
from ohmskin.doctor.examine import Evidence, examine
from ohmskin.doctor.far import segments_of
from ohmskin.doctor.findings import WHOLE_SKIN, Diagnosis, Finding, Kind, Severity
from ohmskin.doctor.signal import FAR_S, LEAST_SCANS, REST_S, SETTLED_S, comparison
from ohmskin.doctor.wires import CornerScans
from ohmskin.estimate.knowledge import WireOhm
from ohmskin.force.calibration import load_calibration
from ohmskin.link.device import Device, scans_for
from ohmskin.link.messages import Hello, Scan
from ohmskin.link.protocol import ENUMS
from ohmskin.link.serial_port import latency_timer

WAIT_S: Final = 30.0  # [s] A person has this long to press where they are asked to.
CLOCK_S: Final = 1.0  # [s] A look by another ADC clock takes this long: it tells noise alone.
TURNS: Final = 5  # [looks] So often each settle time is had while corners are pressed.
TURN_S: Final = 0.3  # [s] Such a look takes this long: a hand drifts in more.
LONGEST: Final = 2.0  # [1] A look at slow scans takes up to this many times as long.
_COLOURS: Final = {Severity.FAULT: "red", Severity.WARNING: "yellow", Severity.NOTE: "cyan"}
_UNANSWERED: Final = {
    errors.DeviceLost: Kind.LOST,
    errors.DeviceSilent: Kind.NOTHING_ANSWERS,
    errors.PortError: Kind.PORT_UNUSABLE,
    errors.ProtocolMismatch: Kind.PROTOCOL_MISMATCH,
}

_out = Console(soft_wrap=True, markup=False, highlight=False)
# Says what is being done, and before it what a person is asked to press, if anything.
Tell = Callable[..., None]


def doctor(
    port: Port,
    calibration: Annotated[
        Path | None, Option(help="file (.json) of this board: --press compares with its wires")
    ] = None,
    wires: Wires = "",
    press: Annotated[bool, Option(help="then ask for touches, which show the wires")] = False,
    into: Annotated[Path | None, Option(help="calibration that takes these wires (.json)")] = None,
    as_json: Annotated[bool, Option("--json", help="one JSON object")] = False,
) -> None:
    """Say what is wrong with the board at PORT, and what to do. Touch nothing.

    Takes under 10 s, but for --press, and leaves the board as it was. --press measures the wires:
    it says when and where to press. Any rectangle will do: its lines are measured. In mode far, the
    wires of all lines are measured without, and --into takes them. Exit code 0: sound; 1: something
    is wrong.
    """
    calibration = calibration or into
    told = None if calibration is None else load_calibration(calibration)
    nominal = wires_of(wires)
    wire_ohm = nominal.both or (None if told is None else told.nominal_wire_ohm.both)
    with terminal() as tell:
        try:
            device = ohmskin.open(port, start=False)
        except errors.OhmskinError as exc:
            diagnosis = Diagnosis([_unanswered(port, exc)])
        else:
            with device:
                if told is not None:
                    told.check(device.info)
                if device.info.mode == "far":
                    if press:
                        raise ValueError("mode far shows the wires untouched: leave out --press")
                elif into is not None and not (press and wire_ohm):
                    raise ValueError("in mode near, --into needs --press and nominal --wires")
                evidence = gather(device, tell, wire_ohm, press=press)
            diagnosis = examine(evidence)
    page = as_object(port, diagnosis)
    if as_json:
        print(json.dumps(page, default=asdict))  # noqa: T201
    else:
        print_page(page)
    if into is not None:
        _keep_wires(diagnosis, wire_ohm, into)
    if diagnosis.worse:
        raise SystemExit(1)


def _keep_wires(diagnosis: Diagnosis, wire_ohm: tuple[float, float] | None, into: Path) -> None:
    """Write the wires that presses or far ends showed into a calibration, with their deviation."""
    measured = segments_of(diagnosis.lines)
    if wire_ohm and diagnosis.pressed and diagnosis.pressed[0].known:
        whole = diagnosis.pressed[0]
        top, bottom = (whole.share * ohm for ohm in wire_ohm)
        measured = WireOhm(top, bottom, whole.std / whole.share)
    if measured is None:
        raise ValueError(f"{into} is as it was: neither presses nor far ends have told the wires")
    replace(load_calibration(into), nominal_wire_ohm=measured).save(into)


def _unanswered(port: str, error: errors.OhmskinError) -> Finding:
    """Why there is nothing to examine. Raises what is a wrong use instead."""
    kind = _UNANSWERED.get(type(error))
    wrong_url = kind is Kind.PORT_UNUSABLE and ("://" in port or error.__cause__ is None)
    if kind is None or wrong_url:
        raise error
    remedy = error.remedy or "check the port's name and its cable"
    told = {"port": port, "problem": error.problem, "remedy": remedy}
    return Finding(kind, WHOLE_SKIN, {name: told[name] for name in kind.names})


@contextmanager
def terminal() -> Iterator[Tell]:
    """On a terminal, one line changes. Elsewhere each request is printed once, and no progress."""
    console, said = Console(stderr=True, markup=False, highlight=False), {""}

    def print_once(doing: str, request: str = "") -> None:
        if request not in said:
            said.add(request)
            console.print(request)

    if not console.is_terminal:
        yield print_once
        return
    with console.status("connecting") as status:
        yield lambda doing, request="": status.update(f"{request}; {doing}" if request else doing)


# ------------------------------------------------------------------------------- the examination


def gather(
    device: Device,
    tell: Tell = lambda *told: None,
    wire_ohm: tuple[float, float] | None = None,
    *,
    press: bool = False,
    seconds: float = REST_S,
    clocks: bool = False,
) -> Evidence:
    """What `examine` goes by, as far as the board lets. Leaves the board as it was.

    seconds: how long the first look takes. clocks: whether to scan by each ADC clock, too.

    :raises ValueError: somebody would be asked to press a skin of one row or column.
    """
    board, path = device.info, device.name.partition("?")[0]
    evidence = Evidence(board, host_version=ohmskin.__version__)
    # Wires of no resistance are none that could have changed.
    evidence.wire_ohm = wire_ohm if wire_ohm and all(wire_ohm) else None
    evidence.latency = None if "://" in path else latency_timer(path)
    presses = CornerScans(board) if press else None
    try:
        tell("self-test")
        with suppress(errors.CommandRefused):  # a recording has none
            evidence.report = device.self_test()
        tell(f"scanning {'the plate' if clocks else 'the untouched skin'} for {seconds:g} s")
        _scan(device, evidence.scans, seconds)
        evidence.board = device.info
        other = comparison(evidence.board)
        with suppress(errors.CommandRefused), put_back(device):
            if other is not None:
                tell("scanning with a longer settle time")
                far = evidence.board.mode == "far"
                evidence.settled = _look(device, FAR_S if far else SETTLED_S, **other)
            for clock in ENUMS["adc_prescaler"].values if clocks else ():
                tell(f"scanning by {clock}")
                # As fast as it can: a slow clock does not reach the rate of the board.
                by_clock = _look(device, CLOCK_S, adc_prescaler=clock, rate_hz=0)
                evidence.clocks.append(by_clock)
        if presses is not None:
            evidence.presses = presses
            _scan_presses(device, presses, tell)
        if presses is not None and presses.done and other is not None:
            tell("comparing settle times", "keep pressing")
            usual = {"settle_us": board.settle_asked_us, "rate_hz": board.rate_asked_mhz / 1000}
            with suppress(errors.CommandRefused), put_back(device):
                for wanted in TURNS * (usual, other):
                    evidence.pressed.append(_look(device, TURN_S, **wanted))
    except errors.RecordingEnded:
        pass  # all of the recording was read
    except errors.DeviceLost as exc:
        evidence.board, evidence.lost = device.info, str(exc)
    evidence.stats = device.stats
    return evidence


@contextmanager
def put_back(device: Device) -> Iterator[None]:
    """Let the board stand still and then scan as before, however the body ends.

    A board that is lost cannot be put back, and who reads it next is told.
    """
    board = device.info
    device.stop()
    try:
        yield
    finally:
        with suppress(errors.DeviceLost):
            device.stop()
            device.configure(
                rows=board.rows,
                columns=board.columns,
                rate_hz=board.rate_asked_mhz / 1000,
                settle_us=board.settle_asked_us,
                adc_prescaler=board.adc_prescaler,
                mode=board.mode,
            )


def _look(device: Device, seconds: float, **wanted: Any) -> tuple[Hello, list[Scan]]:
    """Scans of a board that is configured like this, and what it then says of itself."""
    device.stop()
    board, scans = device.configure(**wanted), list[Scan]()
    _scan(device, scans, seconds)
    return board, scans


def _scan(device: Device, scans: list[Scan], seconds: float) -> None:
    # Slow scans are looked at for longer: few of them do not tell noise.
    least_s = (LEAST_SCANS - 1) / device.info.rate_hz
    for scan in scans_for(device, min(max(seconds, least_s), LONGEST * seconds)):
        scans.append(scan)  # one by one, so that those before an error are kept


def _scan_presses(device: Device, presses: CornerScans, tell: Tell) -> None:
    """Until three corners and then three others were pressed, or it has taken too long."""
    for scan in scans_for(device, WAIT_S):
        presses.take(scan)
        if presses.done:
            return
        tell(*words.guidance(presses))


# ----------------------------------------------------------------------------------- the page


def as_object(port: str, diagnosis: Diagnosis) -> dict[str, Any]:
    """What ``--json`` prints, with places and shares that `asdict` takes apart."""
    return {
        "port": port,
        "sound": not diagnosis.worse,
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
        show(f"{name:<18}  {shown}")
    if page["lines"]:
        show("\nwires [ohm]         end to end    by segment, from the near end; ?: not known")
    for line in page["lines"]:
        show(words.line_wire_in_words(line))
