"""Climbs at once against one after the other, in plain Python."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.geometry import se3
from coec.geometry.cameras import build
from coec.geometry.edges.alignment import MAX_SWEEPS, AscentStart, EdgeFrames, ascend, frame_alignment

WIDTH, HEIGHT, EDGES = 96, 64, 300
TRUTH = se3.perturbation(np.array([0.02, -0.03, 0.01, 0.0, 0.0, 0.0]))
STEPS_RAD = (0.02, 0.01, 0.005)
MOVES = np.array([[se3.perturb(np.eye(4), step * turn) for turn in (*np.eye(6)[:3], *-np.eye(6)[:3])]
                  for step in STEPS_RAD])  # fmt: skip


@pytest.fixture(scope="module")
def frames() -> EdgeFrames:
    """Five frames of range edges, with a hill of edge strength at the pixel of each, as the camera stands."""
    rng = np.random.default_rng(5)
    camera = build("double_sphere", width=WIDTH, height=HEIGHT, fx=30.0, fy=31.0, cx=47.2, cy=30.9, xi=-0.2, alpha=0.6)
    maps = rng.normal(scale=4.0, size=(5, HEIGHT, WIDTH))
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    p_camera = rng.uniform((-9.0, -6.0, 8.0), (9.0, 6.0, 12.0), (5, EDGES, 3))
    for of_frame, points in zip(maps, p_camera, strict=True):
        for right, down, ahead in points[::10]:
            u, v = 47.2 + 24.0 * right / ahead, 30.9 + 24.0 * down / ahead
            of_frame += 60.0 * np.exp(-0.02 * ((columns - u) ** 2 + (rows - v) ** 2))
    xyz_m = (p_camera.reshape(-1, 3) - TRUTH[:3, 3]) @ TRUTH[:3, :3]
    return EdgeFrames(
        camera=camera,
        xyz_m=np.ascontiguousarray(xyz_m.T, np.float32),
        weight=rng.uniform(0.5, 1.8, 5 * EDGES).astype(np.float32),
        first_point=EDGES * np.arange(6),
        maps=np.clip(maps, -127, 127).astype(np.int8),
    )


def score(frames: EdgeFrames, pose: NDArray[np.float64], ascent: AscentStart) -> float:
    at = frame_alignment(frames, pose)
    of_frames = at.strength / np.sqrt(at.square)
    return float(np.cumsum(of_frames[ascent.first : ascent.last])[-1])


def plain(frames: EdgeFrames, ascent: AscentStart) -> tuple[NDArray[np.float64], float]:
    pose, best, fineness = ascent.pose, score(frames, ascent.pose, ascent), 0
    for _ in range(MAX_SWEEPS):
        improved = False
        for move in MOVES[fineness]:
            # As `se3.perturb` adds it up: entry by entry.
            trial = np.array([[sum(move[i, k] * pose[k, j] for k in range(4)) for j in range(4)] for i in range(4)])
            if (reached := score(frames, trial, ascent)) > best:
                pose, best, improved = trial, reached, True
        fineness += not improved
        if fineness == len(MOVES):
            break
    return pose, best


def test_ascents_at_once_end_where_each_ends_by_itself(frames: EdgeFrames) -> None:
    started = [
        AscentStart(se3.perturb(TRUTH, 0.01 * np.array([1.0, -1.0, 0.5, 0.0, 0.0, 0.0])), 0, 5),
        AscentStart(TRUTH, 3, 5),
        AscentStart(se3.perturb(TRUTH, np.array([0.0, 0.015, 0.0, 0.0, 0.0, 0.0])), 0, 1),
    ]
    retained = [ascent.pose.copy() for ascent in started]
    for end, ascent, before in zip(ascend(frames, started, MOVES), started, retained, strict=True):
        pose, best = plain(frames, ascent)
        np.testing.assert_allclose(end.pose, pose, rtol=0.0, atol=1e-15)
        assert end.score == pytest.approx(best, rel=1e-12)
        assert end.score > score(frames, before, ascent)
        np.testing.assert_array_equal(ascent.pose, before)


def test_a_ascent_of_no_frames_ends_where_it_began(frames: EdgeFrames) -> None:
    (end,) = ascend(frames, [AscentStart(TRUTH, 2, 2)], MOVES)
    np.testing.assert_array_equal(end.pose, TRUTH)
    assert end.score == 0.0
