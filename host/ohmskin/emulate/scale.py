# SPDX-License-Identifier: Apache-2.0
"""A scale under an emulated skin, sans-IO: what it prints, as laboratory scales do.

    US,GS,+  123.4 g

US: the number changes; ST: it is stable. The scale shows the force after a filter of one pole, with
noise, to a tenth of a gram. Not modelled: drift, a zero that is not that of the empty skin, the end
of its range.
"""

import math
from collections.abc import Callable
from typing import Final

import numpy as np

# Standard gravity [N/g] (CGPM, 1901).
_NEWTONS_A_GRAM: Final = 0.00980665
# The options of an emulator:// URL: numbers a second [Hz], time constant of the filter [s],
# standard deviation of a number [g]. Chosen: those of a usual laboratory scale, or of an HX711 at
# its slower rate.
DEFAULTS: Final = {"scale_rate": 10.0, "scale_lag": 0.1, "scale_noise": 1.0}
SCALE_OPTIONS: Final = {
    "scale_rate": f"numbers a second, {DEFAULTS['scale_rate']:g} unless told",
    "scale_lag": f"time constant of its filter in s, {DEFAULTS['scale_lag']:g} unless told",
    "scale_noise": f"noise of a number in g, {DEFAULTS['scale_noise']:g} unless told",
}
# The filter samples the force so often for each number. Chosen: a touch lasts for many samples.
_STEPS: Final = 8
# A number is stable if it differs by less from the one before [g]. Chosen: as of scales that show
# 0.1 g.
_STABLE_G: Final = 1.0


class EmulatedScale:
    """Prints the force under a skin, `force_n(seconds since it was switched on)` [N].

    next_s: when it prints again [s].

    :raises ValueError: no scale does that.
    """

    def __init__(
        self,
        force_n: Callable[[float], float],
        rate_hz: float = DEFAULTS["scale_rate"],
        lag_s: float = DEFAULTS["scale_lag"],
        noise_g: float = DEFAULTS["scale_noise"],
        seed: int = 0,
    ) -> None:
        if not (0.1 <= rate_hz <= 1000 and 0 <= lag_s <= 10 and 0 <= noise_g <= 1e6):
            raise ValueError(
                "a scale prints 0.1 to 1000 numbers a second, its lag is 0 to 10 s, and its noise "
                "0 to 1000000 g"
            )
        self._force_n, self._noise_g = force_n, noise_g
        self._step_s = 1.0 / (rate_hz * _STEPS)
        self._keep = math.exp(-self._step_s / lag_s) if lag_s else 0.0
        self._random = np.random.default_rng([seed, 5])
        self._steps, self._slow_g, self._shown_g = 0, 0.0, 0.0

    @property
    def next_s(self) -> float:
        """When it prints again [s]."""
        return (self._steps // _STEPS + 1) * _STEPS * self._step_s

    def heard(self, until_s: float) -> bytes:
        """What it has printed since the last call, until `until_s`."""
        lines = []
        while self._step_s * (self._steps + 1) <= until_s:
            self._steps += 1
            now_g = self._force_n(self._steps * self._step_s) / _NEWTONS_A_GRAM
            self._slow_g = self._keep * self._slow_g + (1 - self._keep) * now_g
            if self._steps % _STEPS == 0:
                shown_g = self._slow_g + self._noise_g * self._random.standard_normal()
                state = "ST" if abs(shown_g - self._shown_g) < _STABLE_G else "US"
                sign = "-" if shown_g < 0 else "+"
                lines.append(f"{state},GS,{sign}{abs(shown_g):7.1f} g\r\n".encode())
                self._shown_g = shown_g
        return b"".join(lines)
