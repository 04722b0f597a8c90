"""A look of the monitor on its way to the worker and back: pairs as their frames, figures as plain values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from coec.adapters.msgpack_frames import (
    decode_camera,
    decode_ego,
    decode_lidar,
    encode_camera,
    encode_ego,
    encode_lidar,
)
from coec.calibration.causes import Cause
from coec.calibration.monitor import Observation
from coec.calibration.values import FramePair, Matrix4, Metric
from coec.config import LimitsConfig


def pack_pairs(pairs: Sequence[FramePair]) -> list[list[bytes | None]]:
    """Camera, LiDAR and ego-motion frame of each pair, native msgpack."""
    return [[encode_camera(p.camera), encode_lidar(p.lidar), encode_ego(p.motion) if p.motion else None] for p in pairs]


def unpack_pairs(frames: Sequence[Sequence[bytes | None]], limits: LimitsConfig) -> tuple[FramePair, ...]:
    """The pairs that `pack_pairs` packed.

    Raises:
        DecodeError: a frame cannot be decoded.
    """
    return tuple(
        FramePair(
            decode_camera(camera or b"", limits),
            decode_lidar(lidar or b"", limits),
            decode_ego(motion, limits) if motion else None,
        )
        for camera, lidar, motion in frames
    )


def pack_pose(T: Matrix4) -> list[list[float]]:
    """A transform (4, 4) as rows."""
    rows: list[list[float]] = T.tolist()
    return rows


def pack_observation(observation: Observation) -> dict[str, Any]:
    """Every field in values that msgpack knows; doubles stay the same doubles."""
    return {
        "stamp_ns": observation.stamp_ns,
        "pair_stamps_ns": list(observation.pair_stamps_ns),
        "metrics": [[m.name, float(m.value), float(m.limit), bool(m.at_least)] for m in observation.metrics],
        "offset": [float(value) for value in observation.offset],
        "sigma": [float(value) for value in observation.sigma],
        "distance2": float(observation.distance2),
        "flagged": bool(observation.flagged),
        "weak": bool(observation.weak),
        "flagged_by_paper": None if observation.flagged_by_paper is None else bool(observation.flagged_by_paper),
        "causes": [[cause.code, cause.text] for cause in observation.causes],
    }


def unpack_observation(values: Mapping[str, Any]) -> Observation:
    """The observation that `pack_observation` packed."""
    return Observation(
        stamp_ns=values["stamp_ns"],
        pair_stamps_ns=tuple(values["pair_stamps_ns"]),
        metrics=tuple(Metric(name, value, limit, at_least) for name, value, limit, at_least in values["metrics"]),
        offset=np.array(values["offset"], dtype=np.float64),
        sigma=np.array(values["sigma"], dtype=np.float64),
        distance2=values["distance2"],
        flagged=values["flagged"],
        weak=values["weak"],
        flagged_by_paper=values["flagged_by_paper"],
        causes=tuple(Cause(code, text) for code, text in values["causes"]),
    )
