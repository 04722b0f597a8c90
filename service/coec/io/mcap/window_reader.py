"""Reads windows, one MCAP file each: completely, pair by pair, or only their result; the names of window files and of
what they contain; and the attachment with the rig.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import BaseModel, ConfigDict, ValidationError

from coec.calibration.types import MOUNT_RAD, CameraFrame, EgoMotion, FramePair, LidarFrame, Matrix4, Rig, Window
from coec.config import CalibrationConfig, LimitsConfig, Matrix4x4, describe
from coec.errors import ConfigError, DecodeError, SourceError, WindowError
from coec.io.mcap import reader
from coec.io.mcap.writer import CHUNK_BYTES
from coec.io.rig_files import matrix_rows, rig_from_json, rig_to_json, rigid_matrix
from coec.io.ros import message_decoding, messages
from coec.io.ros.point_clouds import WRITTEN_TIME
from coec.schemas.message import from_json, to_json
from coec.schemas.replies import CalibrationResult

SUFFIX = ".mcap"
PART_SUFFIX = ".part"
"""Suffix of a window that is being recorded. A file with it that is found at start can be salvaged."""

REWRITE_SUFFIX = ".tmp"
"""Suffix of a finished window that is being rewritten. A file with it that is found at start is useless, because the
original is still there."""

RIG, CONFIGURATION, MASK, RESULT = "rig.json", "configuration.json", "mask.png", "result.json"
"""Attachments."""

JSON = "application/json"

METADATA, CARRIED_OVER = "coec", "coec_kept"
"""Metadata records: what the window is, and which other window it holds pairs of."""

PACKING, LZ4 = "packing", "lz4"
"""Entry of the metadata: compression of the chunks that shrink; empty: none. Rewriting a window keeps it."""

IMAGE, COMPRESSED, DEPTH = "camera/image", "camera/image/compressed", "camera/depth/compressed"
POINTS, CAMERA_INFO, RESULT_TOPIC, OVERLAY = "lidar/points", "camera/camera_info", "result", "overlay"
ODOMETRY, IMU = "odometry", "imu"
"""Topics below `/coec/<pair>/`."""

BETWEEN = "between/"
"""Below it are the topics for sweep, ego-motion and image of the thinned pairs."""

BETWEEN_IMAGE = BETWEEN + "image/compressed"
"""The images of thinned pairs are compressed, whatever the camera sends."""


def topic(pair: str, name: str) -> str:
    """The full topic of a pair for one of these names."""
    return f"/coec/{pair}/{name}"


def is_between(topic: str) -> bool:
    """Whether a topic belongs to the thinned pairs. Only the fourth part counts, as a pair may have any name."""
    return topic.split("/")[3:4] == [BETWEEN.rstrip("/")]


def with_suffix(path: Path, suffix: str) -> Path:
    """The path with a suffix added to the file name."""
    return path.with_name(path.name + suffix)


class _RigAttachment(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    schema_version: int = 1
    window_id: str
    T_camera_lidar_start: Matrix4x4
    rig: dict[str, Any]


def encode_rig(rig: Rig, T_camera_lidar_start: Matrix4, window_id: str) -> bytes:
    """The attachment, without the rig's mask, which is a separate one."""
    start = matrix_rows(T_camera_lidar_start)
    return to_json(_RigAttachment(window_id=window_id, T_camera_lidar_start=start, rig=rig_to_json(rig)))


def decode_rig(path: Path, data: bytes, mask_png: bytes | None) -> tuple[Rig, Matrix4, str]:
    """Rig, extrinsic at the start (4, 4) and window id of the window at `path`.

    Raises:
        WindowError: the attachment is not valid.
    """
    try:
        document = _RigAttachment.model_validate_json(data)
        T_camera_lidar_start = rigid_matrix(document.T_camera_lidar_start, "T_camera_lidar_start")
        return rig_from_json(document.rig, mask_png), T_camera_lidar_start, document.window_id
    except ValidationError as error:
        raise WindowError(f"{path}: {RIG}: {describe(error)}") from error
    except (ConfigError, WindowError) as error:
        raise WindowError(f"{path}: {RIG}: {error}") from error


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
    schemas: dict[int, reader.Schema] = field(default_factory=dict)
    channels: dict[int, reader.Channel] = field(default_factory=dict)
    parts: dict[PairKey, _Parts] = field(default_factory=dict)

    def add(self, record: reader.Record) -> PairKey | None:
        """Adds a record. Returns the place of the pair that it completes; None if it completes none."""
        match record:
            case reader.Schema():
                self.schemas[record.schema_id] = record
            case reader.Channel():
                self.channels[record.channel_id] = record
            case reader.McapAttachment():
                self.attachments[record.name] = record.data
            case reader.Metadata() if record.name == METADATA:
                self.metadata = record.values
            case reader.Metadata() if record.name == CARRIED_OVER:
                self.carried_over = record.values
            case reader.McapMessage():
                return self._add_message(record)
        return None

    def head(self, path: Path) -> tuple[Rig, Matrix4, str]:
        """Rig, extrinsic at the start and window id."""
        if RIG not in self.attachments:
            raise WindowError(f"{path} is not a recorded window: it has no attachment {RIG}")
        return decode_rig(path, self.attachments[RIG], self.attachments.get(MASK))

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

    def _add_message(self, message: reader.McapMessage) -> PairKey | None:
        channel = self.channels.get(message.channel_id)
        schema = None if channel is None else self.schemas.get(channel.schema_id)
        if channel is None or schema is None or schema.name not in _FRAME_TYPES:
            return None
        if channel.topic.endswith(f"/{OVERLAY}"):
            return None
        try:
            frame = message_decoding.decode(schema.name, message.data, _LIMITS, point_time=WRITTEN_TIME)
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


MAX_UNPACKED = 64
"""A window may unpack to at most this many times its size (plus `CHUNK_BYTES`). No tool compresses images and clouds to
a sixtieth."""


def read_window(path: Path) -> tuple[Window, CalibrationConfig]:
    """The window exactly as it was recorded, and the configuration that it was recorded for.

    Raises:
        WindowError: unreadable, cut off, damaged, not a window of coec, or without a pair.
    """
    content = WindowContent()
    size = _size(path)
    for record in records_of(path, max_unpacked_bytes=size * MAX_UNPACKED + CHUNK_BYTES):
        content.add(record)
    rig, T_camera_lidar_start, window_id = content.head(path)
    places = sorted(content.parts)
    pairs, between = (
        tuple(
            sorted((content.pair(path, of) for of in places if of.between == thinned), key=lambda pair: pair.stamp_ns)
        )
        for thinned in (False, True)
    )
    if not pairs:
        raise WindowError(f"{path} holds no camera-LiDAR pair")
    # The service began the window at the extrinsic in use, which is off by about `MOUNT_RAD`.
    window = Window(window_id, rig, T_camera_lidar_start, pairs, MOUNT_RAD, between)
    return window, content.parsed_configuration(path)


def pairs_since(path: Path, since_ns: int) -> Iterator[FramePair]:
    """The pairs of a window from a stamp on, in the order of the file; holds one at a time in memory.

    Raises:
        WindowError: unreadable, cut off or damaged.
    """
    content = WindowContent()
    for record in records_of(path, max_unpacked_bytes=_size(path) * MAX_UNPACKED + CHUNK_BYTES):
        place = content.add(record)
        if place is None:
            continue
        pair = content.pair(path, place)
        if pair.stamp_ns >= since_ns and not place.between:
            yield pair


def read_result(path: Path) -> CalibrationResult | None:
    """The result that was written into a window; None if it has none. Does not read the frames.

    Raises:
        WindowError: unreadable, cut off or damaged.
    """
    data = _attachment(path, RESULT)
    if data is None:
        return None
    try:
        return from_json(CalibrationResult, data)
    except DecodeError as error:
        raise WindowError(f"{path}: {RESULT}: {error}") from error


def read_vehicle(path: Path) -> str:
    """The vehicle that recorded a window; empty if the window does not say. Does not read the frames.

    Raises:
        WindowError: unreadable or damaged at its beginning.
    """
    return metadata_of(path).get("vehicle", "")


def metadata_of(path: Path) -> dict[str, str]:
    """The metadata `coec` of a window, from before its first message; empty if there are none.

    Raises:
        WindowError: unreadable or damaged at its beginning.
    """
    for record in records_of(path):
        match record:
            case reader.Metadata() if record.name == METADATA:
                return record.values
            case reader.McapMessage():
                break
    return {}


def is_window(path: Path) -> bool:
    """Whether a sound MCAP file is a window of coec. Does not read the frames.

    Raises:
        SourceError: unreadable, cut off or damaged, so that it cannot be decided.
    """
    try:
        return reader.read_attachment(path, RIG) is not None
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror}") from error
    except reader.McapDamagedError as error:
        raise SourceError(error.of(path)) from error


def records_of(path: Path, max_unpacked_bytes: int | None = None) -> Iterator[reader.Record]:
    """The records of a window's file; those before an error are sound.

    Raises:
        WindowError: unreadable, cut off or damaged.
    """
    try:
        with path.open("rb") as stream:
            yield from reader.read_records(stream, max_unpacked_bytes=max_unpacked_bytes)
    except OSError as error:
        raise WindowError(f"cannot read {path}: {error.strerror}") from error
    except reader.McapDamagedError as error:
        raise WindowError(_damage(path, error)) from error


def _attachment(path: Path, name: str) -> bytes | None:
    try:
        return reader.read_attachment(path, name)
    except OSError as error:
        raise WindowError(f"cannot read {path}: {error.strerror}") from error
    except reader.McapDamagedError as error:
        raise WindowError(_damage(path, error)) from error


def _damage(path: Path, error: reader.McapDamagedError) -> str:
    message = error.of(path)
    return f"{message}; the daemon does so for its own at start" if error.is_mcap else message


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError as error:
        raise WindowError(f"cannot read {path}: {error.strerror}") from error
