"""Range edges on scenes whose edges are known: a pole before a wall, seen by sensors of different make."""

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.geometry.edges.range_edges import MAX_WEIGHT_M, SPILL_RAD, range_edges
from coec.geometry.edges.scan_lines import scan_lines

POLE_M, POLE_RADIUS_M, WALL_M = 6.0, 0.25, 15.0

Cloud = tuple[NDArray[np.float32], NDArray[np.uint16]]


def rays(beams: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.uint16]]:
    """Azimuth, elevation and ring of an organised sweep over a quarter of a turn, 0.2° apart."""
    # Off the round numbers, so that no beam lies on the border of a band of elevation.
    elevation = np.radians(np.linspace(-15.03, 15.11, beams))
    azimuth = np.radians(np.arange(-45.0, 45.0, 0.2) + 0.03)
    ring = np.repeat(np.arange(beams, dtype=np.uint16), len(azimuth))
    return np.tile(azimuth, beams), np.repeat(elevation, len(azimuth)), ring


def placed(
    azimuth: NDArray[np.float64], elevation: NDArray[np.float64], horizontal_m: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Points of the rays at these horizontal distances."""
    xyz_m = [horizontal_m * np.cos(azimuth), horizontal_m * np.sin(azimuth), horizontal_m * np.tan(elevation)]
    return np.column_stack(xyz_m).astype(np.float32)


def pole_before_wall(beams: int, pole_m: float = POLE_M, wall_m: float = WALL_M) -> Cloud:
    azimuth, elevation, ring = rays(beams)
    on_pole = np.abs(pole_m * np.sin(azimuth)) < POLE_RADIUS_M
    return placed(azimuth, elevation, np.where(on_pole, pole_m, wall_m / np.cos(azimuth))), ring


def horizontal_m(xyz_m: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(np.hypot(xyz_m[:, 0], xyz_m[:, 1]))


@pytest.mark.parametrize("beams", [16, 32, 64, 128])
@pytest.mark.parametrize("with_ring", [True, False])
def test_a_pole_before_a_wall_has_two_edges_per_beam_and_the_wall_none(beams: int, with_ring: bool) -> None:
    xyz_m, ring = pole_before_wall(beams)
    edges = range_edges(scan_lines(xyz_m, ring if with_ring else None))
    assert np.bincount(ring[edges.index], minlength=beams).tolist() == [2] * beams
    result = xyz_m[edges.index]
    assert horizontal_m(result) == pytest.approx(POLE_M, abs=1e-3)
    # The outermost columns on the pole, left and right of it.
    assert np.abs(result[:, 1]).min() > POLE_RADIUS_M - POLE_M * np.radians(0.2)
    assert np.count_nonzero(result[:, 1] > 0) == beams


@pytest.mark.parametrize("beams", [16, 64, 128])
def test_a_cloud_with_and_without_ring_agree(beams: int) -> None:
    xyz_m, ring = pole_before_wall(beams)
    known, unknown = range_edges(scan_lines(xyz_m, ring)), range_edges(scan_lines(xyz_m, None))
    assert sorted(known.index) == sorted(unknown.index)


@pytest.mark.parametrize("with_ring", [True, False])
def test_the_order_of_the_points_does_not_matter(with_ring: bool) -> None:
    xyz_m, ring = pole_before_wall(64)
    shuffle = np.random.default_rng(1).permutation(len(xyz_m))
    plain = range_edges(scan_lines(xyz_m, ring if with_ring else None))
    shuffled = range_edges(scan_lines(xyz_m[shuffle], ring[shuffle] if with_ring else None))
    a, b = np.argsort(plain.index), np.argsort(shuffle[shuffled.index])
    np.testing.assert_array_equal(plain.index[a], shuffle[shuffled.index][b])
    np.testing.assert_array_equal(plain.shift_m[a], shuffled.shift_m[b])
    np.testing.assert_array_equal(plain.weight[a], shuffled.weight[b])


def edges_of_beams(columns_deg: float, spill_rad: float, phase: float) -> NDArray[np.float64]:
    """Azimuth (n,) of the edges of a pole 0.1 rad to either side, found by beams `columns_deg` apart of which the first
    lies `phase` of that aside, and which come back from it up to `spill_rad` beside it."""
    azimuth = np.radians(np.arange(-30.0, 30.0, columns_deg)) + phase * np.radians(columns_deg)
    near = np.abs(azimuth) < 0.1 + spill_rad
    xyz_m = placed(azimuth, np.zeros(len(azimuth)), np.where(near, POLE_M, WALL_M))
    edges = range_edges(scan_lines(xyz_m, np.zeros(len(azimuth), np.uint16)))
    at_m = xyz_m[edges.index] + edges.shift_m
    assert np.linalg.norm(at_m, axis=1) == pytest.approx(POLE_M, rel=1e-6)
    return np.asarray(np.arctan2(at_m[:, 1], at_m[:, 0]))


@pytest.mark.parametrize("columns_deg", [0.1, 0.17, 0.2])
def test_over_all_directions_that_beams_can_fall_an_edge_is_where_the_silhouette_is(columns_deg: float) -> None:
    """On average; a single one is off by half a spacing at most. The last beam on the pole lies inside by that much."""
    context = [
        np.abs(edges_of_beams(columns_deg, SPILL_RAD, phase)) - 0.1 for phase in np.linspace(0.0, 1.0, 40, False)
    ]
    assert {len(result) for result in context} == {2}
    assert np.degrees(np.mean(context)) == pytest.approx(0.0, abs=0.02 * columns_deg)
    assert np.degrees(np.max(np.abs(context))) <= 0.51 * columns_deg


def test_between_beams_that_are_distant_the_last_near_one_is_the_edge() -> None:
    """Such a sensor measures a pole as far out as half a column beside it."""
    half_rad = np.radians(0.35) / 2.0
    context = [np.abs(edges_of_beams(0.35, half_rad, phase)) - 0.1 for phase in np.linspace(0.0, 1.0, 40, False)]
    assert np.degrees(np.mean(context)) == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("with_ring", [True, False])
def test_what_is_thinner_than_two_columns_is_one_edge_where_it_was_measured(with_ring: bool) -> None:
    azimuth, elevation, ring = rays(16)
    on_pole = np.abs(azimuth - azimuth[225]) < np.radians(0.1)
    xyz_m = placed(azimuth, elevation, np.where(on_pole, POLE_M, WALL_M))
    edges = range_edges(scan_lines(xyz_m, ring if with_ring else None))
    assert sorted(edges.index) == np.flatnonzero(on_pole).tolist()
    assert (edges.shift_m == 0.0).all()


def test_the_weight_is_the_root_of_the_jump_up_to_a_cap() -> None:
    xyz_m, ring = pole_before_wall(1, pole_m=10.0, wall_m=11.5)
    edges = range_edges(scan_lines(xyz_m, ring))
    range_m = np.linalg.norm(xyz_m, axis=1)
    jumps_m = [max(range_m[i - 1], range_m[i + 1]) - range_m[i] for i in edges.index]
    assert edges.weight == pytest.approx(np.sqrt(jumps_m), rel=1e-5)
    far = range_edges(scan_lines(*pole_before_wall(1)))
    assert far.weight == pytest.approx(np.sqrt(MAX_WEIGHT_M))


@pytest.mark.parametrize(("pole_m", "wall_m"), [(14.6, 15.0), (37.0, 38.5)])
def test_a_step_below_half_a_metre_or_a_twentieth_of_the_range_is_no_edge(pole_m: float, wall_m: float) -> None:
    xyz_m, ring = pole_before_wall(16, pole_m, wall_m)
    ahead = np.abs(np.arctan2(xyz_m[:, 1], xyz_m[:, 0])) < np.radians(3.0)
    assert len(range_edges(scan_lines(xyz_m[ahead], ring[ahead])).index) == 0


def test_a_level_ground_has_no_edges() -> None:
    """Rings lie far apart on the ground: their distance is no jump, whether the rings are known or not."""
    azimuth, elevation, ring = rays(64)
    down = elevation < np.radians(-2.0)
    ground = placed(azimuth[down], elevation[down], -1.8 / np.tan(elevation[down]))
    assert len(range_edges(scan_lines(ground, ring[down])).index) == 0
    assert len(range_edges(scan_lines(ground, None)).index) == 0


def test_beyond_a_hole_is_no_neighbour() -> None:
    """Glass or sky around a pole gives no returns: there is no telling what lies behind."""
    xyz_m, ring = pole_before_wall(16)
    half_width_rad = POLE_RADIUS_M / POLE_M
    azimuth = np.abs(np.arctan2(xyz_m[:, 1], xyz_m[:, 0]))
    retained = (azimuth < half_width_rad) | (azimuth > half_width_rad + np.radians(1.5))
    assert len(range_edges(scan_lines(xyz_m[retained], ring[retained])).index) == 0


def test_the_vehicle_itself_has_no_edges() -> None:
    xyz_m, ring = pole_before_wall(16, pole_m=1.5)
    assert len(range_edges(scan_lines(xyz_m, ring)).index) == 0


@pytest.mark.parametrize("ring", [None, np.zeros(0, np.uint16)])
def test_an_empty_cloud_has_no_edges(ring: NDArray[np.uint16] | None) -> None:
    edges = range_edges(scan_lines(np.zeros((0, 3), np.float32), ring))
    assert edges.index.shape == (0,)
    assert edges.weight.shape == (0,)


@pytest.mark.parametrize("started", [0, 170])
@pytest.mark.parametrize("step", [1, -1])
def test_which_way_a_sensor_turns_and_where_it_begins_changes_nothing(started: int, step: int) -> None:
    xyz_m, ring = pole_before_wall(16)
    per_ring = len(ring) // 16
    turned = np.roll(np.arange(per_ring)[::step], started)
    order = (np.arange(16)[:, None] * per_ring + turned).ravel()
    known, other = (
        range_edges(scan_lines(xyz_m, ring)),
        range_edges(scan_lines(np.ascontiguousarray(xyz_m[order]), ring[order])),
    )
    assert sorted(order[other.index]) == sorted(known.index)
    at = np.argsort(order[other.index])
    np.testing.assert_allclose(other.shift_m[at], known.shift_m[np.argsort(known.index)], atol=1e-5)
