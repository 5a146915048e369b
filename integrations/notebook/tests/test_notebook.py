# SPDX-License-Identifier: Apache-2.0
"""The notebook, by a kernel of Jupyter: every cell runs, and the heat map is live."""

from pathlib import Path

import nbformat
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parents[1] / "skin.ipynb"


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
    assert " N at [" in printed
    shapes = arrays.outputs[0].data["text/plain"]
    assert "'force_n': (361, 8, 8)" in shapes or "'force_n': (360, 8, 8)" in shapes


def test_it_is_kept_without_outputs() -> None:
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    assert not any(cell.get("outputs") for cell in notebook.cells)
