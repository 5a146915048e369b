# SPDX-License-Identifier: Apache-2.0
"""The wiring that platformio.ini has now, of the built firmware: `make test-wiring`.

The simulators are told the pins of platformio.ini by Debian's table of Arduino's pins, not by the
firmware. Each cell of the skin has a resistor of its own.
"""

from collections.abc import Callable

import numpy as np
import pytest

from firmware_helpers import assert_whole
from lockstep import BOARDS, LockstepSim, Rig, elf_of
from ohmskin.circuit.configurations import ratio_from_current
from ohmskin.link.codes import quantise
from pin_maps import of_platformio_ini, told_by
from second_simulator import SecondSim

pytestmark = [pytest.mark.simavr, pytest.mark.any_wiring]
HALF_ADC_CLOCK = 16  # clock cycles
IN_AVR8JS = pytest.param(SecondSim, id="avr8js", marks=pytest.mark.second_sim)


@pytest.mark.parametrize("simulator", [pytest.param(LockstepSim, id="simavr"), IN_AVR8JS])
@pytest.mark.parametrize("board", BOARDS)
def test_every_cell_is_read(
    board: str, simulator: Callable[..., LockstepSim], rng: np.random.Generator
) -> None:
    wiring, number = of_platformio_ini(board)
    elf, lines = elf_of(board), wiring.lines
    assert told_by(elf) == (wiring.numbers, wiring.ref_ohm), (
        "the firmware was built before platformio.ini had these flags: run 'make firmware'"
    )
    if simulator is SecondSim and lines > 16:
        pytest.skip("avr8js has multiplexers of 16 channels here")
    with Rig(board, simulator(board, elf, pins=wiring.pins(board)), lines) as rig:
        rig.run(rig.sim.boot_s)
        # So that codes differ from cell to cell, the resistors are even in their current.
        current = 1 / (sum(wiring.ref_ohm) + np.array([1e6, 1e3]))
        currents = rng.permuted(np.linspace(*current, lines * lines)).reshape(lines, lines)
        expected = quantise(ratio_from_current(currents, *map(float, wiring.ref_ohm)))
        far = rng.integers(1024, size=expected.shape, dtype=np.uint16)  # whatever may be there
        rig.set_codes(np.concatenate([expected, far], axis=-1), rng)
        for mode in ("near", "far"):
            rig.start_scan(rate_mhz=0, rows=lines, columns=lines, mode=mode)
            rig.run(0.5 * (lines / 16) ** 2)
            rig.must("stop")
            assert_whole(rig)
            if mode == "near":
                wrong = np.argwhere((rig.scans[0].codes != expected).any(axis=2))
                assert wrong.tolist() == [], "cells (row, column) that read wrong"
        rig.must("self_test", limit_s=1.0)
        assert rig.frames("self_test_report")[-1]["findings"] == ()
        hello, stats = rig.hello(), rig.sim.stats()
    assert (hello["ref_top_ohm"], hello["ref_bottom_ohm"]) == wiring.ref_ohm
    assert hello["wiring"] == number
    assert stats.get("undriven", 0) == stats.get("floating_pins", 0) == 0
    assert stats.get("change_after_hold_cycles_min", HALF_ADC_CLOCK) >= HALF_ADC_CLOCK
    says = f"another one, 0x{number:04X}" if number else "as docs/build.md has it"
    top, bottom = wiring.ref_ohm
    name = "avr8js" if simulator is SecondSim else "simavr"
    print(f"\n{board} in {name}: all {lines * lines} cells read right, each with its own resistor")
    print(f"  {wiring}")
    print(f"  'ohmskin info' shows: wiring {says}; references {top} Ohm top, {bottom} Ohm bottom")
