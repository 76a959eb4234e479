"""Long work in a notebook has a progress bar, short work has none; run in a kernel of Jupyter."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")

CELLS = (
    "import jetnormal, numpy",
    "points = numpy.random.default_rng(0).normal(size=(20_000, 3))",
    "jetnormal.estimate(points, 'pca', orient='none').shape",
    "jetnormal.estimate(points[:1000], 'pca', orient='none').shape",
)


def test_long_work_has_a_bar(tmp_path, monkeypatch):
    import nbformat

    paths = [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in CELLS])
    nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    _, _, long, short = (list(cell.outputs) for cell in notebook.cells)
    widgets = [output for output in long if "application/vnd.jupyter.widget-view+json" in output.get("data", {})]
    assert len(widgets) == 1
    assert long[-1]["data"]["text/plain"] == "(20000, 3)"
    assert [output["output_type"] for output in short] == ["execute_result"]
    assert not [output for output in (*long, *short) if output.get("name") == "stderr"]
