# SPDX-License-Identifier: Apache-2.0
"""The built firmware in an AVR simulator, in real time, as a `Link`: ``simavr://uno?scene=ghost``.

The simulator `skinsim` is a separate program, which `SkinSim` starts and talks to over two pipes.
firmware/sim/README.md lists settings, and what is not modelled: above all crystal tolerance, and
everything on the USB side of the UART.
"""

import json
import struct
import subprocess
import tempfile
import threading
import time
from collections import deque
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from ohmskin.arrays import Float
from ohmskin.circuit.skin import all_readings, end_admittance
from ohmskin.emulate.scenes import Scene
from ohmskin.errors import DeviceLost, PortError
from ohmskin.files import Closing, check_place, naming, read_bounded, whole_file
from ohmskin.link.serial_port import SerialLink

BOARDS: Final = ("uno", "megaatmega2560")
_REPOSITORY: Final = Path(__file__).resolve().parents[3]
# The simulator, in a checkout; it need not exist.
PROGRAM: Final = _REPOSITORY / "firmware" / "sim" / "build" / "skinsim"
# Where PlatformIO leaves the firmware of all boards.
_BUILT: Final = _REPOSITORY / ".pio" / "build"
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
# takes 11 ms, and solving a skin of 16x16 some milliseconds. The scene "slip" is too fast for that.
_TABLE_EVERY_S: Final = 0.02
# So many of these skins are remembered, for whoever asks what a scan has read. Chosen: 20 s of
# them, and no scan is as late.
_SHOWN_TABLES: Final = 1000


class SimulationError(RuntimeError):
    """The simulator refused a request, its processor crashed, or the program is gone."""


class SkinSim(Closing):
    """A board with a skin, simulated cycle by cycle.

    board: one of `BOARDS`. elf: the firmware. bootloader: an Intel hex file of the boot section, or
    "board" for the one the board is sold with. pty: run in real time, from the request "G" on, with
    the UART on the pseudo-terminal `pty_path`; else time passes only in requests that run the
    board. pins: a wiring unlike the board's own, as firmware/sim/README.md has it.

    Raises FileNotFoundError if the simulator or the firmware is not built, SimulationError if the
    simulator does not start. Requests may come from any thread, but after `close` none.
    """

    def __init__(
        self, board: str, elf: Path, *, pty: bool = False, bootloader: str = "", pins: str = ""
    ) -> None:
        for path, made_by in ((PROGRAM, "make sim"), (elf, "make firmware")):
            if not path.is_file():
                raise FileNotFoundError(f"{path} is missing: run '{made_by}' in a checkout")
        options = pty * ["--pty"] + bool(bootloader) * ["--bootloader", bootloader]
        options += bool(pins) * ["--pins", pins]
        command = [str(PROGRAM), "--board", board, *options, str(elf)]
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 (close() closes it)
        # Ctrl-C, which a terminal sends to its whole session, is for this program alone. The
        # simulator ends when its pipes are closed, which also happens when this program is killed.
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=self._stderr, start_new_session=True
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._requests, self._replies = self._process.stdin, self._process.stdout
        self._lock = threading.Lock()
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
        return self.requests((op, payload))[0]

    def requests(self, *of: tuple[str, bytes]) -> list[bytes]:
        """As `request`, of several operations: hardly any time passes between them."""
        if self._requests.closed:
            raise SimulationError("the simulator is closed")
        with self._lock:
            try:
                for op, payload in of:
                    self._requests.write(_HEADER.pack(ord(op), len(payload)) + payload)
                self._requests.flush()
            except BrokenPipeError:
                raise self._death() from None
            replies, refusals = list[bytes](), list[SimulationError]()
            for op, _ in of:  # all are read before one raises: none is left for the next request
                try:
                    replies.append(self._reply(op))
                except SimulationError as exc:
                    refusals.append(exc)
            if refusals:
                raise refusals[0]
            return replies

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
    `eeprom`: a file that keeps the EEPROM from one link to the next; `close` writes it, whole.

    :raises PortError: there is no such board or setting, or firmware or simulator are not built.
    :raises ValueError: the EEPROM's file cannot be read or written, or is another board's.
    """

    def __init__(
        self, board: str, scene: Scene, name: str = "", settings: Mapping[str, str] = {}
    ) -> None:
        if board not in BOARDS:
            raise PortError(f"no simulated board '{board}': there are {', '.join(BOARDS)}")
        elf = _BUILT / board / "firmware.elf"
        own = dict(settings)
        # A board on a desk has the boot loader that it is sold with.
        loader = own.pop("bootloader", "board" if "desk" in own else "")
        self._eeprom = Path(own.pop("eeprom")) if "eeprom" in own else None
        with ExitStack() as opened:
            try:
                self.sim = opened.enter_context(SkinSim(board, elf, pty=True, bootloader=loader))
                self.sim.set(**own)
                self._load_eeprom()
                self._scene = scene
                # The board is wired as the firmware's ELF file says; the skin is, too.
                references = json.loads(self.sim.request("S")).get("ref_ohm")
                if references is None:
                    raise PortError(f"{elf} does not tell its wiring: run 'make firmware sim'")
                top, bottom = references
                scene.faults = replace(scene.faults, ref_top=top, ref_bottom=bottom)
                # Since when [s] the board has read the skin of which time of the scene [s].
                self._shown_s: deque[tuple[float, float]] = deque(maxlen=_SHOWN_TABLES)
                self._show(0.0)
                super().__init__(self.sim.pty_path)
                self.resets_board = bool(loader)
                self.sim.request("G")  # the port is open: nothing that the board says is lost
            except (FileNotFoundError, SimulationError) as exc:
                raise PortError(str(exc)) from exc
            opened.pop_all()
        self._look_due_s = time.monotonic() if scene.begin_s < float("inf") else float("inf")
        self.name = name or f"simavr://{board}"

    @property
    def now_s(self) -> float:
        """The board's time since it was switched on [s]: a busy machine makes it pass slower."""
        return _simulated_s(self.sim.request("S"))

    def scene_s(self, time_s: float) -> float:
        """The scene's time that the skin has at a time of the board [s]: it changes in steps."""
        shown = reversed(tuple(self._shown_s))  # the thread that reads may add to it meanwhile
        return next((scene_s for since_s, scene_s in shown if since_s <= time_s), 0.0)

    def read(self) -> bytes:
        """See `Link.read`; also moves what touches the skin."""
        if time.monotonic() >= self._look_due_s:
            self._look_due_s = time.monotonic() + _TABLE_EVERY_S
            try:
                now_s = self.now_s
                if now_s >= self._scene.begin_s:
                    self._show(now_s)
                    if not self._scene.moves:
                        self._look_due_s = float("inf")
            except SimulationError as exc:
                raise DeviceLost(f"{self.name} has ended: {exc}") from exc
        return super().read()

    def _show(self, scene_s: float) -> None:
        """Let the board read the skin of a time of the scene [s] from now on."""
        skin = self._scene.skin(scene_s)
        admittance = end_admittance(skin)
        currents = bytes([_FAR_ENDS + self._scene.rows]) + admittance.tobytes()
        table = table_of(all_readings(skin, admittance))
        *_, stats = self.sim.requests(("C", currents), ("T", table), ("S", b""))
        self._shown_s.append((_simulated_s(stats), scene_s))

    def _load_eeprom(self) -> None:
        path, size = self._eeprom, len(self.sim.request("E"))
        if path is None:
            return
        check_place(path)
        if path.exists():
            with naming(path):
                content = read_bounded(path, size)
                if len(content) != size:
                    raise ValueError(f"is no EEPROM of this board: it has not {size} bytes")
            self.sim.request("e", bytes(2) + content)

    def close(self) -> None:
        """See `Link.close`. Raises ValueError where the EEPROM's file cannot be written."""
        super().close()
        with self.sim, suppress(SimulationError):  # it is closed already, or gone
            content = self.sim.request("E")
            if self._eeprom is not None:
                with whole_file(self._eeprom) as file:
                    file.write(content)


def table_of(ratio: Float) -> bytes:
    """What the request "T" takes: readings a to h, or a to d alone, (rows, columns, n).

    There are up to 32 rows and columns. Cells beyond the array carry no current: 1, 0, 1, 0.
    """
    rows, columns, readings = ratio.shape
    lines = 16 if max(rows, columns) <= 16 else 32
    table = np.tile([1.0, 0.0], (lines, lines, 4))
    table[:rows, :columns, :readings] = ratio
    return table.tobytes()


def _simulated_s(stats: bytes) -> float:
    """The board's time since it was switched on [s], of the reply to "S"."""
    return float(json.loads(stats)["simulated_s"])
