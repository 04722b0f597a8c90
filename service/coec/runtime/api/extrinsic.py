"""The answer to `extrinsic`, made from the state of a pair."""

from __future__ import annotations

import hashlib
from math import degrees
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from coec.adapters.files.conversions import intrinsics_of, number_or_null, transform_of
from coec.calibration.lifecycle import CalibrationStatus, PairState
from coec.calibration.lifecycle.policy import step_between
from coec.calibration.types import Rig, Uncertainty
from coec.geometry import se3
from coec.schemas import replies
from coec.schemas.replies import CalibrationResult

AXES = ("rx", "ry", "rz", "tx", "ty", "tz")
UNITS: tuple[Literal["deg", "m"], ...] = ("deg", "deg", "deg", "m", "m", "m")


def axes_of(result: CalibrationResult | None, status: CalibrationStatus) -> replies.Axes:
    """Correction and standard deviation per axis, of a result or (None) of the nominal calibration."""

    def axis(index: int) -> replies.AxisReply:
        if result is None:
            return replies.AxisReply(status="not_accepted", sigma=None, correction=0.0, unit=UNITS[index])
        return replies.AxisReply(
            status=_axis_status(result, index, status),
            sigma=result.sigma[index],
            correction=result.correction[index],
            unit=UNITS[index],
        )

    return replies.Axes(rx=axis(0), ry=axis(1), rz=axis(2), tx=axis(3), ty=axis(4), tz=axis(5))


def _axis_status(result: CalibrationResult, index: int, status: CalibrationStatus) -> replies.AxisStatus:
    if result.unobservable[index]:
        return "not_observable"
    return status.value if result.solved[index] else "not_solved"


def extrinsic_of(
    vehicle: str,
    rig: Rig,
    state: PairState,
    accepted: CalibrationResult | None,
    percent_complete: float,
    config_hash: str,
) -> replies.ExtrinsicReply:
    """The calibration to use now. `accepted` is `state.accepted` in its wire form; `config_hash` is used while there is
    none."""
    of, cloud = uncertainty_of_served(state), rig.cloud
    return replies.ExtrinsicReply(
        vehicle=vehicle,
        pair=rig.pair,
        camera_frame=rig.camera_frame,
        lidar_frame=rig.lidar_frame,
        camera_from_lidar=transform_of(state.T_camera_lidar),
        cloud_frame=None if cloud is None else cloud.frame_id,
        camera_from_cloud=None
        if cloud is None
        else transform_of(state.T_camera_lidar @ se3.inverse(cloud.T_cloud_lidar)),
        provenance=state.provenance.value,
        status=state.status.value,
        percent_complete=percent_complete,
        axes=axes_of_served(state, rig, accepted),
        correlation_pitch_height=None if of is None else number_or_null(of.pitch_height),
        correlation_yaw_side=None if of is None else number_or_null(of.yaw_side),
        valid_from_ns=state.valid_from_ns,
        data_stamp_ns=accepted.data_stamp_ns if accepted else None,
        window_id=accepted.window_id if accepted else None,
        config_hash=accepted.config_hash if accepted else config_hash,
        pending=candidate_of(state) if state.pending else None,
        held=state.hold is not None,
        hold=hold_of(state),
        intrinsics=intrinsics_of(rig.camera),
    )


def hold_of(state: PairState) -> replies.Hold | None:
    """Who holds the served extrinsic; None if nobody does."""
    hold = state.hold
    if hold is None:
        return None
    return replies.Hold(since_ns=hold.since_ns, sender=hold.sender, reason=hold.reason or None)


def candidate_of(state: PairState) -> replies.Candidate | None:
    """The candidate that waits for `apply`; None if there is none."""
    if state.pending is None:
        return None
    pending = state.pending
    window_id = pending.estimate.window_id
    content = f"{window_id}\n".encode() + pending.T_camera_lidar.astype("<f8").tobytes()
    return replies.Candidate(
        window_id=window_id,
        sha256=hashlib.sha256(content).hexdigest(),
        data_stamp_ns=pending.estimate.data_stamp_ns,
        camera_from_lidar=transform_of(pending.T_camera_lidar),
        step=degrees_and_metres(step_between(state.T_camera_lidar, pending.T_camera_lidar)),
        waits=replies.Reason(code=pending.waits.code, text=pending.waits.text),
    )


def degrees_and_metres(rad_m: NDArray[np.float64]) -> replies.Vector6:
    """(6,) radians and metres in the units of the wire, degrees and metres."""
    a, b, c, x, y, z = (float(value) for value in rad_m)
    return degrees(a), degrees(b), degrees(c), x, y, z


def uncertainty_of_served(state: PairState) -> Uncertainty | None:
    """Uncertainty of what is served: that of the track if it holds more than one window, else that of the accepted
    window. None while nothing was accepted."""
    if state.accepted is None:
        return None
    return state.accepted.uncertainty if state.track is None or state.track.windows <= 1 else state.track.uncertainty


def axes_of_served(state: PairState, rig: Rig, accepted: CalibrationResult | None) -> replies.Axes:
    """Correction and standard deviation per axis of what is served: those of the track if it holds more than one
    window."""
    axes = axes_of(accepted, CalibrationStatus.ACCEPTED)
    if accepted is None or state.track is None or state.track.windows <= 1:
        return axes
    correction = degrees_and_metres(step_between(rig.T_camera_lidar_nominal, state.T_camera_lidar))
    sigma = degrees_and_metres(state.track.uncertainty.sigma)
    updated = {
        name: getattr(axes, name).model_copy(
            update={"correction": correction[index], "sigma": sigma[index] if accepted.solved[index] else None}
        )
        for index, name in enumerate(AXES)
    }
    return replies.Axes(**updated)
