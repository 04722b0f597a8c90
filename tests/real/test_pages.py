"""The README and the tutorial in the environment that they make themselves: a fresh checkout, its own set-up, and every
block typed there. In the gate the same blocks run in the environment of the checks (tests/test_readme.py)."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

from real.packages import copied_checkout, require_index
from test_readme import BLOCKS, LONG_S, Block, name_of, play_through

pytestmark = pytest.mark.slow

PAGES = ("README", "tutorial")
OF_PAGES = [block for block in BLOCKS if block.page.stem in PAGES and block.language == "console"]
PYTHON = [block for block in BLOCKS if block.page.stem in PAGES and block.language == "python"]

FOREIGN = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
"""Variables that would let another environment shine through."""


def environment() -> dict[str, str]:
    """The variables of a person's shell."""
    return {name: value for name, value in os.environ.items() if name not in FOREIGN}


def done(text: Sequence[object], cwd: Path) -> subprocess.CompletedProcess[str]:
    """A command to its end."""
    command = [str(word) for word in text]
    return subprocess.run(command, cwd=cwd, env=environment(), capture_output=True, text=True, timeout=LONG_S)


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a clone of the working tree would hold, set up by the first command of the tutorial."""
    require_index(tmp_path_factory.mktemp("probe"))
    folder = copied_checkout(tmp_path_factory.mktemp("fresh") / "coec")
    shown = done(["deploy/demo", "--output", folder.parent / "demo"], folder)
    assert shown.returncode == 0, shown.stderr
    return folder


@pytest.mark.parametrize("block", OF_PAGES, ids=name_of)
def test_a_block_works_in_the_environment_that_the_page_makes(checkout: Path, block: Block, tmp_path: Path) -> None:
    own = checkout / ".venv" / "bin"
    env = environment() | {"PATH": f"{own}{os.pathsep}{os.environ['PATH']}"}
    play_through(block, tmp_path, LONG_S, short=False, coec=(str(own / "coec"),), env=env)


@pytest.mark.parametrize("block", PYTHON, ids=name_of)
def test_python_of_a_page_works_there(checkout: Path, block: Block, tmp_path: Path) -> None:
    ran = done([checkout / ".venv" / "bin" / "python", "-c", block.text], tmp_path)
    assert ran.returncode == 0, ran.stderr


def test_every_command_loads_its_extras_there(checkout: Path) -> None:
    for module in ("duckdb", "embreex", "foxglove", "fsspec", "pyarrow.parquet", "small_gicp"):
        result = done([checkout / ".venv" / "bin" / "python", "-c", f"import {module}"], checkout)
        assert result.returncode == 0, result.stderr


def test_the_site_is_built_as_the_readme_says(checkout: Path) -> None:
    for command in (("deploy/setup", "--docs"), (".venv/bin/mkdocs", "build", "--strict")):
        assert " ".join(command) in (checkout / "README.md").read_text()
        ran = done(command, checkout)
        assert ran.returncode == 0, ran.stderr
    assert (checkout / "build" / "site" / "tutorial.html").is_file()
