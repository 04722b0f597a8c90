"""Looks at all pairs of a rig, as the monitor takes them. Every sweep and every picture is prepared once, however many
pairs use it, and each look becomes evidence for its edge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

from coec.adapters.depth.maps import open_depth
from coec.adapters.images.codec import CachedGreys, GreyImages
from coec.calibration.estimators import prepare_window_data
from coec.calibration.monitor.change_detector import Observation
from coec.calibration.monitor.check import check_at, join, seen_part
from coec.calibration.monitor.check_verdict import judge_check
from coec.calibration.monitor.neighbourhood import REACH_RAD
from coec.calibration.monitor.sensors import OUTLINE_RAD, PreparedSweep, prepare_images
from coec.calibration.ports import DepthModel, Silence
from coec.calibration.rig.types import Edge, RigGraph, Sensor, SensorKind
from coec.calibration.types import FramePair, Matrix4, Rig, Window
from coec.config import CalibrationConfig, DepthConfig, LimitsConfig
from coec.evaluation.check_drives import CHECK_PAIRS
from coec.geometry.se3 import inverse
from coec.simulation.aboard import product
from coec.simulation.rig_drive import RigDrive

PERIOD_S = 5.0
"""Time between two looks at one pair, as in the monitor; pairs take turns."""

TURN_S = PERIOD_S / CHECK_PAIRS
"""Time between two instants that are drawn."""

ROWS = (0.34, 0.70)
"""The rows of the pictures that are drawn, as shares of their height: on a street, what the LiDAR sees lies between
0.40 and 0.64, and a local mean reaches 40 pixels further."""

TURNS = (0, 1, 3, 4)
"""By how many instants the looks at each pair follow those at the first pair: 0.8 to 1.7 s apart."""


def due(instants: int, pairs: Sequence[str]) -> tuple[str, ...]:
    """Whose turn it is, of up to four pairs, after so many instants; a look takes the latest `CHECK_PAIRS` instants."""
    return tuple(
        pair
        for turn, pair in zip(TURNS, pairs, strict=False)
        if instants >= CHECK_PAIRS + turn and (instants - turn) % CHECK_PAIRS == 0
    )


@dataclass(frozen=True, slots=True, eq=False)
class SeenPair:
    """A pair of frames with its prepared sweep."""

    frames: FramePair
    sweep: PreparedSweep


def observe(rig: Rig, pose: Matrix4, seen: Sequence[SeenPair]) -> Observation:
    """A look at an uncommissioned pair that serves `pose` (4, 4); edges alone decide, so no depth is inferred.

    Raises:
        CalibrationError: an image cannot be decoded.
    """
    pairs, sweeps = tuple(one.frames for one in seen), [one.sweep for one in seen]
    window = Window(f"{rig.pair}-{pairs[-1].stamp_ns}", rig, pose, pairs)
    images = CachedGreys(GreyImages(LimitsConfig()), len(pairs))
    window_data = prepare_window_data(window, _no_depth(), images, CalibrationConfig(), Silence())
    part = seen_part(rig, sweeps, pose, OUTLINE_RAD)
    upright = rig.T_camera_lidar_nominal[:2, 2]
    pictures = prepare_images(window_data.greys(), len(pairs), rig.camera, rig.mask, upright, part, part)
    evidence = join(window_data, sweeps, pictures, REACH_RAD)
    return judge_check(evidence, check_at(evidence, pose), pose, None)


def graph_of(drive: RigDrive, lidar: str) -> RigGraph:
    """All cameras of a drive with one of its LiDARs, at their nominal mounts; each edge is named after its pair."""
    sensors = [Sensor(lidar, SensorKind.LIDAR), *(Sensor(camera, SensorKind.CAMERA) for camera in drive.cameras)]
    T_ego_lidar = inverse(drive.T_sensor_ego_nominal(lidar))
    edges = [
        Edge(f"{camera}-{lidar}", camera, lidar, product(drive.T_sensor_ego_nominal(camera), T_ego_lidar))
        for camera in drive.cameras
    ]
    return RigGraph.of(sensors, edges)


@cache
def _no_depth() -> DepthModel:
    """A depth model that is never asked: edges alone decide."""
    return open_depth(DepthConfig(model="stereo"), LimitsConfig())
