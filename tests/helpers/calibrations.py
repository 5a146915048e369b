# SPDX-License-Identifier: Apache-2.0
"""Calibrations of simulated skins whose cells are all alike, for several test files."""

from dataclasses import replace

import numpy as np

from ohmskin.arrays import Float
from ohmskin.calibrate.regression import ForceRegression
from ohmskin.emulate.scenes import BOTTOM_WIRE_OHM, TOP_WIRE_OHM, Scene
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.force.calibration import Calibration, Rest

NEWTON_SIEMENS = 20e-6  # of every cell, in these tests


def calibration(
    rest_ratio: Float, method: str = "touch", unit_id: int = 0, siemens: float = NEWTON_SIEMENS
) -> Calibration:
    """One of cells of which each is linear: `siemens` (for "voltage" 1) a newton."""
    rows, columns = rest_ratio.shape[:2]
    knowledge = SkinKnowledge(
        rows,
        columns,
        adc_bits=10,
        rest_ratio=rest_ratio,
        nominal_wire_ohm=WireOhm(TOP_WIRE_OHM, BOTTOM_WIRE_OHM),
    )
    force_n = np.arange(1.0, 11.0)
    cells = np.arange(force_n.size) % (rows * columns)
    found = ForceRegression().fit(cells, siemens * force_n, force_n, shape=(rows, columns))
    return Calibration(
        unit_id=unit_id,
        date="2025-03-01",
        method=method,
        rest=Rest.of(method, knowledge, "2025-03-01"),
        model=found.model_,
        indenter_area_m2=1e-4,
        nominal_wire_ohm=WireOhm(TOP_WIRE_OHM, BOTTOM_WIRE_OHM),
    )


def of_scene(name: str, **options: object) -> Calibration:
    scene = Scene(name, 8, 8, seed=1)
    return calibration(scene.rest_ratio, **options)  # type: ignore[arg-type]


def half_doubtful(name: str, **options: object) -> Calibration:
    """That of a scene; presses of columns 0 to 3 scatter by 9 N, more than any touch has."""
    known = of_scene(name, **options)
    std = known.model.residual_std.copy()
    std[:, :4] = 9.0
    return replace(known, model=replace(known.model, residual_std=std))
