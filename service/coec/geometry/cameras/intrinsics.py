"""Checks of the numbers that describe a camera. Each raises ValueError with the name of the field."""

import math
from numbers import Integral, Real
from typing import NamedTuple


class CommonIntrinsics(NamedTuple):
    """The checked fields that all models share, in the order in which all models start."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


def finite(name: str, value: float) -> float:
    """`value` as a float; ValueError unless it is a finite number."""
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number, got {value!r}")
    return float(value)


def positive(name: str, value: float) -> float:
    """`value` as a float; ValueError unless it is finite and above zero."""
    if not finite(name, value) > 0.0:
        raise ValueError(f"{name} must be above zero, got {value!r}")
    return float(value)


def within(name: str, value: float, low: float, high: float) -> float:
    """`value` as a float; ValueError unless low <= value <= high."""
    if not low <= finite(name, value) <= high:
        raise ValueError(f"{name} must lie in [{low:g}, {high:g}], got {value!r}")
    return float(value)


def pixel_count(name: str, value: int) -> int:
    """`value` as an int; ValueError unless it is a whole number above zero."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value <= 0:
        raise ValueError(f"{name} must be a whole number of pixels above zero, got {value!r}")
    return int(value)


def common_intrinsics(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> CommonIntrinsics:
    """The checked size (px), focal lengths (px, above zero) and principal point (px, any finite value)."""
    return CommonIntrinsics(
        pixel_count("width", width),
        pixel_count("height", height),
        positive("fx", fx),
        positive("fy", fy),
        finite("cx", cx),
        finite("cy", cy),
    )
