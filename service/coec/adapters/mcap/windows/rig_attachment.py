"""`rig.json` of a window: the rig, the extrinsic at the start, and the window's id."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from coec.adapters.files.rig import matrix_rows, rig_from_json, rig_to_json, rigid_matrix
from coec.adapters.mcap.windows.names import RIG
from coec.calibration.types import Matrix4, Rig
from coec.config import Matrix4x4, describe
from coec.errors import ConfigError, WindowError
from coec.schemas.base import to_json


class _RigAttachment(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    schema_version: int = 1
    window_id: str
    T_camera_lidar_start: Matrix4x4
    rig: dict[str, Any]


def encode_rig(rig: Rig, T_camera_lidar_start: Matrix4, window_id: str) -> bytes:
    """The attachment, without the rig's mask, which is a separate one."""
    start = matrix_rows(T_camera_lidar_start)
    return to_json(_RigAttachment(window_id=window_id, T_camera_lidar_start=start, rig=rig_to_json(rig)))


def decode_rig(path: Path, data: bytes, mask_png: bytes | None) -> tuple[Rig, Matrix4, str]:
    """Rig, extrinsic at the start (4, 4) and window id of the window at `path`.

    Raises:
        WindowError: the attachment is not valid.
    """
    try:
        document = _RigAttachment.model_validate_json(data)
        T_camera_lidar_start = rigid_matrix(document.T_camera_lidar_start, "T_camera_lidar_start")
        return rig_from_json(document.rig, mask_png), T_camera_lidar_start, document.window_id
    except ValidationError as error:
        raise WindowError(f"{path}: {RIG}: {describe(error)}") from error
    except (ConfigError, WindowError) as error:
        raise WindowError(f"{path}: {RIG}: {error}") from error
