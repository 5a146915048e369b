# SPDX-License-Identifier: Apache-2.0
"""Faults that stay while touches change: which lines are shorted, and which yarn is broken.

Touches alone explain a frame of a damaged skin more or less, with cells that are not pressed. But
the damage is in the next frame as well, and other touches are not. So each frame is asked how much
better a damage would explain it, and what frames answer is added up.

**Short** of two neighbouring lines, where their leads end: `PortCircuit.shorted_port_ohm`.

**Broken yarn** of a line: all its segments resist twice as much. That a single segment resists ten
times as much looks about the same to the cells behind it.

With d what a damage changes of the modelled readings h, over their noise, and J, S and y - h + J u
as in `full_fit`, the damage explains a frame better by the gain in twice its log likelihood,
whatever the cells are:

    gain = 2 d^T S^-1 (y - h + J u) - d^T S^-1 d .

For each damage, gains are added up, and the sum begins anew when it falls below 0 (the CUSUM of
Page, *Biometrika* 41, 1954). Frames of one touch have errors that are alike, so each touch counts
once, by its first frame, and no touch counts for more than `MOST_GAIN`. On a sound skin, nearly
every touch contradicts.

Of other damages, frames show that something is wrong, and not what: in the mean, they surprise the
model (`FullFit.surprise`).
"""

from typing import Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.estimate.full_fit import FullFit
from ohmskin.estimate.prior import MAX_STEP_LOG, likeness

# Skins of fewer ports are told no such fault. Chosen: on 3x3, a few odd readings spoil a whole
# frame.
LEAST_STAYING_PORTS: Final = 16
# Resistance of a short [ohm]. Chosen: of two threads that touch. Most shorts of up to some hundred
# ohm look about the same.
SHORT_OHM: Final = 20.0
# A touch is the same as the last one if both are more alike. Chosen: a fingertip has to move by a
# third of its width.
SAME_TOUCH: Final = 0.95
# What one touch adds to a sum, or takes from it, at the most. Chosen: five touches have to agree.
MOST_GAIN: Final = 8.0
# A sum from here on is a damage. Chosen: of 168 simulated sound boards, and 160 skins of up to 300
# touches with wires of 10 to 30 % scatter, the largest was 23, when more frames were asked.
CERTAIN_GAIN: Final = 40.0
# No sum is larger. Chosen: three touches that contradict take a damage back that is no more.
MOST_SUM: Final = 60.0

# The skin is at fault, and not a single frame, if the running mean of the frames' surprise is above
# this. Chosen: on sound skins, dense touches have a surprise of up to 1.
STAYING_SURPRISE: Final = 1.2
STAYING_FAULT: Final = "other frames fit no touches: is a line damaged? ask the doctor"
# What a message says of a damage that it names.
MANY_TOUCHES: Final = "many touches look like it: ask the doctor"
# Weight of the newest frame in this running mean.
SURPRISE_SHARE: Final = 0.1
# No frame enters the mean with more surprise, and a frame that nothing explains enters it with
# this. Chosen: more than half of the frames have to be odd before the skin is at fault.
MOST_SURPRISE: Final = 1.8


class StayingFaults:
    """What frames so far have shown of damages of a skin."""

    def __init__(self, shape: tuple[int, int]) -> None:
        rows, columns = self._shape = shape
        # The first line of each short, of R+C: its other line is the next one.
        self._pairs = np.concatenate([np.arange(rows - 1), np.arange(rows, rows + columns - 1)])
        self._surprise = 0.0
        self._shorts, self._yarns = np.zeros(len(self._pairs)), np.zeros(sum(self._shape))
        self._rise_log: Float | None = None  # of the last touch that was asked

    def ask(self, fit: FullFit, rise_log: Float, *, is_doubted: bool, knows_rest: bool) -> None:
        """Count what this frame shows. A fit that is no answer may show a damage all the same.

        rise_log: how far the cells of this fit conduct more than at rest, (RC,) [log S].
        is_doubted: the fit is no answer. knows_rest: wires do not hide the cells at rest.
        """
        if rise_log.size < LEAST_STAYING_PORTS:
            return
        surprise = MOST_SURPRISE if is_doubted else min(fit.surprise, MOST_SURPRISE)
        self._surprise += SURPRISE_SHARE * (surprise - self._surprise)
        if knows_rest:
            self._compare(fit, rise_log)

    def _compare(self, fit: FullFit, rise_log: Float) -> None:
        """Ask a new touch for all damages."""
        if (before := self._rise_log) is not None:
            is_idle = max(rise_log.max(), before.max()) < MAX_STEP_LOG
            if is_idle or likeness(rise_log, before) > SAME_TOUCH:
                return
        self._rise_log = rise_log
        shorts, yarns = fit.gains_of_shorts(self._pairs, SHORT_OHM), fit.gains_of_yarns()
        # A short looks like broken yarns, too; a broken yarn does not look like a short.
        self._shorts = _summed(self._shorts, shorts)
        self._yarns = _summed(self._yarns, yarns - max(float(shorts.max(initial=0.0)), 0.0))

    @property
    def unnamed(self) -> str:
        """That frames show some damage, in words, or empty."""
        return STAYING_FAULT if self._surprise > STAYING_SURPRISE else ""

    @property
    def named(self) -> str:
        """The damage that touches have shown, in words, or empty."""
        shorts, yarns = self._shorts, self._yarns
        if shorts.max(initial=0.0) >= CERTAIN_GAIN:
            line, number = self._line(int(self._pairs[shorts.argmax()]))
            return f"{line}s {number} and {number + 1}: shorted? {MANY_TOUCHES}"
        # If the wires of all lines were longer than believed, none would be broken.
        if yarns.max() >= CERTAIN_GAIN and np.count_nonzero(yarns > 0.5 * CERTAIN_GAIN) == 1:
            line, number = self._line(int(yarns.argmax()))
            return f"{line} {number}: is its yarn broken? {MANY_TOUCHES}"
        return ""

    def _line(self, electrode: int) -> tuple[str, int]:
        """Whether a line is a row or a column, and its number there."""
        rows = self._shape[0]
        return ("row", electrode) if electrode < rows else ("column", electrode - rows)


def _summed(sums: Float, gains: Float) -> Float:
    """The sums with these gains."""
    return np.clip(sums + np.clip(gains, -MOST_GAIN, MOST_GAIN), 0.0, MOST_SUM)
