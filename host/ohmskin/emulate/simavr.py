# SPDX-License-Identifier: Apache-2.0
"""The built firmware in an AVR simulator, in real time, as a `Link`: ``simavr://uno?scene=ghost``.

The simulator `skinsim` (firmware/sim) is a separate program, which `SkinSim` starts and talks to
over two pipes. It runs the firmware unchanged, with a skin at its pins.

firmware/sim/README.md lists what is not modelled. Above all these are noise, the ADC's own errors
and its sample-and-hold capacitor, crystal tolerance, and everything on the USB side of the UART.
"""

import os
import struct
import subprocess
import tempfile
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from ohmskin.emulate.scenes import Scene
from ohmskin.errors import DeviceLost, PortError
from ohmskin.files import Closing
from ohmskin.link.serial_port import SerialLink

BOARDS: Final = ("uno", "megaatmega2560")
# The simulator's table of readings has this shape; a cell without current reads like this.
_TABLE_SHAPE: Final = (16, 16, 4)
_NO_CURRENT: Final = (1.0, 0.0, 1.0, 0.0)
# Requests and replies begin with an operation (u8) and the length of what follows (u32).
_HEADER: Final = struct.Struct("<BI")
# A simulator whose pipes are closed ends at once; after this time it is killed [s].
_EXIT_TIMEOUT_S: Final = 2.0
# The skin's readings follow a moving scene in steps of this time [s].
_TABLE_EVERY_S: Final = 0.02
_REPOSITORY: Final = Path(__file__).resolve().parents[3]


class SimulationError(RuntimeError):
    """The simulator refused a request, its processor crashed, or the program is gone."""


def default_program() -> Path:
    """Path of `skinsim` in this repository; it need not exist."""
    return _REPOSITORY / "firmware" / "sim" / "build" / "skinsim"


class SkinSim(Closing):
    """A board with a skin, simulated cycle by cycle.

    board: one of `BOARDS`. elf: the firmware. pty: run in real time, from `power_on` on, with the
    UART on the pseudo-terminal `pty_path`; else time passes only in requests that run the board.

    Raises FileNotFoundError if the simulator or the firmware is not built, SimulationError if the
    simulator does not start. Not thread-safe.
    """

    def __init__(self, board: str, elf: str | os.PathLike[str], *, pty: bool = False) -> None:
        program = default_program()
        if not program.exists():
            raise FileNotFoundError(f"{program} is missing: run 'make -C firmware/sim'")
        if not Path(elf).is_file():
            raise FileNotFoundError(f"no firmware at {elf}: run 'make firmware' in a checkout")
        command = [str(program), "--board", board, *(["--pty"] if pty else []), os.fspath(elf)]
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 (close() closes it)
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=self._stderr)
        try:
            # Either answer shows that the simulator has started.
            self.pty_path = self._receive("P").decode() if pty else ""
            if not pty:
                self.request("S")
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the simulator. Further calls raise SimulationError. May be called again."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with suppress(BrokenPipeError):
                    pipe.close()
        try:
            self._process.wait(_EXIT_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._stderr.close()

    def power_on(self) -> None:
        """Let a board with a pseudo-terminal run; its port should be open by then."""
        self.request("G")

    def set_table(self, ratio: ArrayLike) -> None:
        """Set sense voltage / Vdd, shape (rows, columns, 4), up to 16 rows and columns.

        The last axis is configuration A, B, C, D. Cells beyond the array carry no current: 1, 0,
        1, 0. A conversion gives the code min(1023, floor(1024 ratio)). With a settling time the
        nodes head for the new values from this cycle on. Raises ValueError for a bad shape or a
        ratio that is not finite.
        """
        given = np.asarray(ratio, dtype=np.float64)
        if given.ndim != 3 or given.shape[2] != 4 or max(given.shape[:2]) > 16:
            raise ValueError(
                f"ratio has shape {given.shape}: must be (rows, columns, 4), at most (16, 16, 4)"
            )
        if not np.isfinite(given).all():
            raise ValueError("ratio has values that are not finite")
        table = np.empty(_TABLE_SHAPE, dtype="<f8")
        table[:] = _NO_CURRENT
        table[: given.shape[0], : given.shape[1]] = given
        self.request("T", table.tobytes())

    def set_tau_us(self, tau_us: float) -> None:
        """Time constant [us] with which a node settles after a change of pins; 0 is at once.

        Raises ValueError unless 0 to 1e9.
        """
        if not 0 <= tau_us <= 1e9:
            raise ValueError(f"tau_us is {tau_us}: must be from 0 to 1e9")
        self.request("U", struct.pack("<d", tau_us))

    def request(self, op: str, payload: bytes = b"") -> bytes:
        """The reply to an operation of firmware/sim/README.md.

        Raises SimulationError if it is refused or the simulator is gone.
        """
        pipe = self._process.stdin
        if pipe is None or pipe.closed:
            raise SimulationError("the simulator is closed")
        try:
            pipe.write(_HEADER.pack(ord(op), len(payload)) + payload)
            pipe.flush()
        except BrokenPipeError:
            raise self._death() from None
        return self._receive(op)

    def _receive(self, op: str) -> bytes:
        reply_op, length = _HEADER.unpack(self._read(_HEADER.size))
        payload = self._read(length)
        if chr(reply_op) == "!":
            raise SimulationError(payload.decode(errors="replace"))
        if chr(reply_op) != op:
            raise SimulationError(f"skinsim answered {chr(reply_op)!r} to {op!r}: rebuild it")
        return payload

    def _read(self, count: int) -> bytes:
        pipe = self._process.stdout
        assert pipe is not None
        octets = pipe.read(count)
        if len(octets) < count:
            raise self._death()
        return octets

    def _death(self) -> SimulationError:
        try:
            code = self._process.wait(_EXIT_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            code = None
        self._stderr.seek(0)
        said = self._stderr.read().decode(errors="replace").strip()
        return SimulationError(f"skinsim ended with code {code}: {said[-2000:] or 'no message'}")


class SimavrLink(SerialLink):
    """A simulated board's pseudo-terminal, and the skin that it reads.

    board: one of `BOARDS`. elf: the firmware, by default the one that `make firmware` builds.
    tau_us: time constant of the skin's wiring [us].

    :raises PortError: there is no such board, or firmware or simulator are not built.
    """

    def __init__(
        self, board: str, scene: Scene, elf: Path | None = None, tau_us: float = 0.0, name: str = ""
    ) -> None:
        if board not in BOARDS:
            raise PortError(f"no simulated board '{board}': there are {', '.join(BOARDS)}")
        elf = elf or _REPOSITORY / ".pio" / "build" / board / "firmware.elf"
        with ExitStack() as opened:
            try:
                self.sim = opened.enter_context(SkinSim(board, elf, pty=True))
                self.sim.set_tau_us(tau_us)
                self.sim.set_table(scene.ratio(0.0))
                super().__init__(self.sim.pty_path)
                self.sim.power_on()  # the port is open: nothing that the board says is lost
            except (FileNotFoundError, SimulationError) as exc:
                raise PortError(str(exc)) from exc
            opened.pop_all()
        self._scene = scene
        self._begin_s = time.monotonic()
        self._table_due_s = 0.0 if scene.moves else float("inf")
        self.name = name or f"simavr://{board}"

    def read(self) -> bytes:
        """See `Link.read`; also moves what touches the skin."""
        elapsed_s = time.monotonic() - self._begin_s
        if elapsed_s >= self._table_due_s:
            self._table_due_s = elapsed_s + _TABLE_EVERY_S
            try:
                self.sim.set_table(self._scene.ratio(elapsed_s))
            except SimulationError as exc:
                raise DeviceLost(f"{self.name} has ended: {exc}") from exc
        return super().read()

    def close(self) -> None:
        """See `Link.close`."""
        super().close()
        self.sim.close()
