# SPDX-License-Identifier: Apache-2.0
"""Show the spectrum of a fingertip's force: python slip.py PORT CALIBRATION [PICTURE.png]

A thing that begins to slip makes the force tremble, too fast for scans of the whole skin. So the
skin is read twice, for a second each: as it is, and where it is touched alone.

Without hardware, with a fingertip whose force trembles by 5 % at 200 Hz, and presses of six cells
of the emulated skin:

    ohmskin calibrate table "emulator://8x8" examples/presses.csv skin.json \
        --indenter-mm2 80 --wires 100,200 --leads 80
    python examples/slip.py "emulator://8x8?scene=slip&begin=0&speed=0" skin.json slip.png
"""

import sys
from contextlib import suppress

import numpy as np

import ohmskin
from ohmskin.arrays import Float
from ohmskin.link.clock import scan_s

SECONDS = 1.0
HZ = np.arange(5.0, 300.5, 0.5)
FAST = ohmskin.Region(settle_us=20)  # speed counts here, more than the last per cent


def force_over_time(port: str, calibration: str, *, focus: bool) -> tuple[Float, Float]:
    """Times [s] and the forces of the strongest contact [N], with focus those of regions alone."""
    found = []
    with ohmskin.open(port, calibration=calibration, focus=FAST if focus else False) as skin:
        for scan in skin:
            if scan.contacts and not (focus and scan.is_whole):
                middle_s = 1e-6 * scan.time_us + scan_s(skin.info, scan) / 2
                found.append((middle_s, max(each.force_n for each in scan.contacts)))
                if middle_s - found[0][0] >= SECONDS:
                    break
    time_s, force_n = np.transpose(found)
    return time_s, force_n


def spectrum(time_s: Float, force_n: Float) -> Float:
    """Amplitude at each of `HZ`, over the mean force: by least squares, for times are not even."""
    shares = []
    for hz in HZ:
        wave = np.exp(2j * np.pi * hz * time_s)
        columns = np.transpose([np.ones_like(time_s), wave.real, wave.imag])
        mean, *amplitude = np.linalg.lstsq(columns, force_n, rcond=None)[0]
        shares.append(np.hypot(*amplitude) / mean)
    return np.array(shares)


def main(port: str, calibration: str, picture: str = "") -> None:
    curves = {}
    for focus, name in ((False, "the whole skin"), (True, "the region of the contact")):
        time_s, force_n = force_over_time(port, calibration, focus=focus)
        rate_hz = (time_s.size - 1) / (time_s[-1] - time_s[0])
        shares = spectrum(time_s, force_n)
        known = rate_hz / 2 >= HZ
        best = np.argmax(np.where(known, shares, 0))
        line = f"{100 * shares[best]:.1f} % of {force_n.mean():.2f} N at {HZ[best]:g} Hz"
        print(f"{name}, {rate_hz:.0f} times a second: the strongest line is {line}")
        curves[f"{name}, {rate_hz:.0f} Hz"] = HZ[known], 100 * shares[known]
    if picture:
        from matplotlib.figure import Figure

        axes = (figure := Figure(figsize=(8, 3.5), layout="constrained")).subplots()
        for name, curve in curves.items():
            axes.plot(*curve, label=name)
        axes.set(xlabel="frequency [Hz]", ylabel="amplitude [% of the force]")
        axes.legend(frameon=False)
        figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    try:
        with suppress(KeyboardInterrupt):  # Ctrl-C ends it
            print("waits for a touch", flush=True)
            main(*sys.argv[1:])
    except (ohmskin.OhmskinError, ValueError) as exc:
        sys.exit(f"slip: {exc}")
