"""A camera that moves while a window is taken. To move the late sweeps by S⁻¹ is to move the mount by S: exact."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.search.test_global_search import angle_deg, away_from
from coec.calibration.objective.edges import EdgeCue
from coec.calibration.search.change_point import MIN_FRAMES, change_point
from coec.calibration.types import Matrix4, Window
from coec.config import VerdictConfig
from coec.geometry import se3

LIMITS = VerdictConfig()


def turned(edges: EdgeCue, first: int, last: int, T_before: Matrix4, T_after: Matrix4) -> EdgeCue:
    """The cue as if the mount had been at `T_after` in the frames `first` to before `last`."""
    carried = se3.inverse(T_after) @ T_before
    band, chart, sharp = edges.bands[0], edges.charts[-1], edges.sharp

    def of(xyz_m: np.ndarray, of_frames: np.ndarray) -> np.ndarray:
        moved = carried[:3, :3] @ xyz_m + carried[:3, 3:]
        return np.where((of_frames >= first) & (of_frames < last), moved, xyz_m).astype(np.float32)

    frames, of_sharp = (np.repeat(np.arange(len(e.first_point) - 1), np.diff(e.first_point)) for e in (band, sharp))
    return replace(
        edges,
        sharp=replace(sharp, xyz_m=of(sharp.xyz_m, of_sharp)),
        bands=(replace(band, xyz_m=of(band.xyz_m, frames)), *edges.bands[1:]),
        charts=(edges.charts[0], replace(chart, xyz_m=of(chart.xyz_m, chart.frame))),
    )


def test_a_mount_that_stays_gains_nothing(sharp_street: Window, sharp_edges: EdgeCue) -> None:
    result = change_point(sharp_edges, sharp_street.T_camera_lidar_start)
    assert result is not None
    assert result.gain < 0.5 * LIMITS.max_change_gain


@pytest.mark.parametrize(
    ("first_late", "size_deg"), [(9, 3.0), (8, 1.5), (7, 0.5), (6, 0.3), (5, 0.5), (3, 3.0), (2, 1.0)]
)
def test_a_displacement_is_detected_where_and_when_it_was(
    sharp_street: Window, sharp_edges: EdgeCue, first_late: int, size_deg: float
) -> None:
    T_before = sharp_street.T_camera_lidar_start
    T_after = away_from(T_before, size_deg, seed=first_late)
    # The solve ends where most of the frames are.
    solved = T_before if first_late >= 5 else T_after
    result = change_point(turned(sharp_edges, first_late, 10, T_before, T_after), solved)
    assert result is not None
    assert result.gain > LIMITS.max_change_gain
    assert result.of_camera
    assert result.first_late == first_late
    # Two frames alone tell a pose to half a degree.
    assert angle_deg(result.T_before, T_before) < 0.6
    assert angle_deg(result.T_after, T_after) < 0.6
    assert np.degrees(result.turn_rad) == pytest.approx(size_deg, abs=0.6)


def test_one_bad_frame_is_no_knock(sharp_street: Window, sharp_edges: EdgeCue) -> None:
    pose = sharp_street.T_camera_lidar_start
    result = change_point(turned(sharp_edges, 4, 5, pose, away_from(pose, 2.0, seed=1)), pose)
    assert result is not None
    assert result.gain < LIMITS.max_change_gain


def test_frames_that_fit_nothing_are_no_knock(sharp_street: Window, sharp_edges: EdgeCue) -> None:
    pose = sharp_street.T_camera_lidar_start
    result = change_point(turned(sharp_edges, 6, 10, pose, away_from(pose, 90.0, seed=2)), pose)
    assert result is not None
    assert not (result.of_camera and result.gain > LIMITS.max_change_gain)


def test_same_input_same_bits(sharp_street: Window, sharp_edges: EdgeCue) -> None:
    pose = sharp_street.T_camera_lidar_start
    edges = turned(sharp_edges, 6, 10, pose, away_from(pose, 1.0, seed=3))
    one, other = change_point(edges, pose), change_point(edges, pose)
    assert one is not None
    assert other is not None
    assert (one.first_late, one.gain, one.T_after.tobytes()) == (other.first_late, other.gain, other.T_after.tobytes())


def test_few_frames_have_no_early_and_late(sharp_street: Window, sharp_edges: EdgeCue) -> None:
    few = replace(sharp_edges.whole, first_point=sharp_edges.whole.first_point[:MIN_FRAMES])
    assert change_point(replace(sharp_edges, whole=few), sharp_street.T_camera_lidar_start) is None
