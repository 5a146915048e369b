# SPDX-License-Identifier: Apache-2.0
"""``ohmskin flash``: build the firmware, write it to a board, and hear that it runs there."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.console import Console

import ohmskin
from ohmskin.emulate.simavr import BOARDS
from ohmskin.errors import DeviceLost, OhmskinError, PortError
from ohmskin.link.messages import Hello
from ohmskin.link.serial_port import SerialPort, serial_ports

_out = Console(soft_wrap=True)
_ROOT: Final = Path(__file__).parents[3]
# A board is in its boot loader for up to 3 s, and its port may be gone meanwhile.
REBOOT_S: Final = 5.0
_RETRY_S: Final = 0.2


def flash(
    board: Annotated[str, typer.Argument(help=" | ".join(BOARDS))] = "",
    port: Annotated[str, typer.Option(help="serial port of the board")] = "",
) -> None:
    """Build the firmware, write it to a board, and check that it answers.

    Needs a checkout and PlatformIO. Without arguments: to the one board that is attached.
    """
    board, port = _chosen(board, port, serial_ports())
    if not (_ROOT / "platformio.ini").is_file():
        raise OhmskinError("the firmware is not here: run this in a checkout of the repository")
    pio = shutil.which("pio", path=str(Path(sys.executable).parent)) or shutil.which("pio")
    if pio is None:
        raise OhmskinError("PlatformIO is not installed: pip install 'ohmskin[flash]'")
    command = [pio, "run", "-d", str(_ROOT), "-e", board, "-t", "upload", "--upload-port", port]
    packages = _ROOT / ".pio" / "core"  # where `make setup` puts them
    environment = {"PLATFORMIO_CORE_DIR": str(packages)} if packages.is_dir() else {}
    _out.print(f"flashing {board} at {port}", markup=False)
    before = {each.path for each in serial_ports()}
    if subprocess.run(command, env=environment | os.environ).returncode:
        raise OhmskinError(f"flashing {board} at {port} failed: its last lines above say why")
    found, hello = _answer(board, port, before)
    if hello.board != board:
        raise OhmskinError(f"{found} answers as '{hello.board}', not as {board}: flash that one")
    _out.print(f"{found}: {board}, firmware {hello.version}, answers", markup=False)


def _chosen(board: str, port: str, attached: list[SerialPort]) -> tuple[str, str]:
    """The board and the port that are meant.

    :raises PortError: that is not clear.
    """
    if board and board not in BOARDS:
        raise PortError(f"no board '{board}': there are {', '.join(BOARDS)}")
    meant = [each for each in attached if port in ("", each.path)]
    fit = [each for each in meant if each.board in ((board,) if board else BOARDS)]
    if not port and len(fit) > 1:
        listed = ", ".join(f"{each.path} ({each.board})" for each in fit)
        raise PortError(f"{len(fit)} boards are attached: say --port: {listed}")
    if len(fit) == 1:
        return fit[0].board, fit[0].path
    other = next((each for each in meant if each.board), None)
    if port and other is not None:
        raise PortError(f"{port} is a {other.board}, not a {board}: say which you mean")
    if not (board and port):
        listed = ", ".join(each.path for each in meant) or "there is none"
        raise PortError(
            f"no {board or 'known board'} is found by its USB id: say which board is where: "
            f"ohmskin flash {' | '.join(BOARDS)} --port PORT: {listed}"
        )
    return board, port


def _answer(board: str, port: str, before: set[str]) -> tuple[str, Hello]:
    """Where the flashed board is now, which may be a new port, and what it says of itself."""
    deadline_s = time.monotonic() + REBOOT_S
    while True:
        attached = serial_ports()
        new = [each.path for each in attached if each.board == board and each.path not in before]
        gone = port in before and all(each.path != port for each in attached)
        at = new[0] if gone and len(new) == 1 else port
        try:
            with ohmskin.open(at, start=False) as skin:
                return at, skin.info
        except (PortError, DeviceLost):
            if time.monotonic() > deadline_s:
                raise
            time.sleep(_RETRY_S)
