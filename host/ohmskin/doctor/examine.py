# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a skin board, from scans of the untouched skin and what the board says.

No port, no clock: `examine` takes what was read, and gives the findings in the order in which they
matter. The parts: `doctor_circuit` (lines, cells, references), `doctor_signal` (hum, noise,
settling), `doctor_wires`, `doctor_press` (wires as well, once the skin is pressed); here, what the
link and the board tell.

A skin that is touched is not at fault: touched cells are named and left out, and what movement
hides is not judged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.doctor.circuit import BOTTOM_WIRE_OHM, TOP_WIRE_OHM, Circuit, examine_circuit
from ohmskin.doctor.findings import NOT_KNOWN, Diagnosis, Finding, in_order, named
from ohmskin.doctor.press import CornerScans, all_of, pressed_findings
from ohmskin.doctor.signal import (
    SOUND_NOISE_LSB,
    RestScans,
    Signal,
    examine_settling,
    examine_signal,
    find_hum,
    hum_finding,
)
from ohmskin.doctor.wires import lines_in_words, measure_wires, wire_findings, wires_in_words
from ohmskin.link import protocol
from ohmskin.link.messages import BoardStats, Hello, Scan, SelfTestReport

LEAST_SCANS: Final = 2
RATE_TOLERANCE: Final = 0.005  # of a resonator
NOT_PRESSED: Final = f"{NOT_KNOWN}: no three corners of a rectangle were pressed"
SLOW_HOST: Final = 0.1
LEAST_SPAN_S: Final = 1.0  # by the host's clock: scans come in bursts
BAD_RESETS: Final = {
    "brown_out": "the supply dipped: power the board from another port or a stronger supply, and "
    "nothing else from its 5 V pin",
    "watchdog": "the firmware hung: write it anew with 'ohmskin flash', and report it",
}


@dataclass(frozen=True, eq=False)
class Examined:
    """What `examine` goes by. What could not be had is None, and is not judged.

    scans: as the board is configured; settled: those of a longer settle time, and what the board
    said of itself meanwhile. stats: of the connection. rest_ratio: readings (R, C, 4) of an earlier
    rest. wire_ohm: nominal wires of a segment, top and bottom. presses: of the same skin, after all
    else. latency: the USB bridge's timer [ms] and where it is set.
    """

    board: Hello
    scans: Sequence[Scan]
    stats: BoardStats = field(default_factory=BoardStats)
    settled: tuple[Hello, Sequence[Scan]] | None = None
    report: SelfTestReport | None = None
    rest_ratio: Float | None = None
    wire_ohm: tuple[float, float] | None = None
    presses: CornerScans | None = None
    latency: tuple[int, str] | None = None
    host_version: str = ""


def examine(examined: Examined) -> Diagnosis:
    """All findings, in order, and the figures behind them."""
    board = examined.board
    findings = _of_board(examined)
    measured: dict[str, Any] = {
        "board": board.board,
        "unit_id": board.unit_id,
        "rows": board.rows,
        "columns": board.columns,
        "scans": len(examined.scans),
    }
    usual = rest_scans(board, examined.scans)
    findings += _of_link(examined, usual, measured)
    if usual is not None:
        findings += _of_skin(examined, usual, measured)
    return Diagnosis(in_order(findings), measured)


def rest_scans(board: Hello, scans: Sequence[Scan]) -> RestScans | None:
    """The scans of a board's size as arrays; None if they are too few to be judged."""
    shape = (board.rows, board.columns)
    fit = [scan for scan in scans if scan.codes.shape[:2] == shape]
    if len(fit) < LEAST_SCANS:
        return None
    codes = np.stack([scan.codes for scan in fit]).astype(np.float64)
    return RestScans(board, codes, np.array([1e-6 * scan.time_us for scan in fit]))


# ---------------------------------------------------------------------------------- the skin


def _of_skin(examined: Examined, usual: RestScans, measured: dict[str, Any]) -> list[Finding]:
    board = examined.board
    signal = examine_signal(usual)
    best, findings = usual, []
    if examined.settled is not None and not signal.moved.any():
        settled = rest_scans(*examined.settled)
        if settled is not None:
            unsettled, most = examine_settling(usual, settled)
            measured["settling_lsb"] = round(most, 2)
            findings += unsettled
            best = settled if unsettled else usual
            signal = _hum_elsewhere(signal, settled, board)
    circuit = examine_circuit(
        best.mean,
        signal.noise_lsb,
        len(best.codes),
        board,
        examined.wire_ohm,
        moved=bool(signal.moved.any()),
    )
    findings += signal.findings
    findings += circuit.findings
    findings += _touched(circuit, signal)
    measured |= _figures(circuit, signal)
    if not (circuit.touched.any() or circuit.wrong.any() or signal.moved.any()):
        findings += _of_wires(examined, best, signal, measured)
    return findings


def _of_wires(
    examined: Examined, rest: RestScans, signal: Signal, measured: dict[str, Any]
) -> list[Finding]:
    board, scans = examined.board, len(rest.codes)
    wire_ohm = examined.wire_ohm or (TOP_WIRE_OHM, BOTTOM_WIRE_OHM)
    wires = measure_wires(rest.mean, signal.noise_lsb, scans, board, wire_ohm, examined.rest_ratio)
    measured["wires"] = wires_in_words(wires, wire_ohm)
    told = examined.wire_ohm is not None
    findings, lines = [], []
    if told or examined.rest_ratio is not None:
        findings = wire_findings(wires, wire_ohm, board.rows)
    if examined.rest_ratio is not None:
        lines = lines_in_words(wires, board.rows)
    if examined.presses is not None:
        seen = examined.presses.measure(rest.mean, scans, signal.noise_lsb, wire_ohm)
        measured["wires"] = all_of(seen).in_words(wire_ohm) if seen else NOT_PRESSED
        lines += [f"{each.where}: {each.share}" for each in seen]
        if seen and told and not findings:
            findings = pressed_findings(seen, wire_ohm)
    measured["wires_of_lines"] = lines
    return findings


def _hum_elsewhere(signal: Signal, settled: RestScans, board: Hello) -> Signal:
    """Hum that the board's own scan rate hides shows at another."""
    if not signal.hum_hidden or signal.hum_lsb:
        return signal
    hum = find_hum(settled)
    still = examine_signal(settled).hum_hidden
    hidden = tuple(each for each in signal.hum_hidden if each in still)
    if hum is None:
        return replace(signal, hum_hidden=hidden)
    findings = (*signal.findings, hum_finding(hum, board))
    return replace(signal, findings=findings, hum_lsb=hum.lsb, hum_hidden=hidden)


def _touched(circuit: Circuit, signal: Signal) -> list[Finding]:
    if not (circuit.touched.any() or signal.moved.any()):
        return []
    cells = circuit.touched if circuit.touched.any() else signal.moved
    return [
        Finding(
            "touched",
            "note",
            named(np.argwhere(cells)),
            "readings move" if signal.moved.any() else "conducts as if pressed",
            "nothing touches the skin meanwhile",
            "let go and run this again; if nothing is on the skin, look for what presses it there: "
            "a fold, a cable, a seam that is too tight",
        )
    ]


def _figures(circuit: Circuit, signal: Signal) -> dict[str, Any]:
    known = circuit.cell_siemens[np.isfinite(circuit.cell_siemens)]
    return {
        "noise_lsb": round(signal.noise_lsb, 3),
        "noise_of_adc_lsb": round(SOUND_NOISE_LSB, 3),
        "hum_lsb": round(signal.hum_lsb, 2),
        "hum_not_visible": list(signal.hum_hidden),
        "reference_ratio": circuit.reference_ratio and round(circuit.reference_ratio, 4),
        "cell_ohm": float(f"{1 / np.median(known):.3g}") if known.size else None,
    }


# --------------------------------------------------------------------------- board and link


def _of_board(examined: Examined) -> list[Finding]:
    board, findings = examined.board, []
    if examined.report is not None:
        findings += [_self_test(name, examined.report) for name in examined.report.findings]
    for cause in board.reset_cause:
        if cause in BAD_RESETS:
            findings.append(
                Finding(
                    "reset_cause",
                    "warning",
                    "board",
                    f"its last reset was by {cause.replace('_', '-')}",
                    "power-on or the reset pin",
                    BAD_RESETS[cause],
                )
            )
    if examined.host_version and board.version != examined.host_version:
        findings.append(
            Finding(
                "version",
                "note",
                "firmware",
                f"firmware {board.version}, host {examined.host_version}",
                "the same version; they do speak the same protocol",
                "'ohmskin flash' writes the firmware of this host",
            )
        )
    if examined.latency is not None and examined.latency[0] > 1:
        timer_ms, place = examined.latency
        findings.append(
            Finding(
                "usb_latency",
                "note",
                "USB bridge",
                f"latency timer {timer_ms} ms: scans may come so much later",
                "1 ms",
                f"echo 1 | sudo tee {place} (lasts until it is unplugged; a udev rule lasts)",
            )
        )
    return findings


def _self_test(name: str, report: SelfTestReport) -> Finding:
    doc = protocol.ENUMS["finding"].docs.get(name, "a finding of a newer firmware")
    what, _, cause = doc.partition(": ")
    return Finding(
        "self_test",
        "fault",
        f"{name.partition('_')[0]} sense node",
        f"{name}: {what}; codes {report.code_min} to {report.code_max}",
        "nothing that no skin can cause",
        f"look for a {cause or 'fault of the board'}",
    )


def _of_link(
    examined: Examined, usual: RestScans | None, measured: dict[str, Any]
) -> list[Finding]:
    stats, board = examined.stats, examined.board
    findings = []

    def warn(name: str, where: str, found: str, expected: str, to_do: str) -> None:
        findings.append(Finding(name, "warning", where, found, expected, to_do))

    made = stats.scans + stats.missed
    measured |= {
        "missed": stats.missed,
        "dropped_by_board": stats.dropped_by_board,
        "damaged": stats.line.damaged,
        "restarts": stats.restarts,
        "rate_hz": None,
    }
    if stats.restarts:
        cause = ", ".join(board.reset_cause) or "unknown"
        warn(
            *("restarted", "board", f"{stats.restarts} restarts meanwhile, the last by: {cause}"),
            "none",
            "check the USB cable and the supply; close programs that open the port as well",
        )
    if stats.missed:
        by_board = f", {stats.dropped_by_board} of them dropped by the board"
        warn(
            *("loss", "line", f"{stats.missed} of {made} scans missing{by_board}"),
            "every scan",
            "lower the scan rate, or raise the line's speed (?baud=1000000 behind the port)"
            if stats.dropped_by_board
            else "use a shorter cable and no hub; close programs that keep this machine busy",
        )
    if stats.line.damaged:
        warn(
            "damaged",
            "line",
            f"{stats.line.damaged} damaged frames ({stats.line.crc_errors} wrong CRCs)",
            "none",
            "use another USB cable, without a hub, away from motors' cables",
        )
    if stats.board_rx_errors:
        warn(
            *("receive_errors", "line", f"the board got {stats.board_rx_errors} damaged commands"),
            "none",
            "use another USB cable, without a hub, away from motors' cables",
        )
    if usual is None:
        if not stats.restarts and not stats.missed:
            warn(
                *("loss", "line", f"only {len(examined.scans)} scans came"),
                f"{board.rate_hz:.1f} a second",
                "check the cable, and that no other program uses the port",
            )
        return findings
    rate_hz, host_rate_hz = _rates_hz(examined.scans)
    measured["rate_hz"] = round(rate_hz, 3)
    asked_hz = board.rate_asked_mhz / 1000 or board.rate_hz
    if abs(rate_hz / asked_hz - 1) > RATE_TOLERANCE:
        warn(
            *("rate", "board", f"{rate_hz:.2f} scans/s by the board's clock"),
            f"{asked_hz:.2f} scans/s",
            "the firmware does not keep its rate: write it anew with 'ohmskin flash'",
        )
    if abs(host_rate_hz / rate_hz - 1) > SLOW_HOST and not stats.missed and not stats.restarts:
        found = f"{host_rate_hz:.1f} scans/s come by this machine's clock"
        findings.append(
            Finding(
                *("slow_host", "note", "host", found, f"{rate_hz:.1f} scans/s"),
                "close what keeps this machine busy; else the board's clock is off",
            )
        )
    return findings


def _rates_hz(scans: Sequence[Scan]) -> tuple[float, float]:
    """Scan rate by the board's clock, and by the host's if that is to be trusted [Hz]."""
    number = np.array([scan.number for scan in scans], dtype=np.float64)
    board_s = np.array([1e-6 * scan.time_us for scan in scans])
    host_s = np.array([scan.host_time_s for scan in scans])
    step, took_s = np.diff(number), np.diff(board_s)
    forward = (step > 0) & (took_s > 0)  # but for restarts
    rate_hz = float(step[forward].sum() / took_s[forward].sum()) if forward.any() else 0.0
    span_s = float(host_s[-1] - host_s[0])
    if span_s < LEAST_SPAN_S:
        return rate_hz, rate_hz
    return rate_hz, float(number[-1] - number[0]) / span_s
