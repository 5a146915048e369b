# SPDX-License-Identifier: Apache-2.0
"""A skin that is kneaded over a scale, as users do it, and touched after that.

Fingertips press anywhere, about two a second, each on several cells; a scale under the skin shows
the sum. Before that, a robot presses single cells, and after that there are touches of single
cells, as `pressed_skin` says, and other fingertips. All of it is one history of one skin, so both
ways of calibrating are compared by the same cells and the same touches.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ohmskin.arrays import Bool, Float
from ohmskin.link.codes import ratio_from_codes
from ohmskin.link.messages import Scan
from ohmskin.link.protocol import ADC_BITS
from ohmskin.record.recorder import Recorder
from ohmskin.record.recording import ForceSample, Tare
from pressed_skin import REST_SCANS, SENSOR_NOISE_N, Forces, Plan, PressedSkin

SCAN_HZ = 50.0
TIP_WIDTH, TIP_N = (0.7, 1.2), (1.0, 12.0)  # in cells, and forces: least and most
# A fingertip comes, holds and goes [s]; then another one comes after 0 to `PAUSE_S`.
TIP_S, PAUSE_S = np.array([0.0, 0.15, 0.25, 0.4]), 0.2
WEIGHT_S = np.array([0.0, 0.3, 1.0, 1.3])  # the same of a weight
WEIGHTS_N = (1.0, 2.0, 5.0)
LEAST_SHARE = 0.01  # of a fingertip's highest pressure: less counts as none
TIPS_READ, NEXT_TIP_S = 100, 3.0  # held-out fingertips; when the next one comes
BESIDE_N, BESIDE_SHARE = 1.0, 0.3  # least force beside the skin, and as a share of the touch


class Press(NamedTuple):
    """A fingertip: from and to [s], and what passes beside the skin at its highest [N]."""

    from_s: float
    to_s: float
    beside_n: float


@dataclass(frozen=True)
class Scale:
    """What stands under the skin.

    rate_hz: so often it shows a number; None: at each scan. delay_s, pole_s: its filter. noise_n,
    drift_n: of its numbers; how far its zero wanders.
    """

    rate_hz: float | None = None
    delay_s: float = 0.0
    pole_s: float = 0.0
    noise_n: float = SENSOR_NOISE_N
    drift_n: float = 0.0


class KneadedSkin(PressedSkin):
    """One skin, its presses, kneading and touches.

    scans: of the kneading. beside: this share of the fingertips presses beside the skin, too.
    spared: so many cells are touched by no fingertip of the kneading. weights: so many weights are
    laid somewhere in place of fingertips.
    """

    def __init__(
        self,
        plan: Plan,
        scans: int = 6000,
        beside: float = 0.0,
        spared: int = 0,
        weights: int = 0,
    ) -> None:
        self._span_s, self._beside, self._weights = scans / SCAN_HZ, beside, weights
        self._seed = plan.seed
        if weights:
            self._span_s = weights * (WEIGHT_S[-1] + 0.5 * PAUSE_S) + 4.0
        self.presses: list[Press] = []
        cells = plan.shape[0] * plan.shape[1]
        own = np.random.default_rng([plan.seed, 77])
        self.spared: Bool = np.zeros(cells, dtype=bool)
        self.spared[own.permutation(cells)[:spared]] = True
        self._own = own
        super().__init__(plan)
        tips, kneading = TIPS_READ, self._knead_s.size
        last = len(self._touched) - tips - kneading
        self.tip_rise, self.tip_n = self._touched[last : last + tips], self._touch_n[last:][:tips]
        self.knead_rise, self.knead_n = self._touched[last + tips :], self._touch_n[last + tips :]
        self._touched, self._touch_n = self._touched[:last], self._touch_n[:last]

    def _tip(self, start_s: float, times_s: Float, shares: Float, spared: Bool) -> float:
        """A fingertip somewhere. Returns its force [N]."""
        own, (rows, columns) = self._own, self._shape
        row, column = own.uniform(0, rows - 1), own.uniform(0, columns - 1)
        width, force_n = own.uniform(*TIP_WIDTH), own.uniform(*TIP_N)
        if self._weights and times_s is WEIGHT_S:
            force_n = float(own.choice(WEIGHTS_N))
        i, j = np.divmod(np.arange(rows * columns), columns)
        pressure = np.exp(-((i - row) ** 2 + (j - column) ** 2) / width**2)
        pressure[(pressure < LEAST_SHARE * pressure.max()) | spared] = 0.0
        if pressure.max() < 0.1:  # it would be on spared cells alone
            return self._tip(start_s, times_s, shares, spared)
        for cell in np.flatnonzero(pressure):
            of_cell = force_n * pressure[cell] / pressure.sum()
            self._knots[cell] += zip(start_s + times_s, of_cell * shares, strict=True)
        return float(force_n)

    def _touch(self, now_s: float, count: int) -> Float:
        """The kneading, then what is read later. Returns when: touches, fingertips, kneading."""
        own, self._shape = self._own, self.rest.shape
        tip_s = WEIGHT_S if self._weights else TIP_S
        begin_s = now_s
        now_s += 2.0
        while now_s < begin_s + self._span_s - 1.0:
            force_n = self._tip(now_s, tip_s, np.array([0.0, 1.0, 1.0, 0.0]), self.spared)
            off = own.random() < self._beside
            least_n = max(BESIDE_N, BESIDE_SHARE * force_n)
            beside_n = own.uniform(1, 2) * least_n if off else 0.0
            self.presses.append(Press(now_s - begin_s, now_s + tip_s[-1] - begin_s, beside_n))
            now_s += tip_s[-1] + own.uniform(0, PAUSE_S)
        self._knead_s = np.arange(begin_s, begin_s + self._span_s, 1 / SCAN_HZ)
        self._begin_s = begin_s
        now_s = begin_s + self._span_s + 1.0
        tips_s = now_s + NEXT_TIP_S * np.arange(TIPS_READ)
        everywhere = np.zeros_like(self.spared)
        for start_s in tips_s:
            highest = own.choice([1.0, 1.3])
            shares = np.array([0.0, highest, 1.0, 1.0, 0.0])
            self._tip(start_s, np.array([0.0, 1.0, 1.3, 1.8, 2.5]), shares, everywhere)
        read_s = super()._touch(float(tips_s[-1]) + NEXT_TIP_S, count)
        return np.concatenate([read_s, tips_s + 1.6, self._knead_s])

    # ------------------------------------------------------------------------ what is recorded

    def total(self, scale: Scale, *, beside: bool) -> tuple[Float, Float]:
        """What the scale shows while the skin is kneaded: times [s], forces [N]."""
        time_s = self._knead_s - self._begin_s
        fine_s = np.arange(0.0, time_s[-1], 0.001)
        force_n = np.interp(fine_s, time_s, self.knead_n.sum(axis=(1, 2)))
        for press in self.presses if beside else ():
            shape = np.interp(fine_s - press.from_s, TIP_S, [0, 1, 1, 0])
            force_n += press.beside_n * shape
        if scale.pole_s:
            slow, keep = 0.0, np.exp(-0.001 / scale.pole_s)
            for n, now_n in enumerate(force_n.tolist()):
                slow = keep * slow + (1 - keep) * now_n
                force_n[n] = slow
        shown_s = time_s if scale.rate_hz is None else np.arange(0.0, time_s[-1], 1 / scale.rate_hz)
        # The same for all scales under one skin, and another for each skin.
        random = np.random.default_rng([self._seed, 78])
        shown_n = np.interp(shown_s - scale.delay_s, fine_s, force_n)
        shown_n += scale.noise_n * random.standard_normal(shown_s.size)
        phase = random.uniform(0, 2 * np.pi)
        shown_n += scale.drift_n * (shown_s / time_s[-1] + 0.3 * np.sin(shown_s / 15 + phase))
        return shown_s, shown_n

    def record_kneading(
        self, path: Path, scale: Scale = Scale(), mode: str = "near", *, beside: bool = True
    ) -> None:
        """Write the recording of the kneading (.mcap). beside: with what passes beside the skin."""
        rest = self._codes(np.zeros((REST_SCANS, *self.rest.shape)), mode)
        with Recorder(path, replace(self._hello, mode=mode)) as recorder:
            recorder.add(Tare(ratio_from_codes(rest, ADC_BITS).mean(axis=0), 0.0, mode))
            for number, codes in enumerate(self._codes(self.knead_rise, mode)):
                now_s = number / SCAN_HZ
                recorder.add(Scan(codes, number, round(1e6 * now_s), now_s, 0, mode=mode))
            for now_s, force_n in np.transpose(self.total(scale, beside=beside)).tolist():
                recorder.add(ForceSample(force_n, now_s))

    def read_tips(self, calibration: Path) -> Forces:
        """As `read`, of the held-out fingertips."""
        touched = self._touched, self._touch_n
        try:
            self._touched, self._touch_n = self.tip_rise, self.tip_n
            return self.read(calibration)
        finally:
            self._touched, self._touch_n = touched
