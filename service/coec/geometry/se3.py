"""Rotations and rigid transforms as NumPy arrays.

A transform T is (4, 4) and named after its frames: T_camera_lidar maps LiDAR to camera. A vector xi is
[rx ry rz tx ty tz] in radians and metres, and it has two meanings:

- `perturbation` and `perturb`: a separate rotation Exp(r) and translation t, T(xi) = [Exp(r) | t] · T. A correction in
  degrees and metres about the camera axes then reads as a user expects it.
- `exp` and `log`: a twist, the motion at a constant velocity for one unit of time. Used for motion compensation.

J. Solà, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, appendices B and D.
"""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Below this angle the coefficients of the exponential and logarithm come from their series, whose first dropped term is
# then below 1e-15 of the first. Above it, cancellation costs less than 1e-15 in the result. Unit: rad.
_SMALL_ANGLE_RAD = 0.1


def _skew(r: Array) -> Array:
    """The matrix of the cross product with r."""
    return np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])


def _vector(name: str, value: Array, size: int) -> Array:
    vector = np.asarray(value, dtype=np.float64)
    if vector.shape != (size,):
        raise ValueError(f"{name} must have the shape ({size},), got {vector.shape}")
    return vector


def _coefficients(angle: float) -> tuple[float, float, float]:
    """sin(a)/a, (1 - cos(a))/a^2 and (a - sin(a))/a^3."""
    if angle < _SMALL_ANGLE_RAD:
        s = angle * angle
        return (
            1.0 - s / 6.0 * (1.0 - s / 20.0 * (1.0 - s / 42.0 * (1.0 - s / 72.0))),
            0.5 * (1.0 - s / 12.0 * (1.0 - s / 30.0 * (1.0 - s / 56.0 * (1.0 - s / 90.0)))),
            (1.0 - s / 20.0 * (1.0 - s / 42.0 * (1.0 - s / 72.0 * (1.0 - s / 110.0)))) / 6.0,
        )
    half_sine = math.sin(0.5 * angle)
    return (
        math.sin(angle) / angle,
        2.0 * half_sine * half_sine / angle**2,
        (angle - math.sin(angle)) / angle**3,
    )


def rotation_exp(r: Array) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,), radians (Rodrigues). Raises ValueError for any other shape."""
    r = _vector("r", r, 3)
    a, b, _ = _coefficients(float(np.linalg.norm(r)))
    k = _skew(r)
    rotation: Array = np.eye(3) + a * k + b * (k @ k)
    return rotation


def rotation_log(rotation: Array) -> Array:
    """Rotation vector (3,), radians, length in [0, pi], of a rotation matrix (3, 3). Exact near 0 and near pi.

    Uses the quaternion, because its vector part does not vanish near pi as the antisymmetric part of the matrix does.
    """
    q = quaternion_xyzw_from_rotation(rotation)
    sine = float(np.linalg.norm(q[:3]))
    # angle / sine; its limit at zero angle is 2.
    scale = 2.0 * math.atan2(sine, q[3]) / sine if sine > 0.0 else 2.0
    return scale * q[:3]


def rotation_angle_rad(transform: Array) -> float:
    """Geodesic angle in [0, pi], radians, of a rotation (3, 3) or of the rotation of a transform (4, 4)."""
    return float(np.linalg.norm(rotation_log(np.asarray(transform, dtype=np.float64)[:3, :3])))


def quaternion_xyzw_from_rotation(rotation: Array) -> Array:
    """Unit quaternion [x y z w], w >= 0, of a rotation matrix (3, 3).

    Divides by the largest of the four components, which is at least one half, so that nothing cancels at any angle
    (S. W. Shepperd, "Quaternion from rotation matrix", Journal of Guidance and Control 1(3), 1978).
    """
    r = np.asarray(rotation, dtype=np.float64)
    if r.shape != (3, 3):
        raise ValueError(f"rotation must have the shape (3, 3), got {r.shape}")
    x, y, z = r.diagonal()
    # Row i is the quaternion times four times its i-th component.
    candidates = np.array(
        [
            [1.0 + x - y - z, r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
            [r[0, 1] + r[1, 0], 1.0 - x + y - z, r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1.0 - x - y + z, r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], 1.0 + x + y + z],
        ]
    )
    q = candidates[int(np.argmax(candidates.diagonal()))]
    unit: Array = q / np.linalg.norm(q)
    return -unit if unit[3] < 0.0 else unit


def rotation_from_quaternion_xyzw(quaternion_xyzw: Array) -> Array:
    """Rotation matrix (3, 3) of a quaternion [x y z w] of any length. Raises ValueError if it or its square is zero or
    not finite."""
    q = _vector("quaternion_xyzw", quaternion_xyzw, 4)
    with np.errstate(over="ignore", invalid="ignore"):  # a NaN may be signalling
        norm = float(np.linalg.norm(q))
    if not (norm > 0.0 and math.isfinite(norm)):
        raise ValueError(f"quaternion_xyzw must be finite and not zero, got {q.tolist()}")
    x, y, z, w = q / norm
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def transform_from(rotation: Array, translation_m: Array) -> Array:
    """(4, 4) from a rotation (3, 3) and a translation (3,), metres."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation_m
    return transform


def inverse(transform: Array) -> Array:
    """Inverse (4, 4) of a rigid transform: T_b_a of T_a_b."""
    rotation = transform[:3, :3]
    return transform_from(rotation.T, -rotation.T @ transform[:3, 3])


def exp(xi: Array) -> Array:
    """Transform (4, 4) reached by the twist xi (6,), radians and metres, in one unit of time."""
    xi = _vector("xi", xi, 6)
    a, b, c = _coefficients(float(np.linalg.norm(xi[:3])))
    k = _skew(xi[:3])
    k2 = k @ k
    return transform_from(np.eye(3) + a * k + b * k2, (np.eye(3) + b * k + c * k2) @ xi[3:])


def log(transform: Array) -> Array:
    """The twist (6,), radians and metres, rotation at most pi, that `exp` turns into this transform (4, 4)."""
    r = rotation_log(transform[:3, :3])
    angle = float(np.linalg.norm(r))
    # (1 - (a/2) cot(a/2)) / a^2
    if angle < _SMALL_ANGLE_RAD:
        s = angle * angle
        d = (1.0 + s / 60.0 * (1.0 + s / 42.0 * (1.0 + s / 40.0))) / 12.0
    else:
        d = (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / angle**2
    k = _skew(r)
    return np.concatenate([r, (np.eye(3) - 0.5 * k + d * (k @ k)) @ transform[:3, 3]])


def perturbation(xi: Array) -> Array:
    """[Exp(r) | t] (4, 4) of xi = [r t] (6,): a rotation vector in radians and a separate translation in metres."""
    xi = _vector("xi", xi, 6)
    return transform_from(rotation_exp(xi[:3]), xi[3:])


def perturbation_log(transform: Array) -> Array:
    """The xi (6,), radians and metres, that `perturbation` turns into this transform (4, 4)."""
    return np.concatenate([rotation_log(transform[:3, :3]), transform[:3, 3]])


def perturb(transform: Array, xi: Array) -> Array:
    """T(xi) = perturbation(xi) · T: for T_camera_lidar, a turn about and a shift along the camera's axes."""
    a, b, c, *shift = _vector("xi", xi, 6).tolist()
    by_axis, by_square, _ = _coefficients(math.sqrt(a * a + b * b + c * c))
    # Rodrigues' formula, entry by entry: a search calls this thousands of times, and small arrays are mostly overhead.
    square = a * a + b * b + c * c
    rows = (
        (1.0 + by_square * (a * a - square), by_square * a * b - by_axis * c, by_square * a * c + by_axis * b),
        (by_square * a * b + by_axis * c, 1.0 + by_square * (b * b - square), by_square * b * c - by_axis * a),
        (by_square * a * c - by_axis * b, by_square * b * c + by_axis * a, 1.0 + by_square * (c * c - square)),
    )
    x, y, z, last = transform.tolist()
    moved = [
        [p * x[j] + q * y[j] + r * z[j] + t * last[j] for j in range(4)]
        for (p, q, r), t in zip(rows, shift, strict=True)
    ]
    return np.array([*moved, last])


def difference(transform_a: Array, transform_b: Array) -> Array:
    """The xi (6,) that leads from b to a: perturb(transform_b, xi) = transform_a."""
    return perturbation_log(transform_a @ inverse(transform_b))


def adjoint(T_b_a: Array) -> Array:
    """(6, 6) matrix that converts a small perturbation about the axes of frame a into one about those of frame b, with
    T_b_a (4, 4). A rotation also shifts the origin of b, by its lever."""
    rotation, lever = T_b_a[:3, :3], T_b_a[:3, 3]
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = jacobian[3:, 3:] = rotation
    jacobian[3:, :3] = np.cross(lever, rotation.T).T
    return jacobian


def is_rigid(transform: Array, tolerance: float = 1e-6) -> bool:
    """Whether `transform` is (4, 4), finite, with the last row 0 0 0 1 and a proper rotation.

    `tolerance` bounds every entry of R^T R - 1; the default lets calibration files with seven digits pass.
    """
    t = np.asarray(transform, dtype=np.float64)
    if t.shape != (4, 4) or not np.isfinite(t).all() or not np.array_equal(t[3], [0.0, 0.0, 0.0, 1.0]):
        return False
    rotation = t[:3, :3]
    if np.abs(rotation).max() > 1.0 + tolerance:  # no rotation, and its square may overflow
        return False
    orthonormal = bool(np.abs(rotation.T @ rotation - np.eye(3)).max() <= tolerance)
    return orthonormal and float(np.linalg.det(rotation)) > 0.0


METRES_PER_RADIAN = 7.0
"""A shift of this many metres moves things that far away by as much as a turn of one radian. It is the range, in
metres, of the edges that tell translation: a car or a post on the near side of a street. Difference steps, search steps
and the conversion of a pixel of rotation into translation all use it. See docs/measured.md."""


def axis_steps(rotation_rad: float, metres_per_radian: float = METRES_PER_RADIAN) -> Array:
    """(6,) steps about and along the axes rx ry rz tx ty tz, rad and m: the rotation, and the shift worth as much."""
    return np.array([rotation_rad] * 3 + [rotation_rad * metres_per_radian] * 3)
