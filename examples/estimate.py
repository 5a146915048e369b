# SPDX-License-Identifier: Apache-2.0
"""Print the touched cells of a skin, ten times a second: python estimate.py PORT"""

import sys
import time
from contextlib import suppress

import ohmskin


def main(port: str, seconds: float = float("inf")) -> None:
    with ohmskin.open(port) as skin:
        rest = skin.latest().ratio  # nothing may touch the skin now
        knowledge = ohmskin.SkinKnowledge.of(skin.info, rest)
        estimator = ohmskin.make_estimator("touch", knowledge)
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            estimate = estimator.estimate(skin.latest().ratio)
            for row, column in zip(*estimate.touched.nonzero(), strict=True):
                siemens = estimate.cell_siemens[row, column]
                std = estimate.cell_siemens_std[row, column]
                print(f"({row}, {column}): {1e6 * siemens:.2f} +- {1e6 * std:.2f} microsiemens")
            time.sleep(0.1)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    try:
        with suppress(KeyboardInterrupt):  # Ctrl-C ends it
            main(sys.argv[1])
    except (ohmskin.OhmskinError, ValueError) as exc:
        sys.exit(f"estimate: {exc}")
