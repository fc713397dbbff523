"""In Jupyter a cell shows a frame, and a result a few lines."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.support.dsse_command import ENVIRONMENT

CELLS = [
    "import consensus_dsse as dsse\nresult = dsse.simulate('ieee33', plots=False)\nresult",
    "result.branches.to_pandas()",
]


def test_a_cell_of_a_notebook_shows_a_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    nbclient, nbformat, *_ = (pytest.importorskip(name) for name in ("nbclient", "nbformat", "ipykernel", "pandas"))
    monkeypatch.setitem(os.environ, "PYTHONPATH", ENVIRONMENT["PYTHONPATH"])
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in CELLS])
    client = nbclient.NotebookClient(notebook, timeout=1800, resources={"metadata": {"path": str(tmp_path)}})
    client.execute()
    shown = [cell.outputs[-1]["data"] for cell in notebook.cells]
    assert shown[0]["text/plain"].startswith("<RunResult of 'ieee33': consensus of 3 areas")
    assert shown[1]["text/html"].count("<th>") >= 37  # one per branch, and the columns
    assert "i_from_a" in shown[1]["text/html"]
