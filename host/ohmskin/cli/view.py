# SPDX-License-Identifier: Apache-2.0
"""``ohmskin view``: a live page of one or several boards."""

import logging
import os
import sys
import threading
import webbrowser
from pathlib import Path
from types import ModuleType
from typing import Annotated, Final, TextIO

from typer import Argument, Option

from ohmskin.cli.terminal import printable
from ohmskin.ctrl_c import ends_by_ctrl_c
from ohmskin.errors import OhmskinError
from ohmskin.force.calibration import load_calibration
from ohmskin.link.device import LOG

# Where Linux says that a browser has somewhere to open.
_DISPLAYS: Final = {"DISPLAY", "WAYLAND_DISPLAY"}


def view(
    ports: Annotated[
        list[str] | None,
        Argument(metavar="PORT", envvar="OHMSKIN_PORT", help="or URLs; none: the page asks"),
    ] = None,
    calibration: Annotated[
        list[Path] | None, Option(envvar="OHMSKIN_CALIBRATION", help="forces; one for each unit")
    ] = None,
    force: Annotated[bool, Option("--force", help="take that of another unit")] = False,
    host: Annotated[str, Option(help="address at which the page listens")] = "127.0.0.1",
    http_port: Annotated[
        int | None,
        Option(min=0, max=65535, help="its port; 0: any free; default: 8765, or the next free"),
    ] = None,
    no_browser: Annotated[bool, Option("--no-browser", help="only print its address")] = False,
) -> None:
    """Show skins live on a page in the browser: heat map, contacts, tare, recording.

    Only this machine reaches it, unless --host says otherwise, at the address that is printed.
    A board that is not there, or goes, is told of, and is opened whenever it is plugged in.
    Recordings go to the current folder. Ctrl-C ends it; a recording is whole then.
    """
    server = page_server()
    from ohmskin.view.boards import ViewedBoards

    calibrations = [load_calibration(path) for path in calibration or ()]

    def started(url: str) -> None:
        print(url, flush=True)  # noqa: T201
        if not no_browser:
            browse(url)

    LOG.addHandler(told := _Told())
    try:
        with ends_by_ctrl_c():
            boards = ViewedBoards(ports or (), calibrations, Path(), force=force)
            server.serve(boards, host, http_port, started)
    finally:
        LOG.removeHandler(told)


def page_server() -> ModuleType:
    """The module that serves the page.

    :raises OhmskinError: what it needs is not installed.
    """
    try:
        from ohmskin.view import server
    except ImportError as exc:
        raise OhmskinError(
            f"the page needs more ({exc.name}): run pip install '.[view]' in the checkout, or "
            "'FILE.whl[view]' of a release's wheel"
        ) from exc
    return server


def browse(url: str) -> None:
    """Open a browser, where it has somewhere to open."""
    if sys.platform in ("win32", "darwin") or _DISPLAYS & {*os.environ}:
        # Some browsers return only when they are closed.
        threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()


class _Told(logging.StreamHandler[TextIO]):
    """Prints what the log says of boards: whoever looks at the terminal may not see the page.

    If stderr was closed, it goes on without: a failure would end the thread that reads the board.
    """

    def format(self, record: logging.LogRecord) -> str:
        """A line."""
        return printable(f"ohmskin: {' '.join(record.getMessage().split())}")
