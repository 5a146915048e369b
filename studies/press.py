# SPDX-License-Identifier: Apache-2.0
"""How the conductance of a pressed cell follows the force on it: a simulation of textile contact.

Symbols

====== ============= =========================================================== ====
symbol shape         meaning                                                     unit
====== ============= =========================================================== ====
t      (n,)          `time_s`, rising                                            s
F      (n, R, C)     `force_n`, straight between the times, constant before      N
y      (n, R, C)     what F has crept to                                         N
e      (n, R, C)     force that would press the layers as deep, had they crept   N
p      (n, R, C)     e, with the memory of unloading                             N
w      (n, R, C)     log of the contact noise                                    1
G      (n, R, C)     rise of the cell's conductance above rest                   S
====== ============= =========================================================== ====

    creep       e = (F + a y) / (1 + a),  T dy/dt = F - y            standard linear solid [Findley]
    hysteresis  p = max(e, min(u(e), p before)),  u(e) = e + h e / (e + h)   generalised play [BS]
    contact     c = k p^b exp(w),  G = c / (1 + c / full)      contact grows until all is in contact
    noise       w = n(t) + d(t), two Ornstein-Uhlenbeck processes: n fast (contacts come and go),
                d slow (a press repeated does not give the same)

u(e) is the unloading branch. It lies h above the loading branch at a large force and meets it at no
force. k and b differ between cells, log-normally. docs/force.md says where the defaults are from.
Not modelled: a force below which the layers do not touch, and pressure that spreads to neighbours.

[BS] Brokate and Sprekels, "Hysteresis and Phase Transitions", 1996, section 2.4.
[Findley] Findley, Lai and Onaran, "Creep and Relaxation of Nonlinear Viscoelastic Materials", 1976.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ohmskin.arrays import Float

PAUSE_S: Final = (0.3, 0.9)  # before a press of the robot, least and most. Chosen.
RAMP_S: Final = 1.0  # its rise, and its fall. Chosen: slow against the creep.
HOLD_S: Final = 0.3  # how long it holds. Chosen.
LEAVE_S: Final = 2.5  # after its last press: by then a cell's creep has faded to nanosiemens


@dataclass(frozen=True)
class PressModel:
    """The cells of one skin under force, by the equations of the module.

    siemens_at_1n: k [S/N^b], above 0.
    exponent: b, above 0.
    full_contact_siemens: full [S], above 0.
    play_n: h [N].
    creep: a.
    creep_time_s: T, above 0.
    noise, drift: standard deviations of n and d.
    noise_time_s, drift_time_s: their time constants, above 0.
    gain_spread, exponent_spread: standard deviations of ln k and ln b between cells.
    seed: of the cells and of the noise.
    """

    siemens_at_1n: float = 30e-6
    exponent: float = 1.7
    full_contact_siemens: float = 4e-3
    play_n: float = 0.06
    creep: float = 0.09
    creep_time_s: float = 0.6
    noise: float = 0.24
    noise_time_s: float = 0.14
    drift: float = 0.12
    drift_time_s: float = 60.0
    gain_spread: float = 0.2
    exponent_spread: float = 0.03
    seed: int = 0

    def rise(self, time_s: Float, force_n: Float) -> Float:
        """Conductance above rest G [S] over a history of forces [N], both (n,) or (n, R, C).

        time_s (n,) rises, and no force is below 0. The first force has always been there. The same
        arguments give the same answer.
        """
        cells = force_n.reshape(len(time_s), -1)
        random = np.random.default_rng(self.seed)
        log_gain = self.gain_spread * random.standard_normal(cells.shape[1])
        log_exponent = self.exponent_spread * random.standard_normal(cells.shape[1])
        gain, exponent = self.siemens_at_1n * np.exp(log_gain), self.exponent * np.exp(log_exponent)
        log_noise = self.noise * wander(time_s, cells.shape[1], self.noise_time_s, random)
        log_noise += self.drift * wander(time_s, cells.shape[1], self.drift_time_s, random)
        contact = gain * self._pressing(time_s, cells) ** exponent * np.exp(log_noise)
        rise = contact / (1 + contact / self.full_contact_siemens)
        return np.asarray(rise).reshape(force_n.shape)

    def _pressing(self, times: Float, forces: Float) -> Float:
        """p of the module's table [N], (n, cells)."""
        steps = np.diff(times) / self.creep_time_s
        stays = np.exp(-steps)
        # Exact where forces are straight between the times.
        follows = (1 + np.expm1(-steps) / steps)[:, None] * np.diff(forces, axis=0)
        pressing = np.empty_like(forces)
        pressing[0] = crept = forces[0]
        for i, (stay, follow) in enumerate(zip(stays, follows, strict=True), start=1):
            crept = stay * crept + (1 - stay) * forces[i - 1] + follow
            depth = (forces[i] + self.creep * crept) / (1 + self.creep)
            width = depth + self.play_n
            unloading = depth + self.play_n * depth / np.where(width > 0, width, 1.0)
            pressing[i] = np.maximum(depth, np.minimum(unloading, pressing[i - 1]))
        return pressing


def robot_presses(
    peaks_n: Sequence[float], random: np.random.Generator, start_s: float
) -> tuple[Float, Float]:
    """A robot's presses of one cell: times [s] and forces [N], straight in between, each (4 m,).

    Each press rises in 1 s, holds 0.3 s and leaves in 1 s, after a pause of 0.3 to 0.9 s.
    """
    times_s, forces_n = [], []
    now_s = start_s
    for peak_n in peaks_n:
        now_s += random.uniform(*PAUSE_S)
        times_s += [now_s, now_s + RAMP_S, now_s + RAMP_S + HOLD_S, now_s + 2 * RAMP_S + HOLD_S]
        forces_n += [0.0, peak_n, peak_n, 0.0]
        now_s = times_s[-1]
    return np.array(times_s), np.array(forces_n)


def wander(times: Float, cells: int, time_constant_s: float, random: np.random.Generator) -> Float:
    """Ornstein-Uhlenbeck processes of unit variance, (n, cells), exact for any steps of time."""
    values = random.standard_normal((len(times), cells))
    stays = np.exp(-np.diff(times) / time_constant_s)
    fresh = np.sqrt(1 - stays**2)
    for i, (stay, new) in enumerate(zip(stays, fresh, strict=True), start=1):
        values[i] = stay * values[i - 1] + new * values[i]
    return values
