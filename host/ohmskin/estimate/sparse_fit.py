# SPDX-License-Identifier: Apache-2.0
"""Which cells a frame shows to be touched, and how hard: what `touch` answers, and where `joint`
starts.

Symbols; m, x, s, J, W, P and S differ from those of `full_fit`

====== ============== ================================================================== ==========
symbol shape          meaning                                                            unit
====== ============== ================================================================== ==========
rho0   (RC,)          port resistance of the untouched skin                              ohm
H      (RC, RC)       voltage over cell e per current through port p                     ohm
M      (RC, RC)       voltage over cell e per current forced through cell f from outside ohm
d      (k,)           what the touches add to the conductance of k cells                 S
q      (k, RC)        current that the added conductance draws, per port current         1
v      (RC, RC)       voltage over cell e per current through port p, cells touched      ohm
x      (k,)           log conductances of the k touched cells; all others are at rest    log S
I      (RC,)          port currents per Vdd                                              S
s      (RC,)          deviation of I by noise of readings, drift of cells at rest, wires S
r      (RC,)          residual (I_read - I) / s, I_read the measured currents            1
J      (k, RC)        dI / dx / s                                                        1
A      (k, k)         J J^T and the precision of the prior of x                          1
W      (m, 2RC+n)     dI / dw / s P^1/2 at the m ports where wires matter; w are the log 1
                      segments and the leads, P is their covariance, n the number of
                      means (`wire_belief`). (m, n) where single segments are in these
S      (m, m)         covariance of r at these ports by noise and wires, 1 + W W^T       1
====== ============== ================================================================== ==========

H, M and v are voltages per ampere, hence in ohms; in the code they are called `..._volt`.

The untouched skin is solved once. Added conductances are a change of rank k (Woodbury):

    q = (diag(1/d) + M_kk)^-1 H_k ,   rho = rho0 - sum_k H_k q ,   v = H - M_k^T q ,

and over the touched cells v_k = q / d. All derivatives follow from v: d rho / d g_e = -v_e^2
(Tellegen). At far ends, a port is driven and sensed at different ends. There, one factor of each
product is H, q or v of the sensed ends.

A frame starts without touched cells. Gauss-Newton steps on x minimise |r|^2 and the prior of the
cells. Where a reading then shows more current than the model explains, it asks for its cell: of
these cells, those that would explain most in their row and in their column are added. This goes on
until no reading asks for a cell. A cell that falls back to rest is taken out. In the last steps,
wires may differ from what is believed of them, with the covariance P. So the readings are weighed
by S^-1 there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ohmskin.arrays import Float
from ohmskin.circuit.ports import PortCircuit, leak_slopes, port_difference, wire_current
from ohmskin.circuit.small import cholesky, gram, inverse, solve, solve_lower, solve_positive
from ohmskin.estimate.knowledge import MAX_CELL_SIEMENS
from ohmskin.estimate.port_readings import PortReadings
from ohmskin.estimate.prior import (
    HIGHEST_TOUCH_SIEMENS,
    LEFT_OUT_STDS,
    MAX_CHI2,
    MAX_ITERATIONS,
    MAX_STEP_LOG,
    SEGMENT_STD,
    TOUCHED_STDS,
    UNLIMITED_STD,
    CellPrior,
)
from ohmskin.estimate.wire_belief import Lesson, WireBelief, without_means

Cells = NDArray[np.intp]
NO_CELLS: Final[Cells] = np.zeros(0, dtype=np.intp)

# All numbers are chosen. `make ablate` tries half, twice and none of each; the table "What each
# number earns" of docs/estimate.md says what came of it.

# Touches are few if there are at most so many for each line, on average. A fingertip makes more.
MAX_TOUCHES_PER_LINE: Final = 0.5
# A reading that shows more current than the model by so many deviations asks for its cell.
DEMAND_STDS: Final = 4.0
# A cell that asks counts as a ghost if it would add less conductance than this share of the largest
# in its row, or of the largest in its column.
RIVAL_SHARE: Final = 0.5
# Wires matter to a reading if they may move it by more than this share of its noise.
HEAVY_SHARE: Final = 0.1
_MAX_LOG_SIEMENS: Final = float(np.log(MAX_CELL_SIEMENS))


class RestNetwork(PortCircuit):
    """rho0, H and M of a skin whose cells all conduct.

    cell_siemens: conductances of the cells, (RC,) [S]; given as (R, C).
    port_volt, sense_volt: H by the driven and by the sensed ends of the ports, (cells, ports).
    volts: both of them; where all ends are near ends, these are one.
    cell_volt: M, (RC, RC).
    own_slope: -d rho / d g of each cell at its own port, (RC,) [ohm^2].
    own_volt: M[e, e] of each cell, (RC,) [ohm].
    """

    def __init__(self, cell_siemens: Float, *wire_ohm: float, **others: Any) -> None:
        """Made of what a `PortCircuit` is made of."""
        super().__init__(cell_siemens, *wire_ohm, **others)
        self.cell_siemens = siemens = cell_siemens.ravel()
        currents = [self.cell_current, self.sense_current][: 1 + any(self.far)]
        lines = [current.reshape(-1, siemens.size) / siemens for current in currents]
        self.volts = [port_difference(each, self.rows).T for each in lines]
        self.port_volt, self.sense_volt = self.volts[0], self.volts[-1]
        # in_series[e, f]: current through cell e per volt inserted in series with cell f. While the
        # electrodes are held, it is B = sqrt(g) (1 + sqrt(g) K sqrt(g))^-1 sqrt(g). As they float,
        # it is B - B E^T Z E B, where B E^T is `per_potential`, and Z E B is `lines[0] * siemens`.
        # (K, E and Z as in `circuit.skin`.)
        in_series = inverse(self.factor)
        in_series *= np.sqrt(siemens) * np.sqrt(siemens)[:, None]
        in_series -= self.per_potential @ (lines[0] * siemens)
        # One ampere forced through cell f makes 1 / g_f volts over it, if no current can leave the
        # cell. As it can, the cell acts as a source of 1 / g_f volts (Norton), which drives
        # in_series[:, f] / g_f through all cells, against the voltages that are counted here.
        self.cell_volt = -in_series / siemens / siemens[:, None]
        self.cell_volt.ravel()[:: siemens.size + 1] += 1.0 / siemens
        self.own_slope = self.port_volt.diagonal() * self.sense_volt.diagonal()
        self.own_volt = self.cell_volt.diagonal()

    def by_wires_of(self, ports: Cells, cell_current: Float, sense_current: Float) -> Float:
        """d rho / dw of all wires, (m, 2RC) [ohm], from cell currents of ports, (m, RC).

        cell_current, sense_current: the currents through the cells that a current of one makes
            which flows through the driven ends, or through the sensed ends, of a port.
        """
        slopes = wire_current(cell_current.reshape(-1, *self.shape))
        if any(self.far):
            sensed = wire_current(sense_current.reshape(-1, *self.shape))
            # A current into a far end flows back through the whole line.
            rows, columns = np.divmod(ports, self.shape[1])
            sensed[np.arange(ports.size), 0, rows] -= self.far[0]
            sensed[np.arange(ports.size), 1, :, columns] -= self.far[1]
            slopes *= sensed
        else:
            slopes *= slopes
        slopes *= self.segment_ohm.reshape(2, *self.shape)
        return slopes.reshape(len(cell_current), -1)


class TouchedNetwork:
    """A `RestNetwork` with conductances `added` (k,) > 0 [S] at `cells` (k,), k >= 0.

    port_ohm: rho, (RC,).
    volt, sense_volt: v of the touched cells by the driven, and by the sensed ends, (k, RC).
    """

    def __init__(self, rest: RestNetwork, cells: Cells, added: Float) -> None:
        self._rest, self._cells, self._added = rest, cells, added
        self._system = rest.cell_volt[cells[:, None], cells]
        self._system.ravel()[:: cells.size + 1] += 1.0 / added
        # q by the driven ends, and by the sensed ones if they are others.
        at_rest = [volt[cells] for volt in rest.volts]
        self._drawn = [solve_positive(self._system, volt) for volt in at_rest]
        volts = [drawn / added[:, None] for drawn in self._drawn]
        self.volt, self.sense_volt = volts[0], volts[-1]
        self.port_ohm = rest.port_ohm - (at_rest[-1] * self._drawn[0]).sum(axis=0)

    def own_slope(self) -> tuple[Float, Float]:
        """-d rho / d g of each cell at its own port, and its M[e, e], cells touched, both (RC,)."""
        rest = self._rest
        if not self._cells.size:  # as in most frames: this saves a tenth of their time
            return rest.own_slope, rest.own_volt
        coupling = rest.cell_volt[self._cells]
        by_forced = solve_positive(self._system, coupling)  # q, of currents forced through cells
        volts = [
            volt.diagonal() - (coupling * drawn).sum(axis=0)
            for volt, drawn in zip(rest.volts, self._drawn, strict=True)
        ]
        return volts[0] * volts[-1], rest.own_volt - (coupling * by_forced).sum(axis=0)

    def slopes(
        self, ports: Cells, prior: CellPrior, belief: WireBelief, fitted: Cells | None = None
    ) -> tuple[Float, Float]:
        """Slopes of rho of m ports by the log resistances of cells (m, RC), and by wires.

        Those by cells that are fitted are 0; by default, these are the touched ones. The others
        follow the means of the wires. Slopes by wires are those of `WireBelief.per_std`. By
        Tellegen, the slope by a cell is v v' g, v' by the sensed ends, and likewise by a wire.
        """
        current, sensed = self.cell_current(ports)
        by_cell = current * sensed / self._rest.cell_siemens
        by_cell[:, self._cells if fitted is None else fitted] = 0.0
        by_leaks = 1e-6 * self.by_leaks(ports) if belief.has_leaks else None  # by uS
        by_wire = self._rest.by_wires_of(ports, current, sensed)
        by_means = belief.by_means(by_wire, belief.means, ports, by_leaks)
        return by_cell, belief.per_std(by_wire, by_means + by_cell @ prior.by_means)

    def by_leaks(self, ports: Cells) -> Float:
        """Slopes of rho of m ports by the leaks of rows, and of columns, (m, 2) [ohm / S].

        The current that the touches draw lowers the voltage between neighbouring lines.
        """
        rest, rows = self._rest, self._rest.rows
        of_cells = rest.cell_current.reshape(-1, rest.cell_siemens.size) / rest.cell_siemens
        by_touch = of_cells[:, self._cells].T
        volt, sensed = (
            port_difference(potential, rows)[ports] - drawn.T[ports] @ by_touch
            for potential, drawn in (
                (rest.impedance.T, self._drawn[0]),
                (rest.sensed.T, self._drawn[-1]),
            )
        )
        return leak_slopes(volt, sensed, rest.shape)

    def cell_current(self, ports: Cells) -> tuple[Float, Float]:
        """Currents through all cells per current through driven ends, and through sensed ends.

        Both are of m ports, (m, RC).
        """
        rest, cell_volt_of_touched = self._rest, self._rest.cell_volt[self._cells]
        siemens = rest.cell_siemens.copy()
        siemens[self._cells] += self._added
        currents = [
            (volt.T[ports] - drawn.T[ports] @ cell_volt_of_touched) * siemens
            for volt, drawn in zip(rest.volts, self._drawn, strict=True)
        ]
        return currents[0], currents[-1]


@dataclass(frozen=True, eq=False)
class Touched:
    """The answer of a few touches. It has the attributes of a `FullFit` that answers are made of.

    cells: the touched cells, (k,).
    log_cells: log resistances of all cells, (RC,) [log ohm].
    log_cells_std: their deviation, (RC,).
    own_log_std: the part of it that does not come from the means of the layers and leads, (RC,).
    by_means: how much these logs follow the means of the top and of the bottom layer [log ohm], and
        the mean lead [ohm], up or down, (RC, 3).
    modelled: port currents of the model, (RC,) [S].
    iterations: steps taken.
    teach: says what the readings tell of the wires. Only some frames are asked.
    misfit, surprise: always 0: where few touches do not explain the readings, there is no
        `Touched`.
    """

    cells: Cells
    log_cells: Float
    log_cells_std: Float
    own_log_std: Float
    by_means: Float
    modelled: Float
    iterations: int
    teach: Callable[[], Lesson]
    misfit: float = 0.0
    surprise: float = 0.0

    @cached_property
    def lesson(self) -> Lesson:
        """What the readings say of the wires."""
        return self.teach()


def most_touches(shape: tuple[int, int]) -> float:
    """How many touches of a skin (R, C) are still few."""
    return MAX_TOUCHES_PER_LINE * sum(shape)


class SparseFit:
    """Fits the frames of a skin (R, C), each by itself.

    most: how many touches are still few. Frames with more have no answer here.
    least_log_siemens: a cell counts as touched if its log conductance is above this, (RC,).
    series_ohm: the references and the leads of each port, which are in series with the skin,
        (RC,) [ohm].
    net: the network of the untouched skin.
    untouched: the same as a `TouchedNetwork` without touches, from which each frame starts.
    current: port currents of the untouched skin per Vdd, (RC,) [S].
    model_variance: variance of these currents by the drift of cells and by what is not known of
        wires, (RC,) [S^2].
    least_ohm: wires from each cell to the sensed ends of its lines: a port has at least as much,
        (RC,) [ohm].
    path_std_ohm: standard deviation of these wires and of the leads, (RC,) [ohm].
    """

    def __init__(self, prior: CellPrior, belief: WireBelief, ref_ohm: float) -> None:
        self.prior, self.belief = prior, belief
        self.series_ohm = ref_ohm + belief.leads_of_ports @ belief.lead_ohm(prior.means)
        self.most = most_touches(belief.shape)
        self.least_log_siemens = -prior.expected + TOUCHED_STDS * prior.std
        self.net = net = belief.circuit(prior.expected, prior.means, RestNetwork)
        self.untouched = TouchedNetwork(net, NO_CELLS, np.zeros(0))
        self.current = 1.0 / (net.port_ohm + self.series_ohm)
        by_cell, by_wire = self.untouched.slopes(np.arange(net.port_ohm.size), prior, belief)
        # The slope of I is that of rho times I^2, but for the sign.
        variance_ohm2 = by_cell**2 @ prior.std**2 + (by_wire**2).sum(axis=1)
        self.model_variance = variance_ohm2 * self.current**4
        path_ohm = belief.believed_wires().path_ohm
        self.least_ohm = path_ohm - (self.series_ohm - ref_ohm)
        *layer_std, lead_std_ohm = belief.means_std()[:3].tolist()
        wires_std = np.hypot(max(layer_std), SEGMENT_STD) * path_ohm
        self.path_std_ohm = wires_std + belief.leads_of_ports.sum(axis=1) * lead_std_ohm

    def find(self, ports: PortReadings) -> "FewTouches | None":
        """The touched cells of one frame; None if they are not few."""
        frame = FewTouches(self, ports)
        # A frame never starts from the frame before it: cells that no reading asks for would stay.
        frame.converge(NO_CELLS, np.zeros(0))
        for _ in range(MAX_ITERATIONS):
            asked, added_siemens = frame.asked_for()
            if not asked.size:
                return frame if frame.cells.size <= self.most else None
            cells = np.concatenate([frame.cells, asked])
            # Twice as many cells may be in the model for a while: ghosts among them leave again.
            if cells.size > 2 * self.most:
                return None
            log_siemens = np.log(self.net.cell_siemens[asked] + added_siemens)
            frame.converge(cells, np.concatenate([frame.log_siemens, log_siemens]))
        return None


class FewTouches:
    """One frame: the touched cells in its model, and all that follows from them.

    cells: the touched cells, (k,).
    log_siemens: x, their log conductances, (k,) [log S].
    steps: Gauss-Newton steps taken.
    """

    def __init__(self, skin: SparseFit, ports: PortReadings) -> None:
        self._skin = skin
        self._measured, self._reading_std = ports.current.ravel(), ports.current_std.ravel()
        # s of ports whose own cell is at rest. It is approximate at first: the drift of cells and
        # the wires move the currents as if nothing were touched. `explain` makes it anew, for the
        # touches that were found.
        self._untouched_std = np.sqrt(self._reading_std**2 + skin.model_variance)
        self._target_ohm = 1.0 / np.maximum(self._measured, 1e-12) - skin.series_ohm
        self.steps = 0

    def _place(self, cells: Cells, log_siemens: Float) -> None:
        """Take these cells for touched, and compute network, currents and residual."""
        skin = self._skin
        self.cells, self.log_siemens = cells, log_siemens
        self._siemens = np.exp(log_siemens)
        self._touched, self._current = skin.untouched, skin.current
        if cells.size:
            added = self._siemens - skin.net.cell_siemens[cells]
            self._touched = TouchedNetwork(skin.net, cells, added)
            self._current = 1.0 / (self._touched.port_ohm + skin.series_ohm)
        self._compare()

    def _compare(self) -> None:
        """Compute s and r of the present model."""
        # A touched cell can explain whatever its own port reads. So cells at rest and wires are no
        # noise there: only the readings are.
        self._std = self._untouched_std.copy()
        self._std[self.cells] = self._reading_std[self.cells]
        self._residual = (self._measured - self._current) / self._std

    def _forecast(self, log_siemens: Float, slopes: Float) -> None:
        """Take these log conductances of the same cells, (k,), and what `slopes` make of them."""
        change = (log_siemens - self.log_siemens) @ slopes
        self.log_siemens = log_siemens
        self._current = self._current + change * self._std
        self._residual = self._residual - change

    def converge(self, cells: Cells, log_siemens: Float) -> None:
        """Step from these cells until no step matters; cells that fall back to rest are taken out.

        Conductances start at the least that counts as touched, or above it, because a touch must
        add more than 0. If steps still matter after `MAX_ITERATIONS`, they end all the same:
        `asked_for` and `explain` judge what was reached.
        """
        self._place(cells, np.maximum(log_siemens, self._skin.least_log_siemens[cells]))
        for _ in range(MAX_ITERATIONS):
            if not self.cells.size:
                return
            slopes = self._slopes()
            moved, is_last = self._stepped(slopes @ slopes.T, slopes @ self._residual)
            moved = np.minimum(moved, _MAX_LOG_SIEMENS)
            stays = moved > self._skin.least_log_siemens[self.cells]
            self._place(self.cells[stays], moved[stays])
            if is_last and stays.all():
                return

    def _slopes(self) -> Float:
        """J, (k, RC): dI / dx = I^2 v v' g, with v' by the sensed ends."""
        slopes = self._touched.volt * self._touched.sense_volt
        return np.asarray(slopes * self._siemens[:, None] * (self._current**2 / self._std))

    def _stepped(self, system: Float, pull: Float) -> tuple[Float, bool]:
        """x after a step, (k,), and whether no further step would matter.

        system: J J^T, (k, k). It is overwritten by A: the precision of the prior is added.
        pull: J r, (k,).
        """
        centre, variance = self._skin.prior.normal(-self.log_siemens, self.cells)
        # `centre` is the log resistance at rest: minus the log conductance.
        from_rest, precision = self.log_siemens + centre, 1.0 / variance
        system.ravel()[:: self.cells.size + 1] += precision
        step = solve_positive(system, pull - from_rest * precision)
        self.steps += 1
        is_last = (step**4 * system.diagonal()).max() < LEFT_OUT_STDS**2
        step = np.minimum(np.maximum(step, -MAX_STEP_LOG), MAX_STEP_LOG)  # faster than np.clip
        return self.log_siemens + step, bool(is_last)

    def asked_for(self) -> tuple[Cells, Float]:
        """Cells that readings ask for, and the conductance that each would have to add alone [S].

        A current above the model's by `DEMAND_STDS` asks for its cell. Such a cell counts if it
        would add at least `RIVAL_SHARE` of what the largest in its row would add, and of the
        largest in its column. A ghost would add less, because its current passes three touches in
        series.
        """
        skin = self._skin
        asks = self._residual > DEMAND_STDS
        asks[self.cells] = False
        if not asks.any():
            return NO_CELLS, np.zeros(0)
        slope, cell_volt = self._touched.own_slope()
        # A port has at least the resistance of its wires. They may resist less than is believed, so
        # that half of it is taken for the least. Where noise makes a reading show still less, this
        # least counts: the reading then asks for a very hard touch, and not for a touch of negative
        # resistance.
        target_ohm = np.maximum(self._target_ohm, 0.5 * skin.least_ohm)
        # One cell more is a change of rank 1. It lowers rho to the target, and so
        # rho - target = slope / (1 / d + M), which is solved for 1 / d.
        missing_ohm = np.maximum(self._touched.port_ohm - target_ohm, 1e-9)
        added_ohm = slope / missing_ohm - cell_volt
        added_siemens = asks / np.maximum(added_ohm, 1.0 / HIGHEST_TOUCH_SIEMENS)
        of_lines = added_siemens.reshape(skin.net.shape)
        rival = np.maximum(of_lines.max(axis=1, keepdims=True), of_lines.max(axis=0))
        asks &= added_siemens >= RIVAL_SHARE * rival.ravel()
        asked = asks.nonzero()[0]
        return asked, added_siemens[asked]

    @property
    def log_cells(self) -> Float:
        """Log resistances of all cells, (RC,)."""
        log_cells = self._skin.prior.expected.copy()
        log_cells[self.cells] = -self.log_siemens
        return log_cells

    def explain(self) -> Touched | None:
        """Take the last steps, in which wires are uncertain by P, and return their answer.

        None: the readings reject these touches. Ports where wires matter (heavy) reject them by
        their chi-square. Each other port (light) rejects them if it draws less current than the
        model, because no further touch makes a port draw less. Light ports that draw more need no
        test: the strongest of them would have added its cell in `find`.
        """
        if not self.cells.size:
            return self._nothing_touched()
        # Where wires matter, S^-1 weighs the readings; elsewhere their noise does, which is cheap.
        heavy = self._moved_by_wires()
        ports, light = np.flatnonzero(heavy), ~heavy
        wires, drift_ohm = self._sharpen(ports)  # W
        factor = cholesky(gram(wires, onto=np.eye(ports.size, order="F")))  # of S
        # The network was solved with the mean wires that the prior is about. `offset` is how the
        # means that are believed now change these residuals, to first order.
        belief = self._skin.belief
        by_mean_std = wires[:, -len(belief.means) :]
        offset = belief.moved_since(self._skin.prior.means, by_mean_std)
        for _ in range(2):  # two steps are enough: `converge` has led near, without S
            slopes = self._slopes()
            residual = self._residual[ports] - offset
            heavy_slopes, light_slopes = slopes[:, ports], slopes[:, light]
            # With L L^T = S: J S^-1 J^T, and J S^-1 r.
            whitened = solve_lower(factor, heavy_slopes.T)
            system = light_slopes @ light_slopes.T + whitened.T @ whitened  # A, after `_stepped`
            pull = light_slopes @ self._residual[light] + solve_lower(factor, residual) @ whitened
            moved, is_last = self._stepped(system, pull)
            least = self._skin.least_log_siemens[self.cells]
            moved = np.minimum(np.maximum(moved, least), _MAX_LOG_SIEMENS)
            if is_last:  # what it leaves out is next to nothing: so no new network
                self._forecast(moved, slopes)
                break
            self._place(self.cells, moved)
        residual = self._residual[ports] - offset
        probable_noise = solve(factor, residual)
        if residual @ probable_noise > MAX_CHI2 * ports.size:
            return None
        if self._residual[light].min(initial=0.0) < -DEMAND_STDS:
            return None
        # The residual has the covariance S, of which the noise of the readings has 1. So S^-1 times
        # the residual is the most probable noise. The remainder comes from wires that differ from
        # what is believed, and belongs to the model. `offset` belongs to it as well, and is not yet
        # in `_current`.
        modelled = self._current.copy()
        modelled[ports] += (residual - probable_noise + offset) * self._std[ports]
        covariance_of_cells = solve(cholesky(system), np.eye(self.cells.size))  # A^-1
        # A mean that is one deviation off moves x by its column of A^-1 J S^-1 W.
        by_means = covariance_of_cells @ whitened.T @ solve_lower(factor, by_mean_std)

        def teach() -> Lesson:
            # For the lesson, touches are noise of nearly any size, because nobody knows how hard
            # they are. And leads differ by more if the mean lead is not known.
            by_ohm = (self._current[ports] ** 2 / self._std[ports])[:, None]
            odd_leads = belief.odd_lead_ohm() * by_ohm * belief.leads_of_ports[ports]
            own = wires[:, : -len(belief.means)]
            # Cells that drift move several ports alike: so here, s^2 is taken apart again.
            noise = np.hstack([UNLIMITED_STD * heavy_slopes.T, odd_leads, own, by_ohm * drift_ohm])
            of_readings = (self._reading_std[ports] / self._std[ports]) ** 2
            unlimited = cholesky(gram(noise, onto=np.diag(of_readings)))
            return Lesson(by_mean_std, residual, unlimited)

        return self._answer(covariance_of_cells, np.abs(by_means), modelled, teach)

    def _nothing_touched(self) -> Touched | None:
        """The answer if no cell is touched; None if a port draws less than in an untouched skin."""
        if self._residual.min() < -DEMAND_STDS:
            return None
        none = np.zeros((0, len(self._skin.belief.means)))
        nothing = Lesson(none, np.zeros(0), np.zeros((0, 0)))
        return self._answer(np.zeros((0, 0)), none, self._current, lambda: nothing)

    def _answer(
        self, covariance: Float, by_means: Float, modelled: Float, teach: Callable[[], Lesson]
    ) -> Touched:
        """The answer, in which cells at rest have the deviation of their prior.

        covariance: of x, (k, k).
        by_means: how far a mean that is one deviation off moves x, (k, number of means).
        """
        prior, cells = self._skin.prior, self.cells
        std, of_means = prior.std.copy(), np.zeros((modelled.size, 3))
        std[cells] = np.sqrt(covariance.diagonal())
        of_means[cells] = by_means[:, :3]
        parts = without_means(std, of_means, self._skin.belief)
        return Touched(cells, self.log_cells, std, *parts, modelled, self.steps, teach)

    def _moved_by_wires(self) -> NDArray[np.bool_]:
        """At which ports wires may move the reading by more than `HEAVY_SHARE` of its noise, (RC,).

        An error of path_ohm changes the current by I^2 times the error. At rest it changes nothing,
        because the fit of the rest readings has put the error into the cells at rest. So only what
        I^2 is above its value at rest counts. Wires always matter at the ports of touched cells.
        """
        skin = self._skin
        move = (self._current**2 - skin.current**2) * skin.path_std_ohm
        heavy: NDArray[np.bool_] = move > HEAVY_SHARE * self._std
        heavy[self.cells] = True
        return heavy

    def _sharpen(self, ports: Cells) -> tuple[Float, Float]:
        """Make s anew at m ports. Returns W at these, and what cells that drift move rho by.

        There, s has the noise of the readings and the drift of cells at rest as the
        touched network shows it. It no longer has the wires, because these are in S.
        """
        skin, square = self._skin, self._current[ports] ** 2
        by_cell, by_wire = self._touched.slopes(ports, skin.prior, skin.belief)
        by_cell *= skin.prior.std
        model_variance = square * square * np.einsum("ij,ij->i", by_cell, by_cell)
        self._untouched_std[ports] = np.sqrt(self._reading_std[ports] ** 2 + model_variance)
        self._compare()
        by_wire *= -(square / self._std[ports])[:, None]
        return by_wire, by_cell
