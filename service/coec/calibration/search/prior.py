"""What is known of a pose before its window is used: a calibrated mount seldom moves, and seldom far; and how long a
step of translation is for a step of rotation, for every search that takes steps in both. The prior is a density of
the angle θ between the pose and the start, per volume of rotations. It falls like Cauchy's in three dimensions
(Student's with one degree of freedom, the longest tails of the family): p(θ) ∝ (1 + θ² / s²)⁻² Its scale s is the
error that creep, temperature and a workshop leave. A displacement has no typical size, so the tails are long: 3°
are 7 nats less likely than 0°, 25° are 16. The evidence of a street outweighs that several times over; that of a
tunnel, where some pose among a hundred thousand always fits by chance, does not.

The prior is a density of the angle θ between the pose and the start, per volume of rotations. It falls like Cauchy's in
three dimensions (Student's with one degree of freedom, the longest tails of the family):

p(θ) ∝ (1 + θ² / s²)⁻²

Its scale s is the error that creep, temperature and a workshop leave. A knock has no typical size, so the tails are
long: 3° are 7 nats less likely than 0°, 25° are 16. The evidence of a street outweighs that several times over; that of
a tunnel, where some pose among a hundred thousand always fits by chance, does not.
"""

from __future__ import annotations

from math import log1p, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Matrix4
from coec.geometry import se3

MOUNT_RAD = radians(0.5)
"""Scale for a calibration in use: bolted brackets creep and breathe by some tenths of a degree between windows, and a
workshop leaves about as much error."""


def log_prior(T_camera_lidar: Matrix4, start: Matrix4, known_to_rad: float) -> float:
    """Log prior of a pose (4, 4) relative to that of the start (4, 4), which is known to `known_to_rad`: nats, 0 at the
    start and negative elsewhere."""
    turned = se3.rotation_angle_rad(T_camera_lidar @ se3.inverse(start)) / known_to_rad
    return -2.0 * log1p(turned * turned)


METRES_PER_RADIAN = 7.0
"""A shift of this many metres moves things that far away by as much as a turn of one radian. It is the range, in
metres, of the edges that tell translation: a car or a post on the near side of a street. Difference steps, search steps
and the conversion of a pixel of rotation into translation all use it. See docs/measured.md."""

POLISH_METRES_PER_RADIAN = 10.0
"""Metres per radian of the first trust region of a polish. It is wider along the translations because their hill is
wider. See docs/measured.md."""


def of_both(rotation_rad: float, metres_per_radian: float = METRES_PER_RADIAN) -> NDArray[np.float64]:
    """(6,) steps about and along the axes rx ry rz tx ty tz, rad and m: the rotation, and the shift worth as much."""
    return np.array([rotation_rad] * 3 + [rotation_rad * metres_per_radian] * 3)
