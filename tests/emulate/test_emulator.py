# SPDX-License-Identifier: Apache-2.0
"""The emulated board, sans-IO, and that it and the firmware answer alike."""

import re
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import ohmskin
from firmware_helpers import go_fast
from lockstep import CPU_HZ, Rig
from ohmskin.emulate import board as emulator
from ohmskin.emulate.board import BoardSettings, EmulatedBoard
from ohmskin.emulate.scenes import BEGIN_S, SCENES, Scene
from ohmskin.emulate.urls import emulated
from ohmskin.errors import PortError
from ohmskin.link import framing, protocol
from ohmskin.link.codes import quantise
from ohmskin.link.messages import BoardDecoder, Hello, Scan
from ohmskin.link.session import configuration
from places import ROOT
from stepped import stepped

DEFAULT = {"rows": 8, "columns": 8, "rate_mhz": 90_000, "settle_us": 0}
DEFAULT |= {"accuracy": 0, "mode": 0}


class EmulatedSim:
    """An emulated board, with as much of a `LockstepSim` as a `Rig` needs."""

    def __init__(self) -> None:
        self.board = EmulatedBoard(Scene().ratio, BoardSettings())
        self._cycles = 0

    def write(self, octets: bytes) -> None:
        self.board.receive(octets)

    def run_cycles(self, cycles: int) -> bytes:
        self._cycles += cycles
        return self.board.advance(self._cycles / CPU_HZ)

    def close(self) -> None:
        pass


def rig_of(board: str) -> Rig:
    """An emulated board, or the built firmware, which reads the same skin."""
    if board == "emulator":
        return Rig(board, EmulatedSim())
    rig = Rig(board)
    rig.sim.set_table(Scene().ratio(0.0))
    rig.run(0.02)
    return rig


def hello_of(rig: Rig) -> Hello:
    return Hello(**rig.hello())


def answer(rig: Rig, frame_type: int, payload: bytes) -> str:
    """The result in the ack of a frame, which may be none of the protocol's."""
    rig.sim.write(framing.encode(frame_type, 0, payload))
    result = rig.result_of(0)
    assert rig.frames("ack")[-1]["command"] == frame_type
    return result


def asked_for(hello: Hello, of: Iterable[str] = DEFAULT) -> dict[str, Any]:
    """What the board was asked for, in the integers of the line."""
    asked = configuration(hello)
    for name in ("accuracy", "mode"):
        asked[name] = protocol.ENUMS[name].values[asked[name]]
    return {name: asked[name] for name in of}


# ------------------------------------------------------------------------------ sans-IO board


def test_scans_come_at_their_time_and_read_the_skin() -> None:
    scene = Scene("moving", 5, 3, seed=4)

    def ratio(time_s: float, mode: str = "near") -> np.ndarray:
        return scene.ratio(BEGIN_S + time_s, mode)

    board = EmulatedBoard(ratio, BoardSettings(5, 3, rate_hz=100))
    host = BoardDecoder()
    host.feed(board.advance(0.0), 0.0)
    start = protocol.FRAMES["start"]
    board.receive(framing.encode(start.id, 1, b""))
    host.feed(board.advance(0.0), 0.0)
    assert board.next_scan_s == pytest.approx(0.01)
    assert host.feed(board.advance(0.0099), 0.0) == []
    found = [m for m in host.feed(board.advance(0.2001), 0.0) if isinstance(m, Scan)]
    assert [s.number for s in found] == list(range(20))
    assert [s.time_us for s in found] == [10_000 * n for n in range(20)]
    for scan in found:
        np.testing.assert_array_equal(scan.codes, quantise(ratio(scan.time_us * 1e-6)))


@pytest.mark.parametrize("name", [name for name in SCENES if name not in ("rest", "weights")])
def test_a_scene_begins_untouched(name: str) -> None:
    """Whoever tares first tares the skin at rest: 2 s, as the pages say, and the time to open."""
    scene = Scene(name, 8, 8, seed=1)
    for time_s in np.arange(0, 2.9, 0.1):
        np.testing.assert_array_equal(scene.ratio(time_s), scene.rest_ratio)
    assert any(scene.touched(time_s).any() for time_s in np.arange(3.0, 10.0, 0.1))


@pytest.mark.parametrize("name", ["single", "ghost", "multi"])
def test_touches_that_stay_begin_after_three_seconds_or_when_the_port_says(name: str) -> None:
    counts = {"single": 1, "ghost": 3, "multi": 5}
    for option, begin_s in (("", 3.0), ("&begin=0", 0.0), ("&begin=0.5", 0.5)):
        _, scene, _ = emulated(f"emulator://8x8?scene={name}&seed=1{option}")
        assert scene.touched(begin_s - 1e-6).sum() == 0
        assert scene.touched(begin_s).sum() == counts[name]
        for mode in ("near", "far"):
            before, after = scene.ratio(begin_s - 1e-6, mode), scene.ratio(begin_s, mode)
            assert np.abs(after - before).max() > 0.1
            np.testing.assert_array_equal(scene.ratio(1e6, mode), after)


def test_noise_is_that_of_the_seed_and_of_its_size() -> None:
    ratio = np.full((8, 8, 4), 0.5)

    def codes(seed: int, noise_lsb: float) -> np.ndarray:
        board = EmulatedBoard(lambda *_: ratio, BoardSettings(), noise_lsb=noise_lsb, seed=seed)
        return np.stack([board.codes_at(0.0) for _ in range(40)]).astype(float)

    np.testing.assert_array_equal(codes(1, 3.0), codes(1, 3.0))
    assert (codes(1, 3.0) != codes(2, 3.0)).any()
    assert codes(1, 0.0).std() == 0
    assert codes(1, 3.0).std() == pytest.approx(3.0, rel=0.05)
    assert codes(1, 3.0).mean() == pytest.approx(511.5, abs=0.2)


def test_lines_beyond_the_skin_are_open() -> None:
    skin = stepped("emulator://8x8?noise=0")
    skin.configure(rows=9, columns=10, rate_hz=0)
    codes = skin.latest().codes
    assert codes.shape == (9, 10, 4)
    np.testing.assert_array_equal(codes[8], np.tile([1023, 0, 1023, 0], (10, 1)))
    np.testing.assert_array_equal(codes[:, 8:], np.tile([1023, 0, 1023, 0], (9, 2, 1)))
    np.testing.assert_array_equal(codes[:8, :8], quantise(Scene().ratio(0.0)))


def test_saved_settings_outlive_a_reset_and_others_do_not() -> None:
    rig = rig_of("emulator")
    rig.must("configure", **(DEFAULT | {"rows": 3}))
    rig.must("set_unit_id", unit_id=77)
    rig.must("save")
    rig.must("configure", **(DEFAULT | {"rows": 2}))
    rig.must("start")
    rig.sim.board.reset()
    hello = hello_of(rig)
    assert (hello.rows, hello.unit_id, hello.settings) == (3, 77, "stored")
    assert (hello.scanning, hello.reset_cause) == (0, ("external",))
    rig.must("load_defaults")
    assert (hello_of(rig).rows, hello_of(rig).unit_id) == (8, 0)
    rig.sim.board.reset()
    assert hello_of(rig).rows == 3


def test_a_large_skin_is_scanned_as_fast_as_it_can_be() -> None:
    assert stepped("emulator://8x8").info.rate_hz == pytest.approx(90, rel=1e-4)
    hello = stepped("emulator://16x16").info
    assert (hello.rows, hello.columns) == (16, 16)
    assert hello.rate_hz == pytest.approx(16e6 / ((11.5 * 32 + 20 * 16) * 1024))


def test_numbers_of_the_firmware_are_those_of_its_source() -> None:
    def source(file: str) -> str:
        return (ROOT / "firmware" / "src" / file).read_text()

    def number(file: str, name: str) -> int:
        (digits,) = re.findall(rf"\b{name} = (\d+)", source(file))
        return int(digits)

    plan, avr = "core/scan_plan.h", "avr_numbers.h"
    assert number(plan, "SLOT_CYCLES_MAX") == emulator.SLOT_CYCLES_MAX
    (settle_us,) = re.findall(r"SETTLE_US\[\] = {(.*)};", source(plan))
    assert [int(us) for us in settle_us.split(",")] == list(emulator.SETTLE_US.values())
    for name in ("BUSY_A_SLOT", "BUSY_A_READING", "BUSY_A_SCAN"):
        assert number(avr, name) == getattr(emulator, name)
    assert number("core/scan_plan.cpp", "SPARE_SLOTS") == emulator.SPARE_SLOTS
    assert number(plan, "LINE_IDLE_PART") == emulator.LINE_IDLE_PART
    for name in ("IDLE_TO_CHANGE", "FEW", "IDLE_OF_FEW"):
        assert number(plan, name) == getattr(emulator, name)
    assert f"OHMSKIN_ROWS_MAX {emulator.LINES_MAX}" in source("core/scan_sequence.h")
    slot_min, held = re.findall(r"\((\d+)u \* prescaler\(accuracy\)( / 2)?\)", source(avr))
    assert slot_min == (str(emulator.SLOT_ADC_CLOCKS_MIN), "")
    assert held == (str(round(2 * emulator.HELD_ADC_CLOCKS)), " / 2")
    told = (
        source("core/settings.cpp")
        .split("void take_defaults(Settings *settings) {")[1]
        .split("\n}")[0]
    )
    defaults = EmulatedBoard(Scene().ratio, BoardSettings()).settings
    for name in ("unit_id", "rows", "columns", "rate_mhz", "settle_us", "whole_every"):
        (value,) = re.findall(rf"\b{name}(?: = [\w.]+)* = (\d+);", told)
        assert int(value) == defaults[name]
    assert (defaults["accuracy"], defaults["mode"]) == ("usual", "near")
    assert re.findall(r"frames::(\w+::\w+)", told) == ["Accuracy::Usual", "Mode::Near"]


@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("emulator://8x8?speed=2", "speed must be 1, or 0"),
        ("emulator://8x8?rate=1000", "line_too_slow"),
        ("emulator://16x16?rate=90", "too_fast"),
        ("emulator://8x8?rate=0.5", "bad_rate"),
        ("emulator://8x8?rate=-1", "times a second"),
        ("emulator://8x8?rate=inf", "rate|times a second"),
        ("emulator://8x8?rate=nan", "rate|times a second"),
        ("emulator://8x8?rate=0.0001", "times a second"),
        ("emulator://8x8?rate=", "rate must be a number, not ''"),
        ("emulator://8x8?seed=nan", "seed must be a whole number, not 'nan'"),
        ("emulator://8x8?noise=nan", "noise"),
        ("emulator://8x8?noise=-1", "noise"),
        ("emulator://8x8?noise=1e308", "noise must be from 0 to 1024"),
        ("emulator://8x8?rate=1e308", "times a second"),
        ("emulator://8x8?readings=/dev/zero", "no option 'readings'"),
        ("emulator://8x8?drop=1.5", "drop"),
        ("emulator://8x8?drop=nan", "drop"),
        ("emulator://8x8?stall=-1", "stall"),
        ("emulator://8x8?unit=-1", "unit_id is -1"),
        ("emulator://8x8?foreign=70000", "layout_crc"),
        ("emulator://8x8?seed=-4", "seed must be 0 or more, not -4"),
        ("emulator://8x8?rows=4", "no option 'rows'"),
        ("emulator://8x8?scene=nothing", "no scene"),
        ("emulator://1x1?scene=ghost", "2x2"),
        ("emulator://8x8?scene=ghost&begin=-1", "begin must be 0 s or later"),
        ("emulator://8x8?begin=nan", "begin must be 0 s or later"),
        ("emulator://0x4", "1x1 to 16x16"),
        ("emulator://17x4", "1x1 to 16x16"),
        ("emulator://", "a size is as 8x8, from 1x1 to"),
    ],
)
def test_wrong_urls(url: str, reason: str) -> None:
    with pytest.raises(PortError, match=reason):
        emulated(url)


# ---------------------------------------------------------------------- emulator and firmware

HOST_FRAMES = {
    frame.id: frame.struct.size for frame in protocol.FRAMES.values() if frame.sender == "host"
}
# Of types that are no command's, of commands with a byte too many or too few, and a bad speed.
ODD_FRAMES: list[tuple[int, bytes]] = [
    *((0x00, b""), (0x01, b""), (0x02, bytes(9)), (0x7F, b"abc"), (0x8B, b""), (0xFF, bytes(9))),
    *((frame_id, bytes(size + 1)) for frame_id, size in HOST_FRAMES.items()),
    *((frame_id, bytes(size - 1)) for frame_id, size in HOST_FRAMES.items() if size),
    (protocol.FRAMES["set_baud"].id, (9600).to_bytes(4, "little")),
]

# Every one with 8x8, 90 Hz, no settle time and the default prescaler unless it says otherwise.
# Fast scans that a line of 500 kbaud cannot carry are not among them: the emulator has no line.
RATES_MHZ = (
    *(0, 1, 999, 1000, 1001, 12_345, 140_000, 143_000, 144_000, 150_000, 50_000_000, 50_000_001),
    0xFFFFFFFF,
)
ALONE: dict[str, tuple[int, ...]] = {
    "rows": (0, 17, 255),
    "columns": (0, 17),
    "rate_mhz": RATES_MHZ,
    "settle_us": (1, 20, 36, 40, 100, 3000, 3001, 0xFFFF),
    "accuracy": (1, 2, 3, 255),
    "mode": (1, 2, 3, 4, 255),
}
SIZES_AND_RATES = [
    *((1, 1, 90_000), (1, 16, 90_000), (16, 1, 90_000), (3, 5, 90_000), (16, 16, 90_000)),
    *((1, 1, 1000), (1, 1, 2_000_000), (2, 2, 500_000), (2, 2, 2_000_000), (4, 4, 300_000)),
    *((16, 16, 20_000), (16, 16, 30_000), (16, 16, 0)),
]
CONFIGURATIONS: list[dict[str, int]] = [
    {},
    *({name: value} for name, values in ALONE.items() for value in values),
    *({"rows": r, "columns": c, "rate_mhz": rate} for r, c, rate in SIZES_AND_RATES),
    *({"settle_us": 3000, "rate_mhz": rate} for rate in (1000, 1500)),
    *({"settle_us": settle, "rate_mhz": 0} for settle in (100, 10)),
    {"settle_us": 50, "rows": 16, "columns": 16, "rate_mhz": 10_000},
    *(
        {"settle_us": 500, "rows": 1, "columns": 2, "rate_mhz": rate}
        for rate in (100_000, 240_000, 250_000)
    ),
    {"accuracy": 1, "rate_mhz": 70_000},
    {"accuracy": 2, "rate_mhz": 30_000},
    {"accuracy": 1, "rate_mhz": 0},
    {"mode": 1, "rate_mhz": 0},
    {"mode": 1, "accuracy": 2, "rate_mhz": 0},
    {"mode": 2, "rate_mhz": 0},
    {"mode": 3, "rate_mhz": 0},
    {"mode": 3, "rate_mhz": 0, "rows": 3, "columns": 3},
    {"row_mask": 0x18, "column_mask": 3, "mode": 3, "rate_mhz": 500_000, "whole_every": 50},
    {"row_mask": 0},
    {"column_mask": 0x100},
    {"accuracy": 2, "rate_mhz": 0, "settle_us": 200},
    # With several faults, the first of the checks decides.
    {"rows": 0, "columns": 0},
    {"rows": 0, "rate_mhz": 1},
    {"columns": 99, "settle_us": 9999},
    {"rate_mhz": 1, "settle_us": 9999},
    {"settle_us": 9999, "accuracy": 3},
    {"accuracy": 3, "rate_mhz": 2_000_000},
    {"mode": 4, "accuracy": 3},
    {"mode": 4, "rate_mhz": 2_000_000},
]


@pytest.mark.simavr
@pytest.mark.parametrize("board", ["uno", "megaatmega2560"])
def test_emulator_and_firmware_answer_alike(board: str) -> None:
    with rig_of(board) as real, rig_of("emulator") as model:
        results: dict[str, int] = {}
        for change in CONFIGURATIONS:
            wanted = DEFAULT | change
            result = real.command("configure", **wanted)
            assert model.command("configure", **wanted) == result, change
            results[result] = results.get(result, 0) + 1
            kept, modelled = hello_of(real), hello_of(model)
            assert asked_for(kept) == asked_for(modelled)
            assert (asked_for(kept, wanted) == wanted) >= (result == "ok"), change
            assert modelled.rate_hz == pytest.approx(kept.rate_hz, rel=0.002), change
            assert modelled.slot_cycles == pytest.approx(kept.slot_cycles, rel=0.05), change
            assert modelled.settle_us == pytest.approx(kept.settle_us, rel=0.05, abs=2), change
        print(f"{board}: {len(CONFIGURATIONS)} configurations: {results}")
        assert len(CONFIGURATIONS) >= 60
        assert {"ok", "bad_rows", "bad_columns", "bad_rate"} < set(results)
        assert {"bad_settle", "bad_accuracy", "too_fast"} < set(results)
        for frame_type, payload in ODD_FRAMES:
            answers = [answer(rig, frame_type, payload) for rig in (real, model)]
            assert answers[0] == answers[1] != "ok", (frame_type, payload)
        both_in_every_state(real, model)


@pytest.mark.simavr
@pytest.mark.parametrize("board", ["uno", "emulator"])
def test_the_speed_of_the_line_decides_which_scans_can_be(board: str) -> None:
    with rig_of(board) as rig:
        quick = DEFAULT | {"rows": 2, "columns": 2, "rate_mhz": 1_200_000}
        assert rig.command("configure", **quick) == "line_too_slow"
        rig.must("configure", **(quick | {"rate_mhz": 0, "settle_us": 1}))
        slow = hello_of(rig).rate_hz
        go_fast(rig)
        assert hello_of(rig).rate_hz > 1.2 * slow
        rig.must("configure", **quick)
        rig.must("save")
        rig.run(0.3)
        (rig.sim if board == "uno" else rig.sim.board).reset()
        rig.run(0.02)
        hello = hello_of(rig)
        assert (hello.settings, hello.rows, hello.baud) == ("stored", 2, 500_000)
        assert hello.rate_hz == pytest.approx(1200, rel=0.002)
        assert rig.command("start") == "line_too_slow"
        go_fast(rig)
        rig.must("start")


@pytest.mark.simavr
@pytest.mark.parametrize("board", ["uno", "emulator"])
def test_a_start_right_behind_set_baud_is_refused(board: str) -> None:
    with rig_of(board) as rig:
        rig.sim.write(rig.encode("set_baud", baud=1_000_000) + rig.encode("start"))
        rig.run(0.02)
        assert [ack["result"] for ack in rig.frames("ack")] == ["ok", "busy"]
        hello = hello_of(rig)
        assert (hello.baud, hello.scanning) == (1_000_000, 0)
        rig.must("start")


REGION: dict[str, protocol.Value] = {
    "row_mask": 6,
    "column_mask": 5,
    "rate_mhz": 300_000,
    "settle_us": 0,
    "mode": 3,
    "whole_mode": 0,
    "whole_every": 9,
}


def both_in_every_state(real: Rig, model: Rig) -> None:
    """Commands while scanning and after, whose answers and consequences must be the same."""
    both = (real, model)
    for rig in both:
        rig.must("configure", **(DEFAULT | {"rows": 4, "columns": 3}))
    commands: list[tuple[str, dict[str, protocol.Value]]] = [
        *(("stop", {}), ("start", {}), ("start", {})),
        ("set_region", REGION | {"row_mask": 0}),
        ("set_region", REGION | {"column_mask": 8}),
        ("set_region", REGION | {"mode": 4}),
        ("set_region", REGION),
        ("set_region", REGION | {"mode": 0, "row_mask": 15, "column_mask": 7}),
        ("configure", DEFAULT | {"rows": 1}),
        ("configure", DEFAULT | {"rows": 0}),
        *(("load_defaults", {}), ("self_test", {}), ("set_baud", {"baud": 1_000_000})),
        *(("set_unit_id", {"unit_id": 0xFFFFFFFF}), ("save", {}), ("get_hello", {})),
        *(("stop", {}), ("stop", {}), ("self_test", {}), ("load_defaults", {}), ("get_hello", {})),
    ]
    for name, values in commands:
        answers = [rig.command(name, **values) for rig in both]
        assert answers[0] == answers[1], (name, answers)
        for rig in both:
            rig.run(0.3 if name == "save" else 0.0)
        told = [hello_of(rig) for rig in both]
        for what in ("unit_id", "rows", "columns", "scanning", "baud", "ref_top_ohm"):
            assert getattr(told[0], what) == getattr(told[1], what), (name, what)
    for rig in both:
        assert len(rig.scans) > 20
        assert [scan.header["scan"] for scan in rig.scans] == list(range(len(rig.scans)))
        report = rig.frames("self_test_report")[-1]
        assert report["findings"] == ()
        assert len(report["code_min"]) == len(report["code_max"]) == 8
    # The same skin reads the same, but for the instant of the hold: this one does not move.
    np.testing.assert_array_equal(real.scans[-1].codes, model.scans[-1].codes)


@pytest.mark.simavr
@pytest.mark.parametrize("board", ["uno", "emulator"])
def test_a_new_region_goes_before_a_whole_scan_that_is_due(board: str) -> None:
    """The second scan after the command has it, and whole scans come all the same."""
    with rig_of(board) as rig:
        rig.must("configure", **DEFAULT)
        rig.must("start")
        for number in range(40):
            mask = 6 << number % 3
            rig.must("set_region", **(REGION | {"whole_every": 2, "row_mask": mask}))
            heard_us = rig.frames("ack")[-1]["time_us"]
            rig.run(0.02 + 0.001 * (number % 7))
            headers = (scan.header for scan in rig.scans)
            after = [each["row_mask"] for each in headers if each["time_us"] > heard_us]
            assert mask in after[:2]
        masks = [scan.header["row_mask"] for scan in rig.scans]
        assert masks.count(0xFF) > len(masks) / 4


# ------------------------------------------------------------- any request, and what it changes

u8, u16, u32 = st.integers(0, 255), st.integers(0, 0xFFFF), st.integers(0, 0xFFFFFFFF)
requests = st.fixed_dictionaries(
    {
        "rows": st.one_of(st.integers(0, 18), u8),
        "columns": st.one_of(st.integers(0, 18), u8),
        "rate_mhz": st.one_of(st.integers(0, 2_100_000), st.integers(0, 150_000), u32),
        "settle_us": st.one_of(st.integers(0, 3100), st.integers(0, 100), u16),
        "accuracy": st.one_of(st.sampled_from([0, 1, 2]), u8),
        "mode": st.one_of(st.sampled_from([0, 1, 2, 3]), u8),
    }
)
LIMITS = {
    "bad_rows": lambda asked: not 1 <= asked["rows"] <= 16,
    "bad_columns": lambda asked: not 1 <= asked["columns"] <= 16,
    "bad_rate": lambda asked: asked["rate_mhz"] and not 1000 <= asked["rate_mhz"] <= 50_000_000,
    "bad_settle": lambda asked: asked["settle_us"] > 3000,
    "bad_accuracy": lambda asked: asked["accuracy"] not in (0, 1, 2),
    "bad_mode": lambda asked: asked["mode"] not in (0, 1, 2, 3),
}


@pytest.fixture(scope="module", params=["emulator", pytest.param("uno", marks=pytest.mark.simavr)])
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    with rig_of(request.param) as opened:
        yield opened


@settings(max_examples=500)
@given(requests)
@example(DEFAULT | {"rate_mhz": 0})
@example(DEFAULT | {"rows": 1, "columns": 1, "rate_mhz": 50_000_000})
def test_any_configuration_is_taken_or_refused(rig: Rig, asked: dict[str, int]) -> None:
    """Refused for its first fault and without a consequence, or kept as asked for."""
    before = hello_of(rig)
    result = rig.command("configure", **asked)
    after = hello_of(rig)
    fault = next((name for name, broken in LIMITS.items() if broken(asked)), None)
    if fault is not None:
        assert result == fault
    if result != "ok":
        assert after == before
        assert result in (fault, "too_fast", "line_too_slow")
        return
    assert asked_for(after) == asked
    if asked["rate_mhz"]:
        assert after.rate_hz == pytest.approx(asked["rate_mhz"] / 1000, rel=0.002)
    assert after.settle_us >= asked["settle_us"]
    conversion_s = 13 * (32 << asked["accuracy"]) / 16e6
    assert after.scan_cycles / 16e6 >= after.readings * conversion_s


@settings(max_examples=200)
@given(st.lists(st.tuples(u8, st.binary(max_size=24)), max_size=10))
def test_no_frame_upsets_the_emulator(sent: list[tuple[int, bytes]]) -> None:
    rig = rig_of("emulator")
    results = {member for member in protocol.ENUMS["result"].values if member != "busy"}
    for frame_type, payload in sent:
        assert answer(rig, frame_type, payload) in results
    assert hello_of(rig).layout_crc == protocol.LAYOUT_CRC


@pytest.mark.simavr
@pytest.mark.parametrize(
    ("option", "reason"),
    [
        ("elf=/etc/passwd", "^no setting 'elf'"),
        ("bootloader=/dev/null", "is no Intel hex file"),
        ("bootloader=/none.hex", "cannot read '/none.hex': No such file"),
    ],
)
def test_the_simulator_takes_no_file_for_firmware(option: str, reason: str) -> None:
    with pytest.raises(PortError, match=reason) as refused:
        ohmskin.open(f"simavr://uno?{option}")
    assert "\n" not in str(refused.value)
