"""What a worker that says it is ready has behind it."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from coec.calibration.types import Window
from coec.config import Config, LidarConfig
from coec.errors import CalibrationError
from coec.service.worker import warm_up
from coec.service.worker.tasks import Solver
from warm import LENSES, pair_configs

SCRIPT = """
import gc
import coec_lab.simulation.source
from support.simulated_drives import rendered_drive

coec_lab.simulation.source.open_sim = rendered_drive
from numba.core.dispatcher import Dispatcher
from coec.service.worker.warm_up import late_kernels
from coec.service.worker.tasks import Solver
from coec.calibration.pipeline import calibrate
from coec.calibration.types import Silence
from coec.io.recordings.window_cutting import load_window
from coec.cli.convert import configuration_for
from coec.config import CalibrationConfig, Config, DepthConfig, ObjectiveConfig, SearchConfig
from coec.io.recordings.layouts import open_source

source = "sim:seed=1&seconds=12&camera_hz=0.5&lidar_hz=0.5&camera=fisheye160&lidar=16&depth=yes"
window = load_window(source, None, 25, lambda *_: None).window
pair = configuration_for(open_source(source), window.T_camera_lidar_start, None)
settings = dict(depth=DepthConfig(model="stereo"), search=SearchConfig(dof=6, reach_deg=4.0))
configuration = CalibrationConfig(**settings)
config = Config(pairs=(pair.model_copy(update={"calibration": configuration}),))


def kernels():
    compiled = [kernel for kernel in gc.get_objects() if isinstance(kernel, Dispatcher)]
    return {(kernel.py_func.__qualname__, str(types)) for kernel in compiled for types in kernel.overloads}


solver = Solver(config, 8)
solver.warm_up()
warm = kernels()
for kind in ("fused", "mi"):
    solved = CalibrationConfig(**settings, objective=ObjectiveConfig(kind=kind))
    calibrate(window, solver._network(solved.depth), solver._images, solved, Silence())
used = kernels()
for run in late_kernels(solver._rigs[pair.name].camera):
    run()
print(len(warm), sorted(used - warm), "|", sorted(kernels() - used))
"""


def test_no_calibration_waits_for_a_kernel_after_the_warm_up() -> None:
    """In a process of its own: in this one, other tests have run them all."""
    env = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "NUMBA_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, env=env, check=False)
    assert done.returncode == 0, done.stderr
    warm, reported = done.stdout.split(maxsplit=1)
    assert int(warm) > 15
    left, needless = reported.split("|")
    assert left.strip() == "[]"
    assert needless.strip() == "[]", "the second compiler compiles what no solve runs"


def test_pairs_that_differ_in_numbers_alone_are_warmed_up_once(monkeypatch: pytest.MonkeyPatch) -> None:
    warmed: list[type] = []

    def calibrated(window: Window, *_: object) -> None:
        warmed.append(type(window.rig.camera))
        raise CalibrationError("an invented window need not lead to a result")

    monkeypatch.setattr(warm_up, "prepare_window_data", calibrated)
    monkeypatch.setattr(warm_up, "diagnose", calibrated)
    one, other = (next(iter(pair_configs([lens]))) for lens in LENSES[:2])
    another = one.model_copy(update={"name": "another", "lidar": LidarConfig(key="another/lidar")})
    Solver(Config(pairs=(one, another, other)), 1).warm_up()
    assert len(set(warmed)) == 2
    assert len(warmed) == 4, "a check and a window of each"
