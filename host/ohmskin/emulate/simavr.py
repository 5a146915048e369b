# SPDX-License-Identifier: Apache-2.0
"""The built firmware in an AVR simulator, in real time, as a `Link`: ``simavr://uno?scene=ghost``.

The simulator `skinsim` is a separate program, which `SkinSim` starts and talks to over two pipes.
firmware/sim/README.md lists settings, and what is not modelled: above all crystal tolerance, and
everything on the USB side of the UART.
"""

import struct
import subprocess
import tempfile
import time
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.skin import all_readings, end_admittance
from ohmskin.emulate.scenes import Scene
from ohmskin.errors import DeviceLost, PortError
from ohmskin.files import Closing
from ohmskin.link.serial_port import SerialLink

BOARDS: Final = ("uno", "megaatmega2560")
_REPOSITORY: Final = Path(__file__).resolve().parents[3]
# The simulator, in a checkout; it need not exist.
PROGRAM: Final = _REPOSITORY / "firmware" / "sim" / "build" / "skinsim"
# Requests and replies begin with an operation (u8) and the length of what follows (u32):
# firmware/sim/README.md.
_HEADER: Final = struct.Struct("<BI")
# Added to the number of rows in the request "C", this says that far ends are in its matrix, too
# (HAS_FAR of firmware/sim/control.c).
_FAR_ENDS: Final = 0x80
# A simulator whose pipes are closed ends at once. One that has not after this time [s] hangs, and
# is killed. Chosen: long even for a machine that is busy.
_EXIT_TIMEOUT_S: Final = 2.0
# While touches move, the simulator is told a new skin every so often [s]. Chosen: a scan at 90 Hz
# takes 11 ms, and solving a skin of 16x16 some milliseconds.
_TABLE_EVERY_S: Final = 0.02


class SimulationError(RuntimeError):
    """The simulator refused a request, its processor crashed, or the program is gone."""


class SkinSim(Closing):
    """A board with a skin, simulated cycle by cycle.

    board: one of `BOARDS`. elf: the firmware. bootloader: an Intel hex file of the boot section, or
    "board" for the one the board is sold with. pty: run in real time, from the request "G" on, with
    the UART on the pseudo-terminal `pty_path`; else time passes only in requests that run the
    board.

    Raises FileNotFoundError if the simulator or the firmware is not built, SimulationError if the
    simulator does not start. Not thread-safe.
    """

    def __init__(self, board: str, elf: Path, *, pty: bool = False, bootloader: str = "") -> None:
        for path, made_by in ((PROGRAM, "make sim"), (elf, "make firmware")):
            if not path.is_file():
                raise FileNotFoundError(f"{path} is missing: run '{made_by}' in a checkout")
        options = pty * ["--pty"] + bool(bootloader) * ["--bootloader", bootloader]
        command = [str(PROGRAM), "--board", board, *options, str(elf)]
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 (close() closes it)
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=self._stderr)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._requests, self._replies = self._process.stdin, self._process.stdout
        try:
            # Either answer, a path or nothing, shows that the simulator has started.
            self.pty_path = (self._reply("P") if pty else self.request("Z")).decode()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the simulator. Further calls raise SimulationError. May be called again."""
        for pipe in (self._requests, self._replies):
            with suppress(BrokenPipeError):
                pipe.close()
        try:
            self._process.wait(_EXIT_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._stderr.close()

    def set_table(self, ratio: Float) -> None:
        """Set readings a to h, or a to d alone, (rows, columns, n), of up to 16 rows and columns.

        Cells beyond the array carry no current: 1, 0, 1, 0. An ideal conversion gives the code
        min(1023, floor(1024 ratio)). Raises SimulationError for a ratio that is not finite.
        """
        rows, columns, readings = ratio.shape
        table = np.tile([1.0, 0.0], (16, 16, 4))
        table[:rows, :columns, :readings] = ratio
        self.request("T", table.tobytes())

    def set(self, **settings: float | str) -> None:
        """Change settings of the simulator: firmware/sim/README.md lists them.

        Raises SimulationError for one that is not there, or out of its range.
        """
        for name, value in settings.items():
            self.request("O", f"{name}={value}".encode())

    def request(self, op: str, payload: bytes = b"") -> bytes:
        """The reply to an operation of firmware/sim/README.md.

        Raises SimulationError if it is refused or the simulator is gone.
        """
        if self._requests.closed:
            raise SimulationError("the simulator is closed")
        try:
            self._requests.write(_HEADER.pack(ord(op), len(payload)) + payload)
            self._requests.flush()
        except BrokenPipeError:
            raise self._death() from None
        return self._reply(op)

    def _reply(self, op: str) -> bytes:
        reply_op, length = _HEADER.unpack(self._read(_HEADER.size))
        payload = self._read(length)
        if chr(reply_op) == "!":
            raise SimulationError(payload.decode(errors="replace"))
        if chr(reply_op) != op:
            raise SimulationError(f"skinsim answered {chr(reply_op)!r} to {op!r}: rebuild it")
        return payload

    def _read(self, count: int) -> bytes:
        octets = self._replies.read(count)
        if len(octets) < count:
            raise self._death()
        return octets

    def _death(self) -> SimulationError:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_EXIT_TIMEOUT_S)
        self._stderr.seek(0)
        said = self._stderr.read().decode(errors="replace").strip()[-2000:] or "no message"
        return SimulationError(f"skinsim ended with code {self._process.returncode}: {said}")


class SimavrLink(SerialLink):
    """A simulated board's pseudo-terminal, and the skin that it reads.

    board: one of `BOARDS`, with the firmware that `make firmware` builds. settings: `bootloader` of
    `SkinSim` and those of its `set`; with `desk`, the board has its boot loader unless told.

    :raises PortError: there is no such board or setting, or firmware or simulator are not built.
    """

    def __init__(
        self, board: str, scene: Scene, name: str = "", settings: Mapping[str, str] = {}
    ) -> None:
        if board not in BOARDS:
            raise PortError(f"no simulated board '{board}': there are {', '.join(BOARDS)}")
        elf = _REPOSITORY / ".pio" / "build" / board / "firmware.elf"
        own = dict(settings)
        # A board on a desk has the boot loader that it is sold with.
        loader = own.pop("bootloader", "board" if "desk" in own else "")
        with ExitStack() as opened:
            try:
                self.sim = opened.enter_context(SkinSim(board, elf, pty=True, bootloader=loader))
                self.sim.set(**own)
                self._scene = scene
                self._show(0.0)
                super().__init__(self.sim.pty_path)
                self.resets_board = bool(loader)
                self.sim.request("G")  # the port is open: nothing that the board says is lost
            except (FileNotFoundError, SimulationError) as exc:
                raise PortError(str(exc)) from exc
            opened.pop_all()
        self.begin_s = time.monotonic()
        self._table_due_s = scene.begin_s
        self.name = name or f"simavr://{board}"

    def read(self) -> bytes:
        """See `Link.read`; also moves what touches the skin."""
        elapsed_s = time.monotonic() - self.begin_s
        if elapsed_s >= self._table_due_s:
            self._table_due_s = elapsed_s + _TABLE_EVERY_S if self._scene.moves else float("inf")
            try:
                self._show(elapsed_s)
            except SimulationError as exc:
                raise DeviceLost(f"{self.name} has ended: {exc}") from exc
        return super().read()

    def _show(self, time_s: float) -> None:
        skin = self._scene.skin(time_s)
        admittance = end_admittance(skin)
        self.sim.request("C", bytes([_FAR_ENDS + self._scene.rows]) + admittance.tobytes())
        self.sim.set_table(all_readings(skin, admittance))

    def close(self) -> None:
        """See `Link.close`."""
        super().close()
        self.sim.close()
