"""What the rig is told of two LiDARs of a vehicle: the result of a look at them, or why there was none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

from coec.calibration.lidar_to_lidar.types import RangeBias
from coec.calibration.rig.evidence import EdgeObservation
from coec.calibration.rig.types import Edge
from coec.calibration.rig.vehicle import EdgeWindow
from coec.calibration.types import Reason


class LidarState(StrEnum):
    """State of two LiDARs. `not_measured`: nothing ever looks at them. `waiting`: nothing has looked at them yet.
    `measured`: the latest look gives the pose of one in the other. `refused`: it does not, or no look was possible."""

    NOT_MEASURED = "not_measured"
    WAITING = "waiting"
    MEASURED = "measured"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """The result of a look at two LiDARs a and b.

    Attributes:
        look: the pose of b in a, as evidence of which sensor moved.
        window: the same for the joint estimate.
        range_bias: by how much b measures longer ranges than a.
        rms_m: distance of the points of b from the surfaces of a.
        points, share: number and share of the points of b that met a surface.
    """

    observation: EdgeObservation
    window: EdgeWindow
    range_bias: RangeBias
    rms_m: float
    points: int
    share: float


@dataclass(frozen=True, slots=True, eq=False)
class LidarPairReport:
    """The outcome of a look, or of the sweeps that should have given one.

    Attributes:
        stamp_ns: stamp of the last sweep of the look.
        told: the result; None if the look was refused.
        reasons: why it was refused; empty exactly if it was not.
        losses: number of sweeps and looks that were lost so far, by cause.
    """

    stamp_ns: int
    registration: Registration | None
    reasons: tuple[Reason, ...]
    losses: Mapping[str, int]


@dataclass(frozen=True, slots=True, eq=False)
class LidarPairStatus:
    """Everything that is known of two LiDARs.

    Attributes:
        edge: the two LiDARs and their pose as built.
        state: see `LidarState`.
        reasons: reasons for the state; empty if they are measured.
        stamp_ns: stamp of the latest look that was done or refused; None before the first.
        told: result of the latest look that was not refused.
        looks: number of looks that had a result.
        losses: see `LidarsSaid`.
    """

    edge: Edge
    state: LidarState = LidarState.WAITING
    reasons: tuple[Reason, ...] = ()
    stamp_ns: int | None = None
    registration: Registration | None = None
    registrations: int = 0
    losses: Mapping[str, int] = field(default_factory=dict)

    def after(self, report: LidarPairReport) -> LidarPairStatus:
        """This knowledge with the outcome of one more look."""
        known = replace(self, stamp_ns=report.stamp_ns, reasons=report.reasons, losses=report.losses)
        if report.registration is None:
            return replace(known, state=LidarState.REFUSED)
        return replace(known, state=LidarState.MEASURED, registration=report.registration, registrations=self.registrations + 1)
