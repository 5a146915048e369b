# SPDX-License-Identifier: Apache-2.0
"""Estimates from what the built firmware reads in simavr, on a board as unkind as one on a desk."""

import numpy as np
import pytest

from desk import DeskSkin, desk_skin, paced_skin
from ohmskin.circuit.skin import readings
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.estimate.methods import make_estimator
from ohmskin.estimate.port_readings import PortReader
from ohmskin.link.protocol import MODES
from studies.judge import answers_of, judge_trial, pooled
from studies.trials import knowledge_of, random_trial


@pytest.fixture(scope="module")
def skins() -> list[DeskSkin]:
    return [desk_skin(seed, 8) for seed in range(3)]


@pytest.mark.parametrize("method", ["joint", "touch"])
def test_errors_are_small_and_stated(skins: list[DeskSkin], method: str) -> None:
    """Lines that have not settled make single readings err by 30 LSB, and currents by little."""
    error, stated = [], []
    for skin in skins:
        known = SkinKnowledge(
            8,
            8,
            adc_bits=10,
            rest_ratio=skin.rest_ratio,
            nominal_wire_ohm=WireOhm(100.0, 200.0, lead=0.0),
        )
        estimator = make_estimator(method, known)
        for truth, ratios in zip(skin.frames, skin.ratios, strict=True):
            *_, found = (estimator.estimate(ratio) for ratio in ratios)
            assert found.converged
            pressed = truth.cell_siemens > 1.5 * skin.rest.cell_siemens
            error.append(np.abs(found.cell_siemens / truth.cell_siemens - 1)[pressed])
            stated.append((found.cell_siemens_std / truth.cell_siemens)[pressed])
    errors, stds = np.concatenate(error), np.concatenate(stated)
    assert np.median(errors) < 0.015
    assert np.mean(errors < 4 * stds) > 0.98
    assert np.median(stds / errors) < 4  # 10 where all of a disagreement counts as noise


@pytest.fixture(scope="module")
def far_skins() -> list[DeskSkin]:
    return [desk_skin(seed, 8, mode="far") for seed in range(2)]


@pytest.mark.parametrize("method", ["joint", "touch"])
def test_far_ends_need_no_wires(far_skins: list[DeskSkin], method: str) -> None:
    """Near ends err by 10 LSB alike, which looks like an offset; far ends hardly."""
    error, stated = [], []
    for skin in far_skins:
        known = SkinKnowledge(
            8,
            8,
            adc_bits=10,
            rest_ratio=skin.rest_ratio,
            nominal_wire_ohm=WireOhm(lead=0.0),
            reading_names=MODES["far"],
        )
        estimator = make_estimator(method, known)
        for truth, ratios in zip(skin.frames, skin.ratios, strict=True):
            *_, found = (estimator.estimate(ratio) for ratio in ratios)
            pressed = truth.cell_siemens > 1.5 * skin.rest.cell_siemens
            error.append(np.abs(found.cell_siemens / truth.cell_siemens - 1)[pressed])
            stated.append((found.cell_siemens_std / truth.cell_siemens)[pressed])
        assert np.median(found.top_wire_ohm) == pytest.approx(100, rel=0.3)
        assert np.median(found.bottom_wire_ohm) == pytest.approx(200, rel=0.3)
    errors, stds = np.concatenate(error), np.concatenate(stated)
    assert np.median(errors) < 0.01
    assert np.mean(errors < 4 * stds) > 0.98
    assert np.median(stds / errors) < 4


@pytest.mark.parametrize("mode", ["half", "quick"])
def test_fewer_readings_at_default_rates(mode: str) -> None:
    """Lines that charge do not make ghosts, with near scans, which settle less, in between.

    Nor does what they do to near scans count as an offset of the board: that made currents of half
    and quick err by 1.6 LSB. Near scans, of which rest is one, show too much current in all cells,
    by what the converter's gain and its sample capacitor make: currents of half and quick show as
    much, once near scans in between have shown it.
    """
    parts, errors_lsb, of_rest_lsb = [], [], []
    for seed in range(12):
        trial = random_trial(8, 8, 6, 12, 7000 + seed)
        skin = paced_skin(seed, trial, mode=mode, rate_mhz=0, whole_every=12)
        assert skin.scans_hz > 120
        estimator = make_estimator("touch", knowledge_of(skin.rest_ratio))
        found = [[estimator.estimate(each) for each in scans][-1] for scans in skin.ratios]
        parts.append(judge_trial(answers_of(found), trial))
        reader, ref_ohm = PortReader(knowledge_of(skin.rest_ratio)), trial.rest.ref_bottom_ohm
        at_rest = readings(trial.rest)[..., 1]
        off_by = ref_ohm * reader.read(skin.rest_ratio).current - at_rest
        of_rest = np.median(off_by / (1 - 2 * at_rest))
        reader.reset()
        for scans, exact in zip(skin.ratios, trial.readings.ratio, strict=True):
            *_, ports = (reader.read(each, in_order=True) for each in scans)
            off_by = ref_ohm * ports.current - exact[..., 1]
            errors_lsb.append(1024 * off_by)
            of_rest_lsb.append(1024 * (off_by - of_rest * (1 - 2 * exact[..., 1])))
    assert np.sqrt(np.mean(np.square(errors_lsb))) < {"half": 1.0, "quick": 1.2}[mode]
    assert abs(np.mean(of_rest_lsb)) < 0.2
    # Noise alone makes 0.5 and 0.58 LSB, as A hardly counts where lines charge.
    assert np.std(of_rest_lsb) < {"half": 0.6, "quick": 0.8}[mode]
    judged = pooled(parts)
    assert judged.error_percent() < 2
    assert judged.pressed_within_percent() > 95
    assert judged.ghost_us() < 2
