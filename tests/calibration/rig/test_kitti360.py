"""The two parallel cameras of KITTI-360 beside one LiDAR, with the bar between them as a link."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from coec.calibration.rig.graph import Edge, RigGraph, RigidLink, Sensor, SensorKind
from coec.calibration.rig.joint_estimate import estimate_jointly
from coec.calibration.tracker import Measurement
from coec.config import CalibrationConfig, LimitsConfig
from coec.geometry import se3
from coec.io.depth.depth_maps import open_depth
from coec.io.recordings import window_cutting
from coec_lab.experiments.solve_experiments import Bench, greys_of, inferred

BAR = np.array([np.radians(0.02)] * 3 + [0.002] * 3)
"""What the rectification of a stereo camera is good for (rad, m)."""


def _calibrated(source: str) -> tuple[Measurement, np.ndarray]:
    loaded = window_cutting.load_window(source, None, 25, lambda *_: None)
    configuration = CalibrationConfig()
    depth = inferred(loaded.window, open_depth(configuration.depth, LimitsConfig()), lambda *_: None)
    bench = Bench(loaded.window, depth, greys_of(loaded.window), configuration)
    outcome = bench.solve(bench.reference)
    assert outcome.trial.estimate is not None
    assert outcome.accepted
    return Measurement.from_estimate(outcome.trial.estimate), bench.reference


@pytest.mark.slow
def test_two_cameras_on_a_bar_close_and_keep_what_they_have_in_common(
    sample_data: Path, record_property: Callable[[str, object], None]
) -> None:
    cameras = ("image_00", "image_01")
    reported = {
        name: _calibrated(f"kitti360:{sample_data / 'kitti360'}?drive=2013_05_28_drive_0000_sync&camera={name}")
        for name in cameras
    }
    built = {name: reference for name, (_, reference) in reported.items()}
    T_1_0 = built["image_01"] @ se3.inverse(built["image_00"])
    assert np.linalg.norm(T_1_0[:3, 3]) == pytest.approx(0.594, abs=0.01)
    sensors = [*(Sensor(name, SensorKind.CAMERA) for name in cameras), Sensor("velodyne", SensorKind.LIDAR)]
    edges = [Edge(name, name, "velodyne", built[name]) for name in cameras]
    rig = RigGraph.of(sensors, edges, [RigidLink("bar", "image_01", "image_00", T_1_0, BAR)])
    seen = {name: window for name, (window, _) in reported.items()}
    result = estimate_jointly(rig, seen)
    alone = {name: se3.difference(seen[name].T_camera_lidar, built[name])[:3] for name in cameras}
    joined = {name: se3.difference(result.T_a_b[name], built[name])[:3] for name in cameras}
    separation = {
        how: np.degrees(np.linalg.norm(xi["image_01"] - xi["image_00"]))
        for how, xi in (("alone", alone), ("joined", joined))
    }
    common = np.degrees(np.linalg.norm(sum(joined.values()) / 2.0 - sum(alone.values()) / 2.0))
    closed = f"apart {separation['alone']:.3f}° alone, {separation['joined']:.3f}° joined"
    record_property("figure", f"{closed}; common offset moved {common:.3f}°")
    assert result.consistent
    assert separation["joined"] < 0.03
    assert common < 0.03
