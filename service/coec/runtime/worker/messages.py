"""A check of the monitor on its way to the worker and back: pairs as their frames, figures as plain values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from coec.adapters.frames.msgpack_frames import (
    decode_camera,
    decode_ego,
    decode_lidar,
    encode_camera,
    encode_ego,
    encode_lidar,
)
from coec.calibration.commissioning.baseline import Drift
from coec.calibration.monitor.change_detector import Observation
from coec.calibration.monitor.sensor_faults import Cause
from coec.calibration.types import FramePair, Matrix4, Metric
from coec.config import LimitsConfig


def pack_pairs(pairs: Sequence[FramePair]) -> Sequence[list[bytes | None]]:
    """Camera, LiDAR and ego-motion frame of each pair, native msgpack, packed anew whenever an entry is asked for: the
    pairs of a check have 15 MB, and need not be in memory twice."""
    return _PackedPairs(pairs)


class _PackedPairs(Sequence[list[bytes | None]]):
    def __init__(self, pairs: Sequence[FramePair]) -> None:
        self._pairs = tuple(pairs)

    def __len__(self) -> int:
        return len(self._pairs)

    @overload
    def __getitem__(self, index: int) -> list[bytes | None]: ...
    @overload
    def __getitem__(self, index: slice) -> _PackedPairs: ...
    def __getitem__(self, index: int | slice) -> list[bytes | None] | _PackedPairs:
        if isinstance(index, slice):
            return _PackedPairs(self._pairs[index])
        pair = self._pairs[index]
        motion = encode_ego(pair.motion) if pair.motion else None
        return [encode_camera(pair.camera), encode_lidar(pair.lidar), motion]


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
    drift = observation.drift
    return {
        "stamp_ns": observation.stamp_ns,
        "pair_stamps_ns": list(observation.pair_stamps_ns),
        "metrics": [[m.name, float(m.value), float(m.limit), bool(m.at_least)] for m in observation.metrics],
        "offset": _floats(observation.offset),
        "sigma": _floats(observation.sigma),
        "distance2": float(observation.distance2),
        "flagged": bool(observation.flagged),
        "weak": bool(observation.weak),
        "flagged_by_paper": None if observation.flagged_by_paper is None else bool(observation.flagged_by_paper),
        "causes": [[cause.code, cause.text] for cause in observation.causes],
        "first_derivative": _floats(observation.first_derivative),
        "second_derivative": _floats(observation.second_derivative),
        "dirty": list(observation.dirty),
        "textured": observation.textured,
        "drift": None if drift is None else [_floats(drift.value), _floats(drift.sigma)],
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
        first_derivative=np.array(values["first_derivative"], dtype=np.float64),
        second_derivative=np.array(values["second_derivative"], dtype=np.float64),
        dirty=tuple(values["dirty"]),
        textured=values["textured"],
        drift=None if values["drift"] is None else Drift(*(np.array(v, dtype=np.float64) for v in values["drift"])),
    )


def _floats(values: NDArray[np.float64]) -> list[float]:
    return [float(value) for value in values]
