# SPDX-License-Identifier: Apache-2.0
"""A skin that is calibrated by a recording of presses, as users do it, and touched after that.

A robot presses cell after cell, up to five times each with about 0.4 to 8 N. `PressedSkin.record`
writes what a board reads meanwhile, and the forces; `calibrate` runs that command on the recording;
`PressedSkin.read` reads many touches by a `SkinReader`. Readings are those of the node
Laplacian, which shares no code with the estimators, with noise and 10 bits. Every resistance of a
skin scatters by 10 % about its layer's.
"""

from __future__ import annotations

import io
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import ohmskin
from network import SkinCircuit
from ohmskin.arrays import Bool, Float
from ohmskin.cli.main import app
from ohmskin.estimate.knowledge import NO_WIRES, WireOhm
from ohmskin.force.calibration import load_calibration
from ohmskin.force.reader import SkinReader
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.messages import Scan
from ohmskin.link.protocol import ADC_BITS, ENUMS, MODES
from ohmskin.record.recorder import Recorder
from ohmskin.record.recording import ForceSample, Tare
from studies.judge import STATED_STDS
from studies.press import LEAVE_S, PressModel, robot_presses, wander
from studies.trials import NOISE_LSB, SPREAD, skin_at_rest, stretched

# How many times as fast as that of the studies the robot presses; scans/s: twelve of a press.
PACE, RATE_HZ = 2.0, 10.0
REST_SCANS, UNTOUCHED_S = 90, 5.0  # scans of the tare; seconds before the first press
PEAKS_N, PEAK_SPREAD = np.geomspace(0.4, 8.0, 5), 0.1  # of the presses of a cell
SENSOR_NOISE_N = 0.01
TOUCHES, TOUCH_N = (2, 6), (0.4, 7.0)  # at once, and forces of them: least and most
# A touch begins, is at its highest, at its force, let go and away [s]; every other one is 1.3 times
# as high before, and so is read on its way back.
TOUCH_S, OVER = np.array([0.0, 1.0, 1.3, 1.8, 2.5]), 1.3
READ_S, NEXT_S = 1.6, 3.0  # when it is read; when other touches begin


@dataclass(frozen=True)
class SeriesModel:
    """Another law of contact, for whoever must not lean on that of `PressModel`.

    G = c (1 +- play) / (1 + c s),  c = k F^b exp(d):  a power law with a resistor s in series. G
    lies lower while the force grows, and higher once it falls; d drifts slowly, and nothing creeps.

    siemens_at_1n: k [S/N^b]. exponent: b. series_ohm: s. play: to either side.
    noise, noise_time_s: standard deviation of d, and its time constant.
    spread, exponent_spread: standard deviations of ln k and ln s, and of ln b, between cells.
    seed: of the cells and of the noise.
    """

    siemens_at_1n: float = 30e-6
    exponent: float = 1.5
    series_ohm: float = 250.0
    play: float = 0.04
    noise: float = 0.03
    noise_time_s: float = 20.0
    spread: float = 0.2
    exponent_spread: float = 0.03
    seed: int = 0

    def rise(self, time_s: Float, force_n: Float) -> Float:
        """As `PressModel.rise`."""
        cells = force_n.reshape(len(time_s), -1)
        random = np.random.default_rng(self.seed)
        gain, series, exponent = (
            middle * np.exp(spread * random.standard_normal(cells.shape[1]))
            for middle, spread in (
                (self.siemens_at_1n, self.spread),
                (self.series_ohm, self.spread),
                (self.exponent, self.exponent_spread),
            )
        )
        turns = np.sign(np.diff(cells, axis=0, prepend=0.0))
        last = np.maximum.accumulate(np.where(turns, np.arange(len(cells))[:, None], 0), axis=0)
        grows = np.take_along_axis(turns, last, axis=0)
        drift = self.noise * wander(time_s, cells.shape[1], self.noise_time_s, random)
        contact = gain * cells**exponent * np.exp(drift)
        rise = contact * (1 - self.play * grows) / (1 + contact * series)
        return np.asarray(rise).reshape(force_n.shape)


# That of the studies has less of its noise here: 24 % would hide what wires do.
LAWS: dict[str, PressModel | SeriesModel] = {
    "studies": PressModel(noise=0.03, drift=0.03),
    "series": SeriesModel(),
}


class Forces(NamedTuple):
    """What frames of one skin, (F, R, C), show: forces and deviations [N]; (F,), converged."""

    true_n: Float
    force_n: Float
    std_n: Float
    converged: Bool

    def rmse_n(self) -> float:
        """Of the touched cells."""
        return float(np.sqrt(np.mean((self.force_n - self.true_n)[self.true_n > 0] ** 2)))

    def within_percent(self) -> float:
        """How many touched cells are within 4 stated deviations."""
        off_n = np.abs(self.force_n - self.true_n)
        return 100 * float(np.mean((off_n <= STATED_STDS * self.std_n)[self.true_n > 0]))

    def wrong_percent(self) -> float:
        """How many cells mislead, for 100 touched ones: off by half, 0.5 N and 4 deviations."""
        off_n = np.abs(self.force_n - self.true_n)
        limit_n = np.maximum(np.maximum(0.5 * self.true_n, 0.5), STATED_STDS * self.std_n)
        misleads = (off_n > limit_n) & self.converged[:, None, None]
        return 100 * float(misleads.sum() / np.count_nonzero(self.true_n))


def codes_of(
    circuit: SkinCircuit, cell_siemens: Float, mode: str, random: np.random.Generator
) -> NDArray[np.uint16]:
    """What a board reads of these cells, (F, R, C) [S], in a mode, (F, R, C, 4)."""
    names = [ENUMS["reading"].values[name] for name in MODES[mode]]
    ratio = np.array([circuit.readings(cell)[..., names] for cell in cell_siemens])
    return quantise(ratio + NOISE_LSB / 2**ADC_BITS * random.standard_normal(ratio.shape))


@dataclass(frozen=True)
class Plan:
    """What is pressed.

    wire_ohm: a segment of the top layer, and of the bottom one. law: a name of `LAWS`.
    seed: of everything. shape: of the skin. lead_ohm: a lead of every line.
    odd_lead_ohm: what one line, by the seed, has more of a lead.
    presses_of: so many cells, at random, are pressed; None: all.
    presses: of each of these, the hardest ones of five.
    touches: so many frames are read later, each of other touches.
    """

    wire_ohm: tuple[float, float]
    law: str
    seed: int
    shape: tuple[int, int] = (8, 8)
    lead_ohm: float = 0.0
    odd_lead_ohm: float = 0.0
    presses_of: int | None = None
    presses: int = PEAKS_N.size
    touches: int = 100


class PressedSkin:
    """One skin, its presses and touches, by a plan. rest: the untouched skin."""

    def __init__(self, plan: Plan) -> None:
        cells, law = plan.shape[0] * plan.shape[1], LAWS[plan.law]
        keys = [plan.seed, *plan.shape, *map(round, plan.wire_ohm), list(LAWS).index(plan.law)]
        self._random = random = np.random.default_rng(keys)
        rest = skin_at_rest(*plan.shape, random, wire_ohm=plan.wire_ohm)
        leads_ohm = plan.lead_ohm * np.exp(SPREAD * random.standard_normal(sum(plan.shape)))
        leads_ohm[plan.seed % leads_ohm.size] += plan.odd_lead_ohm
        self.rest = replace(rest, lead_ohm=leads_ohm)
        # Of each cell: times and forces, straight in between.
        self._knots: list[list[tuple[float, float]]] = [[(0.0, 0.0)] for _ in range(cells)]
        pressed = np.sort(random.permutation(cells)[: plan.presses_of])
        end_s = self._press(pressed, PEAKS_N[-plan.presses :])
        self._scans_s = np.arange(0.0, end_s, 1 / RATE_HZ)
        read_s = self._touch(end_s, plan.touches)
        knots_s = [time_s for knots in self._knots for time_s, _ in knots]
        # All corners of the forces: between them the model's steps are exact.
        steps_s = np.unique(np.concatenate([self._scans_s, read_s, knots_s]))
        forces_n = np.stack([np.interp(steps_s, *np.transpose(k)) for k in self._knots], axis=-1)
        self._sensor = steps_s[steps_s < end_s], forces_n[steps_s < end_s].sum(axis=1)
        forces_n = forces_n.reshape(-1, *plan.shape)
        rises = replace(law, seed=int(random.integers(1 << 32))).rise(steps_s, forces_n)
        self._pressed = rises[np.searchsorted(steps_s, self._scans_s)]
        touched = np.searchsorted(steps_s, read_s)
        self._touched, self._touch_n = rises[touched], forces_n[touched]
        size = "x".join(map(str, plan.shape))
        with ohmskin.open(f"emulator://{size}", start=False) as board:
            self._hello = board.info

    def _press(self, cells: NDArray[np.intp], peaks_n: Float) -> float:
        """A robot presses these cells, one after another. Returns when it is done [s]."""
        now_s = UNTOUCHED_S
        for cell in cells:
            lift = 1 + PEAK_SPREAD * self._random.uniform(-1, 1, peaks_n.size)
            times_s, forces_n = robot_presses(list(peaks_n * lift), self._random, 0.0)
            self._knots[cell] += zip(now_s + times_s / PACE, forces_n, strict=True)
            now_s += (times_s[-1] + LEAVE_S) / PACE
        return float(now_s)

    def _touch(self, now_s: float, count: int) -> Float:
        """Many touches of several cells. Returns when each is read, (count,) [s]."""
        least, most = (min(touches, len(self._knots)) for touches in TOUCHES)
        begin_s = now_s + NEXT_S * np.arange(count)
        for start_s in begin_s:
            touches = self._random.integers(least, most + 1)
            for cell in self._random.choice(len(self._knots), touches, replace=False):
                force_n = self._random.uniform(*TOUCH_N)
                highest = self._random.choice([1.0, OVER])
                shares = np.array([0.0, highest, 1.0, 1.0, 0.0])
                self._knots[cell] += zip(start_s + TOUCH_S, force_n * shares, strict=True)
        return np.asarray(begin_s + READ_S)

    def _codes(self, rises: Float, mode: str, factor: float = 1.0) -> NDArray[np.uint16]:
        """What the board reads of cells that rise so much, (n, R, C) [S].

        factor: the wires over those at the calibration.
        """
        random, cells = np.random.default_rng(len(rises)), self.rest.cell_siemens + rises
        return codes_of(SkinCircuit(stretched(self.rest, factor)), cells, mode, random)

    def record(self, path: Path, mode: str = "near") -> None:
        """Write the recording of the presses (.mcap)."""
        rest = self._codes(np.zeros((REST_SCANS, *self.rest.shape)), mode)
        random = np.random.default_rng(1)
        with Recorder(path, replace(self._hello, mode=mode)) as recorder:
            recorder.add(Tare(ratio_from_codes(rest, ADC_BITS).mean(axis=0), 0.0, mode))
            for number, codes in enumerate(self._codes(self._pressed, mode)):
                now_s = float(self._scans_s[number])
                recorder.add(Scan(codes, number, round(1e6 * now_s), now_s, 0, mode=mode))
            for now_s, force_n in np.transpose(self._sensor).tolist():
                force_n += SENSOR_NOISE_N * random.standard_normal()
                recorder.add(ForceSample(force_n, now_s))

    def read(self, calibration: Path, factor: float = 1.0) -> Forces:
        """What a later use of the skin shows of its touches. factor: as in `_codes`."""
        of_skin = load_calibration(calibration)
        reader = SkinReader(replace(self._hello, mode=of_skin.mode), of_skin)
        scans = [
            reader.read(Scan(codes, number, 11_111 * number, number / 90, 0, mode=of_skin.mode))
            for number, codes in enumerate(self._codes(self._touched, of_skin.mode, factor))
        ]
        return Forces(
            self._touch_n,
            np.array([scan.force_n for scan in scans]),
            np.array([scan.force_n_std for scan in scans]),
            np.array([scan.estimate.converged for scan in scans]),
        )


def calibrate(recording: Path, out: Path, method: str, told: WireOhm = NO_WIRES) -> str:
    """Run the command, tell it these wires, and return what it says."""
    arguments = ["calibrate", "recording", str(recording), str(out), "--indenter-mm2", "80"]
    arguments += ["--method", method]
    if told.both:
        arguments += ["--wires", ",".join(f"{ohm:g}" for ohm in told.both)]
    if told.lead is not None:
        arguments += ["--leads", f"{told.lead:g}"]
    with redirect_stdout(io.StringIO()) as said:
        app(arguments, standalone_mode=False)
    return said.getvalue()
