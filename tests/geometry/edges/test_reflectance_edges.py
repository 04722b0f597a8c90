"""Reflectance edges of sweeps of a painted wall, by LiDARs of several kinds."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.geometry.edges.reflectance_edges import (
    LEAST_STEPS,
    PLATEAU_SHARE,
    SMOOTH_M,
    SMOOTH_SHARE,
    ReflectanceSteps,
    learn_noise,
    reflectance_edges,
    reflectance_steps,
)
from coec.geometry.edges.scan_lines import NEIGHBOUR_RAD, SweepEdges, scan_lines

Values = NDArray[np.float32]

SPACING_DEG = 0.2
RINGS = 16
WALL_M = 12.0
EDGES_DEG = (-14.53, -6.21, 3.07, 17.72)
"""Where the paint on the wall begins and ends, azimuth."""


def wall(spacing_deg: float = SPACING_DEG) -> tuple[Values, NDArray[np.uint16], NDArray[np.float64]]:
    """(N, 3) points of a round wall about the sensor, their rings, and their azimuths in degrees."""
    ring, column = np.meshgrid(np.arange(RINGS), np.arange(-30.0, 30.0, spacing_deg), indexing="ij")
    azimuth, elevation = np.radians(column.ravel()), np.radians(ring.ravel() - 8.0)
    directions = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    return (
        (WALL_M * np.column_stack(directions)).astype(np.float32),
        ring.ravel().astype(np.uint16),
        column.ravel().astype(np.float64),
    )


def painted(azimuth_deg: NDArray[np.float64], dark: float, bright: float, beam_deg: float = SPACING_DEG) -> Values:
    """Mean reflectance under a beam of some width: the paint is dark."""
    share = np.zeros(len(azimuth_deg))
    for begin, end in (EDGES_DEG[:2], EDGES_DEG[2:]):
        low, high = azimuth_deg - 0.5 * beam_deg, azimuth_deg + 0.5 * beam_deg
        share += np.clip(np.minimum(high, end) - np.maximum(low, begin), 0.0, beam_deg) / beam_deg
    return (bright + (dark - bright) * share).astype(np.float32)


def calibrated(values: Values, rng: np.random.Generator) -> Values:
    """Whole values of 8 bits."""
    return np.clip(np.rint(values + rng.normal(0.0, 1.0, len(values))), 0.0, 255.0).astype(np.float32)


def raw(values: Values, rng: np.random.Generator) -> Values:
    """Raw values of 16 bits, whose scatter grows with their level."""
    scaled = 20.0 * values
    return np.rint(scaled * (1.0 + rng.normal(0.0, 0.06, len(values)))).astype(np.float32)


def coarse(values: Values, rng: np.random.Generator) -> Values:
    """Values from 0 to 1 in few steps."""
    return (np.rint(20.0 * (values + rng.normal(0.0, 2.0, len(values))) / 255.0) / 20.0).astype(np.float32)


SENSORS = (calibrated, raw, coarse)


def edges_of(xyz_m: Values, ring: NDArray[np.uint16] | None, values: Values) -> SweepEdges:
    steps = reflectance_steps(scan_lines(xyz_m, ring), values)
    noise = learn_noise([steps])
    assert noise is not None
    return reflectance_edges(steps, noise)


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("with_ring", [True, False])
def test_paint_on_a_wall_has_its_edges_in_every_scan_line(sensor, with_ring: bool) -> None:  # type: ignore[no-untyped-def]
    xyz_m, ring, azimuth_deg = wall()
    values = sensor(painted(azimuth_deg, 40.0, 160.0), np.random.default_rng(3))
    edges = edges_of(xyz_m, ring if with_ring else None, values)
    at_m = xyz_m[edges.index] + edges.shift_m
    at_deg = np.degrees(np.arctan2(at_m[:, 1], at_m[:, 0]))
    for edge_deg in EDGES_DEG:
        near = np.abs(at_deg - edge_deg) < SPACING_DEG
        per_line = np.bincount(ring[edges.index[near]], minlength=RINGS)
        assert per_line.max() == 1
        assert per_line.sum() >= RINGS - 1
        # What the beam on the edge measures shows where it passes through the beam.
        assert abs(at_deg[near].mean() - edge_deg) < 0.1 * SPACING_DEG
        assert at_deg[near].std() < 0.3 * SPACING_DEG
    far = np.min(np.abs(at_deg[:, None] - np.array(EDGES_DEG)), axis=1) >= SPACING_DEG
    assert np.count_nonzero(far) <= 0.002 * len(xyz_m)


@pytest.mark.parametrize("sensor", SENSORS)
def test_noise_alone_has_hardly_an_edge(sensor) -> None:  # type: ignore[no-untyped-def]
    xyz_m, ring, azimuth_deg = wall()
    levels = np.linspace(20.0, 200.0, len(azimuth_deg), dtype=np.float32)
    edges = edges_of(xyz_m, ring, sensor(levels, np.random.default_rng(4)))
    assert len(edges.index) <= 0.002 * len(xyz_m)


def test_the_unit_of_reflectance_does_not_matter() -> None:
    xyz_m, ring, azimuth_deg = wall()
    values = raw(painted(azimuth_deg, 40.0, 160.0), np.random.default_rng(5))
    plain, scaled = edges_of(xyz_m, ring, values), edges_of(xyz_m, ring, np.float32(0.25) * values)
    np.testing.assert_array_equal(plain.index, scaled.index)
    np.testing.assert_array_equal(plain.shift_m, scaled.shift_m)


def test_a_jump_of_range_is_no_edge_of_reflectance() -> None:
    xyz_m, ring, azimuth_deg = wall()
    values = painted(azimuth_deg, 40.0, 160.0)
    for begin, end in (EDGES_DEG[:2], EDGES_DEG[2:]):
        xyz_m[(azimuth_deg > begin) & (azimuth_deg < end)] *= np.float32(0.8)
    assert len(edges_of(xyz_m, ring, calibrated(values, np.random.default_rng(6))).index) <= 0.002 * len(xyz_m)


def test_one_value_everywhere_teaches_no_noise_and_values_that_are_not_finite_make_no_edge() -> None:
    xyz_m, ring, azimuth_deg = wall()
    lines = scan_lines(xyz_m, ring)
    assert learn_noise([]) is None
    assert learn_noise([reflectance_steps(lines, np.full(len(xyz_m), 7.0, np.float32))]) is None
    few = scan_lines(xyz_m[:LEAST_STEPS], ring[:LEAST_STEPS])
    assert learn_noise([reflectance_steps(few, np.arange(LEAST_STEPS, dtype=np.float32))]) is None
    values = calibrated(painted(azimuth_deg, 40.0, 160.0), np.random.default_rng(7))
    values[azimuth_deg < 0.0] = np.nan
    values[(azimuth_deg > 10.0) & (azimuth_deg < 11.0)] = np.inf
    edges = edges_of(xyz_m, ring, values)
    assert (azimuth_deg[edges.index] > 0.0).all()
    assert np.count_nonzero(np.abs(azimuth_deg[edges.index] - EDGES_DEG[2]) < SPACING_DEG) == RINGS


def test_steps_are_those_of_a_slow_reading_of_the_definition() -> None:
    rng = np.random.default_rng(8)
    xyz_m, ring, _ = wall(0.4)
    retained = np.flatnonzero(rng.random(len(xyz_m)) < 0.8)
    xyz_m, ring = xyz_m[retained] * rng.uniform(0.99, 1.01, (len(retained), 1)).astype(np.float32), ring[retained]
    lines = scan_lines(xyz_m, ring)
    values = (
        rng.integers(0, 9, len(retained)) // 8
        + 4 * rng.integers(0, 5, len(retained) // 4 + 1).repeat(4)[: len(retained)]
    ).astype(np.float32)
    height, highest = _slow(lines.azimuth, lines.range_m, lines.first, values[lines.order])
    steps: ReflectanceSteps = reflectance_steps(lines, values)
    np.testing.assert_array_equal(steps.height, height)
    np.testing.assert_array_equal(steps.highest, highest)
    assert 20 < np.count_nonzero(highest) < np.count_nonzero(np.isfinite(height))


def _slow(
    azimuth: Values, range_m: Values, first: NDArray[np.int64], value: Values
) -> tuple[Values, NDArray[np.bool_]]:
    height, plateau = np.full(len(value), np.nan, np.float32), np.zeros(len(value), np.bool_)
    for begin, end in pairwise(first.tolist()):
        for k in range(begin + 2, end - 2):
            five = slice(k - 2, k + 3)
            near, far = range_m[five].min(), range_m[five].max()
            if np.diff(azimuth[five]).max() > NEIGHBOUR_RAD or far - near > SMOOTH_M + SMOOTH_SHARE * near:
                continue
            a, b, _, c, d = value[five]
            height[k] = (c + d - a - b) / 2
            plateau[k] = height[k] != 0 and max(abs(b - a), abs(d - c)) <= PLATEAU_SHARE * abs(height[k])
    highest = plateau.copy()
    size = np.nan_to_num(np.abs(height))
    for k in np.flatnonzero(plateau).tolist():
        highest[k] = (size[k - 2 : k] < size[k]).all() and (size[k + 1 : k + 3] <= size[k]).all()
    return height, highest


def test_leaves_have_no_edges_but_the_border_of_their_bush_has() -> None:
    xyz_m, ring, azimuth_deg = wall()
    rng = np.random.default_rng(5)
    leaf = np.floor(azimuth_deg / (4 * SPACING_DEG)).astype(np.int64) + 100 * ring.astype(np.int64)
    leaves = rng.uniform(70.0, 120.0, leaf.max() - leaf.min() + 1)[leaf - leaf.min()]
    # Most of the scene is smooth and of the same levels, so that the noise of the sensor does not hide the leaves.
    bush = azimuth_deg < -20.0
    edges = edges_of(xyz_m, ring, calibrated(np.where(bush, leaves, 90.0 + azimuth_deg), rng))
    at_deg = azimuth_deg[edges.index]
    # In each scan line eleven leaves end within the bush; five of them would be edges by the sensor's noise alone.
    assert np.count_nonzero(at_deg < -21.0) < 2.5 * RINGS
    assert np.count_nonzero(np.abs(at_deg + 20.0) < 2.0 * SPACING_DEG) > 0.5 * RINGS
