"""Commands beside Debian's TBB, which numba prefers by default, and whose threads then keep a process from ending."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import pytest

from conftest import REPOSITORY

pytestmark = pytest.mark.slow

PATIENCE_S = 600.0
"""A first run compiles the kernels. With TBB a command never ends."""


@pytest.fixture
def tbb() -> None:
    """Skips the test where numba would not find TBB."""
    try:
        ctypes.CDLL("libtbb.so.12")
    except OSError:
        pytest.skip("needs libtbb.so.12: apt-get install libtbb12 (or name the folder that has it in LD_LIBRARY_PATH)")


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Runs Python without a threading layer of the user."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_THREADING")}
    own["PYTHONPATH"] = str(REPOSITORY / "service")
    command = [sys.executable, *(str(argument) for argument in arguments)]
    return subprocess.run(command, env=own, capture_output=True, text=True, timeout=PATIENCE_S)


@pytest.mark.fault("TBB is installed (libtbb12, a dependency of OpenCV and ROS)", "commands end; TBB is not used")
@pytest.mark.usefixtures("tbb")
def test_a_command_that_runs_parallel_kernels_ends(tmp_path: Path) -> None:
    code = "import numba, sys; from coec.geometry import mutual_information; from coec.cli.main import main; "
    code += "status = main(); "
    code += "print('layer', numba.threading_layer()); sys.exit(status)"
    drive = tmp_path / "drive.mcap"
    made = run("-m", "coec", "sim", "drive", "--output", drive, "--seconds", "8")
    assert made.returncode == 0, made.stderr
    done = run("-c", code, "commission", drive, "--frames", "6", "--output", tmp_path / "rig.json")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] in ("layer omp", "layer workqueue")
    assert (tmp_path / "rig.json").exists()
