# SPDX-License-Identifier: Apache-2.0
"""How wide must a force be spread, and does real time matter? python spread.py CALIBRATION

Prints what the skin shows in sum of 10 N in its middle, spread over more and more cells: step by
step without a clock, and on an emulated board in real time (a second each). Without hardware, see
squeeze.py for a calibration.
"""

import sys
from itertools import islice

import numpy as np

from ohmskin.force.simulated import SimulatedSkin

FORCE_N = 10.0
SPREADS = 0.2, 0.4, 0.6, 1.0  # standard deviations [pitches]
SCANS, SETTLED = 90, 10


def shown(calibration: str, spread: float) -> tuple[float, float, float]:
    """The largest force on a cell, and the sums shown by steps and in real time [N]."""
    skin = SimulatedSkin(calibration)
    rows, columns = skin.calibration.rows, skin.calibration.columns
    row, column = np.indices((rows, columns))
    away = (row - rows // 2) ** 2 + (column - columns // 2) ** 2
    force_n = np.exp(-away / (2 * spread**2))
    force_n *= FORCE_N / force_n.sum()
    steps = [skin.step(force_n, number / 90) for number in range(SCANS)]
    with SimulatedSkin(calibration).opened(lambda _: force_n) as live:
        scans = list(islice(live, SCANS))
    sums = (np.mean([np.nansum(s.force_n) for s in each[SETTLED:]]) for each in (steps, scans))
    return float(force_n.max()), *sums


def main(calibration: str) -> None:
    print(f"{'spread':>6}{'largest':>9}{'by steps':>10}{'real time':>11}   pitches, newtons")
    for spread in SPREADS:
        largest_n, by_steps_n, live_n = shown(calibration, spread)
        print(f"{spread:6.1f}{largest_n:9.1f}{by_steps_n:10.2f}{live_n:11.2f}")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    try:
        main(sys.argv[1])
    except ValueError as exc:
        sys.exit(f"spread: {exc}")
