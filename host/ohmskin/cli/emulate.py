# SPDX-License-Identifier: Apache-2.0
"""``ohmskin emulate``: an emulated board at a pseudo-terminal, for any program."""

import signal
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Annotated

import typer

from ohmskin.emulate.line_faults import FAULTS
from ohmskin.emulate.pty_server import PtyServer
from ohmskin.emulate.scenes import SCENES
from ohmskin.emulate.skin_faults import SKIN_FAULTS
from ohmskin.opening import emulated

EPILOG = (
    f"Scenes: {'; '.join(f'{k}: {v}' for k, v in SCENES.items())}. "
    f"Faults of the line: {'; '.join(f'{k}: {v}' for k, v in FAULTS.items())}. "
    f"Faults of the skin: {'; '.join(f'{k}: {v}' for k, v in SKIN_FAULTS.items())}."
)


def emulate(
    url: Annotated[str, typer.Argument(help="emulator://8x8?scene=ghost&seed=1")] = (
        "emulator://8x8?scene=ghost"
    ),
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
