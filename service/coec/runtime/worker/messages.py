"""Packs the contents of questions to the worker into values that msgpack knows: pairs as frames, poses as rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, TypeVar, overload

import numpy as np

from coec.adapters.frames.msgpack_frames import (
    decode_camera,
    decode_ego,
    decode_lidar,
    encode_camera,
    encode_ego,
    encode_lidar,
)
from coec.calibration.lidar_to_lidar.types import LidarRig, SweepPair
from coec.calibration.types import FramePair, Matrix4, SweepTiming
from coec.config import LimitsConfig

T = TypeVar("T")


def pack_pairs(pairs: Sequence[FramePair]) -> Sequence[list[bytes | None]]:
    """Camera, LiDAR and ego-motion frame of each pair in native msgpack. Each entry is packed whenever it is read,
    because the pairs of a check have 15 MB and need not be in memory twice."""
    return _PackedLazily(pairs, _pair)


def pack_sweeps(pairs: Sequence[SweepPair]) -> Sequence[list[bytes | None]]:
    """The same for sweeps of two LiDARs."""
    return _PackedLazily(pairs, _sweeps)


def _pair(pair: FramePair) -> list[bytes | None]:
    return [encode_camera(pair.camera), encode_lidar(pair.lidar), encode_ego(pair.motion) if pair.motion else None]


def _sweeps(pair: SweepPair) -> list[bytes | None]:
    return [encode_lidar(pair.a), encode_lidar(pair.b), encode_ego(pair.motion) if pair.motion else None]


class _PackedLazily(Sequence[list[bytes | None]], Generic[T]):
    def __init__(self, pairs: Sequence[T], pack: Callable[[T], list[bytes | None]]) -> None:
        self._pairs = tuple(pairs)
        self._pack = pack

    def __len__(self) -> int:
        return len(self._pairs)

    @overload
    def __getitem__(self, index: int) -> list[bytes | None]: ...
    @overload
    def __getitem__(self, index: slice) -> _PackedLazily[T]: ...
    def __getitem__(self, index: int | slice) -> list[bytes | None] | _PackedLazily[T]:
        if isinstance(index, slice):
            return _PackedLazily(self._pairs[index], self._pack)
        return self._pack(self._pairs[index])


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


def unpack_sweeps(frames: Sequence[Sequence[bytes | None]], limits: LimitsConfig) -> tuple[SweepPair, ...]:
    """The pairs that `pack_sweeps` packed.

    Raises:
        DecodeError: a frame cannot be decoded.
    """
    return tuple(
        SweepPair(
            decode_lidar(a or b"", limits),
            decode_lidar(b or b"", limits),
            decode_ego(motion, limits) if motion else None,
        )
        for a, b, motion in frames
    )


def pack_lidars(rig: LidarRig) -> dict[str, Any]:
    """Two LiDARs as they were mounted."""
    return {
        "a": rig.a,
        "b": rig.b,
        "T_a_b": pack_pose(rig.T_a_b_nominal),
        "T_a_ego": pack_pose(rig.T_a_ego),
        "sweep_a": _packed_timing(rig.sweep_a),
        "sweep_b": _packed_timing(rig.sweep_b),
    }


def unpack_lidars(packed: Mapping[str, Any]) -> LidarRig:
    """What `pack_lidars` packed."""
    return LidarRig(
        packed["a"],
        packed["b"],
        np.array(packed["T_a_b"], dtype=np.float64),
        np.array(packed["T_a_ego"], dtype=np.float64),
        *(None if packed[name] is None else SweepTiming(*packed[name]) for name in ("sweep_a", "sweep_b")),
    )


def _packed_timing(timing: SweepTiming | None) -> list[float] | None:
    return None if timing is None else [timing.period_s, timing.sign, timing.stamp_azimuth_rad]


def pack_pose(T: Matrix4) -> list[list[float]]:
    """A transform (4, 4) as rows."""
    rows: list[list[float]] = T.tolist()
    return rows
