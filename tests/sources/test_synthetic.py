"""The synthetic street: repeatable, in order, and consistent with its own truth."""

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.adapters.images.codec import decode_bgr, decode_depth
from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.types import CameraFrame, EgoMotion, FramePair, LidarFrame
from coec.config import LimitsConfig
from coec.errors import UsageError
from coec.geometry import se3
from coec.geometry.cameras import in_image
from coec.geometry.projection import project
from coec.sources import open_source
from coec.sources.recording import Recording

LIMITS = LimitsConfig()
FRAMES = 3


@pytest.fixture(scope="module")
def recording() -> Recording:
    return open_source(f"synthetic:?seed=4&frames={FRAMES}&width=320")


@pytest.fixture(scope="module")
def pairs(recording: Recording) -> list[FramePair]:
    messages = list(recording.messages())
    cameras = [each for each in messages if isinstance(each, CameraFrame)]
    sweeps = [each for each in messages if isinstance(each, LidarFrame)]
    motions = {each.stamp_ns: each for each in messages if isinstance(each, EgoMotion)}
    return [FramePair(c, s, motions[c.stamp_ns]) for c, s in zip(cameras, sweeps, strict=True)]


def _consistency(recording: Recording, pair: FramePair, T_camera_lidar: NDArray[np.float64], *, moved: bool) -> float:
    """Share of the points in view whose range from the camera is within 1 % of the exact depth where they
    project."""
    xyz_m = compensate(pair, recording.rig, enabled=moved)
    p_camera = xyz_m @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3]
    uv_px, valid = project(recording.rig.camera, p_camera)
    range_m = np.linalg.norm(p_camera, axis=1)
    valid &= in_image(recording.rig.camera, uv_px) & (range_m > 4)  # nearer, the code is coarse or at its end
    u, v = np.rint(uv_px[valid]).astype(int).T
    assert pair.camera.depth is not None
    expected_m = 65535 * 2.0 / decode_depth(pair.camera.depth, LIMITS)[v, u]
    assert valid.sum() > 2000
    return float(np.mean(np.abs(expected_m / range_m[valid] - 1) < 0.01))


def test_same_seed_gives_the_same_bytes_and_another_seed_does_not(recording: Recording) -> None:
    first = list(recording.messages([1]))
    second = list(open_source(f"synthetic:?seed=4&frames={FRAMES}&width=320").messages([1]))
    other = list(open_source(f"synthetic:?seed=5&frames={FRAMES}&width=320").messages([1]))

    def content(messages: list[CameraFrame | LidarFrame | EgoMotion]) -> list[object]:
        clouds = [(each.stamp_ns, each.xyz_m.tobytes()) for each in messages if isinstance(each, LidarFrame)]
        return [*(each for each in messages if not isinstance(each, LidarFrame)), *clouds]

    assert content(first) == content(second)
    assert content(first) != content(other)


def test_default_is_one_slice_of_three_minutes() -> None:
    stamps_ns = open_source("synthetic:").camera_stamps_ns
    assert len(stamps_ns) == 12
    assert 160e9 < stamps_ns[-1] - stamps_ns[0] < 180e9


def test_messages_are_in_the_order_of_their_stamps(recording: Recording) -> None:
    stamps_ns = [message.stamp_ns for message in recording.messages()]
    assert stamps_ns == sorted(stamps_ns)


def test_ego_motion_surrounds_every_exposure_at_fifty_hertz(recording: Recording) -> None:
    motions_ns = np.array([each.stamp_ns for each in recording.messages() if isinstance(each, EgoMotion)])
    for stamp_ns in recording.camera_stamps_ns:
        near_s = (motions_ns[np.abs(motions_ns - stamp_ns) < 1e9] - stamp_ns) / 1e9
        assert near_s.min() <= -0.1
        assert near_s.max() >= 0.1
        np.testing.assert_allclose(np.diff(near_s), 0.02)


def test_points_fall_on_the_depth_they_were_measured_at(recording: Recording, pairs: list[FramePair]) -> None:
    truth = recording.rig.T_camera_lidar_nominal
    for pair in pairs:
        right = _consistency(recording, pair, truth, moved=True)
        assert right > 0.7
        assert right > _consistency(recording, pair, truth, moved=False) + 0.02
        for axis in range(3):
            for sign in (-1.0, 1.0):
                wrong = se3.perturb(truth, np.deg2rad(sign) * np.eye(6)[axis])
                assert right > _consistency(recording, pair, wrong, moved=True) + 0.05


def test_image_has_structure_inside_the_mask_and_nothing_outside(recording: Recording, pairs: list[FramePair]) -> None:
    mask = recording.rig.mask
    assert mask is not None
    assert mask.shape == (320, 320)
    for pair in pairs:
        image = decode_bgr(pair.camera.image, LIMITS)
        assert pair.camera.depth is not None
        depth = decode_depth(pair.camera.depth, LIMITS)
        assert image[mask].std() > 30
        assert image[:20, :20].max() < 8
        np.testing.assert_array_equal(np.isfinite(depth), mask)


def test_sweep_is_timed_over_one_turn_about_its_stamp(pairs: list[FramePair]) -> None:
    for pair in pairs:
        sweep = pair.lidar
        assert sweep.time_offset_s is not None
        azimuth = np.arctan2(sweep.xyz_m[:, 1], sweep.xyz_m[:, 0])
        np.testing.assert_allclose(sweep.time_offset_s, -0.1 * azimuth / (2 * np.pi), atol=1e-4)
        assert 8_000 < len(sweep.xyz_m) < 20_000


def test_vehicle_moves(pairs: list[FramePair]) -> None:
    assert all(pair.motion is not None and pair.motion.speed_mps > 6.9 for pair in pairs)


@pytest.mark.parametrize(
    ("query", "complaint"),
    [
        ("sede=1", "sede"),
        ("frames=0", "frames=0.*from 1 to 1000"),
        ("frames=2.5", "frames=2.5.*a whole number"),
        ("width=100000", "width=100000"),
        ("period_s=nan", "period_s=nan.*a number"),
        ("seed=-1", "seed=-1"),
    ],
)
def test_bad_query_names_the_key(query: str, complaint: str) -> None:
    with pytest.raises(UsageError, match=complaint):
        open_source(f"synthetic:?{query}")
