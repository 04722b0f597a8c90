"""What a question to the worker carries, in values that msgpack knows: pairs as their frames, poses as rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import overload

from coec.adapters.frames.msgpack_frames import (
    decode_camera,
    decode_ego,
    decode_lidar,
    encode_camera,
    encode_ego,
    encode_lidar,
)
from coec.calibration.types import FramePair, Matrix4
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
