"""Hypothesis strategies that prefer the places where formulas break (zero, the axis, right angles, half turns), and
where readers do (the ends of types, and one type where another is expected)."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

_SINGULAR_RAD = (0.0, math.pi / 4, math.pi / 2, 3 * math.pi / 4, math.pi)
_OFFSETS_RAD = (0.0, 1e-15, 1e-12, 1e-9, 1e-7, 1e-5, 1e-3, 0.03)


def _near_singular_angles() -> st.SearchStrategy[float]:
    return st.builds(
        lambda centre, offset, sign: min(max(centre + sign * offset, 0.0), math.pi),
        st.sampled_from(_SINGULAR_RAD),
        st.sampled_from(_OFFSETS_RAD),
        st.sampled_from((-1.0, 1.0)),
    )


def angles_rad() -> st.SearchStrategy[float]:
    """Angles in [0, pi], half of them within 0.03 rad of a multiple of 45 degrees, many much closer."""
    return _near_singular_angles() | st.floats(0.0, math.pi)


def directions() -> st.SearchStrategy[NDArray[np.float64]]:
    """Unit vectors (3,) by polar angle from +z and azimuth."""
    return st.builds(
        lambda polar, azimuth: np.array(
            [math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth), math.cos(polar)]
        ),
        angles_rad(),
        angles_rad() | angles_rad().map(lambda angle: -angle),
    )


def points_m() -> st.SearchStrategy[NDArray[np.float64]]:
    """Points (3,) of the camera frame, a millimetre to ten kilometres away, in any direction."""
    return st.builds(lambda direction, exponent: direction * 10.0**exponent, directions(), st.floats(-3.0, 4.0))


def rotation_vectors() -> st.SearchStrategy[NDArray[np.float64]]:
    """Rotation vectors (3,), radians, of length 0 to pi."""
    return st.builds(lambda axis, angle: axis * angle, directions(), angles_rad())


def twists() -> st.SearchStrategy[NDArray[np.float64]]:
    """xi (6,): a rotation vector as above and a translation of up to 100 m."""
    return st.builds(
        lambda r, direction, length: np.concatenate([r, direction * length]),
        rotation_vectors(),
        directions(),
        st.sampled_from((0.0, 1e-9, 0.5)) | st.floats(0.0, 100.0),
    )


def scalars() -> st.SearchStrategy[Any]:
    """What a document may hold at its ends, in every encoding."""
    texts = st.sampled_from(("", "\0", "/", "..", "1e999", "front", "accepted"))
    return st.one_of(
        st.none(),
        st.booleans(),
        st.sampled_from((0, -1, 2**31, 2**53, 2**63 - 1, -(2**63))),
        st.sampled_from((0.0, -0.0, 1e308, 5e-324, 0.5)) | st.floats(allow_nan=False, allow_infinity=False),
        texts | st.text(st.characters(codec="utf-8"), max_size=8),
    )


def documents(names: Sequence[str]) -> st.SearchStrategy[Any]:
    """Maps and lists in one another that every encoding can write, with these names for most of their fields."""
    fields = st.sampled_from(tuple(names)) | st.text(st.characters(codec="utf-8"), max_size=4)
    rows = st.just([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    return st.recursive(
        scalars() | rows,
        lambda inner: st.lists(inner, max_size=6) | st.dictionaries(fields, inner, max_size=6),
        max_leaves=20,
    )
