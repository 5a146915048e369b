# SPDX-License-Identifier: Apache-2.0
"""Measure the built firmware in the AVR simulator, cycle by cycle; nothing here depends on this
machine's speed, and two runs give the same numbers.

    make bench-firmware

The JSON object has an entry for each board; other_boards.py beside this file says what `pico`,
`arduino` and `pins` have, modes_and_regions.py what figures of modes half and quick, of regions and
interrupts are. What is measured how:

scan_hz, jitter_us    from the instants at which the converter holds the first reading of a scan,
                      at the 90 Hz setting, 8x8. Jitter is the largest deviation from a grid of
                      the period that `hello` reports, over the whole run.
max_scan_hz           rate 0, 8x8, 1 Mbaud: scans that reached the host whole, per simulated second.
scan_hz_16x16         the same with 16x16.
shortest_scan_hz      the same as max_scan_hz with the shortest slots that there are.
wrong, readings       readings that differ from the exact code of the skin's table at the instant of
                      the hold, in the runs at 90 Hz (wrong_90hz, ...) and with the shortest slots
                      (wrong_max, ...), and their sums.
settle_us_min         from the last change of the address or drive pins, or of the converter's
                      channel, to the hold, at 90 Hz.
cpu_percent           cycles in which the main loop found nothing to do are idle; the rest is load,
                      interrupts included. cpu_percent_max: with the shortest slots.
settle_us_min_max     as settle_us_min, at rate 0.
lost_scans, ...       of all runs together.
wrong_late_converter  readings that came and are wrong where conversions take 1 to 32 cycles longer
                      than the data sheet says, at 90 Hz and with the shortest slots of each ADC
                      clock; a scan that is dropped and counted is right.
capacitor_error_lsb_90hz, capacitor_error_lsb_max_rate
                      error of a reading by 14 pF of sample capacitor and 100 pF at a node of 30
                      kOhm, after a reading of the scale's other end, at 90 Hz and rate 0: mean over
                      64 cells, each at another place within its code; the largest of a to d.
lines_error_lsb_90hz  error of a cell's current, rms over the skin: three corners at 5 kOhm, 30 pF a
                      line, charged through the cells; _100pf: with 100 pF.
opens_s               longest time to open a board (Uno, old Nano; Mega) behind its real boot loader
                      that is reset 0 to 1.8 s after its port was opened, in real time.
wrong_far, readings_far
                      the same as wrong_90hz and readings_90hz in mode far; scan_hz_far: as scan_hz.
cell_voltage_error_lsb_far, current_error_lsb_far
                      largest error in mode far of e - f of a pressed cell, and of its current, (1 -
                      a + b) / 2: three corners at 5 kOhm, 100 pF a node, 30 pF a line.
wrong_second_simulator, readings_second_simulator
                      the same as wrong and readings, in avr8js (firmware/second_sim), 8x8: a third
                      each at 90 Hz, 120 Hz and rate 0. wrong_far_second_simulator,
                      readings_far_second_simulator: in mode far at 90 Hz.
flash_bytes           avr-size, text + data.
ram_bytes             avr-size, data + bss; the stack comes on top.

During the runs the host asks for `hello` about once every ten scans, and the skin changes as often,
each time to 1024 random codes, a third each at the lower and upper edge of their step.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from bars import QUICK, Part, about, at_least, at_most, options, report  # beside this file
from desk import near_admittance
from lockstep import BOARDS, CPU_HZ, Rig, elf_of
from modes_and_regions import measure_modes, measure_modes_second  # beside this file
from ohmskin.arrays import Float
from ohmskin.circuit.configurations import READING_SIGN
from ohmskin.circuit.skin import Skin, all_readings, end_admittance
from ohmskin.emulate.scenes import Scene
from ohmskin.emulate.simavr import SimavrLink
from ohmskin.link import protocol
from ohmskin.link.session import Session
from other_boards import measure_arduino, measure_pico, measure_pins  # beside this file
from second_simulator import SecondSim

# Readings that are wanted: at 90 Hz, and with the shortest slots; in mode far; in the second
# simulator, which is slow. Chosen: a fault of one reading in so many would show.
READINGS_WANTED, READINGS_WANTED_FAR, READINGS_WANTED_SECOND = 1_000_000, 500_000, 20_000
LATE_CYCLES = (1, 2, 8, 32)  # by which conversions are late, of the converter's clock of 16 MHz
ADC_CLOCKS = ("usual", "fine", "finest")
# Three of a rectangle's corners at 5 kOhm, the rest at 1 MOhm, no wires.
_CELLS = np.full((8, 8), 1e-6)
_CELLS[[2, 2, 5], [2, 5, 2]] = 1 / 5e3
THREE_CORNERS = Skin(_CELLS, *np.zeros((2, 8, 8)))
# Boards, and boot loaders that they are sold with: the second is an old Nano's.
_OLD_NANO = (
    "/usr/share/arduino/hardware/arduino/avr/bootloaders/atmega/ATmegaBOOT_168_atmega328.hex"
)
LOADERS = (("uno", "board"), ("uno", _OLD_NANO), ("megaatmega2560", "board"))


# ------------------------------------------------------------------------------- measurements


def _measure_run(
    rig: Rig, rng: np.random.Generator, readings: int, progress: str
) -> dict[str, Any]:
    """Figures of the scan in progress over at least `readings` readings."""
    period = rig.hello()["scan_cycles"]
    rig.run_cycles(3 * period)
    size = rig.scans[0].codes.size
    rig.sim.reset_stats()
    damaged, answers, asked = rig.damaged, len(rig.frames("ack")), 0
    told = time.monotonic()
    while not asked or len(rig.scans) * size < readings:
        rig.randomize(rng)
        rig.send("get_hello")
        asked += 1
        rig.run_cycles(int(rng.integers(5 * period, 15 * period)))
        rig.take_holds()
        if time.monotonic() - told > 5:
            told = time.monotonic()
            done = 100 * len(rig.scans) * size / readings
            print(f"{rig.board}: {progress}, {done:.0f} %", file=sys.stderr, flush=True)
    stats = rig.sim.stats()
    rig.must("stop")
    check = rig.check()
    answers = len(rig.frames("ack")) - 1 - answers  # but stop's
    starts = check.start_cycles
    grid = starts[0] + period * np.arange(len(starts))
    made = rig.scans[-1].header["scan"] + 1
    return {
        "made_hz": CPU_HZ * (len(starts) - 1) / float(starts[-1] - starts[0]),
        "delivered_hz": CPU_HZ * (len(rig.scans) - 1) / float(starts[made - 1] - starts[0]),
        "jitter_us": float(np.abs(starts - grid).max()) / (CPU_HZ / 1e6),
        "wrong": check.wrong,
        "readings": check.readings,
        "settle_us_min": min(stats["settle_cycles_min"], stats["channel_settle_cycles_min"])
        / (CPU_HZ / 1e6),
        "cpu_percent": stats["cpu_percent"],
        "lost": made - len(rig.scans),
        "damaged": rig.damaged - damaged,
        "unanswered": asked - answers,
    }


def _sizes(elf: Path) -> tuple[int, int]:
    """Bytes of flash, and of RAM without the stack."""
    done = subprocess.run(["avr-size", elf], capture_output=True, text=True, check=True)
    text, data, bss = map(int, done.stdout.splitlines()[1].split()[:3])
    return text + data, data + bss


def measure_second(board: str, part: Part) -> dict[str, int]:
    """Readings in the second simulator, and how many of them are wrong."""
    rng = np.random.default_rng(10 + BOARDS.index(board))
    third = part.of(READINGS_WANTED_SECOND) / 3
    runs = [("", "near", rate_mhz, third) for rate_mhz in (90_000, 120_000, 0)]
    runs.append(("_far", "far", 90_000, part.of(READINGS_WANTED_FAR)))
    found: dict[str, int] = {}
    with Rig(board, SecondSim(board)) as rig:
        rig.run(0.05)
        rig.must("set_baud", baud=protocol.CONSTANTS["baud_fast"])
        rig.run(0.01)
        for name, mode, rate_mhz, wanted in runs:
            rig.randomize(rng)
            rig.start_scan(rate_mhz=rate_mhz, mode=mode)
            period = rig.hello()["scan_cycles"]
            while sum(s.codes.size for s in rig.scans) < wanted:
                rig.run_cycles(int(rng.integers(period, 5 * period)))
                rig.take_holds()
                rig.randomize(rng)
            rig.must("stop")
            check = rig.check()
            for what, count in (("readings", check.readings), ("wrong", check.wrong)):
                key = f"{what}{name}_second_simulator"
                found[key] = found.get(key, 0) + count
        return found | measure_modes_second(rig, rng, part)


def _measure_late(board: str, rng: np.random.Generator) -> dict[str, int]:
    """Readings where conversions take longer than the data sheet says, and how many are wrong."""
    readings = wrong = 0
    scans: list[dict[str, Any]] = [{"rate_mhz": 90_000}]
    scans += [{"rate_mhz": 0, "settle_us": 1, "accuracy": clock} for clock in ADC_CLOCKS]
    for scan in scans:
        for late in LATE_CYCLES:
            with Rig(board) as rig:
                rig.run(0.05)
                codes = rig.randomize(rng)[:8, :8, :4]
                rig.sim.set(late_cycles=late)
                rig.start_scan(**scan)
                rig.run(0.2)
                readings += sum(read.codes.size for read in rig.scans)
                wrong += sum(int((read.codes != codes).sum()) for read in rig.scans)
    return {"wrong_late_converter": wrong, "readings_late_converter": readings}


def _errors_lsb(board: str, ratio: Float, scan: dict[str, Any], **settings: float) -> Float:
    """Codes of an 8x8 skin with these settings of the simulator, less those without [LSB].

    Means over a second: with noise, steps of codes average out; without, a code hides what is less
    than it. In mode near the skin has no far ends.
    """
    codes = []
    noise = {name: settings[name] for name in {"noise_lsb"} & settings.keys()}
    for each in (noise, settings):
        with Rig(board) as rig:
            rig.sim.set_table(ratio)
            rig.sim.set(**each)
            if "line_pf" in each:
                far = scan.get("mode") == "far"
                siemens = (end_admittance if far else near_admittance)(THREE_CORNERS)
                rig.sim.request("C", bytes([0x80 * far | 8]) + siemens.tobytes())
            rig.run(0.05)
            rig.start_scan(**scan)
            rig.run(1.0)
            codes.append(np.mean([scan.codes for scan in rig.scans[2:]], axis=0))
    return np.asarray(codes[1] - codes[0])


def capacitor_error_lsb(board: str, rate_mhz: int, **settings: float) -> float:
    """Error of a reading by these capacitances, after one of the scale's other end [LSB].

    Mean over the cells, the largest of a to d. An error of less than a code changes few codes. So
    each cell is at another place within its code, and as many change as the error is large: it is
    found to 1/64 LSB. No code is the first or the last, beyond which errors would not show.
    """
    within = np.zeros((16, 16, 1))
    within[:8, :8, 0] = (np.random.default_rng(0).permutation(64).reshape(8, 8) + 0.5) / 64
    opposite = (np.array([1022, 1, 1022, 1]) + within) / 1024
    error = _errors_lsb(board, opposite, {"rate_mhz": rate_mhz}, **settings)
    return float(np.abs(error.mean(axis=(0, 1))).max())


def _measure_nodes(board: str) -> dict[str, float]:
    """What the sample capacitor and the lines' capacitances do to readings [LSB]."""
    corners = all_readings(THREE_CORNERS, end_admittance(THREE_CORNERS))
    found = {}
    for name, rate_mhz in (("90hz", 90_000), ("max_rate", 0)):
        error_lsb = capacitor_error_lsb(board, rate_mhz, sample_pf=14, node_pf=100)
        found[f"capacitor_error_lsb_{name}"] = round(error_lsb, 2)
    for name, line_pf in (("", 30), ("_100pf", 100)):
        lines = {"line_pf": line_pf, "cell_pf": 2, "node_pf": 50, "noise_lsb": 0.5}
        error = _errors_lsb(board, corners, {}, **lines)
        current = (error * READING_SIGN).mean(axis=2)
        found[f"lines_error_lsb_90hz{name}"] = round(float(np.sqrt((current**2).mean())), 2)
    desk = {"sample_pf": 14, "input_ohm": 10e3, "node_pf": 100, "line_pf": 30, "cell_pf": 2}
    error = _errors_lsb(board, corners, {"mode": "far"}, noise_lsb=0.5, **desk)
    a, e, b, f = np.moveaxis(error[_CELLS > 1e-5], -1, 0)
    found["cell_voltage_error_lsb_far"] = round(float(np.abs(e - f).max()), 2)
    found["current_error_lsb_far"] = round(float(np.abs(b - a).max() / 2), 2)
    return found


def measure_opening(part: Part) -> dict[str, float]:
    """The longest time to open a board [s], in real time: by board, the Nano among the Unos.

    Each is behind its boot loader, and is reset some time after its port was opened.
    """
    phases = [(board, loader, 0.2 * n) for board, loader in LOADERS for n in range(part.of(10))]
    found: dict[str, float] = {}
    for board, loader, reset_s in phases:
        print(f"{board}: opening, reset after {reset_s:.1f} s", file=sys.stderr, flush=True)
        link = SimavrLink(board, Scene(), settings={"bootloader": loader})
        reset = threading.Timer(reset_s, link.sim.request, ["X"])
        started_s = time.monotonic()
        reset.start()
        try:
            Session(link).close()
        finally:
            reset.cancel()
        taken_s = round(time.monotonic() - started_s, 2)
        found[board] = max(found.get(board, 0.0), taken_s)
    return found


def measure(board: str, part: Part) -> dict[str, Any]:
    """All figures of one board, as the JSON line has them."""
    rng = np.random.default_rng(BOARDS.index(board))
    with Rig(board) as rig:
        rig.run(0.05)
        rig.randomize(rng)
        rig.start_scan()
        normal = _measure_run(rig, rng, part.of(READINGS_WANTED), "90 Hz")
        rig.must("set_baud", baud=protocol.CONSTANTS["baud_fast"])
        rig.run(0.01)
        rig.start_scan(rate_mhz=0)
        fastest = _measure_run(rig, rng, part.of(READINGS_WANTED // 5), "rate 0")
        rig.start_scan(rate_mhz=0, rows=16, columns=16)
        large = _measure_run(rig, rng, part.of(READINGS_WANTED // 5), "rate 0, 16x16")
        rig.start_scan(rate_mhz=0, settle_us=1)
        shortest = _measure_run(rig, rng, part.of(READINGS_WANTED), "shortest slots")
        rig.start_scan(mode="far")
        far = _measure_run(rig, rng, part.of(READINGS_WANTED_FAR), "far, 90 Hz")
    with Rig(board) as rig:
        rig.run(0.05)
        modes = measure_modes(rig, rng, part)
    flash, ram = _sizes(elf_of(board))
    runs = (normal, fastest, large, shortest, far)
    counted = {"90hz": normal, "max": shortest, "16x16": large, "far": far}
    return {
        "scan_hz": round(normal["made_hz"], 4),
        "jitter_us": round(normal["jitter_us"], 3),
        "max_scan_hz": round(fastest["delivered_hz"], 3),
        "scan_hz_16x16": round(large["delivered_hz"], 3),
        "shortest_scan_hz": round(shortest["delivered_hz"], 3),
        "wrong": normal["wrong"] + fastest["wrong"] + shortest["wrong"],
        "readings": normal["readings"] + fastest["readings"] + shortest["readings"],
        **{f"wrong_{name}": run["wrong"] for name, run in counted.items()},
        **{f"readings_{name}": run["readings"] for name, run in counted.items()},
        "scan_hz_far": round(far["made_hz"], 4),
        **modes,
        **_measure_late(board, rng),
        **_measure_nodes(board),
        "settle_us_min": round(min(normal["settle_us_min"], far["settle_us_min"]), 3),
        "settle_us_min_max": round(fastest["settle_us_min"], 3),
        "cpu_percent": round(normal["cpu_percent"], 2),
        "cpu_percent_max": round(shortest["cpu_percent"], 2),
        "lost_scans": sum(run["lost"] for run in runs),
        "damaged_frames": sum(run["damaged"] for run in runs),
        "unanswered_commands": sum(run["unanswered"] for run in runs),
        "flash_bytes": flash,
        "ram_bytes": ram,
    }


BARS = (
    about("scan_hz", 90, 0.05),
    at_most("jitter_us", 2),
    at_least("max_scan_hz", 90),
    at_least("scan_hz_16x16", 22.5),
    at_least("shortest_scan_hz", 130),
    at_most("wrong", 0),
    at_most("wrong_16x16", 0),
    at_least("readings_90hz", READINGS_WANTED),
    at_least("readings_max", READINGS_WANTED),
    about("scan_hz_far", 90, 0.05),
    at_most("wrong_far", 0),
    at_least("readings_far", READINGS_WANTED_FAR),
    at_most("wrong_far_second_simulator", 0),
    at_least("readings_far_second_simulator", READINGS_WANTED_FAR),
    at_most("cell_voltage_error_lsb_far", 1),
    at_most("current_error_lsb_far", 3),
    at_most("wrong_second_simulator", 0),
    at_least("readings_second_simulator", READINGS_WANTED_SECOND),
    at_least("settle_us_min", 20),
    at_least("settle_us_min_max", 20),
    at_most("wrong_late_converter", 0),
    at_least("readings_late_converter", 50_000),
    at_most("capacitor_error_lsb_90hz", 0.5),
    at_most("capacitor_error_lsb_max_rate", 0.5),
    at_most("lines_error_lsb_90hz", 1.2),
    at_most("lines_error_lsb_90hz_100pf", 6),
    at_most("opens_s", 8),
    at_least("half_8x8_hz", 180),
    at_least("quick_8x8_hz", 350),
    at_least("half_16x16_hz", 45),
    at_least("quick_16x16_hz", 90),
    at_least("region_3x3_quick_hz", 1699),
    at_least("region_3x3_half_hz", 1199),
    at_least("region_3x3_quick_whole10_hz", 1500),
    at_most("dropped_modes", 0),
    at_least("readings_modes", 2_000_000),
    at_most("wrong_modes", 0),
    at_least("readings_modes_second_simulator", 1_000_000),
    at_most("wrong_modes_second_simulator", 0),
    at_most("interrupt_cycles_max", 270),
    at_most("lost_scans", 0),
    at_most("damaged_frames", 0),
    at_most("unanswered_commands", 0),
)
PICO_BARS = (
    at_most("wrong", 0),
    at_least("readings", 2_000_000),
    at_least("max_scan_hz", 170),
    at_least("half_8x8_hz", 340),
    at_least("scan_hz_16x16", 42),
    at_most("saves_lost", 0),
    at_most("storms_failed", 0),
    at_most("flash_bytes", 40_000),
)
ARDUINO_BARS = (at_most("wrong", 0), at_least("scan_hz", 16.99), at_most("stamp_error_ms", 1))
PINS_BARS = (at_most("wrong", 0), at_least("maps", 6), at_least("readings", 2_400_000))
UNO_BARS = (at_most("flash_bytes", 13_000), at_most("ram_bytes", 1200))


OTHERS = {
    "arduino": (measure_arduino, ARDUINO_BARS),
    "pins": (measure_pins, PINS_BARS),
    "pico": (measure_pico, PICO_BARS),
}


def main() -> int:
    part: Part = options(__doc__).parse_args().part
    with ProcessPoolExecutor(len(BOARDS)) as pool:
        # What takes longest first.
        others = {name: pool.submit(measure, part) for name, (measure, _) in OTHERS.items()}
        boards = {
            board: [pool.submit(each, board, part) for each in (measure_second, measure)]
            for board in BOARDS
        }
        figures: dict[str, Any] = {
            board: {key: value for part_of in parts for key, value in part_of.result().items()}
            for board, parts in boards.items()
        }
        figures |= {name: part_of.result() for name, part_of in others.items()}
    for board, opens_s in measure_opening(part).items():
        figures[board]["opens_s"] = opens_s
    all_met = True
    for name, measured in figures.items():
        print(f"\n{name}")
        bars = OTHERS[name][1] if name in OTHERS else BARS
        all_met &= report(measured, (*bars, *UNO_BARS) if name == "uno" else bars)
    print(json.dumps(figures))
    return 0 if all_met or part is QUICK else 1


if __name__ == "__main__":
    sys.exit(main())
