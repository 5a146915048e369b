# SPDX-License-Identifier: Apache-2.0
"""A skin that something touches at rest is not calibrated, and an untouched one always is."""

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from command_line import Run, assert_one_line, well
from network import laplacian_readings
from ohmskin.calibrate.presses import Calibrator
from ohmskin.circuit.skin import Skin
from ohmskin.emulate.board import BoardSettings, EmulatedBoard
from ohmskin.errors import TareRefused
from ohmskin.link.device import mean_ratio
from recordings import record_presses, sensor_log, write_log
from stepped import stepped

TOLD = ("--indenter-mm2", "80")
TOUCHED = "cells (2, 2), (2, 5), (5, 2) are touched at rest"
TABLE = "row,column,force_n,conductance\n" + "".join(
    f"{cell},{cell},{force_n},{20e-6 * force_n}\n" for cell in (0, 1) for force_n in (1, 2, 3)
)


def skin(shape: tuple[int, int], wire_ohm: float, random: np.random.Generator) -> Skin:
    """One whose cells scatter by 30 % about 1 MOhm, and whose segments do by 10 %."""
    cell = 1e-6 * np.exp(0.3 * random.standard_normal(shape))
    wires = wire_ohm * np.exp(0.1 * random.standard_normal((2, *shape)))
    return Skin(cell, *wires)


def calibrator(of: Skin, method: str = "joint") -> Calibrator:
    """That of a board that has scanned this skin at rest 30 times."""
    ratio = laplacian_readings(of)
    settings = BoardSettings(*of.shape)
    board = stepped(EmulatedBoard(lambda *_: ratio, settings, noise_lsb=0.3))
    board.start()
    return Calibrator(board.info, mean_ratio(islice(board, 30)), method, 1e-4)


@pytest.mark.parametrize("wire_ohm", [100.0, 10e3])
@pytest.mark.parametrize("shape", [(1, 1), (2, 2), (3, 3), (1, 7), (8, 8)])
def test_no_untouched_skin_is_refused(shape: tuple[int, int], wire_ohm: float) -> None:
    random = np.random.default_rng(1)
    for _ in range(3):
        calibrator(skin(shape, wire_ohm, random))


@pytest.mark.parametrize("method", ["joint", "ohm"])
def test_a_touch_at_rest_is_named_whatever_the_method(method: str) -> None:
    random = np.random.default_rng(2)
    touches: list[tuple[tuple[int, int], float, list[tuple[int, int]], str]] = [
        ((2, 2), 100.0, [(0, 0), (0, 1), (1, 0)], "cells (0, 0), (0, 1), (1, 0) are touched"),
        ((8, 8), 100.0, [(7, 7)], "cell (7, 7) is touched"),
        ((8, 8), 2000.0, [(1, 2), (6, 2)], "cells (1, 2), (6, 2) are touched"),
    ]
    for shape, wire_ohm, cells, words in touches:
        rest = skin(shape, wire_ohm, random)
        touched = rest.cell_siemens.copy()
        touched[tuple(np.transpose(cells))] += 20e-6
        with pytest.raises(TareRefused) as refused:
            calibrator(replace(rest, cell_siemens=touched), method)
        assert str(refused.value).startswith(words)


@pytest.mark.parametrize("mode", ["near", "far"])
def test_a_table_is_refused_where_the_skin_is_touched(run: Run, tmp_path: Path, mode: str) -> None:
    (tmp_path / "presses.csv").write_text(TABLE)
    out, url = tmp_path / "skin.json", f"emulator://8x8?scene=ghost&begin=0&speed=0&mode={mode}"
    command = ("calibrate", "table", url, str(tmp_path / "presses.csv"), str(out), *TOLD)
    assert_one_line(run(*command), TOUCHED, "measure rest with nothing on the skin, or say --force")
    assert not out.exists()
    well(run(*command, "--force"))
    assert out.exists()


def test_weights_are_not_asked_for_on_a_touched_skin(run: Run, tmp_path: Path) -> None:
    out, url = tmp_path / "skin.json", "emulator://8x8?scene=ghost&begin=0&speed=0"
    done = run("calibrate", "weights", url, str(out), "--grams", "50,100,200", *TOLD)
    assert done.out.count("take everything off the skin: its rest is measured in") == 3
    assert_one_line(done._replace(out=""), TOUCHED)


def test_later_scans_show_a_light_touch_at_rest(run: Run, tmp_path: Path) -> None:
    """Its mean over the rest is below the limit for one skin at rest, whose cells may scatter."""
    path = tmp_path / "presses.mcap"
    record_presses(path, 44.0)  # two cells that are pressed
    times_s, force_n = sensor_log(44.0)
    write_log(path.with_suffix(".csv"), times_s, force_n)
    begin_s = times_s[force_n > 0.2][0]
    command = ("calibrate", "recording", str(path), str(tmp_path / "skin.json"), *TOLD)
    command += ("--forces", str(path.with_suffix(".csv")))
    well(run(*command, "--rest", f"{begin_s - 0.2:.2f}"))
    touched = (*command, "--rest", f"{begin_s + 1.2:.2f}")
    assert_one_line(run(*touched), "cell (0, 0) is touched at rest")
    well(run(*touched, "--force"))
