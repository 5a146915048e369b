# SPDX-License-Identifier: Apache-2.0
"""A gripper squeezes a ball with 1 to 10 N: python squeeze.py CALIBRATION [PICTURE.png]

Prints the force of the motors, that on the skin in the model, and what the skin shows. Without
hardware, with made-up presses:

    ohmskin calibrate table "emulator://8x8" integrations/mujoco/presses.csv skin.json \
        --indenter-mm2 80 --wires 100,200 --leads 80
    ohmskin skin skin.json --pitch-mm 10,10
    python integrations/mujoco/squeeze.py skin.json squeeze.png
"""

import sys
from pathlib import Path

import mujoco
import numpy as np

from ohmskin_mujoco import Pad

MODEL = Path(__file__).with_name("gripper.xml")
SCAN_S = 1 / 90
SETTLED_S = 0.5


def squeezed(calibration: str, seconds: float = 4.0) -> np.ndarray:
    """Columns: time [s], force of a motor, force on the skin, force that the skin shows [N]."""
    model = mujoco.MjModel.from_xml_path(str(MODEL))
    data = mujoco.MjData(model)
    pad = Pad(model, "skin", calibration)
    rows, next_s = [], SETTLED_S
    while data.time < seconds:
        data.ctrl[:] = motor_n = 5.5 - 4.5 * np.cos(2 * np.pi * data.time / 4)
        mujoco.mj_step(model, data)
        if data.time >= next_s:
            next_s += SCAN_S
            scan = pad.read(data)
            rows.append((data.time, motor_n, pad.force_n(data).sum(), np.nansum(scan.force_n)))
    return np.array(rows)


def main(calibration: str, picture: str = "") -> None:
    if picture:
        import matplotlib.pyplot as plt  # before the simulation: it may be missing
    table = squeezed(calibration)
    print(f"{'s':>6}{'motor':>8}{'on skin':>9}{'shown':>8}   newtons")
    for row in table[::30]:
        print(f"{row[0]:6.2f}{row[1]:8.2f}{row[2]:9.2f}{row[3]:8.2f}")
    error_n = table[:, 3] - table[:, 2]
    rms = np.sqrt(np.mean(error_n**2)) / table[:, 2].mean()
    print(f"rms of shown less on skin, over the mean: {100 * rms:.2f} %")
    if picture:
        for column, name in ((1, "motor"), (2, "on the skin"), (3, "shown by the skin")):
            plt.plot(table[:, 0], table[:, column], label=name)
        plt.xlabel("time [s], simulated")
        plt.ylabel("force [N]")
        plt.legend()
        plt.savefig(picture)


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except (ImportError, ValueError) as exc:
        sys.exit(f"squeeze: {exc}")
