"""The notebooks run from the first cell to the last."""

from __future__ import annotations

import os
from pathlib import Path

import nbformat
import pytest
from conftest import ROOT
from nbclient import NotebookClient

NOTEBOOKS = ROOT / "python" / "notebooks"


@pytest.mark.full
@pytest.mark.parametrize("name", ["clips", "train", "transfer"])
def test_a_notebook_runs(name: str, tmp_path: Path) -> None:
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    client = NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(tmp_path)}})
    client.execute()
    # COMIC_NOTEBOOKS names a directory for the executed notebooks, to look at their pictures.
    out = Path(os.environ.get("COMIC_NOTEBOOKS", tmp_path))
    nbformat.write(notebook, out / f"{name}.ipynb")
    shown = [output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("image/png" in data for data in shown)
