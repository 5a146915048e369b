# SPDX-License-Identifier: Apache-2.0
"""A misfit that stays: what no touches explain, frame after frame, by a node Laplacian."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from network import SkinCircuit  # tests/helpers
from ohmskin.arrays import Float
from ohmskin.circuit.skin import Skin, port_resistance_ohm
from ohmskin.estimate import full_fit
from ohmskin.estimate.base import Estimate
from ohmskin.estimate.full_fit import FullFit
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.estimate.methods import make_estimator
from ohmskin.estimate.near_wires import LearnedWires
from ohmskin.estimate.port_readings import PortReadings
from ohmskin.estimate.prior import LAYER_STD, LEAD_STD, REST_STD, SEGMENT_STD, CellPrior
from ohmskin.estimate.staying_faults import STAYING_FAULT
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.link.protocol import ENUMS, MODES
from studies.trials import Trial, bent_trial, finger_trial, jump_trial, palm_trial, random_trial

FRAMES = 50
SHOWN = "many touches look like it: ask the doctor"
SHORTED = f"rows 3 and 4: shorted? {SHOWN}"
BROKEN = f"row 2: is its yarn broken? {SHOWN}"


def led(skin: Skin) -> Skin:
    """The same skin behind leads of 100 ohm."""
    return replace(skin, lead_ohm=np.array(100.0))


def estimates(
    trial: Trial,
    method: str,
    mode: str = "near",
    *,
    short_ohm: float = 0.0,
    segment_times: float = 1.0,
    noise_lsb: float = 0.3,
) -> list[Estimate]:
    """All frames, by 10 bits.

    After the tare, there is a short between rows 3 and 4, where their leads end; or the second
    segment of row 2 has so many times its resistance.
    """
    names = [ENUMS["reading"].values[name] for name in MODES[mode]]
    short = (np.array([[3], [4]]), np.array([short_ohm])) if short_ohm else None
    times = np.ones(trial.rest.shape)
    times[2, 1] = segment_times
    frames = [
        SkinCircuit(led(replace(skin, top_wire_ohm=skin.top_wire_ohm * times)), short).readings(
            skin.cell_siemens
        )[..., names]
        for skin in trial.frames
    ]
    rest = SkinCircuit(led(trial.rest)).readings(trial.rest.cell_siemens)[..., names]
    exact = np.array([*[rest] * 90, *frames])  # a tare is the mean of 90 scans
    exact += noise_lsb / 1024 * np.random.default_rng(0).standard_normal(exact.shape)
    ratios = ratio_from_codes(quantise(exact))
    rest = ratios[:90].mean(axis=0)
    shape = trial.rest.shape
    known = SkinKnowledge(*shape, adc_bits=10, rest_ratio=rest, reading_names=MODES[mode])
    estimator = make_estimator(method, known)
    return [estimator.estimate(ratio) for ratio in ratios[90:]]


@pytest.mark.parametrize("method", ["joint", "touch"])
def test_a_short_of_20_ohm_flags_most_frames_once_some_have_shown_it(method: str) -> None:
    """A frame alone may be explained by touches that are not there."""
    found = estimates(random_trial(8, 8, 8, FRAMES, 24001), method, short_ohm=20.0)
    late = found[20:]
    assert sum(one.converged for one in late) <= 6
    assert sum(one.message == SHORTED for one in late) >= 15


@pytest.mark.parametrize(
    ("mode", "method"), [("near", "joint"), ("near", "touch"), ("half", "joint"), ("far", "joint")]
)
@pytest.mark.parametrize(
    ("damage", "named"), [({"short_ohm": 20.0}, SHORTED), ({"segment_times": 30.0}, BROKEN)]
)
def test_a_damage_is_named_after_some_touches_and_no_other_line_is(
    damage: dict[str, float], named: str, mode: str, method: str
) -> None:
    named_in = 0
    for seed in range(3):
        trial = random_trial(8, 8, 8, 120, 500 + seed)
        messages = [one.message for one in estimates(trial, method, mode, **damage)]
        assert {one for one in messages if one.endswith(SHOWN)} <= {named}
        named_in += named in messages
    assert named_in >= 2


@pytest.mark.parametrize("mode", ["near", "far"])
def test_fingertips_show_a_short_that_no_frame_of_them_shows(mode: str) -> None:
    trial = finger_trial(8, 8, 80, 3)
    messages = [one.message for one in estimates(trial, "joint", mode, short_ohm=20.0)]
    assert SHORTED in messages
    assert {one for one in messages if one.endswith(SHOWN)} == {SHORTED}


@pytest.mark.parametrize("method", ["joint", "touch"])
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    "trial",
    [
        random_trial(8, 8, 16, FRAMES, 1),
        random_trial(3, 3, 3, FRAMES, 2),
        random_trial(4, 4, 4, FRAMES, 5),
        bent_trial(8, 8, 8, FRAMES, 3),
        jump_trial(8, 8, 8, FRAMES, 4),
        palm_trial(8, 8, FRAMES, 6),
        palm_trial(4, 4, FRAMES, 4),
    ],
    ids=["dense", "small", "4x4", "bent", "jump", "palm", "palm 4x4"],
)
def test_a_sound_skin_is_never_said_to_be_damaged(trial: Trial, mode: str, method: str) -> None:
    # One reading of each cell shows no noise, if nothing else has: it counts as that of a code.
    for noise_lsb in (0.3,) if mode == "quick" else (0.3, 3.0):
        messages = [one.message for one in estimates(trial, method, mode, noise_lsb=noise_lsb)]
        assert STAYING_FAULT not in messages
        assert not [one for one in messages if one.endswith(SHOWN)]


class NormalPrior(CellPrior):
    """Without tails: then the distribution of chi-square is known."""

    def about(self, means: Float) -> CellPrior:
        return self

    def normal(
        self, log_ohm: Float, cells: NDArray[np.intp] | slice = slice(None)
    ) -> tuple[Float, Float]:
        return self.expected[cells], self.std[cells] ** 2


def test_skins_drawn_from_the_prior_are_no_surprise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Chi-square is that of the readings which cells and wires leave free."""
    monkeypatch.setattr(full_fit, "FOLLOWS_LOG", 100.0)  # here nothing follows a tail
    random, shape, ref_ohm = np.random.default_rng(0), (5, 6), 6e4
    belief = LearnedWires(shape, WireOhm(200.0, 400.0, lead=300.0))
    rest = np.log(random.uniform(1e5, 4e5, 30))
    by_means = np.zeros((30, belief.means.size))
    prior = NormalPrior(rest, np.full(30, REST_STD), by_means, belief.means)
    noise = np.full(shape, 2e-8)
    surprises = []
    for _ in range(200):
        top, bottom = (
            ohm * np.exp(LAYER_STD * random.standard_normal() + SEGMENT_STD * own)
            for ohm, own in zip((200.0, 400.0), random.standard_normal((2, *shape)), strict=True)
        )
        lead = 300.0 * (1 + LEAD_STD * random.standard_normal())
        leads = lead + SEGMENT_STD * 300.0 * random.standard_normal(sum(shape))
        siemens = np.exp(-rest - REST_STD * random.standard_normal(30)).reshape(shape)
        rho = port_resistance_ohm(Skin(siemens, top, bottom)) + leads[:5, None] + leads[5:]
        current = 1 / (rho + ref_ohm) + noise * random.standard_normal(shape)
        ports = PortReadings(ratio=current, current=current, current_std=noise)
        fit = FullFit(prior, belief, ref_ohm, ports, rest)
        assert not fit.message
        surprises.append(fit.surprise)
    assert np.mean(surprises) == pytest.approx(1, abs=0.05)
