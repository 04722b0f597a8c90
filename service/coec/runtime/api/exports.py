"""The served extrinsic of a pair in the form that exports need."""

from __future__ import annotations

import numpy as np

import coec
from coec.adapters.exports.extrinsic import ExportedExtrinsic, ExtrinsicOrigin
from coec.adapters.exports.told import NOMINAL, ExportFrames, between_frames
from coec.calibration.lifecycle import PairState, Provenance
from coec.config import CameraIntrinsics
from coec.runtime.api.extrinsic import uncertainty_of_served


def exported(
    state: PairState,
    vehicle: str,
    pair: str,
    own: tuple[str, str],
    camera: CameraIntrinsics | None,
    frames: ExportFrames,
) -> ExportedExtrinsic:
    """The extrinsic of a state with its whole covariance; `own` are the frames of the LiDAR and the camera. The only
    possible objection to it is that it is still the nominal calibration."""
    accepted, uncertainty = state.accepted, uncertainty_of_served(state)
    origin = ExtrinsicOrigin(
        vehicle=vehicle,
        pair=pair,
        version=coec.__version__,
        provenance=state.provenance.value,
        window_id=None if accepted is None else accepted.window_id,
        data_stamp_ns=None if accepted is None else accepted.data_stamp_ns,
        config_hash=None if accepted is None else accepted.config_hash,
        rejection_reasons=(NOMINAL,) if state.provenance is Provenance.NOMINAL else (),
    )
    covariance = np.full((6, 6), np.nan) if uncertainty is None else uncertainty.covariance
    return between_frames(state.T_camera_lidar, covariance, own, frames, camera, origin)
