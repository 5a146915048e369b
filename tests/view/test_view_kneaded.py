# SPDX-License-Identifier: Apache-2.0
"""A skin that is kneaded, on the page: ``ohmskin calibrate knead --view``."""

import re
import subprocess
import sys
import threading
from itertools import islice
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
from starlette.testclient import TestClient

import ohmskin
from command_line import ENVIRONMENT, Run, well
from ohmskin.link.messages import Scan
from ohmskin.view.boards import ViewedBoards
from ohmskin.view.kneaded import KneadedBoard
from ohmskin.view.server import make_app
from viewed import ORIGIN, TOKEN, panel


def test_the_page_is_sent_what_is_known_and_can_command_nothing() -> None:
    with ohmskin.open("emulator://2x3?speed=0") as skin:
        board, (scan, later) = skin.info, islice(skin, 2)
    kneaded, boards = KneadedBoard("a port", board), ViewedBoards()
    boards[0] = kneaded
    log_std = np.array([[0.12, 0.5, 0.1], [0.14, 0.9, 0.2]])

    def show(scan: Scan, words: str) -> None:
        kneaded.show(scan, log_std, log_std <= 0.15, (0, 2), words)

    with TestClient(make_app(boards, "127.0.0.1", TOKEN), base_url=ORIGIN) as client:
        client.params = {"token": TOKEN}
        with panel(client) as page:
            state = page.until_state(lambda state: state["kneaded"])
            assert (state["port"], state["board"]["rows"]) == ("a port", 2)
            show(scan, "press at row 0, column 2")
            seen = page.scan(lambda scan: True)
            np.testing.assert_allclose(seen["log_std"], log_std, rtol=1e-6)
            assert seen["touched"].tolist() == [[1, 0, 1], [1, 0, 0]]
            assert seen["contacts"] == [["next", 0, 2, None, None]]
            page.until_state(lambda state: state["note"] == "press at row 0, column 2")
            show(later, "a tenth of a second later")  # too soon for a reader
            for command in ({"do": "tare", "force": True}, {"do": "record"}, {"do": "undo"}):
                page.refused("does not know", **command)
            kneaded.end("it has ended")
            state = page.until_state(lambda state: state["status"] == "ended")
            assert state["note"] == "it has ended"


def test_kneading_serves_the_page_while_it_lasts(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers: list[int] = []

    def browse(url: str) -> None:
        def ask() -> None:
            with urlopen(url) as answer:
                answers.append(answer.status)

        asking.append(threading.Thread(target=ask))
        asking[0].start()

    asking: list[threading.Thread] = []
    monkeypatch.setattr("ohmskin.cli.knead.browse", browse)
    knead = ("calibrate", "knead", "emulator://2x3?speed=0&rate=20&scene=knead&begin=3")
    out, before = str(tmp_path / "skin.json"), {*threading.enumerate()}
    done = well(run(*knead, out, "--force-port", "truth", "--seconds", "9", "--view"))
    (asked,) = asking
    asked.join()
    assert answers == [200]
    assert re.search(r"^http://127\.0\.0\.1:\d+/\?token=\S+$", done.out, re.MULTILINE)
    assert not {thread for thread in threading.enumerate() if not thread.daemon} - before


@pytest.mark.browser
def test_a_browser_shows_where_to_press_next(browser: Any, tmp_path: Path) -> None:
    port = "emulator://2x3?scene=knead&rate=20&begin=3"
    call = [sys.executable, "-m", "ohmskin", "calibrate", "knead", port, "skin.json", "--view"]
    call += ["--force-port", "truth", "--seconds", "8"]
    complaints: list[str] = []
    with subprocess.Popen(
        call, cwd=tmp_path, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        url = next(line.strip() for line in process.stdout if line.startswith("http://"))
        page = browser.new_page(viewport={"width": 360, "height": 740})
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(url)
        shown = page.get_by_role("region", name=port, exact=True)
        shown.locator(".touches b").filter(has_text="press here").wait_for()
        shown.locator(".notice p.good").filter(has_text="cells are known to 15 %").wait_for()
        assert "of 6 are known, outlined" in shown.locator(".estimate .count").inner_text()
        assert not shown.get_by_role("button", name="Tare").is_visible()
        shown.locator(".notice p").filter(has_text="it has ended").wait_for()
        page.close()
        process.stdout.read()
    assert process.returncode == 0
    assert complaints == []
