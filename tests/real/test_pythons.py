"""Each version of Python that pyproject.toml names: coec is installed with it, and the tests of its own parts pass."""

from __future__ import annotations

import shutil
import subprocess
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from conftest import REPOSITORY
from real.packages import completed, copied_checkout, environment, require_index, run_tests, uv

pytestmark = pytest.mark.slow

Record = Callable[[str, object], None]
"""pytest's `record_property`."""

TESTS = (
    "tests/cli/test_calibrate.py",
    "tests/cli/test_export.py",
    "tests/cli/test_main.py",
    "tests/cli/test_query.py",
    "tests/fleet",
    "tests/geometry",
    "tests/io/foxglove",
    "tests/io/mcap",
    "tests/io/recordings",
    "tests/io/ros",
    "tests/io/system",
    "tests/io/test_baseline_file.py",
    "tests/io/test_serialise.py",
    "tests/io/test_state_file.py",
    "tests/io/test_storage.py",
    "tests/service/api",
    "tests/service/worker",
    "tests/schemas",
    "tests/test_calibration_options.py",
    "tests/test_client.py",
    "tests/test_daemon.py",
)


def versions() -> list[str]:
    """As the classifiers name them: `3.11` and later."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    prefix = "Programming Language :: Python :: "
    return [line.removeprefix(prefix) for line in project["project"]["classifiers"] if line.startswith(prefix)]


def interpreter_of(version: str) -> str:
    """The path of an interpreter, or the test is skipped. A name on PATH may be one that only says what is missing."""
    name = f"python{version}"
    on_path = shutil.which(name)
    if on_path is not None and subprocess.run([on_path, "--version"], capture_output=True).returncode == 0:
        return on_path
    result = completed(uv(), "python", "find", "--no-python-downloads", version, may_fail=True)
    if result.returncode != 0:
        pytest.skip(f"needs Python {version}: have {name} on PATH, or run `uv python install {version}`")
    return result.stdout.strip()


@pytest.mark.parametrize("version", versions())
def test_coec_works_with_this_python(version: str, tmp_path: Path, record_property: Record) -> None:
    interpreter = interpreter_of(version)
    require_index(tmp_path / "probe")
    checkout = copied_checkout(tmp_path / "coec")
    python = environment(tmp_path / "environment", interpreter, checkout)
    assert completed(python, "--version").stdout.startswith(f"Python {version}.")
    record_property("figure", run_tests(python, checkout, TESTS))
