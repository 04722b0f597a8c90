"""What a calibration says, and what is done with it, for a program that imports coec."""

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
"""At which of its poses a window is drawn."""


class Result:
    """What one window says of where the camera is. Arrays are copies: to change one changes nothing else."""

    def __init__(self, calibrated: Calibrated) -> None:
        self._calibrated = calibrated
        self._document = calibrated.result

    def __repr__(self) -> str:
        reasons = "".join(f", {reason.code}" for reason in self.reasons)
        return f"<coec.Result {self.document.window_id}: {self.verdict.decision}{reasons}>"

    @property
    def document(self) -> CalibrationResult:
        """Everything, as a pydantic model: what `coec calibrate --json` prints, but for how long it took."""
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
        """(6,) rx ry rz (degrees) and tx ty tz (metres) from the recording's own calibration, about and along the
        camera axes: T_camera_lidar = exp(correction)·T_nominal."""
        return np.array(self.document.correction)

    @property
    def sigma(self) -> NDArray[np.float64]:
        """(6,) standard deviations of the same, degrees and metres; NaN where an axis was not estimated."""
        return np.array([np.nan if value is None else value for value in self.document.sigma])

    @property
    def covariance(self) -> NDArray[np.float64]:
        """(6, 6) of the error about and along the camera axes, radians and metres: the true transform is
        exp(error)·T_camera_lidar. NaN where an axis was not estimated."""
        return self._calibrated.estimate.uncertainty.covariance.copy()

    @property
    def accepted(self) -> bool:
        """Whether the self-diagnosis stands by the result."""
        return self.document.verdict.decision == "accepted"

    @property
    def verdict(self) -> Verdict:
        """The decision (`accepted` or `failed`), and the reasons."""
        return self.document.verdict

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Why it is not accepted: machine-readable codes, and a sentence each; empty where it is."""
        return self.document.verdict.reasons

    @property
    def figures(self) -> dict[str, MetricReply]:
        """The figures of the self-diagnosis by name, each with its limit and whether it keeps it."""
        return dict(self.document.metrics)

    @property
    def configuration(self) -> CalibrationConfig:
        """What decided the result. Give it to another `calibrate` to have the same again."""
        return self._calibrated.configuration

    @property
    def camera_fit(self) -> CameraFit | None:
        """How well `camera_model` fits the recording's camera; None where none was asked for."""
        return self._calibrated.fit

    @property
    def time_offset(self) -> TimeOffset | None:
        """Offset of the camera's clock, s; None unless `time_offset=True`."""
        return self._calibrated.offset

    def to_json(self) -> str:
        """Canonical JSON of `document`: equal results give equal bytes. `coec export` reads it, and its schema is
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
        """Writes the result into a file of another program, at once or not at all. Of a file that holds other
        transforms (URDF, Autoware's YAML and the like), this one alone is changed.

        Args:
            path: the file; its folder is made if need be.
            format: `tf`, `urdf`, `autoware`, `kalibr`, `kitti`, `kitti360`, `nuscenes`, `openlabel`, `colmap`,
                `opencv` or `json`. Which direction each holds is written in the file.
            parent: name of the frame; None: the LiDAR's.
            child: likewise; None: the camera's.
            T_parent_lidar: (4, 4) pose of the LiDAR in `parent`, metres; None: the LiDAR is the parent.
            force: also write what is not accepted; the file says so.

        Returns:
            The file.

        Raises:
            NotAcceptedError: the verdict is negative, and `force` was not given.
            UsageError: no such format, or `T_parent_lidar` is no (4, 4) array of finite numbers.
            OutputError: the file cannot be written, or what it holds cannot be changed.
            SourceError: the file that is there cannot be read.
        """
        pose = None if T_parent_lidar is None else np.array(T_parent_lidar, dtype=np.float64)
        if pose is not None and (pose.shape != (4, 4) or not np.isfinite(pose).all()):
            raise UsageError(f"T_parent_lidar: (4, 4) finite numbers are expected, these are {pose.shape}")
        camera = intrinsics_config(self._calibrated.window.rig.camera)
        extrinsic = of_result(self.document, camera, Frames(parent, child, pose))
        accepted(extrinsic, self.document.window_id, "force=True", force=force)
        place = Path(fspath(path))
        output.replace(place, text_of(extrinsic, format, place).encode())
        return place

    def overlay(self, at: Pose = "result") -> NDArray[np.uint8]:
        """The middle frame of the window with the points of its sweep, coloured by range.

        Args:
            at: the pose at which they are drawn: `result`, `start` (where the search began), or `nominal` (the
                recording's own calibration).

        Returns:
            (height, width, 3) uint8, RGB, as matplotlib's `imshow` and Pillow take it; somewhat higher than the image,
            and a whole factor larger where that is small.

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
