# SPDX-License-Identifier: Apache-2.0
"""The wires, measured: what they lose between the near and the far end of a line.

Symbols, for a line of n cells with as many ports (a row; columns likewise)

====== ======== ================================================================== ==========
symbol shape    meaning                                                            unit
====== ======== ================================================================== ==========
p, s   (n,)     what the line lost per current of its ports, and its deviation     ohm
c      (n, n)   current through its segments, per current of these ports           1
q      (n,)     what segments like the layer's mean, as believed, would lose       ohm
m      scalar   reference: mean segment of the layer, as first seen                ohm
z      (n,)     the line's segments, in shares of m; y their mean                  1
v      scalar   variance of z about y                                              1
L, l   (n, n)   information of all frames: sums of m^2 c^T c / s^2, m c^T p / s^2
====== ======== ================================================================== ==========

The circuit gives c and q: they depend little on the wires. So p = m c z is linear. A frame shows
the layers by itself, and an offset o that far ends may have against near ones: rows lose too much
by it, columns too little (h, per deviation of o, as I changes from port to port). With t the factor
by which a layer exceeds what is believed, minimised is, over t of both layers and o,

    sum_lines (p - t q -+ o h)^T (s^2 + v q q^T)^-1 (p - t q -+ o h) + o^2 ,

weighed against what frames before have shown, which fades: a skin bends. What single segments have
of their own takes many frames. It does not fade, in shares of a reference m, which stays until the
layer differs from it by more than a segment does:

    z = y + v (1 + v L)^-1 (l - L y) , y = sum_lines 1^T (1 + v L)^-1 l / sum 1^T (1 + v L)^-1 L 1 ,

of covariance v (1 + v L)^-1.
"""

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.skin import PortCircuit
from ohmskin.estimate.port_readings import PortReadings
from ohmskin.estimate.prior import FADE, LAYER_STD, MAX_STEP, SEGMENT_STD, WireBelief


class MeasuredWires(WireBelief):
    """What far ends show of the wires of a skin: of layers in a frame, of segments in many."""

    def reset(self) -> None:
        """Back to the wires at rest, or the nominal ones."""
        super().reset()
        self._before = self._nominal, np.diagonal(self._prior_covariance)
        self._reference = self._nominal
        self._segments: Float | None = None
        self._own_std = np.full((2, *self.shape), SEGMENT_STD)
        self._known = [
            (np.zeros((lines, n, n)), np.zeros((lines, n)))
            for lines, n in (self.shape, self.shape[::-1])
        ]

    def measure(self, circuit: PortCircuit, ports: PortReadings) -> None:
        """Take the layers' wires from one frame, whose circuit is about this one."""
        layers, variance = (of.copy() for of in self._before)
        weight = ports.drop_std**-2.0
        normal, right = np.eye(3), np.zeros(3)  # of t of both layers, and of the shift
        for layer, sign in ((0, 1.0), (1, -1.0)):
            if not ports.far[layer]:
                continue
            model = circuit.drop_ohm[layer].reshape(self.shape)
            shift = sign * ports.drop_shift
            # Sums over each line, of which the segments' own deviation is taken out.
            own, shared, seen, both, read = (
                (weight * one * other).sum(axis=1 - layer)
                for one, other in (
                    *((model, model), (model, shift), (model, ports.drop_ohm[layer])),
                    *((shift, shift), (shift, ports.drop_ohm[layer])),
                )
            )
            less = 1.0 / (1.0 / SEGMENT_STD**2 + own)
            normal[layer, layer] = (own - less * own * own).sum()
            normal[layer, 2] = normal[2, layer] = (shared - less * own * shared).sum()
            normal[2, 2] += (both - less * shared * shared).sum()
            right[layer] = (seen - less * own * seen).sum()
            right[2] += (read - less * shared * seen).sum()
        covariance = np.linalg.inv(normal)
        found = covariance @ right
        for layer in (0, 1):
            if ports.far[layer]:
                times = max(found[layer], np.exp(-MAX_STEP))
                prior = 1.0 / (1.0 + variance[layer] * times**2 / covariance[layer, layer])
                seen_log = self.log_layers[layer] + np.log(times)
                layers[layer] += (1 - prior) * (seen_log - layers[layer])
                variance[layer] *= prior
        self.log_layers, self._root = layers, np.diag(np.sqrt(variance))
        self._shift = found[2], covariance[2, 2]

    def settle(self, far: tuple[bool, bool]) -> None:
        """These are the wires at rest: later frames are expected about them, but for a bend."""
        variance = np.where(far, LAYER_STD**2, np.diagonal(self._prior_covariance))
        self._nominal, self._prior_covariance = self.log_layers, np.diag(variance)
        self._before = self._nominal, variance

    def keep(self, circuit: PortCircuit, ports: PortReadings) -> None:
        """Learn from a frame that is news: layers as in `measure`, and single segments."""
        self.measure(circuit, ports)
        known = np.diagonal(self._root) ** 2
        most = np.diagonal(self._prior_covariance)
        self._before = self.log_layers, known + FADE * (most - known)
        segments, variance = self.layers(self.mean), SEGMENT_STD**2
        for layer in (0, 1):
            if not ports.far[layer]:
                continue
            if abs(self.log_layers[layer] - self._reference[layer]) > SEGMENT_STD:
                self._reference = self._reference.copy()
                self._reference[layer] = self.log_layers[layer]
            shift = (1 - 2 * layer) * ports.drop_shift
            drop = ports.drop_ohm[layer] - self._shift[0] * shift
            weight = 1.0 / (ports.drop_std**2 + self._shift[1] * shift**2)
            if layer == 1:
                drop, weight = drop.T, weight.T
            ohm = np.exp(self._reference[layer])
            current = ohm * circuit.line_current(layer)
            heavy = current * weight[..., None]
            precision, pull = self._known[layer]
            precision += np.matmul(heavy.transpose(0, 2, 1), current)
            pull += np.einsum("lpk,lp->lk", heavy, drop)
            inverse = np.linalg.inv(np.eye(len(precision[0])) + variance * precision)
            told = np.matmul(inverse, np.stack([pull, precision.sum(axis=2)], axis=2))
            mean = told[..., 0].sum() / told[..., 1].sum()
            share = mean + variance * (told[..., 0] - mean * told[..., 1])
            own_std = np.sqrt(variance * np.einsum("lkk->lk", inverse))
            segments[layer] = ohm * (share if layer == 0 else share.T)
            self._own_std[layer] = own_std if layer == 0 else own_std.T
        self._segments = segments

    def layers(self, log_wires: Float) -> Float:
        """Segments (2, R, C) [ohm], as learned, or these if no frame has been news."""
        return super().layers(log_wires) if self._segments is None else self._segments.copy()

    def segment_std(self) -> Float:
        """As of layers that are known, and what readings leave of each segment's own."""
        return np.asarray(np.hypot(np.diagonal(self._root)[:, None, None], self._own_std))
