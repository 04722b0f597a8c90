"""What a caller may choose of how a recording is calibrated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from coec.config import CalibrationConfig, describe
from coec.errors import UsageError


@dataclass(frozen=True, slots=True)
class Choices:
    """None leaves a value as it was recorded, else at its default.

    Attributes:
        depth: an ONNX file, the name of a built-in network, or `stereo`: the maps of the source.
        objective: what is maximised: `fused`, `mi` or `intensity`.
        dof: degrees of freedom that are searched: 3, rotation only, or 6, translation too.
        motion_compensation: whether sweeps are compensated for the motion of the vehicle.
    """

    depth: str | None = None
    objective: str | None = None
    dof: int | None = None
    motion_compensation: bool | None = None


def configuration_of(choices: Choices, recorded: CalibrationConfig | None) -> CalibrationConfig:
    """The recorded configuration, or the defaults, with what was chosen.

    Raises:
        UsageError: a value that does not exist.
    """
    values: dict[str, Any] = (recorded or CalibrationConfig()).model_dump()
    if choices.depth is not None:
        values["depth"]["model"] = choices.depth
    if choices.objective is not None:
        values["objective"]["kind"] = choices.objective
    if choices.dof is not None:
        values["search"]["dof"] = choices.dof
    if choices.motion_compensation is not None:
        values["motion_compensation"] = choices.motion_compensation
    try:
        return CalibrationConfig.model_validate(values)
    except ValidationError as error:
        raise UsageError(f"the options do not fit: {describe(error)}") from error
