"""The notebooks under docs/notebooks: their cells run in order, in an interpreter of their own, without Jupyter."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

import coec
from conftest import REPOSITORY
from e2e.processes import environment

NOTEBOOKS = sorted((REPOSITORY / "docs" / "notebooks").glob("*.ipynb"))
MAX_BYTES = 300_000
PATIENCE_S = 1800.0


def cells(notebook: Path) -> list[str]:
    """Its code, in order."""
    document = json.loads(notebook.read_text())
    return ["".join(cell["source"]) for cell in document["cells"] if cell["cell_type"] == "code"]


def test_there_is_one() -> None:
    assert NOTEBOOKS


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: str(path.stem))
def test_a_notebook_is_small_and_holds_no_outputs(notebook: Path) -> None:
    document = json.loads(notebook.read_text())
    assert notebook.stat().st_size <= MAX_BYTES
    assert document["nbformat"] == 4
    assert all(not cell["outputs"] for cell in document["cells"] if cell["cell_type"] == "code")
    assert document["cells"][0]["cell_type"] == "markdown"


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: str(path.stem))
def test_its_cells_parse_and_use_what_there_is(notebook: Path) -> None:
    tree = ast.parse("\n".join(cells(notebook)), str(notebook))
    imported = [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    assert [name for name in imported if find_spec(name) is None] == []
    used = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "coec"
    }
    assert used
    assert used <= set(coec.__all__)


@pytest.mark.slow
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: str(path.stem))
def test_its_cells_run_in_order(notebook: Path, tmp_path: Path) -> None:
    ran = subprocess.run(
        [sys.executable, "-c", "\n".join(cells(notebook))],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        env=environment() | {"MPLBACKEND": "agg"},
    )
    assert ran.returncode == 0, ran.stderr
    assert "accepted" in ran.stdout
    assert "not exported" in ran.stdout
    assert (tmp_path / "calibration.json").is_file()
    assert not (tmp_path / "wrong.json").exists()
