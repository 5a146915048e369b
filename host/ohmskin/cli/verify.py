# SPDX-License-Identifier: Apache-2.0
"""``ohmskin verify``: a board against a reference plate, known resistors at its crossings."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
from typer import Argument, Option

import ohmskin
from ohmskin.arrays import numbers
from ohmskin.circuit.configurations import CONFIGURATIONS
from ohmskin.circuit.plate import load_plate
from ohmskin.cli.board import Leads, Port, Wires, wires_of
from ohmskin.cli.doctor import as_object, print_page, terminal
from ohmskin.cli.doctor_words import line_in_words
from ohmskin.cli.picture import check_picture, picture
from ohmskin.cli.terminal import Terminal
from ohmskin.doctor.examine import examine
from ohmskin.doctor.gather import gather_plate
from ohmskin.doctor.plate import PlateExam, Tolerance
from ohmskin.emulate.scenes import LEAD_OHM
from ohmskin.files import check_place, whole_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST: Final = Tolerance()
_out = Terminal(soft_wrap=True, highlight=False)


def _most(what: str) -> Any:
    return Option(min=0.0, help=f"most {what}", rich_help_panel="Tolerances")


def verify(
    port: Port,
    plate: Annotated[Path, Argument(help="ohms at each crossing (.csv), 'open' for none")],
    wires: Wires = "0,0",
    leads: Leads = LEAD_OHM,
    seconds: Annotated[float, Option(min=0.5, help="so long losses are counted")] = 60.0,
    png: Annotated[Path | None, Option("--picture", help="PNG to write")] = None,
    json_file: Annotated[str, Option("--json", help="file for all figures; -: here")] = "",
    cell_percent: Annotated[
        float, _most("error of a cell: 1 % of a resistor, 2 % of multiplexers and converter")
    ] = _MOST.cell_percent,
    reference_percent: Annotated[
        float, _most("error of a reference: 1 % of itself, the rest of the converter")
    ] = _MOST.reference_percent,
    settling_lsb: Annotated[
        float, _most("change with more time: 30 pF a line and 100 pF a node make 3")
    ] = _MOST.settling_lsb,
    loss: Annotated[float, _most("share of lost scans: a sound line loses none")] = 0.0,
) -> None:
    """Compare the board at PORT with a plate of known resistors.

    Finds wrong resistors, swapped lines, wrong references, readings that are not linear or not
    settled, noise by ADC clock, and lost scans. Leaves the board as it was. Exit code 0: all is
    within the tolerances; 1: something is not.
    """
    if png is not None:
        check_picture(png, plate)
    if json_file not in ("", "-"):
        check_place(Path(json_file), plate, ending=".json")
    tolerance = Tolerance(cell_percent, reference_percent, settling_lsb)
    exam = PlateExam(load_plate(plate), wires_of(wires, leads), tolerance)
    with terminal() as report, ohmskin.open(port, start=False) as device:
        evidence = gather_plate(device, exam.plate.shape, report, seconds)
    evidence.loss = loss
    diagnosis = examine(evidence, exam.examine)
    page = as_object(port, diagnosis)
    everything = json.dumps(page | {"hello": evidence.board, "exam": vars(exam)}, default=_plain)
    if json_file == "-":
        print(everything)  # noqa: T201
    else:
        print_page(page)
        _print_exam(exam)
    if json_file not in ("", "-"):
        with whole_file(json_file) as file:
            file.write(everything.encode())
    if png is not None:
        with picture(png, (15, 5), f"{port}: {page['verdict']}") as figure:
            _draw(figure, exam)
    if diagnosis.worse:
        raise SystemExit(1)


def _plain(value: Any) -> Any:
    """Arrays as lists, and objects with fields as dictionaries, for JSON."""
    return numbers(value) if isinstance(value, np.ndarray) else asdict(value)


def _print_exam(exam: PlateExam) -> None:
    """Readings, noise, and the error of each resistor, for people."""
    for name, line in exam.lines.items():
        _out.print(f"reading {name:<10}  {line_in_words(line)}")
    for clock, noise_lsb in exam.noise_lsb.items():
        _out.print(f"{clock:<18}  noise {noise_lsb:.2f} LSB")
    _out.print("\nerror of each resistor in percent, row by row:")
    for errors, opens in zip(exam.error_percent, exam.open, strict=True):
        _out.print(" ".join(f"{_percent(*each):>7}" for each in zip(errors, opens, strict=True)))


def _percent(error: float, is_open: bool, digits: int = 2) -> str:
    """An error of a resistor [%], in words."""
    return "open" if is_open else "." if np.isnan(error) else f"{error:.{digits}f}"


def _draw(figure: "Figure", exam: PlateExam) -> None:
    """What the board reads of the plate: errors of cells, changes by settling, and linearity."""
    size = 8 if max(exam.plate.shape) <= 8 else 5  # of letters
    most, crossings = exam.tolerance, range(max(exam.plate.shape))
    of_cells, of_settling, of_lines = figure.subplots(1, 3)
    for axes, values, limit, name, colours in (
        (of_cells, exam.error_percent, most.cell_percent, "error of each resistor [%]", "RdBu_r"),
        (of_settling, exam.settling_lsb, most.settling_lsb, "change if settled [LSB]", "Oranges"),
    ):
        least = -2 * limit if axes is of_cells else 0.0
        image = axes.imshow(values, cmap=colours, vmin=least, vmax=2 * limit)
        figure.colorbar(image, ax=axes, extend="both" if least else "max", shrink=0.85)
        axes.set(title=name, xlabel="column", ylabel="row")
        axes.set(xticks=crossings[: values.shape[1]], yticks=crossings[: values.shape[0]])
        for (row, column), value in np.ndenumerate(values):
            colour = "white" if abs(value) > 1.4 * limit else "black"
            text = _percent(value, bool(axes is of_cells and exam.open[row, column]), 1).strip(".")
            if axes is of_cells and exam.wrong[row, column]:
                text = f"[{text or 'bridge'}]"
            axes.text(column, row, text, ha="center", va="center", color=colour, fontsize=size)
    for k, name in enumerate(CONFIGURATIONS):
        x, y = exam.predicted_lsb[..., k].ravel(), exam.shown_lsb[..., k].ravel()
        of_lines.plot(x, y - x, "o+x."[k], label=name, markersize=6, fillstyle="none")
    of_lines.set(title="reading less prediction [LSB]", xlabel="current by the circuit [LSB]")
    of_lines.legend(title="reading")
