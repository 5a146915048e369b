# SPDX-License-Identifier: Apache-2.0
"""The notebook, by a kernel of Jupyter: every cell runs, and the heat map is live."""

import re
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

NOTEBOOK = Path(__file__).parents[1] / "skin.ipynb"
TABLE = Path(__file__).parents[3] / "examples" / "presses.csv"


def test_every_cell_runs() -> None:
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    client = NotebookClient(notebook, timeout=300, kernel_name="python3")
    updates = []
    told = client.process_message

    def process(message: dict, cell: object, index: int) -> object:
        if message["msg_type"] == "update_display_data":
            updates.append(message["content"]["data"]["text/html"])
        return told(message, cell, index)

    client.process_message = process
    client.execute()
    assert len(updates) == 50
    assert all(html.count("<td ") == 64 for html in updates)
    assert len(set(updates)) > 10  # the finger moves
    _, _, plotted, arrays = (cell for cell in notebook.cells if cell.cell_type == "code")
    printed = "".join(out.text for out in plotted.outputs if out.output_type == "stream")
    assert re.search(r"1\d\.\d+ \+- [1-6]\.\d+ N at row \d\.\d, column \d\.\d\n", printed)
    shapes = arrays.outputs[0].data["text/plain"]
    assert "'force_n': (361, 8, 8)" in shapes or "'force_n': (360, 8, 8)" in shapes


def test_it_goes_on_when_the_board_is_plugged_20_times() -> None:
    """It vanishes 0.3 s after it was opened, and is opened again a second later."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    first, live = [cell for cell in notebook.cells if cell.cell_type == "code"][:2]
    notebook.cells = [first, live]
    first.source = first.source.replace("&begin=0", "&begin=0&vanish=0.3")
    live.source = live.source.replace("for _ in range(50):", "while skin.opened <= 20:")
    live.source += (
        "\ncount, scans = skin.since(count, timeout_s=30)\nprint(skin.opened, len(scans))"
    )
    NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    (said,) = (out.text for out in live.outputs if out.output_type == "stream")
    opened, scans = map(int, said.split())
    assert (opened, scans > 0) == (21, True)


def test_with_a_board_only_the_port_changes(tmp_path: Path) -> None:
    """The calibration is that of the folder; what is wrong with the port is said."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    first = next(cell for cell in notebook.cells if cell.cell_type == "code")
    port = next(line for line in first.source.splitlines() if line.startswith("PORT ="))
    client = NotebookClient(notebook, resources={"metadata": {"path": str(tmp_path)}}, timeout=300)
    first.source = first.source.replace(port, 'PORT = "/dev/ttyNone"')
    with pytest.raises(CellExecutionError, match=r"skin\.json: cannot be read"):
        client.execute()
    words = ("calibrate", "table", "emulator://8x8", TABLE, tmp_path / "skin.json")
    told = ("--indenter-mm2", "80", "--wires", "100,200", "--leads", "80")
    subprocess.run([sys.executable, "-m", "ohmskin", *map(str, (*words, *told))], check=True)
    with pytest.raises(CellExecutionError, match="no port /dev/ttyNone"):
        client.execute()


def test_it_is_kept_without_outputs() -> None:
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    assert not any(cell.get("outputs") for cell in notebook.cells)
