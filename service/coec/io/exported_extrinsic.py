"""What every export writes (`io.exports`): a transform between two named frames, its uncertainty and its origin, made
from a window's result or from a reply to `extrinsic`.
"""

import math
import re
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

import coec
from coec.calibration.types import NS_PER_S
from coec.config import CameraIntrinsics
from coec.errors import NotAcceptedError, OutputError
from coec.geometry import cameras, se3
from coec.io.rig_files import camera_of, intrinsics_config
from coec.io.serialise import estimate_of, intrinsics_of, matrix_of, number_or_null
from coec.schemas.replies import AXES, CalibrationResult, ExtrinsicReply, Intrinsics

Matrix = NDArray[np.float64]


REFUSED = "REFUSED - do not use"
"""Stands above every pose of a refused result that can be copied."""


@dataclass(frozen=True, slots=True)
class ExtrinsicOrigin:
    """Where an extrinsic comes from.

    Attributes:
        version: of coec.
        provenance: `nominal`, `commissioned`, `estimated` or `restored`.
        window_id, data_stamp_ns, config_hash: of the window that it rests on; None if there is none.
        rejection_reasons: why it is not accepted, one sentence each; empty if it is accepted.
    """

    vehicle: str
    pair: str
    version: str
    provenance: str
    window_id: str | None
    data_stamp_ns: int | None
    config_hash: str | None
    rejection_reasons: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ExportedExtrinsic:
    """A camera's pose, ready to be written.

    Attributes:
        T_camera_lidar: (4, 4) maps LiDAR (x forward, y left, z up) to optical camera coordinates (x right, y down, z
            forward), metres.
        covariance: (6, 6) of its error about and along the camera axes, radians and metres: the true transform is
            exp(error)·T_camera_lidar. NaN for entries that are not known.
        parent, child: names of the frames; the child is the camera.
        T_parent_lidar: (4, 4) pose of the LiDAR in the parent; identity if the parent is the LiDAR.
        camera: intrinsics; None if they are not known.
        origin: see `ExtrinsicOrigin`.
    """

    T_camera_lidar: Matrix
    covariance: Matrix
    parent: str
    child: str
    T_parent_lidar: Matrix
    camera: CameraIntrinsics | None
    origin: ExtrinsicOrigin

    @property
    def T_child_parent(self) -> Matrix:
        """(4, 4) maps coordinates in the parent to optical camera coordinates."""
        return self.T_camera_lidar @ se3.inverse(self.T_parent_lidar)

    @property
    def T_parent_child(self) -> Matrix:
        """(4, 4) pose of the optical camera frame in the parent: what tf, URDF and most formats hold."""
        return self.T_parent_lidar @ se3.inverse(self.T_camera_lidar)

    @property
    def T_parent_body(self) -> Matrix:
        """(4, 4) pose in the parent of the camera's body frame (x forward, y left, z up; REP 103)."""
        return self.T_parent_child @ T_OPTICAL_BODY

    @property
    def intrinsics(self) -> Intrinsics | None:
        """Those of `camera`, with their hash: the pose holds for them alone."""
        return None if self.camera is None else intrinsics_of(camera_of(self.camera))

    def remarks(self, direction: str) -> list[str]:
        """Comment lines for a file: the direction of its numbers in words, their uncertainty and their origin."""
        origin = self.origin
        lines = [
            *self._objection_lines(),
            f"{origin.pair} of {origin.vehicle}: {origin.provenance}, by coec {origin.version}",
            direction,
            self._sigma_line(),
            f"covariance of the error (rad, m; about the camera axes, row by row): {_numbers(self.covariance.ravel())}",
            *self._intrinsics_lines(),
        ]
        if origin.window_id is not None:
            lines.append(
                f"window {origin.window_id}, data until {utc(origin.data_stamp_ns)}, configuration {origin.config_hash}"
            )
        return [_one_line(line) for line in lines]

    def document(self, direction: str) -> dict[str, object]:
        """The same facts as JSON values, for formats without comments."""
        origin = self.origin
        return {
            "direction": direction,
            "accepted": not origin.rejection_reasons,
            "objections": list(origin.rejection_reasons),
            "covariance_rad_m": [[number_or_null(value) for value in row] for row in self.covariance.tolist()],
            "vehicle": origin.vehicle,
            "pair": origin.pair,
            "provenance": origin.provenance,
            "intrinsics": None if self.intrinsics is None else self.intrinsics.model_dump(mode="json"),
            "window_id": origin.window_id,
            "data_stamp_ns": origin.data_stamp_ns,
            "config_hash": origin.config_hash,
            "version": origin.version,
        }

    def _objection_lines(self) -> list[str]:
        """Why it must not be used, in the first line; nothing for an accepted extrinsic."""
        reasons = self.origin.rejection_reasons
        if not reasons:
            return []
        refused = "" if self.origin.provenance == "nominal" else f"{REFUSED}. "
        return [f"{refused}NOT ACCEPTED, exported by force: {' '.join(reasons)}"]

    def _intrinsics_lines(self) -> list[str]:
        """The intrinsics to which the pose belongs; nothing if they are not known."""
        lens = self.intrinsics
        if lens is None:
            return []
        parameters = " ".join(f"{name} {value!r}" for name, value in lens.parameters.items())
        return [
            f"holds with the intrinsics {lens.model} {lens.width} x {lens.height} {parameters}; sha256 {lens.sha256}"
        ]

    def _sigma_line(self) -> str:
        sigma = np.sqrt(self.covariance.diagonal())
        axis_texts = [
            f"{name} {np.degrees(value):.4f} deg" if axis < 3 else f"{name} {value:.4f} m"
            for axis, (name, value) in enumerate(zip(AXES, sigma.tolist(), strict=True))
            if math.isfinite(value)
        ]
        return f"sigma about the camera axes: {', '.join(axis_texts)}" if axis_texts else "sigma: not known"


T_OPTICAL_BODY: Matrix = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""Maps body coordinates (x forward, y left, z up) to optical ones (x right, y down, z forward): REP 103."""


def utc(stamp_ns: int | None) -> str:
    """A stamp for people."""
    if stamp_ns is None:
        return "an unknown time"
    return datetime.fromtimestamp(stamp_ns // NS_PER_S, tz=UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def _one_line(text: str) -> str:
    """The text in one line and in ASCII, so that a comment with it cannot end early and every reader accepts it."""
    return " ".join(text.split()).encode("ascii", "replace").decode()


def _numbers(values: Matrix) -> str:
    return " ".join("?" if math.isnan(value) else f"{value:.6g}" for value in values.tolist())


FRAME = re.compile(r"[A-Za-z_][A-Za-z0-9_./-]{0,127}")
"""Frame names that are safe in XML, YAML, JSON and a shell."""

NOMINAL = "It is the nominal calibration: nothing has been accepted yet."

PITCH_HEIGHT, YAW_SIDE = (0, 4), (1, 3)
"""Axes of the two correlations in a reply."""


@dataclass(frozen=True, slots=True, eq=False)
class ExportFrames:
    """The frames between which a transform is written; None: the pair's own frames.

    Attributes:
        T_parent_lidar: (4, 4) pose of the LiDAR in the parent; None: the parent is the LiDAR.
    """

    parent: str | None = None
    child: str | None = None
    T_parent_lidar: NDArray[np.float64] | None = None


def extrinsic_of_result(
    result: CalibrationResult, camera: CameraIntrinsics | None, frames: ExportFrames
) -> ExportedExtrinsic:
    """A window's result, with its whole covariance; the reasons of a negative verdict become the objections. `camera`
    None: the intrinsics that the result holds."""
    reasons = tuple(reason.text for reason in result.verdict.reasons)
    rejection_reasons = () if result.verdict.decision == "accepted" else reasons or ("Its verdict is negative.",)
    covariance = estimate_of(result).uncertainty.covariance
    return _exported(result, "estimated", covariance, rejection_reasons, camera, frames)


def extrinsic_of_reply(
    reply: ExtrinsicReply, camera: CameraIntrinsics | None, frames: ExportFrames
) -> ExportedExtrinsic:
    """The extrinsic that a service serves, with the part of its covariance that a reply holds: σ of each axis and two
    correlations. The only possible objection is that it is still the nominal calibration. `camera` None: the intrinsics
    that the reply holds."""
    rejection_reasons = (NOMINAL,) if reply.provenance == "nominal" else ()
    return _exported(reply, reply.provenance, _reply_covariance(reply), rejection_reasons, camera, frames)


def _exported(
    value: CalibrationResult | ExtrinsicReply,
    provenance: str,
    covariance: NDArray[np.float64],
    rejection_reasons: tuple[str, ...],
    camera: CameraIntrinsics | None,
    frames: ExportFrames,
) -> ExportedExtrinsic:
    origin = ExtrinsicOrigin(
        vehicle=value.vehicle,
        pair=value.pair,
        version=coec.__version__,
        provenance=provenance,
        window_id=value.window_id,
        data_stamp_ns=value.data_stamp_ns,
        config_hash=value.config_hash,
        rejection_reasons=rejection_reasons,
    )
    own = (value.lidar_frame, value.camera_frame)
    intrinsics = intrinsics_config_of(value.intrinsics) if camera is None else camera
    return between_frames(matrix_of(value.camera_from_lidar), covariance, own, frames, intrinsics, origin)


def intrinsics_config_of(intrinsics: Intrinsics | None) -> CameraIntrinsics | None:
    """The intrinsics of a result or a reply; None if it holds none, or no camera that this version has."""
    if intrinsics is None:
        return None
    parameters = {**intrinsics.parameters, "width": intrinsics.width, "height": intrinsics.height}
    try:
        return intrinsics_config(cameras.build(intrinsics.model, **parameters))
    except ValueError:
        return None


def between_frames(
    T_camera_lidar: NDArray[np.float64],
    covariance: NDArray[np.float64],
    own: tuple[str, str],
    frames: ExportFrames,
    camera: CameraIntrinsics | None,
    origin: ExtrinsicOrigin,
) -> ExportedExtrinsic:
    """An extrinsic between the requested frames, by default its own (LiDAR, camera).

    Raises:
        OutputError: a frame has a name that some format cannot hold.
    """
    for name in (frames.parent or own[0], frames.child or own[1]):
        if not FRAME.fullmatch(name):
            raise OutputError(f"{name[:64]!a} names no frame: letters, digits and _ . / - are known to all formats")
    return ExportedExtrinsic(
        T_camera_lidar=T_camera_lidar,
        covariance=covariance,
        parent=frames.parent or own[0],
        child=frames.child or own[1],
        T_parent_lidar=np.eye(4) if frames.T_parent_lidar is None else frames.T_parent_lidar,
        camera=camera,
        origin=origin,
    )


def _reply_covariance(reply: ExtrinsicReply) -> NDArray[np.float64]:
    axes = [getattr(reply.axes, name) for name in AXES]
    sigma = np.array(
        [math.nan if axis.sigma is None else axis.sigma * (math.pi / 180 if axis.unit == "deg" else 1) for axis in axes]
    )
    covariance = np.full((6, 6), np.nan)
    covariance[np.diag_indices(6)] = sigma**2
    correlations = {PITCH_HEIGHT: reply.correlation_pitch_height, YAW_SIDE: reply.correlation_yaw_side}
    for (one, other), correlation in correlations.items():
        if correlation is not None:
            covariance[one, other] = covariance[other, one] = correlation * sigma[one] * sigma[other]
    return covariance


def parse_pose(text: str) -> NDArray[np.float64]:
    """(4, 4) from ``x,y,z,qx,qy,qz,qw``: metres, and a quaternion of any length.

    Raises:
        ValueError: not seven finite numbers, or a quaternion of length zero.
    """
    values = [float(item) for item in text.split(",")]
    if len(values) != 7 or not all(math.isfinite(value) for value in values):
        raise ValueError("seven finite numbers are expected: x,y,z,qx,qy,qz,qw")
    return se3.transform_from(se3.rotation_from_quaternion_xyzw(np.array(values[3:])), np.array(values[:3]))


def require_accepted(extrinsic: ExportedExtrinsic, name: str, override: str, *, force: bool) -> None:
    """Returns if the extrinsic may be written. `name` (of the calibration) and `override` (the option that forces
    the export) appear in the error message.

    Raises:
        NotAcceptedError: its verdict is negative, and `force` is False.
    """
    if extrinsic.origin.rejection_reasons and not force:
        raise NotAcceptedError(
            f"{name}: not accepted: {' '.join(extrinsic.origin.rejection_reasons)} "
            f"`{override}` exports it all the same, and says so in the file."
        )
