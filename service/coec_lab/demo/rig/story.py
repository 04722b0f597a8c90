"""What `coec demo --rig` plays: one street, driven twice. In one drive the roof LiDAR is knocked, in one a camera."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot
from typing import TYPE_CHECKING

from coec.simulation.source import require_extra

if TYPE_CHECKING:
    from coec.simulation.rig_drive import RigConfig

SEED = 2

CAMERA_PX = 700
"""Side of the pictures. Pictures of 1400 px take four times as long to draw. With half as many pixels, one degree is
within the uncertainty of the pixels, and a single camera that is off by it stays undecided."""

LIDAR = "roof"
"""The LiDAR whose view all four cameras share; the rig's short-range LiDARs are left out."""

KNOCK_S = 16.0
"""Time of the knock: by then every pair has been looked at twice."""

LONGEST_S = KNOCK_S + 60.0
"""Length of the drive if no sensor is named: an alarm has to come within a minute."""

REST_S = 6.0
"""Driving after the sensor was named, in which every pair is looked at once more."""


@dataclass(frozen=True, slots=True)
class Act:
    """One drive.

    Attributes:
        name: of its files.
        sensor: the knocked one.
        turn_deg: of the sensor about its own axes.
    """

    name: str
    sensor: str
    turn_deg: tuple[float, float, float]

    @property
    def knock_deg(self) -> float:
        """Angle of the knock."""
        return hypot(*self.turn_deg)


ACTS = (Act("lidar", LIDAR, (0.0, 1.0, 0.0)), Act("camera", "left", (0.0, 1.0, 0.0)))
"""The LiDAR nods and the camera looks aside, each by one degree."""


def drive_config(act: Act | None) -> RigConfig:
    """Configuration of the drive of an act; None: no sensor is knocked.

    Raises:
        SourceError: the library that casts rays is not installed.
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
