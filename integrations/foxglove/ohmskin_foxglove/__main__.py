# SPDX-License-Identifier: Apache-2.0
"""``ohmskin-foxglove add``: clouds in a recording. ``ohmskin-foxglove live``: clouds of a board."""

import argparse
import sys
from functools import partial
from pathlib import Path

import ohmskin
from ohmskin.force.geometry import required
from ohmskin_foxglove import add_clouds, serve


def main() -> None:
    """The command line. An error is one line, exit code 1."""
    parser = argparse.ArgumentParser(prog="ohmskin-foxglove")
    commands = parser.add_subparsers(dest="command", required=True)
    add = commands.add_parser("add", help="a recording with the forces of a calibration in it")
    add.add_argument("recording", type=Path)
    add.add_argument("calibration")
    add.add_argument("out", type=Path)
    live = commands.add_parser("live", help="serve a skin to Foxglove, on this machine")
    live.add_argument("port", help="serial port or URL")
    live.add_argument("calibration")
    live.add_argument("--ws-port", type=int, default=8765, help="port for Foxglove")
    told = parser.parse_args()
    try:
        if told.command == "add":
            scans = add_clouds(told.recording, ohmskin.load_calibration(told.calibration), told.out)
            print(f"{told.out}: {scans} scans")
        else:
            known = ohmskin.load_calibration(told.calibration)
            required(known.geometry)
            with ohmskin.LiveSkin(told.port, known, every=False) as skin:
                serve(skin, told.ws_port, partial(print, flush=True))
    except (ohmskin.OhmskinError, ValueError, OSError, RuntimeError) as exc:
        sys.exit(f"ohmskin-foxglove: {exc}")


if __name__ == "__main__":
    main()
