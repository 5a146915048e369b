# SPDX-License-Identifier: Apache-2.0
"""What a person sees in a shell or a notebook, and ``async for``."""

import asyncio
import re
from contextlib import suppress
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

import ohmskin
from calibrations import of_scene
from recordings import write_recording
from stepped import stepped

PORT = "emulator://8x8?scene=ghost&begin=0&seed=1"


def test_each_is_a_line() -> None:
    with ohmskin.open(PORT) as bare:
        scan = bare.latest()
        assert repr(bare) == f"<Session {PORT}: unit 0, 8x8 cells at 90.0 Hz>"
        pattern = r"<Scan \d+: 8x8 cells, mode near, missed \d+ before it>"
        assert re.fullmatch(pattern, repr(scan))
        known = ohmskin.SkinKnowledge.of(bare.info)
        estimate = ohmskin.make_estimator("joint", known).estimate(scan.ratio)
        pattern = r"<Estimate of 8x8 cells: 3 touched, converged, chi-square \d\.\d\d>"
        assert re.fullmatch(pattern, repr(estimate))
    with ohmskin.open(PORT, calibration=of_scene("ghost")) as skin:
        assert repr(skin).endswith("unit 0, 8x8 cells at 90.0 Hz, forces by 'touch'>")
        assert repr(skin.latest()).startswith("<ForceScan ")


def cells_of(html: str) -> list[tuple[float, int]]:
    """Value and hue of each cell of a heat map."""
    found = re.findall(r'<td title="([^"]+)" style="background: hsl\((\d+) ', html)
    return [(float(value), int(hue)) for value, hue in found]


def test_a_notebook_shows_heat_maps_on_a_scale_that_stays() -> None:
    with ohmskin.open(PORT, calibration=of_scene("ghost")) as skin:
        scan = skin.latest()
    for shown, values, full_scale in (
        (scan, scan.force_n, 10),
        (scan.estimate, 1e6 * scan.estimate.cell_siemens, 200),
        (ohmskin.Scan(scan.codes, 1, 1, 1.0, 0), 1e3 * scan.ratio[:, :, 1], 200),
    ):
        cells = cells_of(shown._repr_html_())
        assert [value for value, _ in cells] == pytest.approx(values.ravel(), rel=1e-2, abs=1e-9)
        shades = np.clip(1 + np.log10(np.clip(values, 1e-9, None) / full_scale) / 2, 0, 1)
        assert [hue for _, hue in cells] == pytest.approx(60 - 60 * shades.ravel(), abs=0.51)
        assert shown._repr_html_().count("<tr>") == 8


def test_text_in_a_notebook_is_text() -> None:
    scan = ohmskin.Scan(np.zeros((1, 1, 4), np.uint16), 1, 1, 1.0, 0)
    assert "&lt;Scan 1: 1x1 cells" in scan._repr_html_()


@pytest.mark.parametrize("calibrated", [False, True])
def test_a_loop_goes_on_while_scans_are_waited_for(calibrated: bool) -> None:
    more = {"calibration": of_scene("ghost")} if calibrated else {}
    turns = 0

    async def turn() -> None:
        nonlocal turns
        while True:
            turns += 1
            await asyncio.sleep(0.001)

    async def read() -> list[ohmskin.Scan]:
        other, scans = asyncio.create_task(turn()), []
        with ohmskin.open(PORT, **more) as skin:
            async for scan in skin:
                scans.append(scan)
                if len(scans) == 10:
                    break
        other.cancel()
        return scans

    scans = asyncio.run(read())
    assert [each.number - scans[0].number for each in scans] == list(range(10))
    assert isinstance(scans[0], ohmskin.ForceScan) == calibrated
    assert turns > 10


def test_who_stops_waiting_for_a_scan_is_given_it_next() -> None:
    """A timeout ended the whole iteration, and the scan that came was lost."""

    async def read() -> list[int]:
        numbers: list[int] = []
        with ohmskin.open("emulator://2x2?rate=20") as skin:
            scans = aiter(skin)
            while len(numbers) < 5:
                with suppress(TimeoutError):
                    numbers.append((await asyncio.wait_for(anext(scans), 0.001)).number)
        return numbers

    numbers = asyncio.run(read())
    assert numbers == list(range(numbers[0], numbers[0] + 5))


def test_async_ends_with_a_recording(tmp_path: Path) -> None:
    path, bench = tmp_path / "a.mcap", stepped("emulator://2x2")
    write_recording(path, bench.info, islice(bench, 7))

    async def count() -> int:
        with ohmskin.open(f"replay://{path}?speed=0") as skin:
            return len([scan async for scan in skin])

    assert asyncio.run(count()) == len(ohmskin.load_recording(path).scans) == 7


def test_an_estimator_says_what_it_is_made_of() -> None:
    for given in (stepped("emulator://2x2").info, 8):
        with pytest.raises(TypeError, match=r"'joint' is made of .* SkinKnowledge\.of\(skin\.info"):
            ohmskin.make_estimator("joint", given)
