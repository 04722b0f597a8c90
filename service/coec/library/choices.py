"""The settings of a calibration that a caller may choose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike, fspath
from typing import Any, TypedDict

from pydantic import ValidationError

from coec.config import CalibrationConfig, describe
from coec.errors import UsageError
from coec.library.progress import Progress


class Options(TypedDict, total=False):
    """The keyword arguments of `coec.calibrate`, each explained there."""

    depth: str | PathLike[str] | None
    objective: str | None
    dof: int | None
    perturb: Sequence[float] | None
    motion_compensation: bool | None
    camera_model: str | None
    time_offset: bool
    configuration: CalibrationConfig | None
    progress: Progress | None


@dataclass(frozen=True, slots=True)
class Choices:
    """What the caller chose. None: the recorded value, else the default.

    Attributes:
        depth: an ONNX file, the name of a built-in network, or `stereo`: the depth maps of the source.
        objective: what the search maximises: `fused`, `mi` or `intensity`.
        dof: degrees of freedom of the search: 3, rotation only, or 6, translation too.
        motion_compensation: whether sweeps are compensated for the motion of the vehicle.
    """

    depth: str | None = None
    objective: str | None = None
    dof: int | None = None
    motion_compensation: bool | None = None

    @classmethod
    def of(cls, options: Options) -> Choices:
        """What the keyword arguments choose."""
        depth = options.get("depth")
        return cls(
            depth=None if depth is None else fspath(depth),
            objective=options.get("objective"),
            dof=options.get("dof"),
            motion_compensation=options.get("motion_compensation"),
        )


def configuration_of(choices: Choices, recorded: CalibrationConfig | None) -> CalibrationConfig:
    """The recorded configuration, else the defaults, overridden by the choices.

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
