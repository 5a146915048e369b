# SPDX-License-Identifier: Apache-2.0
"""The built firmware as a device of the host, in lock-step: its time passes while somebody waits.

A program runs as with ``simavr://``, but every run is the same, however busy the machine is.
"""

from collections import deque
from collections.abc import Callable, Mapping
from typing import cast

from desk import show
from lockstep import LockstepSim, elf_of
from ohmskin.circuit.skin import Skin
from ohmskin.emulate.driver import SteppedLink, SteppedSkin

BOOT_S = 0.3


class LockstepLink:
    """A simulated Uno at the end of a line whose bytes come later to the host by `delay_s`.

    skin: the one that the board reads at a time [s], asked for every `step_s`, by which the host
    is late at most. settings: those of the simulator.
    """

    resets_board = False

    def __init__(
        self,
        skin: Callable[[float], Skin],
        *,
        delay_s: float = 0.0,
        step_s: float = 250e-6,
        settings: Mapping[str, float] = {},
    ) -> None:
        self.name = "uno in lock-step"
        self.sim = LockstepSim("uno", elf_of("uno"))
        self.sim.set(**settings)
        self._skin, self.delay_s, self._step_s = skin, delay_s, step_s
        self._shown: Skin | None = None
        self._coming: deque[tuple[float, bytes]] = deque()  # when [s], what
        self._steps = 0
        self.sim.run(BOOT_S)

    def now_s(self) -> float:
        """The time since the board has booted [s]."""
        return self._steps * self._step_s

    def read(self, limit_s: float = 0.2) -> bytes:
        """See `Link.read`."""
        end = self._steps + max(round(limit_s / self._step_s), 1)
        while self._steps < end:
            skin = self._skin(self.now_s())
            if skin is not self._shown:
                show(self.sim, skin)
                self._shown = skin
            octets = self.sim.run(self._step_s)
            self._steps += 1
            if octets:
                self._coming.append((self.now_s() + self.delay_s, octets))
            if self._coming and self._coming[0][0] <= self.now_s():
                return self._coming.popleft()[1]
        return b""

    def write(self, octets: bytes) -> None:
        """See `Link.write`."""
        self.sim.write(octets)

    def set_baud(self, baud: int) -> None:
        """See `Link.set_baud`: this end of the line follows the board."""

    def close(self) -> None:
        """See `Link.close`."""
        self.sim.close()


def lockstep_skin(link: LockstepLink) -> SteppedSkin:
    """What `ohmskin.open` would give for such a board; it does not scan yet."""
    return SteppedSkin(cast(SteppedLink, link))
