"""The result of a calibration, and its export, for a program that imports coec."""

from __future__ import annotations

from os import PathLike, fspath
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from coec.adapters.exports.told import Frames, of_result
from coec.adapters.files import output
from coec.adapters.files.conversions import matrix_of
from coec.adapters.files.rig import intrinsics_config
from coec.calibration.frames.time_offset import TimeOffset
from coec.config import CalibrationConfig
from coec.errors import UsageError
from coec.library.calibrating import Calibrated
from coec.library.camera_fit import CameraFit
from coec.library.exporting import accepted, text_of
from coec.reports import pictures
from coec.reports.overlay import titled
from coec.schemas.base import to_json
from coec.schemas.replies import CalibrationResult, MetricReply, Reason, Verdict

Pose = Literal["result", "start", "nominal"]
"""The poses at which a window can be drawn."""


class Result:
    """Where the camera is, according to one window. Arrays are copies, so changing one does not change the result."""

    def __init__(self, calibrated: Calibrated) -> None:
        self._calibrated = calibrated
        self._document = calibrated.result

    def __repr__(self) -> str:
        reasons = "".join(f", {reason.code}" for reason in self.reasons)
        return f"<coec.Result {self.document.window_id}: {self.verdict.decision}{reasons}>"

    @property
    def document(self) -> CalibrationResult:
        """The whole result as a pydantic model: what `coec calibrate --json` prints, except how long it took."""
        return self._document

    @property
    def T_camera_lidar(self) -> NDArray[np.float64]:
        """(4, 4) float64: maps LiDAR coordinates (x forward, y left, z up) to camera coordinates (x right, y down,
        z forward), metres. Use it only if `accepted`."""
        return matrix_of(self.document.camera_from_lidar)

    @property
    def quaternion_xyzw(self) -> NDArray[np.float64]:
        """(4,) rotation of `T_camera_lidar`: unit quaternion, w last and not negative."""
        return np.array(self.document.camera_from_lidar.quaternion_xyzw)

    @property
    def translation_m(self) -> NDArray[np.float64]:
        """(3,) last column of `T_camera_lidar`, metres."""
        return np.array(self.document.camera_from_lidar.translation_m)

    @property
    def correction(self) -> NDArray[np.float64]:
        """(6,) rx ry rz (degrees) and tx ty tz (metres), about and along the camera axes, by which the result differs
        from the recording's own calibration: T_camera_lidar = exp(correction)·T_nominal."""
        return np.array(self.document.correction)

    @property
    def sigma(self) -> NDArray[np.float64]:
        """(6,) standard deviations of `correction`, degrees and metres; NaN where an axis was not estimated."""
        return np.array([np.nan if value is None else value for value in self.document.sigma])

    @property
    def covariance(self) -> NDArray[np.float64]:
        """(6, 6) covariance of the error about and along the camera axes, radians and metres: the true transform is
        exp(error)·T_camera_lidar. NaN where an axis was not estimated."""
        return self._calibrated.estimate.uncertainty.covariance.copy()

    @property
    def accepted(self) -> bool:
        """Whether the self-diagnosis accepts the result."""
        return self.document.verdict.decision == "accepted"

    @property
    def verdict(self) -> Verdict:
        """The decision (`accepted` or `failed`) and its reasons."""
        return self.document.verdict

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Why the result is not accepted: machine-readable codes with a sentence each. Empty if it is accepted."""
        return self.document.verdict.reasons

    @property
    def figures(self) -> dict[str, MetricReply]:
        """The figures of the self-diagnosis by name, each with its limit and whether it is within it."""
        return dict(self.document.metrics)

    @property
    def configuration(self) -> CalibrationConfig:
        """The settings that decided the result. Pass it to another `calibrate` to repeat them."""
        return self._calibrated.configuration

    @property
    def camera_fit(self) -> CameraFit | None:
        """How well the chosen `camera_model` fits the recording's camera; None if none was chosen."""
        return self._calibrated.fit

    @property
    def time_offset(self) -> TimeOffset | None:
        """Offset of the camera's clock, s; None unless `time_offset=True`."""
        return self._calibrated.offset

    def to_json(self) -> str:
        """Canonical JSON of `document`: equal results give equal bytes. `coec export` reads it. Its schema is
        `schemas/v1/CalibrationResult.json`."""
        return to_json(self.document).decode()

    def export(
        self,
        path: str | PathLike[str],
        *,
        format: str,
        parent: str | None = None,
        child: str | None = None,
        T_parent_lidar: NDArray[np.float64] | None = None,
        force: bool = False,
    ) -> Path:
        """Writes the result into a file of another program's format, completely or not at all. If the file exists and
        holds other transforms (URDF, Autoware's YAML and the like), only this transform is changed.

        Args:
            path: the file; its folder is made if it does not exist.
            format: `tf`, `urdf`, `autoware`, `kalibr`, `kitti`, `kitti360`, `nuscenes`, `openlabel`, `colmap`,
                `opencv` or `json`. The file states the direction of its transform.
            parent: name of the parent frame; None: the LiDAR's.
            child: name of the child frame; None: the camera's.
            T_parent_lidar: (4, 4) pose of the LiDAR in `parent`, metres; None: the LiDAR is the parent.
            force: also write a result that is not accepted; the file says that it is not.

        Returns:
            The path of the file.

        Raises:
            NotAcceptedError: the verdict is negative, and `force` was not given.
            UsageError: no such format, or `T_parent_lidar` is no (4, 4) array of finite numbers.
            OutputError: the file cannot be written, or its present content cannot be changed.
            SourceError: the existing file cannot be read.
        """
        pose = None if T_parent_lidar is None else np.array(T_parent_lidar, dtype=np.float64)
        if pose is not None and (pose.shape != (4, 4) or not np.isfinite(pose).all()):
            raise UsageError(f"T_parent_lidar: (4, 4) finite numbers are expected, not {pose.shape}")
        camera = intrinsics_config(self._calibrated.window.rig.camera)
        extrinsic = of_result(self.document, camera, Frames(parent, child, pose))
        accepted(extrinsic, self.document.window_id, "force=True", force=force)
        place = Path(fspath(path))
        output.replace(place, text_of(extrinsic, format, place).encode())
        return place

    def overlay(self, at: Pose = "result") -> NDArray[np.uint8]:
        """Draws the points of the sweep, coloured by range, over the middle camera frame of the window.

        Args:
            at: the pose at which the points are drawn: `result`, `start` (where the search began), or `nominal` (the
                recording's own calibration).

        Returns:
            (height, width, 3) uint8, RGB, as matplotlib's `imshow` and Pillow take it. It is somewhat higher than the
            image, and a small image is enlarged by a whole factor.

        Raises:
            DecodeError: the image cannot be decoded.
        """
        window = self._calibrated.window
        poses = {
            "result": self.T_camera_lidar,
            "start": window.T_camera_lidar_start,
            "nominal": window.rig.T_camera_lidar_nominal,
        }
        if at not in poses:
            raise UsageError(f"at={at!r}: known are {', '.join(poses)}")
        title = f"{self.document.window_id}: {self.verdict.decision if at == 'result' else at}"
        compensated = self.configuration.motion_compensation
        (drawn,) = pictures.overlays(window, [poses[at]], compensated)
        return np.ascontiguousarray(titled(drawn, title)[:, :, ::-1])
