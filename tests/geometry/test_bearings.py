"""Bearings of points, held against NumPy's angles."""

import numpy as np

from coec.geometry.sweep_kernels import bearings, grid_counts


def test_are_those_of_numpy_in_every_direction() -> None:
    rng = np.random.default_rng(4)
    # Straight up and down there is no azimuth.
    axes = np.concatenate([np.eye(3)[:2], -np.eye(3)[:2], [[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]])
    xyz_m = np.concatenate([rng.normal(size=(9000, 3)) * rng.uniform(0.1, 90.0, (9000, 1)), axes]).astype(np.float32)
    x, y, z = xyz_m.astype(np.float64).T
    seen = bearings(xyz_m)
    separation = np.angle(np.exp(1j * (seen.azimuth - np.arctan2(y, x))))
    assert np.abs(separation).max() < 1e-6
    assert np.abs(seen.elevation - np.arctan2(z, np.hypot(x, y))).max() < 1e-6
    np.testing.assert_allclose(seen.range_m, np.sqrt(x * x + y * y + z * z), rtol=1e-6)


def test_the_origin_and_no_points_are_no_fault() -> None:
    seen = bearings(np.zeros((1, 3), np.float32))
    assert (seen.azimuth[0], seen.elevation[0], seen.range_m[0]) == (0.0, 0.0, 0.0)
    assert len(bearings(np.empty((0, 3), np.float32)).azimuth) == 0


def test_counts_are_those_of_a_histogram() -> None:
    rng = np.random.default_rng(5)
    elevation, azimuth = (rng.uniform(-a, a, 5000).astype(np.float32) for a in (0.6, np.pi))
    bands, sectors = grid_counts(elevation, azimuth, -0.45, -0.05, 40, 36)
    inside = (elevation >= -0.45) & (elevation <= -0.05)
    assert bands.sum() == sectors.sum() == inside.sum()
    # A number on the border of two cells may be rounded into either.
    assert np.abs(bands - np.histogram(elevation, 40, (-0.45, -0.05))[0]).max() <= 1
    assert np.abs(sectors - np.histogram(azimuth[inside], 36, (-np.pi, np.pi))[0]).max() <= 1
