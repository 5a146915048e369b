# SPDX-License-Identifier: Apache-2.0
"""The built firmware in an AVR simulator, in real time, as a `Link`: ``simavr://uno?scene=ghost``."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Final

from ohmskin.emulate.scenes import Scene
from ohmskin.emulate.simavr import SimulationError, SkinSim
from ohmskin.errors import DeviceLost, PortError
from ohmskin.link.serial_port import SerialLink

BOARDS: Final = ("uno", "megaatmega2560")
_REPOSITORY: Final = Path(__file__).parents[3]
_TABLE_EVERY_S: Final = 0.02


class SimavrLink(SerialLink):
    """The simulator's pseudo-terminal, and the skin that the simulated board touches.

    `board`: one of `BOARDS`. `elf`: the firmware, by default the one `make firmware` builds.
    `tau_us`: time constant of the skin's wiring [us].

    :raises PortError: there is no such board, or firmware or simulator are not built.
    """

    def __init__(
        self, board: str, scene: Scene, elf: Path | None = None, tau_us: float = 0.0, name: str = ""
    ) -> None:
        if board not in BOARDS:
            raise PortError(f"no simulated board '{board}': there are {', '.join(BOARDS)}")
        elf = elf or _REPOSITORY / ".pio" / "build" / board / "firmware.elf"
        if not elf.is_file():
            raise PortError(f"no firmware at {elf}: run 'make firmware' in a checkout")
        try:
            self._sim = SkinSim(board, elf, pty=True)
        except (FileNotFoundError, SimulationError) as exc:
            raise PortError(str(exc)) from exc
        try:
            self._scene = scene
            self._begin_s = time.monotonic()
            self._table_due_s = float("inf") if not scene.moves else 0.0
            self._sim.set_tau_us(tau_us)
            self._sim.set_table(scene.ratio(0.0))
            assert self._sim.pty_path is not None
            super().__init__(self._sim.pty_path)
        except BaseException:
            self._sim.close()
            raise
        self.name = name or f"simavr://{board}"

    def read(self) -> bytes:
        """See `Link.read`; also moves what touches the skin."""
        elapsed_s = time.monotonic() - self._begin_s
        if elapsed_s >= self._table_due_s:
            self._table_due_s = elapsed_s + _TABLE_EVERY_S
            try:
                self._sim.set_table(self._scene.ratio(elapsed_s))
            except SimulationError as exc:
                raise DeviceLost(f"{self.name} has ended: {exc}") from exc
        return super().read()

    def close(self) -> None:
        """See `Link.close`."""
        super().close()
        self._sim.close()
