# SPDX-License-Identifier: Apache-2.0
"""What bench_pace.py measures of the host and the built firmware together, in lock-step.

focus_error_over_whole   a fingertip that moves over the desk's skin by some five cells a second:
                         median error of its cells where the board follows it, over that where it
                         takes near scans of all cells at 90 Hz
new_touch_s              a second touch, away from a fingertip that is followed, 200 times at any
                         moment: from the touch to the estimate that shows it, at worst, with the
                         time that the estimate took on this machine
refocus_scans, refocus_ms
                         the first scan begun after a command for another region that has it, and
                         how long after, at worst of 100 such regions as fingertips ask for
slip_hz_error, slip_amplitude_error
                         a finger whose force trembles by 5 % at 200 Hz (the scene "slip"), followed
                         for a second, 20 us to settle: of the strongest line of the spectrum
slip_hz                  how often its force was read in a second
clock_delay_error_ms     4 ms of delay from board to host: error of `Scan.delay_s`, at worst, where
                         the board was still while commands were answered, and where it scanned
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from itertools import islice

import numpy as np

from bars import Part  # beside this file
from calibrations import of_scene  # tests/helpers
from lockstep import Rig
from lockstep_skin import LockstepLink, lockstep_skin
from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin
from ohmskin.emulate.scenes import SLIP_HZ, Scene
from ohmskin.estimate.base import Estimate
from ohmskin.force.focus import Focus
from ohmskin.force.reader import CalibratedSkin, SkinReader
from ohmskin.link import protocol
from ohmskin.link.clock import line_delay_s, scan_s
from ohmskin.link.device import Device, Region
from ohmskin.link.messages import Scan
from studies.judge import answers_of, judge

Cell = tuple[int, int]

SEED = 7100
DESK: dict[str, float] = {
    "desk": 1,
    "offset_lsb": 1.0,
    "gain_lsb": -1.0,
    "inl_lsb": 1.0,
    "far_open": 1,
}
TARE_S, BEGIN_S = 0.3, 0.6  # the skin is untouched until then
MOVES_S, ARRIVALS, REGIONS = 4.0, 200, 100
FIRST_OHM, LOG_OHM = 8e3, (3.7, 4.3)  # of a new touch, 5 to 20 kOhm
AWAY = 3  # lines, between both
FOLLOWED_S = (0.05, 0.15)
TREMBLES_S = 1.0
FAST = Region(settle_us=20)
LEAST_S = 0.1  # for the quick look
PHASES = 40  # of a period of the tremble, in which the simulated skin moves
DELAY_S, CLOCK_STEP_S, CLOCK_SCANS = 4e-3, 50e-6, 200


def measure(part: Part) -> dict[str, float]:
    return of_moving(part) | of_arrivals(part) | of_refocus(part) | of_slip(part) | of_clock(part)


def middle_s(scan: Scan, device: Device) -> float:
    """When the middle of a scan was, by the time of the simulation [s]."""
    board = device.info
    return scan.host_time_s - line_delay_s(scan, board) - scan_s(board, scan) / 2


def tared(link: LockstepLink) -> tuple[Device, SkinReader]:
    """A simulated board whose skin was still untouched."""
    device = lockstep_skin(link)
    reader = SkinReader(device.info)
    reader.tare_by(device, TARE_S)
    return device, reader


def of_moving(part: Part) -> dict[str, float]:
    """focus_*."""
    scene = Scene("moving", seed=SEED, begin_s=BEGIN_S)
    skin_of_ms = lru_cache(lambda ms: scene.skin(1e-3 * ms))
    errors = []
    for follows in (False, True):
        device, reader = tared(LockstepLink(lambda t: skin_of_ms(round(1e3 * t)), settings=DESK))
        with device:
            reader.focus = Focus(device) if follows else None
            shown, at_s = [], []
            for scan in device:
                if scan.host_time_s > BEGIN_S + 0.1 + max(part.share * MOVES_S, LEAST_S):
                    break
                estimate = reader.read(scan).estimate
                if (taken_s := middle_s(scan, device)) > BEGIN_S + 0.1:
                    shown.append(estimate)
                    at_s.append(taken_s)
        true = np.array([scene.skin(each_s).cell_siemens for each_s in at_s])
        judged = judge(answers_of(shown), true, scene.rest.cell_siemens)
        errors.append(judged.error_percent())
    return {
        "focus_error_over_whole": round(errors[1] / errors[0], 2),
        "focus_error_percent": round(errors[1], 2),
    }


class Followed:
    """A skin that is touched here and there, followed by a reader: `read` gives what it shows."""

    def __init__(self) -> None:
        self._rest = self._skin = Scene(seed=SEED).rest
        self.device, self._reader = tared(LockstepLink(lambda _: self._skin))
        self._reader.focus = Focus(self.device)
        self._scans = iter(self.device)

    def touch(self, *touches: tuple[Cell, float]) -> None:
        """From now on: cells, and their resistances [ohm]."""
        siemens = self._rest.cell_siemens.copy()
        for cell, ohm in touches:
            siemens[cell] += 1 / ohm
        self._skin = replace(self._rest, cell_siemens=siemens)

    def read(self) -> tuple[Scan, Estimate]:
        scan = next(self._scans)
        return scan, self._reader.read(scan).estimate


def of_arrivals(part: Part) -> dict[str, float]:
    """new_touch_s."""
    random, worst_s, skin = np.random.default_rng(SEED), 0.0, Followed()
    with skin.device:
        for _ in range(part.of(ARRIVALS)):
            one, other = random.integers(8, size=(2, 2))
            while np.abs(one - other).max() < AWAY or (one == other).any():
                other = random.integers(8, size=2)
            first: tuple[Cell, float] = (one[0], one[1]), FIRST_OHM
            new: tuple[Cell, float] = (other[0], other[1]), 10 ** random.uniform(*LOG_OHM)
            skin.touch(first)
            scan, found = skin.read()
            while scan.is_whole or not found.touched[first[0]]:
                scan, found = skin.read()
            end_s = scan.host_time_s + random.uniform(*FOLLOWED_S)
            while scan.host_time_s < end_s:
                scan, found = skin.read()
            skin.touch(first, new)
            begin_s = skin.device.now_s
            while not found.touched[new[0]]:
                scan, found = skin.read()
            worst_s = max(worst_s, scan.host_time_s + found.seconds - begin_s)
            skin.touch()
            while found.touched.any():
                scan, found = skin.read()
    return {"new_touch_s": round(worst_s, 3)}


def of_refocus(part: Part) -> dict[str, float]:
    """refocus_*."""
    random, scans, worst_us = np.random.default_rng(SEED), 0, 0
    asked = {"rate_mhz": 0, "settle_us": 0, "mode": "quick", "whole_mode": "near"}
    with Rig("uno") as rig:
        rig.run(0.3)
        rig.start_scan()
        for _ in range(part.of(REGIONS)):
            masks = {}
            for name in ("row_mask", "column_mask"):
                count = int(random.integers(3, 6))
                masks[name] = protocol.all_lines(count) << int(random.integers(9 - count))
            rig.must("set_region", **masks, **asked, whole_every=25)
            heard_us = rig.frames("ack")[-1]["time_us"]
            rig.run(random.uniform(0.05, 0.1))
            after = [each.header for each in rig.scans if each.header["time_us"] > heard_us]
            has_it = [masks.items() <= header.items() for header in after]
            first = has_it.index(True)
            scans = max(scans, 1 + first)
            worst_us = max(worst_us, after[first]["time_us"] - heard_us)
            rig.scans.clear()
    return {"refocus_scans": scans, "refocus_ms": round(1e-3 * worst_us, 1)}


def of_slip(part: Part) -> dict[str, float]:
    """slip_*."""
    scene = Scene("slip", seed=1, begin_s=BEGIN_S)
    skin_of_phase = lru_cache(lambda phase: scene.skin(BEGIN_S + phase / PHASES / SLIP_HZ))

    def skin(time_s: float) -> Skin:
        phase = round((time_s - BEGIN_S) * SLIP_HZ * PHASES)
        return scene.rest if phase < 0 else skin_of_phase(phase % PHASES)

    device = lockstep_skin(LockstepLink(skin, step_s=1 / SLIP_HZ / PHASES))
    with CalibratedSkin(device, of_scene("slip"), focus=FAST) as calibrated:
        calibrated.tare(TARE_S)
        time_s, force_n = [], []
        for scan in calibrated:
            if scan.host_time_s > BEGIN_S + 0.1 + max(part.share * TREMBLES_S, LEAST_S):
                break
            if scan.host_time_s > BEGIN_S + 0.1 and not scan.is_whole and scan.contacts:
                time_s.append(1e-6 * scan.time_us + scan_s(device.info, scan) / 2)
                force_n.append(scan.contacts[0].force_n)
    hz, share = strongest(np.array(time_s), np.array(force_n))
    # What the cells of the calibration's linear law add, over a period.
    period = np.array([skin_of_phase(phase).cell_siemens.sum() for phase in range(PHASES)])
    spectrum = np.abs(np.fft.rfft(period - scene.rest.cell_siemens.sum()))
    return {
        "slip_hz_error": round(abs(hz / SLIP_HZ - 1), 4),
        "slip_amplitude_error": round(abs(share / (2 * spectrum[1] / spectrum[0]) - 1), 3),
        "slip_hz": round(len(time_s) / (time_s[-1] - time_s[0])),
    }


def strongest(time_s: Float, force_n: Float) -> tuple[float, float]:
    """Frequency [Hz] and amplitude, as a share of the mean, of the strongest line of a spectrum.

    By least squares, since times are not even.
    """
    found = []
    for hz in np.arange(20.0, 500.0, 0.25):
        wave = np.exp(2j * np.pi * hz * time_s)
        columns = np.transpose([np.ones_like(time_s), wave.real, wave.imag])
        mean, *amplitude = np.linalg.lstsq(columns, force_n, rcond=None)[0]
        found.append((float(np.hypot(*amplitude) / mean), float(hz)))
    share, hz = max(found)
    return hz, share


def of_clock(part: Part) -> dict[str, float]:
    """clock_*."""
    rest, found_s = Scene(seed=SEED).rest, []
    for before_s in (DELAY_S, 5 * DELAY_S):  # the delay until it scans
        link = LockstepLink(lambda _: rest, delay_s=before_s, step_s=CLOCK_STEP_S)
        with lockstep_skin(link) as device:
            scans = iter(device)
            first = next(scans)
            if before_s == DELAY_S:
                found_s.append(first.delay_s)
                continue
            link.delay_s = DELAY_S
            for scan in islice(scans, 10 + part.of(CLOCK_SCANS)):
                if scan.number % 20 == 10:
                    device.set_unit_id(scan.number % 7)
            found_s.append(scan.delay_s)
    worst_s = max(abs(each_s - DELAY_S) for each_s in found_s)
    return {"clock_delay_error_ms": round(1e3 * worst_s, 2)}
