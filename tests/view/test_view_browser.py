# SPDX-License-Identifier: Apache-2.0
"""``ohmskin view`` in a browser: what somebody sees, hears and does at the page."""

import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from calibrations import half_doubtful, of_scene
from command_line import ENVIRONMENT, Done, finish
from ohmskin.emulate.scenes import BOTTOM_WIRE_OHM, TOP_WIRE_OHM
from ohmskin.estimate.knowledge import WireOhm
from ohmskin.record.recording import load_recording
from ports import Serve

pytestmark = pytest.mark.browser

GHOST = "emulator://8x8?scene=ghost&begin=0&seed=1"
PHONE = {"width": 360, "height": 740}
LIMIT_MS = 15_000

Panel = Any  # a locator of Playwright's, which is imported only where there is a browser


class Server(NamedTuple):
    folder: Path
    url: str


@contextmanager
def serving(folder: Path, *arguments: str) -> Iterator[Server]:
    """``ohmskin view`` as a process, without boards until a page opens one; Ctrl-C ends it."""
    call = [sys.executable, "-m", "ohmskin", "view", "--http-port", "0", "--no-browser"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([*call, *arguments], cwd=folder, env=ENVIRONMENT, **pipes) as process:
        try:
            yield Server(folder, process.stdout.readline().strip())
            process.send_signal(signal.SIGINT)
            done = finish(process)
            assert done == Done(0, "", done.err)
            # Only of boards that tests pulled out.
            assert all("is gone: is the board still" in line for line in done.err.splitlines())
        finally:
            process.kill()


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("view")
    # Leads that nobody has told make the force of a hard touch uncertain.
    told = WireOhm(TOP_WIRE_OHM, BOTTOM_WIRE_OHM, lead=0.0)
    replace(of_scene("ghost"), nominal_wire_ohm=told).save(folder / "skin.json")
    half_doubtful("ghost", unit_id=7).save(folder / "doubtful.json")
    with serving(folder, "--calibration", "skin.json", "--calibration", "doubtful.json") as server:
        yield server


@pytest.fixture
def new_page(browser: Any, server: Server) -> Iterator[Callable[..., Any]]:
    """A function that opens the page; no page may ask another host, or complain."""
    contexts, requests, complaints = [], [], []

    def make(url: str = server.url, **options: Any) -> Any:
        context = browser.new_context(**{"viewport": {"width": 1280, "height": 800}, **options})
        context.set_default_timeout(LIMIT_MS)
        contexts.append(context)
        page = context.new_page()
        page.on("request", lambda request: requests.append(request.url))
        page.on("websocket", lambda socket: requests.append(socket.url.replace("ws:", "http:")))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", lambda said: complaints.append(said.text) if said.type == "error" else 0)
        page.goto(url)
        return page

    yield make
    foreign = [url for url in requests if not url.startswith(server.url.partition("?")[0])]
    assert requests
    for context in contexts:
        for page in context.pages:
            close = page.get_by_role("button", name="Close")
            for left in reversed(range(close.count())):
                close.first.click()
                close.nth(left).wait_for(state="detached")
        context.close()
    assert foreign == []
    assert complaints == []


@pytest.fixture
def page(new_page: Callable[..., Any]) -> Any:
    return new_page()


def open_board(page: Any, port: str) -> Panel:
    """Types a port, and waits for its first scan on the screen."""
    field = page.get_by_label("Serial port or URL")
    field.fill(port)
    field.press("Enter")
    panel = page.get_by_role("region", name=port, exact=True)
    has_text(panel, ".status", "scanning")
    has_text(panel, ".rate", r"\d Hz")
    return panel


def switch(panel: Panel, name: str, *, on: bool = True) -> None:
    """Shows a part of a panel, or hides it. Browsers of a test remember nothing of another."""
    panel.get_by_label(name, exact=True).set_checked(on)


def has_text(panel: Panel, query: str, pattern: str) -> str:
    """Waits until the text is as wanted, and gives it."""
    found = panel.locator(query)
    deadline_s = time.monotonic() + LIMIT_MS / 1000
    while not re.search(pattern, text := found.inner_text()):
        assert time.monotonic() < deadline_s, f"{query}: {text!r}, not {pattern!r}"
        panel.page.wait_for_timeout(30)
    return text


def colours(panel: Panel, name: str, row: int, column: int) -> set[int]:
    """Those of a cell in a heat map, within its outline: several where it is hatched."""
    pixels = panel.locator(f".{name} .cells").evaluate(
        """(canvas, [row, column]) => {
            const ratio = canvas.width / canvas.clientWidth;
            const side = Math.floor((canvas.clientHeight - 20) / 8);
            const at = (index) => (20 + index * side + 4) * ratio;
            const length = (side - 8) * ratio;
            const image = canvas.getContext("2d").getImageData(at(column), at(row), length, length);
            return [...new Set(new Uint32Array(image.data.buffer))];
        }""",
        [row, column],
    )
    return set(pixels)


def test_the_ghost_is_in_the_raw_reading_and_not_in_the_estimate(page: Any) -> None:
    panel = open_board(page, GHOST)
    has_text(panel, ".estimate .count", "by ‘touch’: 3 cells touched")
    (seeming,) = re.findall(r"\d+", has_text(panel, ".raw .count", "cells"))
    assert int(seeming) > 3
    switch(panel, "Details")
    contacts = panel.locator(".contacts tbody tr").all_inner_texts()
    assert [re.split(r"\t", line)[1] for line in contacts] == ["2.0, 2.0", "2.0, 5.0", "5.0, 2.0"]
    switch(panel, "Raw reading")
    assert panel.locator(".amount").inner_text() == "force"
    ghost, untouched = (5, 5), (0, 0)
    assert colours(panel, "raw", *ghost) != colours(panel, "raw", *untouched)
    assert colours(panel, "estimate", *ghost) == colours(panel, "estimate", *untouched)
    assert colours(panel, "estimate", 2, 2) != colours(panel, "estimate", *untouched)
    has_text(panel, ".latency", r"^\d+ ms$")
    has_text(panel, ".missed", "^0 scans$")
    has_text(panel, ".rest", r"by calibration\s+2025-03-01")
    panel.get_by_label("Method").select_option("ohm")
    has_text(panel, ".estimate .count", "by ‘ohm’: [0-9]{2} cells touched")
    assert panel.locator(".amount").inner_text() == "above rest"
    panel.get_by_label("Show").select_option("ohms")
    has_text(panel, ".value", "kΩ")


def test_tare_by_keyboard_is_refused_forced_and_undone(page: Any) -> None:
    panel = open_board(page, GHOST)
    tare = panel.get_by_role("button", name="Tare", exact=True)
    tare.focus()
    tare.press("Enter")
    has_text(panel, ".notice", r"cells \(2, 2\), \(2, 5\), \(5, 2\) are touched")
    panel.get_by_role("button", name="Tare anyway").press("Enter")
    assert tare.evaluate("button => button === document.activeElement")
    has_text(panel, ".estimate .count", "0 cells touched")
    has_text(panel, ".rest", r"tare\s+20")
    panel.get_by_role("button", name="Undo tare").press("Space")
    has_text(panel, ".notice", "undone")
    has_text(panel, ".estimate .count", "3 cells touched")
    assert panel.get_by_role("button", name="Undo tare").is_disabled()


def test_cells_are_chosen_by_keyboard_and_read_as_a_table(page: Any) -> None:
    panel = open_board(page, GHOST)
    has_text(panel, ".chosen", r"\(2, 2\)")  # the highest at first
    cells = panel.locator(".estimate .cells")
    cells.focus()
    cells.press("ArrowDown")
    has_text(panel, ".said", r"cell \(3, 2\): [\d.]+ ± [\d.]+ N")
    cells.press("ArrowUp")
    for _ in range(3):
        cells.press("ArrowRight")
    has_text(panel, ".said", r"cell \(2, 5\): 1\.2\d ± 0\.1\d N")
    switch(panel, "Raw reading")
    panel.locator(".raw .cells").click(position={"x": 25, "y": 25})
    has_text(panel, ".chosen", r"\(0, 0\)")
    switch(panel, "Table")
    has_text(panel, ".values caption", r"force \[N\]")
    table = panel.locator(".values tbody tr")
    assert table.count() == 8
    assert re.match(r"1\.2\d ± 0\.1\d N", table.nth(2).locator("td").nth(5).inner_text())


def test_a_force_below_its_deviation_is_a_word(page: Any) -> None:
    panel = open_board(page, f"{GHOST}&unit=7")
    has_text(panel, ".estimate .count", "3 cells touched")
    switch(panel, "Details")
    rows = panel.locator(".contacts tbody tr").all_inner_texts()
    amounts = {line.split("\t")[1]: line.split("\t")[2] for line in rows}
    assert amounts["2.0, 2.0"] == amounts["5.0, 2.0"] == "uncertain"
    assert re.fullmatch(r"1\.2\d ± 0\.1\d N", amounts["2.0, 5.0"])
    has_text(panel, ".chosen", r"\(2, 2\)")
    has_text(panel, ".value", "^uncertain$")
    switch(panel, "Table")
    has_text(panel, ".values caption", r"force \[N\]")
    cells = panel.locator(".values tbody tr").nth(2).locator("td").all_inner_texts()
    assert cells[:4] == 4 * ["uncertain"]
    assert all(re.fullmatch(r"[\d.]+ ± 0\.\d\d N", cell) for cell in cells[4:])
    # Untouched, of no force either way: the uncertain one is hatched.
    hatched, plain = (colours(panel, "estimate", 0, column) for column in (0, 7))
    assert len(hatched) > len(plain) == 1
    panel.get_by_label("Show").select_option("siemens")
    has_text(panel, ".value", r"\d ± [\d.]+ µS")


def test_no_value_below_its_deviation_is_written(page: Any) -> None:
    def said(value: float, std: float, touched: int) -> str:
        return page.evaluate(
            """async ([value, std, touched]) => {
                const { scaleOf, withStd } = await import(new URL("scale.js", location));
                return withStd(scaleOf("siemens"), value, std, touched);
            }""",
            [value, std, touched],
        )

    assert said(20e-6, 19e-6, 1) == "20 ± 19 µS"
    assert said(20e-6, 21e-6, 1) == said(20e-6, 21e-6, 0) == "uncertain"
    assert said(0.3e-6, 0.4e-6, 0) == "0.3 ± 0.4 µS"  # known well enough: it is next to nothing
    assert said(20e-6, float("nan"), 1) == "uncertain"


def test_a_contact_of_unknown_deviation_is_uncertain(page: Any) -> None:
    """JSON says null, which JavaScript takes for the least deviation of all."""
    amounts = page.evaluate(
        """async () => {
            const { Panel } = await import(new URL("panel.js", location));
            const contacts = [[1, 2, 2, 1.66, null], [2, 5, 2, 1.66, 0.02]];
            return Panel.prototype.amounts({ force: [], contacts }, { briefly: false });
        }"""
    )
    assert amounts == ["uncertain", "1.66 ± 0.02 N"]


def test_what_is_off_the_scale_is_marked(page: Any) -> None:
    panel = open_board(page, "emulator://8x8?scene=single&begin=0&seed=1")
    has_text(panel, ".estimate .count", "1 cell touched")
    switch(panel, "Curve")
    scale = panel.get_by_label("Scale")
    edge = """canvas => {
        const ratio = canvas.width / canvas.clientWidth;
        const at = [canvas.width - 14 * ratio, 8 * ratio, 1, 1];
        return [...canvas.getContext("2d").getImageData(...at).data].join();
    }"""
    red = ",".join(map(str, (0xA8, 0x20, 0x1A, 255)))
    count = {}
    for top_n, off in (("50", False), ("5", True)):
        scale.select_option(top_n)
        has_text(panel, ".value", "N, off the scale$" if off else "N$")
        page.wait_for_timeout(300)
        assert (panel.locator(".plot").evaluate(edge) == red) == off
        count[off] = len(colours(panel, "estimate", 4, 4))
    assert count[True] > count[False]


def test_many_columns_have_their_numbers_on_hover(page: Any) -> None:
    panel = open_board(page, "emulator://13x13?scene=ghost&begin=0&seed=1")
    cells, hover = panel.locator(".estimate .cells"), panel.locator(".estimate .hover")
    assert hover.is_hidden()
    box = cells.bounding_box()
    side = (box["height"] - 20) / 13
    cells.hover(position={"x": 20 + 3.5 * side, "y": 20 + 9.5 * side})
    has_text(panel, ".estimate .hover", r"^\(9, 3\): \d\d(\.\d+)? ± \d(\.\d+)? µS$")
    page.mouse.move(1, 1)
    assert hover.is_hidden()
    digits = """(canvas, at) => {
        const ratio = canvas.width / canvas.clientWidth;
        const data = canvas.getContext("2d").getImageData(at * ratio, at * ratio, 99, 99).data;
        return data.some((each) => each > 0);
    }"""
    assert not panel.locator(".estimate .digits").evaluate(digits, 22)
    assert panel.locator(".estimate .digits").evaluate(digits, 0)  # numbers of rows and columns


def test_the_empty_page_offers_an_emulated_skin_and_the_doctor(page: Any) -> None:
    start = page.locator("#start")
    assert "ohmskin doctor" in start.inner_text()
    start.get_by_role("button", name="Open an emulated skin").click()
    panel = page.get_by_role("region", name="emulator://8x8?scene=moving", exact=True)
    has_text(panel, ".status", "scanning")
    assert start.is_hidden()
    other = open_board(page, "emulator://4x4")
    chips = [each.locator(".chip") for each in (panel, other)]
    assert len({chip.inner_text() for chip in chips}) == 2
    shade = "chip => getComputedStyle(chip).backgroundColor"
    assert len({chip.evaluate(shade) for chip in chips}) == 2
    page.mouse.wheel(0, 500)
    assert panel.locator("h2").is_visible()


def test_every_control_has_a_name(page: Any) -> None:
    panel = open_board(page, GHOST)
    for control in page.locator("button, select, input, canvas[tabindex]").all():
        if control.is_visible():
            name = control.evaluate("e => e.ariaLabel || e.labels?.[0]?.innerText || e.innerText")
            assert name.strip(), control.evaluate("e => e.outerHTML")
    assert panel.locator("[role=status]").count() >= 3
    assert page.evaluate("document.documentElement.lang") == "en"


def test_the_first_view_is_the_estimate_and_its_contacts(new_page: Callable[..., Any]) -> None:
    page = new_page(viewport={"width": 1400, "height": 900})
    panel = open_board(page, GHOST)
    has_text(panel, ".health", r"^\d+ Hz, nothing missed, \d+ ms$")
    assert not panel.locator(".raw, .curve, .side, .values").filter(visible=True).count()
    has_text(panel, ".touches li:first-child", r"^\d\.\d\d N$")
    assert panel.locator(".touches li").count() == 3
    box = panel.locator(".estimate .cells").bounding_box()
    side = (box["height"] - 20) / 8
    circle = panel.locator(".touches li").nth(1).locator("i").bounding_box()
    assert circle["x"] + circle["width"] / 2 == pytest.approx(box["x"] + 20 + 5.5 * side, abs=3)
    assert circle["y"] + circle["height"] / 2 == pytest.approx(box["y"] + 20 + 2.5 * side, abs=3)
    assert box["height"] > 500
    assert box["y"] + box["height"] < 900
    assert page.evaluate("document.documentElement.scrollWidth") <= 1400


def test_what_is_switched_on_is_remembered(page: Any) -> None:
    panel = open_board(page, GHOST)
    for name in ("Raw reading", "Curve", "Details"):
        switch(panel, name)
    switch(panel, "Details", on=False)
    page.reload()
    panel = page.get_by_role("region", name=GHOST, exact=True)
    has_text(panel, ".rate", r"\d Hz")
    assert panel.locator(".raw .map").is_visible()
    assert panel.locator(".plot").is_visible()
    assert panel.locator(".side").is_hidden()


CONTRAST = """(panel) => new Promise((done) => {
    const canvas = (name) => panel.querySelector(`.estimate .${name}`);
    const linear = (byte) =>
        byte <= 10 ? byte / 255 / 12.92 : ((byte / 255 + 0.055) / 1.055) ** 2.4;
    const light = (data, at) =>
        0.2126 * linear(data[at]) + 0.7152 * linear(data[at + 1]) + 0.0722 * linear(data[at + 2]);
    const found = [];
    panel.addEventListener("drawn", function look() {
        const [cells, digits] = ["cells", "digits"].map(canvas);
        const side = (cells.clientHeight - 20) / 8;
        for (let cell = 0; cell < 64; cell++) {
            const place = [cell % 8, Math.floor(cell / 8)].map((index) => 24 + index * side);
            const [under, over] = [cells, digits].map((each) =>
                each.getContext("2d").getImageData(...place, side - 8, side - 8).data);
            let best = 0;
            const back = light(under, 0);
            for (let at = 0; at < over.length; at += 4) {
                if (over[at + 3] < 255) continue;
                const [low, high] = [back, light(over, at)].sort((a, b) => a - b);
                best = Math.max(best, (high + 0.05) / (low + 0.05));
            }
            found.push(best);
        }
        if (found.length >= 1000) {
            panel.removeEventListener("drawn", look);
            done(found);
        }
    });
})"""


def test_numbers_are_read_well_while_a_finger_moves(page: Any) -> None:
    """Their ink was that of a colour which had changed since: 38 of 768 were hard to read."""
    panel = open_board(page, "emulator://8x8?scene=moving&begin=0&seed=1")
    switch(panel, "Numbers")
    has_text(panel, ".estimate .count", r"[1-9]\d* cells? touched")
    page.wait_for_timeout(500)
    assert min(panel.evaluate(CONTRAST)) >= 4.5  # of text: WCAG 2.2, 1.4.3


def test_no_colour_of_the_scale_is_without_a_legible_ink(page: Any) -> None:
    inks = page.evaluate(
        """async () => {
            const { colourAt, inkAt } = await import(new URL("scale.js", location));
            return Array.from({ length: 256 }, (_, k) => [colourAt(k / 255), inkAt(k / 255)]);
        }"""
    )

    def luminance(rgb: list[int]) -> float:
        shares = [part / 255 for part in rgb]
        linear = [s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4 for s in shares]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    for colour, ink in inks:
        back = luminance([int(part) for part in re.findall(r"\d+", colour)])
        front = {"#000": 0.0, "#fff": 1.0}[ink]
        low, high = sorted((back, front))
        assert (high + 0.05) / (low + 0.05) >= 4.5, colour


def test_digits_are_as_many_as_the_deviation_allows(page: Any) -> None:
    """The examples are those of the Particle Data Group, Introduction, 5.3, and the page's own."""

    def said(value: float, std: float) -> list[str]:
        return page.evaluate(
            """async ([value, std]) => {
                const { writtenWith } = await import(new URL("scale.js", location));
                return writtenWith(value, std);
            }""",
            [value, std],
        )

    assert said(0.827, 0.119) == ["0.83", "0.12"]
    assert said(0.827, 0.367) == ["0.8", "0.4"]
    assert said(537, 99.1) == ["540", "100"]
    assert said(537, 34) == ["537", "34"]
    assert said(1.2345, 0.0021) == ["1.23", "0.01"]
    assert said(12345, 678) == ["12300", "700"]


def test_far_mode_is_named(page: Any) -> None:
    panel = open_board(page, f"{GHOST}&mode=far")
    has_text(panel, ".board", "mode far: lines are sensed at both ends")


def test_a_recording_is_made_and_marked(page: Any, server: Server) -> None:
    panel = open_board(page, GHOST)
    panel.get_by_role("button", name="Record").click()
    text = has_text(panel, ".file", r"recording to .*\.mcap: [1-9]\d* scans")
    path = Path(re.findall(r"/.*\.mcap", text)[0])
    assert path.parent == server.folder.resolve()
    panel.get_by_label("Mark").fill("first poke")
    panel.get_by_label("Mark").press("Enter")
    has_text(panel, ".notice", "marked: first poke")
    panel.get_by_role("button", name="Stop recording").click()
    has_text(panel, ".file", "last recording")
    recording = load_recording(path)
    assert not recording.cut_off
    assert [mark.text for mark in recording.marks] == ["first poke"]
    assert sum(scan.missed for scan in recording.scans[1:]) == 0


def test_a_board_that_is_pulled_out_is_said_and_comes_back(
    page: Any, pty_board: Serve, tmp_path: Path
) -> None:
    port = tmp_path / "skin"
    first = pty_board(GHOST)
    port.symlink_to(first.path)
    panel = open_board(page, str(port))
    port.unlink()  # another test's board may get the same pseudo-terminal
    first.close()
    has_text(panel, ".status", "not there, tried again every second: .*(is gone|no port)")
    assert panel.get_by_role("button", name="Tare", exact=True).is_disabled()
    second = pty_board(GHOST)
    port.symlink_to(second.path)
    has_text(panel, ".status", "^scanning$")
    has_text(panel, ".estimate .count", "3 cells touched")


def test_a_board_of_another_size_is_shown_as_if_it_were_the_first(
    page: Any, pty_board: Serve, tmp_path: Path
) -> None:
    port = tmp_path / "skin"
    first = pty_board("emulator://8x4?scene=single&begin=0&unit=3")
    port.symlink_to(first.path)
    panel = open_board(page, str(port))
    switch(panel, "Table")
    has_text(panel, ".chosen", r"\(4, 2\)")
    has_text(panel, ".notice p", "no forces: ")
    heads = "table => [...table.tHead.rows].map(row => row.cells.length)"
    port.unlink()
    first.close()
    has_text(panel, ".status", "not there")
    second = pty_board(GHOST)
    port.symlink_to(second.path)
    has_text(panel, ".board", "8 × 8 cells")
    has_text(panel, ".values caption", r"force \[N\]")
    page.wait_for_timeout(2500)  # the table is renewed once a second
    assert panel.locator(".values table").evaluate(heads) == [9]
    assert panel.locator(".values tbody tr").first.locator("td").count() == 8
    has_text(panel, ".chosen", r"\(2, 2\)")
    assert panel.locator(".notice p").inner_text() == ""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_two_boards_on_a_phone(new_page: Callable[..., Any], scheme: str) -> None:
    page = new_page(viewport=PHONE, color_scheme=scheme, device_scale_factor=2, has_touch=True)
    one = open_board(page, GHOST)
    other = open_board(page, "emulator://4x16?scene=multi&begin=0&seed=3")
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    for panel in (one, other):
        box = panel.locator(".estimate .cells").bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= PHONE["width"]
    one.locator(".estimate .cells").tap(position={"x": 25, "y": 25})
    has_text(one, ".chosen", r"\(0, 0\)")
    assert "(0, 0)" not in other.locator(".chosen").inner_text()
    background = page.evaluate("getComputedStyle(document.body).backgroundColor")
    lightness = sum(map(int, re.findall(r"\d+", background)[:3])) / 3
    assert (lightness > 128) == (scheme == "light")


def test_what_is_drawn_is_the_newest(page: Any) -> None:
    panel = open_board(page, GHOST)
    drawn = panel.evaluate(
        """(panel) => new Promise((done) => {
            const all = [];
            panel.addEventListener("drawn", ({ detail }) => {
                all.push(detail);
                if (all.length === 60) done(all);
            });
        })"""
    )
    numbers = [each["scan"] for each in drawn]
    assert numbers == sorted(set(numbers))
    assert sorted(each["latencyMs"] for each in drawn)[30] < 250  # a busy machine


def test_a_message_that_is_too_long_ends_the_connection(page: Any, server: Server) -> None:
    open_board(page, GHOST)
    code = page.evaluate(
        """async () => {
            const [{ number }] = await (await fetch("boards" + location.search)).json();
            const place = new URL(`boards/${number}${location.search}`, location.href);
            const socket = new WebSocket(place.href.replace("http", "ws"));
            await new Promise((open) => (socket.onopen = open));
            const closed = new Promise((close) => (socket.onclose = close));
            socket.send(JSON.stringify({ do: "mark", text: "x".repeat(20000) }));
            return (await closed).code;
        }"""
    )
    assert code == 1009  # too big: RFC 6455, 7.4.1


def test_a_page_without_its_token(browser: Any, server: Server) -> None:
    with browser.new_page() as page:
        page.goto(server.url.partition("?")[0])
        assert "with its token" in page.locator("body").inner_text()


def test_ctrl_c_leaves_a_whole_recording(browser: Any, tmp_path: Path) -> None:
    with browser.new_page() as page:
        page.set_default_timeout(LIMIT_MS)
        with serving(tmp_path, GHOST) as server:
            page.goto(server.url)
            panel = page.get_by_role("region", name=GHOST, exact=True)
            panel.get_by_role("button", name="Record").click()
            has_text(panel, ".file", r"[1-9]\d* scans")
        has_text(panel, ".status", "out of reach")
    (path,) = tmp_path.glob("*.mcap")
    recording = load_recording(path)
    assert not recording.cut_off
    assert recording.scans
