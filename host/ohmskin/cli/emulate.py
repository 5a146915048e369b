# SPDX-License-Identifier: Apache-2.0
"""``ohmskin emulate``: an emulated board at a pseudo-terminal."""

import signal
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Annotated, Final

import typer

from ohmskin.cli.demo import URL
from ohmskin.emulate.board import PtyServer
from ohmskin.emulate.faults import LINE_FAULTS, SKIN_FAULTS
from ohmskin.emulate.scenes import SCENES
from ohmskin.opening import emulated

_OPTIONS: Final = {
    "Scenes (scene=ghost)": SCENES,
    "Faults of the line (drop=0.1)": LINE_FAULTS,
    "Faults of the skin (open_row=3)": SKIN_FAULTS,
}
EPILOGS: Final = {
    "emulate": "\n".join(
        line
        for title, known in _OPTIONS.items()
        for line in (f"{title}:", *(f"- {name}: {text}" for name, text in known.items()))
    )
}


def emulate(
    url: Annotated[str, typer.Argument(help="an emulator:// URL")] = URL,
    link: Annotated[
        Path | None, typer.Option(help="also make this symbolic link to the pseudo-terminal")
    ] = None,
    seconds: Annotated[float, typer.Option(help="stop after so long; 0: never")] = 0.0,
) -> None:
    """Serve an emulated board at a pseudo-terminal, for any program. Ctrl-C ends it."""
    board, _, faults = emulated(url)
    with ExitStack() as stack:
        server = stack.enter_context(PtyServer(board, faults))
        if link is not None:
            if link.is_symlink():
                link.unlink()
            link.symlink_to(server.path)
            stack.callback(link.unlink, missing_ok=True)
        print(server.path, flush=True)  # noqa: T201
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # the link goes then, too
        with suppress(KeyboardInterrupt):
            server.serve(seconds or float("inf"))
