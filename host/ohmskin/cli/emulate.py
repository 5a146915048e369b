# SPDX-License-Identifier: Apache-2.0
"""``ohmskin emulate``: an emulated board for other programs."""

from typing import Annotated, Final

from typer import Argument

from ohmskin.cli.board import Seconds
from ohmskin.cli.demo import URL
from ohmskin.ctrl_c import ends_by_ctrl_c
from ohmskin.emulate.driver import PtyServer
from ohmskin.emulate.faults import LINE_FAULTS, SKIN_FAULTS
from ohmskin.emulate.scale import SCALE_OPTIONS
from ohmskin.emulate.scenes import LEAD_OHM, SCENES
from ohmskin.emulate.urls import emulated, is_stepped, scale_under
from ohmskin.errors import PortError

# The options of an emulator:// URL, for the command's help.
_OPTIONS: Final = {
    "Scenes (scene=ghost)": SCENES,
    "The skin (lead=300)": {"lead": f"ohms of each line's lead, {LEAD_OHM:g} unless told"},
    "The scale under the scene knead (scale_rate=80)": SCALE_OPTIONS,
    "Faults of the line (drop=0.1)": LINE_FAULTS,
    "Faults of the skin (open_row=3)": SKIN_FAULTS,
}
EPILOG: Final = "\n".join(
    line
    for title, options in _OPTIONS.items()
    for line in (f"{title}:", *(f"- {name}: {text}" for name, text in options.items()))
)


def emulate(
    url: Annotated[str, Argument(help="an emulator:// URL")] = URL, seconds: Seconds = 0.0
) -> None:
    """Serve an emulated board at a pseudo-terminal. Ctrl-C ends it.

    In the scene knead, a scale is under the skin: its pseudo-terminal is the second one.
    """
    if is_stepped(url):
        raise PortError("a pseudo-terminal has real time: leave out speed=0")
    board, scene, faults = emulated(url)
    scale = scale_under(scene, url) if scene.name == "knead" else None
    with PtyServer(board, faults, scale) as server, ends_by_ctrl_c():
        print("\n".join(filter(None, [server.path, server.scale_path])), flush=True)  # noqa: T201
        server.serve(seconds or float("inf"))
