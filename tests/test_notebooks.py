"""Every notebook runs from its first cell to its last, and is committed without outputs."""

import ast
import os
import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))


def read(path):
    return nbformat.read(path, as_version=4)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_has_no_outputs(path):
    cells = [cell for cell in read(path).cells if cell.cell_type == "code"]
    assert cells
    assert not any(cell.outputs or cell.execution_count for cell in cells)


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_runs(path, tmp_path, monkeypatch):
    """Run a notebook: its assertions hold, its figures are drawn, and else it shows tables."""
    if path.stem == "a_storage_ring":
        pytest.importorskip("at", reason="needs PyAT: pip install accelerator-toolbox")
    if path.stem == "a_swing_up":
        pytest.importorskip("casadi", reason="CasADi is an extra")
    monkeypatch.setenv("PYTHONPATH", str(path.parent), prepend=os.pathsep)  # files beside it
    monkeypatch.setenv("GFNN_SMOKE", "1")
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))
    client = NotebookClient(
        read(path), timeout=600, kernel_name="python3", resources={"metadata": {"path": tmp_path}}
    )
    outputs = [
        output
        for cell in client.execute().cells
        if cell.cell_type == "code"
        for output in cell.outputs
    ]
    shown = [output.data for output in outputs if output.output_type != "stream"]
    assert any("image/png" in data for data in shown)
    assert all({"image/png", "text/html"} & data.keys() for data in shown)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_uses_public_names_only(path):
    code = "\n".join(cell.source for cell in read(path).cells if cell.cell_type == "code")
    assert "assert " in code  # what it claims it checks
    names = {
        name
        for node in ast.walk(ast.parse(re.sub(r"^%.*$", "", code, flags=re.M)))
        for name in (
            [node.attr]
            if isinstance(node, ast.Attribute)
            else [alias.name for alias in node.names]
            if isinstance(node, ast.ImportFrom)
            else []
        )
    }
    assert not {name for name in names if name.startswith("_")}
