"""The reply of `rig`: what all pairs of a vehicle say together. Which of its sensors moved, and where they all are.

A sensor that moved by x has moved about its own axes: x (deg, then m) is on the left of the pose of the rig in its
frame. Sensor time throughout; a number that could not be computed is null.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from coec.schemas.base import Message, Part
from coec.schemas.replies import Count, Counts, Maybe6x6, Reason, Transform, Vector6

SensorKind = Literal["camera", "lidar"]
SensorState = Literal["calibrated", "camera_moved", "lidar_moved", "undecided", "unknown"]
LidarsState = Literal["not_measured", "waiting", "measured", "refused"]
Probability = Annotated[float, Field(ge=0, le=1)]


class SensorMove(Part):
    """By how much a sensor moved, about its own axes."""

    by: Vector6 = Field(description="rx ry rz (deg), tx ty tz (m)")
    sigma: Vector6 = Field(description="standard deviations (deg, m)")


class SensorReply(Part):
    """A camera or a LiDAR of the vehicle, whatever pairs it is of."""

    name: str
    kind: SensorKind
    state: SensorState = Field(
        description="`undecided`: something moved or is disturbed, and this may be it; `unknown`: nothing looked. "
        "One that moved is so called until every pair of it serves another extrinsic"
    )
    probability: Probability | None = Field(description="that it moved; null where nothing can tell")
    since_ns: int | None = Field(description="sensor time since which it is in this state, ns; null before any look")
    moved: SensorMove | None = Field(description="set where it moved, or may have")
    pairs: tuple[str, ...] = Field(description="that have it")
    reasons: tuple[Reason, ...] = Field(description="why it is in this state; the first one says most")


class JointPair(Part):
    """A pair, as all pairs together put it."""

    pair: str
    camera: str
    lidar: str
    measured: bool = Field(description="whether a window of its own is in it; else the others put it there")
    camera_from_lidar: Transform
    sigma: Vector6 = Field(description="standard deviations (deg, m)")
    covariance: Maybe6x6 = Field(description="about the axes of the camera (rad, m), exact")
    step: Vector6 = Field(description="from what the pair serves to this: rx ry rz (deg), tx ty tz (m)")


class OpenLoop(Part):
    """A way along pairs and links that should end where it begins, and does not."""

    names: tuple[str, ...] = Field(description="of the pairs and links, in their order")
    rotation_deg: float = Field(description="by which it does not close")
    translation_m: float | None = Field(description="likewise; null where a pair on it does not tell")
    p_value: Probability = Field(description="chance of one as large")


class JointReply(Part):
    """Where everything is, by the latest windows of all pairs."""

    stamp_ns: int = Field(description="of the newest window in it, ns")
    pairs: tuple[JointPair, ...]
    chi2: float = Field(ge=0, description="sum of squares of what the pairs miss each other by")
    freedom: Count = Field(description="its degrees of freedom: six for each loop; 0 where no loop closes")
    p_value: Probability = Field(description="chance of a sum as large")
    consistent: bool = Field(description="whether the pairs fit each other; else they say `inconsistent_rig`")
    left_out: str | None = Field(description="the pair that alone did not fit, if one did")
    open_loops: tuple[OpenLoop, ...] = Field(description="loops that do not close, the least likely first")
    widened: float = Field(ge=1, description="factor on all standard deviations, for what the loops miss")


class RigMove(Part):
    """A move of one or two sensors: from when they were named until every pair of them serves another extrinsic."""

    sensors: tuple[str, ...]
    since_ns: int = Field(description="sensor time at which they were named, ns")
    stepped_ns: int = Field(description="sensor time before which they moved, ns")
    over_ns: int | None = Field(description="sensor time at which it was put right, ns; null while it is not")
    by: dict[str, SensorMove] = Field(description="by sensor, as it was known when they were named")


class LidarsReply(Part):
    """Two LiDARs of the vehicle, by the surfaces that both see: no camera has a part in it."""

    name: str = Field(description="of the edge, as in `disturbed` and `looks`")
    a: str
    b: str
    state: LidarsState = Field(
        description="`measured`: the latest look tells where b sits in a; `refused`: it does not, or there was none; "
        "`waiting`: there was none yet; `not_measured`: nothing looks"
    )
    reasons: tuple[Reason, ...] = Field(description="of the state; empty where it is `measured`")
    stamp_ns: int | None = Field(description="of the latest look, or of the sweep that made none, ns; null: none came")
    measured_ns: int | None = Field(description="of the latest look that told something, of which the rest is, ns")
    a_from_b: Transform | None = Field(description="maps coordinates of b to those of a; null before any look")
    sigma: Vector6 | None = Field(description="standard deviations about and along the axes of a (deg, m)")
    correction: Vector6 | None = Field(description="from how they were built to this: rx ry rz (deg), tx ty tz (m)")
    range_bias_m: float | None = Field(description="by how much b measures longer than a, m")
    range_bias_sigma_m: float | None
    rms_m: float | None = Field(description="distance of the points of b from the surfaces of a, m")
    share: Probability | None = Field(description="of the points of b that lie on a surface of a")
    looks: Count = Field(description="that told something")
    losses: Counts = Field(description="looks and sweeps that were lost, by cause")


class RigCorrection(Part):
    """A move of one or two sensors, put right in all of their pairs at once."""

    stamp_ns: int = Field(description="sensor time at which it was decided, ns")
    from_ns: int = Field(description="sensor time from which the pairs are looked at with it, ns")
    sensors: tuple[str, ...]
    pairs: tuple[str, ...]


class RigReply(Message):
    """All sensors of a vehicle. A reply exists before the first look: all `unknown`."""

    vehicle: str
    stamp_ns: int | None = Field(description="all that was asked up to this sensor time is in it, ns; null: nothing is")
    sensors: tuple[SensorReply, ...]
    nobody: Probability | None = Field(description="that no sensor moved; null before the first look")
    disturbed: dict[str, Probability] = Field(
        description="that something else lastingly disturbs a pair, or an edge between two LiDARs, by name"
    )
    joint: JointReply | None = Field(description="null before the first accepted window, or of a single pair")
    correction: RigCorrection | None = Field(description="the latest; null before the first")
    move: RigMove | None = Field(
        default=None, description="the latest, over or not; null before the first since the service was started"
    )
    lidars: tuple[LidarsReply, ...] = Field(default=(), description="every two of them")
    reasons: tuple[Reason, ...] = Field(default=(), description="what keeps the pairs from being put together")
    looks: Counts = Field(description="checks that were put together, by pair, and looks at two LiDARs, by edge")
    losses: Counts = Field(description="what was not, or out of order, by cause")
