"""What is known of a pose before a window is looked at: a mount that has a calibration seldom moves, and seldom far.

Of the angle θ by which the pose differs from the start, a density per volume of rotations that falls like Cauchy's in
three dimensions (Student's with one degree of freedom, the longest tails of the family):

    p(θ) ∝ (1 + θ² / s²)⁻²

Its scale s is what creep, temperature and a workshop leave. A knock has no scale, so the tails are long: 3° are 7 nats
less likely than 0°, 25° are 16. A street outweighs that several times over; a tunnel, where some pose among a hundred
thousand always fits by chance, does not.
"""

from __future__ import annotations

from math import log1p, radians

from coec.calibration.types import Matrix4
from coec.geometry import se3

MOUNT_RAD = radians(0.5)
"""Scale of a calibration that is in use: bolted brackets creep and breathe by some tenths of a degree between windows,
and a workshop leaves about as much."""


def log_prior(T_camera_lidar: Matrix4, start: Matrix4, known_to_rad: float) -> float:
    """How likely a pose (4, 4) is before anything was seen, against the start's (4, 4), which is known to
    `known_to_rad`: nats, 0 at the start and below it elsewhere."""
    turned = se3.rotation_angle_rad(T_camera_lidar @ se3.inverse(start)) / known_to_rad
    return -2.0 * log1p(turned * turned)
