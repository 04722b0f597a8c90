"""Two LiDARs of a vehicle as the rig is told of them: what a look at them came to, or why there was none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

from coec.calibration.lidar_to_lidar.types import RangeBias
from coec.calibration.rig.evidence import Look
from coec.calibration.rig.types import Edge
from coec.calibration.rig.vehicle import Windowed
from coec.calibration.types import Reason


class LidarState(StrEnum):
    """Of two LiDARs. `not_measured`: nothing ever looks at them; `waiting`: nothing has yet; `measured`: the latest
    look tells where the one sits in the other; `refused`: it does not, or there was none."""

    NOT_MEASURED = "not_measured"
    WAITING = "waiting"
    MEASURED = "measured"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """What a look told.

    Attributes:
        look: where b sits in a, for who asks which sensor moved.
        window: the same for the joint estimate.
        range_bias: by how much b measures longer than a.
        rms_m: distance of the points of b from the surfaces of a.
        points, share: of b that met one.
    """

    look: Look
    window: Windowed
    range_bias: RangeBias
    rms_m: float
    points: int
    share: float


@dataclass(frozen=True, slots=True, eq=False)
class LidarsSaid:
    """What came of a look, or of the sweeps that should have made one.

    Attributes:
        stamp_ns: of its last sweep.
        told: what it told; None where it was refused.
        reasons: why, exactly where it was.
        losses: sweeps and looks that were lost up to there, by cause.
    """

    stamp_ns: int
    told: Registration | None
    reasons: tuple[Reason, ...]
    losses: Mapping[str, int]


@dataclass(frozen=True, slots=True, eq=False)
class LidarsKnown:
    """All that is known of two LiDARs.

    Attributes:
        edge: as they were built.
        state: see there.
        reasons: of the state; empty where they are measured.
        stamp_ns: of the latest look that was done or refused; None before the first.
        told: by the latest that was not refused.
        looks: that told something.
        losses: see `LidarsSaid`.
    """

    edge: Edge
    state: LidarState = LidarState.WAITING
    reasons: tuple[Reason, ...] = ()
    stamp_ns: int | None = None
    told: Registration | None = None
    looks: int = 0
    losses: Mapping[str, int] = field(default_factory=dict)

    def after(self, said: LidarsSaid) -> LidarsKnown:
        """With what came of one more look."""
        known = replace(self, stamp_ns=said.stamp_ns, reasons=said.reasons, losses=said.losses)
        if said.told is None:
            return replace(known, state=LidarState.REFUSED)
        return replace(known, state=LidarState.MEASURED, told=said.told, looks=self.looks + 1)
