# SPDX-License-Identifier: Apache-2.0
"""`ohmskin doctor` in mode far: wires of every line, and what is wrong with far ends.

Truths are those of ngspice (tests/data/far_harsh_8x8.npz), of the scene behind an emulated board
(its faults are checked against a node Laplacian in tests/emulate), and of the skin that the AVR
simulator reads.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_doctor import told

from calibrations import calibration
from command_line import Run, assert_one_line, well
from lockstep import Rig, elf_of
from ohmskin.arrays import Float
from ohmskin.circuit.skin import all_readings, end_admittance
from ohmskin.cli.doctor_words import named, verdict, words_of
from ohmskin.doctor.circuit import examine_circuit
from ohmskin.doctor.examine import examine
from ohmskin.doctor.far import examine_far, near_ends
from ohmskin.doctor.findings import WHOLE_SKIN, Diagnosis, Finding, Kind, LineWire, Severity
from ohmskin.doctor.signal import Rest
from ohmskin.emulate.driver import SteppedSkin
from ohmskin.emulate.scenes import LEAD_OHM
from ohmskin.emulate.simavr import PROGRAM
from ohmskin.emulate.urls import emulated
from ohmskin.estimate.knowledge import SkinKnowledge, WireOhm
from ohmskin.force.calibration import Calibration, load_calibration
from ohmskin.force.calibration import Rest as CalibratedRest
from ohmskin.link.codes import quantise
from ohmskin.link.protocol import MODES
from stepped import evidence, stepped

FAR = "emulator://8x8?mode=far&seed=1"
HARSH = Path(__file__).parents[1] / "data" / "far_harsh_8x8.npz"
WIRES = (0.2, 1.0, 10.0)  # times 100 and 200 ohm: from 20 ohm to 2 kOhm a segment


def of_lines(top_ohm: Float, bottom_ohm: Float) -> dict[str, Float]:
    """Segments of each line, from its near end."""
    rows = {f"row {i}": each for i, each in enumerate(top_ohm)}
    return rows | {f"column {j}": each for j, each in enumerate(bottom_ohm.T)}


def errors_of(lines: list[LineWire], truth: dict[str, Float]) -> tuple[Float, Float, Float]:
    """Shares by which lines are off, the same in deviations, and segments in deviations."""
    share, in_std, segments = [], [], []
    for line in lines:
        exact_ohm = truth[named(line.place)]
        off_ohm = line.ohm - exact_ohm.sum()
        share.append(off_ohm / exact_ohm.sum())
        in_std.append(off_ohm / line.std_ohm)
        segments.append((np.array(line.segment_ohm) - exact_ohm) / line.segment_std_ohm)
    return np.array(share), np.array(in_std), np.concatenate(segments)


def diagnosis_of(ratio: Float, noise_lsb: float, lead_ohm: float, scans: int = 225) -> Diagnosis:
    """What the means of so many noisy scans of mode far show, readings (R, C, 4)."""
    random = np.random.default_rng(1)
    noisy = ratio + noise_lsb / 1024 * random.standard_normal((scans, *ratio.shape))
    codes = quantise(np.clip(noisy, 0, 1)).mean(axis=0)
    rows, columns = ratio.shape[:2]
    masks = {"row_mask": (1 << rows) - 1, "column_mask": (1 << columns) - 1}
    board = replace(stepped(FAR).info, rows=rows, columns=columns, **masks)
    seen_lsb = float(np.hypot(noise_lsb, 12**-0.5))
    told = WireOhm(lead=lead_ohm)
    rest, diagnosis = Rest(board, codes, scans, seen_lsb, told=told), Diagnosis()
    examine_far(rest, examine_circuit(near_ends(rest), diagnosis), diagnosis)
    return diagnosis


# ------------------------------------------------------------------------------- sound skins


@pytest.mark.parametrize("wires", WIRES)
@pytest.mark.parametrize("noise", [0, 0.3, 0.5])
def test_no_sound_skin_has_a_finding_and_lines_are_as_stated(wires: float, noise: float) -> None:
    """In all, 72 skins of six sizes; of every other one, the leads are told."""
    in_std = []
    for seed, size in enumerate(("8x8", "8x8", "8x8", "4x12", "3x3", "2x2", "1x1", "16x1")):
        url = f"emulator://{size}?mode=far&seed={seed}&wires={wires}&noise={noise}"
        leads = WireOhm(lead=None if seed % 2 else LEAD_OHM)
        diagnosis, skin = examine(evidence(url, told=leads)), emulated(url)[1].skin(0.0)
        assert diagnosis.findings == [], url
        of_two = " (two rows and two columns hardly show shorts and exchanged ends)"
        assert verdict(diagnosis) == f"sound: nothing is wrong{of_two if size == '2x2' else ''}"
        assert len(diagnosis.lines) == sum(skin.shape)
        truth = of_lines(skin.top_wire_ohm, skin.bottom_wire_ohm)
        off, deviations, _ = errors_of(diagnosis.lines, truth)
        in_std += deviations.tolist()
        if size == "8x8" and wires >= 1:
            least = 0.1 if seed % 2 else 0.04
            assert np.median(np.abs(off)) < (least if noise else 0.1)
    assert np.abs(in_std).max() < 4
    assert np.sqrt(np.mean(np.square(in_std))) < 1.2


def test_lines_against_ngspice() -> None:
    """1 and 2 kOhm a segment, untouched and touched, with the noise of a sound converter."""
    data = np.load(HARSH)
    names = data["reading_names"].tolist()
    far = [names.index(name) for name in "aebf"]
    shares = []
    for k, ratio in [(0, data["rest_ratio"]), *enumerate(data["ratio"])]:
        diagnosis = diagnosis_of(ratio[..., far], 0.3, 0.0)
        assert [each for each in diagnosis.findings if each.kind is not Kind.TOUCHED] == []
        truth = of_lines(data["top_wire_ohm"][k], data["bottom_wire_ohm"][k])
        off, in_std, of_segments = errors_of(diagnosis.lines, truth)
        assert len(off) == 16
        assert max(np.abs(in_std).max(), np.abs(of_segments).max()) < 3
        shares += np.abs(off).tolist()
    assert np.median(shares) < 0.02
    assert max(shares) < 0.05


def test_touches_show_segments() -> None:
    """Four touches on row 1: segments are known between them, and at rest they are not."""
    skin = emulated("emulator://3x4?seed=2")[1].skin(0.0)
    top_ohm = skin.top_wire_ohm.copy()
    top_ohm[1] = 90, 110, 140, 70
    cells = skin.cell_siemens.copy()
    untouched = replace(skin, top_wire_ohm=top_ohm)
    cells[1] = 1 / 5e3
    stds = []
    for each in (replace(untouched, cell_siemens=cells), untouched):
        ratio = all_readings(each, end_admittance(each))[..., [0, 4, 1, 5]]
        line = diagnosis_of(ratio, 0.4, LEAD_OHM).lines[1]
        assert np.all(
            np.abs(np.subtract(line.segment_ohm, top_ohm[1])) < 3.5 * np.array(line.segment_std_ohm)
        )
        stds.append(np.array(line.segment_std_ohm))
    assert np.all(stds[0] < 12)
    assert np.all(stds[1] > 12)


@pytest.mark.simavr
@pytest.mark.skipif(not (PROGRAM.is_file() and elf_of("uno").is_file()), reason="make firmware sim")
@pytest.mark.parametrize("far_open", [0, 1])
def test_the_firmware_on_a_desk(far_open: int) -> None:
    """As built, in the simulator, with the converter's errors and all capacitances; and the same
    without far multiplexers: then all far ends are open.
    """
    skin = emulated("emulator://8x8?seed=3")[1].skin(0.0)
    admittance = end_admittance(skin)
    with Rig("uno") as rig:
        rig.sim.set_table(all_readings(skin, admittance.copy()))
        rig.sim.set(desk=1, far_open=far_open)
        rig.sim.request("C", bytes([0x80 | 8]) + admittance.tobytes())
        rig.run(0.05)
        rig.start_scan(mode="far", settle_us=300, rate_mhz=0)
        rig.run(3.0)
        codes = np.array([scan.codes for scan in rig.scans[2:]], dtype=float)
    board = stepped(FAR).info
    noise_lsb = float(np.sqrt(np.mean(np.diff(codes, axis=0) ** 2) / 2))
    rest, diagnosis = Rest(board, codes.mean(0), len(codes), noise_lsb), Diagnosis()
    examine_far(rest, examine_circuit(near_ends(rest), diagnosis), diagnosis)
    if far_open:
        assert [each.kind for each in diagnosis.findings] == [Kind.OPEN_FAR, Kind.OPEN_FAR]
        assert diagnosis.lines == []
        return
    assert diagnosis.findings == []
    truth = of_lines(skin.top_wire_ohm, skin.bottom_wire_ohm)
    off, in_std, _ = errors_of(diagnosis.lines, truth)
    assert np.median(np.abs(off)) < 0.05
    assert np.abs(in_std).max() < 4


# ------------------------------------------------------------------------------------ faults


FOUND = {
    "open_far_row=5": ("open_far", "far end of row 5"),
    "open_far_row=0": ("open_far", "far end of row 0"),
    "open_far_column=4": ("open_far", "far end of column 4"),
    "swap_far_rows=2,3": ("swapped_far", "far ends of rows 2, 3"),
    "swap_far_columns=0,7": ("swapped_far", "far ends of columns 0, 7"),
    "short_far_rows=2,3": ("short_far", "far ends of rows 2 and 3"),
    "short_far_columns=0,7": ("short_far", "far ends of columns 0 and 7"),
    "short_rows=2,3": ("short_rows", "rows 2 and 3"),
    "short_columns=0,7": ("short_columns", "columns 0 and 7"),
    "broken_row=4,3": ("broken_yarn", "row 4, between columns 2 and 3"),
    "broken_row=4,7": ("broken_yarn", "row 4, between columns 6 and 7"),
    "broken_column=1,5": ("broken_yarn", "column 5, between rows 0 and 1"),
    "crimp_row=1": ("bad_crimp", "row 1, near end"),
    "crimp_column=6&crimp_ohm=900": ("bad_crimp", "column 6, near end"),
    "open_row=3": ("open_row", "row 3"),
    "dead=1,2": ("dead_cell", "cell (1, 2)"),
    "saturated=1,2": ("saturated_cell", "cell (1, 2)"),
    "ref_top=36000": ("reference_ratio", "reference resistors"),
}


@pytest.mark.parametrize("fault", FOUND)
def test_every_fault_is_named_and_no_other(fault: str) -> None:
    for seed, noise in ((1, 0.3), (2, 0.5)):
        assert told(f"emulator://8x8?mode=far&seed={seed}&noise={noise}&{fault}") == [FOUND[fault]]


@pytest.mark.parametrize("wires", WIRES)
def test_far_ends_are_judged_with_all_wires(wires: float) -> None:
    for fault in ("open_far_row=5", "open_far_column=4", "swap_far_rows=2,3", "broken_row=4,3"):
        assert told(f"{FAR}&wires={wires}&noise=0.4&{fault}") == [FOUND[fault]]


@pytest.mark.parametrize(
    ("size", "fault"), [("2x2", "row=0"), ("2x8", "row=0"), ("8x2", "column=1")]
)
def test_an_open_far_end_is_named_where_a_layer_has_two_lines(size: str, fault: str) -> None:
    """Nobody can say which of the two leads is the usual one."""
    found = ("open_far", f"far end of {fault.replace('=', ' ')}")
    assert told(f"emulator://{size}?mode=far&open_far_{fault}") == [found]


def test_several_faults_are_named_at_once() -> None:
    ends = "swap_far_rows=1,2&open_far_column=5"
    assert sorted(told(f"{FAR}&{ends}&broken_row=6,3&crimp_column=2&dead=0,0")) == [
        ("bad_crimp", "column 2, near end"),
        ("broken_yarn", "row 6, between columns 2 and 3"),
        ("dead_cell", "cell (0, 0)"),
        ("open_far", "far end of column 5"),
        ("swapped_far", "far ends of rows 1, 2"),
    ]


def test_two_broken_lines_that_cross_are_both_named() -> None:
    """Cell (4, 5) is beyond both breaks."""
    assert told(f"{FAR}&broken_row=4,3&broken_column=1,5") == [
        ("broken_yarn", "row 4, between columns 2 and 3"),
        ("broken_yarn", "column 5, between rows 0 and 1"),
    ]


def test_a_crimp_is_measured_and_counts_in_its_line() -> None:
    sound_ohm = examine(evidence(FAR)).lines[1].ohm
    for ohm in (400, 1500):
        diagnosis = examine(evidence(f"{FAR}&crimp_row=1&crimp_ohm={ohm}"))
        [finding] = diagnosis.findings
        assert finding.kind.severity is Severity.WARNING
        more_ohm, std_ohm = finding.values["more_ohm"], finding.values["std_ohm"]
        assert abs(more_ohm - ohm) < 3 * std_ohm < 0.5 * ohm
        line = diagnosis.lines[1]
        assert abs(line.ohm - sound_ohm - ohm) < 3 * line.std_ohm


def test_a_bad_segment_and_an_odd_line_are_told_apart() -> None:
    sound = emulated("emulator://8x8?seed=5")[1].skin(0.0)
    worn = [100, 100, 100, 100, 1500, 100, 100, 100]
    for segments, kind in ((worn, Kind.BAD_SEGMENT), (250, Kind.LINE_WIRE)):
        top_ohm = sound.top_wire_ohm.copy()
        top_ohm[2] = segments
        skin = replace(sound, top_wire_ohm=top_ohm)
        ratio = all_readings(skin, end_admittance(skin))[..., [0, 4, 1, 5]]
        diagnosis = diagnosis_of(ratio, 0.4, LEAD_OHM)
        [finding] = diagnosis.findings
        assert (finding.kind, finding.place.rows) == (kind, (2,))
        if kind is Kind.BAD_SEGMENT:
            first, last = finding.values["between"]
            assert first < 4 <= last
        else:
            assert finding.values["ohm"] == pytest.approx(2000, rel=0.1)
            assert finding.values["usual_ohm"] == pytest.approx(800, rel=0.1)
        assert all(words_of(finding).values())


def test_wires_that_are_not_nominal_are_told() -> None:
    found = evidence(f"{FAR}&wires=2", told=WireOhm(100.0, 200.0))
    rows, columns = examine(found).findings
    assert {rows.kind, columns.kind} == {Kind.LINE_WIRE}
    assert rows.place.rows == columns.place.columns == tuple(range(8))
    assert rows.values["ohm"] == pytest.approx(2 * rows.values["usual_ohm"], rel=0.1)
    assert examine(replace(found, told=WireOhm(200.0, 400.0))).findings == []


def test_all_far_ends_are_open_where_there_is_no_second_pair() -> None:
    """Sense nodes that are connected to nothing keep what they had."""
    read = evidence(FAR)
    assert read.settled is not None
    for codes in (*(scan.codes for scan in read.scans), *read.settled.codes):
        codes[..., 1] = np.roll(codes[..., 0].T.ravel(), 1).reshape(8, 8).T
        codes[..., 3] = np.roll(codes[..., 2].T.ravel(), 1).reshape(8, 8).T
    rows, columns = examine(read).findings
    assert (rows.kind, columns.kind) == (Kind.OPEN_FAR, Kind.OPEN_FAR)
    assert rows.place.rows == columns.place.columns == tuple(range(8))


@pytest.mark.parametrize("code", [None, 300, 900])
@pytest.mark.parametrize("lines", [(3,), tuple(range(8))])
def test_far_ends_that_show_nothing_are_open(lines: tuple[int, ...], code: int | None) -> None:
    """They show what the near ends show (None), or the same code whatever is read."""
    read = evidence(FAR)
    assert read.settled is not None
    for codes in (*(scan.codes for scan in read.scans), *read.settled.codes):
        codes[lines, :, 1] = codes[lines, :, 0] if code is None else code
    assert [(each.kind, each.place.rows) for each in examine(read).findings] == [
        (Kind.OPEN_FAR, lines)
    ]


# ------------------------------------------------------------------------------- the command


def test_page_and_json(run: Run, benches: list[SteppedSkin]) -> None:
    done = well(run("doctor", FAR))
    assert benches[0].now_s < 8
    table = done.out[done.out.index("wires [ohm]") :].splitlines()
    assert len(table) == 1 + 16
    assert table[1].startswith("row 0 ")
    assert " +- " in table[16]
    answer = json.loads(run("doctor", FAR, "--json").out)
    assert [each["place"]["rows"] for each in answer["lines"][:8]] == [[n] for n in range(8)]
    assert answer["lines"][9]["place"]["columns"] == [1]
    assert len(answer["lines"][9]["segment_ohm"]) == 8
    assert json.loads(run("doctor", "emulator://2x2", "--json").out)["lines"] == []


def far_calibration() -> Calibration:
    """Told nothing of the wires. Its readings are of the emulated skin, and its forces made up."""
    scene = emulated(FAR)[1]
    made = calibration(scene.rest_ratio)
    known = SkinKnowledge(
        8, 8, adc_bits=10, rest_ratio=scene.ratio(0, "far"), reading_names=MODES["far"]
    )
    rest = CalibratedRest.of("touch", known, made.date)
    return replace(made, rest=rest, nominal_wire_ohm=WireOhm(), mode="far")


@pytest.mark.usefixtures("benches")
def test_a_calibration_takes_the_wires_that_far_ends_show(run: Run, tmp_path: Path) -> None:
    """They are those of the scene, within four of the deviations that are kept with them."""
    path, told = tmp_path / "skin.json", far_calibration()
    for wires in (0.6, 4.0, 1.0):
        told.save(path)
        url = f"{FAR}&noise=0.4&wires={wires}"
        well(run("doctor", url, "--leads", str(LEAD_OHM), "--into", str(path)))
        kept = load_calibration(path).nominal_wire_ohm
        skin = emulated(url)[1].skin(0.0)
        off = np.log(
            [kept.top / skin.top_wire_ohm.mean(), kept.bottom / skin.bottom_wire_ohm.mean()]
        )
        stds = np.array([kept.top_log_std, kept.bottom_log_std])
        assert (np.abs(off) < 4 * stds).all()
        assert stds.max() < 0.1
    crimp = f"{url}&crimp_row=1"  # one bad line does not count
    told.save(path)
    assert run("doctor", crimp, "--leads", str(LEAD_OHM), "--into", str(path)).code == 1
    with_crimp = load_calibration(path).nominal_wire_ohm
    np.testing.assert_allclose(with_crimp.both, kept.both, rtol=0.03)


@pytest.mark.usefixtures("benches")
def test_a_calibration_takes_the_leads_that_far_ends_show(run: Run, tmp_path: Path) -> None:
    """Nobody has told them; and those that are told stay where presses would show the wires."""
    path = tmp_path / "skin.json"
    for lead_ohm in (0, 300, 3000):
        far_calibration().save(path)
        run("doctor", f"{FAR}&seed=3&wires=2&lead={lead_ohm}", "--into", str(path))
        kept = load_calibration(path).nominal_wire_ohm
        assert kept.lead == pytest.approx(lead_ohm, abs=4 * kept.lead_std_ohm)
        assert kept.lead_std_ohm < 80


@pytest.mark.usefixtures("benches")
def test_wires_that_are_not_told_are_not_kept(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "skin.json"
    far_calibration().save(path)
    before = path.read_bytes()
    moving = f"{FAR}&scene=moving&begin=0"  # a skin that moves has no rest
    rounded = f"{FAR}&noise=0&wires=0.1"  # wires lose less than a code
    for url in (moving, rounded):
        done = run("doctor", url, "--into", str(path))
        assert done.code == 2
        assert "skin.json is as it was: neither presses nor far ends have told" in done.err
        assert path.read_bytes() == before
    near = run("doctor", "emulator://8x8?seed=1", "--into", str(path))
    assert_one_line(near, "this calibration is of mode far, not near")


def test_a_plate_is_verified_by_the_near_ends(
    run: Run, benches: list[SteppedSkin], tmp_path: Path
) -> None:
    plate = tmp_path / "plate.csv"
    plate.write_text("10000,open\n22000,47000\n")
    url = f"emulator://2x2?mode=far&plate={plate}"
    answer = json.loads(run("verify", url, str(plate), "--seconds", "1", "--json", "-").out)
    assert answer["findings"] == []
    assert answer["hello"]["mode"] == "near"
    assert benches[0].info.mode == "far"


def test_a_wire_below_0_ohm_is_said_to_leak() -> None:
    """It was asked whether the stripe was worn."""
    diagnosis = examine(evidence("emulator://1x5?mode=far&damp=1e5"))
    found = [one for one in diagnosis.findings if one.kind is Kind.LINE_WIRE]
    assert found
    assert all("as a damp one does" in words_of(one)["what_to_do"] for one in found)
    noise = Finding(Kind.LINE_WIRE, WHOLE_SKIN, {"ohm": -1.0, "std_ohm": 9.0, "usual_ohm": 800.0})
    assert "of another yarn?" in words_of(noise)["what_to_do"]


@pytest.mark.parametrize(
    ("size", "axis", "lines"), [("4x3", 0, (1, 2)), ("3x4", 1, (1, 2)), ("3x3", 0, (0, 2))]
)
def test_exchanged_far_ends_of_a_small_skin_are_named(
    size: str, axis: int, lines: tuple[int, int]
) -> None:
    """Half of the lines gave all of them a lead of 270 kOhm, and all far ends seemed open."""
    pair = ",".join(map(str, lines))
    option = f"swap_far_{('rows', 'columns')[axis]}={pair}"
    for seed in range(4):
        found = examine(evidence(f"emulator://{size}?mode=far&seed={seed}&{option}")).findings
        places = [(one.kind, one.place.rows, one.place.columns) for one in found]
        assert places == [(Kind.SWAPPED_FAR, *((lines, ()) if axis == 0 else ((), lines)))]


def test_exchanged_far_ends_of_two_rows_are_not_called_sound() -> None:
    """Nothing in two rows says which of them is as it should be."""
    for seed in range(4):
        skin = f"emulator://2x8?mode=far&seed={seed}&swap_far_rows=0,1"
        assert examine(evidence(skin)).worse
