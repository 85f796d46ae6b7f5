"""Run notebooks again and store their outputs: python pipelines/run_notebooks.py [NAME ...]

The hash of the code is written into the notebook's metadata, so that a test finds outputs that are older than the code.
"""

from __future__ import annotations

import hashlib
import sys
import tempfile
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"


def code_hash(notebook: Any) -> str:
    """SHA-256 of the code of all cells."""
    code = "\0".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
    return hashlib.sha256(code.encode()).hexdigest()


def run(path: Path, folder: str | None = None) -> None:
    """Run a notebook in an empty folder, or in a given one, and store it with its outputs."""
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as empty:
        NotebookClient(notebook, timeout=3600, resources={"metadata": {"path": folder or empty}}).execute()
    notebook.metadata["code_hash"] = code_hash(notebook)
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # times of execution
    nbformat.write(notebook, path)


if __name__ == "__main__":
    for name in sys.argv[1:] or sorted(path.stem for path in NOTEBOOKS.glob("*.ipynb")):
        print(name, flush=True)
        run(NOTEBOOKS / f"{name}.ipynb")
