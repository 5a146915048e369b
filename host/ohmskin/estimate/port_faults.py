# SPDX-License-Identifier: Apache-2.0
"""What no touches can make of a skin: readings and currents that a fault must be behind.

A frame is at fault, and its answer not to be relied on, where

- the readings of most cells disagree by far more than noise, or those of one cell do so that no
  three of its four readings agree (one reading that is stuck is left out);
- a current is below that at rest. Touches lower resistances, and that lowers the resistance between
  any two electrodes (Rayleigh's monotonicity law). So touches cannot do this, but open lines do;
- a port has less resistance than it had if every cell were pressed as hard as can be, by the same
  law: a row is shorted to a column. Where nobody has told the wires, the limit is one such cell;
- two lines that differed at rest draw the same current from every other line, and each of these
  currents is larger than at rest: their electrodes are shorted. The same holds for two lines that
  were alike at rest already, and drew more than the other lines. A finger between two lines makes
  them alike, too. So lines that are touched at one place only must be alike in `ALIKE_FRAMES` of
  the frames that are compared; until then, it is in doubt which of them is touched;
- a line showed no current at rest, though others did;
- the far end of a line has a potential that is not between those of the near ends, or stays while
  that of the near end moves: it is open, or it belongs to another line;
- all far ends of a layer show what the near ends show: they are not connected.

A check answers with words, and with no words where nothing is wrong. What frames have shown of
pairs of lines is the only state here; only `LinePairs.compare` and `reset` change it.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Bool, Float
from ohmskin.circuit.ports import PortCircuit
from ohmskin.estimate.knowledge import MIN_CELL_SIEMENS, SkinKnowledge
from ohmskin.estimate.port_currents import FarReadings, NearEnds, NearReadings, PortCurrents
from ohmskin.estimate.port_noise import Spread
from ohmskin.estimate.prior import HIGHEST_TOUCH_SIEMENS

# What is beyond a limit by more standard deviations is no noise. Chosen: by chance, one normal
# error of 3.5 million is.
FAULT_STDS: Final = 5.0
# Root of the mean square by which the readings of a cell disagree, over Vdd. If it is more for the
# median cell, most cells are at fault. Chosen: the simulated desk (`make bench-desk`) stays below.
MOST_CELLS_RATIO: Final = 0.016
# A cell is at fault if its readings disagree by more than this root mean square, over Vdd. Chosen:
# about twice `MOST_CELLS_RATIO`, because one of many cells is the worst even on a sound skin.
ONE_CELL_RATIO: Final = 0.03
# A cell at fault must also disagree by more than so many times the median cell, so that noise makes
# none. The three readings that are left when one is taken out agree if they disagree by less than
# this. Chosen: one more than `FAULT_STDS`, because the median cell is not the noisiest.
ONE_CELL_TIMES: Final = 6.0
# Without noise, three readings of a cell agree if they disagree by less than so many standard
# deviations of rounding. Chosen: 1.2 LSB, more than rounding alone can make of them.
AGREE_STDS: Final = 4.0
# Share of a port's current at rest by which it may drift, up or down. Chosen: three deviations of
# the drift that `prior.REST_STD` expects.
DRIFT_SHARE: Final = 0.15
# Two lines are alike if none of their currents differ by more standard deviations. Chosen: joined
# electrodes give the same code, or differ by noise, and one code is 3.5 deviations of rounding.
SAME_STDS: Final = 3.4
# Touched lines are shorted if no frame shows them apart while so many are compared: three seconds
# at 90 Hz. Chosen: no finger lies so evenly on two lines for longer.
ALIKE_FRAMES: Final = 270
# Lines that a frame has shown apart are in doubt after so many: a tenth of a second. Chosen: a
# finger that moves passes the middle of two lines in less.
DOUBT_FRAMES: Final = 9
# A line is touched if a port draws more than this times its current at rest. Chosen: of two shorted
# lines, a port draws no more than both at rest, which drift.
TOUCHED_TIMES: Final = 2.5
# Lines that were shorted at rest already drew more than this times the median line. Chosen: more
# than lines at rest scatter, and less than the double that two lines in one draw.
PAIR_TIMES: Final = 1.15
# Share of its nominal wires that a skin has at least. Chosen: no bend or wrong number halves them.
WIRE_SHARE: Final = 0.5
# A far end is constant if its range over the ports of its line is so many times less than the range
# of the near end, and within noise. Chosen: the far end of a sound line moves by more than the near
# end does.
CONSTANT_TIMES: Final = 3.0
# That is judged only where the near end clearly moves: where its range is above so many deviations
# of the difference of both ends. Chosen: twice the range that noise gives eight equal readings,
# four deviations, up to which the range of a far end is within noise.
CLEAR_STDS: Final = 8.0
# A far end is not judged so over fewer ports. Chosen: a sound line of four ports was constant by
# chance.
LEAST_PORTS: Final = 6
# [ohm] What lines lose at the least up to their far ends. Chosen: a switch of a CD74HC4067 alone
# has 70 ohm, typically (data sheet).
LEAST_LOSS_OHM: Final = 60.0
# A layer's far ends show its near ends if what its lines lose is below the least loss by so many
# deviations, and not above 0 by as many. Chosen: one frame of a sound skin in 4,000 is off by as
# much.
NO_LOSS_STDS: Final = 3.5
# Share of the sums that tell this loss which is left after each frame. Chosen: they remember some
# thirty frames.
FAR_MEMORY: Final = 0.97
# What is said of a cell that conducts less than at rest.
LOSS_TEXT: Final = "conducts less than at rest, is a line open?"

# Near ends of rows are above their far ends, those of columns below.
_TO_NEAR: Final = np.array([1.0, -1.0]).reshape(2, 1, 1)
_LINES: Final = ("row", "column")  # By axis: rows are counted by axis 0 of an array of ports.


def mended(
    near_ends: NearEnds, near: NearReadings, spread: Spread, ports: PortCurrents, ratio_std: float
) -> tuple[PortCurrents, str]:
    """The currents without stuck readings; and what could not be mended, in words, or empty.

    ports: the currents of these readings. Their arrays are not written into.
    ratio_std: deviation of a reading by its rounding [V/Vdd].
    """
    has_four, typical = near_ends.per_cell == 4, spread.median_rms
    charging = 1.0 if has_four else 2.0  # multiplexers at far ends double the capacitance
    if typical > charging * MOST_CELLS_RATIO:
        return ports, f"the readings of most cells disagree, by {100 * typical:.0f} % of Vdd"
    limit = max(charging * ONE_CELL_RATIO, ONE_CELL_TIMES * typical)
    if spread.rms.max() <= limit:  # as in most frames
        return ports, ""
    current, std, fault = ports.current.copy(), ports.std.copy(), ""
    agree = max(AGREE_STDS * ratio_std, ONE_CELL_TIMES * typical)
    for index in np.flatnonzero(spread.rms > limit):
        cell = np.unravel_index(index, spread.rms.shape)
        disagreement, current_of_three = np.inf, 0.0
        if has_four:
            disagreement, current_of_three = near_ends.best_three(near.ratio[cell])
        if disagreement < agree:
            current[cell] = current_of_three
            # The cell's own deviation comes from the stuck reading, too, so that of the best cell
            # is taken. Chosen: twice that, because in three readings offsets and what lines draw
            # do not cancel.
            std[cell] = 2.0 * std.min()
        else:  # one is enough for a message: the last
            by = 100 * spread.rms[cell]
            fault = f"{cell_of(index, current)}: its readings disagree by {by:.0f} % of Vdd"
    return PortCurrents(current, std), fault


class LinePairs:
    """Finds rows (axis 0), or columns (axis 1), that read alike though they did not at rest.

    Two shorted lines are one node, so their currents from every other line are the same. `compare`
    compares all pairs of lines in a frame. It counts, for each pair, the frames that were compared
    since the last one that has shown this pair apart. Frames that are not compared (`needs_frame`
    says which) neither add to a count nor end it. So most frames take no time here. The price is
    that many brief touches, all of which press the same two lines equally, may in the end look like
    shorted lines.

    A finger that lies evenly on two lines joins them, too: a short with a touch on one of the lines
    would give the same frame. A finger does not explain why two lines are alike if nothing touches
    them, or if they are touched at several places: it would have to lie evenly at each of them.

    high (lines,): which lines have clearly more current at all of their ports, as a short gives
    them. In a frame, that is more than the line itself had at rest, and more over that than lines
    which nothing touches; at rest, more than the median line. places (lines,): at how many places,
    each of neighbouring ports, a line has more current than a short alone can give it.
    """

    def __init__(self, axis: int, rest: PortCurrents, least_std: float) -> None:
        """least_std [S]: of a current that is only rounded; none is believed to be known better."""
        self._axis, self._least_std = axis, least_std
        self._lines, self._ports = (rest.current if axis == 0 else rest.current.T).shape
        self._each_pair = np.triu(np.ones((self._lines, self._lines), dtype=bool), 1)
        self._rest_std = self._largest_std(rest)
        self._rest_apart = self._apart(rest)
        self.reset()

    def reset(self) -> None:
        """Forget the frames before."""
        shape = self._lines, self._lines
        self._alike_frames: NDArray[np.intp] = np.zeros(shape, dtype=np.intp)
        self._never_apart = np.ones(shape, dtype=bool)

    def were_shorted_at_rest(self, high: Bool) -> str:
        """The first pair of the lines `high` that was alike at rest already, in words, or empty.

        Two of fewer than four lines would move the median that they are compared with. Lines with
        fewer than three ports may be alike by chance.
        """
        if self._lines < 4 or self._ports < 3:
            return ""
        return self._first(self._rest_apart < SAME_STDS, high)

    def needs_frame(self, high: Bool, touched: Bool) -> bool:
        """Whether a frame with these lines is worth comparing: all pairs take long.

        A short shows in two high lines, a doubt in two touched ones, (lines,). Without two of them,
        a frame is compared only if it may show a pair apart that counts as alike: while the count
        of some pair is full, and if it is the first frame. Lines with fewer than three ports may be
        alike by chance.
        """
        if self._ports < 3:
            return False
        is_first = not self._alike_frames[0, 0]  # after a frame, a line has been like itself
        is_wanted = is_first or (self._alike_frames[self._each_pair] >= ALIKE_FRAMES).any()
        return bool(is_wanted or np.count_nonzero(high) >= 2 or np.count_nonzero(touched) >= 2)

    def compare(self, now: PortCurrents) -> bool:
        """Compare all pairs of lines in a frame. Returns whether it shows any pair alike."""
        apart = self._apart(now)
        # Two shorted lines may differ by more than the limit in a noisy frame. So only a difference
        # of twice the limit shows them apart.
        shows_apart = apart > 2 * SAME_STDS
        self._alike_frames = np.where(shows_apart, 0, self._alike_frames + 1)
        self._never_apart &= ~shows_apart
        self._alike = (apart < SAME_STDS) & self._each_pair
        self._noisier = max(self._largest_std(now) / self._rest_std, 1.0)
        return bool(self._alike.any())

    def judge(self, high: Bool, places: NDArray[np.intp]) -> tuple[str, Bool]:
        """What is wrong with the pairs that the last frame compared shows alike.

        Returns the first pair of lines that is shorted, in words, or empty; and which lines are in
        doubt (lines,): touched, and alike for so long that they may be shorted.
        """
        # Lines that hardly differed at rest are alike without any fault. So a pair counts only if
        # it differed at rest by clearly more than this frame's noise.
        differed = self._rest_apart > 2 * SAME_STDS * self._noisier
        least_places = np.minimum(places, places[:, None])
        # If no frame has shown them apart, they may have been shorted between rest and the first
        # frame, and need not be alike for long. But a touch at one place may be a finger on both.
        since = self._never_apart & (least_places != 1)
        is_shorted = self._alike & differed & (since | (self._alike_frames >= ALIKE_FRAMES))
        doubt = self._alike & (self._never_apart | (self._alike_frames >= DOUBT_FRAMES))
        doubt &= least_places > 0
        in_doubt = np.asarray(doubt.any(axis=0) | doubt.any(axis=1))
        return self._first(is_shorted, high), in_doubt

    def _first(self, is_alike: Bool, high: Bool) -> str:
        if not is_alike.any():
            return ""
        pairs = np.argwhere(is_alike & high & high[:, None] & self._each_pair)
        return f"{_LINES[self._axis]}s {pairs[0][0]} and {pairs[0][1]}" if len(pairs) else ""

    def _apart(self, ports: PortCurrents) -> Float:
        """Largest difference between two lines' currents, in deviations (lines, lines)."""
        current, std = ports.current, np.maximum(ports.std, self._least_std)
        if self._axis == 0:
            current, std = current.T, std.T
        difference = np.abs(current[:, :, None] - current[:, None])  # (ports, lines, lines)
        difference /= np.maximum(std[:, :, None], std[:, None])
        return np.asarray(difference.max(axis=0))

    def _largest_std(self, ports: PortCurrents) -> float:
        return max(float(ports.std.max()), self._least_std)


class SkinFaults:
    """Compares the currents of frames with those at rest, and with what the wires allow.

    doubt: cells of lines that the last frame shows touched alike, (R, C): a finger may lie evenly
        on both lines, or they are shorted, and then one of them may be untouched.
    """

    def __init__(self, knowledge: SkinKnowledge, rest: PortCurrents | None) -> None:
        """rest: currents of the untouched skin. Without them, only short ports are found."""
        self._highest = _highest_current(knowledge)
        self._rest = rest
        self._pairs: list[LinePairs] = []
        if rest is not None:
            self._pairs = [LinePairs(axis, rest, knowledge.current_std) for axis in (0, 1)]
            self._rest_current = np.maximum(rest.current, MIN_CELL_SIEMENS)
        self.reset()

    def reset(self) -> None:
        """Forget the frames before."""
        for pairs in self._pairs:
            pairs.reset()
        self.doubt: Bool = np.zeros(self._highest.shape, dtype=bool)

    def at_rest(self) -> str:
        """What is wrong at rest already: a line that is open, or two that are shorted."""
        if self._rest is None:
            return ""
        current_stds = self._rest.current / self._rest.std
        for axis, pairs in enumerate(self._pairs):
            clearest = current_stds.max(axis=1 - axis)  # of the ports of each line
            # Where the whole skin hardly conducts, a line without a clear current is like the
            # others. So the median line must be clear by far. Chosen: four times the limit, so that
            # no line counts as open that conducts a quarter of the median line.
            is_open = (clearest < FAULT_STDS) & (float(np.median(clearest)) > 4 * FAULT_STDS)
            if is_open.any():
                line = f"{_LINES[axis]} {is_open.argmax()}"
                return f"{line} conducted nothing at rest: is it open?"
            median_line = np.median(self._rest.current, axis=axis, keepdims=True)
            high = np.all(self._rest.current > PAIR_TIMES * median_line, axis=1 - axis)
            if pair := pairs.were_shorted_at_rest(high):
                return f"{pair} conducted alike at rest, and more than others"
        return ""

    def find(self, now: PortCurrents, *, is_whole: bool = True) -> str:
        """The first fault that a frame's currents show, in words, or empty.

        A frame is compared for shorted lines only if it is whole and has no shorted port and no
        loss, and its columns only if no rows are shorted.
        """
        self.doubt = np.zeros(now.current.shape, dtype=bool)
        fault = self._short(now)
        if fault or self._rest is None:
            return fault
        fault = self._loss(now, self._rest)
        if fault or not is_whole:
            return fault
        over_rest = now.current / self._rest_current
        is_touched = now.current > TOUCHED_TIMES * self._rest_current + FAULT_STDS * now.std
        for axis, pairs in enumerate(self._pairs):
            high = np.asarray((over_rest > 1.0 + DRIFT_SHARE).all(axis=1 - axis))
            touched = is_touched if axis == 0 else is_touched.T
            wanted = pairs.needs_frame(high, np.asarray(touched.any(axis=1)))
            if wanted and pairs.compare(now):  # sound skins hardly ever show lines alike
                # Touches raise the currents of untouched lines as well. Under an edge or half a
                # palm, they tie all lines of the other layer to one node: then an untouched line
                # draws the same current from each of them, and two lines may be alike by chance.
                # The lower quarter of the lines is taken for untouched ones.
                quarter = len(high) // 4
                untouched = np.partition(over_rest, quarter, axis).take([quarter], axis)
                higher = over_rest > (1.0 + DRIFT_SHARE) * untouched
                high &= higher.all(axis=1 - axis)
                begins = touched[:, 1:] & ~touched[:, :-1]
                places = touched[:, 0] + np.count_nonzero(begins, axis=1)
                pair, doubt = pairs.judge(high, places)
                if pair:
                    return f"{pair} read alike as they did not at rest: shorted?"
                self.doubt |= doubt[:, None] if axis == 0 else doubt
        return ""

    def _short(self, now: PortCurrents) -> str:
        """A port with less resistance than a skin can have."""
        excess = now.current - self._highest - FAULT_STDS * now.std
        return worst_cell(excess, "less resistance than any touch leaves: is it a short?")

    def _loss(self, now: PortCurrents, rest: PortCurrents) -> str:
        """A current that is below that at rest, by more than drift and noise."""
        std = np.hypot(now.std, rest.std)
        loss = (1.0 - DRIFT_SHARE) * rest.current - now.current - FAULT_STDS * std
        lost = np.count_nonzero(loss > 0)
        if not lost:  # as in most frames
            return ""
        if lost > 0.5 * loss.size:
            return "the whole skin conducts less than at rest: take the rest readings anew"
        return worst_cell(loss, LOSS_TEXT)


class FarFaults:
    """Finds far ends that do not show their lines, frame after frame.

    What has been seen of a far end stays until a frame shows another thing: an untouched skin shows
    little of it.
    """

    def __init__(self, knowledge: SkinKnowledge, sensed: tuple[bool, bool]) -> None:
        """sensed: whether rows, and whether columns, have far ends that are read."""
        wires = knowledge.nominal_wire_ohm
        told_ohm = [sum(filter(None, (wires.lead, ohm)), start=0.0) for ohm in wires[:2]]
        # What a line is told to lose at least, up to its first crossing, may be less.
        self._least_ohm = [
            LEAST_LOSS_OHM if ohm is None else min(LEAST_LOSS_OHM, 0.5 * told)
            for ohm, told in zip(wires[:2], told_ohm, strict=True)
        ]
        self._sensed = sensed
        self._lines = knowledge.rows, knowledge.columns
        self._rest_sums = [np.zeros((4, 4))] * 2
        self.reset()

    def reset(self) -> None:
        """Forget the frames before, but what the rest readings have shown."""
        self._is_constant = [np.zeros(lines, dtype=bool) for lines in self._lines]
        self._sums = list(self._rest_sums)
        self._is_near = [False, False]

    def keep_as_rest(self, far: FarReadings, std: Float, shift: float) -> str:
        """What `find` says of the rest readings; they count once, before all frames."""
        self._rest_sums = [np.zeros((4, 4))] * 2
        self.reset()
        fault = self.find(far, std, shift)
        self._rest_sums = list(self._sums)
        return fault

    def find(self, far: FarReadings, std: Float, shift: float) -> str:
        """The lines at fault, in words: `far rows`, `far columns`, or `far row 3`; or empty.

        std: of the difference between both ends (R, C); shift: of the offset of far ends [V/Vdd].
        """
        # Near ends are known in two ways: as modelled by the current, which references with other
        # values spoil, and as read, which lines that charge spoil. A fault shows in both.
        drops = np.array([far.drop, far.read_drop])
        near = far.ends + drops * _TO_NEAR
        alive = ~far.is_dead  # else the near end is at fault
        most = alive * (drops.max(axis=0) + FAULT_STDS * std)
        weight = alive / (std * std)
        for axis, line in enumerate(_LINES):
            if not self._sensed[axis]:
                continue
            is_off = self._constant(axis, near[:, axis], far.ends[axis], std)
            is_off = is_off | (most[axis].sum(axis=1 - axis) < 0)
            if count := np.count_nonzero(is_off):
                if count > 0.5 * is_off.size:
                    return f"far {line}s do not follow their lines: is a connector off?"
                return f"far {line} {is_off.argmax()} does not follow its line: is it open?"
            if self._loses_nothing(axis, drops[:, axis], far.near_current, weight, shift):
                return f"far {line}s read as their near ends: is a connector off?"
        return ""

    def _constant(self, axis: int, near: Float, far: Float, std: Float) -> Bool:
        """Lines whose far end is the same for all ports, though the near end is not, (lines,).

        near: potentials of near ends, modelled and read, (2, R, C) [V/Vdd].
        far: potentials of far ends, (R, C) [V/Vdd].
        """
        across = 1 - axis
        of_near = (near.max(axis=1 + across) - near.min(axis=1 + across)).min(axis=0)
        of_far, noise = far.max(axis=across) - far.min(axis=across), std.max(axis=across)
        is_constant = (of_far < 4.0 * noise) & (of_far < of_near / CONSTANT_TIMES)
        state = self._is_constant[axis]
        # Over a few ports, what the wires lose may by chance cancel what the cells change, so that
        # the far end stays.
        if far.shape[across] >= LEAST_PORTS:
            np.copyto(state, is_constant, where=of_near > CLEAR_STDS * noise)
        return state

    def _loses_nothing(
        self, axis: int, drops: Float, current: Float, weight: Float, shift: float
    ) -> bool:
        """Whether a layer's far ends show what its near ends show, as where the connector is off.

        What all lines of the layer lose is fitted by one resistance, and by one offset of all far
        ends. This frame is judged alone, and together with those before.

        drops (2, R, C): what they lose, in two ways [V/Vdd].
        """
        terms = np.array([current, np.full(current.shape, shift), *drops]).reshape(4, -1)
        alone = (terms * weight.ravel()) @ terms.T
        self._sums[axis] = FAR_MEMORY * self._sums[axis] + alone
        for square in (alone, self._sums[axis]):
            # Least squares, with the offset within one deviation.
            (own, both, *pulls), (_, offset, *offset_pulls) = square[:2].tolist()
            per_offset = both / (offset + 1.0)
            precision = max(own - per_offset * both, 1e-9)
            pairs = zip(pulls, offset_pulls, strict=True)
            ohm = max(pull - per_offset * of_offset for pull, of_offset in pairs) / precision
            reach_ohm = NO_LOSS_STDS * precision**-0.5
            if ohm < min(reach_ohm, self._least_ohm[axis] - reach_ohm):
                self._is_near[axis] = True
            elif ohm > 2.0 * reach_ohm:
                self._is_near[axis] = False
        return self._is_near[axis]


def _highest_current(knowledge: SkinKnowledge) -> Float:
    """What ports draw if every cell is pressed as hard as can be, (R, C) [S].

    Without wires, that could not be told from a short. There, it is what one such cell draws: hard
    presses that add up to more are seldom, and wires that nobody told make all answers to them
    wrong.
    """
    shape = knowledge.rows, knowledge.columns
    if knowledge.nominal_wire_ohm.both is None:
        return np.full(shape, 1.0 / (1.0 / HIGHEST_TOUCH_SIEMENS + knowledge.ref_ohm))
    top, bottom = (WIRE_SHARE * ohm for ohm in knowledge.nominal_wire_ohm.both)
    pressed = PortCircuit(np.full(shape, HIGHEST_TOUCH_SIEMENS), top, bottom)
    return np.asarray(1.0 / (pressed.port_ohm.reshape(shape) + knowledge.ref_ohm))


def worst_cell(excess: Float, what: str) -> str:
    """The cell with the largest excess (R, C), and what is wrong with it; empty if none is > 0."""
    worst = excess.argmax()
    return f"{cell_of(worst, excess)}: {what}" if excess.flat[worst] > 0 else ""


def cell_of(index: int | np.intp, ports: Float) -> str:
    """The cell of this flat index into an array of ports (R, C), in words."""
    row, column = np.unravel_index(index, ports.shape)
    return f"cell ({row}, {column})"
