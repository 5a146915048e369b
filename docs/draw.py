#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Draw the pictures of the pages about hardware, and print the numbers in them. No simulation.

python docs/draw.py            write docs/*.svg
python docs/draw.py --check    change nothing, exit 1 when one is stale

A picture keeps a digest of its numbers and of the files that draw it, by which it is told to be
current: matplotlib draws a little differently from version to version.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
sys.path[:0] = [str(ROOT / "host"), str(DOCS)]

import draw_wiring  # noqa: E402

from ohmskin.circuit.configurations import current_std  # noqa: E402
from ohmskin.link import framing, protocol  # noqa: E402
from ohmskin.link.codes import ADC_BITS, ratio_std  # noqa: E402

CLOCK_HZ = 16_000_000
# Hold to the change of pins, at most, and to the end of the conversion, at an ADC clock of 500 kHz.
PINS_CYCLES = 104
HELD_CYCLES = 23 * 32 // 2
CELLS_OHM = (1e3, 1e4, 1e5, 1e6)
REFERENCES_OHM = (3e3, 1e4, 3e4, 1e5)
SIZES = range(1, 17)
BITS_PER_BYTE = 10  # 8N1


def _constant(path: str, pattern: str) -> int:
    """A number of the firmware, from its source."""
    found = re.search(pattern, (ROOT / "firmware/src" / path).read_text())
    if found is None:
        raise ValueError(f"firmware/src/{path} has no '{pattern}': mend docs/draw.py")
    return int(found[1])


# ------------------------------------------------------------------------------------- numbers


def relative_std(cell_ohm: np.ndarray | float, ref_ohm: np.ndarray | float) -> Any:
    """std(g) / g = (1 + g R)^2 std(I) / g, R both references: one cell alone, without wires."""
    siemens, loop_ohm = 1.0 / np.asarray(cell_ohm), 2.0 * np.asarray(ref_ohm)
    std = np.vectorize(lambda ref: current_std(ratio_std(ADC_BITS), ref, ref))(ref_ohm)
    return (1.0 + siemens * loop_ohm) ** 2 * std / siemens


def slot() -> dict[str, float]:
    """A slot at the default setting (8x8, 90 Hz), clock cycles from the timer's zero."""
    trigger = _constant("board_avr.cpp", r"TRIGGER_AT = (\d+);")
    entry = _constant("board_avr.cpp", r"PINS_AFTER_INTERRUPT = (\d+);")
    spare = _constant("board_avr.cpp", r"PINS_SPARE = (\d+);")
    prescaler = 32
    hold = trigger + 2 * prescaler + 3
    readings, period = 256, round(CLOCK_HZ / 90)
    # Equal slots of whole cycles, with so many idle ones that the period is kept to 200 ppm.
    slots = next(n for n in range(readings, 300) if abs(round(period / n) * n - period) <= 35)
    cycles = round(period / slots)
    return {
        "trigger": trigger,
        "hold": hold,
        "interrupt": hold + prescaler // 2 + spare - entry,
        "pins_set": hold + PINS_CYCLES,
        "conversion_done": trigger + 13 * prescaler + prescaler // 2 + 3,
        "cycles": cycles,
        "slots": slots,
        "rate_hz": CLOCK_HZ / (cycles * slots),
        "pins_us": (cycles - PINS_CYCLES) * 1e6 / CLOCK_HZ,
        "settle_us": (cycles - HELD_CYCLES) * 1e6 / CLOCK_HZ,
    }


def scan_rates() -> dict[str, list[float]]:
    """Fastest scans a second of n x n cells: by the converter, and by the line."""
    scan = protocol.FRAMES["scan"]
    cells = np.array([n * n for n in SIZES])
    octets = np.array(
        [
            len(
                framing.encode(
                    scan.id, 1, b"\1" * (scan.struct.size + protocol.codes_size(4 * n * n))
                )
            )
            for n in SIZES
        ]
    )
    readings = len(protocol.MODES["near"]) * cells
    settle_us = _constant("core/scan_plan.h", r"SETTLE_US\[\] = \{(\d+),")
    rates = {"converter": CLOCK_HZ / ((HELD_CYCLES + settle_us * CLOCK_HZ / 1e6) * readings)}
    for name in ("baud_default", "baud_fast"):
        rates[name] = protocol.CONSTANTS[name] / BITS_PER_BYTE / octets
    most = protocol.CONSTANTS["rate_mhz_max"] / 1000
    return {name: np.minimum(rate, most).tolist() for name, rate in rates.items()}


def numbers() -> dict[str, Any]:
    """What is drawn, by picture."""
    precision = {
        f"{ref:g}": [float(relative_std(c, ref)) for c in CELLS_OHM] for ref in REFERENCES_OHM
    }
    return {
        "reference-resistor": precision,
        "kneading": None,
        "circuit": None,
        "far-ends": None,
        "slot": slot(),
        "scan-rate": scan_rates(),
        **{picture: draw_wiring.table(picture) for picture in draw_wiring.BOARDS},
    }


def report(drawn: dict[str, Any]) -> None:
    """Print the numbers of the pages."""
    print("standard deviation of a cell's conductance, 10 bit [%]")
    print("references [ohm] \\ cell [ohm]  " + "".join(f"{cell:>9.0e}" for cell in CELLS_OHM))
    for ref, shares in drawn["reference-resistor"].items():
        print(f"{ref:>30}  " + "".join(f"{100 * share:9.2f}" for share in shares))
    at = drawn["slot"]
    print(
        f"slot at 8x8, 90 Hz: {at['cycles']} cycles, {1e6 * at['cycles'] / CLOCK_HZ:.2f} us; "
        f"{at['slots']} slots a scan, {at['rate_hz']:.2f} Hz;\n"
        f"settle time of the pins {at['pins_us']:.1f} us, "
        f"of the sample capacitor {at['settle_us']:.1f} us"
    )
    rates = drawn["scan-rate"]
    print("fastest scans a second:   converter   500 kbaud   1 Mbaud")
    for n in (4, 8, 10, 12, 16):
        print(f"{n:>17}x{n:<6}" + "".join(f"{rates[name][n - 1]:12.1f}" for name in rates))


# ------------------------------------------------------------------------------------ pictures


def _draw_precision(axes: Any) -> None:
    ref_ohm = np.geomspace(1e3, 3e5, 200)
    for cell_ohm, name in zip(CELLS_OHM, ("1 kΩ", "10 kΩ", "100 kΩ", "1 MΩ"), strict=True):
        axes.loglog(1e-3 * ref_ohm, 100 * relative_std(cell_ohm, ref_ohm), label=f"cell {name}")
    axes.axvline(30, color="black", linestyle=":", label="30 kΩ")
    axes.set(
        xlabel="each reference resistor [kΩ]",
        ylabel="std of the conductance [%]",
        title="What rounding to 10 bit costs",
        ylim=(0.1, 30),
    )
    axes.set_xticks([1, 3, 10, 30, 100, 300], ["1", "3", "10", "30", "100", "300"])
    axes.set_yticks([0.1, 0.3, 1, 3, 10, 30], ["0.1", "0.3", "1", "3", "10", "30"])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.figure.legend(loc="outside right center", frameon=False)


def _draw_slot(axes: Any) -> None:
    at = slot()
    us = 1e6 / CLOCK_HZ
    rows = {"timer 1": 3, "converter": 2, "interrupt": 1, "pins, multiplexers": 0}
    colours = {
        "samples": "#f2b705",
        "converts": "#7fb3d5",
        "sets the pins": "#c39bd3",
        "pins may still change": "#f5b7b1",
        "pins set: the skin settles": "#a9dfbf",
    }

    def bar(row: str, begin: float, end: float, colour: str, text: str = "") -> None:
        fill = colours.get(colour, colour)
        axes.barh(rows[row], us * (end - begin), left=us * begin, color=fill, height=0.55)
        axes.text(us * (begin + end) / 2, rows[row], text, ha="center", va="center", fontsize=8)

    period = at["cycles"]
    bar("pins, multiplexers", 0, at["hold"], "pins set: the skin settles")
    for start, name in ((0, "k"), (period, "k+1")):
        hold, pins_set = start + at["hold"], start + at["pins_set"]
        bar("timer 1", start, start + period, "#eeeeee" if start else "#dddddd", f"slot {name}")
        bar("converter", start + at["trigger"], hold, "samples")
        bar("converter", hold, start + at["conversion_done"], "converts", f"converts {name}")
        bar("interrupt", start + at["interrupt"], pins_set, "sets the pins")
        bar("pins, multiplexers", hold, pins_set, "pins may still change")
        settled = min(period + hold, 2 * period)
        text = "for k+2" if start else f"for k+1: {at['pins_us']:.1f} us"
        bar("pins, multiplexers", pins_set, settled, "pins set: the skin settles", text)
        axes.plot([us * hold, us * hold], [-0.4, 3.4], color="#b03a2e", linewidth=1)
        axes.text(us * hold, 3.5, f"hold {name}", color="#b03a2e", ha="center", fontsize=8)
    patches = [axes.barh(0, 0, color=colour, label=name) for name, colour in colours.items()]
    axes.figure.legend(handles=patches, loc="outside lower center", ncols=3, frameon=False)
    axes.set_yticks(list(rows.values()), list(rows))
    axes.set(xlabel="time [us]", xlim=(0, us * 2 * period), ylim=(-0.5, 3.9))
    axes.set_title("Two slots at 90 Hz, 8x8")
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)


def _draw_rates(axes: Any) -> None:
    rates = scan_rates()
    names = {
        "converter": "converter, 20 us to settle",
        "baud_default": "line, 500 kbaud",
        "baud_fast": "line, 1 Mbaud",
    }
    for name, label in names.items():
        axes.semilogy(list(SIZES), rates[name], marker="o", markersize=3, label=label)
    axes.axhline(90, color="black", linestyle=":", label="90 Hz, the default")
    axes.set(
        xlabel="rows = columns", ylabel="scans a second, at most", title="What limits the rate"
    )
    axes.set_xticks([1, 2, 4, 6, 8, 10, 12, 14, 16])
    axes.set_yticks([30, 100, 300, 1000, 2000], ["30", "100", "300", "1000", "2000"])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend()


def _draw_circuit(axes: Any) -> None:
    """A 2x2 skin, the port of cell (0, 0) selected, the other three cells pressed."""
    black, ghost = "black", "#b03a2e"
    top_y, column_x, apart = (2.0, 0.0), (2.0, 5.0), 0.9

    def wire(*points: tuple[float, float], colour: str = black) -> None:
        axes.plot(*zip(*points, strict=True), color=colour, linewidth=1.2, zorder=1)

    def resistor(x: float, y: float, name: str, angle: float = 0.0, fill: str = "white") -> None:
        box = {"boxstyle": "square,pad=0.25", "facecolor": fill, "edgecolor": black}
        axes.text(x, y, name, rotation=angle, ha="center", va="center", fontsize=7, bbox=box)

    for i, y in enumerate(top_y):
        wire((-0.4, y), (column_x[1], y))
        axes.plot(-0.4, y, "o", color=black, markersize=4)
        for j, x in enumerate(column_x):
            resistor(x - 1.5, y, f"Rt[{i},{j}]")
    for j, x in enumerate(column_x):
        wire((x + apart, 3.6), (x + apart, top_y[1] - apart))
        axes.plot(x + apart, 3.6, "o", color=black, markersize=4)
        for i, y in enumerate(top_y):
            resistor(x + apart, y + 0.45, f"Rb[{i},{j}]")
            colour = black if i == j == 0 else ghost
            wire((x, y), (x + apart, y - apart), colour=colour)
            resistor(
                x + apart / 2,
                y - apart / 2,
                f"g[{i},{j}]",
                -45,
                "white" if i == j == 0 else "#f5b7b1",
            )
            axes.plot([x, x + apart], [y, y - apart], "o", color=black, markersize=2.5)
    ghosts = [(column_x[1], top_y[0]), (column_x[1] + apart, top_y[0] - apart)]
    wire((column_x[0], top_y[0]), ghosts[0], colour=ghost)
    wire(ghosts[1], (column_x[1] + apart, top_y[1] - apart), colour=ghost)
    wire((column_x[1], top_y[1]), (column_x[0], top_y[1]), colour=ghost)
    wire(
        (column_x[0] + apart, top_y[1] - apart),
        (column_x[0] + apart, top_y[0] - apart),
        colour=ghost,
    )
    wire((-0.4, 2), (-1.6, 2), (-1.6, 3.3), (-1.6, 4.6))
    resistor(-1.6, 2.75, "row\nmultiplexer", 0, "#eeeeee")
    resistor(-1.6, 4.1, "R_top")
    axes.text(-1.6, 4.7, "drive top", ha="center", va="bottom", fontsize=8)
    axes.annotate(
        "A0: A, D",
        (-1.6, 3.4),
        (-3.0, 3.4),
        va="center",
        fontsize=8,
        arrowprops={"arrowstyle": "-"},
    )
    wire((column_x[0] + apart, 3.6), (column_x[0] + apart, 4.6), (8.2, 4.6))
    resistor(4.6, 4.6, "column multiplexer", 0, "#eeeeee")
    resistor(7.2, 4.6, "R_bottom")
    axes.text(8.3, 4.6, "drive bottom", ha="left", va="center", fontsize=8)
    axes.annotate(
        "A1: B, C", (6.2, 4.6), (6.2, 5.3), ha="center", fontsize=8, arrowprops={"arrowstyle": "-"}
    )
    axes.set(xlim=(-3.2, 9.9), ylim=(-1.3, 5.6), aspect="equal")
    axes.axis("off")


def _draw_far_ends(axes: Any) -> None:
    """A 2x2 skin with multiplexers at both ends: cell (0, 0) selected, pressed alone."""
    from matplotlib.patches import Rectangle

    grey, current, sense = "#999999", "#b03a2e", "#00795a"
    rows_y, columns_x, apart = (2.0, 0.0), (2.0, 5.0), 0.9

    def wire(*points: tuple[float, float], colour: str = grey, width: float = 1.2) -> None:
        axes.plot(*zip(*points, strict=True), color=colour, linewidth=width, zorder=1)

    def resistor(x: float, y: float, name: str, angle: float = 0.0) -> None:
        box = {"boxstyle": "square,pad=0.25", "facecolor": "white", "edgecolor": "black"}
        axes.text(x, y, name, rotation=angle, ha="center", va="center", fontsize=7, bbox=box)

    def multiplexer(x: float, y: float, width: float, height: float, name: str) -> None:
        axes.add_patch(
            Rectangle((x, y), width, height, facecolor="#eeeeee", edgecolor="black", zorder=2)
        )
        upright = 90 if height > width else 0
        place = (x + width / 2, y + height / 2)
        axes.text(*place, name, rotation=upright, ha="center", va="center", fontsize=8, zorder=3)

    def node(x: float, y: float, name: str, colour: str, up: int) -> None:
        axes.plot(x, y, "o", color=colour, markersize=5, zorder=4)
        place = {"xytext": (0, 6 * up), "textcoords": "offset points", "ha": "center"}
        beside = {"va": "bottom" if up > 0 else "top", "color": colour, "fontweight": "bold"}
        axes.annotate(name, (x, y), fontsize=9, **place, **beside)

    for i, y in enumerate(rows_y):
        wire((-1.0, y), (7.4, y))
        for j, x in enumerate(columns_x):
            resistor(x - 1.4, y, f"Rt[{i},{j}]")
    for j, x in enumerate(columns_x):
        wire((x + apart, 3.6), (x + apart, -2.1))
        for i, y in enumerate(rows_y):
            resistor(x + apart, y + 0.45, f"Rb[{i},{j}]")
            wire((x, y), (x + apart, y - apart))
            resistor(x + apart / 2, y - apart / 2, f"g[{i},{j}]", -45)
    far = {"colour": sense, "width": 2.2}
    wire((columns_x[0], rows_y[0]), (7.4, rows_y[0]), **far)
    wire((8.1, 1.0), (8.9, 1.0), **far)
    wire((columns_x[0] + apart, rows_y[0] - apart), (columns_x[0] + apart, -2.1), **far)
    wire((4.4, -2.8), (4.4, -3.4), **far)
    path = [(-3.6, 4.7), (-3.6, 1.0), (-1.7, 1.0)]
    wire(*path, colour=current, width=2.2)
    cell = [(2.0, 2.0), (2.9, 1.1), (2.9, 3.6)]
    wire((-1.0, 2.0), *cell, colour=current, width=2.2)
    wire((4.4, 4.3), (4.4, 5.0), (8.9, 5.0), colour=current, width=2.2)
    resistor(-3.6, 3.2, "R_top")
    resistor(7.3, 5.0, "R_bottom")
    multiplexer(-1.7, -0.6, 0.7, 3.2, "rows, near")
    multiplexer(7.4, -0.6, 0.7, 3.2, "rows, far")
    multiplexer(2.2, 3.6, 4.4, 0.7, "columns, near")
    multiplexer(2.2, -2.8, 4.4, 0.7, "columns, far")
    axes.text(-3.6, 4.8, "D2: Vdd", ha="center", va="bottom", fontsize=8)
    axes.text(9.0, 5.0, "D3: ground", ha="left", va="center", fontsize=8)
    node(-3.6, 1.0, "a, to A0", current, -1)
    node(5.6, 5.0, "b, to A1", current, 1)
    node(8.9, 1.0, "e, to A2", sense, -1)
    node(4.4, -3.4, "f, to A3", sense, -1)
    axes.plot([], [], color=current, linewidth=2.2, label="carries the current")
    axes.plot([], [], color=sense, linewidth=2.2, label="carries none: shows the crossing")
    axes.plot([], [], color=grey, linewidth=1.2, label="not selected: floats")
    axes.legend(loc="lower left", bbox_to_anchor=(-0.02, 0.0), frameon=False, fontsize=8)
    axes.set(xlim=(-4.6, 10.6), ylim=(-4.1, 5.6), aspect="equal")
    axes.axis("off")


def _draw_kneading(axes: Any) -> None:
    """From the side: skin, plate, load cell, table; where the force goes, and where it must not."""
    from matplotlib.patches import Ellipse, FancyBboxPatch, Rectangle

    force, metal = "#b03a2e", "#c8ccd0"

    def box(x: float, y: float, width: float, height: float, colour: str) -> None:
        size = {"facecolor": colour, "edgecolor": "black", "linewidth": 1, "zorder": 2}
        axes.add_patch(Rectangle((x, y), width, height, **size))

    def say(text: str, at: tuple[float, float], words: tuple[float, float], side: str) -> None:
        line = {"arrowstyle": "-", "color": "#777777", "linewidth": 0.8}
        axes.annotate(text, at, words, ha=side, va="center", fontsize=8, arrowprops=line, zorder=6)

    def arrow(x: float, y: float, to_x: float, to_y: float) -> None:
        style = {"arrowstyle": "-|>", "color": force, "linewidth": 2}
        axes.annotate("", (to_x, to_y), (x, y), arrowprops=style, zorder=5)

    box(-5.5, -1.2, 12.5, 0.5, "#d9c7a8")  # table
    box(-2.2, -0.7, 1.0, 0.35, metal)  # what the load cell is screwed to
    box(-2.2, -0.35, 4.4, 0.7, "#e8ebee")  # load cell
    for x in (-0.32, 0.32):
        axes.add_patch(Ellipse((x, 0.0), 0.5, 0.5, facecolor="white", edgecolor="black", zorder=3))
    box(1.2, 0.35, 1.0, 0.35, metal)  # spacer
    box(-3.2, 0.7, 6.4, 0.3, metal)  # plate
    # The skin: two layers of stripes.
    skin = FancyBboxPatch((-2.7, 1.0), 5.4, 0.34, boxstyle="round,pad=0,rounding_size=0.12")
    skin.set(facecolor="#7fb3d5", edgecolor="black", zorder=2)
    axes.add_patch(skin)
    for n in range(8):
        axes.add_patch(Rectangle((-2.45 + 0.65 * n, 1.19), 0.36, 0.08, color="#24506e", zorder=3))
    axes.plot([-2.6, 2.6], [1.09, 1.09], color="#24506e", linewidth=2, zorder=3)
    for width, colour in ((28, "black"), (26, "#efc9a9")):  # a finger
        ends = [-1.0, -0.4], [1.75, 3.0]
        axes.plot(*ends, color=colour, linewidth=width, solid_capstyle="round", zorder=4)
    arrow(-1.0, 2.6, -1.0, 1.45)
    arrow(1.7, 0.95, 1.7, 0.1)
    arrow(-1.7, -0.1, -1.7, -0.9)
    axes.plot([2.7, 3.4, 3.9, 4.2], [1.15, 1.0, 0.2, -0.7], color="#24506e", linewidth=1.5)
    axes.plot([2.2, 2.9, 3.1], [-0.1, -0.35, -0.7], color="black", linewidth=1.2)
    box(4.0, -0.7, 1.3, 0.45, "#2f7d5b")
    box(2.7, -0.7, 0.8, 0.3, "#b5482f")
    say(
        "load cell: one end on the table,\nthe other under the plate",
        (-2.0, 0.1),
        (-3.6, -0.1),
        "right",
    )
    say("plate, stiff", (-3.1, 0.85), (-3.6, 1.05), "right")
    say("skin, all of it on the plate", (-2.5, 1.2), (-3.6, 1.75), "right")
    say("press anywhere, softly and hard", (-1.15, 2.4), (-3.6, 2.6), "right")
    say(
        "cables lie loose: a tight one\ncarries force past the load cell",
        (3.6, 0.7),
        (4.4, 1.3),
        "left",
    )
    say("the skin's board, to USB", (4.9, -0.5), (5.5, 0.3), "left")
    say("HX711 and its board, to USB", (3.1, -0.65), (3.6, -1.6), "left")
    axes.plot([], [], color=force, linewidth=2, label="all of the force goes this way")
    axes.legend(loc="upper right", frameon=False, fontsize=8)
    axes.set(xlim=(-7.6, 9.3), ylim=(-1.9, 3.5), aspect="equal")
    axes.axis("off")


PICTURES = {
    "kneading": (_draw_kneading, (8.0, 2.9)),
    "reference-resistor": (_draw_precision, (7.0, 3.4)),
    "circuit": (_draw_circuit, (8.0, 4.3)),
    "far-ends": (_draw_far_ends, (8.0, 5.1)),
    "slot": (_draw_slot, (8.0, 3.6)),
    "scan-rate": (_draw_rates, (6.4, 3.8)),
    **{
        picture: (lambda axes, name=picture: draw_wiring.draw(axes, draw_wiring.table(name)), size)
        for picture, size in dict.fromkeys(draw_wiring.BOARDS, (8.0, 6.0)).items()
    },
}


def _digest(content: Any) -> str:
    rounded = json.loads(json.dumps(content), parse_float=lambda text: f"{float(text):.6g}")
    sources = [Path(__file__), Path(draw_wiring.__file__)]
    text = "".join(path.read_text() for path in sources) + json.dumps(rounded)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def stale(drawn: dict[str, Any]) -> list[Path]:
    """Pictures that are missing, or drawn of other numbers or by other sources."""
    paths = {name: DOCS / f"{name}.svg" for name in PICTURES}
    return [
        path
        for name, path in paths.items()
        if not path.exists() or f"digest {_digest(drawn[name])}" not in path.read_text()
    ]


def draw(drawn: dict[str, Any]) -> None:
    """Write all pictures."""
    import matplotlib

    matplotlib.use("svg")
    from matplotlib import pyplot

    pyplot.rcParams.update({"svg.hashsalt": "ohmskin", "font.size": 9})
    for name, (artist, size) in PICTURES.items():
        figure, axes = pyplot.subplots(figsize=size, layout="constrained")
        artist(axes)
        note = f"Written by docs/draw.py; do not edit. digest {_digest(drawn[name])}"
        figure.savefig(DOCS / f"{name}.svg", metadata={"Date": None, "Description": note})
        pyplot.close(figure)


def main() -> int:
    """Draw, or check."""
    drawn = numbers()
    if sys.argv[1:] == ["--check"]:
        for path in stale(drawn):
            print(f"{path.relative_to(ROOT)} is stale: run 'python docs/draw.py'", file=sys.stderr)
        return 1 if stale(drawn) else 0
    report(drawn)
    draw(drawn)
    return 0


if __name__ == "__main__":
    sys.exit(main())
