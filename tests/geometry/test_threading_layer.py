"""Which library shares the loops of parallel kernels among threads: the same one in every process, chosen by coec."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import coec

LAUNCH = """
import numba, numpy
from coec.geometry.mutual_information import share_of_pixels
values = numpy.ones((8, 8), numpy.float32)
share_of_pixels(values, values > 0.0, numpy.ones(1, numpy.float32))
print(numba.threading_layer(), *numba.config.THREADING_LAYER_PRIORITY)
"""
"""Runs a parallel kernel and prints the layer that ran it, then those that numba was to try."""

POOL = f"""
from concurrent.futures import ProcessPoolExecutor
from coec_lab.simulation.parallel import SPAWN
if __name__ == "__main__":
    with ProcessPoolExecutor(1, mp_context=SPAWN) as pool:
        pool.submit(exec, {LAUNCH!r}, {{}}).result()
"""

ENTRIES = {
    "program, command or judge of a fleet": "import coec",
    "worker": "import coec.service.worker.worker_main",
    "program that imported numba before": "import numba; import coec",
}


def run(code: str, **environment: str) -> list[str]:
    """What a process of its own prints, in words. No layer is chosen in its environment but by `environment`."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_THREADING")}
    own |= {"PYTHONPATH": str(Path(coec.__file__).parents[1]), **environment}
    done = subprocess.run([sys.executable, "-c", code], env=own, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.parametrize(
    "entry",
    [pytest.param(code, marks=pytest.mark.slow if code == "import coec" else ()) for code in ENTRIES.values()],
    ids=ENTRIES,
)
def test_every_process_prefers_openmp_and_tries_tbb_last(entry: str) -> None:
    layer, *tried = run(f"{entry}\n{LAUNCH}")
    assert tried == ["omp", "workqueue", "tbb"]
    assert layer in ("omp", "workqueue"), "numba's own queue takes the place of OpenMP on a system without libgomp"


def test_processes_of_a_pool_have_the_layer_of_the_program(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(POOL)
    layer, *tried = run(f"import runpy; runpy.run_path({str(program)!r}, run_name='__main__')")
    assert (layer in ("omp", "workqueue"), tried) == (True, ["omp", "workqueue", "tbb"])


@pytest.mark.parametrize(
    "choice",
    [
        {"NUMBA_THREADING_LAYER": "workqueue"},
        pytest.param({"NUMBA_THREADING_LAYER_PRIORITY": "workqueue omp tbb"}, marks=pytest.mark.slow),
    ],
    ids=lambda choice: next(iter(choice)),
)
def test_a_layer_that_the_user_chooses_wins(choice: dict[str, str]) -> None:
    assert run(f"import coec\n{LAUNCH}", **choice)[0] == "workqueue"
