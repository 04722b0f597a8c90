"""The reply of `rig`: what all pairs of a vehicle together say about which sensor moved and where all sensors are.

Moves are about a sensor's own axes: a move x (deg, then m) multiplies, from the left, the pose of the rig in the
sensor's frame. All times are sensor time; a number that could not be computed is null.
"""

from typing import Annotated, Literal

from pydantic import Field

from coec.schemas.message import Message, Part, Text
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
    """A camera or a LiDAR of the vehicle, over all its pairs."""

    name: Text
    kind: SensorKind
    state: SensorState = Field(
        description="`undecided`: something moved or is disturbed, and it may be this sensor; `unknown`: no check yet. "
        "`camera_moved` and `lidar_moved` last until every pair of the sensor serves another extrinsic"
    )
    probability: Probability | None = Field(description="probability that the sensor moved; null if not measured")
    since_ns: int | None = Field(description="sensor time at which this state began, ns; null before any check")
    moved: SensorMove | None = Field(description="set if the sensor moved, or may have")
    pairs: tuple[Text, ...] = Field(description="pairs of this sensor")
    reasons: tuple[Reason, ...] = Field(description="why the sensor is in this state, the most important first")


class JointPair(Part):
    """The extrinsic of a pair, estimated from all pairs together."""

    pair: Text
    camera: Text
    lidar: Text
    measured: bool = Field(description="whether a window of its own is included; otherwise it follows from the others")
    camera_from_lidar: Transform
    sigma: Vector6 = Field(description="standard deviations (deg, m)")
    covariance: Maybe6x6 = Field(description="about the axes of the camera (rad, m), exact")
    step: Vector6 = Field(
        description="from the extrinsic that the pair serves to this one: rx ry rz (deg), tx ty tz (m)"
    )


class OpenLoop(Part):
    """A loop along pairs and links that does not close: it should end where it begins."""

    names: tuple[Text, ...] = Field(description="pairs and links of the loop, in order")
    rotation_deg: float = Field(description="rotation by which it does not close")
    translation_m: float | None = Field(
        description="translation by which it does not close; null if a pair in it does not determine it"
    )
    p_value: Probability = Field(description="chance of a gap at least as large")


class JointReply(Part):
    """Poses of all sensors, estimated from the latest windows of all pairs."""

    stamp_ns: int = Field(description="stamp of the newest window in it, ns")
    pairs: tuple[JointPair, ...]
    chi2: float = Field(ge=0, description="sum of squared normalised residuals between the pairs")
    freedom: Count = Field(description="degrees of freedom of `chi2`: six for each loop; 0 if there is no loop")
    p_value: Probability = Field(description="chance of a `chi2` at least as large")
    consistent: bool = Field(description="whether the pairs fit each other; if not, they report `inconsistent_rig`")
    left_out: Text | None = Field(description="the one pair that did not fit and was left out, if any")
    open_loops: tuple[OpenLoop, ...] = Field(description="loops that do not close, the least likely first")
    widened: float = Field(ge=1, description="factor on all standard deviations, to cover the gaps of the loops")


class RigMove(Part):
    """A move of one or two sensors. It lasts from its attribution until every pair of them serves another extrinsic."""

    sensors: tuple[Text, ...]
    since_ns: int = Field(description="sensor time of the attribution, ns")
    stepped_ns: int = Field(description="sensor time before which they moved, ns")
    over_ns: int | None = Field(description="sensor time at which the move was corrected, ns; null until then")
    by: dict[Text, SensorMove] = Field(description="size of the move by sensor, as known at the attribution")


class LidarsReply(Part):
    """Two LiDARs of the vehicle, registered by the surfaces that both measure, without any camera."""

    name: Text = Field(description="name of the edge, as in `disturbed` and `looks`")
    a: Text
    b: Text
    state: LidarsState = Field(
        description="`measured`: the latest registration determines the pose of b in a; `refused`: it does not, or the "
        "latest sweep gave none; `waiting`: no registration yet; `not_measured`: not registered"
    )
    reasons: tuple[Reason, ...] = Field(description="reasons for the state; empty if it is `measured`")
    stamp_ns: int | None = Field(
        description="stamp of the latest registration, or of the sweep that gave none, ns; null: no sweep yet"
    )
    measured_ns: int | None = Field(description="stamp of the registration that gave the figures below, ns")
    a_from_b: Transform | None = Field(description="maps coordinates of b to those of a; null before the first")
    sigma: Vector6 | None = Field(description="standard deviations about and along the axes of a (deg, m)")
    correction: Vector6 | None = Field(description="from the nominal pose to this one: rx ry rz (deg), tx ty tz (m)")
    range_bias_m: float | None = Field(description="by how much b measures longer ranges than a, m")
    range_bias_sigma_m: float | None
    rms_m: float | None = Field(description="rms distance of the points of b from the surfaces of a, m")
    share: Probability | None = Field(description="share of the points of b that lie on a surface of a")
    looks: Count = Field(description="useful registrations")
    losses: Counts = Field(description="registrations and sweeps that were lost, by cause")


class RigCorrection(Part):
    """The correction of a move of one or two sensors, applied to all of their pairs at once."""

    stamp_ns: int = Field(description="sensor time at which it was decided, ns")
    from_ns: int = Field(description="sensor time from which the pairs are checked with it, ns")
    sensors: tuple[Text, ...]
    pairs: tuple[Text, ...]


class RigReply(Message):
    """All sensors of a vehicle. Before the first check all of them are `unknown`."""

    vehicle: Text
    stamp_ns: int | None = Field(
        description="sensor time up to which all requested results are included, ns; null: nothing yet"
    )
    sensors: tuple[SensorReply, ...]
    nobody: Probability | None = Field(description="probability that no sensor moved; null before the first check")
    disturbed: dict[Text, Probability] = Field(
        description="by pair, or by edge between two LiDARs: probability that something else disturbs it permanently"
    )
    joint: JointReply | None = Field(description="null before the first accepted window, and for a single pair")
    correction: RigCorrection | None = Field(description="the latest correction; null before the first")
    move: RigMove | None = Field(
        default=None, description="the latest move since the service started, over or not; null before the first"
    )
    lidars: tuple[LidarsReply, ...] = Field(default=(), description="every two LiDARs")
    reasons: tuple[Reason, ...] = Field(default=(), description="what prevents combining the pairs")
    looks: Counts = Field(description="combined checks by pair, and registrations of two LiDARs by edge")
    losses: Counts = Field(description="checks that were not combined, or arrived out of order, by cause")
