# SPDX-License-Identifier: Apache-2.0
"""Hum, noise, movement and settling, from scans of a skin at rest.

Symbols

====== =============== =====================================================================
symbol shape           meaning
====== =============== =====================================================================
N, M   ()              scans, readings of one
y      (N, R, C, 4)    codes [LSB]
t      (N,)            board time of the scans' starts [s]
d      (R, C, 4)       time of each reading since its scan's start [s]
w      (N,)            Hann window over its sum: what is slow does not leak to the mains
c(f)   (R, C, 4)       2 sum_n w_n (y_n - mean) exp(-2 pi i f t_n) [LSB]
P(f)   ()              power: mean of |c(f)|^2 over all M readings [LSB^2]
====== =============== =====================================================================

Hum of amplitude a has |c(f)| = a at every reading. Noise of deviation s alone has the power
4 s^2 sum w^2. Hum is found where P is far above that of the noise and above that of frequencies
beside it, and where the amplitude is large enough to matter.

One reading at scan rate r sees the frequency f as |f - k r|, with k the nearest whole number, so
that two mains may look alike. But the readings of one scan are taken at different times, and with
the right f their c(f) exp(-2 pi i f d) have one phase. Mains that are seen at almost 0 Hz look like
drift.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ohmskin.arrays import Bool, Float
from ohmskin.doctor.findings import WHOLE_SKIN, Diagnosis, Kind, Place, lines_of
from ohmskin.link.clock import reading_offsets_s, slot_s
from ohmskin.link.codes import ratio_from_codes
from ohmskin.link.messages import Hello, Scan
from ohmskin.link.protocol import CONSTANTS

Complex = NDArray[np.complex128]

REST_S: Final = 2.5  # [s] The first look takes this long: with all else, less than 10 s pass.
SETTLED_S: Final = 1.6  # [s] The second look takes this long: it need not tell noise.
FAR_S: Final = 4.0  # [s] In mode far, it tells the wires.
LEAST_SCANS: Final = 16  # [scans] Noise and hum are not judged by fewer.

MAINS_HZ: Final = (50.0, 60.0)  # [Hz] The world has these mains.
MAINS_SEARCH_HZ: Final = (-0.4, -0.2, 0.0, 0.2, 0.4)  # [Hz] Resonator and grid are off by 0.5 %.
HUM_LSB: Final = 0.5  # [LSB] Hum of a smaller amplitude changes a code by one, and is not told.
# [deviations] P is above that of noise by so many deviations, if all readings were independent. The
# four readings of a cell round alike, so that it is half as many.
HUM_OVER_NOISE: Final = 10.0
HUM_OVER_BESIDE: Final = 3.0  # [1] P of drift and of other tones is as high beside.
BESIDE: Final = (-7, -6, -5, -4, 4, 5, 6, 7)  # [1 / duration] A Hann window's main lobe ends at 2.
IN_PHASE: Final = 1.5  # [1] If two mains differ less in phase, they may be one that is seen twice.
OVERLAP: Final = 0.5  # [1] From this |m|^2 on, a sine and its mirror image cannot be told apart.
STILL_HZ: Final = 0.5  # [Hz] Mains that are seen below this plus 4 / duration look like drift.

ADC_NOISE_LSB: Final = 0.3  # [LSB] A sound board's converter has this noise, as the emulated one.
SOUND_NOISE_LSB: Final = (ADC_NOISE_LSB**2 + 1 / 12) ** 0.5  # [LSB] This is seen with rounding.
NOISY_LSB: Final = 0.8  # [LSB] A board whose usual noise is above this, twice that, is noisy.
NOISY_CELL_LSB: Final = 1.0  # [LSB] A noisy line or cell has more: the worst of many is looked at.
NOISY_SHARE: Final = 1.7  # [1] It also has this factor over the usual noise: three times the power.

BLOCKS: Final = 8  # [parts] Means of so many parts of the scans, 0.3 s each, show what moves.
MOVED_LSB: Final = 3.0  # [LSB] A touch changes these means by more: the lightest one by 15.
CLEAR_STDS: Final = 6.0  # [deviations] By chance, none of 1024 readings differs so much.

UNSETTLED_LSB: Final = 1.0  # [LSB] A longer settle time changes settled readings by less: a code.
SETTLED_NOISE_LSB: Final = 0.5  # [LSB] Scatter is taken for this at least: rounding hides as much.
LONGER: Final = 4  # [1] The second look settles for so many times as long.
LEAST_LONGER_US: Final = 100  # [us] It settles at least for this: ten time constants of 10 us.
LONGER_FAR_US: Final = 300  # [us] Of far ends, even a tenth of a code counts: wires show a few.
NOT_LONGER: Final = 1.2  # [1] A settle time that is longer by less than this shows nothing new.
LEAST_LOOK_HZ: Final = 4.0  # [Hz] The second look is not slower, unless the board is.


@dataclass(frozen=True, eq=False)
class RestScans:
    """Scans of one configuration: codes (N, R, C, 4), board time at their starts (N,) [s]."""

    board: Hello
    codes: Float
    time_s: Float

    @classmethod
    def of(cls, board: Hello, scans: Sequence[Scan]) -> Self | None:
        """The scans that have a board's size; None if there are fewer than two."""
        fit = [scan for scan in scans if scan.codes.shape[:2] == (board.rows, board.columns)]
        if len(fit) < 2:
            return None
        codes = np.stack([scan.codes for scan in fit]).astype(np.float64)
        return cls(board, codes, np.array([1e-6 * scan.time_us for scan in fit]))

    @cached_property
    def mean(self) -> Float:
        """Mean codes (R, C, 4)."""
        return np.asarray(self.codes.mean(axis=0))

    @cached_property
    def window(self) -> Float:
        """w (N,)."""
        window = np.hanning(len(self.codes) + 2)[1:-1]
        return np.asarray(window / window.sum())

    def amplitude(self, frequency_hz: float) -> Complex:
        """c (R, C, 4)."""
        turn = np.exp(-2j * np.pi * frequency_hz * self.time_s)
        return 2 * np.tensordot(self.window * turn, self.codes - self.mean, axes=1)

    def power(self, frequency_hz: float) -> float:
        """P."""
        return float(np.mean(np.abs(self.amplitude(frequency_hz)) ** 2))

    @property
    def hidden_hz(self) -> tuple[float, ...]:
        """Mains that these scans cannot show [Hz]."""
        seconds = float(np.ptp(self.time_s)) if len(self.codes) >= LEAST_SCANS else 0.0
        return _hidden_hz(self.board.rate_hz, seconds)


@dataclass(frozen=True, eq=False)
class Rest:
    """The skin at rest, by the means of scans.

    codes: means (R, C, 4) of so many scans. noise_lsb: of a reading, without hum. wire_ohm: nominal
    ones of a segment, top and bottom. moves: something touches the skin and moves, so that the
    means are of no one skin. offset_lsb: of the converter, where no second drive cancels it.
    """

    board: Hello
    codes: Float
    scans: int
    noise_lsb: float
    wire_ohm: tuple[float, float]
    moves: bool = False
    offset_lsb: float = 0.0

    @property
    def ratio(self) -> Float:
        """The same as ratios to Vdd."""
        return ratio_from_codes(self.codes, self.board.adc_bits)

    @property
    def std_lsb(self) -> float:
        """Deviation of these means, rounding included."""
        return float(np.hypot(rounding_std_lsb(self.noise_lsb), self.noise_lsb / self.scans**0.5))


@dataclass(frozen=True, eq=False)
class Hum:
    """Mains hum. mains_hz: which mains, or both where they cannot be told apart [Hz].

    frequency_hz: where it was found. amplitude: c (R, C, 4). lsb: mean amplitude of a reading.
    """

    mains_hz: tuple[float, ...]
    frequency_hz: float
    amplitude: Complex
    lsb: float


def examine_signal(
    scans: RestScans, diagnosis: Diagnosis, other: RestScans | None = None
) -> tuple[float, Bool]:
    """Adds hum and noise to a diagnosis. Returns the noise of a reading without hum [LSB], and the
    cells that changed meanwhile, (R, C).

    other: scans at another rate, which may show a hum that these hide.
    """
    hum, hidden_hz = find_hum(scans), scans.hidden_hz
    rest = scans.codes - scans.mean
    if hum is not None:
        turn = np.exp(2j * np.pi * hum.frequency_hz * scans.time_s)
        rest -= np.real(turn[:, None, None, None] * hum.amplitude)
    # Differences from scan to scan: what moves slowly is no noise.
    variance = np.mean(np.diff(rest, axis=0) ** 2, axis=0) / 2
    noise_lsb = float(np.median(variance.mean(axis=2)) ** 0.5)
    moved = _moved(rest, variance)
    if other is not None and hidden_hz and hum is None and not moved.any():
        hum = find_hum(other)
        hidden_hz = tuple(each for each in hidden_hz if each in other.hidden_hz)
    if hum is not None:
        by_cell = np.sqrt(np.mean(np.abs(hum.amplitude) ** 2, axis=2))
        # The worst cell is named if it has twice as much as others.
        worst = (by_cell == by_cell.max()) & (by_cell > 2 * np.median(by_cell))
        diagnosis.add(
            Kind.HUM,
            Place.of_cells(worst),
            mains_hz=hum.mains_hz,
            amplitude_lsb=hum.lsb,
            most_lsb=HUM_LSB,
            rate_hz=scans.board.rate_hz,
            seen_hz=_seen_hz(hum.frequency_hz, scans.board.rate_hz),
        )
    if len(scans.codes) >= LEAST_SCANS and not moved.any():
        _examine_noise(np.sqrt(variance.mean(axis=2)), diagnosis)
    diagnosis.measured |= {
        "noise_lsb": round(noise_lsb, 3),
        "hum_lsb": 0.0 if hum is None else round(hum.lsb, 2),
        "hum_not_visible": list(hidden_hz),
    }
    return noise_lsb, moved


def rounding_std_lsb(scatter_lsb: ArrayLike) -> Float:
    """What rounding leaves in the mean of many codes that scatter like this [LSB].

    Normal scatter of deviation s before rounding leaves a bias of up to exp(-2 pi^2 s^2) / pi, and
    without scatter that of rounding, 1 / sqrt(12) [Widrow, Kollar: Quantization Noise, 2008].
    """
    before = np.maximum(np.square(scatter_lsb) - 1 / 12, 0.0)
    return np.asarray(np.exp(-2 * np.pi**2 * before) / 12**0.5)


# ----------------------------------------------------------------------------------------- hum


def find_hum(scans: RestScans) -> Hum | None:
    """The mains hum in the scans; None if there is none, or none can be seen.

    Of two mains that are found, the one with one phase, or both.
    """
    if not np.ptp(scans.codes, axis=0).any():
        return None
    seen = [_hum_at(mains_hz, scans) for mains_hz in MAINS_HZ if mains_hz not in scans.hidden_hz]
    hums = [hum for hum in seen if hum is not None]
    if len(hums) < 2:
        return hums[0] if hums else None
    offsets_s = reading_offsets_s(scans.board)

    def in_phase_lsb(hum: Hum) -> float:
        """Its amplitude if all readings have one phase, less if they have not."""
        turn = np.exp(-2j * np.pi * hum.frequency_hz * offsets_s)
        return float(np.abs(np.mean(scans.amplitude(hum.frequency_hz) * turn)))

    less, more = sorted(hums, key=in_phase_lsb)
    if in_phase_lsb(more) > IN_PHASE * in_phase_lsb(less):
        return more
    return replace(hums[0], mains_hz=MAINS_HZ)


def _hum_at(mains_hz: float, scans: RestScans) -> Hum | None:
    """Hum near one of the mains, if it matters and stands out.

    A sine a is seen as c = a + m conj(a): near half the scan rate, it and its mirror image overlap
    by m. At half the rate only a part of it is seen, half of its power on average.
    """
    hz = max((mains_hz + off for off in MAINS_SEARCH_HZ), key=scans.power)
    power, sine = scans.power(hz), scans.amplitude(hz)
    mirror = complex(scans.window @ np.exp(-4j * np.pi * hz * scans.time_s))
    if abs(mirror) ** 2 >= OVERLAP:
        share, sine = 0.5, sine / 2
    else:
        sine = (sine - mirror * np.conj(sine)) / (1 - abs(mirror) ** 2)
        share = float(np.mean(np.abs(sine) ** 2)) / power
    of_noise = 4 * float(np.mean((scans.codes - scans.mean) ** 2) * np.sum(scans.window**2))
    lsb = max(share * (power - of_noise), 0.0) ** 0.5
    seconds = np.ptp(scans.time_s)
    beside = np.median([scans.power(hz + far / seconds) for far in BESIDE])
    over_noise = power > of_noise * (1 + HUM_OVER_NOISE / sine.size**0.5)
    if lsb > HUM_LSB and over_noise and power > HUM_OVER_BESIDE * beside:
        return Hum((mains_hz,), hz, sine, lsb)
    return None


def _seen_hz(mains_hz: float, rate_hz: float) -> float:
    """What one reading shows of a mains at this scan rate [Hz]."""
    return abs(mains_hz - rate_hz * round(mains_hz / rate_hz))


def _hidden_hz(rate_hz: float, seconds: float) -> tuple[float, ...]:
    """Mains that this scan rate shows too slow to tell them from drift [Hz]."""
    least_hz = STILL_HZ + 4 / max(seconds, 1e-3)
    return tuple(each for each in MAINS_HZ if _seen_hz(each, rate_hz) < least_hz)


# --------------------------------------------------------------------------- noise, what moves


def _moved(rest: Float, variance: Float) -> Bool:
    """Cells whose mean over an eighth of the scans changed by more than noise, (R, C), bool."""
    if len(rest) < 2 * BLOCKS:
        return np.zeros(rest.shape[1:3], dtype=np.bool_)
    means = np.stack([block.mean(axis=0) for block in np.array_split(rest, BLOCKS)])
    of_noise = np.sqrt(variance * BLOCKS / len(rest))
    return np.asarray((np.ptp(means, axis=0) > MOVED_LSB + CLEAR_STDS * of_noise).any(axis=2))


def _examine_noise(cell_lsb: Float, diagnosis: Diagnosis) -> None:
    """Adds noisy lines, or else cells, or else the skin. cell_lsb: noise of each cell, (R, C)."""
    usual = float(np.median(cell_lsb))
    limit = max(NOISY_CELL_LSB, NOISY_SHARE * usual)
    row_lsb, column_lsb = np.median(cell_lsb, axis=1), np.median(cell_lsb, axis=0)
    place, lsb = Place(lines_of(row_lsb > limit), lines_of(column_lsb > limit)), usual
    if place != WHOLE_SKIN:
        lsb = float(max(row_lsb.max(), column_lsb.max()))
    elif (cell_lsb > limit).any():
        place, lsb = Place.of_cells(cell_lsb > limit), float(cell_lsb.max())
    if place != WHOLE_SKIN or usual > NOISY_LSB:
        diagnosis.add(Kind.NOISE, place, noise_lsb=lsb, sound_lsb=SOUND_NOISE_LSB)


# ------------------------------------------------------------------------------------ settling


def second_look(board: Hello) -> dict[str, Any] | None:
    """`settle_us` and `rate_hz` of a second look; None if it could show nothing new.

    The settle time is longer, where it can be; the rate is one at which no mains stands still.
    """
    readings = board.rows * board.columns * board.readings_per_cell
    spare_us = 1e6 / (readings * min(board.rate_hz, LEAST_LOOK_HZ)) - 1e6 * slot_s(board)
    most_us = min(CONSTANTS["settle_us_max"], int(board.settle_us + spare_us))
    least_us = LONGER_FAR_US if board.mode == "far" else LEAST_LONGER_US
    longer_us = min(max(LONGER * board.settle_us, least_us), most_us)
    if longer_us <= NOT_LONGER * board.settle_us and not _hidden_hz(board.rate_hz, REST_S):
        return None
    slot_us = 1e6 * slot_s(board) + longer_us - board.settle_us
    fastest_hz = min(1e6 / (readings * slot_us), board.rate_hz)
    rates_hz = np.linspace(0.7, 1.0, 31) * fastest_hz
    best_hz = max(rates_hz, key=lambda rate_hz: min(_seen_hz(each, rate_hz) for each in MAINS_HZ))
    rate_hz = max(round(float(best_hz), 3), CONSTANTS["rate_mhz_min"] / 1000)
    return {"settle_us": longer_us, "rate_hz": rate_hz}


def examine_settling(
    usual: RestScans, settled: RestScans, diagnosis: Diagnosis, most_lsb: float = UNSETTLED_LSB
) -> bool:
    """Adds to a diagnosis how means change with a longer settle time, if by more than `most_lsb`.

    Returns whether they do.
    """
    settle_us, longer_us = usual.board.settle_us, settled.board.settle_us
    diagnosis.measured["settling_lsb"] = 0.0
    if longer_us <= NOT_LONGER * settle_us:
        return False
    change = np.abs(usual.mean - settled.mean)
    scatter = np.maximum(usual.codes.std(axis=0), settled.codes.std(axis=0))
    in_mean = (1 / len(usual.codes) + 1 / len(settled.codes)) ** 0.5
    clear = change - CLEAR_STDS * np.maximum(scatter, SETTLED_NOISE_LSB) * in_mean
    diagnosis.measured["settling_lsb"] = round(max(float(clear.max()), 0.0), 2)
    cells = (clear > most_lsb).any(axis=2)
    if cells.any():
        place = WHOLE_SKIN if cells.mean() > 0.5 else Place.of_cells(cells)
        values = settling(usual, settled, float(change.max()))
        diagnosis.add(Kind.SETTLING, place, most_lsb=most_lsb, pressed=False, **values)
    return bool(cells.any())


def settling(usual: RestScans, settled: RestScans, change_lsb: float) -> dict[str, float]:
    """A change with a longer settle time, both times, and the one that is long enough [us]."""
    # A node that is left with e of its swing S after a slot t settles with tau = t / ln(S / e).
    swing = float(np.ptp(settled.mean, axis=2).max())
    remnant = min(change_lsb, 0.9 * swing)
    slots = np.log(2 * swing / UNSETTLED_LSB) / np.log(swing / remnant)
    needed_us = usual.board.settle_us + 1e6 * slot_s(usual.board) * (slots - 1)
    return {
        "change_lsb": change_lsb,
        "settle_us": usual.board.settle_us,
        "longer_us": settled.board.settle_us,
        "needed_us": int(np.ceil(min(needed_us, CONSTANTS["settle_us_max"]))),
    }
