# SPDX-License-Identifier: Apache-2.0
"""The pictures of the wiring: pins and resistors are those of firmware/src/wiring.h."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

WIRING = Path(__file__).resolve().parents[1] / "firmware" / "src" / "wiring.h"
# By picture: the name in wiring.h, the title, what its pins are called, and its supply.
BOARDS = {
    "wiring-uno": ("UNO", "Arduino Uno, Nano", "D", "5 V"),
    "wiring-megaatmega2560": ("MEGA", "Arduino Mega 2560", "D", "5 V"),
    "wiring-pico": ("PICO", "Raspberry Pi Pico", "GP", "3V3"),
}
BLACK, DRIVE, FAR = "black", "#b03a2e", "#00795a"
ROWS_Y, COLUMNS_X = {0: 8.2, 1: 7.4, 15: 6.0}, {0: 10.4, 1: 11.4, 15: 13.0}


def table(picture: str) -> dict[str, Any]:
    """What is connected to which pin of a board, as it is printed there; references [ohm]."""
    text = WIRING.read_text()
    board, title, letter, supply = BOARDS[picture]

    def numbers(name: str) -> list[str]:
        (found,) = re.findall(rf"#define OHMSKIN_{name} ([\d, ]+)", text)
        return found.replace(" ", "").split(",")

    wires = {
        name: [letter + pin for pin in numbers(f"{board}_{name}")]
        for name in ("ROWS", "COLUMNS", "TOP", "BOTTOM")
    }
    senses = ["A" + pin for pin in numbers("SENSE_INPUTS")]
    if letter == "GP":  # A0 is printed as GP26
        senses = [f"GP{26 + int(each[1:])}" for each in senses]
    (top_ohm,), (bottom_ohm,) = numbers("REF_TOP_OHM"), numbers("REF_BOTTOM_OHM")
    return wires | {
        "title": title,
        "supply": supply,
        "SENSE": senses,
        "REF_TOP": f"{int(top_ohm) / 1e3:g} kΩ",
        "REF_BOTTOM": f"{int(bottom_ohm) / 1e3:g} kΩ",
    }


def draw(axes: Any, at: dict[str, Any]) -> None:
    """A board by its `table`, multiplexers, references and skin."""
    _skin(axes)
    _box(axes, (0, -1.3), (2.6, 11.2), at["title"].replace(" ", "\n"), BLACK)
    _near(axes, 8.9, "row", [at["ROWS"], *at["TOP"], at["REF_TOP"], at["SENSE"][0]])
    _near(axes, 4.7, "column", [at["COLUMNS"], *at["BOTTOM"], at["REF_BOTTOM"], at["SENSE"][1]])
    for pin, y in ((at["supply"], 9.4), ("GND", 0.2)):
        _pin(axes, y, pin, BLACK)
    say = f"all multiplexers: VCC to {at['supply']},\nGND and EN to GND, 100 nF between"
    axes.text(3.0, 9.65, say, fontsize=8, va="center")
    _far(axes, at["SENSE"][2:])
    axes.set(xlim=(-0.2, 17.2), ylim=(-1.6, 11.2), aspect="equal")
    axes.axis("off")


def _wire(axes: Any, *points: tuple[float, float], colour: str = BLACK, far: bool = False) -> None:
    style = (0, (4, 2)) if far else "solid"
    axes.plot(*zip(*points, strict=True), color=colour, linewidth=1.2, linestyle=style, zorder=1)


def _box(
    axes: Any, corner: tuple[float, float], size: tuple[float, float], name: str, edge: str
) -> None:
    from matplotlib.patches import Rectangle

    style = "--" if edge == FAR else "-"
    patch = Rectangle(corner, *size, facecolor="#eeeeee", edgecolor=edge, linestyle=style, zorder=2)
    axes.add_patch(patch)
    middle = [at + length / 2 for at, length in zip(corner, size, strict=True)]
    axes.text(*middle, name, ha="center", va="center", fontsize=8, color=edge, zorder=3)


def _pin(axes: Any, y: float, name: str, colour: str) -> None:
    axes.text(2.5, y, name, ha="right", va="center", fontsize=8, color=colour, zorder=3)


def _skin(axes: Any) -> None:
    from matplotlib.patches import Rectangle

    middle = {"color": "#7d6608", "fontsize": 8}
    axes.add_patch(Rectangle((9.8, 5.4), 3.8, 3.4, facecolor="#fdf2d0", edgecolor="none"))
    for number, y in ROWS_Y.items():
        _wire(axes, (8.6, y), (14.6, y))
        axes.text(8.75, y + 0.06, f"row {number}", va="bottom", fontsize=7)
    for n, (number, x) in enumerate(COLUMNS_X.items()):
        y = 4.2 - 0.6 * n
        _wire(axes, (8.6, y), (x, y), (x, 9.5))
        axes.text(8.75, y + 0.06, f"column {number}", va="bottom", fontsize=7)
        for row_y in ROWS_Y.values():
            axes.plot(x, row_y, "s", color="#7d6608", markersize=7, zorder=3)
    axes.text(12.2, 6.7, "…", ha="center", va="center", **middle)
    axes.text(13.2, 4.9, "skin: each\ncrossing is\na cell", va="center", **middle)


def _near(axes: Any, top: float, line: str, pins: list[Any]) -> None:
    """A multiplexer whose upper edge is there; pins: S0 to S3, drive, reference, sense."""
    address, drive, reference, sense = pins
    _box(axes, (7.0, top - 3.9), (1.6, 3.9), f"{line}\nmultiplexer", BLACK)
    for n, pin in enumerate(address):
        y = top - 0.4 - 0.4 * n
        _pin(axes, y, pin, BLACK)
        _wire(axes, (2.6, y), (7.0, y))
        axes.text(6.9, y + 0.03, f"S{n}", ha="right", va="bottom", fontsize=7)
    drive_y, sense_y = top - 2.6, top - 3.4
    for y, pin in ((drive_y, drive), (sense_y, sense)):
        _pin(axes, y, pin, DRIVE)
    _wire(axes, (2.6, drive_y), (5.6, drive_y), (5.6, sense_y), colour=DRIVE)
    _wire(axes, (2.6, sense_y), (7.0, sense_y), colour=DRIVE)
    axes.plot(5.6, sense_y, "o", color=DRIVE, markersize=4)
    resistor = {"boxstyle": "square,pad=0.3", "facecolor": "white", "edgecolor": DRIVE}
    axes.text(4.1, drive_y, reference, ha="center", va="center", fontsize=8, bbox=resistor)
    axes.text(6.9, sense_y + 0.03, "common", ha="right", va="bottom", fontsize=7)


def _far(axes: Any, pins: list[str]) -> None:
    """The second pair, which is optional: its common pins alone go to pins of their own."""
    address = "S0-S3 as the\n{}"
    _box(axes, (14.6, 5.4), (1.9, 3.4), "far row\nmultiplexer\n\n" + address.format("rows'"), FAR)
    name = "far column multiplexer\n" + address.format("columns'").replace("\n", " ")
    _box(axes, (9.8, 9.5), (3.8, 1.2), name, FAR)
    axes.text(15.55, 9.1, "optional", ha="center", va="bottom", fontsize=8, color=FAR)
    for pin, y in zip(pins, (-0.4, -1.0), strict=True):
        _pin(axes, y, pin, FAR)
    _wire(axes, (2.6, -0.4), (15.5, -0.4), (15.5, 5.4), colour=FAR, far=True)
    _wire(axes, (2.6, -1.0), (16.9, -1.0), (16.9, 10.1), (13.6, 10.1), colour=FAR, far=True)
