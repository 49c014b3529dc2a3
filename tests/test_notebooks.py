"""The notebooks run from top to bottom and draw; they are kept without what they print."""

from __future__ import annotations

import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))

each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def test_the_documents_list_every_notebook():
    listed = re.findall(r"`(\w+\.ipynb)`", (ROOT / "docs" / "notebooks.md").read_text(encoding="utf-8"))
    assert listed
    assert sorted(listed) == [path.name for path in NOTEBOOKS]


@each_notebook
def test_a_notebook_is_kept_without_results(path):
    book = nbformat.read(path, nbformat.NO_CONVERT)
    nbformat.validate(book)
    code = [cell for cell in book.cells if cell.cell_type == "code"]
    assert [cell.id for cell in code if cell.outputs or cell.execution_count is not None] == []
    assert [cell.id for cell in book.cells if cell.metadata] == []
    assert book.metadata == {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }


@each_notebook
def test_a_notebook_runs_and_draws(path, tmp_path, monkeypatch):
    for folder in ("IPYTHONDIR", "JUPYTER_RUNTIME_DIR"):  # not the user's own
        monkeypatch.setenv(folder, str(tmp_path / folder))
    book = nbformat.read(path, nbformat.NO_CONVERT)
    NotebookClient(book, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in book.cells for output in cell.get("outputs", [])]
    told = [output.text for output in outputs if output.get("name") == "stderr"]
    assert [text for text in told if "the commanded rates reverse from sample to sample" not in text] == []
    assert any("image/png" in output.get("data", {}) for output in outputs)
