# SPDX-License-Identifier: Apache-2.0
"""Frames of which not all was read. Readings are those of the node Laplacian, with noise."""

from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest

from network import SkinCircuit, floating_share
from ohmskin.arrays import Float
from ohmskin.estimate.joint import BEYOND_REGION
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.estimate.methods import METHODS, make_estimator
from ohmskin.estimate.port_currents import MOST_OFFSET_RATIO
from ohmskin.estimate.port_partial import STALE_SHARE
from ohmskin.estimate.port_readings import PortReader
from ohmskin.link.codes import quantise, ratio_from_codes
from ohmskin.record.readings import Readings, estimate_file, load_readings
from studies.judge import STATED_STDS, answers_of, judge, pooled
from studies.trials import Trial, finger_trial, random_trial, skin_at_rest

NOISE_RATIO = 0.3 / 1024
READ = {"near": (0, 1, 2, 3), "half": (0, 1), "quick": (1,)}
TRIALS = {"touches": partial(random_trial, 8, 8, 6, 14), "finger": partial(finger_trial, 8, 8, 14)}


@cache
def trial(scene: str, seed: int = 2) -> tuple[Trial, Float, Float]:
    """A skin; what a board reads of it at rest, the mean of 50 scans, and in each frame."""
    made, random = TRIALS[scene](seed), np.random.default_rng(5)
    circuit = SkinCircuit(made.rest)
    exact = np.array([circuit.readings(cells)[..., :4] for cells in made.cell_siemens])
    rest = np.repeat(circuit.readings(made.rest.cell_siemens)[None, ..., :4], 50, axis=0)
    rest, frames = (
        ratio_from_codes(quantise(ratio + NOISE_RATIO * random.standard_normal(ratio.shape)))
        for ratio in (rest, exact)
    )
    return made, rest.mean(axis=0), frames


def knowledge(rest_ratio: Float | None, names: str = "abcd") -> SkinKnowledge:
    wires = WireOhm(100.0, 200.0, 0.0)
    return SkinKnowledge(
        8, 8, adc_bits=10, rest_ratio=rest_ratio, nominal_wire_ohm=wires, reading_names=tuple(names)
    )


def of_region(frame: Float, rows: slice, columns: slice, read: tuple[int, ...]) -> Float:
    some = np.full_like(frame, np.nan)
    some[rows, columns, read] = frame[rows, columns, read]
    return some


@pytest.mark.parametrize("method", ["joint", "touch"])
@pytest.mark.parametrize("scene", list(TRIALS))
def test_one_reading_of_each_cell_errs_by_twice_as_much_at_most(scene: str, method: str) -> None:
    medians, converged = {}, []
    for mode, read in READ.items():
        parts = []
        for seed in range(2, 7):
            made, rest, frames = trial(scene, seed)
            estimator = make_estimator(method, knowledge(rest))
            every = slice(None)
            found = [estimator.estimate(of_region(each, every, every, read)) for each in frames]
            converged += [one.converged for one in found]
            parts.append(judge(answers_of(found), made.cell_siemens, made.rest.cell_siemens))
        judged = pooled(parts)
        assert judged.pressed_within_percent() > 98
        medians[mode] = judged.error_percent()
    assert np.mean(converged) > 0.99
    # Were there nothing but independent noise, by the roots of 2 and of 4.
    assert medians["half"] < 1.15 * 2**0.5 * medians["near"]
    assert medians["quick"] < 1.15 * 2.0 * medians["near"]


@pytest.mark.parametrize("names", ["ab", "b", "ba"])
def test_a_file_has_what_was_read(names: str, tmp_path: Path) -> None:
    """All of it, rest as well, has the same few readings; the same with the others not a number."""
    _, rest, frames = trial("touches")
    read = ["abcd".index(name) for name in names]
    np.savez(
        tmp_path / "some.npz",
        ratio=frames[..., read],
        rest_ratio=rest[..., read],
        reading_names=np.array(list(names)),
        adc_bits=10,
        nominal_top_wire_ohm=100.0,
        nominal_bottom_wire_ohm=200.0,
        nominal_lead_ohm=0.0,
    )
    found = estimate_file(load_readings(tmp_path / "some.npz"), "joint")["cell_siemens"]
    every = slice(None)
    estimator = make_estimator("joint", knowledge(of_region(rest, every, every, tuple(read))))
    for frame, cells in zip(frames, found, strict=True):
        again = estimator.estimate(of_region(frame, every, every, tuple(read)))
        np.testing.assert_array_equal(again.cell_siemens, cells)


def test_a_file_has_four_readings_in_any_order(tmp_path: Path) -> None:
    """They were taken for a b c d, in silence: two were, and are, read by their names."""
    _, rest, frames = trial("touches")
    np.savez(tmp_path / "sound.npz", ratio=frames, rest_ratio=rest)
    read = [3, 2, 0, 1]
    some = {"ratio": frames[..., read], "rest_ratio": rest[..., read]}
    np.savez(tmp_path / "other.npz", **some, reading_names=["d", "c", "a", "b"])
    sound, other = (load_readings(tmp_path / f"{name}.npz") for name in ("sound", "other"))
    found = [estimate_file(readings, "joint")["cell_siemens"] for readings in (sound, other)]
    np.testing.assert_array_equal(*found)
    with pytest.raises(ValueError, match="four near ends come as a b c d, not d c a b"):
        make_estimator("joint", knowledge(rest)).estimate(frames[0], tuple("dcab"))


def test_a_region_is_read_as_well_as_the_whole() -> None:
    """A finger that stays: only the 5x5 cells around it are read after the first scan."""
    made, rest, frames = trial("finger")
    row, column = np.unravel_index(made.cell_siemens[0].argmax(), (8, 8))
    rows, columns = slice(max(row - 2, 0), row + 3), slice(max(column - 2, 0), column + 3)
    estimator = make_estimator("joint", knowledge(rest))
    whole = estimator.estimate(frames[0])
    for _ in range(5):
        again = estimator.estimate(of_region(frames[0], rows, columns, READ["near"]))
    inside = np.zeros((8, 8), dtype=bool)
    inside[rows, columns] = True
    np.testing.assert_allclose(
        again.cell_siemens[inside], whole.cell_siemens[inside], rtol=0.05, atol=1e-6
    )
    off_by = np.abs(again.cell_siemens - made.cell_siemens[0])
    assert (off_by < STATED_STDS * again.cell_siemens_std).all()


@pytest.mark.parametrize("method", ["joint", "touch"])
def test_a_region_follows_a_finger_and_touches_in_it(method: str) -> None:
    """After one whole scan, a finger's cells become harder, softer, and one of them lets go."""
    made, rest, _ = trial("finger")
    circuit, at_rest = SkinCircuit(made.rest), made.rest.cell_siemens
    random, before = np.random.default_rng(3), made.cell_siemens[0]
    row, column = np.unravel_index(before.argmax(), (8, 8))
    region = np.ix_(*(range(max(n - 2, 0), min(n + 3, 8)) for n in (row, column)))
    estimator = make_estimator(method, knowledge(rest))
    errors, stds = [], []
    for number in range(12):
        cells = before.copy()
        if number:
            cells[region] = (
                at_rest[region]
                + random.uniform(0.3, 2, cells[region].shape) * (before - at_rest)[region]
            )
            cells[row, column] = at_rest[row, column]
        exact = circuit.readings(cells)[..., :4]
        ratio = ratio_from_codes(
            quantise(exact + NOISE_RATIO * random.standard_normal(exact.shape))
        )
        some = np.full_like(ratio, np.nan)
        some[region] = ratio[region]
        found = estimator.estimate(some if number else ratio)
        assert found.converged
        if number:
            errors.append((found.cell_siemens - cells)[region])
            stds.append(found.cell_siemens_std[region])
    assert (np.abs(errors) < STATED_STDS * np.array(stds)).mean() > 0.98
    # Cells of a finger have up to hundreds of microsiemens.
    assert np.median(np.abs(errors)) < 0.02 * before.max()


def test_ports_that_are_not_read_become_less_certain() -> None:
    _, rest, frames = trial("touches")
    reader = PortReader(knowledge(rest))
    whole = reader.read(frames[3], in_order=True)
    some = of_region(frames[3], slice(0, 3), slice(0, 3), READ["quick"])
    first, second = (reader.read(some, in_order=True) for _ in range(2))
    outside = np.ones((8, 8), dtype=bool)
    outside[:3, :3] = False
    np.testing.assert_array_equal(second.current[outside], whole.current[outside])
    assert (whole.current_std < first.current_std)[outside].all()
    assert (first.current_std < second.current_std)[outside].all()
    read_again = reader.read(frames[3], in_order=True)
    np.testing.assert_allclose(read_again.current_std, whole.current_std)


@pytest.mark.parametrize("method", ["joint", "touch"])
def test_a_region_after_a_frame_without_noise_has_an_answer(method: str) -> None:
    """Its readings agree in most cells, and then it does not show how much noise there is."""
    skin = skin_at_rest(8, 8, np.random.default_rng(3))
    skin = replace(skin, cell_siemens=np.full((8, 8), 1e-6))
    frame = ratio_from_codes(quantise(SkinCircuit(skin).readings(skin.cell_siemens)[..., :4]))
    estimator = make_estimator(method, knowledge(None))
    estimator.estimate(frame)
    found = estimator.estimate(of_region(frame, slice(2, 5), slice(2, 5), READ["quick"]))
    assert np.isfinite(found.cell_siemens).all()
    assert np.isfinite(found.cell_siemens_std[2:5, 2:5]).all()


def test_offsets_that_whole_scans_have_shown_are_taken_from_one_reading() -> None:
    _, rest, frames = trial("touches")
    offset = 3.0 / 1024 * np.array([0.5, -1.0, -1.0, 0.5])  # of the nodes of a, d and of b, c
    reader, exact = PortReader(knowledge(rest)), PortReader(knowledge(rest))
    shifted = [np.clip(frame + offset, 0, 1) for frame in frames[:2]]
    reader.read(shifted[0], in_order=True)
    quick = of_region(shifted[1], slice(None), slice(None), READ["quick"])
    true = exact.read(frames[1], in_order=True).current
    found = reader.read(quick, in_order=True)
    assert (np.abs(found.current - true) < 4 * found.current_std).mean() > 0.98
    reader.reset()
    never_shown = reader.read(quick, in_order=True)
    assert np.median(np.abs(never_shown.current - true)) > 3 * np.median(
        np.abs(found.current - true)
    )


@pytest.mark.parametrize(
    "method", sorted({*METHODS, "voltage"} - {"joint", "touch", "matrix", "ohm"})
)
def test_methods_that_need_all_readings_say_so(method: str) -> None:
    ratio = np.full((2, 2, 4), 0.5)
    ratio[..., 2:] = np.nan
    estimator = make_estimator(method, SkinKnowledge(2, 2))
    with pytest.raises(ValueError, match=f"'{method}' takes whole scans of a b c d: use 'joint'"):
        estimator.estimate(ratio)


def test_a_file_is_refused_before_the_first_frame_takes_minutes() -> None:
    _, rest, frames = trial("touches")
    every = slice(None)
    ratio = np.stack([frames[0], of_region(frames[1], every, every, READ["half"])])
    with pytest.raises(ValueError, match="'lsq' takes whole scans"):
        estimate_file(Readings(ratio, rest), "lsq", watch=lambda _: pytest.fail("estimated"))


def test_a_frame_may_have_fewer_readings_than_the_skin() -> None:
    _, rest, frames = trial("touches")
    estimators = [make_estimator("joint", knowledge(rest)) for _ in range(2)]
    every = slice(None)
    named = estimators[0].estimate(frames[2][..., [1]], ("b",))
    padded = estimators[1].estimate(of_region(frames[2], every, every, (1,)))
    np.testing.assert_array_equal(named.cell_siemens, padded.cell_siemens)
    with pytest.raises(ValueError, match=r"these readings are .* this skin"):
        estimators[0].estimate(frames[2], ("a", "e", "b", "f"))


def test_what_no_board_leaves_out_is_refused() -> None:
    """A hole amid what was read; nothing at all; rest of some cells only."""
    _, rest, frames = trial("touches")
    estimator = make_estimator("joint", knowledge(rest))
    hole = of_region(frames[0], slice(1, 6), slice(1, 6), READ["half"])
    hole[3, 4, 1] = np.nan
    with pytest.raises(ValueError, match=r"of cell \(3, 4\), reading B, is nan, not in 0..1"):
        estimator.estimate(hole)
    with pytest.raises(ValueError, match=r"of cell \(0, 0\), reading A, is nan, not in 0..1"):
        estimator.estimate(np.full((8, 8, 4), np.nan))
    with pytest.raises(ValueError, match="rest_ratio has cells without any reading"):
        knowledge(of_region(rest, slice(1, 6), slice(1, 6), READ["near"]))
    far = make_estimator("joint", SkinKnowledge(8, 8, reading_names=("a", "e", "b", "f")))
    with pytest.raises(ValueError, match=r"reading E, is nan: .* leave other modes out"):
        far.estimate(of_region(frames[0], slice(None), slice(None), (0, 2)))


def test_two_readings_of_a_cell_are_worth_the_mean_of_two() -> None:
    """Where nothing but noise makes them differ, as on lines that settle at once."""
    made, rest, _ = trial("touches")
    random = np.random.default_rng(8)
    exact = np.repeat(made.readings.ratio[:1], 60, axis=0)
    frames = ratio_from_codes(quantise(exact + NOISE_RATIO * random.standard_normal(exact.shape)))
    reader, every = PortReader(knowledge(rest)), slice(None)
    reader.read(frames[0], in_order=True)
    read = [reader.read(of_region(each, every, every, READ["half"])) for each in frames]
    a, b = np.moveaxis(frames[..., :2], -1, 0)
    of_two = (1.0 - a + b) / (2 * knowledge(rest).ref_top_ohm)
    found = np.array([ports.current for ports in read])
    assert found.std(axis=0).mean() < 1.05 * of_two.std(axis=0).mean()
    assert found.std(axis=0).mean() < 1.3 * np.mean([ports.current_std for ports in read])


def read_with(siemens: float, row: int, column: int) -> tuple[SkinKnowledge, Float]:
    """What is known of a skin, and a frame of it with this cell [S] and all others at rest."""
    made, rest, _ = trial("touches")
    cells = made.rest.cell_siemens.copy()
    cells[row, column] = siemens
    return knowledge(rest), ratio_from_codes(
        quantise(SkinCircuit(made.rest).readings(cells)[..., :4])
    )


@pytest.mark.parametrize("siemens", [5e-5, 2e-4, 6e-4])
def test_a_touch_that_arrives_in_a_region_is_as_uncertain_as_in_a_whole_frame(
    siemens: float,
) -> None:
    (known, frame), (_, at_rest) = read_with(siemens, 3, 5), read_with(1e-6, 3, 5)
    whole = make_estimator("joint", known).estimate(frame)
    estimator = make_estimator("joint", known)
    estimator.estimate(at_rest)
    for _ in range(3):
        part = estimator.estimate(of_region(frame, slice(2, 5), slice(4, 7), READ["near"]))
        assert part.converged, part.message
        assert part.cell_siemens[3, 5] == pytest.approx(siemens, rel=0.2)
        assert 0.7 < part.cell_siemens_std[3, 5] / whole.cell_siemens_std[3, 5] < 1.5


@pytest.mark.parametrize("touches", [(2e-5, 2e-5), (2e-5, 1e-4)], ids=["still", "changing"])
def test_cells_outside_a_region_age_however_touches_in_it_change(
    touches: tuple[float, float],
) -> None:
    """By a share a frame, as ports do that are not read."""
    frames = [read_with(siemens, 3, 5)[1] for siemens in touches]
    estimator = make_estimator("joint", read_with(touches[0], 3, 5)[0])
    estimator.estimate(frames[0])
    for number in range(12):
        part = of_region(frames[number % 2], slice(2, 5), slice(4, 7), READ["near"])
        found = estimator.estimate(part)
    outside = (found.cell_siemens_std / found.cell_siemens)[6:, :3]
    assert (outside > 0.9 * 12 * STALE_SHARE).all()
    assert (outside < 1.1 * 12 * STALE_SHARE).all()


@pytest.mark.parametrize("read", ["half", "quick"])
@pytest.mark.parametrize("method", ["joint", "touch"])
def test_where_a_region_does_not_explain_what_it_reads_the_other_cells_stay(
    method: str, read: str
) -> None:
    """A finger goes round the skin, and only the cells in the middle are read. Cells elsewhere were
    called untouched, and certain, because the prior alone was left to speak of them."""
    _, rest, frames = trial("finger")
    estimator = make_estimator(method, knowledge(rest))
    before, middle = estimator.estimate(frames[0]), slice(2, 6)
    outside = np.ones((8, 8), dtype=bool)
    outside[middle, middle] = False
    messages = set()
    for frame in frames[1:]:
        found = estimator.estimate(of_region(frame, middle, middle, READ[read]))
        messages.add(found.message)
        for name in ("cell_siemens", "cell_siemens_std"):
            ratio = (getattr(found, name) / getattr(before, name))[outside]
            assert (ratio > 0.999).all()
            assert (ratio < 1.001).all() or name == "cell_siemens_std"
        before = found
    assert messages == {"", BEYOND_REGION}


def test_cells_that_have_left_a_region_stay_as_it_has_read_them() -> None:
    """They became again what the last whole frame had shown."""
    known, soft = read_with(2e-5, 3, 5)
    hard = read_with(1e-4, 3, 5)[1]
    estimator = make_estimator("joint", known)
    estimator.estimate(soft)
    for _ in range(5):
        near = estimator.estimate(of_region(hard, slice(2, 5), slice(4, 7), READ["near"]))
    away = estimator.estimate(of_region(hard, slice(5, 8), slice(0, 3), READ["near"]))
    assert away.cell_siemens[3, 5] == pytest.approx(near.cell_siemens[3, 5])
    assert away.cell_siemens_std[3, 5] > near.cell_siemens_std[3, 5]


def test_what_cells_outside_may_have_become_makes_a_region_less_certain() -> None:
    """Half of a fingertip is read, again and again; the other half may press as it likes."""
    made, rest, frames = trial("finger")
    row, column = np.unravel_index(made.cell_siemens[0].argmax(), (8, 8))
    rows, columns = slice(max(row - 2, 0), row + 1), slice(max(column - 2, 0), column + 3)
    estimator = make_estimator("joint", knowledge(rest))
    estimator.estimate(frames[0])
    part = of_region(frames[0], rows, columns, READ["near"])
    stds = [estimator.estimate(part).cell_siemens_std[row, column] for _ in range(25)]
    assert stds[-1] > 1.2 * stds[0]


def test_what_a_whole_frame_cannot_be_relied_on_for_no_region_is() -> None:
    """A cell that conducts more than any touch, then frames of another region."""
    known, frame = read_with(1 / 20, 5, 5)
    estimator = make_estimator("joint", known)
    assert not estimator.estimate(frame).converged
    part = estimator.estimate(of_region(frame, slice(0, 3), slice(0, 3), READ["near"]))
    assert not part.converged


def test_cells_outside_a_region_keep_all_of_their_uncertainty() -> None:
    known, frame = read_with(1 / 1500, 6, 6)
    estimator = make_estimator("joint", known)
    whole = estimator.estimate(frame)
    part = estimator.estimate(of_region(frame, slice(0, 3), slice(0, 3), READ["near"]))
    assert part.cell_siemens_std[6, 6] >= whole.cell_siemens_std[6, 6]


def test_wires_that_nobody_told_make_cells_outside_a_region_no_more_uncertain() -> None:
    """The whole frame has taught something of the wires, which counts for these cells as well."""
    trial = random_trial(8, 8, 2, 8, seed=2)
    given = trial.rounded(10, wires_told=False)
    for ratio, pressed in zip(given.ratio, trial.pressed, strict=True):
        estimator = make_estimator("joint", given.knowledge(0))
        whole = estimator.estimate(ratio).cell_siemens_std[pressed]
        part = ratio.copy()
        part[pressed.any(axis=1)] = np.nan
        outside = estimator.estimate(part).cell_siemens_std[pressed]
        assert (0.2 * whole < outside).all()
        assert (outside < 1.2 * whole).all()


def charged(ratio: Float, random: np.random.Generator) -> Float:
    """Readings (F, R, C, 4) with lines that charge: a little at each cell, by 2 LSB on average.

    Row and column draw what the other cells of these lines conduct to them. A and C are read while
    it is all there, B and D when a tenth of it is left.
    """
    current = 1.0 - ratio[..., 0]  # times the reference
    by_row, by_column = (current.sum(axis=axis, keepdims=True) - current for axis in (2, 1))
    drawn = random.normal(2.0, 2.0, current.shape) / 1024
    row, column = drawn * by_row / (by_row + by_column), drawn * by_column / (by_row + by_column)
    return ratio + np.stack([-row, -0.1 * column, column, 0.1 * row], axis=-1)


@pytest.mark.parametrize("lines_charge", [False, True])
def test_whole_scans_show_offsets_however_lines_charge(lines_charge: bool) -> None:
    made, rest, _ = trial("touches")
    random, offset = np.random.default_rng(4), np.array([2.0, -1.0, -1.0, 2.0]) / 1024
    exact = np.repeat(made.readings.ratio[6:7], 40, axis=0)
    ratio = (charged(exact, random) if lines_charge else exact) + offset
    ratio = ratio_from_codes(quantise(ratio + NOISE_RATIO * random.standard_normal(ratio.shape)))
    reader, every = PortReader(knowledge(rest)), slice(None)
    errors = []
    for whole in ratio:
        reader.read(whole, in_order=True)
        quick = ratio_from_codes(
            quantise(exact[0] + offset + NOISE_RATIO * random.standard_normal(exact[0].shape))
        )
        found = reader.read(of_region(quick, every, every, READ["quick"]), in_order=True)
        errors.append(found.current * made.rest.ref_bottom_ohm - exact[0, ..., 1])
    assert abs(np.mean(errors)) * 1024 < 0.15


def test_whole_scans_show_noise() -> None:
    """Rest, a mean, shows none."""
    made, _, _ = trial("finger")
    random, noise = np.random.default_rng(4), 0.8 / 1024

    def read(exact: Float) -> Float:
        return ratio_from_codes(quantise(exact + noise * random.standard_normal(exact.shape)))

    at_rest = made.readings.rest_ratio
    assert at_rest is not None
    rest = read(np.repeat(at_rest[None], 50, axis=0)).mean(axis=0)
    reader, every, errors = PortReader(knowledge(rest)), slice(None), []
    for exact in np.repeat(made.readings.ratio, 3, axis=0):
        reader.read(read(exact), in_order=True)
        found = reader.read(of_region(read(exact), every, every, READ["quick"]), in_order=True)
        current = exact[..., 1] / made.rest.ref_bottom_ohm
        errors.append((found.current - current) / found.current_std)
    hard = made.readings.ratio.repeat(3, axis=0)[20:, ..., 1] > 0.25
    assert abs(np.mean(np.array(errors)[20:][hard])) < 0.3
    assert 0.85 < np.std(errors[20:]) < 1.15


def a_board(
    current: Float,
    random: np.random.Generator,
    noise_lsb: float = 0.8,
    offset_lsb: tuple[float, float] = (0.0, 0.0),
) -> Float:
    """All readings of currents (R, C), times a reference; offsets: of row and column."""
    ratio = np.stack([1.0 - current, current, 1.0 - current, current], axis=-1)
    row, column = offset_lsb
    ratio += np.array([row, column, column, row]) / 1024
    ratio += noise_lsb / 1024 * random.standard_normal(ratio.shape)
    return ratio_from_codes(quantise(np.clip(ratio, 0.0, 1.0)))


def quick_of(frame: Float) -> Float:
    return of_region(frame, slice(None), slice(None), READ["quick"])


def pressed(random: np.random.Generator) -> tuple[Float, Float]:
    """Currents of a skin at rest, and with four cells pressed hard, times a reference."""
    rest = np.exp(random.normal(-3.5, 0.5, (8, 8))).clip(0.0, 0.3)
    touched = rest.copy()
    touched[2:4, 2:4] = 0.4
    return rest, touched


@pytest.mark.parametrize("mode", ["half", "quick"])
@pytest.mark.parametrize("size", [(1, 1), (2, 2), (1, 8), (8, 8)])
def test_deviations_of_noise_are_stated_on_skins_of_any_size(
    size: tuple[int, int], mode: str
) -> None:
    """Few cells hardly show noise and offsets: both are fitted to the cells that show them."""
    random, errors = np.random.default_rng(9), []
    for _ in range(40 if np.prod(size) < 64 else 5):
        current = np.exp(random.normal(-3.0, 0.7, size)).clip(0.0, 0.45)
        rest = np.mean([a_board(0.3 * current, random) for _ in range(30)], axis=0)
        reader = PortReader(SkinKnowledge(*size, adc_bits=10, rest_ratio=rest))
        for number in range(30):
            reader.read(a_board(current, random), in_order=True)
            frame = np.full((*size, 4), np.nan)
            frame[..., READ[mode]] = a_board(current, random)[..., READ[mode]]
            found = reader.read(frame, in_order=True)
            if number >= 5:
                errors.append((found.current - current / 3e4) / found.current_std)
    assert 0.8 < np.std(errors) < 1.3


@pytest.mark.parametrize("rest_is_known", [True, False])
def test_a_reader_that_was_reset_answers_as_a_fresh_one(rest_is_known: bool) -> None:
    """After frames of a board with noise and offsets."""
    random = np.random.default_rng(10)
    rest, touched = pressed(random)
    known = knowledge(a_board(rest, random) if rest_is_known else None)
    used, fresh = PortReader(known), PortReader(known)
    for _ in range(20):
        for read in (READ["near"], READ["half"], READ["quick"]):
            frame = a_board(touched, random, 3.0, (4.0, -4.0))
            used.read(of_region(frame, slice(None), slice(None), read), in_order=True)
    used.reset()
    for mode in ("quick", "half", "near", "quick", "half"):
        frame = of_region(a_board(touched, random), slice(None), slice(None), READ[mode])
        again, first = (reader.read(frame, in_order=True) for reader in (used, fresh))
        np.testing.assert_array_equal(again.current, first.current, err_msg=mode)
        np.testing.assert_array_equal(again.current_std, first.current_std, err_msg=mode)


def test_rows_that_draw_more_are_corrected_by_more() -> None:
    """Of a difference d of A and B, A has d (0.84 + 0.25 share), and B lacks the remainder.

    Cells of the first row, and those of the first column, conduct. So the other lines are at the
    potential of that row, or of that column, and draw from it.
    """
    random = np.random.default_rng(11)
    skin = skin_at_rest(8, 8, random)
    cells = np.full((8, 8), 1e-6)
    cells[0, 2:] = cells[2:, 0] = 5e-5
    skin = replace(skin, cell_siemens=cells)
    current = SkinCircuit(skin).readings(cells)[..., 1]
    rest = np.mean([a_board(current, random) for _ in range(30)], axis=0)
    reader = PortReader(knowledge(rest))
    for _ in range(10):
        reader.read(a_board(current, random), in_order=True)
        reader.read(quick_of(a_board(current, random)), in_order=True)
    share = floating_share(skin)
    difference = 10.0 / 1024
    excess = difference * (0.84 + 0.25 * share)
    ratio = np.full((8, 8, 4), np.nan)
    ratio[..., 0] = 1.0 - current - excess
    ratio[..., 1] = current - (difference - excess)
    found = reader.read(ratio, in_order=True)
    off_by = 1024 * (3e4 * found.current - current)
    # With the same share everywhere, they would be off by 2.5 LSB times the share.
    assert share[0, 1] > 0.5
    assert share[1, 0] < -0.5
    assert np.abs(off_by).max() < 0.5


def test_an_offset_that_no_board_has_is_not_taken_from_one_reading() -> None:
    """By 12 LSB, alike in all cells: only the part is believed that a converter may have."""
    random = np.random.default_rng(12)
    rest, touched = pressed(random)
    reader = PortReader(knowledge(a_board(rest, random)))
    for _ in range(5):
        reader.read(a_board(touched, random, offset_lsb=(12.0, 12.0)), in_order=True)
        found = reader.read(quick_of(a_board(touched, random)), in_order=True)
    off_by = 1024 * (3e4 * found.current - touched)
    assert np.median(off_by) == pytest.approx(-1024 * MOST_OFFSET_RATIO, abs=0.7)


def test_a_line_that_hangs_teaches_nothing_of_the_board() -> None:
    """Its node reads 0.9 at either supply: its readings are off by most of the supply, one way."""
    random = np.random.default_rng(13)
    rest, touched = pressed(random)
    reader = PortReader(knowledge(a_board(rest, random)))
    errors = []
    for number in range(40):
        frame = a_board(touched, random)
        if number >= 10:
            frame[5, :, 0] = frame[5, :, 3] = 0.9
        reader.read(frame, in_order=True)
        found = reader.read(quick_of(a_board(touched, random)), in_order=True)
        if number >= 10:
            errors.append((3e4 * found.current - touched) / (3e4 * found.current_std))
    assert abs(np.mean(errors)) < 0.2
    assert abs(np.mean(np.array(errors)[:, 2:4, 2:4])) < 0.4
    assert 0.85 < np.std(errors) < 1.2


def test_a_rest_that_is_a_mean_teaches_no_noise() -> None:
    """A frame of one reading is asked for before the first whole one: rest stands in until then."""
    random = np.random.default_rng(14)
    rest, touched = pressed(random)
    reader = PortReader(knowledge(np.mean([a_board(rest, random) for _ in range(50)], axis=0)))
    reader.read(quick_of(a_board(touched, random)), in_order=True)
    errors = []
    for _ in range(3):
        reader.read(a_board(touched, random), in_order=True)
        found = reader.read(quick_of(a_board(touched, random)), in_order=True)
        errors.append((3e4 * found.current - touched) / (3e4 * found.current_std))
    assert 0.85 < np.std(errors) < 1.15


def test_a_reader_of_one_cell_that_was_reset_answers_as_a_fresh_one() -> None:
    """Noise of one cell is by what changes from frame to frame: not from before to after."""
    random, current = np.random.default_rng(15), np.full((1, 1), 0.2)
    used, fresh = (PortReader(SkinKnowledge(1, 1, adc_bits=10)) for _ in range(2))
    quick = np.array([np.nan, 0.2, np.nan, np.nan])[None, None]
    for _ in range(3):
        used.read(a_board(current, random, offset_lsb=(5.0, -5.0)), in_order=True)
        used.read(quick, in_order=True)
    used.reset()
    for _ in range(3):
        frame = a_board(current, random)
        for ratio in (frame, quick):
            again, first = (reader.read(ratio, in_order=True) for reader in (used, fresh))
            np.testing.assert_array_equal(again.current, first.current)
            np.testing.assert_array_equal(again.current_std, first.current_std)


def test_currents_of_one_reading_have_the_excess_of_whole_frames() -> None:
    """A sample capacitor moves readings of whole frames, rest as well, towards the other node."""
    random, excess = np.random.default_rng(16), 1.2 / 1024
    rest, touched = pressed(random)

    def whole(current: Float) -> Float:
        return a_board(current + excess * (1.0 - 2.0 * current), random)

    reader = PortReader(knowledge(np.mean([whole(rest) for _ in range(30)], axis=0)))
    off_by = []
    for _ in range(20):
        for frame in (whole(touched), *(quick_of(a_board(touched, random)) for _ in range(3))):
            found = reader.read(frame, in_order=True)
        off_by.append(1024 * (3e4 * found.current - touched) / (1.0 - 2.0 * touched))
    # As much as in whole frames, also where a cell is pressed, and from the second one on.
    assert np.mean(off_by[2:]) == pytest.approx(1024 * excess, abs=0.15)
    assert np.mean(np.array(off_by)[2:, 2:4, 2:4]) == pytest.approx(1024 * excess, abs=1.0)
    reader.reset()
    found = reader.read(quick_of(a_board(touched, random)), in_order=True)
    assert abs(np.median(1024 * (3e4 * found.current - touched))) < 0.4


@pytest.mark.parametrize("scene", list(TRIALS))
def test_a_skin_that_changes_around_whole_frames_shows_no_excess(scene: str) -> None:
    """Each whole frame is of another touch than the frame after it, and the frame before."""
    for seed in range(2, 5):
        made, rest, frames = trial(scene, seed)
        exact = made.readings.ratio[..., 1]
        reader, errors = PortReader(knowledge(rest)), []
        for number in range(42):
            before, whole, after = (frames[(number * step) % 14] for step in (3, 5, 1))
            reader.read(quick_of(before), in_order=True)
            reader.read(whole, in_order=True)
            found = reader.read(quick_of(after), in_order=True)
            error = 3e4 * found.current - exact[number % 14]
            errors.append(1024 * error / (1.0 - 2.0 * exact[number % 14]))
        assert abs(np.median(errors)) < 0.5
