"""The renderer's kernels are cached where those of `geometry` are: the package may lie where nobody can write."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import coec

pytest.importorskip("embreex", reason="needs ray casting")

WHERE = """
from coec_lab.simulation import scene, shading, render
kernels = [value for module in (scene, shading, render) for value in vars(module).values() if hasattr(value, "stats")]
print(*{kernel.stats.cache_path for kernel in kernels}, sep="\\n")
"""


def test_nothing_is_written_into_the_package(tmp_path: Path) -> None:
    environment = {"PYTHONPATH": str(Path(coec.__file__).parents[1]), "XDG_CACHE_HOME": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", WHERE],
        env=os.environ | environment | {"NUMBA_CACHE_DIR": ""},
        capture_output=True,
        text=True,
        check=True,
    )
    folders = [Path(line) for line in done.stdout.split()]
    assert folders
    for folder in folders:
        assert folder.is_relative_to(tmp_path / "coec")
