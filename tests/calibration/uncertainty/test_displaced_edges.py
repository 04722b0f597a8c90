"""How pose, clocks and lens displace the range edges of a window."""

from dataclasses import replace

import numpy as np
import pytest

from coec.calibration.uncertainty.displaced_edges import (
    CLOCKS,
    LENS,
    SHIFTS,
    SIZE,
    TURNS,
    AssumedEdges,
    assumed_levels,
)
from coec.geometry.edges.displaced_alignment import OUT_OF_VIEW_PX
from support.scenes import (
    CORNER_CAMERA,
    IDENTITY_POSE,
    corner_edge_levels,
    corner_motions,
    corner_pixels,
    corner_points,
    corner_window,
)

PLACES = (*TURNS, *SHIFTS, *CLOCKS, *LENS)
STEPS = np.array([1e-3] * 3 + [1e-2] * 3 + [1e-2] * 3 + [1e-2] * 4)


@pytest.fixture
def level(rng: np.random.Generator) -> AssumedEdges:
    points = corner_points(rng)
    levels = corner_edge_levels(corner_pixels(points), points)
    return assumed_levels(levels, corner_window(corner_motions()), IDENTITY_POSE)[-1]


def test_edges_out_of_reach_displace_none_in_view(rng: np.random.Generator) -> None:
    """A LiDAR that turns has most of its edges behind the camera."""
    points = corner_points(rng)
    pixels, window = corner_pixels(points), corner_window(corner_motions())
    behind = np.array([[0.0, 0.0, -9.0]]) + rng.normal(0.0, 0.5, (20 * max(map(len, points)), 3))
    around = [np.concatenate([at, behind.astype(at.dtype)]) for at in points]
    alone, among = (
        assumed_levels(corner_edge_levels(pixels, clouds), window, IDENTITY_POSE) for clouds in (points, around)
    )
    assert [len(one.frames.weight) for one in among] == [len(one.frames.weight) for one in alone]


@pytest.mark.parametrize("place", PLACES)
def test_the_jacobian_is_that_of_differences(level: AssumedEdges, place: int) -> None:
    deviation = 0.3 * STEPS
    step = np.zeros(SIZE)
    step[place] = STEPS[place]
    (ahead, behind), jacobian = (
        [level.at(deviation + sign * step, ()).uv_px.T for sign in (1.0, -1.0)],
        level.at(deviation, (place,)).jacobian[0].T,
    )
    seen = (ahead[:, 0] > OUT_OF_VIEW_PX / 2.0) & (behind[:, 0] > OUT_OF_VIEW_PX / 2.0) & jacobian.any(axis=1)
    assert seen.sum() > 1000
    differences = (ahead - behind)[seen] / (2.0 * STEPS[place])
    np.testing.assert_allclose(jacobian[seen], differences, rtol=0.02, atol=0.02 * np.abs(differences).max())


def test_edges_that_were_seen_later_are_where_they_have_come_to(level: AssumedEdges) -> None:
    late_s = np.array([0.03, -0.02, 0.05])
    deviation = np.zeros(SIZE)
    deviation[list(CLOCKS)] = late_s
    come = level.frames.xyz_m + level.passing * np.sum(late_s[:, None] * level.share, axis=0)
    there = replace(level, frames=replace(level.frames, xyz_m=come)).at(np.zeros(SIZE), ())
    np.testing.assert_allclose(level.at(deviation, ()).uv_px, there.uv_px, atol=1e-3)
    assert np.abs(there.uv_px - level.at(np.zeros(SIZE), ()).uv_px).max() > 1.0


def test_another_lens_is_the_camera_with_its_parameters(level: AssumedEdges) -> None:
    camera, deviation = CORNER_CAMERA, np.zeros(SIZE)
    deviation[list(LENS)] = 0.02, -0.01, 0.05, 0.0
    other = camera._replace(
        fx=1.05 * camera.fx, fy=1.05 * camera.fy, cx=camera.cx + 0.02 * camera.fx, cy=camera.cy - 0.01 * camera.fy
    )
    through = replace(level, frames=replace(level.frames, camera=other)).at(np.zeros(SIZE), ())
    np.testing.assert_allclose(level.at(deviation, ()).uv_px, through.uv_px, atol=1e-3)
