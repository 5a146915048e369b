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
w      (N,)            Hann window: what is slow does not leak to the mains
c(f)   (R, C, 4)       (2 / sum w) sum_n w_n (y_n - mean) exp(-2 pi i f (t_n + d)) [LSB]
====== =============== =====================================================================

Hum of amplitude a at every reading has |c(f)| = a. Noise of deviation s alone has a mean |c|^2 of
4 s^2 sum w^2 / (sum w)^2; hum is found where the mean over all readings is far above it, above that
of frequencies beside it, and large enough to matter. One reading at rate r sees f as |f - k r|, so
two mains may look alike; but readings of one scan are taken at different times, and with the right
f their c agree in phase. What comes to a stand still at the scan rate cannot be seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ohmskin.arrays import Float
from ohmskin.doctor.findings import Finding, named
from ohmskin.link.messages import Hello
from ohmskin.link.protocol import CONSTANTS, ENUMS
from ohmskin.link.timing import reading_offsets_s, slot_s

Bool = NDArray[np.bool_]
Complex = NDArray[np.complex128]

MAINS_HZ: Final = (50.0, 60.0)
MAINS_SEARCH_HZ: Final = (-0.4, -0.2, 0.0, 0.2, 0.4)  # resonator and grid are off by up to 0.5 %
HUM_LSB: Final = 0.5  # amplitude that matters
HUM_OVER_NOISE: Final = 10.0  # over the root of the number of readings
HUM_OVER_BESIDE: Final = 3.0
IN_PHASE: Final = 1.5  # of two mains that look alike, the one whose readings agree so much better
_OVERLAP: Final = 0.5
ADC_NOISE_LSB: Final = 0.3
SOUND_NOISE_LSB: Final = (ADC_NOISE_LSB**2 + 1 / 12) ** 0.5
NOISY_LSB: Final = 0.8
NOISY_SHARE: Final = 1.7  # of one line or cell over the others
NOISY_CELL_LSB: Final = 1.0
BLOCKS: Final = 8
MOVED_LSB: Final = 3.0
CLEAR_STDS: Final = 6.0
UNSETTLED_LSB: Final = 1.0
_LONGER: Final = 4  # settle time to compare with, over the board's
_LEAST_LONGER_US: Final = 100
_NOT_LONGER: Final = 1.2
_LEAST_HZ: Final = 4.0  # of the second look, unless the board is slower
LEAST_SCANS: Final = 16  # from which noise and hum are judged
SETTLED_NOISE_LSB: Final = 0.5
REST_S: Final = 2.5  # of scans as the board is configured
SETTLED_S: Final = 1.6  # of the second look


@dataclass(frozen=True, eq=False)
class RestScans:
    """Scans of one configuration: codes (N, R, C, 4), board time at their starts (N,) [s]."""

    board: Hello
    codes: Float
    time_s: Float

    @property
    def mean(self) -> Float:
        """Mean codes (R, C, 4)."""
        return np.asarray(self.codes.mean(axis=0))

    def deviation(self) -> Float:
        """Standard deviation of each reading, whatever moves it, (R, C, 4) [LSB]."""
        return np.asarray(self.codes.std(axis=0))


@dataclass(frozen=True, eq=False)
class Hum:
    """Mains hum: frequency as found, its name, amplitude c (R, C, 4) as of the scans' starts."""

    frequency_hz: float
    name: str
    amplitude: Complex
    lsb: float


@dataclass(frozen=True, eq=False)
class Signal:
    """What the scans show besides their means. moved: cells that changed, (R, C)."""

    findings: tuple[Finding, ...]
    noise_lsb: float
    hum_lsb: float
    hum_hidden: tuple[float, ...]
    moved: Bool


def examine_signal(scans: RestScans) -> Signal:
    """Hum, then the noise that is left without it, and what moved meanwhile."""
    enough = len(scans.codes) >= LEAST_SCANS
    hum = find_hum(scans)
    seconds = float(np.ptp(scans.time_s))
    hidden = _hidden(scans.board.rate_hz, seconds) if enough else MAINS_HZ
    rest = scans.codes - scans.mean
    if hum is not None:
        turn = np.exp(2j * np.pi * hum.frequency_hz * scans.time_s)
        rest -= np.real(turn[:, None, None, None] * hum.amplitude)
    # Of differences from scan to scan, because what moves slowly is no noise.
    variance = np.mean(np.diff(rest, axis=0) ** 2, axis=0) / 2
    moved = _moved(rest, variance)
    findings = [] if hum is None else [hum_finding(hum, scans.board)]
    if enough and not moved.any():
        findings += _noise(np.sqrt(variance.mean(axis=2)))
    noise_lsb = float(np.median(variance.mean(axis=2)) ** 0.5)
    return Signal(tuple(findings), noise_lsb, hum.lsb if hum else 0.0, hidden, moved)


def mean_std_lsb(noise_lsb: float, scans: int) -> float:
    """Deviation of the mean of so many codes [LSB], each with this noise, rounding included."""
    return float(np.hypot(rounding_std_lsb(noise_lsb), noise_lsb / scans**0.5))


def rounding_std_lsb(scatter_lsb: ArrayLike) -> Float:
    """What rounding leaves in the mean of many codes that scatter like this [LSB].

    Normal scatter of deviation s before rounding leaves a bias of up to exp(-2 pi^2 s^2) / pi, and
    without scatter that of rounding, 1 / sqrt(12) [Widrow, Kollar: Quantization Noise, 2008].
    """
    before = np.maximum(np.square(scatter_lsb) - 1 / 12, 0.0)
    return np.asarray(np.exp(-2 * np.pi**2 * before) / 12**0.5)


# ----------------------------------------------------------------------------------------- hum


def find_hum(scans: RestScans) -> Hum | None:
    """The mains hum that is in the scans, or None."""
    if len(scans.codes) < LEAST_SCANS or not np.ptp(scans.codes, axis=0).any():
        return None
    rest = scans.codes - scans.mean
    window = np.hanning(len(rest) + 2)[1:-1]
    weighted = np.asarray((window / window.sum())[:, None] * rest.reshape(len(rest), -1))
    noise = 4 * float((rest**2).mean()) * float(np.sum((window / window.sum()) ** 2))
    offsets_s = reading_offsets_s(scans.board)
    seconds = float(np.ptp(scans.time_s))
    hidden = _hidden(scans.board.rate_hz, seconds)

    def amplitude(frequency_hz: float) -> Complex:
        turn = np.exp(-2j * np.pi * frequency_hz * scans.time_s)
        return np.asarray(2 * (turn @ weighted).reshape(offsets_s.shape))

    found: list[tuple[float, float, Hum]] = []
    for mains_hz in MAINS_HZ:
        if mains_hz in hidden:
            continue
        near = [(mains_hz + off, amplitude(mains_hz + off)) for off in MAINS_SEARCH_HZ]
        power = [float(np.mean(np.abs(each) ** 2)) for _, each in near]
        best = int(np.argmax(power))
        frequency_hz, strongest = near[best]
        beside = np.median(
            [
                np.mean(np.abs(amplitude(frequency_hz + side * far / seconds)) ** 2)
                for side in (-1, 1)
                for far in (4, 5, 6, 7)
            ]
        )
        turn = np.exp(-4j * np.pi * frequency_hz * scans.time_s)
        share, fitted = _sine(strongest, complex(window @ turn / window.sum()))
        lsb = max(share * (power[best] - noise), 0.0) ** 0.5
        clear = power[best] > noise * (1 + HUM_OVER_NOISE / strongest.size**0.5)
        if lsb > HUM_LSB and clear and power[best] > HUM_OVER_BESIDE * float(beside):
            at_reading = strongest * np.exp(-2j * np.pi * frequency_hz * offsets_s)
            agree = float(np.abs(at_reading.mean()) / np.abs(at_reading).mean())
            name = f"{mains_hz:.0f} Hz"
            found.append((power[best], agree, Hum(frequency_hz, name, fitted, lsb)))
    return _one_of(found)


def _sine(amplitude: Complex, mirror: complex) -> tuple[float, Complex]:
    """The sine behind c, and what share of |c|^2 it has.

    c = a + mirror conj(a): near half the scan rate a sine and its mirror image overlap, and at it
    only a part of each sine is seen, half of the power on average.
    """
    if abs(mirror) ** 2 < _OVERLAP:
        fitted = (amplitude - mirror * np.conj(amplitude)) / (1 - abs(mirror) ** 2)
        return float(np.mean(np.abs(fitted) ** 2) / np.mean(np.abs(amplitude) ** 2)), fitted
    return 0.5, amplitude / 2


def _one_of(found: list[tuple[float, float, Hum]]) -> Hum | None:
    """Of the mains that pass, the one: by phase where both are alike, else by strength."""
    if len(found) < 2:
        return found[0][2] if found else None
    (power, agree, one), (other_power, other_agree, other) = found
    if max(power, other_power) > 2 * min(power, other_power):
        return one if power > other_power else other
    if max(agree, other_agree) > IN_PHASE * min(agree, other_agree):
        return one if agree > other_agree else other
    return Hum(one.frequency_hz, f"{one.name} or {other.name}", one.amplitude, one.lsb)


def _seen_hz(mains_hz: float, rate_hz: float) -> float:
    """What one reading shows of a mains at this scan rate [Hz]."""
    return abs(mains_hz - rate_hz * round(mains_hz / rate_hz))


def _hidden(rate_hz: float, seconds: float) -> tuple[float, ...]:
    """Mains that this scan rate shows too slow to tell them from drift [Hz]."""
    least_hz = 0.5 + 4 / max(seconds, 1e-3)
    return tuple(each for each in MAINS_HZ if _seen_hz(each, rate_hz) < least_hz)


def hum_finding(hum: Hum, board: Hello) -> Finding:
    """What is said of hum that a board showed."""
    by_cell = np.sqrt(np.mean(np.abs(hum.amplitude) ** 2, axis=2))
    worst = np.unravel_index(int(by_cell.argmax()), by_cell.shape)
    where = "whole skin"
    if by_cell.max() > 2 * np.median(by_cell):
        where = f"most at {named([(int(worst[0]), int(worst[1]))])}"
    seen_hz = _seen_hz(hum.frequency_hz, board.rate_hz)
    return Finding(
        "hum",
        "warning",
        where,
        f"{hum.name} of amplitude {hum.lsb:.1f} LSB; at {board.rate_hz:.1f} scans/s it looks like "
        f"{seen_hz:.1f} Hz",
        f"below {HUM_LSB} LSB",
        "ground the robot and the board together, keep the skin's wires short and away from mains "
        "cables, run a laptop from its battery to compare",
    )


# --------------------------------------------------------------------------- noise, what moves


def _moved(rest: Float, variance: Float) -> Bool:
    """Cells whose mean over an eighth of the scans changed by more than noise, (R, C), bool."""
    if len(rest) < 2 * BLOCKS:
        return np.zeros(rest.shape[1:3], dtype=np.bool_)
    means = np.stack([block.mean(axis=0) for block in np.array_split(rest, BLOCKS)])
    of_noise = np.sqrt(variance * BLOCKS / len(rest))
    return np.asarray((np.ptp(means, axis=0) > MOVED_LSB + CLEAR_STDS * of_noise).any(axis=2))


def _noise(cell_lsb: Float) -> list[Finding]:
    """Noise of each cell [LSB], (R, C), against that of the converter alone."""
    usual = float(np.median(cell_lsb))
    places = []
    for axis, what in enumerate(("row", "column")):
        if cell_lsb.shape[axis] > 1:
            level = np.median(cell_lsb, axis=1 - axis)
            bad = level > max(NOISY_CELL_LSB, NOISY_SHARE * usual)
            places += [(f"{what} {line}", float(level[line])) for line in np.flatnonzero(bad)]
    if not places and cell_lsb.size > 1:
        bad_cells = np.argwhere(cell_lsb > max(NOISY_CELL_LSB, NOISY_SHARE * usual))
        places += [(named([(r, c)]), float(cell_lsb[r, c])) for r, c in bad_cells[:6]]
    if not places and usual <= NOISY_LSB:
        return []
    where = ", ".join(place for place, _ in places) or "whole skin"
    most = max([lsb for _, lsb in places], default=usual)
    return [
        Finding(
            "noise",
            "warning",
            where,
            f"{most:.2f} LSB a reading",
            f"{SOUND_NOISE_LSB:.2f} LSB: rounding and {ADC_NOISE_LSB} LSB of the converter",
            "power the board from a clean supply with its capacitors, shorten the skin's wires, "
            "keep motors' cables away; loose contacts are noisy too"
            if not places
            else f"check the contacts of {where}: loose ones are noisy",
        )
    ]


# ------------------------------------------------------------------------------------ settling


def comparison(board: Hello) -> tuple[int, float] | None:
    """Settle time [us] and rate [Hz] of a second look; None if it could show nothing new.

    The settle time is longer, where it can be; the rate is one at which no mains stands still.
    """
    readings = board.rows * board.columns * board.readings_per_cell
    slot_us = 1e6 / (readings * min(board.rate_hz, _LEAST_HZ))
    select_us = 1e6 * slot_s(board) - board.settle_us  # until the pins of a slot have changed
    most_us = min(CONSTANTS["settle_us_max"], int(slot_us - select_us))
    longer_us = min(max(_LONGER * board.settle_us, _LEAST_LONGER_US), most_us)
    if not _is_longer(longer_us, board.settle_us) and not _hidden(board.rate_hz, REST_S):
        return None
    prescaler = ENUMS["adc_prescaler"].values.get(board.adc_prescaler, 0)
    conversion_us = 1e6 * 14 * prescaler / board.clock_hz
    slot_us = max(longer_us + select_us, conversion_us)
    fastest_hz = min(1e6 / (readings * slot_us), board.rate_hz)
    rates_hz = np.linspace(0.7, 1.0, 31) * fastest_hz
    best_hz = max(rates_hz, key=lambda rate_hz: min(_seen_hz(each, rate_hz) for each in MAINS_HZ))
    return longer_us, max(round(float(best_hz), 3), CONSTANTS["rate_mhz_min"] / 1000)


def _is_longer(settle_us: int, than_us: int) -> bool:
    return settle_us > _NOT_LONGER * than_us


def examine_settling(usual: RestScans, settled: RestScans) -> tuple[list[Finding], float]:
    """Means at the usual settle time against a longer one; the largest clear difference [LSB]."""
    if not _is_longer(settled.board.settle_us, usual.board.settle_us):
        return [], 0.0
    difference = np.abs(usual.mean - settled.mean)
    spread = np.maximum(usual.deviation(), settled.deviation())
    std = (
        np.maximum(spread, SETTLED_NOISE_LSB)
        * (1 / len(usual.codes) + 1 / len(settled.codes)) ** 0.5
    )
    clear = difference - CLEAR_STDS * std
    most = float(clear.max())
    if most <= UNSETTLED_LSB:
        return [], max(most, 0.0)
    bad = (clear > UNSETTLED_LSB).any(axis=2)
    # A node that is left with e of its swing S after t settles with tau = t / ln(S / e).
    swing = float(np.ptp(settled.mean, axis=2).max())
    remnant = min(float(difference.max()), 0.9 * swing)
    longer_us = settled.board.settle_us
    enough_us = min(
        usual.board.settle_us * np.log(2 * swing / UNSETTLED_LSB) / np.log(swing / remnant),
        CONSTANTS["settle_us_max"],
    )
    share = bad.mean()
    finding = Finding(
        "settling",
        "fault",
        "whole skin" if share > 0.5 else named(np.argwhere(bad)),
        f"readings change by up to {difference.max():.0f} LSB when {usual.board.settle_us} us of "
        f"settling become {longer_us} us",
        f"no change by more than {UNSETTLED_LSB:.0f} LSB",
        f"shorter wires settle sooner; else wait longer, and scan as fast as that lets: 'ohmskin "
        f"configure PORT --settle {np.ceil(enough_us):.0f} --rate 0', then run this again",
    )
    return [finding], most
