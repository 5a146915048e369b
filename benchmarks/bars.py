# SPDX-License-Identifier: Apache-2.0
"""What figures have to be, the table that says whether they are, and the command of a benchmark.

Every benchmark prints a table of its figures with their bars and, as the last line, one JSON
object. The exit code is 1 when a bar is missed. With --quick, bars do not count.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

Figures = Mapping[str, float | None]


@dataclass(frozen=True)
class Bar:
    """What a figure has to be.

    figure: its name.
    wanted: in words.
    met: whether a number is that.
    """

    figure: str
    wanted: str
    met: Callable[[float], bool]


def at_most(figure: str, limit: float) -> Bar:
    return Bar(figure, f"<= {limit:g}", lambda value: value <= limit)


def at_least(figure: str, limit: float) -> Bar:
    return Bar(figure, f">= {limit:g}", lambda value: value >= limit)


def about(figure: str, middle: float, off: float) -> Bar:
    return Bar(figure, f"{middle:g} ± {off:g}", lambda value: abs(value - middle) <= off)


def report(figures: Figures, bars: Iterable[Bar]) -> bool:
    """Print all figures (None: not measured here) and their bars; true when all are met.

    Raises KeyError for a bar of a figure that nobody measures: it would always be met.
    """
    by_figure: dict[str, list[Bar]] = {}
    for bar in bars:
        by_figure.setdefault(bar.figure, []).append(bar)
    if by_figure.keys() - figures.keys():
        raise KeyError(f"no figure {', '.join(sorted(by_figure.keys() - figures.keys()))}")
    all_met = True
    print(f"{'figure':38}{'measured':>12}  {'bar':14}")
    for name, value in figures.items():
        own = by_figure.get(name, [])
        met = all(value is not None and bar.met(value) for bar in own)
        all_met = all_met and met
        wanted = ", ".join(dict.fromkeys(bar.wanted for bar in own))
        verdict = ("pass" if met else "FAIL") if own else ""
        print(f"{name:38}{'-' if value is None else value:>12}  {wanted:14}{verdict}".rstrip())
    return all_met


@dataclass(frozen=True)
class Part:
    """How much of its work a benchmark does: all of it, or a little with --quick.

    share: of skins, frames and times.
    """

    share: float = 1.0

    def of(self, count: int) -> int:
        """So many of these; one at least."""
        return max(1, round(self.share * count))


ALL, QUICK = Part(), Part(0.01)


def options(text: str | None) -> argparse.ArgumentParser:
    """The command line of a benchmark; text: its docstring."""
    parser = argparse.ArgumentParser(description=(text or "").partition("\n")[0])
    words = "see that it runs, in seconds: its figures mean nothing"
    parser.add_argument(
        "--quick", dest="part", action="store_const", const=QUICK, default=ALL, help=words
    )
    return parser


def finish(part: Part, figures: Figures, bars: Iterable[Bar]) -> int:
    """Print the table and the JSON object: the exit code."""
    all_met = report(figures, bars)
    print(json.dumps(figures))
    return 0 if all_met or part is QUICK else 1


def run(text: str | None, measure: Callable[[Part], Figures], bars: Iterable[Bar]) -> int:
    """A benchmark without options of its own."""
    part: Part = options(text).parse_args().part
    return finish(part, measure(part), bars)


def run_minutes(
    text: str | None,
    measure: Callable[[float], Figures],
    bars: Iterable[Bar],
    *,
    minutes: float,
    least_minutes: float,
) -> int:
    """A benchmark that takes so many minutes, or those of --minutes; with --quick the least."""
    parser = options(text)
    parser.add_argument("--minutes", type=float, default=minutes, help="how long to measure")
    asked = parser.parse_args()
    part: Part = asked.part
    return finish(part, measure(least_minutes if part is QUICK else asked.minutes), bars)
