# SPDX-License-Identifier: Apache-2.0
"""Trials of some frames of a reference file; tests/circuit/test_circuit.py has those of all."""

import numpy as np

from ohmskin.circuit.skin import all_readings, end_admittance
from studies.trials import random_trial, reference_trial, without_leads


def test_some_frames_of_a_file_in_mode_far() -> None:
    some = reference_trial("far/random_5x9_0", slice(-2, None))
    exact = some.rounded(None, mode="far")
    assert len(some.frames) == len(exact.ratio) == 2
    skin = some.frames[1]
    a_to_h = all_readings(skin, end_admittance(skin))
    np.testing.assert_allclose(a_to_h[..., [0, 4, 1, 5]], exact.ratio[1], atol=1e-7)
    picked = reference_trial("random_8x8", np.array([3, 7]))
    every = reference_trial("random_8x8")
    np.testing.assert_array_equal(picked.cell_siemens, every.cell_siemens[[3, 7]])
    np.testing.assert_array_equal(picked.readings.ratio, every.readings.ratio[[3, 7]])


def test_that_there_are_no_leads_is_told_unless_it_is_taken_away() -> None:
    """Figures of "nothing told" were told it, and are 1.3 to 2 times as good as without."""
    told = random_trial(2, 3, 2, 1, 1).rounded(10, wires_told=False)
    assert told.knowledge(0).nominal_wire_ohm.lead == 0.0
    untold = without_leads(told).knowledge(0).nominal_wire_ohm
    assert (untold.both, untold.lead) == (None, None)
