"""What `coec demo --rig` plays: one street, driven twice. Once the LiDAR on the roof is knocked, once a camera."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot
from typing import TYPE_CHECKING

from coec.simulation.source import require_extra

if TYPE_CHECKING:
    from coec.simulation.rig_drive import RigConfig

SEED = 2

CAMERA_PX = 700
"""Side of the pictures: those of 1400 take four times as long to draw. With half as many pixels a degree is within what
pixels leave open, and a single camera that is off by it stays undecided."""

LIDAR = "roof"
"""That all four cameras see: the short-range ones of the rig are left out."""

KNOCK_S = 16.0
"""Of driving: every pair has been looked at twice."""

LONGEST_S = KNOCK_S + 60.0
"""Of driving, should nobody be named: an alarm has to come within a minute."""

REST_S = 6.0
"""Of driving after it was told who moved: every pair is looked at once more."""


@dataclass(frozen=True, slots=True)
class Act:
    """One drive.

    Attributes:
        name: of its files.
        sensor: that is knocked.
        turn_deg: about its own axes.
    """

    name: str
    sensor: str
    turn_deg: tuple[float, float, float]

    @property
    def knock_deg(self) -> float:
        """By how much."""
        return hypot(*self.turn_deg)


ACTS = (Act("lidar", LIDAR, (0.0, 1.0, 0.0)), Act("camera", "left", (0.0, 1.0, 0.0)))
"""The LiDAR nods, the camera looks aside: either by a degree."""


def drive_config(act: Act | None) -> RigConfig:
    """Of the drive of an act; None: nobody is knocked.

    Raises:
        SourceError: what casts the rays is not installed.
    """
    require_extra()
    from coec.evaluation.rig_looks import ROWS
    from coec.simulation.faults import SensorFault, Step
    from coec.simulation.rig_drive import RigConfig

    faults: tuple[SensorFault, ...] = ()
    if act is not None:
        rx, ry, rz = act.turn_deg
        faults = (SensorFault(act.sensor, Step(KNOCK_S, float("inf"), rx=rx, ry=ry, rz=rz)),)
    return RigConfig(seed=SEED, seconds=LONGEST_S, camera=f"fisheye{CAMERA_PX}", ego_hz=20.0, faults=faults, rows=ROWS)
