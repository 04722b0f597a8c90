"""The content of a window, collected from its records one after the other."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from pydantic import ValidationError

from coec.adapters.mcap.files import Channel, McapAttachment, McapMessage, Metadata, Record, Schema
from coec.adapters.mcap.windows import rig_attachment
from coec.adapters.mcap.windows.names import (
    CARRIED_OVER,
    CONFIGURATION,
    DEPTH,
    MASK,
    METADATA,
    OVERLAY,
    RIG,
    is_between,
)
from coec.adapters.ros import incoming, messages
from coec.adapters.ros.point_cloud2 import WRITTEN_TIME
from coec.calibration.types import CameraFrame, EgoMotion, FramePair, LidarFrame, Matrix4, Rig
from coec.config import CalibrationConfig, LimitsConfig, describe
from coec.errors import DecodeError, WindowError

_LIMITS = LimitsConfig(max_message_bytes=2**30, max_image_pixels=2**30, max_points=2**30)
"""Wide limits, because the frames passed those of the recording daemon, which may be wider than the defaults. Their
bytes are in memory already, images are not decoded here, and `reading.MAX_UNPACKED` bounds the whole."""

_FRAME_TYPES = (messages.COMPRESSED_IMAGE, messages.IMAGE, messages.POINT_CLOUD, messages.ODOMETRY, messages.IMU)


class PairKey(NamedTuple):
    """The index of a pair in writing order: among the pairs of the window, or among the thinned pairs between them."""

    between: bool
    order: int


@dataclass(slots=True)
class _Parts:
    """The parts of one pair that have been read so far."""

    camera: CameraFrame | None = None
    lidar: LidarFrame | None = None
    motion: EgoMotion | None = None
    depth: CameraFrame | None = None


@dataclass(slots=True)
class WindowContent:
    """What has been read of a window so far.

    Attributes:
        attachments: by name.
        metadata: what the window is.
        kept: which other window it holds pairs of; empty: none.
    """

    attachments: dict[str, bytes] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)
    carried_over: dict[str, str] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    parts: dict[PairKey, _Parts] = field(default_factory=dict)

    def add(self, record: Record) -> PairKey | None:
        """Adds a record. Returns the place of the pair that it completes; None if it completes none."""
        match record:
            case Schema():
                self.schemas[record.schema_id] = record
            case Channel():
                self.channels[record.channel_id] = record
            case McapAttachment():
                self.attachments[record.name] = record.data
            case Metadata() if record.name == METADATA:
                self.metadata = record.values
            case Metadata() if record.name == CARRIED_OVER:
                self.carried_over = record.values
            case McapMessage():
                return self._add_message(record)
        return None

    def head(self, path: Path) -> tuple[Rig, Matrix4, str]:
        """Rig, extrinsic at the start and window id."""
        if RIG not in self.attachments:
            raise WindowError(f"{path} is not a recorded window: it has no attachment {RIG}")
        return rig_attachment.decode_rig(path, self.attachments[RIG], self.attachments.get(MASK))

    def parsed_configuration(self, path: Path) -> CalibrationConfig:
        """The configuration of the window."""
        if CONFIGURATION not in self.attachments:
            raise WindowError(f"{path} is not a recorded window: it has no attachment {CONFIGURATION}")
        try:
            return CalibrationConfig.model_validate_json(self.attachments[CONFIGURATION])
        except ValidationError as error:
            raise WindowError(f"{path}: {CONFIGURATION}: {describe(error)}") from error

    def pair(self, path: Path, key: PairKey) -> FramePair:
        """Removes and returns the pair at a place."""
        parts = self.parts.pop(key)
        if parts.camera is None or parts.lidar is None:
            named = f"{'thinned ' if key.between else ''}pair {key.order}"
            raise WindowError(f"{path}: {named} lacks its {'sweep' if parts.lidar is None else 'image'}")
        camera = parts.camera
        if parts.depth is not None:
            camera = CameraFrame(camera.stamp_ns, camera.frame_id, camera.image, depth=parts.depth.image)
        return FramePair(camera, parts.lidar, parts.motion)

    def _add_message(self, message: McapMessage) -> PairKey | None:
        channel = self.channels.get(message.channel_id)
        schema = None if channel is None else self.schemas.get(channel.schema_id)
        if channel is None or schema is None or schema.name not in _FRAME_TYPES:
            return None
        if channel.topic.endswith(f"/{OVERLAY}"):
            return None
        try:
            frame = incoming.decode(schema.name, message.data, _LIMITS, point_time=WRITTEN_TIME)
        except DecodeError as error:
            raise WindowError(f"a message on {channel.topic} cannot be decoded: {error}") from error
        key = PairKey(is_between(channel.topic), message.sequence)
        parts = self.parts.setdefault(key, _Parts())
        match frame:
            case LidarFrame():
                parts.lidar = frame
            case EgoMotion():
                parts.motion = frame
            case CameraFrame() if channel.topic.endswith(f"/{DEPTH}"):
                parts.depth = frame
            case CameraFrame():
                parts.camera = frame
                return key
        return None
