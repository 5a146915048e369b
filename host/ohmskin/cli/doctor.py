# SPDX-License-Identifier: Apache-2.0
"""``ohmskin doctor``: one page of findings about the skin board at a port."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.console import Console

import ohmskin
from ohmskin.doctor.examine import Examined, examine
from ohmskin.doctor.findings import Diagnosis, Finding
from ohmskin.doctor.press import Cell, Corners, CornerScans, moved_across, suggested_corners
from ohmskin.doctor.signal import LEAST_SCANS, REST_S, SETTLED_S, comparison
from ohmskin.errors import (
    CommandRefused,
    DeviceLost,
    DeviceSilent,
    OhmskinError,
    PortError,
    ProtocolMismatch,
)
from ohmskin.force.calibration import Calibration, load_calibration
from ohmskin.link.device import Device
from ohmskin.link.messages import Hello, Scan, SelfTestReport
from ohmskin.link.serial_port import latency_ms, latency_timer_file

PRESS_S: Final = 1.0  # of scans with the same cells pressed
WAIT_S: Final = 30.0  # for a person
LONGEST: Final = 2.0  # times the usual, where scans are slow
_COLOURS: Final = {"fault": "red", "warning": "yellow", "note": "cyan"}

_out = Console(soft_wrap=True)
Progress = Callable[[str], None]


def doctor(
    port: Annotated[str, typer.Argument(help="serial port or URL; 'ohmskin ports' lists them")],
    calibration: Annotated[
        Path | None,
        typer.Option(help="calibration file (.json): its rest and wires are what is compared with"),
    ] = None,
    wires: Annotated[
        str, typer.Option(help="nominal ohms of a wire segment, TOP,BOTTOM: 100,200")
    ] = "",
    press: Annotated[
        bool, typer.Option(help="afterwards ask for touches, which show the wires")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object")] = False,
) -> None:
    """Say what is wrong with the skin board at PORT, and what to do. Touch nothing meanwhile.

    Takes under 10 s, but for --press, and leaves the board as it was. --press measures the wires:
    it says when and where to press. Any rectangle will do: its lines are measured. Exit code 0:
    sound; 1: something is wrong.
    """
    told = None if calibration is None else load_calibration(calibration)
    wire_ohm = _wires(wires) if wires else _wires_of(told)
    with _progress() as progress:
        diagnosis = diagnose(port, told, wire_ohm, progress, _asking(progress) if press else None)
    if as_json:
        print(json.dumps(as_object(port, diagnosis)))  # noqa: T201
    else:
        _print(port, diagnosis)
    if diagnosis.wrong:
        raise SystemExit(1)


def _wires(text: str) -> tuple[float, float]:
    try:
        top, bottom = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"--wires wants two numbers, as 100,200, not '{text}'") from None
    if not (0 < top < float("inf") and 0 < bottom < float("inf")):
        raise ValueError(f"--wires must be above 0 ohm, not '{text}'")
    return top, bottom


def _wires_of(calibration: Calibration | None) -> tuple[float, float] | None:
    if calibration is None:
        return None
    top, bottom = calibration.nominal_wire_ohm
    return (top, bottom) if top and bottom else None


@contextmanager
def _progress() -> Iterator[Progress]:
    """A line that says what is done, where somebody looks."""
    errors = Console(stderr=True)
    if not errors.is_terminal:
        yield lambda text: None
        return
    with errors.status("connecting") as status:
        yield lambda text: status.update(text)


def _asking(progress: Progress) -> Progress:
    """Where nobody sees a line that changes, what to press is said once."""
    errors = Console(stderr=True)
    if errors.is_terminal:
        return progress
    said: set[str] = set()

    def ask(text: str) -> None:
        request = text.partition(";")[0]
        if request not in said:
            said.add(request)
            errors.print(request, markup=False, highlight=False)

    return ask


# ------------------------------------------------------------------------------- the examination


def diagnose(
    port: str,
    calibration: Calibration | None = None,
    wire_ohm: tuple[float, float] | None = None,
    progress: Progress = lambda text: None,
    ask: Progress | None = None,
) -> Diagnosis:
    """Examine the board at `port`. What keeps it from being examined is a finding.

    ask: tells a person where to press; without, nobody is asked.

    :raises PortError: the URL is wrong.
    :raises ValueError: the calibration is of another unit or geometry.
    """
    progress("connecting")
    try:
        device = ohmskin.open(port, start=False)
    except (DeviceSilent, DeviceLost, ProtocolMismatch, PortError) as exc:
        return Diagnosis((_unanswered(port, exc),), {})
    with device:
        board = device.info
        if calibration is not None:
            calibration.check(board.unit_id, board.rows, board.columns)
        if ask is not None:
            suggested_corners(board.rows, board.columns)  # before the scans, if there are none
        timer_ms = None if "://" in port else latency_ms(_path(port))
        latency = (timer_ms, str(latency_timer_file(_path(port)))) if timer_ms is not None else None
        gathered = _Gathered()
        lost = None
        try:
            gathered.take(device, progress)
            if ask is not None:
                gathered.ask_for_presses(device, ask)
        except DeviceLost as exc:
            lost = exc
        examined = Examined(
            board=device.info if lost else gathered.board or board,
            scans=gathered.scans,
            stats=device.stats,
            settled=gathered.settled,
            report=gathered.report,
            rest_ratio=None if calibration is None else calibration.rest.ratio,
            wire_ohm=wire_ohm,
            presses=gathered.presses,
            latency=latency,
            host_version=ohmskin.__version__,
        )
    diagnosis = examine(examined)
    if lost is None:
        return diagnosis
    finding = Finding(
        *("lost", "fault", "board", str(lost), "a board that goes on scanning"),
        "check the USB cable and plug, and that the supply is strong enough",
    )
    return Diagnosis((finding, *diagnosis.findings), diagnosis.measured)


class _Gathered:
    """What was read, as far as it came."""

    def __init__(self) -> None:
        self.board: Hello | None = None
        self.report: SelfTestReport | None = None
        self.scans: list[Scan] = []
        self.settled: tuple[Hello, list[Scan]] | None = None
        self.presses: CornerScans | None = None

    def take(self, device: Device, progress: Progress) -> None:
        progress("self-test")
        with suppress(CommandRefused):  # a recording has none
            self.report = device.self_test()
        progress(f"scanning the untouched skin for {REST_S} s")
        _scan(device, self.scans, REST_S)
        self.board = device.info
        progress("scanning with a longer settle time")
        with suppress(CommandRefused):
            self._scan_settled(device, self.board)

    def _scan_settled(self, device: Device, board: Hello) -> None:
        other = comparison(board)
        if other is None:
            return
        settle_us, rate_hz = other
        device.stop()
        try:
            settled = device.configure(rate_hz=rate_hz, settle_us=settle_us)
            self.settled = (settled, [])
            _scan(device, self.settled[1], SETTLED_S)
        finally:
            device.stop()
            device.configure(rate_hz=board.rate_asked_mhz / 1000, settle_us=board.settle_asked_us)

    def ask_for_presses(self, device: Device, ask: Progress) -> None:
        """Until three corners were pressed, and three others, for `PRESS_S` each, or it is late."""
        board = self.board or device.info
        self.presses = presses = CornerScans(board)
        wanted = suggested_corners(board.rows, board.columns)
        held: Corners | None = None
        begin_s = None
        for scan in device:
            begin_s = scan.host_time_s if begin_s is None else begin_s
            corners = presses.take(scan)
            if corners not in (None, held) and presses.scans(corners) >= PRESS_S * board.rate_hz:
                if held is not None:
                    return
                held, wanted = corners, moved_across(corners)
            if scan.host_time_s - begin_s >= WAIT_S:
                return
            still = corners not in (None, held)
            request = _request(wanted, again=held is not None)
            ask(f"{request}; {'hold still' if still else _pressed(presses.pressed)}")


def _request(wanted: Corners, *, again: bool) -> str:
    return f"{'now' if again else 'press firmly, at once:'} {_cells(sorted(wanted))}"


def _pressed(cells: tuple[Cell, ...]) -> str:
    return f"pressed: {_cells(cells) if cells else 'nothing'}"


def _cells(cells: Iterable[Cell]) -> str:
    return " ".join(f"({row}, {column})" for row, column in cells)


def _scan(device: Device, scans: list[Scan], seconds: float) -> None:
    for scan in device:
        scans.append(scan)
        elapsed_s = scan.host_time_s - scans[0].host_time_s
        if elapsed_s >= seconds * (1 if len(scans) >= LEAST_SCANS else LONGEST):
            return


def _path(port: str) -> str:
    return port.partition("?")[0]


def _unanswered(port: str, error: OhmskinError) -> Finding:
    """Why there is nothing to examine. Raises what is a wrong use instead."""
    text = str(error)
    what, _, to_do = text.rpartition(": ")
    expected = "a skin board that answers"
    match error:
        case ProtocolMismatch():
            return Finding("protocol_mismatch", "fault", port, what, "one protocol layout", to_do)
        case DeviceSilent():
            measured = f"nothing answers: {text}"
            to_do = "check the cable and the port; flash the board with 'ohmskin flash'"
            return Finding("nothing_answers", "fault", port, measured, expected, to_do)
        case DeviceLost():
            return Finding("lost", "fault", port, what, expected, to_do)
    if "://" in port or error.__cause__ is None:
        raise error
    return Finding("port_unusable", "fault", port, what or text, expected, to_do)


# ----------------------------------------------------------------------------------- the page


def as_object(port: str, diagnosis: Diagnosis) -> dict[str, object]:
    """What ``--json`` prints."""
    return {
        "port": port,
        "sound": not diagnosis.wrong,
        "verdict": diagnosis.verdict,
        "findings": [asdict(finding) for finding in diagnosis.findings],
        "measured": diagnosis.measured,
    }


def _print(port: str, diagnosis: Diagnosis) -> None:
    _out.print(f"{port}: {diagnosis.verdict}", markup=False, highlight=False)
    for number, finding in enumerate(diagnosis.findings, start=1):
        colour = _COLOURS[finding.severity]
        title = f"{finding.id.replace('_', ' ')}: {finding.where}"
        _out.print(f"\n{number}. ", end="", highlight=False)
        _out.print(f"{finding.severity}, {title}", style=colour, markup=False, highlight=False)
        for label, text in (
            ("measured", finding.measured),
            ("expected", finding.expected),
            ("what to do", finding.what_to_do),
        ):
            _out.print(f"   {label:<10}  {text}", markup=False, highlight=False)
    if diagnosis.measured:
        _out.print("")
    for name, value in diagnosis.measured.items():
        shown = ", ".join(map(str, value)) or "none" if isinstance(value, list) else value
        _out.print(f"{name:<18}  {shown}", markup=False, highlight=False)
