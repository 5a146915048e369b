# SPDX-License-Identifier: Apache-2.0
"""What the doctor says: findings, and the order in which they matter."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

SEVERITIES: Final = {
    "fault": "readings are wrong",
    "warning": "readings are worse than they could be",
    "note": "good to know; nothing is wrong with the skin",
}
# Within a severity, what hides or explains others comes first.
ORDER: Final = (
    *("port_unusable", "nothing_answers", "protocol_mismatch", "lost"),
    *("self_test", "nothing_conducts", "open_row", "open_column", "short_rows", "short_columns"),
    *("dead_cell", "saturated_cell", "reference_ratio", "settling"),
    *("reset_cause", "restarted", "loss", "damaged", "receive_errors", "rate"),
    *("hum", "noise", "wires"),
    *("touched", "unsettled_unknown", "version", "usb_latency", "slow_host"),
)
NOT_KNOWN: Final = "not known"  # how a figure begins that could not be had


@dataclass(frozen=True)
class Finding:
    """One thing found. id: one of `ORDER`; severity: one of `SEVERITIES`."""

    id: str
    severity: str
    where: str
    measured: str
    expected: str
    what_to_do: str

    def __post_init__(self) -> None:
        if self.id not in ORDER or self.severity not in SEVERITIES:
            raise ValueError(f"no finding '{self.id}' of severity '{self.severity}'")


@dataclass(frozen=True)
class Diagnosis:
    """Findings in the order in which they matter, and the figures behind them, by name."""

    findings: tuple[Finding, ...]
    measured: dict[str, Any]

    @property
    def wrong(self) -> bool:
        """Whether there is more than notes."""
        return any(finding.severity != "note" for finding in self.findings)

    @property
    def verdict(self) -> str:
        """One line: whether the skin is sound."""
        worse = [finding for finding in self.findings if finding.severity != "note"]
        touched = any(finding.id == "touched" for finding in self.findings)
        if worse:
            text = f"not sound: {len(worse)} finding{'s' if len(worse) > 1 else ''}, "
            return text + f"first {_spoken(worse[0])}"
        if touched:
            return "no fault found, but something touches the skin: let go, and run this again"
        if str(self.measured.get("wires", "")).startswith(NOT_KNOWN):
            return "sound: nothing is wrong that an untouched skin shows; --press shows its wires"
        return "sound: nothing is wrong"


def _spoken(finding: Finding) -> str:
    return f"{finding.id.replace('_', ' ')} ({finding.where})"


def in_order(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Faults first, then warnings, then notes; each as in `ORDER`."""
    severity = list(SEVERITIES)
    return tuple(
        sorted(findings, key=lambda each: (severity.index(each.severity), ORDER.index(each.id)))
    )


def named(cells: Iterable[tuple[int, int]], most: int = 6) -> str:
    """Cells by name, so many of them at the most."""
    names = [f"({int(row)}, {int(column)})" for row, column in cells]
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"cell{'s' if len(names) > 1 else ''} {', '.join(names[:most])}{more}"
