# SPDX-License-Identifier: Apache-2.0
"""From a frame's readings to what estimators take: a current for each port, and what is wrong.

`PortReader` brings six subjects together, of which each is a module:

- `port_currents`: the current through each port, without offsets of the board and without what
  floating lines draw; at far ends also what the wires lose.
- `port_partial`: the same where not all was read.
- `port_mirror`: what whole frames show of the board, for frames of which not all is read.
- `port_excess`: what whole frames show more of every current than frames of fewer readings.
- `port_noise`: the standard deviation of each current, by how far readings disagree and change.
- `port_faults`: what no touches can make of a skin.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Bool, Float
from ohmskin.estimate.knowledge import SkinKnowledge
from ohmskin.estimate.port_currents import NearEnds, PortCurrents, far_ends_of, read_far_ends
from ohmskin.estimate.port_faults import FarFaults, SkinFaults, mended
from ohmskin.estimate.port_noise import ReadingNoise, Spread, Variances
from ohmskin.estimate.port_partial import PartialEnds, Shown


@dataclass(frozen=True, eq=False)
class PortReadings:
    """One frame, as estimators take it.

    ratio: the readings (R, C, 4) [V/Vdd].
    current: of each port per Vdd (R, C) [S]; where far ends are sensed, what the port would draw if
        the wires up to these ends had no resistance.
    current_std: standard deviation of current (R, C) [S].
    fault: why the frame cannot be relied on, in words; empty if it can.
    doubt: cells of lines that may be touched alike, or shorted, (R, C) (`port_faults`).
    far: whether rows, and whether columns, are sensed at their far ends.
    region: flat indices of the ports that were read, (k,); None: all.

    Only where far ends are sensed:

    drop_ohm: what the wires of row and of column lose per current of the port (2, R, C) [ohm].
    drop_std: standard deviation of drop_ohm, for rows and columns alike (R, C) [ohm].
    drop_shift: what an offset of the far ends of one standard deviation would add to drop_ohm of
        rows, and take from that of columns (R, C) [ohm].
    """

    ratio: Float
    current: Float
    current_std: Float
    fault: str = ""
    doubt: Bool = field(default_factory=lambda: np.zeros((1, 1), dtype=bool))
    far: tuple[bool, bool] = (False, False)
    region: NDArray[np.intp] | None = None
    drop_ohm: Float = field(default_factory=lambda: np.zeros((2, 0, 0)))
    drop_std: Float = field(default_factory=lambda: np.zeros((0, 0)))
    drop_shift: Float = field(default_factory=lambda: np.zeros((0, 0)))


class NearPorts(NamedTuple):
    """What near ends show of one frame.

    ports: currents and their deviations.
    fault: readings that contradict each other, in words, or empty.
    spread: how far the readings of each cell disagree.
    variances: of noise, and of what counts as error.
    offset_ratio: what both near ends of all ports have in common, in mode far [V/Vdd].
    """

    ports: PortCurrents
    fault: str = ""
    spread: Spread | None = None
    variances: Variances | None = None
    offset_ratio: float = 0.0


class PortReader:
    """Reads the frames of a skin, one after the other.

    far: whether rows, and whether columns, are sensed at their far ends.
    """

    def __init__(self, knowledge: SkinKnowledge) -> None:
        self._knowledge, self._near_ends = knowledge, NearEnds(knowledge)
        self.far = far_ends_of(knowledge.checked_names)
        per_cell, square_ohm = self._near_ends.per_cell, self._near_ends.square_ohm
        self._noise = ReadingNoise(knowledge, per_cell, square_ohm)
        self._partial = PartialEnds(knowledge)
        self._own_lead_ohm, rest = knowledge.own_lead_of_ports, None
        if knowledge.rest_ratio is not None:
            rest = self._read_near(knowledge.rest_ratio, in_order=False).ports
            self._partial.keep_as_rest()
        self._faults, self._far_faults = SkinFaults(knowledge, rest), FarFaults(knowledge, self.far)
        self._rest_fault = self._faults.at_rest()

    def reset(self) -> None:
        """Forget the frames before: the last one, and which lines they have shown apart."""
        self._noise.reset()
        self._partial.reset()
        self._faults.reset()
        self._far_faults.reset()

    def read(self, ratio: Float, *, in_order: bool = False) -> PortReadings:
        """Currents of checked readings (R, C, m), m for each cell, and what is wrong with them.

        Of near ends, readings may be NaN: `port_partial`.

        in_order: True for live frames: how the residuals have changed since the frame before is
        noise. False for readings at rest, which may be one scan or the mean of many. They, too,
        count as one frame in the search for shorted lines, so call `reset` after them.
        """
        near = self._read_near(ratio, in_order=in_order)
        # `find` is not called where another fault is known: such a frame must not count as one that
        # shows lines alike, or apart.
        region = self._partial.region
        fault = near.fault or self._rest_fault
        fault = fault or self._faults.find(near.ports, is_whole=region is None)
        if not any(self.far):
            return PortReadings(ratio, *near.ports, fault, self._faults.doubt, region=region)
        assert near.variances is not None  # at far ends, all is read
        assert near.spread is not None
        variance = self._noise.between_ends(near.variances)
        far = read_far_ends(ratio, self._knowledge, near.ports, variance)
        drop_ratio_std = np.sqrt(variance)
        shift_ratio = self._noise.offset_std(near.spread, near.offset_ratio)
        find = self._far_faults.find if in_order else self._far_faults.keep_as_rest
        return PortReadings(
            ratio,
            *far.ports,
            "; ".join(filter(None, (fault, find(far, drop_ratio_std, shift_ratio)))),
            self._faults.doubt,
            self.far,
            drop_ohm=far.drop / far.near_current,
            # Chosen: as good as nothing is known, and its square is still a number.
            drop_std=np.where(far.is_dead, 1e9, drop_ratio_std / far.near_current),
            drop_shift=shift_ratio / far.near_current,
        )

    def _read_near(self, ratio: Float, *, in_order: bool) -> NearPorts:
        """What the near ends show, as if all lines had the nominal lead."""
        near = self._read_as_is(ratio, in_order=in_order)
        if self._own_lead_ohm is None:
            return near
        return near._replace(ports=near.ports.without(self._own_lead_ohm))

    def _read_as_is(self, ratio: Float, *, in_order: bool) -> NearPorts:
        """Currents by the near ends, less what lines that charge add, if readings may show that.

        Two things make the readings of a cell disagree: noise, which changes from frame to frame,
        and lines that charge, which do the same in every frame. Where readings hardly disagree by
        more than rounding, these two cannot be told apart, and the correction would only add noise.
        Where they disagree by more, it is made whatever the cause: in a frame that is only noisy,
        too.
        """
        if np.isnan(ratio).any():
            return NearPorts(self._partial.read(ratio))
        near, noise = self._near_ends.read(ratio), self._noise
        current, v_n = near.current, np.inf  # inf: not known
        spread = noise.spread(near.residual)
        if not noise.shows_nothing_staying(spread):
            current = current - self._near_ends.charging(near)
            v_n = noise.of_change(near.residual) if in_order else noise.of_mean(near.ratio)
        variances = noise.variances(spread, v_n)
        if in_order:
            noise.keep(near.residual)
        ports = PortCurrents(current, noise.current_std(variances))
        ratio_std = self._knowledge.ratio_std
        ports, fault = mended(self._near_ends, near, spread, ports, ratio_std)
        if not any(self.far):
            self._partial.keep(Shown(ports, variances.noise, near, in_order))
        # In mode far, both near ends have the same offset. Mode near does not use it.
        return NearPorts(ports, fault, spread, variances, float(near.offset_ratio[0]))
