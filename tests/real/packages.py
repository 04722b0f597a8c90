"""A copy of the checkout as a user gets it, and environments into which it is installed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from conftest import REPOSITORY

PATIENCE_S = 3600.0
"""For a command: downloads, a first run that compiles kernels, and test suites on a busy machine."""

FOREIGN = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
"""Variables that would let modules of another environment in."""

EXTRAS = ("fleet", "foxglove", "lidars", "sim")
"""Those that the tests need."""

OTHER_VERSIONS = ("-W", "ignore::DeprecationWarning", "-W", "ignore::PendingDeprecationWarning")
"""For pytest with other versions than those of the lock files: what an old package uses of a new one is not ours."""

OF_THE_LOCK_FILES = (
    "tests/docs/test_pages.py::test_the_page_is_the_one_that_the_code_would_write",
    "tests/deploy/test_locks.py::test_the_table_of_licences_is_that_of_the_lock_file",
)
"""Tests that compare files which were written with the locked versions."""


def completed(
    *command: object, cwd: Path = REPOSITORY, may_fail: bool = False, **variables: str
) -> subprocess.CompletedProcess[str]:
    """A command that has ended, in an environment without modules of this one. Fails the test if the command fails."""
    own = {name: value for name, value in os.environ.items() if name not in FOREIGN} | variables
    text = [str(word) for word in command]
    done = subprocess.run(text, cwd=cwd, env=own, capture_output=True, text=True, timeout=PATIENCE_S)
    if not may_fail:
        assert done.returncode == 0, f"{' '.join(text)} ended with {done.returncode}:\n{done.stdout}\n{done.stderr}"
    return done


def require_index(scratch: Path) -> None:
    """Skips the test where pip reaches no package index."""
    fetched = completed(
        sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", scratch, "packaging", may_fail=True
    )
    if fetched.returncode != 0:
        pytest.skip(f"needs a package index that pip reaches: {fetched.stderr.strip()[-200:]}")


def uv() -> str:
    """The program `uv`, or the test is skipped."""
    neighbour = Path(sys.executable).parent / "uv"
    result = str(neighbour) if neighbour.exists() else shutil.which("uv")
    if result is None:
        pytest.skip("needs uv, to resolve versions and to make environments: pip install uv, and have it on PATH")
    return result


def copied_checkout(folder: Path) -> Path:
    """The files of the checkout that are under version control or about to be, as a clone would hold them."""
    if not (REPOSITORY / ".git").exists() or shutil.which("git") is None:
        pytest.skip("needs git, and a checkout: what is copied is the list of files under version control")
    listed = completed("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard").stdout
    for name in listed.split("\0"):
        source = REPOSITORY / name
        if name and source.is_file() and not source.is_symlink():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target)
    return folder


def environment(folder: Path, python: str, checkout: Path, *resolution: str) -> Path:
    """The interpreter of a new environment with coec, its laboratory, the extras and the tools of the tests.

    Args:
        python: the interpreter that it is made with.
        checkout: the sources of coec, which are installed in an editable form.
        resolution: options of `uv pip install` that choose versions.
    """
    completed(uv(), "venv", "--quiet", "--python", python, folder)
    interpreter = folder / "bin" / "python"
    completed(
        uv(), "pip", "install", "--quiet", "--python", interpreter, *resolution,
        "--editable", f".[{','.join(EXTRAS)}]", "--editable", "./service/coec_lab", "--group", "checks", cwd=checkout,
    )  # fmt: skip
    return interpreter


def run_tests(interpreter: Path, checkout: Path, tests: Sequence[str]) -> str:
    """The last line of pytest. Fails the test if any of those tests fails."""
    completed(interpreter, "tests/warm.py", cwd=checkout)  # or the first test compiles the kernels
    left_out = [word for test in OF_THE_LOCK_FILES for word in ("--deselect", test)]
    done = completed(
        interpreter, "-m", "pytest", "-q", "-n0", "-p", "no:cacheprovider", *OTHER_VERSIONS, *left_out, *tests,
        cwd=checkout, may_fail=True,
    )  # fmt: skip
    assert done.returncode == 0, f"{done.stdout[-20_000:]}\n{done.stderr[-2000:]}"
    return done.stdout.strip().splitlines()[-1]
