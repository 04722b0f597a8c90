"""A highway: wide asphalt, guard rails, meadows, and hardly anything else."""

from __future__ import annotations

import numpy as np

from coec.simulation import props
from coec.simulation.mesh import Material, box, join, quads
from coec.simulation.site import Site

MEDIAN_M, LANE_M, SHOULDER_M = 1.5, 3.75, 2.5
"""Half the median, the width of a lane (two each way) and of the hard shoulder: German motorways (RAA 2008)."""
OUTER_M = MEDIAN_M + 2 * LANE_M + SHOULDER_M
OWN_LEFT_M = -(MEDIAN_M + 1.5 * LANE_M)
"""Middle of the right lane."""
RAIL_LOW_M, RAIL_HIGH_M, POSTS_M = 0.45, 0.78, 4.0
GROUND_HALF_M = 60.0
HIGHWAY_STEP_M = 3.0
DELINEATORS_M = 50.0


def highway(rng: np.random.Generator, site: Site, length_m: float) -> None:
    """Adds a stretch of highway."""
    s = np.arange(0.0, length_m + 1e-6, HIGHWAY_STEP_M)
    grey, white = np.array([0.19, 0.19, 0.19]) * rng.uniform(0.9, 1.1), (0.72, 0.74, 0.74)
    site.meshes.append(quads(site.strip(s, (-OUTER_M, OUTER_M), (0.0, 0.0)), grey, Material.ASPHALT))
    for side in (-1.0, 1.0):
        meadow = site.strip(s, (side * OUTER_M, side * GROUND_HALF_M), (-0.05, -0.05))
        site.meshes.append(quads(meadow, np.array([0.09, 0.23, 0.16]) * rng.uniform(0.8, 1.2), Material.GRASS))
        for left in (MEDIAN_M + 0.2, OUTER_M - SHOULDER_M):
            line = site.strip(s, (side * left, side * (left + 0.15)), (0.008, 0.008))
            site.meshes.append(quads(line, white, Material.MARKING))
        for at in np.arange(0.0, length_m, 18.0):
            middle = side * (MEDIAN_M + LANE_M)
            dash = site.strip(np.array([at, at + 3.0, at + 6.0]), (middle - 0.07, middle + 0.07), (0.008, 0.008))
            site.meshes.append(quads(dash, white, Material.MARKING))
        _rail(site, s, side * (OUTER_M + 0.6), length_m)
        if rng.random() < length_m / DELINEATORS_M:
            post = box([-0.05, -0.05, -0.1], [0.05, 0.05, 1.05], (0.8, 0.8, 0.8), Material.SIGN)
            site.put(post, rng.uniform(0, length_m), side * (OUTER_M + 0.3))
        for _ in range(int(rng.poisson(0.5))):
            mesh = props.tree(rng) if rng.random() < 0.4 else props.bush(rng)
            site.put(mesh, rng.uniform(1, length_m - 1), side * rng.uniform(OUTER_M + 6, 50.0))
        if rng.random() < 0.12:
            site.put(props.sign(rng), rng.uniform(1, length_m - 1), side * (OUTER_M + 1.8), 0.0 if side < 0 else np.pi)
    _rail(site, s, 0.0, length_m)


def _rail(site: Site, s: np.ndarray[tuple[int], np.dtype[np.float64]], left_m: float, length_m: float) -> None:
    steel = (0.45, 0.46, 0.46)
    site.meshes.append(quads(site.strip(s, (left_m, left_m), (RAIL_LOW_M, RAIL_HIGH_M)), steel, Material.PAINT))
    post = join([box([-0.05, -0.06, -0.2], [0.05, 0.06, RAIL_HIGH_M - 0.03], steel, Material.PAINT)])
    for at in np.arange(POSTS_M / 2, length_m, POSTS_M):
        site.put(post, float(at), left_m)
