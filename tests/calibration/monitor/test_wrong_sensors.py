"""Checks of a rendered drive on which a sensor is wrong, and what becomes of health."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from calibration.conftest import window_of
from calibration.test_lifecycle import RULES
from coec.calibration import state as lifecycle
from coec.calibration.frames.window import CheckSampler, stands
from coec.calibration.monitor.change_detector import MonitorState
from coec.calibration.monitor.check_verdict import observe
from coec.calibration.state import CalibrationStatus, PairState, Provenance
from coec.calibration.state_machine import HealthState
from coec.calibration.types import DepthModel, FramePair, Matrix4, Rig, Window
from coec.config import CalibrationConfig, LimitsConfig, WindowConfig
from coec.geometry import se3
from coec.io.images import GreyImages
from support.simulated_drives import rendered_source

pytest.importorskip("embreex", reason="needs embreex")

DRIVE = "sim:seed=41&seconds=26&camera_hz=1&lidar_hz=1&ego_hz=20&camera=pinhole480x240&lidar=32&depth=yes"
LIMIT_S = 15.0
Change = Callable[[FramePair], FramePair]


@dataclass(frozen=True)
class Course:
    """How health went: seconds for which it stayed healthy, the state at the end, and all codes of reasons."""

    healthy_s: float
    last: HealthState
    reasons: frozenset[str]


@pytest.fixture(scope="module")
def drive() -> Window:
    """A drive at 8 m/s with a pair a second."""
    return window_of(rendered_source(DRIVE))


def course(drive: Window, depth: DepthModel, change: Change = lambda pair: pair, rig: Rig | None = None) -> Course:
    """Checks every period of the drive, its pairs changed, from a healthy state on."""
    pose, begin_ns = drive.T_camera_lidar_start, drive.pairs[0].stamp_ns
    sampler, images = CheckSampler(RULES.monitor), GreyImages(LimitsConfig())
    state = PairState(
        pose,
        Provenance.ESTIMATED,
        CalibrationStatus.ACCEPTED,
        0,
        health=HealthState.HEALTHY,
        reasons=(),
        proven=True,
        monitor=MonitorState(vouched=True, acquitted_ns=begin_ns),
    )
    healthy_s, reasons = 0.0, set()
    for pair in drive.pairs:
        selected = sampler.offer(change(pair))
        if selected is None:
            continue
        window = Window("check", rig or drive.rig, pose, selected)
        observation = observe(window, depth, images, CalibrationConfig(), None)
        standing = tuple(one.stamp_ns for one in selected if stands(one, WindowConfig()))
        state = lifecycle.after_observation(state, replace(observation, standing_stamps_ns=standing), RULES)
        reasons |= {reason.code for reason in state.reasons}
        if state.health is HealthState.HEALTHY:
            healthy_s = (observation.stamp_ns - begin_ns) / 1e9
    return Course(healthy_s, state.health, frozenset(reasons))


def without_motion(pair: FramePair) -> FramePair:
    """Odometry reports a standing vehicle."""
    assert pair.motion is not None
    return replace(pair, motion=replace(pair.motion, linear_mps=(0.0, 0.0, 0.0), angular_radps=(0.0, 0.0, 0.0)))


def with_points(pair: FramePair, T: Matrix4) -> FramePair:
    """The sweep as a LiDAR measures it that was moved: its points p are T·p (4, 4)."""
    moved = np.einsum("ij,nj->ni", T[:3, :3], pair.lidar.xyz_m) + T[:3, 3]
    return replace(pair, lidar=replace(pair.lidar, xyz_m=np.ascontiguousarray(moved.astype(np.float32))))


def turned(degrees: float) -> Matrix4:
    """(4, 4) about the axis of the LiDAR."""
    return se3.perturbation(np.array([0.0, 0.0, np.radians(degrees), 0.0, 0.0, 0.0]))


def repeating(drive: Window, *, camera: bool) -> Change:
    """The drivers repeat the first sweep, and the first picture if `camera`, with fresh stamps."""
    first = drive.pairs[0]

    def change(pair: FramePair) -> FramePair:
        lidar = replace(first.lidar, stamp_ns=pair.lidar.stamp_ns)
        picture = replace(first.camera, stamp_ns=pair.camera.stamp_ns) if camera else pair.camera
        return replace(pair, camera=picture, lidar=lidar)

    return change


def test_a_right_rig_stays_healthy(drive: Window, stereo: DepthModel) -> None:
    assert course(drive, stereo).last is HealthState.HEALTHY


@pytest.mark.fault(
    "odometry reports a standing vehicle that drives, and the mount is turned by 3°",
    "not healthy after three periods; the odometry is named",
)
def test_stuck_odometry(drive: Window, stereo: DepthModel) -> None:
    pose = drive.T_camera_lidar_start
    after = se3.perturb(pose, np.radians([0.0, 3.0, 0.0, 0.0, 0.0, 0.0]))
    result = course(drive, stereo, lambda pair: with_points(without_motion(pair), se3.inverse(after) @ pose))
    assert (result.last is HealthState.HEALTHY, result.healthy_s <= LIMIT_S) == (False, True)
    assert "ego_motion_wrong" in result.reasons


@pytest.mark.fault("a LiDAR that is turned by 40° or 180° about its axis", "not healthy after three periods")
@pytest.mark.parametrize("degrees", [40.0, pytest.param(180.0, marks=pytest.mark.slow)])
def test_a_turned_lidar(drive: Window, stereo: DepthModel, degrees: float) -> None:
    result = course(drive, stereo, lambda pair: with_points(pair, turned(degrees)))
    assert (result.last is HealthState.HEALTHY, result.healthy_s <= LIMIT_S) == (False, True)


@pytest.mark.fault(
    "drivers that repeat their last frames with fresh stamps, while odometry reports a standing vehicle or motion",
    "not healthy after three periods; the frozen sensor is named",
)
@pytest.mark.parametrize(
    ("camera", "standing", "code"), [(True, True, "camera_frozen"), (False, False, "lidar_frozen")]
)
def test_repeated_frames(drive: Window, stereo: DepthModel, *, camera: bool, standing: bool, code: str) -> None:
    repeated = repeating(drive, camera=camera)
    result = course(drive, stereo, lambda pair: without_motion(repeated(pair)) if standing else repeated(pair))
    assert (result.last is HealthState.HEALTHY, result.healthy_s <= LIMIT_S) == (False, True)
    assert code in result.reasons


@pytest.mark.fault("a focal length that is 2 % or 5 % wrong", "not healthy after three periods; the lens is named")
@pytest.mark.parametrize("factor", [1.02, pytest.param(1.05, marks=pytest.mark.slow)])
def test_a_wrong_focal_length(drive: Window, stereo: DepthModel, factor: float) -> None:
    camera = drive.rig.camera
    rig = replace(drive.rig, camera=camera._replace(fx=factor * camera.fx, fy=factor * camera.fy))
    result = course(drive, stereo, rig=rig)
    assert (result.last is HealthState.HEALTHY, result.healthy_s <= LIMIT_S) == (False, True)
    assert "intrinsics_off" in result.reasons
    assert result.reasons.isdisjoint({"time_offset", "ego_motion_wrong"})


@pytest.mark.fault("a mount that swings by 1.5° about any axis in 2.3 s", "not healthy after four periods")
@pytest.mark.parametrize("axis", [0, *(pytest.param(axis, marks=pytest.mark.slow) for axis in (1, 2))])
def test_a_swinging_mount(drive: Window, stereo: DepthModel, axis: int) -> None:
    pose = drive.T_camera_lidar_start

    def change(pair: FramePair) -> FramePair:
        angle_rad = np.radians(1.5) * np.sin(2.0 * np.pi * pair.stamp_ns / 2.3e9)
        after = se3.perturb(pose, angle_rad * np.eye(6)[axis])
        return with_points(pair, se3.inverse(after) @ pose)

    # A check sees the mean of a swing, which may be right by chance.
    assert course(drive, stereo, change).healthy_s <= LIMIT_S + RULES.monitor.period_s
