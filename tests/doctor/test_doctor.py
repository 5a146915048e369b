# SPDX-License-Identifier: Apache-2.0
"""`ohmskin doctor`: every emulated fault is named, and none on a sound skin.

The boards run in simulated time. A finding is asked for by its fault's own option, and everything
else that is found besides is a failure, too.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ohmskin
from ohmskin.circuit.skin import readings
from ohmskin.cli.doctor_words import measured_in_words, named, verdict, words_of
from ohmskin.doctor.circuit import examine_circuit
from ohmskin.doctor.examine import Evidence, examine
from ohmskin.doctor.findings import WHOLE_SKIN, Diagnosis, Finding, Kind, Place, Severity, merged
from ohmskin.doctor.gather import Step, gather
from ohmskin.doctor.signal import Look, Rest, examine_signal, find_hum, second_look
from ohmskin.emulate.driver import SteppedSkin
from ohmskin.emulate.scenes import Scene
from ohmskin.estimate.knowledge import NO_WIRES, WireOhm
from ohmskin.link.codes import quantise
from ohmskin.link.device import Region, scans_for
from ohmskin.link.messages import BoardStats, DecoderStats, SelfTestReport
from ohmskin.record.recorder import Recorder, record
from stepped import evidence, stepped, stepped_link

NOISES = (0.0, 0.1, 0.3, 0.5)


def told(url: str) -> list[tuple[str, str]]:
    """Kind and place of each finding of a board."""
    return [(each.kind.id, words_of(each)["where"]) for each in examine(evidence(url)).findings]


# ------------------------------------------------------------------------------- sound skins


SIZES = [(1, 1), (1, 2), (2, 1), (1, 16), (16, 1), (2, 2), (3, 3), (2, 5), (5, 2), (8, 8), (4, 12)]


@pytest.mark.parametrize(("rows", "columns"), [*SIZES, (16, 16)])
def test_a_sound_skin_has_no_finding(rows: int, columns: int) -> None:
    for seed, noise in enumerate(NOISES):
        wires = 1 + seed % 2 / 2  # an untouched skin does not show them
        url = f"emulator://{rows}x{columns}?seed={seed}&noise={noise}&wires={wires}"
        diagnosis = examine(evidence(url, told=WireOhm(100.0, 200.0) if seed % 2 else NO_WIRES))
        assert diagnosis.findings == [], url
        assert diagnosis.wires_hidden
        assert measured_in_words(diagnosis)["wires"].startswith("not known: an untouched skin")
        said = verdict(diagnosis)
        assert said.startswith("sound: nothing is wrong that an untouched skin shows")
        # Nothing in two lines says which of them is as it should be; and no line has a rectangle.
        assert ("hardly show shorts" in said) == (2 in (rows, columns))
        assert said.endswith("; --press shows its wires") == (1 not in (rows, columns))
        assert diagnosis.measured["reference_ratio"] == pytest.approx(1, abs=0.03)
        assert diagnosis.measured["noise_lsb"] < 0.8


def test_the_reference_ratio_is_top_over_bottom() -> None:
    for fault, ratio in (("ref_top=33000", 1.1), ("ref_bottom=33000", 1 / 1.1)):
        measured = examine(evidence(f"emulator://8x8?{fault}")).measured
        assert measured["reference_ratio"] == pytest.approx(ratio, abs=0.03)


@pytest.mark.parametrize("rate", [1, 3, 25, 50, 60, 100, 0])
def test_a_sound_skin_has_no_finding_at_any_rate(rate: int) -> None:
    for size in ("2x3", "8x8"):
        assert told(f"emulator://{size}?rate={rate}&noise=0.5") == [], size


@pytest.mark.parametrize("mode", ["near", "far"])
@pytest.mark.parametrize("scene", ["single", "ghost", "multi", "moving"])
def test_a_touch_is_said_and_is_no_fault(scene: str, mode: str) -> None:
    """While something moves, far ends are not judged."""
    for seed, size in enumerate(("3x3", "8x8")):
        bench = stepped(f"emulator://{size}?mode={mode}&scene={scene}&seed={seed}")
        bench.step(5.0)
        diagnosis = examine(gather(bench))
        assert [each.kind for each in diagnosis.findings] == [Kind.TOUCHED], size
        assert diagnosis.worse == []
        assert "something touches the skin" in verdict(diagnosis)
        assert bool(diagnosis.lines) == (mode == "far" and scene != "moving")


# ------------------------------------------------------------------------------------ faults


FOUND = {
    "8x8?open_row=3": ("open_row", "row 3"),
    "8x8?open_column=5": ("open_column", "column 5"),
    "8x8?short_rows=2,3": ("short_rows", "rows 2 and 3"),
    "8x8?short_rows=7,0": ("short_rows", "rows 0 and 7"),
    "8x8?short_columns=4,6": ("short_columns", "columns 4 and 6"),
    "8x8?dead=1,2": ("dead_cell", "cell (1, 2)"),
    "8x8?damp=1e6": ("damp", "the whole skin"),
    "16x16?damp=3e6": ("damp", "the whole skin"),
    "8x8?saturated=1,2": ("saturated_cell", "cell (1, 2)"),
    "8x8?saturated=7,7": ("saturated_cell", "cell (7, 7)"),
    "8x8?ref_top=33000": ("reference_ratio", "reference resistors"),
    "8x8?ref_bottom=28500": ("reference_ratio", "reference resistors"),
    "8x8?noise=1": ("noise", "whole skin"),
    "8x8?noise=3": ("noise", "whole skin"),
    "8x8?hum=50": ("hum", "whole skin"),
    "8x8?hum=60&hum_lsb=1": ("hum", "whole skin"),
    # Where all cells are alike, only the drive's change leaves something to settle.
    "8x8?tau_us=10": ("settling", "cell (0, 0)"),
    "8x8?scene=single&begin=0": ("touched", "cell (4, 4)"),
    "3x1?short_rows=0,2": ("short_rows", "rows 0 and 2"),
    "2x6?short_rows=0,1": ("short_rows", "rows 0 and 1"),
    "16x16?short_columns=0,15": ("short_columns", "columns 0 and 15"),
    "16x16?dead=15,15": ("dead_cell", "cell (15, 15)"),
    "2x2?dead=0,1": ("dead_cell", "cell (0, 1)"),
    "16x16?saturated=15,15": ("saturated_cell", "cell (15, 15)"),
    "16x16?saturated=15,15&wires=1.24": ("saturated_cell", "cell (15, 15)"),
    "1x1?saturated=0,0": ("saturated_cell", "cell (0, 0)"),
    "2x2?open_row=1": ("open_row", "row 1"),
    "4x1?open_row=2": ("open_row", "row 2 (or the only cell there is dead)"),
    "1x1?open_row=0": ("nothing_conducts", "the only cell, its row or its column"),
    "1x3?open_row=0": ("nothing_conducts", "every row and column"),
    "1x1?ref_top=36000": ("reference_ratio", "reference resistors"),
    "1x1?hum=50": ("hum", "whole skin"),
    "16x16?hum=60": ("hum", "whole skin"),
    "16x16?tau_us=8": ("settling", "cell (0, 0)"),
    "1x1?noise=2": ("noise", "whole skin"),
    "1x1?scene=single&begin=0": ("touched", "cell (0, 0)"),
    "4x4?scene=ghost&begin=0": ("touched", "cells (1, 1), (1, 2), (2, 1)"),
}


@pytest.mark.parametrize("url", FOUND)
def test_every_fault_is_named_and_no_other(url: str) -> None:
    assert told(f"emulator://{url}") == [FOUND[url]]
    if "8x8" in url:
        noise = "" if "noise" in url else "&noise=0.5"
        assert told(f"emulator://{url}&seed=1{noise}") == [FOUND[url]]


def test_several_faults_come_in_the_order_in_which_they_matter() -> None:
    url = "emulator://8x8?dead=1,2&open_column=5&short_rows=6,7&ref_top=33000&hum=50"
    assert told(url) == [
        ("open_column", "column 5"),
        ("short_rows", "rows 6 and 7"),
        ("dead_cell", "cell (1, 2)"),
        ("reference_ratio", "reference resistors"),
        ("hum", "whole skin"),
    ]


def test_faults_are_found_beside_a_touch() -> None:
    for fault in ("open_row=3", "short_rows=2,3", "saturated=1,2", "dead=1,2"):
        url = f"emulator://8x8?scene=single&begin=0&{fault}"
        assert told(url) == [FOUND[f"8x8?{fault}"], ("touched", "cell (4, 4)")]


def test_an_open_line_of_a_noisy_board_is_open() -> None:
    """Noise looks like some current there, since no code is below zero."""
    assert told("emulator://8x8?open_row=3&noise=10") == [
        ("open_row", "row 3"),
        ("noise", "whole skin"),
    ]


def test_a_hand_on_most_of_the_skin_is_seen(sound: Evidence) -> None:
    """What its cells scatter by is not taken for the scatter of cells at rest."""
    skin, random = Scene("rest", 8, 8, seed=1).skin(0.0), np.random.default_rng(0)
    siemens = skin.cell_siemens.copy()
    siemens[:5] += 10 ** random.uniform(-5.3, -3.7, (5, 8))
    codes = quantise(readings(replace(skin, cell_siemens=siemens))).astype(np.float64)
    board = replace(sound.board, rows=8, columns=8, row_mask=255, column_mask=255)
    rest, diagnosis = Rest(board, codes, 50, 0.4), Diagnosis()
    touched = examine_circuit(rest, diagnosis).touched
    assert touched[:5].sum() > 30
    assert not touched[5:].any()
    assert diagnosis.findings == []


def test_a_converters_gain_is_no_fault_of_unequal_references(sound: Evidence) -> None:
    """2.2 and 4.7 kOhm show few codes of an untouched skin, and other shares of the gain."""
    random, refs = np.random.default_rng(3), {"ref_top_ohm": 2200, "ref_bottom_ohm": 4700}
    board = replace(sound.board, rows=8, columns=8, row_mask=255, column_mask=255, **refs)
    skin = replace(Scene("rest", 8, 8).rest, **refs)
    for gain in (1 - 2 / 1024, 1 + 2 / 1024):
        exact = 1024 * gain * readings(skin) + 0.7 * random.standard_normal((400, 8, 8, 4))
        codes = np.clip(np.floor(exact), 0, 1023).mean(axis=0)
        diagnosis = Diagnosis()
        examine_circuit(Rest(board, codes, 400, 0.7), diagnosis)
        assert diagnosis.findings == []


def test_lines_that_are_not_there_are_one_finding() -> None:
    bench = stepped("emulator://4x6")
    bench.configure(rows=7, rate_hz=0)
    [finding] = examine(gather(bench)).findings
    assert (finding.kind, finding.place) == (Kind.OPEN_ROW, Place(rows=(4, 5, 6)))
    assert "'ohmskin configure PORT --rows 4 --save'" in words_of(finding)["what_to_do"]


# ----------------------------------------------------------------------- hum, noise, settling


@pytest.mark.parametrize("rate", [90, 100, 110, 120, 37.6])
def test_hum_is_found_at_any_rate(rate: float) -> None:
    """At 37.6 scans/s both mains look like 12 to 15 Hz, at 110 both like 50 Hz: there, both are
    named. At 100 and 120, one of them is half the rate, where only a part of its sine is seen.
    """
    for mains, seen in (("50 Hz", "40.0 Hz"), ("60 Hz", "30.0 Hz")):
        diagnosis = examine(evidence(f"emulator://8x8?rate={rate}&hum={mains[:2]}&hum_lsb=2"))
        [finding] = diagnosis.findings
        words, may_be = words_of(finding)["measured"], mains if rate != 110 else "50 Hz or 60 Hz"
        assert words.startswith(f"{may_be} of amplitude 2.0 LSB; at {rate:.1f} scans/s")
        assert words.endswith(seen) or rate != 90
        assert diagnosis.measured["noise_lsb"] < 0.6


def test_hum_that_stands_still_shows_at_another_rate() -> None:
    for rate in (25, 50):
        read = evidence(f"emulator://8x8?rate={rate}&hum=50&hum_lsb=2")
        alone = examine(replace(read, settled=None))
        assert 50.0 in alone.measured["hum_not_visible"]
        [finding] = examine(read).findings
        assert finding.kind is Kind.HUM


@pytest.mark.parametrize("size", ["8x8", "6x12", "16x16"])
def test_a_touch_that_begins_in_the_second_look_is_no_settling(size: str) -> None:
    """It was: the scene begins after two seconds. The doctor said to wait longer for readings."""
    read = evidence(f"emulator://{size}?scene=ghost")
    assert read.again is not None
    assert [one.kind for one in examine(read).findings] == [Kind.TOUCHED]
    assert [one.kind for one in examine(replace(read, again=None)).findings] == [Kind.SETTLING]
    assert evidence(f"emulator://{size}").again is None


@pytest.mark.parametrize("url", ["8x8?hum=50&rate=50", "8x8?hum=60&rate=60", "4x4?hum=50&rate=50"])
def test_hum_that_stands_still_is_no_fault_of_the_references(url: str) -> None:
    assert told(f"emulator://{url}") == [("hum", "whole skin")]


def test_hum_is_not_seen_in_noise_or_in_other_tones() -> None:
    for noise in (1.0, 3.0, 10.0):
        assert "hum" not in dict(told(f"emulator://4x4?noise={noise}"))
    for hz in (41.0, 45.0, 55.0, 65.0, 77.0):
        assert "hum" not in dict(told(f"emulator://4x4?hum={hz}&hum_lsb=3"))


def rest_of(url: str) -> Look:
    read = evidence(url)
    return Look.of(read.board, read.scans)


def test_noisy_lines_and_cells_are_named() -> None:
    rest = rest_of("emulator://6x5")
    random = np.random.default_rng(1)
    for at, place in (
        (np.s_[:, 3], Place(rows=(3,))),
        (np.s_[:, :, 1], Place(columns=(1,))),
        (np.s_[:, 2, 4], Place(cells=((2, 4),))),
    ):
        codes = rest.codes.copy()
        codes[at] += np.round(3 * random.standard_normal(codes[at].shape))
        examine_signal(replace(rest, codes=codes), diagnosis := Diagnosis())
        [finding] = diagnosis.findings
        assert (finding.kind, finding.place) == (Kind.NOISE, place)
        assert finding.values["noise_lsb"] == pytest.approx(3.05, abs=0.25)
        assert words_of(finding)["what_to_do"].startswith(f"check the contacts of {named(place)}")


def test_noise_is_measured_beside_hum_and_drift() -> None:
    rest = rest_of("emulator://6x5?noise=0.5&hum=50")
    drift = np.linspace(0, 2, len(rest.codes))[:, None, None, None]
    noise_lsb, _ = examine_signal(replace(rest, codes=rest.codes + drift), Diagnosis())
    assert noise_lsb == pytest.approx((0.5**2 + 1 / 12) ** 0.5, rel=0.1)
    hum = find_hum(rest)
    assert hum.lsb == pytest.approx(3.0, rel=0.05)


def test_deviation_of_a_mean_of_codes(sound: Evidence) -> None:
    """Against means of simulated codes over all places within a code."""
    random = np.random.default_rng(2)
    for before in (0.0, 0.2, 0.4, 1.0):
        places = random.uniform(100, 101, 400)
        exact = places[:, None] + before * random.standard_normal((400, 50))
        errors = np.floor(exact).mean(axis=1) + 0.5 - places
        noise = (before**2 + 1 / 12) ** 0.5
        rest = Rest(sound.board, exact, 50, noise)
        assert rest.std_lsb == pytest.approx(errors.std(), rel=0.35)


def test_settling_says_how_long_is_enough() -> None:
    for tau_us in (10, 15, 20):
        bench = stepped(f"emulator://8x8?tau_us={tau_us}")
        [finding] = examine(gather(bench)).findings
        enough_us = finding.values["needed_us"]
        assert f"--settle {enough_us} " in words_of(finding)["what_to_do"]
        assert enough_us < 12 * tau_us
        bench.configure(rate_hz=0, settle_us=enough_us)
        assert examine(gather(bench)).findings == []


@pytest.mark.parametrize("url", ["8x8?tau_us=50", "2x2?tau_us=3000", "16x16?tau_us=200"])
def test_a_skin_that_settles_slowly_is_not_called_touched(url: str) -> None:
    assert [kind for kind, _ in told(f"emulator://{url}")] == ["settling"]


def test_second_look_is_what_a_board_takes() -> None:
    for url in ("1x1", "1x1?rate=50", "2x2?rate=1", "16x16", "16x16?rate=1", "16x16?rate=0", "8x8"):
        bench = stepped(f"emulator://{url}")
        board = bench.info
        other = second_look(board)
        if other is None:
            assert board.settle_us * 1.2 >= 3000
            continue
        bench.configure(**other)
        assert bench.info.settle_asked_us == other["settle_us"]
        assert bench.info.rate_hz >= min(1.0, 0.7 * board.rate_hz)


# ---------------------------------------------------------------------------- board and line


@pytest.fixture(scope="module")
def sound() -> Evidence:
    return evidence("emulator://4x4")


def finding_of(read: Evidence, **changes: object) -> Finding:
    [finding] = examine(replace(read, **changes)).findings
    assert all(words_of(finding).values())
    return finding


def test_what_the_board_says_of_itself(sound: Evidence) -> None:
    for cause in ("brown_out", "watchdog"):
        finding = finding_of(sound, board=replace(sound.board, reset_cause=(cause,)))
        assert finding.kind is Kind.RESET_CAUSE
        assert cause.replace("_", "-") in words_of(finding)["measured"]
    report = SelfTestReport(("bottom_stuck_low", "top_reference_missing"), (0,) * 4, (9,) * 4)
    first, second = (words_of(each) for each in examine(replace(sound, report=report)).findings)
    assert first["where"] == "bottom sense node"
    assert "short to ground" in first["what_to_do"]
    assert second["where"] == "top sense node"
    far = finding_of(sound, report=SelfTestReport(("far_top_stuck_low",), (0,) * 8, (9,) * 8))
    assert words_of(far)["where"] == "far top sense node"
    assert "short to ground" in words_of(far)["what_to_do"]
    assert finding_of(sound, board=replace(sound.board, version_major=9)).kind is Kind.VERSION


def test_counts_of_the_line(sound: Evidence) -> None:
    for kind, stats in (
        (Kind.LOSS, BoardStats(scans=100, missed=3, dropped_by_board=2)),
        (Kind.DAMAGED, BoardStats(scans=100, line=DecoderStats(crc_errors=2))),
        (Kind.DAMAGED, BoardStats(scans=100, board_rx_errors=1)),
        (Kind.RESTARTED, BoardStats(scans=100, restarts=2)),
    ):
        assert finding_of(sound, stats=stats).kind is kind
    finding = finding_of(sound, scans=sound.scans[:1])
    assert words_of(finding)["measured"] == "only 1 scans came"


def test_faults_of_the_line_are_found() -> None:
    for fault, expected in (
        ("drop=0.05", {"loss"}),
        ("bitflip=1e-5", {"loss", "damaged"}),
        ("garbage=0.1", {"damaged"}),
    ):
        assert set(dict(told(f"emulator://8x8?{fault}"))) == expected


def test_the_rate_is_by_the_boards_clock(sound: Evidence) -> None:
    late = [replace(scan, time_us=round(1.02 * scan.time_us)) for scan in sound.scans]
    measured = examine(replace(sound, scans=late, settled=None)).measured
    assert measured["rate_hz"] == pytest.approx(90 / 1.02, abs=0.01)


def test_latency_timer(sound: Evidence) -> None:
    finding = finding_of(sound, latency=(16, "/sys/timer"))
    assert finding.kind is Kind.USB_LATENCY
    assert "/sys/timer" in words_of(finding)["what_to_do"]
    assert examine(replace(sound, latency=(1, "/sys/timer"))).findings == []


# -------------------------------------------------------------------------- findings, words


def test_order_and_verdict() -> None:
    severities = [kind.severity for kind in Kind]
    assert severities == sorted(severities, key=list(Severity).index)
    diagnosis = Diagnosis()
    diagnosis.add(Kind.TOUCHED, moves=True)
    assert diagnosis.worse == []
    diagnosis.add(Kind.LOST, problem="gone", late=0)
    assert verdict(diagnosis) == "not sound: 1 finding and 1 note, first lost (board)"
    with pytest.raises(ValueError, match="lost has"):
        diagnosis.add(Kind.LOST)


def test_what_another_finding_explains_is_not_told() -> None:
    change = dict.fromkeys(Kind.SETTLING.names, 1)
    dead = Finding(Kind.DEAD_CELL, Place(cells=((0, 0), (4, 6), (4, 7))), {"percent_of_usual": 0.0})
    yarn = {"between": (5, 6)}
    found = [
        Finding(Kind.TOUCHED, Place(cells=((4, 6),)), {"moves": False}),
        Finding(Kind.SETTLING, Place(cells=((1, 1),)), change),
        dead,
        Finding(Kind.SETTLING_PRESSED, WHOLE_SKIN, change),
        Finding(Kind.SHORT_ROWS, Place(rows=(2, 3)), {}),
        Finding(Kind.SHORT_ROWS, Place(rows=(5, 6)), {}),
        Finding(Kind.BROKEN_YARN, Place(rows=(4,)), yarn, Place(cells=((4, 6), (4, 7)))),
        Finding(Kind.SHORT_FAR, Place(rows=(2, 3)), {}),
    ]
    assert [(each.kind, each.place) for each in merged(found)] == [
        (Kind.SHORT_ROWS, Place(rows=(5, 6))),
        (Kind.SHORT_FAR, Place(rows=(2, 3))),
        (Kind.BROKEN_YARN, Place(rows=(4,))),
        (Kind.DEAD_CELL, Place(cells=((0, 0),))),
        (Kind.SETTLING_PRESSED, WHOLE_SKIN),
        (Kind.TOUCHED, Place(cells=((4, 6),))),
    ]
    assert merged([dead, found[6]])[1].values is dead.values
    assert merged([dead]) == [dead]


def test_a_kind_explains_kinds_that_there_are() -> None:
    assert set().union(*(kind.explains for kind in Kind)) <= set(Kind.__members__)


def test_places_are_named() -> None:
    cells = tuple((0, column) for column in range(9))
    assert named(Place(rows=(1,), columns=(2, 3))) == "row 1, columns 2, 3"
    assert named(Place(cells=cells)).endswith("(0, 4), (0, 5) and 3 more")
    assert named(Place()) == "whole skin"


def test_findings_are_of_one_unit() -> None:
    """Another one that comes meanwhile, behind an adapter, is said, and its scans do not count."""
    link = stepped_link("emulator://4x4?unit=3")

    def report(step: Step, _: object) -> None:
        if step is Step.SKIN:
            link.board = stepped_link("emulator://4x4?unit=8").board

    found = gather(SteppedSkin(link), report)
    assert "unit 8 has come in place of unit 3" in found.lost
    assert "lost" in {finding.kind.id for finding in examine(found).findings}


FAULTY = "emulator://4x4?open_row=3&seed=1"


@pytest.mark.parametrize("mode", ["quick", "half"])
def test_a_board_that_reads_little_is_examined_by_all_readings(mode: str) -> None:
    skin = stepped(FAULTY)
    skin.configure(mode=mode, rate_hz=200)
    before = skin.set_region(Region(range(1, 3), range(2), mode=mode, whole_every=7))
    found = examine(gather(skin)).findings
    assert [each.kind.id for each in found] == ["open_row"]
    assert (skin.info.row_mask, skin.info.mode, skin.info.whole_every) == (6, mode, 7)
    assert skin.info.rate_hz == before.rate_hz


def test_a_recording_is_examined_by_its_complete_scans(tmp_path: Path) -> None:
    skin, path = stepped(FAULTY), tmp_path / "a.mcap"
    with Recorder(path, skin.info, lambda: skin.now_s) as recorder:
        record(skin, recorder, scans_for(skin, 1.0))
        skin.set_region(Region(range(3), range(3)))
        record(skin, recorder, scans_for(skin, 0.5))
    with ohmskin.open(f"replay://{path}?speed=0") as replay:
        assert [each.kind.id for each in examine(gather(replay)).findings] == ["open_row"]
    few = tmp_path / "few.mcap"
    with Recorder(few, skin.info, lambda: skin.now_s) as recorder:
        record(skin, recorder, scans_for(skin, 0.5))
    with (
        ohmskin.open(f"replay://{few}?speed=0") as replay,
        pytest.raises(ValueError, match="whole"),
    ):
        gather(replay)


def test_scans_of_another_size_are_not_sound() -> None:
    """A recording can have them: nothing of them was examined."""
    given = evidence("emulator://4x4")
    other = replace(given, board=replace(given.board, rows=2, row_mask=3))
    assert [each.kind.id for each in examine(other).findings] == ["lost"]
    assert not examine(other).sound
