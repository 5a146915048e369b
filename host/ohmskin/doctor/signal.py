# SPDX-License-Identifier: Apache-2.0
"""Hum, noise, movement and settling, from scans of a skin at rest.

Symbols

====== =============== =====================================================================
symbol shape           meaning
====== =============== =====================================================================
N, M   ()              scans, readings of one
y      (N, R, C, 4)    codes [LSB]
t      (N,)            board time of the scans' starts [s]
w      (N,)            Hann window over its sum: what is slow does not leak to the mains
c(f)   (R, C, 4)       2 sum_n w_n (y_n - mean) exp(-2 pi i f t_n) [LSB]
P(f)   ()              power: mean of |c(f)|^2 over all M readings [LSB^2]
a      (R, C, 4)       hum: |a| is the amplitude of its sine at each reading [LSB]
m      ()              overlap of a sine and its mirror image at negative frequency [1]
====== =============== =====================================================================

Far from half the scan rate, m is 0 and c(f) = a. Noise of deviation s alone has the power
P = 4 s^2 sum w^2. Hum is found where P is far above that of the noise and above that of frequencies
beside it, and where the amplitude is large enough to matter.

One reading at scan rate r sees the frequency f as |f - k r|, with k the nearest whole number. So
two mains may look alike, and mains that are seen at almost 0 Hz look like drift.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ohmskin.arrays import Bool, Float
from ohmskin.circuit.configurations import READING_SIGN, READINGS_PER_CELL
from ohmskin.doctor.findings import WHOLE_SKIN, Diagnosis, Kind, Place, lines_of
from ohmskin.doctor.limits import ALL_STDS, NOISY_LSB, ROUNDING_LSB, SWITCH_LEAD_STD_OHM
from ohmskin.emulate.scenes import BOTTOM_WIRE_OHM, TOP_WIRE_OHM
from ohmskin.emulate.urls import DEFAULT_NOISE_LSB
from ohmskin.estimate.knowledge import NO_WIRES, WireOhm
from ohmskin.estimate.prior import REACH_STDS, UNKNOWN_LEAD_OHM
from ohmskin.link.clock import slot_s
from ohmskin.link.codes import ratio_from_codes
from ohmskin.link.messages import Hello, Scan
from ohmskin.link.protocol import CONSTANTS

Complex = NDArray[np.complex128]

# How long, and how often, the board is looked at.
# [s] The first look. Chosen: it shows noise, and all looks together take less than 10 s.
REST_S: Final = 2.5
# [s] The second look, with a longer settle time. Chosen: it need not show noise.
SETTLED_S: Final = 1.6
# [s] The second look in mode far. Chosen: it measures wires, which show as few codes.
FAR_S: Final = 4.0
# [s] Scans of this time show their noise, and their mean has little of it. Chosen: 90 scans, whose
# mean has a tenth.
NOISE_S: Final = 1.0
# [blocks] Means of so many parts of the scans show what moves. Chosen: 0.3 s each, as touches last.
BLOCKS: Final = 8
# [scans] Noise and hum are not judged by fewer. Chosen: two a block.
LEAST_SCANS: Final = 2 * BLOCKS
# [1] The second look has a settle time that is so many times as long. Chosen: four times as many
# time constants, which no slow node survives.
LONGER: Final = 4
# [us] The longer settle time is at least this. Chosen: ten time constants of 10 us.
LEAST_LONGER_US: Final = 100
# [us] In mode far, the longer settle time is at least this: wires show as a few codes, so that a
# tenth counts. Chosen: with less, far nodes keep a part of a code (docs/troubleshooting.md).
LONGER_FAR_US: Final = 300
# [1] A settle time that is longer by less than this factor shows nothing new. Chosen: a fifth
# more is the least that clearly changes a slow node: after 5 time constants, it lacks 60 % less.
NOT_LONGER: Final = 1.2
# [Hz] The second look is not slower, unless the board is. Chosen: some six scans in SETTLED_S.
LEAST_LOOK_HZ: Final = 4.0

# Hum.
# [Hz] The world has these mains (IEC 60038).
MAINS_HZ: Final = (50.0, 60.0)
# [Hz] They are looked for so far off: a board's ceramic resonator is off by up to 0.5 %, as
# `messages.MAX_RATE_ERROR` says. Chosen: steps so fine that no tone falls between two.
MAINS_SEARCH_HZ: Final = (-0.4, -0.2, 0.0, 0.2, 0.4)
# [deviations] P of hum is above that of noise by so many deviations, as if all readings were
# independent. But the four readings of a cell round alike, which makes the true deviation twice as
# large. Chosen: 5 true ones.
HUM_OVER_NOISE: Final = 10.0
# [1] P of hum is above that of frequencies beside it by this factor; P of drift and of other tones
# is not. Chosen: in noise alone, the largest P of some frequencies is about twice the usual one.
HUM_OVER_BESIDE: Final = 3.0
# [1 / duration] Frequencies beside a tone. A Hann window's main lobe ends at 2 (Harris 1978).
BESIDE_BINS: Final = (-7, -6, -5, -4, 4, 5, 6, 7)
# [1] From this |m|^2 on, a sine and its mirror image cannot be separated. Chosen: what separates
# them divides noise by 1 - |m|^2, too.
OVERLAP: Final = 0.5
# [Hz] Mains that are seen slower than this, plus 4 / duration, look like drift. Chosen: skins drift
# in seconds.
STILL_HZ: Final = 0.5

# Noise.
# [LSB] A sound board has this noise: that of emulated converters, and the deviation of rounding,
# which is that of a value that may be anywhere within a code.
SOUND_NOISE_LSB: Final = (DEFAULT_NOISE_LSB**2 + 1 / 12) ** 0.5
# [1] A noisy line or cell has more than NOISY_LSB, and more than the usual cell by this factor.
# Chosen: three times the power, which no cell of a sound board has by chance.
NOISY_SHARE: Final = 1.7

# What moves or has not settled.
# [LSB] A touch changes these means by more. Chosen: the lightest touch changes them by 15.
MOVED_LSB: Final = 3.0
# [LSB] A longer settle time changes settled readings by less. Chosen: a code.
UNSETTLED_LSB: Final = 1.0
# [1] Readings A to D times this are the mean of what the four show of the current, (4, 1).
_CURRENT: Final = READING_SIGN[:, None] / READING_SIGN.size


@dataclass(frozen=True, eq=False)
class Look:
    """A look: scans by one configuration.

    board: what the board said of itself.
    codes: the readings, (N, R, C, 4) [LSB].
    time_s: the board's clock at the start of each scan, (N,) [s].
    """

    board: Hello
    codes: Float
    time_s: Float

    @classmethod
    def of(cls, board: Hello, scans: Sequence[Scan]) -> Self | None:
        """The complete scans of the board's size and mode; None if there are fewer than two.

        Others are from before or after a reset, or of a region, or of fewer readings.
        """
        kind = (board.rows, board.columns, READINGS_PER_CELL), board.mode
        kept = [scan for scan in scans if scan.is_complete and scan.kind == kind]
        if len(kept) < 2:
            return None
        codes = np.stack([scan.codes for scan in kept]).astype(np.float64)
        return cls(board, codes, np.array([1e-6 * scan.time_us for scan in kept]))

    @cached_property
    def mean(self) -> Float:
        """Mean codes (R, C, 4)."""
        return np.asarray(self.codes.mean(axis=0))

    @cached_property
    def window(self) -> Float:
        """w: a Hann window over the scans, (N,)."""
        window = np.hanning(len(self.codes) + 2)[1:-1]
        return np.asarray(window / window.sum())

    def amplitude(self, frequency_hz: float) -> Complex:
        """c at this frequency, (R, C, 4) [LSB]."""
        turn = np.exp(-2j * np.pi * frequency_hz * self.time_s)
        return 2 * np.tensordot(self.window * turn, self.codes - self.mean, axes=1)

    def power(self, frequency_hz: float) -> float:
        """P at this frequency [LSB^2]."""
        return float(np.mean(np.abs(self.amplitude(frequency_hz)) ** 2))

    @property
    def hidden_hz(self) -> tuple[float, ...]:
        """Mains that these scans cannot show [Hz]: all of them, if the scans are few."""
        if len(self.codes) < LEAST_SCANS:
            return MAINS_HZ
        return _hidden_hz(self.board.rate_hz, float(np.ptp(self.time_s)))


@dataclass(frozen=True, eq=False)
class Rest:
    """The skin at rest: mean readings of scans.

    board: what the board said of itself.
    codes: the means, (R, C, 4) [LSB].
    scans: number of scans that they are means of.
    noise_lsb: noise of a single reading, without hum [LSB].
    moves: something touches the skin and moves, so that the means are those of no one skin.
    offset_lsb: the converter's, where only one polarity is read: a second one cancels it [LSB].
    told: what is told of wires and leads.
    """

    board: Hello
    codes: Float
    scans: int
    noise_lsb: float
    moves: bool = False
    offset_lsb: float = 0.0
    told: WireOhm = NO_WIRES

    @property
    def wire_ohm(self) -> tuple[float, float]:
        """Nominal wires of a segment, top and bottom [ohm]; unless told, as of emulated skins."""
        return self.told.both or (TOP_WIRE_OHM, BOTTOM_WIRE_OHM)

    @property
    def lead_ohm(self) -> tuple[float, float]:
        """The usual lead of all lines, and its standard deviation [ohm].

        A lead that is badly known, as by presses, and that may be a switch's, is taken for one.
        """
        ohm, std_ohm = self.told.lead_or_usual(SWITCH_LEAD_STD_OHM)
        if std_ohm > SWITCH_LEAD_STD_OHM and abs(ohm - UNKNOWN_LEAD_OHM) < REACH_STDS * std_ohm:
            ohm, std_ohm = UNKNOWN_LEAD_OHM, SWITCH_LEAD_STD_OHM
        return ohm, max(std_ohm, 1.0)  # 1 ohm: a precision is made of it

    @property
    def ratio(self) -> Float:
        """The means as ratios to Vdd."""
        return ratio_from_codes(self.codes, self.board.adc_bits)

    @property
    def std_lsb(self) -> float:
        """Deviation of these means, rounding included."""
        return float(np.hypot(rounding_std_lsb(self.noise_lsb), self.noise_lsb / self.scans**0.5))


@dataclass(frozen=True, eq=False)
class Hum:
    """Mains hum.

    mains_hz: which mains, or both where they cannot be told apart [Hz].
    frequency_hz: where it was found [Hz].
    amplitude: a of each reading, or what can be seen of it, (R, C, 4) [LSB].
    lsb: root mean square of the amplitudes of all readings [LSB].
    """

    mains_hz: tuple[float, ...]
    frequency_hz: float
    amplitude: Complex
    lsb: float


def examine_signal(
    scans: Look, diagnosis: Diagnosis, other: Look | None = None
) -> tuple[float, Bool]:
    """Add hum and noise. Returns the noise of a reading without hum [LSB], and which cells moved.

    other: a look at another scan rate. Mains that `scans` cannot show are looked for in it, too.

    The noise is that of the usual cell, without hum and without what moves slowly. It is not judged
    while something moves, because readings of a touched cell change for another reason.
    """
    hum, hidden_hz = find_hum(scans), scans.hidden_hz
    without_hum = scans.codes - scans.mean
    if hum is not None:
        turn = np.exp(2j * np.pi * hum.frequency_hz * scans.time_s)
        without_hum -= np.real(turn[:, None, None, None] * hum.amplitude)
    variance = noise_variance(without_hum)
    noise_lsb = float(np.median(variance.mean(axis=2)) ** 0.5)
    diagnosis.measured["noise_lsb"] = round(noise_lsb, 3)
    moved = _moved(without_hum, variance)
    if other is not None and hidden_hz and hum is None and not moved.any():
        hum = find_hum(other)
        hidden_hz = tuple(hz for hz in hidden_hz if hz in other.hidden_hz)
    report_hum(hum, scans.board.rate_hz, diagnosis)
    diagnosis.measured["hum_not_visible"] = list(hidden_hz)
    if len(scans.codes) >= LEAST_SCANS and not moved.any():
        _examine_noise(np.sqrt(variance.mean(axis=2)), diagnosis)
    return noise_lsb, moved


def noise_variance(codes: Float) -> Float:
    """Variance of each reading [LSB^2], from the differences between scans that follow each other.

    Each difference has the noise of both scans. What moves slowly changes them little: it is no
    noise.
    """
    return np.asarray(np.mean(np.diff(codes, axis=0) ** 2, axis=0) / 2)


def rounding_std_lsb(scatter_lsb: ArrayLike) -> Float:
    """Deviation that rounding leaves in the mean of many codes [LSB].

    scatter_lsb: deviation of the codes, rounding included.

    Noise makes codes round up and down, and then their mean is better than a code. With s the
    deviation of the noise before rounding, normal noise leaves a bias of exp(-2 pi^2 s^2) / pi at
    most [Widrow, Kollar: Quantization Noise, 2008]. The deviation of rounding alone, 1 / sqrt(12),
    is taken to fall with s as that bias does.
    """
    noise_variance_lsb2 = np.maximum(np.square(scatter_lsb) - 1 / 12, 0.0)  # s^2
    return np.asarray(np.exp(-2 * np.pi**2 * noise_variance_lsb2) / 12**0.5)


# ----------------------------------------------------------------------------------------- hum


def find_hum(scans: Look) -> Hum | None:
    """The mains hum in the scans; None if there is none, or none can be seen.

    At some scan rates both mains look alike, and are found. Then both are named: whoever reads it
    knows which of them the building has.
    """
    if not np.ptp(scans.codes, axis=0).any():
        return None  # readings that never change have no power, by which `_hum_at` divides
    visible_hz = [mains_hz for mains_hz in MAINS_HZ if mains_hz not in scans.hidden_hz]
    hums = [hum for hum in (_hum_at(mains_hz, scans) for mains_hz in visible_hz) if hum is not None]
    if len(hums) == 2:
        return replace(hums[0], mains_hz=MAINS_HZ)
    return hums[0] if hums else None


def report_hum(hum: Hum | None, rate_hz: float, diagnosis: Diagnosis) -> None:
    """Add a hum, if there is one. rate_hz: at which the board scans."""
    diagnosis.measured["hum_lsb"] = 0.0 if hum is None else round(hum.lsb, 2)
    if hum is not None:
        diagnosis.add(
            Kind.HUM,
            mains_hz=hum.mains_hz,
            amplitude_lsb=hum.lsb,
            most_lsb=ROUNDING_LSB,
            rate_hz=rate_hz,
            seen_hz=_seen_hz(hum.frequency_hz, rate_hz),
        )


def _hum_at(mains_hz: float, scans: Look) -> Hum | None:
    """Hum near one of the mains; None if it is too weak to matter, or does not stand out.

    Near half the scan rate, a sine and its mirror image overlap by m: c = a + m conj(a). Solved for
    a, this is a = (c - m conj(c)) / (1 - |m|^2). Where |m| is close to 1, this cannot be solved:
    scans meet the sine at the same places of each wave, so that only a part of it is seen, c / 2.
    Over all phases, the mean of |c|^2 is 2 |a|^2 there.
    """
    hz = max((mains_hz + off for off in MAINS_SEARCH_HZ), key=scans.power)
    power, c = scans.power(hz), scans.amplitude(hz)
    m = complex(scans.window @ np.exp(-4j * np.pi * hz * scans.time_s))
    if abs(m) ** 2 >= OVERLAP:
        sine, of_power = c / 2, 1 / 2
    else:
        sine = (c - m * np.conj(c)) / (1 - abs(m) ** 2)
        of_power = float(np.mean(np.abs(sine) ** 2)) / power  # |a|^2 over |c|^2
    of_noise = 4 * float(np.mean((scans.codes - scans.mean) ** 2) * np.sum(scans.window**2))
    lsb = max(of_power * (power - of_noise), 0.0) ** 0.5
    beside_hz = hz + np.array(BESIDE_BINS) / np.ptp(scans.time_s)
    beside = np.median([scans.power(at_hz) for at_hz in beside_hz])
    over_noise = power > of_noise * (1 + HUM_OVER_NOISE / c.size**0.5)
    if lsb > ROUNDING_LSB and over_noise and power > HUM_OVER_BESIDE * beside:
        return Hum((mains_hz,), hz, sine, lsb)
    return None


def _seen_hz(mains_hz: float, rate_hz: float) -> float:
    """The frequency at which one reading shows a mains at this scan rate: its alias [Hz]."""
    return abs(mains_hz - rate_hz * round(mains_hz / rate_hz))


def _hidden_hz(rate_hz: float, seconds: float) -> tuple[float, ...]:
    """Mains whose alias at this scan rate is so slow that it looks like drift [Hz].

    seconds: how long the look takes. A longer one tells slower aliases from drift.
    """
    least_hz = STILL_HZ + 4 / max(seconds, 1e-3)  # the scans of a broken file may take no time
    return tuple(hz for hz in MAINS_HZ if _seen_hz(hz, rate_hz) < least_hz)


# --------------------------------------------------------------------------- noise, what moves


def _moved(without_hum: Float, variance: Float) -> Bool:
    """Cells (R, C) whose mean changes from block to block of the scans by more than noise does.

    without_hum: readings less their means, (N, R, C, 4) [LSB].
    variance: of the noise of each reading, (R, C, 4) [LSB^2].
    """
    if len(without_hum) < LEAST_SCANS:
        return np.zeros(without_hum.shape[1:3], dtype=np.bool_)
    means = np.stack([block.mean(axis=0) for block in np.array_split(without_hum, BLOCKS)])
    noise_lsb = np.sqrt(variance * BLOCKS / len(without_hum))
    return np.asarray((np.ptp(means, axis=0) > MOVED_LSB + ALL_STDS * noise_lsb).any(axis=2))


def _examine_noise(cell_lsb: Float, diagnosis: Diagnosis) -> None:
    """Add noisy lines; if there are none, noisy cells; if neither, a skin that is noisy all over.

    A loose contact makes its whole line noisy, so the line is named and not its cells.
    cell_lsb: noise of each cell, (R, C).
    """
    usual = float(np.median(cell_lsb))
    most_lsb = max(NOISY_LSB, NOISY_SHARE * usual)
    row_lsb, column_lsb = np.median(cell_lsb, axis=1), np.median(cell_lsb, axis=0)
    place, lsb = Place(lines_of(row_lsb > most_lsb), lines_of(column_lsb > most_lsb)), usual
    if place != WHOLE_SKIN:
        lsb = float(max(row_lsb.max(), column_lsb.max()))
    elif (cell_lsb > most_lsb).any():
        place, lsb = Place.of_cells(cell_lsb > most_lsb), float(cell_lsb.max())
    if place != WHOLE_SKIN or usual > NOISY_LSB:
        diagnosis.add(Kind.NOISE, place, noise_lsb=lsb, sound_lsb=SOUND_NOISE_LSB)


# ------------------------------------------------------------------------------------ settling


def second_look(board: Hello) -> dict[str, Any] | None:
    """`settle_us` and `rate_hz` of a second look; None if it could show nothing new.

    The settle time is longer, so that readings change if they have not settled. The rate is another
    one, at which no mains is seen at almost 0 Hz. So it also shows a hum that the first look cannot
    show. If no longer settle time is possible, and no hum was hidden, it would show nothing new.
    """
    readings = board.readings
    # A longer settle time makes slots longer, and so scans slower: this much is left for it.
    spare_us = 1e6 / (readings * min(board.rate_hz, LEAST_LOOK_HZ)) - 1e6 * slot_s(board)
    most_us = min(CONSTANTS["settle_us_max"], int(board.settle_us + spare_us))
    least_us = LONGER_FAR_US if board.mode == "far" else LEAST_LONGER_US
    longer_us = min(max(LONGER * board.settle_us, least_us), most_us)
    if longer_us <= NOT_LONGER * board.settle_us and not _hidden_hz(board.rate_hz, REST_S):
        return None
    slot_us = 1e6 * slot_s(board) + longer_us - board.settle_us
    fastest_hz = min(1e6 / (readings * slot_us), board.rate_hz)
    # Some rate between these shows every mains far from 0 Hz. A much slower one gives fewer scans.
    rates_hz = np.linspace(0.7, 1.0, 31) * fastest_hz
    best_hz = max(rates_hz, key=lambda rate_hz: min(_seen_hz(hz, rate_hz) for hz in MAINS_HZ))
    rate_hz = max(round(float(best_hz), 3), CONSTANTS["rate_mhz_min"] / 1000)  # of mHz
    return {"settle_us": longer_us, "rate_hz": rate_hz}


def examine_settling(
    usual: Look, settled: Look, diagnosis: Diagnosis, each_lsb: float | None = None
) -> bool:
    """Whether means change with a longer settle time by more than they may, noise apart.

    Adds it if they do: then the usual settle time is too short.

    each_lsb: by how much each reading may change; None: by `UNSETTLED_LSB`, and in mode near, the
        mean of a cell's four readings counts, as in estimates. What floating lines draw while they
        charge changes each reading, but hardly their mean.
    """
    diagnosis.measured["settling_lsb"] = None
    if settled.board.settle_us <= NOT_LONGER * usual.board.settle_us:
        return False
    mean = each_lsb is None and usual.board.mode == "near"
    looks = [look.codes @ (_CURRENT if mean else np.eye(4)) for look in (usual, settled)]
    change = np.abs(looks[0].mean(axis=0) - looks[1].mean(axis=0))
    scatter = np.maximum(*(codes.std(axis=0) for codes in looks))
    # The deviation of a difference of two means is that of a scan times this.
    per_scatter = (1 / len(usual.codes) + 1 / len(settled.codes)) ** 0.5
    clear = change - ALL_STDS * np.maximum(scatter, ROUNDING_LSB) * per_scatter
    diagnosis.measured["settling_lsb"] = round(max(float(clear.max()), 0.0), 2)
    most_lsb = UNSETTLED_LSB if each_lsb is None else each_lsb
    cells = (clear > most_lsb).any(axis=2)
    if cells.any():
        # Where most cells have not settled, a list of them would say less.
        place = WHOLE_SKIN if cells.mean() > 0.5 else Place.of_cells(cells)
        change_lsb = float(np.abs(usual.mean - settled.mean).max())
        values = settling_values(usual, settled, change_lsb)
        diagnosis.add(Kind.SETTLING, place, pressed=False, most_lsb=most_lsb, mean=mean, **values)
    return bool(cells.any())


def settling_values(usual: Look, settled: Look, change_lsb: float) -> dict[str, float]:
    """What describes a change with a longer settle time: change, both times, and the time required.

    change_lsb: the largest change.

    From slot to slot, a node swings by S: at most by the range of a cell's readings, which follow
    each other. In a slot of t seconds, what it lacks to its final voltage falls by the factor
    exp(-t / tau). So at the slot's end the change e = S exp(-t / tau) is still to come, from which
    tau = t / ln(S / e). The time required leaves half of UNSETTLED_LSB:
    tau ln(2 S / UNSETTLED_LSB).
    """
    swing = float(np.ptp(settled.mean, axis=2).max())
    # Noise and a hand may change readings by more than a swing leaves: the log must stay above 0.
    remnant = min(change_lsb, 0.9 * swing)
    needed_slots = np.log(2 * swing / UNSETTLED_LSB) / np.log(swing / remnant)
    needed_us = usual.board.settle_us + 1e6 * slot_s(usual.board) * (needed_slots - 1)
    return {
        "change_lsb": change_lsb,
        "settle_us": usual.board.settle_us,
        "longer_us": settled.board.settle_us,
        "needed_us": int(np.ceil(min(needed_us, CONSTANTS["settle_us_max"]))),
    }
