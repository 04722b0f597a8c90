"""The state of the service from which messages to ROS are made."""

from __future__ import annotations

from dataclasses import dataclass

from coec.adapters.ros.diagnostics import ServicePhase
from coec.calibration.types import Rig
from coec.schemas.replies import ExtrinsicReply, HealthReply
from coec.schemas.rig_state import RigReply


@dataclass(frozen=True, slots=True, eq=False)
class PairOutput:
    """One pair. `serial` is that of its camera; `extrinsic` and `rig` are None while the pair is awaited."""

    health: HealthReply
    serial: str | None
    extrinsic: ExtrinsicReply | None
    rig: Rig | None


@dataclass(frozen=True, slots=True, eq=False)
class VehicleOutput:
    """The service, its pairs and their rig at one moment; `rig` is None if there is only one pair."""

    service: ServicePhase
    pairs: tuple[PairOutput, ...]
    rig: RigReply | None = None
