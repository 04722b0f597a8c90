"""The global stage: an even cover of the reach, and the true basin from far away."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.conftest import window_of
from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.objective.edges import EdgeCue, build_edges, in_reach
from coec.calibration.objective.mutual_information import SearchBox
from coec.calibration.search.global_search import (
    AT_RIM,
    FINE,
    ROUNDS,
    SUMMIT_MARGIN,
    at_rim,
    basin_next_to,
    find_basins,
    highest_summit,
    sample_reach,
)
from coec.calibration.types import Matrix4, Window
from coec.config import LimitsConfig
from coec.geometry import se3
from coec.geometry.edges.alignment import significances
from coec.geometry.edges.charts import charted_significances
from coec.io.images import GreyImages
from coec.io.recordings.layouts import open_source

START = se3.perturbation(np.array([0.4, -0.3, 1.2, 0.5, -1.0, 2.0]))
TURN = SearchBox(np.radians(28.0), 0.0)
BOTH = SearchBox(np.radians(28.0), 0.55)


def moves(poses: NDArray[np.float64], start: Matrix4) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation vectors and shifts (K, 3) that lead from the start to the poses."""
    steps = [se3.perturbation_log(pose @ se3.inverse(start)) for pose in poses]
    shifts = [pose[:3, 3] - pose[:3, :3] @ start[:3, :3].T @ start[:3, 3] for pose in poses]
    return np.array(steps)[:, :3], np.array(shifts)


def angle_deg(a: Matrix4, b: Matrix4) -> float:
    return float(np.degrees(se3.rotation_angle_rad(a @ se3.inverse(b))))


def away_from(truth: Matrix4, angle_deg: float, seed: int) -> Matrix4:
    axis = np.random.default_rng(seed).normal(size=3)
    axis *= np.radians(angle_deg) / np.linalg.norm(axis)
    return se3.perturb(truth, np.array([*axis, 0.0, 0.0, 0.0]))


@pytest.mark.parametrize("reach", [TURN, BOTH], ids=["turn", "both"])
def test_the_cover_stays_within_the_reach(reach: SearchBox) -> None:
    poses = sample_reach(START, reach, 3000)
    assert poses.shape == (3000, 4, 4)
    assert all(se3.is_rigid(pose) for pose in poses)
    turns, shifts = moves(poses, START)
    assert np.linalg.norm(turns, axis=1).max() <= reach.rotation_rad + 1e-9
    assert np.linalg.norm(shifts, axis=1).max() <= reach.translation_m + 1e-9


def test_the_cover_is_deterministic() -> None:
    assert sample_reach(START, BOTH, 500).tobytes() == sample_reach(START, BOTH, 500).tobytes()


def test_the_cover_is_even() -> None:
    turns, shifts = moves(sample_reach(START, BOTH, 4000), START)
    for vectors, radius in ((turns / BOTH.rotation_rad, 1.0), (shifts / BOTH.translation_m, 1.0)):
        # As many points in each octant, and an eighth of them within half the radius.
        octants = np.bincount((vectors > 0.0) @ [1, 2, 4], minlength=8)
        assert np.abs(octants / 4000 - 1 / 8).max() < 0.01
        assert np.mean(np.linalg.norm(vectors, axis=1) < radius / 2) == pytest.approx(1 / 8, abs=0.01)
    # Where the LiDAR turns tells nothing about where it shifts.
    correlation = np.corrcoef(turns.T, shifts.T)[:3, 3:]
    assert np.abs(correlation).max() < 0.05


def test_no_pose_of_the_reach_is_far_from_the_cover() -> None:
    turns, _ = moves(sample_reach(START, TURN, 4000), START)
    rng = np.random.default_rng(0)
    anywhere = rng.normal(size=(300, 3))
    anywhere *= TURN.rotation_rad * rng.random((300, 1)) ** (1 / 3) / np.linalg.norm(anywhere, axis=1, keepdims=True)
    gaps = np.linalg.norm(anywhere[:, None] - turns[None], axis=2).min(axis=1)
    # Side of the cube that each of 4000 poses has to itself.
    side = TURN.rotation_rad * (4.0 / 3.0 * np.pi / 4000) ** (1 / 3)
    assert gaps.max() < 1.5 * side


@pytest.mark.parametrize("seed", range(2))
def test_the_true_basin_is_detected_from_twenty_degrees_away(
    sharp_street: Window, sharp_edges: EdgeCue, seed: int
) -> None:
    truth = sharp_street.rig.T_camera_lidar_nominal
    basins = find_basins(sharp_edges, away_from(truth, 20.0, seed), TURN)
    # On the hill of the fine chart, from where a basin is polished.
    nearest_deg = min(angle_deg(basin.T_camera_lidar, truth) for basin in basins)
    assert nearest_deg < 1.5 * np.degrees(sharp_edges.band_blur_rad[1])


def test_the_true_translation_is_detected_from_half_a_metre_away(sample_data: Path) -> None:
    """On real streets: they tell height, and are cheaper here than a drawn one of their resolution."""
    window = window_of(open_source(f"kitti360:{sample_data}/kitti360?camera=image_00"))
    images = GreyImages(LimitsConfig())
    edges = build_edges(
        window.pairs,
        lambda frame, selected: compensate(window.pairs[frame], window.rig, enabled=True, selection=selected),
        [images.grey(pair.camera) for pair in window.pairs],
        window.rig,
    )
    truth = window.T_camera_lidar_start
    for shift in 0.5 * np.concatenate([np.eye(3), -np.eye(3)]):
        start = se3.perturb(truth, np.concatenate([np.radians(shift), shift]))
        best = find_basins(edges, start, SearchBox(np.radians(3.5), 0.65))[0].T_camera_lidar
        assert angle_deg(best, truth) < 0.6
        assert np.linalg.norm(best[:3, 3] - truth[:3, 3]) < 0.2


def test_in_a_room_every_start_leads_to_one_basin(sample_data: Path) -> None:
    """A quarter of the edges of this laboratory are nearer than three metres."""
    window = window_of(open_source(str(sample_data / "fisheye_lab_vlp16/dataset.yaml")))
    greys = (GreyImages(LimitsConfig()).grey(pair.camera) for pair in window.pairs)
    edges = build_edges(window.pairs, lambda index, points: window.pairs[index].lidar.xyz_m[points], greys, window.rig)
    truth, best = window.T_camera_lidar_start, []
    for seed in range(2):
        turn, shift = np.random.default_rng([seed, 2]).normal(size=(2, 3))
        start = se3.perturb(truth, np.array([*np.radians(15.0) * turn / np.linalg.norm(turn), 0.0, 0.0, 0.0]))
        start[:3, 3] += 0.35 * shift / np.linalg.norm(shift)
        best.append(find_basins(edges, start, BOTH)[0].T_camera_lidar)
    difference = se3.difference(best[1], best[0])
    assert np.degrees(np.linalg.norm(difference[:3])) < 0.6
    assert np.linalg.norm(difference[3:]) < 0.02


def test_basins_are_distinct_and_the_best_comes_first(sharp_street: Window, sharp_edges: EdgeCue) -> None:
    basins = find_basins(sharp_edges, away_from(sharp_street.rig.T_camera_lidar_nominal, 10.0, 4), TURN)
    assert 1 <= len(basins) <= ROUNDS[-1].poses
    z = [basin.significance for basin in basins]
    assert z == sorted(z, reverse=True)
    poses = np.stack([basin.T_camera_lidar for basin in basins])
    assert z == charted_significances(sharp_edges.charts[FINE], poses).tolist()
    for index, a in enumerate(basins):
        for b in basins[:index]:
            assert angle_deg(a.T_camera_lidar, b.T_camera_lidar) >= np.degrees(ROUNDS[-1].separation_rad) - 1e-6


def test_rotation_only_leaves_the_lidar_where_the_start_has_it(sharp_street: Window, sharp_edges: EdgeCue) -> None:
    start = away_from(sharp_street.rig.T_camera_lidar_nominal, 8.0, 6)
    poses = np.stack([basin.T_camera_lidar for basin in find_basins(sharp_edges, start, TURN)])
    _, shifts = moves(poses, start)
    assert np.abs(shifts).max() < 1e-9


def test_basins_lie_within_the_reach(sharp_street: Window, sharp_edges: EdgeCue) -> None:
    start = away_from(sharp_street.rig.T_camera_lidar_nominal, 15.0, 0)
    turns, shifts = moves(np.stack([b.T_camera_lidar for b in find_basins(sharp_edges, start, BOTH)]), start)
    assert np.linalg.norm(turns, axis=1).max() <= BOTH.rotation_rad + 1e-6
    assert np.linalg.norm(shifts, axis=1).max() <= BOTH.translation_m + 2e-6


@pytest.mark.parametrize("share", [0.5, AT_RIM - 0.01, AT_RIM + 0.01, 1.5])
@pytest.mark.parametrize("axis", [1, 4])
def test_a_pose_near_the_bound_of_either_reach_lies_on_the_rim(axis: int, share: float) -> None:
    bound = BOTH.rotation_rad if axis < 3 else BOTH.translation_m
    assert at_rim(se3.perturb(START, share * bound * np.eye(6)[axis]), START, BOTH) == (share > AT_RIM)


def test_rotation_only_has_no_rim_of_translation() -> None:
    assert not at_rim(se3.perturb(START, np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])), START, TURN)


@pytest.mark.slow  # of kept windows the golden decisions tell the bytes
def test_same_input_same_basins_to_the_bit(sharp_street: Window, sharp_edges: EdgeCue) -> None:
    start = away_from(sharp_street.rig.T_camera_lidar_nominal, 12.0, 3)
    first, second = (find_basins(sharp_edges, start, BOTH) for _ in range(2))
    assert [b.T_camera_lidar.tobytes() for b in first] == [b.T_camera_lidar.tobytes() for b in second]
    assert [b.significance for b in first] == [b.significance for b in second]


def test_what_lies_next_to_a_pose_is_the_true_basin_from_a_degree_away(
    sharp_street: Window, sharp_edges: EdgeCue
) -> None:
    truth = sharp_street.rig.T_camera_lidar_nominal
    near = SearchBox(np.radians(5.0), 0.0)
    end = basin_next_to(sharp_edges, away_from(truth, 1.0, 5), near)
    assert angle_deg(end, truth) < 1.5 * np.degrees(sharp_edges.band_blur_rad[1])
    far = away_from(truth, 20.0, 5)
    assert angle_deg(basin_next_to(sharp_edges, far, near), far) <= 5.0


def test_edges_out_of_reach_are_nothing_to_the_bit(sharp_street: Window, sharp_edges: EdgeCue) -> None:
    start = away_from(sharp_street.rig.T_camera_lidar_nominal, 9.0, 1)
    charts = sharp_edges.charts[FINE]
    retained = in_reach(charts, sharp_edges.half_view_rad, start, BOTH)
    assert retained.xyz_m.shape[1] < charts.xyz_m.shape[1]
    poses = sample_reach(start, BOTH, 200)
    assert charted_significances(retained, poses).tolist() == charted_significances(charts, poses).tolist()


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("turned", "shifted"), [(0, 4), (1, 3)])
def test_a_pose_on_the_side_of_a_valley_is_led_to_the_summit_of_the_sharpest_edges(
    sharp_street: Window, sharp_edges: EdgeCue, turned: int, shifted: int, sign: float
) -> None:
    truth = sharp_street.rig.T_camera_lidar_nominal
    step = np.zeros(6)
    # A shift upwards with the turn that leaves things at ten metres where they are; to the side it turns the other way.
    step[turned], step[shifted] = sign * np.radians(0.5), sign * (1 if turned == 0 else -1) * 10.0 * np.radians(0.5)
    off = se3.perturb(truth, step)
    end = highest_summit(sharp_edges, off, None)
    of_truth, of_off, of_end = significances(sharp_edges.sharp, np.array([truth, off, end]))
    assert of_off < 0.8 * of_truth
    assert of_end > of_truth - SUMMIT_MARGIN
    assert angle_deg(end, truth) < 0.1


@pytest.mark.parametrize("roll_deg", [-2.2, 1.4, 3.0])
def test_a_rolled_pose_is_turned_to_the_summit_and_not_shifted(
    sharp_street: Window, sharp_edges: EdgeCue, roll_deg: float
) -> None:
    truth = sharp_street.rig.T_camera_lidar_nominal
    off = se3.perturb(truth, np.radians([0.3, -0.2, roll_deg, 0.0, 0.0, 0.0]))
    end = highest_summit(sharp_edges, off, 0.01)
    assert angle_deg(end, truth) < 0.1
    assert np.allclose(se3.inverse(end)[:3, 3], se3.inverse(off)[:3, 3], atol=1e-9)


def test_a_pose_is_left_where_the_error_of_the_held_centre_displaces_near_edges(
    sharp_street: Window, sharp_edges: EdgeCue
) -> None:
    off = se3.perturb(sharp_street.rig.T_camera_lidar_nominal, np.radians([0.0, 0.0, 2.0, 0.0, 0.0, 0.0]))
    assert highest_summit(sharp_edges, off, 0.1) is off


def test_a_summit_is_left_where_it_is(sharp_street: Window, sharp_edges: EdgeCue) -> None:
    summit = highest_summit(sharp_edges, sharp_street.rig.T_camera_lidar_nominal, None)
    assert highest_summit(sharp_edges, summit, None) is summit


def test_edges_out_of_view_lead_nowhere(sharp_street: Window, sharp_edges: EdgeCue) -> None:
    behind = se3.perturb(sharp_street.rig.T_camera_lidar_nominal, np.array([np.pi, 0.0, 0.0, 0.0, 0.0, 0.0]))
    alone = replace(sharp_edges, sharp=sharp_edges.sharp.of_points(np.zeros(0, np.int64)))
    assert highest_summit(alone, behind, None) is behind
