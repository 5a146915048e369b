# SPDX-License-Identifier: Apache-2.0
"""Currents of frames of which not all was read: some readings of a cell, or some cells.

Symbols are those of `port_currents` and `port_noise`; K are the readings of a cell that were read.

    I = sum_{k in K} s_k R_k (y_k - o_k - b_k) / sum_{k in K} R_k^2 ,
    s_I^2 = v_I / sum R_k^2 .

Fewer than four readings do not show the offset o_k of each node, nor v. Frames in which all was
read show them (`port_mirror`). Of several in a row, the last one before a frame of fewer readings
is asked: o_k is that of the last one asked, v is that of all that were.
Before there was such a frame, the rest readings stand in for it. They may be a mean of many scans,
which shows hardly any noise, and then v is too small. Where neither was read, o_k is 0, and of two
or more readings,

    v = median over cells of (I_1 - I_2)^2 / (R_1^-2 + R_2^-2) / 0.455 ,

with I_1 and I_2 the currents that two of the readings show. In every case, v is at least 2 s^2, as
of readings that round independently. v_I is not taken from another frame, because what is touched
decides where lines charge. A single reading has v_I = v. Several show it as in `port_noise`:

    v_cell = sum_k residual_k^2 / (|K| - 1) ,  v_I = v + STAYING_SHARE^2 max(0, v_cell - v) .

If A and B alone are read, lines that charge add to A, and take less from B, which is read a slot
later. Of what they make in the difference of both currents, I_A - I_B, A has too much by the share

    f = FIRST_SHARE + ROW_SHARE q ,

and B lacks the remainder. (`port_currents` has q. A is a reading of the row.) I has R_A^2 / sum
R_k^2 of the first in it, and lacks 1 - R_A^2 / sum R_k^2 of the second, so that

    I -= (f - 1 + R_A^2 / sum R_k^2) max(0, 1 - n v / v_cell) (I_A - I_B) ,
    n = max(1, CLEAR_NOISES v / mean of v_cell) .

The factor max(...) is the share of v_cell that is not noise. Where hardly a cell of the frame
differs by more than noise, no lines charge, and n keeps the correction from following noise. With k
for what I_A - I_B is multiplied by, its noise adds v k^2 (R_A^-2 + R_B^-2) sum R_k^2 to v_I.

Offsets have noise, too. With V_m and V_d the variances of their mean and their difference
(`port_mirror`), and t_k = +1 for readings of the row's node and -1 for those of the column's,

    (V_m (sum s_k R_k)^2 + V_d / 4 (sum t_k s_k R_k)^2) / sum R_k^2

is added to v_I. It matters where cells are few.

What whole frames show too much in all currents, as rest does, is added (`port_excess`).

A port that was not read keeps its last current. Its deviation grows by `STALE_SHARE` of the current
with each frame since then.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.configurations import (
    READING_OFFSET,
    READING_SIGN,
    READINGS_PER_CELL,
    reference_ohm,
)
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.port_currents import NearReadings, PortCurrents, row_share
from ohmskin.estimate.port_excess import Excess
from ohmskin.estimate.port_mirror import APART_SIGN, BoardShown, MirrorReadings
from ohmskin.estimate.port_noise import MEDIAN_CHI2, STAYING_SHARE

# Share of its current by which a port that is not read may change from frame to frame. Chosen: by
# the next whole scan, 30 frames later, it may be anything.
STALE_SHARE: Final = 0.03
# Ports that no frame has shown yet are taken for as old as so many frames. Chosen: as above.
_NEVER_FRAMES: Final = 30
# Share of A in the difference that lines that charge make between A and B, in modes with these two
# alone, and how much larger it is where the row draws all. Measured in firmware/sim with its preset
# `desk`, touches and fingertips, at the default settle time.
FIRST_SHARE: Final = 0.84
ROW_SHARE: Final = 0.25
# n in a frame whose cells differ by noise alone. Chosen: two deviations; with less, the correction
# would follow noise, and two readings would tell hardly more than one.
CLEAR_NOISES: Final = 4.0


class Shown(NamedTuple):
    """What the last frame of all readings has shown. Before there is one, noise is 0.

    ports: its currents, or newer ones of ports that were read since.
    noise: v, as `port_noise` has it [V^2/Vdd^2]; 0: not known.
    near: its readings, as long as nobody has asked what they show of the board.
    is_live: whether it is no frame at rest.
    """

    ports: PortCurrents
    noise: float
    near: NearReadings | None = None
    is_live: bool = False


class PartialEnds:
    """Reads the near ends of frames of which not all was read, one after the other.

    region: flat indices of the ports that the last frame has read, (k,); None: all of them.
    """

    def __init__(self, knowledge: SkinKnowledge) -> None:
        self._reference = reference_ohm(knowledge.ref_top_ohm, knowledge.ref_bottom_ohm)
        self._rounding, self._ref_ohm = knowledge.ratio_std**2, knowledge.ref_ohm
        nothing = np.zeros((knowledge.rows, knowledge.columns))
        ports = PortCurrents(nothing, nothing + 1.0 / knowledge.ref_ohm)
        self._rest, self._mirrors = Shown(ports, 0.0), MirrorReadings(knowledge)
        self._excess = Excess(knowledge)
        self._no_age = nothing
        self.reset()

    def reset(self) -> None:
        """Forget the frames before, but for rest."""
        self._last = self._rest
        self._board = BoardShown(np.zeros(READINGS_PER_CELL))
        self._mirrors.reset()
        self._excess.reset()
        self.region: NDArray[np.intp] | None = None
        self._age: Float = np.full(self._rest.ports.current.shape, _NEVER_FRAMES)

    def keep(self, shown: Shown) -> None:
        """A frame of all readings has shown this."""
        # The readings of a frame may all agree by chance. Such a frame, of noise 0, tells nothing.
        noises = [each for each in (shown.noise, self._rest.noise) if each]
        self._last = shown._replace(noise=min(noises, default=0.0))
        if shown.is_live:
            self._excess.keep(shown.ports.current)
        self.region = None
        self._age = self._no_age  # never written into

    def keep_as_rest(self) -> None:
        """What the last frame has shown is of the untouched skin."""
        self._rest = self._last
        self.reset()

    def _of_board(self) -> BoardShown:
        """What whole frames have shown of the board: of several in a row, the last one.

        Only the last of several whole frames is asked, and only now: modes that read all need none
        of this. So 30 whole frames and then one of fewer readings count as one.
        """
        if self._last.near is not None:
            self._board = self._mirrors.take(self._last.near, is_live=self._last.is_live)
            self._last = self._last._replace(near=None)
        return self._board

    def read(self, ratio: Float) -> PortCurrents:
        """Currents of all ports, by readings (R, C, 4) of which some are NaN."""
        board = self._of_board()
        kinds = ~np.isnan(ratio).all(axis=(0, 1))
        slope = (READING_SIGN * self._reference)[kinds]
        signal = (ratio - READING_OFFSET - board.offset_ratio)[..., kinds]
        by_each = signal / slope
        # A scan has at least the noise of rounding.
        shown = board.noise or self._last.noise or self._noise(by_each, slope)
        noise = max(shown, 2.0 * self._rounding)
        square_ohm = float(slope @ slope)
        current = signal @ slope / square_ohm
        error = noise
        if slope.size > 1:
            residual = signal - current[..., None] * slope
            by_cell = np.einsum("ijk,ijk->ij", residual, residual) / (slope.size - 1)
            staying = np.maximum(by_cell - noise, 0.0)
            error = noise + STAYING_SHARE**2 * staying
            if kinds.tolist() == [True, True, False, False]:
                # NaN are cells that were not read.
                noises = max(1.0, CLEAR_NOISES * noise / max(float(np.nanmean(by_cell)), 1e-30))
                charged = np.maximum(1.0 - noises * noise / np.maximum(by_cell, 1e-30), 0.0)
                first = FIRST_SHARE + ROW_SHARE * row_share(
                    np.where(np.isnan(current), self._last.ports.current, current), self._ref_ohm
                )
                weight = slope[0] ** 2 / square_ohm
                taken = (first - 1 + weight) * charged
                current -= taken * (by_each[..., 0] - by_each[..., 1])
                error += noise * taken**2 * square_ohm * float(np.sum(slope**-2.0))
        of_mean, of_apart = board.offset_share
        offset = of_mean * slope.sum() ** 2 + 0.25 * of_apart * (slope @ APART_SIGN[kinds]) ** 2
        error = error + noise * offset / square_ohm
        std = np.sqrt(error / square_ohm)
        if not kinds.all():
            current = self._excess.added(current, tuple(np.flatnonzero(kinds)))
        is_read, last = ~np.isnan(current), self._last.ports
        ports = PortCurrents(
            np.where(is_read, current, last.current), np.where(is_read, std, last.std)
        )
        self._last = self._last._replace(ports=ports)
        self._age = np.where(is_read, 0.0, self._age + 1.0)
        self.region = None if is_read.all() else np.flatnonzero(is_read)
        stale = STALE_SHARE * self._age * ports.current
        return PortCurrents(ports.current, np.hypot(ports.std, stale))

    def _noise(self, by_each: Float, slope: Float) -> float:
        """v by this frame alone: currents that each reading shows (R, C, n), slopes (n,)."""
        if slope.size == 1:
            return 0.0
        square = np.diff(by_each[..., :2])[..., 0] ** 2 / np.sum(slope[:2] ** -2.0)
        return float(np.nanmedian(square)) / MEDIAN_CHI2[1]
