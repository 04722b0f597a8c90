"""Rotations and rigid transforms, with draws near 0 and near pi."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from numpy.typing import NDArray

from coec.geometry import se3
from support.strategies import rotation_vectors, twists

Array = NDArray[np.float64]

NEAR_PI = np.array([0.0, math.pi - 1e-9, 0.0])


def series_exponential(matrix: Array) -> Array:
    """Matrix exponential by its power series, with scaling and squaring."""
    scaled = matrix / 1024.0
    result = term = np.eye(len(matrix))
    for k in range(1, 12):
        term = term @ scaled / k
        result = result + term
    return np.linalg.matrix_power(result, 1024)


def twist_matrix(xi: Array) -> Array:
    rx, ry, rz, tx, ty, tz = xi
    return np.array([[0, -rz, ry, tx], [rz, 0, -rx, ty], [-ry, rx, 0, tz], [0, 0, 0, 0]], dtype=np.float64)


@given(twists())
@example(np.zeros(6))
def test_exp_is_the_matrix_exponential(xi: Array) -> None:
    transform = se3.exp(xi)
    np.testing.assert_allclose(transform, series_exponential(twist_matrix(xi)), rtol=0, atol=2e-10)
    assert se3.is_rigid(transform, tolerance=1e-14)


@given(twists())
def test_log_undoes_exp(xi: Array) -> None:
    transform = se3.exp(xi)
    logarithm = se3.log(transform)
    np.testing.assert_allclose(se3.exp(logarithm), transform, rtol=0, atol=1e-12)
    if np.linalg.norm(xi[:3]) < math.pi - 1e-6:  # at pi the axis has two signs
        np.testing.assert_allclose(logarithm, xi, rtol=0, atol=1e-12)


@given(twists())
def test_the_two_readings_of_xi_share_the_rotation_only(xi: Array) -> None:
    split = se3.perturbation(xi)
    np.testing.assert_array_equal(split[:3, 3], xi[3:])
    np.testing.assert_array_equal(split[:3, :3], se3.exp(xi)[:3, :3])
    np.testing.assert_allclose(se3.perturbation(se3.perturbation_log(split)), split, rtol=0, atol=1e-14)


@given(rotation_vectors())
@example(NEAR_PI)
@example(np.array([1e-160, 0.0, 0.0]))
def test_rotation_log_undoes_rotation_exp(r: Array) -> None:
    rotation = se3.rotation_exp(r)
    recovered = se3.rotation_log(rotation)
    if np.linalg.norm(r) > math.pi - 1e-9 and recovered @ r < 0.0:
        recovered = -recovered
    np.testing.assert_allclose(recovered, r, rtol=0, atol=2e-9 if np.linalg.norm(r) > math.pi - 1e-9 else 1e-14)
    np.testing.assert_allclose(se3.rotation_exp(recovered), rotation, rtol=0, atol=2e-9)


@given(rotation_vectors())
def test_quaternion_and_matrix_agree(r: Array) -> None:
    rotation = se3.rotation_exp(r)
    quaternion_xyzw = se3.quaternion_xyzw_from_rotation(rotation)
    assert np.linalg.norm(quaternion_xyzw) == pytest.approx(1.0, abs=1e-15)
    assert quaternion_xyzw[3] >= 0.0
    np.testing.assert_allclose(se3.rotation_from_quaternion_xyzw(3.0 * quaternion_xyzw), rotation, rtol=0, atol=1e-14)


def test_quaternion_of_a_quarter_turn_about_z_is_written_xyzw() -> None:
    rotation = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    half = math.sqrt(0.5)
    np.testing.assert_allclose(se3.quaternion_xyzw_from_rotation(rotation), [0, 0, half, half], atol=1e-15)


def test_angle_of_a_rotation_and_of_a_transform() -> None:
    xi = np.array([0.0, -1.25, 0.0, 3.0, 4.0, 5.0])
    assert se3.rotation_angle_rad(se3.perturbation(xi)) == pytest.approx(1.25, abs=1e-15)
    assert se3.rotation_angle_rad(se3.rotation_exp(xi[:3])) == pytest.approx(1.25, abs=1e-15)
    assert se3.rotation_angle_rad(np.eye(3)) == 0.0


@given(twists(), twists())
def test_difference_is_the_perturbation_on_the_left(a: Array, b: Array) -> None:
    nominal = se3.exp(a)
    moved = se3.perturb(nominal, b)
    np.testing.assert_allclose(moved, se3.perturbation(b) @ nominal, rtol=0, atol=1e-11)
    detected = se3.difference(moved, nominal)
    np.testing.assert_allclose(se3.perturb(nominal, detected), moved, rtol=0, atol=1e-11)


@given(twists())
def test_inverse(xi: Array) -> None:
    transform = se3.exp(xi)
    np.testing.assert_allclose(transform @ se3.inverse(transform), np.eye(4), rtol=0, atol=1e-12)


def test_a_pitch_of_the_camera_moves_the_scene_down() -> None:
    """Convention: positive rx turns z (forward) towards -y, which is up in the image of a y-down camera."""
    forward = np.array([0.0, 0.0, 1.0, 1.0])
    turned = se3.perturbation(np.array([0.1, 0, 0, 0, 0, 0])) @ forward
    assert turned[1] < 0.0


def _reflected() -> Array:
    return np.diag([1.0, 1.0, -1.0, 1.0])


def _with(row: int, column: int, value: float) -> Array:
    transform = np.eye(4)
    transform[row, column] = value
    return transform


@pytest.mark.parametrize(
    ("transform", "rigid"),
    [
        (np.eye(4), True),
        (_with(0, 3, 12.0), True),
        (_with(0, 0, 1.0 + 1e-7), True),
        (_with(0, 0, 1.0 + 1e-5), False),
        (_with(0, 1, 1e-3), False),
        (_with(3, 0, 1e-3), False),
        (_with(3, 3, 2.0), False),
        (_with(1, 3, math.nan), False),
        (_with(1, 1, 1e200), False),
        (_reflected(), False),
        (np.eye(3), False),
    ],
)
def test_is_rigid(transform: Array, rigid: bool) -> None:
    assert se3.is_rigid(transform) is rigid


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\(6,\)"):
        se3.exp(np.zeros(3))
    with pytest.raises(ValueError, match=r"\(6,\)"):
        se3.perturbation(np.zeros(3))
    with pytest.raises(ValueError, match=r"\(3,\)"):
        se3.rotation_exp(np.zeros(6))
    with pytest.raises(ValueError, match=r"\(3, 3\)"):
        se3.rotation_log(np.eye(4))
    for length in (0.0, 1e200, math.nan):
        with pytest.raises(ValueError, match="not zero"):
            se3.rotation_from_quaternion_xyzw(np.full(4, length))
