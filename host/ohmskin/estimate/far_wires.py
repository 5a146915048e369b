# SPDX-License-Identifier: Apache-2.0
"""The wires, measured: what they lose between the near and the far end of a line.

Symbols, for a line of n cells with as many ports (a row; columns likewise)

====== ========= ================================================================== ==========
symbol shape     meaning                                                            unit
====== ========= ================================================================== ==========
p, s   (n,)      what the line lost per current of its ports, and its deviation     ohm
c      (n, n)    current through its segments, per current of these ports           1
q      (n,)      what segments like the layer's mean, as believed, would lose       ohm
t      (4,)      mean segment of each layer over what is believed of it; o; and
                 the mean lead [ohm]
o      scalar    offset of far ends against near ends, over its standard deviation  1
h      (n,)      what an offset of one deviation adds to p: over I, so it differs    ohm
                 from port to port
m      scalar    reference: mean segment of the layer, as first seen                ohm
z      (1+n,)    the line's lead [ohm] and its segments, in shares of m; y the mean
                 of the segments
V      (1+n,)    variances by which each of them differs from its mean. In the fit
                 of t, all wires of a line differ alike: the worst case
L      (1+n,     information of all frames: sums of g^T g / s^2, with g = [1, m c] the
       1+n)      slopes of p by z
l      (1+n,)    sums of g^T p / s^2
====== ========= ================================================================== ==========

The circuit gives c and q, which depend little on the wires. So p = g z is linear in the wires.

What the segments lose, q, grows along the line from port to port. What the lead loses is the same
at all ports of the line. By this, lead and segments are told apart.

A single frame shows the layers and the mean lead. An offset of the far ends would make rows seem to
lose too much and columns too little. So it is found together with them, by minimising over t, in
which o is one element,

    sum_lines (p - X t)^T (s^2 + A A^T)^-1 (p - X t) + o^2 + (lead - k)^2 / d^2 .

X has a column for each element of t that concerns the line: q for its layer, h for the offset (-h
if the line is a column), and ones for the lead. A has the columns q and ones, each times the
deviation of a wire from its mean. It is there because all ports of a line share the wires of the
line: what these wires differ from their means by moves all these ports together, so the ports are
not as many independent measurements of the means. k and d are the mean lead that frames before have
shown, and its deviation. The means of the layers that result are weighed against those that frames
before have shown. What frames have shown of the layers fades, because a skin bends.

It takes many frames to show how single segments differ from the mean. This does not fade: it is
kept in shares of a reference m, and a bend stretches all segments alike. m is changed when the mean
of the layer differs from it by more than segments do from each other. With z the lead of a line
[ohm] and its segments [m], u what is expected of them, and V a diagonal,

    z = u + V (1 + L V)^-1 (l - L u) ,

of covariance V (1 + L V)^-1. The expected lead is the mean lead. The expected segments are all the
same, y, at which the readings of all lines are most probable. With e a vector of ones for segments
and 0 for the lead,

    y = sum_lines e^T (1 + L V)^-1 (l - L u_lead) / sum_lines e^T (1 + L V)^-1 L e .

`LearnedWires` lets a calmer frame of the same touch replace a lesson. That is not needed here.
There, each touch is a lesson only once, so that the error of a noisy frame would stay. Here, each
frame measures the layers anew, and in the sums L and l a noisy frame has a small weight.
"""

from typing import Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.ports import PortCircuit
from ohmskin.estimate.knowledge import WireOhm
from ohmskin.estimate.port_readings import PortReadings
from ohmskin.estimate.prior import LAYER_STD, MAX_STEP_LOG, SEGMENT_STD
from ohmskin.estimate.wire_belief import Fit, WireBelief

# Share of what is known of the layers that fades after each lesson, because skins bend. Chosen: as
# each frame measures the layers, little depends on it.
FADE_SHARE: Final = 0.1
# The far end of a line is at fault if the line loses less than this share of what the usual line
# loses. Chosen: sound lines differ by less.
OFF_SHARE: Final = 0.5
# It must be less by so many deviations. Chosen: by chance, one normal error of 2,000 is as large.
OFF_STDS: Final = 3.5
# A layer counts as measured if the log of its mean segment has a smaller deviation. Chosen: between
# what a bend may change and what is supposed of wires that nobody has told.
KNOWN_LOG: Final = 0.5


class MeasuredWires(WireBelief):
    """Wires at far ends: a frame shows the mean segment of the layers, many show each segment."""

    def reset(self) -> None:
        """Back to the wires at rest, or the nominal ones."""
        super().reset()
        # The means and their variances before this frame: each frame starts from here.
        self._means_before = self._nominal, np.diagonal(self._prior_covariance)
        self._log_reference = self._nominal[:2]  # log m of both layers
        self._segment_ohm: Float | None = None  # (2, R, C) as learned, None before any lesson
        self._own_std = np.full((2, *self.shape), SEGMENT_STD)  # of z, (2, R, C)
        self._off = [np.zeros(lines, dtype=bool) for lines in self.shape]
        self._is_layer_off = [False, False]
        self._judged: PortReadings | None = None  # the last frame whose lines have been looked at
        # L and l of the lines of each layer, which all lessons add to.
        self._information = [
            (np.zeros((lines, 1 + n, 1 + n)), np.zeros((lines, 1 + n)))
            for lines, n in (self.shape, self.shape[::-1])
        ]

    def expect_usual(self, wanted: bool) -> None:
        """Fits always expect the usual: no lesson shows a layer that is sensed at near ends."""
        super().expect_usual(True)

    def learned(self) -> WireOhm | None:
        """The means as the last frame has shown them, also if it had a fingertip on the skin."""
        return None if self._known.means is self._nominal else self._as_known()

    def before_fit(self, log_cells: Float, ports: PortReadings) -> None:
        """Take the means from this frame, weighed against the frames before.

        log_cells: the cells that the fit starts from are good enough, because c and q need only an
            approximate model of the frame.
        """
        self._measure(self.circuit(log_cells, self.means, PortCircuit), ports)

    def _measure(self, circuit: PortCircuit, ports: PortReadings) -> tuple[float, float]:
        """The means of one frame, from an approximate circuit of it; o and the variance of o."""
        means, variance = (before.copy() for before in self._means_before)
        factors, covariance = self._factors(circuit, ports)
        for layer in (0, 1):
            if self.far[layer]:
                # By noise, t may come out as 0 or less, which has no log.
                factor = max(factors[layer], np.exp(-MAX_STEP_LOG))
                # A scalar Kalman step in logs, for each layer by itself. The variance of log t is
                # that of t over t^2. An error of o is in both t; this is neglected.
                kept = 1.0 / (1.0 + variance[layer] * factor**2 / covariance[layer, layer])
                measured = self.means[layer] + np.log(factor)
                means[layer] += (1 - kept) * (measured - means[layer])
                variance[layer] *= kept
        # For the lead, the fit has already weighed what frames before have shown.
        means[2], variance[2] = factors[3], covariance[3, 3]
        self._believe(means, np.diag(variance))
        return factors[2], covariance[2, 2]

    def _factors(self, circuit: PortCircuit, ports: PortReadings) -> tuple[Float, Float]:
        """t, (4,), and its covariance (4, 4): the normal equations of the cost.

        With ab for a^T b / s^2, a sum over the ports of a line, Woodbury's formula is

            a^T (s^2 + A A^T)^-1 b = ab - aA (1 + AA)^-1 Ab .

        Raises LinAlgError for readings so exact that nothing is left of these differences.
        """
        weight = ports.drop_std**-2.0
        lead_ohm, lead_variance = (before[2] for before in self._means_before)
        # On the diagonal, the 1 of o is the term o^2 of the cost. Those of the layers are replaced
        # below, but for a layer that is not sensed: nobody uses its t, and with 0 in place of the 1
        # the matrix would have no inverse.
        normal, right = np.eye(4), np.zeros(4)
        normal[3, 3], right[3] = 1.0 / lead_variance, lead_ohm / lead_variance
        own = np.array([SEGMENT_STD, SEGMENT_STD * abs(self.means[2])])
        of_lines: list[tuple[int, Float]] = []
        for layer, sign in ((0, 1.0), (1, -1.0)):
            if not self.far[layer]:
                continue
            q = circuit.drop_ohm[layer].reshape(self.shape)
            columns = q, sign * ports.drop_shift, np.ones_like(q), ports.drop_ohm[layer]
            lines = np.moveaxis(np.array([*columns, weight]), 1 + layer, 1)
            x, of_ports = lines[:-1], lines[-1]
            products = np.einsum("alp,blp,lp->lab", x, x, of_ports)
            of_lines.append((layer, products.copy()))
            shared = products[:, [0, 2]] * own[:, None]
            system = np.eye(2) + shared[:, :, [0, 2]] * own
            products -= shared.transpose(0, 2, 1) @ np.linalg.solve(system, shared)
            summed = products.sum(axis=0)
            normal[layer, layer] = 0.0
            at = [layer, 2, 3]
            normal[np.ix_(at, at)] += summed[:3, :3]
            right[at] += summed[:3, 3]
        covariance = np.asarray(np.linalg.inv(normal), np.float64)
        factors = covariance @ right
        if ports is not self._judged:
            self._judged = ports
            for layer, products in of_lines:
                self._notice(layer, products, factors[3])
        return factors, covariance

    def _notice(self, layer: int, products: Float, lead_ohm: float) -> None:
        """Notice lines that lose much less than the usual line, and layers that lose nothing.

        Judged is the loss of each line as a share of what the believed wires and lead would lose,
        by least squares. What has been noticed stays until a frame shows that the line loses as it
        should. Lines are compared without what the mean lead of this frame is off: references that
        differ from what is told look like that, in all lines, and are all of what a line loses
        where little of it carries current.

        products (lines, 4, 4): ab of q, h, ones and p. lead_ohm: the mean lead of this frame.
        """
        believed_ohm = max(float(self._means_before[0][2]), 0.0)
        of_loss = products[:, 0] + believed_ohm * products[:, 2]
        per_offset = of_loss[:, 1] / (products[:, 1, 1] + 1.0)
        precision = of_loss[:, 0] + believed_ohm * of_loss[:, 2] - per_offset * of_loss[:, 1]
        precision = np.maximum(precision, 1e-9)
        share = (of_loss[:, 3] - per_offset * products[:, 1, 3]) / precision
        per_ohm = (of_loss[:, 2] - per_offset * products[:, 1, 2]) / precision
        of_line = share - (lead_ohm - believed_ohm) * per_ohm
        reach = OFF_STDS * np.sqrt(1.0 / precision + SEGMENT_STD**2)
        usual = OFF_SHARE * np.sort(of_line)[of_line.size // 2]  # faster than median
        off = self._off[layer]
        off[of_line + reach < usual] = True
        off[of_line - reach > usual] = False
        # A layer whose wires are known may have been bent, but not so far that it loses nothing.
        sound = np.where(off, 0.0, precision)
        total = max(float(sound.sum()), 1e-9)
        loss, nothing = float(share @ sound) / total, OFF_STDS * total**-0.5
        log_std = self._means_before[1][layer] ** 0.5
        least = np.exp(-OFF_STDS * log_std)
        if log_std < KNOWN_LOG and loss < min(nothing, least - nothing):
            self._is_layer_off[layer] = True
        elif loss > nothing:
            self._is_layer_off[layer] = False

    @property
    def fault(self) -> str:
        """Far ends that show none of what their lines lose, in words, or empty."""
        for line, off, whole in zip(("row", "column"), self._off, self._is_layer_off, strict=True):
            if whole or np.count_nonzero(off) > 0.5 * off.size:
                return f"far {line}s lose too little: do they read as near ends?"
            if off.any():
                return f"far {line} {off.argmax()} loses too little: does it read as its near end?"
        return ""

    def fix_rest_wires(self) -> None:
        """Expect the wires at rest in later frames, with the variance that a bend adds."""
        prior = np.diagonal(self._prior_covariance)
        found = np.diagonal(self._known.covariance)
        bend = np.array([*np.where(self.far, LAYER_STD**2 + found[:2], prior[:2]), *found[2:]])
        self._nominal, self._prior_covariance = self._known.means, np.diag(bend)
        self._means_before = self._nominal, bend

    def after_fit(
        self, fit: Fit, ports: PortReadings, tip_log: Float | None = None, *, again: bool = False
    ) -> bool:
        """Learn from a frame that has moved: the means, measured once more, and single segments."""
        if not self._has_moved(fit.log_cells):
            return False
        self._lesson_cells = fit.log_cells
        circuit = self.circuit(fit.log_cells, self.means, PortCircuit)
        offset = self._measure(circuit, ports)
        if self.fault:
            return False
        variance = np.diagonal(self._known.covariance).copy()
        most = np.diagonal(self._prior_covariance)
        variance[:2] += FADE_SHARE * (most - variance)[:2]  # a bend does not change leads
        self._means_before = self._known.means, variance
        segments = self.segment_ohm(self.expected_wires)
        for layer in (0, 1):
            if self.far[layer]:
                segments[layer] = self._segments_of(layer, circuit, ports, offset)
        self._segment_ohm = segments
        return False

    def _segments_of(
        self, layer: int, circuit: PortCircuit, ports: PortReadings, offset: tuple[float, float]
    ) -> Float:
        """Segments of a layer, (R, C) [ohm], from this frame and all lessons before.

        It adds the frame to the L and l of the layer's lines, and sets the layer's `_own_std`.
        offset: o and its variance, in this frame.
        """
        if abs(self.means[layer] - self._log_reference[layer]) > SEGMENT_STD:
            self._log_reference = self._log_reference.copy()
            self._log_reference[layer] = self.means[layer]
        shift = (1 - 2 * layer) * ports.drop_shift
        drop = ports.drop_ohm[layer] - offset[0] * shift
        weight = 1.0 / (ports.drop_std**2 + offset[1] * shift**2)
        if layer == 1:  # a line first, then its ports
            drop, weight = drop.T, weight.T
        reference_ohm, lead_ohm = np.exp(self._log_reference[layer]), self.means[2]
        currents = circuit.line_current(layer)  # c, (lines, ports, segments)
        slopes = np.concatenate([np.ones((*drop.shape, 1)), reference_ohm * currents], axis=2)  # g
        heavy = slopes * weight[..., None]
        information, pull = self._information[layer]  # L and l, which are written into
        information += np.matmul(heavy.transpose(0, 2, 1), slopes)
        pull += np.einsum("lpk,lp->lk", heavy, drop)
        variance = np.full(slopes.shape[2], SEGMENT_STD**2)
        variance[0] = max((SEGMENT_STD * lead_ohm) ** 2, 1e-6)
        inverse = np.linalg.inv(np.eye(len(variance)) + information * variance)
        # (1 + L V)^-1 (l - L u_lead), and (1 + L V)^-1 L e, of each line.
        beyond_lead = pull - information[..., 0] * lead_ohm
        of_pull, of_ones = np.matmul(
            inverse, np.stack([beyond_lead, information[..., 1:].sum(axis=2)], axis=2)
        ).transpose(2, 0, 1)
        mean = of_pull[:, 1:].sum() / of_ones[:, 1:].sum()
        share = (mean + variance * (of_pull - mean * of_ones))[:, 1:]
        own_std = np.sqrt(variance * np.einsum("lkk->lk", inverse))[:, 1:]
        self._own_std[layer] = own_std if layer == 0 else own_std.T
        return np.asarray(reference_ohm * (share if layer == 0 else share.T))

    def segment_ohm(self, log_wires: Float) -> Float:
        """Segments (2, R, C) [ohm]: at far ends those learned, once a frame has been news.

        Others are those of the fit: no lesson is about a layer that is sensed at near ends.
        """
        segments = super().segment_ohm(log_wires)
        if self._segment_ohm is not None:
            far = np.array(self.far)
            segments[far] = self._segment_ohm[far]
        return segments

    def segment_std(self) -> Float:
        """The deviation of the layer's mean, and that of the segment's difference from it."""
        return np.asarray(np.hypot(np.diagonal(self._root)[:2, None, None], self._own_std))
