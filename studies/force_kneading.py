# SPDX-License-Identifier: Apache-2.0
"""Skins that are kneaded over a scale, and the same skins calibrated by single touches, simulated.

Both read the same frames of several touches, those of `surface_trial`, and are told the nominal
wires. Kneading learns as ``ohmskin calibrate recording REC OUT --total`` does. Single touches are
those of `force_experiment`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from rich.table import Table
from threadpoolctl import threadpool_limits

import ohmskin
from ohmskin.arrays import Float
from ohmskin.calibrate.kneading import Kneading
from ohmskin.calibrate.presses import Calibrator
from ohmskin.calibrate.tables import ForceLog
from ohmskin.circuit.skin import readings
from ohmskin.estimate.knowledge import WireOhm
from ohmskin.estimate.methods import VOLTAGE, make_estimator
from ohmskin.force.curve import ForceModel
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.messages import Scan
from ohmskin.link.protocol import ADC_BITS
from ohmskin.record.recording import Recording, Tare
from studies.force_experiment import CHOICE, errors, learn, rises
from studies.force_trial import ForceTrial, Plan, surface_trial
from studies.press import PressModel
from studies.rows import Progress, Steps, text_table
from studies.trials import NOISE_LSB, knowledge_of, skin_at_rest

METHOD: Final = "joint"
MODEL: Final = PressModel()  # of the cells, as measured
SINGLE_VOLTAGE: Final = "single touches, voltage"
SINGLE: Final = f"single touches, {METHOD}"
KNEADED: Final = f"kneading, {METHOD}"
SURFACES: Final = ("flat", "curved")
SCAN_HZ: Final = 50.0
REST_S: Final = 2.0  # until the first fingertip
# Widths [cells] and forces [N] of fingertips, least and most. Chosen: they press some ten cells.
TIP_WIDTH: Final = (0.7, 1.2)
TIP_N: Final = (1.0, 12.0)
LEAST_SHARE: Final = 0.01  # of a fingertip's highest pressure: less counts as none. Chosen.
# A fingertip comes, holds and goes [s]; the next one comes after 0 to `PAUSE_S`. Chosen: two a
# second.
TIP_S: Final = (0.0, 0.15, 0.25, 0.4)
PAUSE_S: Final = 0.2
# The scale: its rate, how late it is, and the noise of its numbers. Chosen: of a load cell's
# amplifier.
SCALE_HZ, SCALE_LAG_S, SCALE_NOISE_N = 10.0, 0.1, 0.01
# Cells a line, what is pressed and read, and how long is kneaded [s]: 8x8 as in
# `force_experiment.FULL`, two minutes as docs/calibrate.md says.
FULL: Final = (8, Plan(4, 6, 3, 3), 120.0)
QUICK: Final = (4, Plan(1, 6, 2, 1), 20.0)


@dataclass(frozen=True, eq=False)
class Row:
    """What one way of calibrating makes of the test's frames; errors as in `force_experiment.Row`.

    calibrated: the way, and the method.
    minutes: that it took.
    true_n, force_n: of the touched cells of all skins, (n,).
    """

    surface: str
    rows: int
    columns: int
    skins: int
    frames: int
    calibrated: str
    minutes: float
    pressed_n: float
    every_cell_n: float
    true_n: Float
    force_n: Float

    def figures(self) -> dict[str, object]:
        """All but the single forces."""
        return {key: of for key, of in vars(self).items() if not isinstance(of, np.ndarray)}


def fingertips_n(
    shape: tuple[int, int], knead_s: float, random: np.random.Generator
) -> tuple[Float, Float]:
    """Times of scans [s], (n,), and what fingertips press meanwhile [N], (n, R, C)."""
    time_s = np.arange(0.0, knead_s, 1 / SCAN_HZ)
    force_n = np.zeros((time_s.size, *shape))
    row, column = np.indices(shape)
    now_s = REST_S
    while now_s < knead_s - 1:
        middle = random.uniform(0, np.array(shape) - 1)
        square = (row - middle[0]) ** 2 + (column - middle[1]) ** 2
        pressure = np.exp(-square / random.uniform(*TIP_WIDTH) ** 2)
        pressure[pressure < LEAST_SHARE * pressure.max()] = 0.0
        highest_n = random.uniform(*TIP_N) * pressure / pressure.sum()
        force_n += np.interp(time_s - now_s, TIP_S, (0, 1, 1, 0))[:, None, None] * highest_n
        now_s += TIP_S[-1] + random.uniform(0, PAUSE_S)
    return time_s, force_n


def knead(lines: int, seed: int, knead_s: float) -> tuple[WireOhm, ForceModel]:
    """Wires and curves by kneading the skin that `surface_trial` makes of this seed."""
    random = np.random.default_rng([seed, lines, lines])
    skin = skin_at_rest(lines, lines, random)
    time_s, force_n = fingertips_n((lines, lines), knead_s, random)
    conductances = skin.cell_siemens + replace(MODEL, seed=seed).rise(time_s, force_n)
    ratio = np.array([readings(replace(skin, cell_siemens=cells)) for cells in conductances])
    codes = quantise(ratio + NOISE_LSB / 2**ADC_BITS * random.standard_normal(ratio.shape))
    scans = [
        Scan(of_scan, number, round(1e6 * now_s), now_s, 0)
        for number, (of_scan, now_s) in enumerate(zip(codes, time_s.tolist(), strict=True))
    ]
    rest_ratio = ratio_from_codes(codes[time_s < REST_S], ADC_BITS).mean(axis=0)
    with ohmskin.open(f"emulator://{lines}x{lines}", start=False) as board:
        recording = Recording([board.info], scans, [Tare(rest_ratio, 0.0)], [], [], cut_off=False)
        told = knowledge_of(rest_ratio).nominal_wire_ohm
        calibrator = Calibrator(board.info, rest_ratio, METHOD, None, told)
    shown_s = np.arange(0.0, knead_s, 1 / SCALE_HZ)
    shown_n = np.interp(shown_s - SCALE_LAG_S, time_s, force_n.sum(axis=(1, 2)))
    shown_n += SCALE_NOISE_N * random.standard_normal(shown_s.size)
    fit = Kneading(calibrator, [recording]).learn(ForceLog(shown_s, shown_n, any_zero=True))
    return calibrator.knowledge.nominal_wire_ohm, fit.model()


def measure(lines: int, plan: Plan, knead_s: float, progress: Progress | None = None) -> list[Row]:
    """Skins of so many rows and columns, flat and curved, by each way of calibrating.

    `progress(done, steps)` is called after each skin is kneaded, and after each surface of it.
    """
    steps = Steps(plan.seeds * (1 + len(SURFACES)), progress)
    shown: dict[tuple[str, str], list[tuple[ForceTrial, Float]]] = {}
    with threadpool_limits(limits=1):
        for seed in range(plan.seeds):
            wires, curves = knead(lines, seed, knead_s)
            steps.done()
            for surface in SURFACES:
                trial = surface_trial(lines, lines, seed, plan, MODEL, curved=surface == "curved")
                for name, method in ((SINGLE_VOLTAGE, VOLTAGE), (SINGLE, METHOD)):
                    rise = rises(method, trial)
                    force_n = learn(trial, rise, CHOICE)(rise)
                    shown.setdefault((surface, name), []).append((trial, force_n))
                knowledge = replace(knowledge_of(trial.rest_ratio), nominal_wire_ohm=wires)
                estimator = make_estimator(METHOD, knowledge)
                # It sees no single touches: `joint` would learn wires from them.
                test, force_n = trial.group >= 0, np.full_like(trial.force_n, np.nan)
                level = np.array([estimator.estimate(frame).level for frame in trial.ratio[test]])
                rise = level - estimator.rest_level()
                force_n[test] = curves.predict(rise, np.zeros_like(rise))[0]
                shown.setdefault((surface, KNEADED), []).append((trial, force_n))
                steps.done()
    return [_row(*key, knead_s, of_skins) for key, of_skins in shown.items()]


def _row(
    surface: str, calibrated: str, knead_s: float, of_skins: list[tuple[ForceTrial, Float]]
) -> Row:
    by_skin = [errors(trial, force_n)[:, 1:].mean(axis=0) for trial, force_n in of_skins]
    pressed_n, every_cell_n = (round(float(off_n), 4) for off_n in np.mean(by_skin, axis=0))
    true_n, shown_n = [], []
    for trial, force_n in of_skins:
        touched = (trial.group >= 0)[:, None, None] & (trial.force_n > 0)
        true_n.append(trial.force_n[touched])
        shown_n.append(force_n[touched])
    trial = of_skins[0][0]
    single_s = trial.time_s[trial.group < 0]
    return Row(
        surface,
        rows=trial.force_n.shape[1],
        columns=trial.force_n.shape[2],
        skins=len(of_skins),
        frames=int(np.count_nonzero(trial.group >= 0)),
        calibrated=calibrated,
        minutes=round((knead_s if calibrated == KNEADED else float(np.ptp(single_s))) / 60, 1),
        pressed_n=pressed_n,
        every_cell_n=every_cell_n,
        true_n=np.concatenate(true_n),
        force_n=np.concatenate(shown_n),
    )


def kneading_table(rows: Sequence[Row]) -> Table:
    """RMSE in newton by surface and way of calibrating."""
    first = rows[0]
    skins = f"{first.skins} skins, {first.frames} frames each"
    title = f"{first.rows}x{first.columns}, simulated: RMSE [N], {skins}"
    words, numbers = ("skin", "calibrated by"), ("minutes", "robot's cell", "every cell")
    table = text_table(words, numbers, title=title, title_justify="left")
    for row in rows:
        figures = (f"{row.minutes:.0f}", f"{row.pressed_n:.2f}", f"{row.every_cell_n:.3f}")
        table.add_row(row.surface, row.calibrated, *figures)
    return table
