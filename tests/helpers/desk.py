# SPDX-License-Identifier: Apache-2.0
"""Scans of skins that the built firmware reads in simavr, on a board as unkind as one on a desk."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lockstep import CPU_HZ, DEFAULT_SCAN, Rig
from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin, all_readings, end_admittance, readings
from ohmskin.doctor.examine import Evidence, examine
from ohmskin.doctor.findings import Diagnosis
from ohmskin.doctor.wires import CornerScans, moved_across, suggested_corners
from ohmskin.emulate.simavr import SkinSim
from ohmskin.estimate.knowledge import WireOhm
from ohmskin.link.codes import ratio_from_codes
from ohmskin.link.messages import Scan
from ohmskin.link.protocol import MODES, lines_of
from stepped import stepped
from studies.trials import Trial, skin_at_rest, touch

REST_SCANS, SCANS = 20, 3
LOOK_SCANS = 60  # of the doctor
TOUCHES = 8
PRESS_OHM = 5e3  # firmly, as the doctor asks


@dataclass(frozen=True, eq=False)
class DeskSkin:
    """rest: the untouched skin; rest_ratio: mean of its scans. frames: skins, each touched anew.

    ratios: of each frame, three scans, (3, R, C, 4).
    """

    rest: Skin
    rest_ratio: Float
    frames: list[Skin]
    ratios: list[Float]


@contextmanager
def _on_desk(
    seed: int, mode: str = "near", *, rest: Skin | None = None, **settings: float
) -> Iterator[tuple[Rig, Skin, Any]]:
    """A board that scans an untouched skin, that skin, and the source of randomness behind both.

    rest: the skin; None: one of 8x8, drawn.
    """
    random = np.random.default_rng([77, seed])
    converter = dict(zip(("offset_lsb", "gain_lsb"), random.uniform(-2, 2, 2), strict=True))
    converter |= {"inl_lsb": random.uniform(-1.5, 1.5), "seed": seed}
    rest = skin_at_rest(8, 8, random) if rest is None else rest
    rows, columns = rest.shape
    rate_mhz = DEFAULT_SCAN["rate_mhz"] if max(rest.shape) <= 8 else 0
    with Rig("uno") as rig:
        rig.sim.set(desk=1)
        rig.sim.set(**converter | settings | {"far_open": float(mode == "near")})
        rig.run(0.3)
        show(rig.sim, rest, mode)
        rig.start_scan(mode=mode, rows=rows, columns=columns, rate_mhz=rate_mhz)
        rig.sim.hold_log(False)
        yield rig, rest, random


def desk_skin(seed: int, frames: int, *, mode: str = "near", **settings: float) -> DeskSkin:
    """8x8 at 90 Hz, Uno: the preset `desk` of firmware/sim, with these settings instead of its own.

    Offset and gain of the converter are within 2 LSB, its bow within 1.5, drawn from the seed.
    """
    with _on_desk(seed, mode, **settings) as (rig, rest, random):
        skins = [touch(rest, int(random.integers(1, TOUCHES + 1)), random) for _ in range(frames)]
        rest_ratio = ratio_from_codes(_scans(rig, REST_SCANS)).mean(axis=0)
        ratios = []
        for skin in skins:
            show(rig.sim, skin, mode)
            ratios.append(ratio_from_codes(_scans(rig, SCANS)))
    return DeskSkin(rest, rest_ratio, skins, ratios)


@dataclass(frozen=True, eq=False)
class PacedSkin:
    """A trial, as a board on a desk reads it.

    scans_hz: of its region, without whole scans in between. rest_ratio: mean of near scans, or of
    those of mode far. ratios: of each frame, the scans up to the third one of the mode that was
    asked for, each (R, C, 4); what was not read is NaN.
    """

    trial: Trial
    scans_hz: float
    rest_ratio: Float
    ratios: list[list[Float]]


def paced_skin(
    seed: int, trial: Trial, *, settings: Mapping[str, float] = {}, **scan: Any
) -> PacedSkin:
    """A trial on the desk of this seed: at rest in mode near, or far, then scanned so.

    settings: of the simulator, in place of the desk's.
    """
    of_all = "far" if scan["mode"] == "far" else "near"
    rows, columns = trial.rest.shape
    with _on_desk(seed, of_all, rest=trial.rest, **settings) as (rig, _, _):
        rest_ratio = ratio_from_codes(_scans(rig, REST_SCANS)).mean(axis=0)
        rig.must("stop")
        rig.start_scan(rows=rows, columns=columns, **scan)
        rig.sim.hold_log(False)
        scans_hz = CPU_HZ / rig.hello()["scan_cycles"]
        ratios = []
        for skin in trial.frames:
            show(rig.sim, skin, of_all)
            rig.scans.clear()
            ratios.append(list(_until_third(rig, scan["mode"], of_all, trial.rest.shape)))
    return PacedSkin(trial, scans_hz, rest_ratio, ratios)


def _until_third(rig: Rig, mode: str, of_all: str, shape: tuple[int, int]) -> Iterator[Float]:
    """Scans of the skin as it is, up to the third of this mode: those under way are left out.

    of_all: the mode that takes all readings, near or far.
    """
    taken, names = 2, MODES[of_all]
    for _ in range(SCANS):
        while True:
            while len(rig.scans) <= taken:
                rig.run(0.004)
            scan, taken = rig.scans[taken], taken + 1
            ratio = np.full((*shape, 4), np.nan)
            masks = scan.header["row_mask"], scan.header["column_mask"]
            lines = [lines_of(mask, count) for mask, count in zip(masks, shape, strict=True)]
            kinds = [names.index(name) for name in MODES[scan.header["mode"]]]
            ratio[np.ix_(*lines, kinds)] = ratio_from_codes(scan.codes)
            yield ratio
            if scan.header["mode"] == mode:
                break


def examined(seed: int, nominal: tuple[float, float]) -> Diagnosis:
    """What the doctor says of that skin on that board, wires among it: corners are pressed."""
    board = stepped("emulator://8x8").info
    presses, corners = CornerScans(board), suggested_corners(8, 8)
    with _on_desk(seed) as (rig, rest, _):
        rest_codes = _scans(rig, LOOK_SCANS)
        scans = [Scan(codes, n, n * 10**6 // 90, n / 90, 0) for n, codes in enumerate(rest_codes)]
        for cells in (corners, moved_across(corners)):
            siemens = rest.cell_siemens.copy()
            siemens[tuple(np.transpose(cells))] += 1 / PRESS_OHM
            show(rig.sim, replace(rest, cell_siemens=siemens), "near")
            for codes in _scans(rig, LOOK_SCANS):
                presses.take(Scan(codes, 0, 0, 0.0, 0))
    return examine(Evidence(board, scans, told=WireOhm(*nominal, lead=0.0), presses=presses))


def show(sim: SkinSim, skin: Skin, mode: str = "near") -> None:
    """Let a simulated board read this skin from now on."""
    if mode == "far":
        ends = end_admittance(skin)
        sim.set_table(all_readings(skin, ends.copy()))
        sim.request("C", bytes([0x80 | skin.shape[0]]) + ends.tobytes())
    else:
        sim.request("C", bytes([skin.shape[0]]) + near_admittance(skin).tobytes())
        sim.set_table(readings(skin))


def near_admittance(skin: Skin) -> Float:
    """Of the near ends alone, (R+C, R+C) [S]: no current leaves the skin at the far ends."""
    ends, lines = end_admittance(skin), sum(skin.shape)
    beyond = np.linalg.solve(ends[lines:, lines:], ends[lines:, :lines])
    return np.ascontiguousarray(ends[:lines, :lines] - ends[:lines, lines:] @ beyond)


def _scans(rig: Rig, count: int) -> NDArray[Any]:
    """So many scans of the skin as it is: those under way are left out."""
    rig.scans.clear()
    while len(rig.scans) < count + 2:
        rig.run(0.012)
    return np.array([scan.codes for scan in rig.scans[2 : count + 2]])
