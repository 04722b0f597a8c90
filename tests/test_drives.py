"""The cache of drawn drives never hides a change of what draws them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np

from coec.calibration.types import LidarFrame
from coec.io.recordings.layouts import open_source
from e2e.processes import environment
from support import simulated_drives

TINY = "sim:seconds=0.4&camera_hz=5&lidar_hz=5&camera=fisheye64&lidar=16&depth=yes"

SCRIPT = f"""
import sys
import coec_lab.simulation.drive
of_drive = set(sys.modules)
from coec_lab.simulation.source import open_sim
from coec.io.recordings.recording_source import parse_spec
before = set(sys.modules)
for _ in open_sim(parse_spec({TINY!r}).query).messages():
    pass
drawing = (name for name in sys.modules if name in of_drive or name not in before)
print(*(sys.modules[name].__file__ for name in drawing if name.split(".")[0] in ("coec", "coec_lab")))
"""


def test_every_module_that_drawing_loads_is_in_the_fingerprint() -> None:
    """In a process of its own: in this one, other tests have loaded them all."""
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, env=environment(), check=True)
    loaded = {Path(name) for name in done.stdout.split()}
    assert any(path.name == "render.py" for path in loaded)
    assert loaded <= simulated_drives.modules_behind(*simulated_drives.ROOTS)


def test_a_rendered_drive_is_the_drive() -> None:
    rendered, drive = simulated_drives.rendered_source(TINY), open_source(TINY)
    assert rendered.camera_stamps_ns == drive.camera_stamps_ns
    for ours, theirs in zip(rendered.messages(), drive.messages(), strict=True):
        if isinstance(ours, LidarFrame) and isinstance(theirs, LidarFrame):
            np.testing.assert_array_equal(ours.xyz_m, theirs.xyz_m)
        else:
            assert ours == theirs
