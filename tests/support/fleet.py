"""Fleets that do not exist: rows of windows as a batch leaves them, drawn with a seed; windows of a small drive with
the results that two vehicles left in them; a Ray cluster of nodes on this machine, and what to do to them.
"""

from __future__ import annotations

import hashlib
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from coec.calibration.pipeline import calibrate
from coec.calibration.types import Silence
from coec.config import CalibrationConfig, DepthConfig, LimitsConfig, ObjectiveConfig
from coec.fleet.jobs import Job, empty_row, lost_row
from coec.io.depth.depth_maps import open_depth
from coec.io.images import GreyImages
from coec.io.mcap.windows import WindowWriter, read_window, write_result
from coec.io.recordings import window_cutting
from coec.io.serialise import result_of
from coec.schemas.documents import WindowRow
from coec.schemas.replies import CalibrationResult, Reason, Verdict
from support.simulated_drives import rendered_drive

BEGIN_NS = 1_700_000_000_000_000_000
HOUR_NS = 3_600_000_000_000

WINDOW_SIGMA = np.array([0.03, 0.02, 0.03, 0.01, 0.01, 0.01])
"""deg and m, of a window."""

REFUSED_SHARE, FAILED_SHARE = 0.05, 0.01
"""Shares."""


def fleet_rows(
    pattern: CalibrationResult, vehicles: int, windows: int, drifts: dict[int, tuple[int, float]], seed: int
) -> Iterator[WindowRow]:
    """The rows of a fleet, vehicle by vehicle, a window every 2.4 hours.

    Args:
        pattern: a real result, for whatever is not drawn.
        vehicles: their number; they are called v000 and so on.
        windows: of each.
        drifts: by the index of a vehicle, an axis and by how much it turns or moves from first to last window.
        seed: of everything.
    """
    rng = np.random.default_rng(seed)
    for vehicle in range(vehicles):
        name = f"v{vehicle:03}"
        mount = rng.normal(0.0, 0.3, 6) * (WINDOW_SIGMA / WINDOW_SIGMA[0])
        axis, drift = drifts.get(vehicle, (0, 0.0))
        for window in range(windows):
            stamp_ns = BEGIN_NS + round(2.4 * HOUR_NS) * window
            url = f"{name}/front-{stamp_ns}.mcap"
            sha256 = hashlib.sha256(url.encode()).hexdigest()
            chance = rng.random()
            if chance < FAILED_SHARE:
                yield lost_row(Job(url), "bad_window", "it is cut off").model_copy(update={"sha256": sha256})
                continue
            correction = mount + rng.normal(0.0, WINDOW_SIGMA)
            correction[axis] += drift * window / max(windows - 1, 1)
            refused = chance < FAILED_SHARE + REFUSED_SHARE
            result = pattern.model_copy(
                update={
                    "vehicle": name,
                    "pair": "front",
                    "window_id": f"front-{stamp_ns}",
                    "data_stamp_ns": stamp_ns,
                    "correction": tuple(float(value) for value in correction),
                    "solved": (True,) * 6,
                    "unobservable": (False,) * 6,
                    "verdict": Verdict(
                        decision="failed" if refused else "accepted",
                        reasons=(Reason(code="sigma_deg", text="too wide"),) if refused else (),
                    ),
                }
            )
            yield empty_row(Job(url), {"coec": "0.1.0"}).model_copy(
                update={"sha256": sha256, "vehicle": name, "result": result, "decided": sha256, "seconds": 1.0}
            )


SMALL_DRIVE = "sim:seed=1&seconds=12&camera_hz=0.5&lidar_hz=0.5&camera=fisheye160&lidar=16&depth=yes"
"""Six frames, two seconds apart, with exact depth."""

LIMITS = LimitsConfig()
WINDOW_CONFIGURATION = CalibrationConfig(
    depth=DepthConfig(model="stereo"), objective=ObjectiveConfig(kind="mi", depth_bins=24, range_bins=20)
)
"""Quick, and not the defaults: what a file says must be used."""

STARTS_RAD = {"one": (0.02, -0.01, 0.01), "two": (0.0, 0.015, -0.01)}
"""By the vehicle that recorded the window: how far off it began."""


def recorded_windows(folder: Path) -> Path:
    """The folder, with two windows in it, as the services of two vehicles leave them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("coec_lab.simulation.source.open_sim", rendered_drive)
        loaded = window_cutting.load_window(SMALL_DRIVE, None, 25, lambda *_: None)
    for vehicle, start in STARTS_RAD.items():
        window = window_cutting.with_perturbed_start(loaded.window, np.array([*start, 0, 0, 0]))
        window = replace(window, window_id=f"{vehicle}-1")
        path = folder / vehicle / f"{window.window_id}.mcap"
        path.parent.mkdir()
        writer = WindowWriter(
            path, window.rig, window.T_camera_lidar_start, window.window_id, WINDOW_CONFIGURATION, {"vehicle": vehicle}
        )
        for pair in window.pairs:
            writer.add(pair)
        writer.finish()
        read, configuration = read_window(path)
        depth = open_depth(configuration.depth, LIMITS)
        estimate = calibrate(read, depth, GreyImages(LIMITS), configuration, Silence())
        write_result(path, result_of(estimate, read.rig, vehicle))
    return folder


STORE_CREDENTIALS = ("AWS_", "AZURE_", "GOOGLE_")
"""Prefixes of environment variables that the nodes do not get."""

RAY_MISSING = "needs the optional extra `ray`: pip install 'coec[ray]' in an environment for tests"


class RayNodes:
    """Two nodes. Only the first one runs the cluster's own services, so the second one may be lost."""

    def __init__(self, cluster: Any) -> None:
        self._cluster = cluster
        self.address: str = cluster.address
        self.second: Any = cluster.add_node(num_cpus=1, object_store_memory=80 * 2**20)

    @property
    def logs(self) -> Path:
        """Folder with the logs of all nodes."""
        return Path(self._cluster.head_node.get_session_dir_path())

    def raylet_of_second(self) -> psutil.Process:
        """The process that is the second node."""
        return psutil.Process(self.second.all_processes["raylet"][0].process.pid)

    def judging_on_second(self) -> bool:
        """Whether a window is being judged on the second node."""
        for child in self.raylet_of_second().children(recursive=True):
            try:
                if child.cmdline()[:1] == ["ray::_Judge.row"]:
                    return True
            except psutil.Error:
                continue
        return False

    def kill_second(self) -> None:
        """Kills every process of the second node for good, as when its machine is taken away."""
        raylet = self.raylet_of_second()
        for process in [raylet, *raylet.children(recursive=True)]:
            process.kill()

    def freeze_second(self) -> list[psutil.Process]:
        """Stops every process of the second node, so that it falls silent with its connections open; returns them."""
        raylet = self.raylet_of_second()
        processes = [raylet, *raylet.children(recursive=True)]
        for process in processes:
            process.send_signal(signal.SIGSTOP)
        return processes


@contextmanager
def two_nodes() -> Iterator[RayNodes]:
    """Two nodes that have no credentials for stores. Skips if Ray is not installed."""
    pytest.importorskip("ray", reason=RAY_MISSING)
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        for name in [name for name in os.environ if name.startswith(STORE_CREDENTIALS)]:
            patch.delenv(name)
        cluster = Cluster(
            initialize_head=True,
            head_node_args={"num_cpus": 1, "object_store_memory": 80 * 2**20, "include_dashboard": False},
        )
        try:
            yield RayNodes(cluster)
        finally:
            cluster.shutdown()


def batch_command(*arguments: object) -> list[str]:
    """The command line of `coec batch`."""
    return [sys.executable, "-m", "coec", "batch", *map(str, arguments)]
