# SPDX-License-Identifier: Apache-2.0
"""What figures have to be, and the table that says whether they are."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Bar:
    """What a figure has to be."""

    figure: str
    wanted: str
    met: Callable[[float], bool]


def at_most(figure: str, limit: float) -> Bar:
    return Bar(figure, f"<= {limit:g}", lambda value: value <= limit)


def at_least(figure: str, limit: float) -> Bar:
    return Bar(figure, f">= {limit:g}", lambda value: value >= limit)


def report(figures: Mapping[str, float | None], bars: Iterable[Bar]) -> bool:
    """Print all figures (None: not measured here) and their bars; true when all are met."""
    by_figure = {bar.figure: bar for bar in bars}
    all_met = True
    print(f"{'figure':38}{'measured':>12}  {'bar':14}")
    for name, value in figures.items():
        bar = by_figure.get(name)
        met = bar is None or (value is not None and bar.met(value))
        all_met = all_met and met
        wanted, verdict = ("", "") if bar is None else (bar.wanted, "pass" if met else "FAIL")
        print(f"{name:38}{'-' if value is None else value:>12}  {wanted:14}{verdict}".rstrip())
    return all_met
