# SPDX-License-Identifier: Apache-2.0
"""``ohmskin demo``: the main job without a board. Says a word before it loads what it needs."""

from pathlib import Path
from typing import Annotated, Final

from typer import Option

from ohmskin.ctrl_c import ctrl_c_kept

URL: Final = "emulator://8x8?scene=ghost&seed=1"


def demo(
    seconds: Annotated[float, Option(min=0.01, help="how long to scan, in s")] = 3.0,
    port: Annotated[str, Option(help="an emulator:// URL")] = f"{URL}&begin=0",
    picture: Annotated[Path, Option(help="PNG to write")] = Path("ohmskin-demo.png"),
) -> None:
    """Scan an emulated skin, and show what a ghost is and how it goes. Needs no board."""
    print(f"scanning {port} for {seconds:g} s", flush=True)  # noqa: T201
    with ctrl_c_kept():
        from ohmskin.cli.compare import compare  # loads for a second

    compare(port, seconds, picture)
