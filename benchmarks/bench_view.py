# SPDX-License-Identifier: Apache-2.0
"""Measure the page of ``ohmskin view``: an emulated 8x8 skin at 90 Hz, one board, one browser.

    make bench-view                                   (needs Chromium, from make setup)
    .venv/bin/python benchmarks/bench_view.py --minutes 10

The board, the server and headless Chromium are processes of their own on this machine; the board is
at a pseudo-terminal, Chromium renders in software. Says at the end what the machine had to do.

latency_ms_p50, _p99   from when the last byte of a scan was read (`Scan.host_time_s`) until the
                       page has handed the frame with it to the compositor: the message that a
                       requestAnimationFrame posts to itself after drawing. A screen adds its own
                       refresh. Page and host both read CLOCK_MONOTONIC; what lies between their
                       zeros is taken from the shortest of many questions to the page, as is
                       clock_error_ms, at most half that question's time.
latency_growth_ms      median of the last tenth less that of the first tenth: what queues up, grows.
frames_per_s           frames that were drawn, each with another scan.
refreshes_per_s        frames that the browser asked for: in the others there was no newer scan.
scans_per_s            scans of the board meanwhile, by their numbers.
longest_gap_ms         between two frames.
server_cpu_percent     of one core: estimator ('joint'), server and reading.
page_bytes             of all files of the page.
"""

from __future__ import annotations

import os
import shutil
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from bars import at_least, at_most, run_minutes  # beside this file
from served import started  # beside this file

SCENE = "emulator://8x8?scene=moving"
PAGE = Path(__file__).parents[1] / "host" / "ohmskin" / "view" / "page"
SETTLE_S = 5.0  # until the page has its first scans. Chosen.
CLOCK_TRIES = 200  # questions to the page, of which the shortest counts. Chosen.
COLLECT = """() => {
    window.drawn = [];
    window.refreshes = 0;
    const count = () => {
        refreshes++;
        requestAnimationFrame(count);
    };
    requestAnimationFrame(count);
    document.querySelector(".panel").addEventListener("drawn", ({ detail }) => {
        drawn.push([detail.scan, detail.host_time_s, detail.nowMs]);
    });
}"""


def cpu_s(pid: int) -> float:
    """User and system time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def clock_offset(page: Any) -> tuple[float, float]:
    """What CLOCK_MONOTONIC says when the page's clock says 0 [ms], and by how much at most not."""
    trips = []
    for _ in range(CLOCK_TRIES):
        asked_s = time.monotonic()
        page_ms = page.evaluate("performance.now()")
        answered_s = time.monotonic()
        half_ms = 500 * (answered_s - asked_s)
        trips.append((half_ms, 500 * (asked_s + answered_s) - page_ms))
    half_ms, offset_ms = min(trips)
    return offset_ms, half_ms


def measure(minutes: float) -> dict[str, Any]:
    """All figures, as the JSON line has them."""
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium")
    if chromium is None:
        sys.exit("needs Chromium, which 'make setup' installs")
    with ExitStack() as stack:
        _, port = stack.enter_context(started("emulate", SCENE))
        view = ("view", port, "--http-port", "0", "--no-browser")
        server, url = stack.enter_context(started(*view))
        playwright = stack.enter_context(sync_playwright())
        browser = playwright.chromium.launch(
            executable_path=chromium,
            args=[] if os.geteuid() else ["--no-sandbox"],
        )
        stack.callback(browser.close)
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(url)
        page.wait_for_timeout(1000 * SETTLE_S)
        offset_ms, error_ms = clock_offset(page)
        page.evaluate(COLLECT)
        before_s, begin_s = cpu_s(server.pid), time.monotonic()
        page.wait_for_timeout(60_000 * minutes)
        seconds = time.monotonic() - begin_s
        drawn, refreshes = np.array(page.evaluate("drawn")), page.evaluate("refreshes")
        used_s = cpu_s(server.pid) - before_s
        missed = page.locator(".missed").inner_text()
    numbers, host_s, drawn_ms = drawn.T
    latency_ms = drawn_ms + offset_ms - 1000 * host_s
    tenth = max(1, len(latency_ms) // 10)
    growth_ms = np.median(latency_ms[-tenth:]) - np.median(latency_ms[:tenth])
    assert np.all(np.diff(numbers) > 0), "a scan was drawn twice, or after a newer one"
    print(
        f"{missed} missed by the host, longest latency {latency_ms.max():.0f} ms", file=sys.stderr
    )
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores", file=sys.stderr)
    return {
        "minutes": round(seconds / 60, 2),
        "latency_ms_p50": round(float(np.median(latency_ms)), 1),
        "latency_ms_p99": round(float(np.percentile(latency_ms, 99)), 1),
        "latency_growth_ms": round(float(growth_ms), 2),
        "clock_error_ms": round(error_ms, 2),
        "frames_per_s": round(len(drawn) / seconds, 1),
        "refreshes_per_s": round(refreshes / seconds, 1),
        "scans_per_s": round((numbers[-1] - numbers[0]) / seconds, 1),
        "longest_gap_ms": round(float(np.diff(drawn_ms).max()), 1),
        "server_cpu_percent": round(100 * used_s / seconds, 1),
        "page_bytes": sum(file.stat().st_size for file in PAGE.iterdir()),
    }


BARS = (
    at_most("latency_ms_p50", 40),
    at_most("latency_growth_ms", 5),
    at_least("frames_per_s", 55),
    at_most("page_bytes", 60_000),
)


if __name__ == "__main__":
    sys.exit(run_minutes(__doc__, measure, BARS, minutes=1.0, least_minutes=0.1))
