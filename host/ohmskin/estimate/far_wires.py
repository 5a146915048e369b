# SPDX-License-Identifier: Apache-2.0
"""The wires, measured: what they lose between the near and the far end of a line.

Symbols, for a line of n cells with as many ports (a row; columns likewise)

====== ========= ================================================================== ==========
symbol shape     meaning                                                            unit
====== ========= ================================================================== ==========
p, s   (n,)      what the line lost per current of its ports, and its deviation     ohm
c      (n, n)    current through its segments, per current of these ports           1
q      (n,)      what segments like the layer's mean, as believed, would lose       ohm
t      (2,)      mean segment of each layer, over what is believed of it            1
o      scalar    offset of far ends against near ones, over its deviation           1
h      (n,)      what an offset of one deviation adds to p: over I, so it differs    ohm
                 from port to port
m      scalar    reference: mean segment of the layer, as first seen                ohm
z      (n,)      the line's segments, in shares of m; y their mean                  1
v      scalar    variance of a segment's own deviation, in shares of the mean. In   1
                 the fit of t, a line as a whole gets the same: the worst case
L, l   (n, n)    information of all frames: sums of m^2 c^T c / s^2, m c^T p / s^2; l is (n,)
====== ========= ================================================================== ==========

The circuit gives c and q, which depend little on the wires. So p = m c z is linear in the segments.

A frame alone shows the layers. An offset of the far ends would make rows seem to lose too much and
columns too little, so it is found with the layers. Minimised is, over t and o,

    sum_lines (p - t q -+ o h)^T (s^2 + v q q^T)^-1 (p - t q -+ o h) + o^2     (- rows, + columns).

v q q^T is there because the ports of a line share its segments: what these have of their own moves
all ports of the line together, so they are not as many independent looks at the layer. The result
is weighed against what frames before have shown. That fades, because a skin bends.

What single segments have of their own takes many frames. It does not fade, because it is kept in
shares of a reference m, and a bend stretches all segments alike. m stays until the layer differs
from it by more than a segment does. With the normal prior of z, the mean y and the variance v,

    z = y + v (1 + v L)^-1 (l - L y) , y = sum_lines 1^T (1 + v L)^-1 l / sum 1^T (1 + v L)^-1 L 1 ,

of covariance v (1 + v L)^-1; y is where the readings of all lines are most probable.

No calmer frame takes a lesson's place here, as it does where touches teach the wires. There, a
touch is a lesson once, and its error would stay. Here, each frame measures the layers anew, and in
the sums L and l a noisy frame counts for little, because it is weighed by its noise.
"""

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.skin import PortCircuit
from ohmskin.estimate.port_readings import PortReadings
from ohmskin.estimate.prior import FADE_SHARE, LAYER_STD, MAX_STEP_LOG, SEGMENT_STD
from ohmskin.estimate.wire_belief import Fit, WireBelief


class MeasuredWires(WireBelief):
    """Wires at far ends: a frame shows the mean segment of the layers, many show each segment."""

    def reset(self) -> None:
        """Back to the wires at rest, or the nominal ones."""
        super().reset()
        # Mean and variance of the layers' logs before this frame: each frame starts from here.
        self._layers_before = self._nominal, np.diagonal(self._prior_covariance)
        self._log_reference = self._nominal  # log m of both layers
        self._segment_ohm: Float | None = None  # (2, R, C) as learned, None before any lesson
        self._own_std = np.full((2, *self.shape), SEGMENT_STD)  # of z, (2, R, C)
        # L and l of the lines of each layer, which all lessons add to.
        self._information = [
            (np.zeros((lines, n, n)), np.zeros((lines, n)))
            for lines, n in (self.shape, self.shape[::-1])
        ]

    def before_fit(self, log_cells: Float, ports: PortReadings) -> None:
        """Take the layers from this frame, weighed against the frames before.

        log_cells: those that the fit starts from will do: c and q need no more than a model of the
        frame that is nearly right.
        """
        self._measure(self.circuit(log_cells, self.log_layers), ports)

    def _measure(self, circuit: PortCircuit, ports: PortReadings) -> tuple[float, float]:
        """The layers of one frame, from an approximate circuit of it; o and the variance of o."""
        logs, variance = (before.copy() for before in self._layers_before)
        factors, covariance = self._factors(circuit, ports)
        for layer in (0, 1):
            if self.far[layer]:
                # By noise, t may come out as 0 or less, which has no log.
                factor = max(factors[layer], np.exp(-MAX_STEP_LOG))
                # A scalar Kalman step in logs, for each layer by itself. The variance of log t is
                # that of t over t^2. That both t have the same error, of o, is neglected.
                kept = 1.0 / (1.0 + variance[layer] * factor**2 / covariance[layer, layer])
                measured = self.log_layers[layer] + np.log(factor)
                logs[layer] += (1 - kept) * (measured - logs[layer])
                variance[layer] *= kept
        self._believe(logs, np.diag(np.sqrt(variance)))
        return factors[2], covariance[2, 2]

    def _factors(self, circuit: PortCircuit, ports: PortReadings) -> tuple[Float, Float]:
        """t of both layers and o, (3,), and their covariance: the normal equations of the cost.

        With ab for a^T b / s^2, a sum over the ports of a line, Sherman and Morrison's formula is

            a^T (s^2 + v q q^T)^-1 b = ab - gain qa qb ,   gain = 1 / (1 / v + qq) .

        Raises LinAlgError for readings so exact that nothing is left of these differences.
        """
        weight = ports.drop_std**-2.0
        # The 1 of o is o^2 in the cost. The 1 of t stays only for a layer that is not sensed, whose
        # t nobody uses: without it, there were no inverse.
        normal, right = np.eye(3), np.zeros(3)
        for layer, sign in ((0, 1.0), (1, -1.0)):
            if not self.far[layer]:
                continue
            q = circuit.drop_ohm[layer].reshape(self.shape)
            p, h = ports.drop_ohm[layer], sign * ports.drop_shift
            qq, qh, qp, hh, hp = (
                (weight * one * other).sum(axis=1 - layer)
                for one, other in ((q, q), (q, h), (q, p), (h, h), (h, p))
            )
            gain = 1.0 / (1.0 / SEGMENT_STD**2 + qq)
            normal[layer, layer] = (qq - gain * qq * qq).sum()
            normal[layer, 2] = normal[2, layer] = (qh - gain * qq * qh).sum()
            normal[2, 2] += (hh - gain * qh * qh).sum()
            right[layer] = (qp - gain * qq * qp).sum()
            right[2] += (hp - gain * qh * qp).sum()
        covariance = np.asarray(np.linalg.inv(normal), np.float64)
        return covariance @ right, covariance

    def fix_rest_wires(self) -> None:
        """Later frames are expected about the wires at rest, but for a bend."""
        variance = np.where(self.far, LAYER_STD**2, np.diagonal(self._prior_covariance))
        self._nominal, self._prior_covariance = self.log_layers, np.diag(variance)
        self._layers_before = self._nominal, variance

    def after_fit(self, fit: Fit, ports: PortReadings) -> None:
        """Learn from a frame that is news: layers as before the fit, and single segments."""
        if not self._is_news(fit.log_cells):
            return
        self._lesson_cells = fit.log_cells
        circuit = self.circuit(fit.log_cells, self.log_layers)
        offset = self._measure(circuit, ports)
        variance = np.diagonal(self._root) ** 2
        most = np.diagonal(self._prior_covariance)
        self._layers_before = self.log_layers, variance + FADE_SHARE * (most - variance)
        segments = self.segment_ohm(self.mean)
        for layer in (0, 1):
            if self.far[layer]:
                segments[layer] = self._segments_of(layer, circuit, ports, offset)
        self._segment_ohm = segments

    def _segments_of(
        self, layer: int, circuit: PortCircuit, ports: PortReadings, offset: tuple[float, float]
    ) -> Float:
        """Segments of a layer, (R, C) [ohm], from this frame and all lessons before.

        It adds the frame to the L and l of the layer's lines, and sets the layer's `_own_std`.
        offset: o and its variance, in this frame.
        """
        if abs(self.log_layers[layer] - self._log_reference[layer]) > SEGMENT_STD:
            self._log_reference = self._log_reference.copy()
            self._log_reference[layer] = self.log_layers[layer]
        shift = (1 - 2 * layer) * ports.drop_shift
        drop = ports.drop_ohm[layer] - offset[0] * shift
        weight = 1.0 / (ports.drop_std**2 + offset[1] * shift**2)
        if layer == 1:  # a line first, then its ports
            drop, weight = drop.T, weight.T
        reference_ohm = np.exp(self._log_reference[layer])
        slopes = reference_ohm * circuit.line_current(layer)  # m c, (lines, ports, segments)
        heavy = slopes * weight[..., None]
        information, pull = self._information[layer]  # L and l, which are written into
        information += np.matmul(heavy.transpose(0, 2, 1), slopes)
        pull += np.einsum("lpk,lp->lk", heavy, drop)
        variance = SEGMENT_STD**2
        inverse = np.linalg.inv(np.eye(len(information[0])) + variance * information)
        # (1 + v L)^-1 l, and (1 + v L)^-1 L 1, of each line.
        of_pull, of_ones = np.matmul(
            inverse, np.stack([pull, information.sum(axis=2)], axis=2)
        ).transpose(2, 0, 1)
        mean = of_pull.sum() / of_ones.sum()
        share = mean + variance * (of_pull - mean * of_ones)
        own_std = np.sqrt(variance * np.einsum("lkk->lk", inverse))
        self._own_std[layer] = own_std if layer == 0 else own_std.T
        return np.asarray(reference_ohm * (share if layer == 0 else share.T))

    def segment_ohm(self, log_wires: Float) -> Float:
        """Segments (2, R, C) [ohm], as learned; those of the fit if no frame has been news."""
        if self._segment_ohm is None:
            return super().segment_ohm(log_wires)
        return self._segment_ohm.copy()

    def segment_std(self) -> Float:
        """As of layers that are known, and what readings leave of each segment's own."""
        return np.asarray(np.hypot(np.diagonal(self._root)[:, None, None], self._own_std))
