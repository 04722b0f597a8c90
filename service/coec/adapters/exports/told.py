"""Makes the exported extrinsic from results of windows and from replies to `extrinsic`."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import coec
from coec.adapters.exports.extrinsic import AXES, ExportedExtrinsic, ExtrinsicOrigin
from coec.adapters.files.conversions import estimate_of, matrix_of
from coec.adapters.files.rig import intrinsics_config
from coec.config import CameraIntrinsics
from coec.errors import OutputError
from coec.geometry import cameras, se3
from coec.schemas.replies import CalibrationResult, ExtrinsicReply, Intrinsics

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
    origin = ExtrinsicOrigin(
        vehicle=result.vehicle,
        pair=result.pair,
        version=coec.__version__,
        provenance="estimated",
        window_id=result.window_id,
        data_stamp_ns=result.data_stamp_ns,
        config_hash=result.config_hash,
        rejection_reasons=() if result.verdict.decision == "accepted" else reasons or ("Its verdict is negative.",),
    )
    return between_frames(
        matrix_of(result.camera_from_lidar),
        estimate_of(result).uncertainty.covariance,
        (result.lidar_frame, result.camera_frame),
        frames,
        intrinsics_config_of(result.intrinsics) if camera is None else camera,
        origin,
    )


def extrinsic_of_reply(
    reply: ExtrinsicReply, camera: CameraIntrinsics | None, frames: ExportFrames
) -> ExportedExtrinsic:
    """The extrinsic that a service serves, with the part of its covariance that a reply holds: σ of each axis and two
    correlations. The only possible objection is that it is still the nominal calibration. `camera` None: the intrinsics
    that the reply holds."""
    served = reply.provenance != "nominal"
    origin = ExtrinsicOrigin(
        vehicle=reply.vehicle,
        pair=reply.pair,
        version=coec.__version__,
        provenance=reply.provenance,
        window_id=reply.window_id,
        data_stamp_ns=reply.data_stamp_ns,
        config_hash=reply.config_hash,
        rejection_reasons=() if served else (NOMINAL,),
    )
    return between_frames(
        matrix_of(reply.camera_from_lidar),
        _reply_covariance(reply),
        (reply.lidar_frame, reply.camera_frame),
        frames,
        intrinsics_config_of(reply.intrinsics) if camera is None else camera,
        origin,
    )


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
