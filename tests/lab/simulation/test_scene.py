"""The town: the same from wherever one comes, bounded, with traffic that moves."""

import numpy as np
import pytest

pytest.importorskip("embreex", reason="needs embreex")

from coec_lab.simulation.road import build_road
from coec_lab.simulation.scene import AHEAD, BEHIND, MISSED, Town
from coec_lab.simulation.street import GROUND_HALF_M, STRETCH_M


def test_a_place_does_not_depend_on_the_way_there() -> None:
    there = Town(5, 400.0)
    there.scene(310.0)
    again, straight = there.scene(100.0), Town(5, 400.0).scene(100.0)
    np.testing.assert_array_equal(again.origin_m, straight.origin_m)
    np.testing.assert_array_equal(again.colour, straight.colour)
    np.testing.assert_array_equal(again.street.corners_m, straight.street.corners_m)
    assert not np.array_equal(straight.street.corners_m[:100], Town(6, 400.0).scene(100.0).street.corners_m[:100])


def test_only_what_is_near_is_retained() -> None:
    town = Town(2, 2000.0)
    for at_m in (0.0, 20 * STRETCH_M):
        scene = town.scene(at_m)
        assert town.stretch_count == BEHIND + AHEAD + 1
        assert len(scene.colour) < 600_000


def test_a_moving_car_is_met_where_it_is_at_the_time_of_the_ray() -> None:
    town = Town(3, 300.0)
    scene = town.scene(100.0)
    mover = scene.movers[0]
    for time_s in (0.0, 0.7):
        x, y, z, _ = mover.poses(town.road, np.array([time_s]))[0]
        above = np.array([x, y, z + 30.0])
        down = np.array([[0.0, 0.0, -1.0]], np.float32)
        here = scene.cast(above, down, time_s)
        assert here.triangle[0] >= len(scene.street.colour)
        assert 26.0 < here.range_m[0] < 29.5  # its roof
        other = scene.cast(above, down, time_s + 2.0)
        assert other.triangle[0] == MISSED or other.range_m[0] > 29.5 or mover.model < 0


def test_the_road_never_bends_tighter_than_its_ground_is_wide() -> None:
    for seed in range(20):
        road = build_road(seed, -100.0, 3000.0)
        heading = road.table[:, 3]
        assert np.abs(heading).max() < np.pi / 2
        assert np.abs(np.gradient(heading, 0.1)).max() < 1 / GROUND_HALF_M
        np.testing.assert_allclose(road.points(0.0, 0.0, 0.0), 0.0, atol=1e-6)
