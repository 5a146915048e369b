# SPDX-License-Identifier: Apache-2.0
"""Drive the AVR simulator `skinsim` (firmware/sim): the built firmware, unchanged, on a skin.

`skinsim` is a separate program; this module starts it and talks to it over two pipes. Nothing
happens in the simulated board between calls, so results do not depend on this machine's speed.
With `pty=True` the board runs by itself in real time, its UART on a pseudo-terminal.

What is not modelled is listed in firmware/sim/README.md; above all: noise, the ADC's own errors
and sample-and-hold capacitor, crystal tolerance, and everything on the USB side of the UART.
"""

from __future__ import annotations

import json
import os
import struct
import subprocess
import tempfile
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ohmskin.files import Closing

CPU_HZ: Final = 16_000_000
TABLE_ROWS: Final = 16
TABLE_COLUMNS: Final = 16
TABLE_CONFIGURATIONS: Final = 4

#: Values of `configuration` in the hold log. A to D are the circuit's four configurations.
CONFIGURATION_NAMES: Final = ("A", "B", "C", "D", "no current", "undriven", "other channel")

#: One record of the hold log. `cycle`: CPU cycles since power-on at the instant of the hold.
#: `settle_cycles`: since row, column or drive pins last changed; 2**32 - 1: never, or longer ago.
HOLD_DTYPE: Final = np.dtype(
    [
        ("cycle", "<u8"),
        ("row", "u1"),
        ("column", "u1"),
        ("configuration", "u1"),
        ("channel", "u1"),
        ("code", "<u2"),
        ("settle_cycles", "<u4"),
    ]
)

_HEADER: Final = struct.Struct("<BI")
_NO_CURRENT: Final = (1.0, 0.0, 1.0, 0.0)
_MAX_WRITE_BYTES: Final = 1 << 20
_MAX_RUN_CYCLES: Final = CPU_HZ * 3600
_EXIT_TIMEOUT_S: Final = 2.0


class SimulationError(RuntimeError):
    """The simulator refused a request, its processor crashed, or the program is gone."""


def default_program() -> Path:
    """Path of `skinsim` in this repository; it need not exist."""
    return Path(__file__).resolve().parents[3] / "firmware" / "sim" / "build" / "skinsim"


class SkinSim(Closing):
    """A board with a skin, simulated cycle by cycle.

    `board`: "uno" or "megaatmega2560". `elf`: the firmware. `program`: path of `skinsim`, by
    default the one built in this repository. `pty`: run in real time with the UART on the
    pseudo-terminal `pty_path`; then `run`, `run_cycles` and `write` are refused.

    Raises FileNotFoundError if the program or the ELF is missing, SimulationError if the
    simulator does not start. Not thread-safe.
    """

    #: Device file of the UART with `pty=True`, else None.
    pty_path: str | None

    def __init__(
        self,
        board: str,
        elf: str | os.PathLike[str],
        *,
        program: str | os.PathLike[str] | None = None,
        pty: bool = False,
    ) -> None:
        executable = default_program() if program is None else Path(program)
        if not executable.exists():
            raise FileNotFoundError(f"{executable} is missing: run 'make -C firmware/sim'")
        if not Path(elf).exists():
            raise FileNotFoundError(f"no firmware {os.fspath(elf)}: build it first")
        command = [str(executable), "--board", board, *(["--pty"] if pty else []), os.fspath(elf)]
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 (close() closes it)
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            bufsize=0,
        )
        self.pty_path = None
        try:
            if pty:
                self.pty_path = self._receive("P").decode()
            else:
                self.run_cycles(0)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the simulator. Further calls raise SimulationError. May be called again."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        try:
            self._process.wait(_EXIT_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._stderr.close()

    def run_cycles(self, cycles: int) -> bytes:
        """Run for `cycles` CPU cycles (16 MHz), to the end of the instruction that reaches them.

        Returns what the device has sent since the last call. 0 only collects that, even after a
        crash. Raises SimulationError if the processor crashes or sleeps for ever; ValueError for
        a negative number or more than an hour.
        """
        if not 0 <= cycles <= _MAX_RUN_CYCLES:
            raise ValueError(f"cycles is {cycles}: must be from 0 to {_MAX_RUN_CYCLES}")
        return self._request("R", struct.pack("<Q", cycles))

    def run(self, seconds: float) -> bytes:
        """Run for `seconds` of simulated time; else as `run_cycles`."""
        return self.run_cycles(round(seconds * CPU_HZ))

    def write(self, uart_bytes: bytes) -> None:
        """Queue bytes on the line to the device; they arrive one after the other at line speed.

        Raises SimulationError when more than 16 MiB wait.
        """
        for start in range(0, len(uart_bytes), _MAX_WRITE_BYTES):
            self._request("W", uart_bytes[start : start + _MAX_WRITE_BYTES])

    def set_baud(self, baud: int) -> None:
        """Baud of the host's end of the line; 0 (at the start) follows the device.

        Bytes between ends that differ by more than 4 % arrive as other bytes, at the device with
        FE0 set. Raises ValueError unless 0 or 50 to 2,000,000.
        """
        if baud != 0 and not 50 <= baud <= 2_000_000:
            raise ValueError(f"baud is {baud}: must be 0 or from 50 to 2000000")
        self._request("B", struct.pack("<I", baud))

    def set_table(self, ratio: npt.ArrayLike) -> None:
        """Set sense voltage / Vdd, shape (rows, columns, 4), up to 16 rows and columns.

        The last axis is configuration A, B, C, D. Cells beyond the array carry no current: 1, 0,
        1, 0. A conversion gives the code min(1023, floor(1024 ratio)). With a settling time the
        nodes head for the new values from this cycle on. Raises ValueError for a bad shape or a
        ratio that is not finite.
        """
        given = np.asarray(ratio, dtype=np.float64)
        if given.ndim != 3 or given.shape[2] != TABLE_CONFIGURATIONS:
            raise ValueError(f"ratio has shape {given.shape}: must be (rows, columns, 4)")
        if given.shape[0] > TABLE_ROWS or given.shape[1] > TABLE_COLUMNS:
            raise ValueError(f"ratio has shape {given.shape}: at most 16 rows and 16 columns")
        if not np.isfinite(given).all():
            raise ValueError("ratio has values that are not finite")
        table = np.empty((TABLE_ROWS, TABLE_COLUMNS, TABLE_CONFIGURATIONS), dtype="<f8")
        table[:] = _NO_CURRENT
        table[: given.shape[0], : given.shape[1]] = given
        self._request("T", table.tobytes())

    def set_tau_us(self, tau_us: float) -> None:
        """Time constant [us] with which a node settles after a change of pins; 0 is at once.

        Raises ValueError unless 0 to 1e9.
        """
        if not 0 <= tau_us <= 1e9:
            raise ValueError(f"tau_us is {tau_us}: must be from 0 to 1e9")
        self._request("U", struct.pack("<d", tau_us))

    def stats(self) -> dict[str, Any]:
        """Counters since the start or `reset_stats`; firmware/sim/README.md lists them.

        Works after a crash: `state` is "running", "crashed" or "done" (asleep for ever).
        """
        counters: dict[str, Any] = json.loads(self._request("S"))
        return counters

    def reset_stats(self) -> None:
        """Restart all counters but `cycles`, `simulated_s` and `resets`."""
        self._request("Z")

    def hold_log(self, enable: bool) -> None:
        """Log every hold of the ADC from now on, or stop. Records kept so far stay."""
        self._request("L", b"\x01" if enable else b"\x00")

    def drain_hold_log(self) -> npt.NDArray[np.void]:
        """Take the logged holds: array of `HOLD_DTYPE`, oldest first.

        At most 2**20 are kept; `stats()["hold_log_dropped"]` counts the rest.
        """
        return np.frombuffer(self._request("L", b"\x02"), dtype=HOLD_DTYPE)

    def eeprom(self) -> bytes:
        """The whole EEPROM, 1024 bytes (uno) or 4096 (megaatmega2560)."""
        return self._request("E")

    def write_eeprom(self, content: bytes, offset: int = 0) -> None:
        """Put `content` into the EEPROM at `offset` [bytes], at once.

        Raises ValueError for a negative offset, SimulationError if it does not fit.
        """
        if not 0 <= offset <= 0xFFFF:
            raise ValueError(f"offset is {offset}: must be from 0 to 65535")
        self._request("e", struct.pack("<H", offset) + content)

    def reset(self) -> None:
        """Pull the reset pin, as a USB bridge does when a port opens: sets EXTRF in MCUSR."""
        self._request("X")

    def jump(self, address: int) -> None:
        """Go on at this byte address of the flash, as if a fault had changed the program counter.

        Raises ValueError for a negative or odd address, SimulationError beyond the flash.
        """
        if address < 0 or address % 2:
            raise ValueError(f"address is {address}: must be even and not negative")
        self._request("J", struct.pack("<I", address))

    def _request(self, op: str, payload: bytes = b"") -> bytes:
        pipe = self._process.stdin
        if pipe is None or pipe.closed:
            raise SimulationError("the simulator is closed")
        unsent = memoryview(_HEADER.pack(ord(op), len(payload)) + payload)
        try:
            while unsent:
                unsent = unsent[pipe.write(unsent) or 0 :]
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
        received = bytearray()
        while len(received) < count:
            chunk = pipe.read(count - len(received))
            if not chunk:
                raise self._death()
            received += chunk
        return bytes(received)

    def _death(self) -> SimulationError:
        try:
            code = self._process.wait(_EXIT_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            code = None
        self._stderr.seek(0)
        said = self._stderr.read().decode(errors="replace").strip()
        return SimulationError(f"skinsim ended with code {code}: {said[-2000:] or 'no message'}")
