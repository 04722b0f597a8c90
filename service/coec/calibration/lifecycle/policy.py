"""Decides whether an accepted estimate may become current without a person."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import degrees, fsum

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Matrix4, Reason
from coec.config import PolicyConfig
from coec.geometry import se3

NS_PER_DAY = 86_400_000_000_000

AXES = ("pitch", "yaw", "roll", "x", "y", "z")


@dataclass(frozen=True, slots=True)
class AppliedChange:
    """A step of the served extrinsic that no person ordered: sensor time, and |rx ry rz tx ty tz| (rad, m)."""

    stamp_ns: int
    step: tuple[float, ...]


def step_between(T_before: Matrix4, T_after: Matrix4) -> NDArray[np.float64]:
    """(6,) perturbation about the camera axes from one extrinsic to the other (rad, m)."""
    return np.asarray(se3.difference(T_after, T_before), dtype=np.float64)


def objection(
    step: NDArray[np.float64], past: Iterable[AppliedChange], stamp_ns: int, policy: PolicyConfig
) -> Reason | None:
    """Why a step (6,) must wait for a person; None when it may be applied.

    Args:
        past: earlier steps; those within 24 h of sensor time of `stamp_ns` count towards the limits of a day.
    """
    if policy.apply == "always":
        return None
    if policy.apply == "never":
        return Reason("apply_never", "policy.apply is `never`: the candidate waits for `command/apply`.")
    size = [abs(float(value)) for value in step]
    recent = [change.step for change in past if abs(stamp_ns - change.stamp_ns) < NS_PER_DAY]
    for axis, name in enumerate(AXES):
        turns = axis < 3
        shown, unit = (degrees(size[axis]), "°") if turns else (size[axis], " m")
        limit = policy.max_step_deg if turns else policy.max_step_m
        if shown > limit:
            return Reason("step_too_large", f"The step in {name} is {shown:.3g}{unit}, policy allows {limit:g}{unit}.")
        day = fsum([size[axis], *(step[axis] for step in recent)])
        shown, limit = (degrees(day), policy.max_per_day_deg) if turns else (day, policy.max_per_day_m)
        if shown > limit:
            text = f"The steps of a day in {name} add up to {shown:.3g}{unit}, policy allows {limit:g}{unit}."
            return Reason("day_exhausted", text)
    return None


def remembered(past: Iterable[AppliedChange], stamp_ns: int) -> tuple[AppliedChange, ...]:
    """The changes that still count at `stamp_ns`."""
    return tuple(change for change in past if abs(stamp_ns - change.stamp_ns) < NS_PER_DAY)


def agrees(step: NDArray[np.float64], policy: PolicyConfig) -> bool:
    """Whether a step (6,) is too small to speak of a contradiction."""
    size = [abs(float(value)) for value in step]
    return max(map(degrees, size[:3])) <= policy.agree_deg and max(size[3:]) <= policy.agree_m
