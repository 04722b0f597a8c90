"""Windows on disk: one MCAP file each (profile `ros2`, CDR), written so that a reader never sees half a file.

Layout. First the attachments without which the rest means nothing (`rig.json`, `configuration.json`, `mask.png`), so
that whatever is cut off behind them can be salvaged. Then pair by pair the sweep, ego-motion, depth map, camera info
and image, each dated by its sensor and with the index of its pair as sequence number; the image comes last and
completes the pair. `write_result` adds a picture (`overlay`), `/diagnostics`, the result as a JSON channel and as
attachment `result.json`. Chunks end with the pairs, so that whatever was added is on the disk.

A window may hold pairs of an earlier one that were kept for it. They come last, though they were taken first; the
metadata `coec_kept` name the window that they are from. A reader sorts pairs by their stamps.

The thinned pairs between those of the window have topics and indices of their own; of these the image comes last,
too. They are asked where the camera moved within the window: `write_result` leaves them out where it did not, which
more than halves what is kept of most windows.

The sender's own sequence numbers are not kept: the pairs of a window were chosen, so gaps between them mean nothing.
Chunks of clouds and raw images are compressed if it is asked for, others never: encoded images shrink by nothing.
Equal pairs give equal bytes: nothing in the file tells when or where it was written.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from coec.adapters.files.rig import mask_to_png
from coec.adapters.mcap.ros_channels import RosChannel, check_stamp
from coec.adapters.mcap.whole_file import FinishedFile, WholeFile
from coec.adapters.mcap.windows import rig_attachment
from coec.adapters.mcap.windows.names import (
    BETWEEN,
    BETWEEN_IMAGE,
    CAMERA_INFO,
    COMPRESSED,
    CONFIGURATION,
    DEPTH,
    IMAGE,
    IMU,
    JSON,
    KEPT,
    LZ4,
    MASK,
    METADATA,
    ODOMETRY,
    PACKING,
    PART_SUFFIX,
    POINTS,
    RIG,
    beside,
    topic,
)
from coec.adapters.ros import messages, outgoing
from coec.calibration.types import FramePair, Matrix4, Rig
from coec.config import CalibrationConfig
from coec.errors import RecordingError
from coec.schemas.base import to_json
from coec.schemas.ros_names import TF_STATIC


@dataclass(frozen=True, slots=True)
class RecordedWindow:
    """A finished file. `sha256` is hexadecimal and of the whole file, `pairs` their number. `bytes` and `modified_ns`
    (what the file system says of the last write) tell this version of the file from a later one."""

    path: Path
    window_id: str
    pairs: int
    bytes: int
    modified_ns: int
    sha256: str

    @classmethod
    def of(cls, file: FinishedFile, window_id: str, pairs: int) -> RecordedWindow:
        """The window that is in a file."""
        return cls(file.path, window_id, pairs, file.bytes, file.modified_ns, file.sha256)


class WindowWriter:
    """Records one window, pair by pair. After a `RecordingError` the file is gone and the writer of no more use."""

    def __init__(
        self,
        path_final: Path,
        rig: Rig,
        T_camera_lidar_start: Matrix4,
        window_id: str,
        configuration: CalibrationConfig,
        metadata: Mapping[str, str],
        *,
        packed: bool = False,
        temporary: Path | None = None,
    ) -> None:
        """Opens `<path_final>.part` (or `temporary`) and writes what must not be lost.

        Args:
            path_final: `<folder>/<window_id>.mcap`, the name after `finish`; a file of that name is replaced.
            rig: of the pair.
            T_camera_lidar_start: (4, 4) extrinsic that is current now, where the search will start.
            window_id: of the window.
            configuration: with which the window will be calibrated.
            metadata: what else a reader may want to know, for example `vehicle`. It becomes part of the bytes.
            packed: compress what shrinks by it.

        Raises:
            RecordingError: the file cannot be written.
        """
        self.pairs = 0
        self._between = 0
        self._rig, self._T_start, self._window_id = rig, T_camera_lidar_start, window_id
        self._file = WholeFile(temporary or beside(path_final, PART_SUFFIX), path_final, packed=packed)
        self._file.attach(RIG, JSON, rig_attachment.encoded(rig, T_camera_lidar_start, window_id))
        self._file.attach(CONFIGURATION, JSON, to_json(configuration))
        if rig.mask is not None:
            self._file.attach(MASK, "image/png", mask_to_png(rig.mask))
        self._file.metadata(METADATA, {"window_id": window_id, PACKING: LZ4 if packed else "", **metadata})
        self._file.sync()

    def note_kept(self, from_window_id: str, since_ns: int) -> None:
        """The pairs that are added from now on are those of another window from a stamp on.

        Raises:
            RecordingError: it could not be written; the `.part` file has been removed.
        """
        self.note_of_kept({"from_window": from_window_id, "since_ns": str(since_ns)})

    def note_of_kept(self, values: Mapping[str, str]) -> None:
        """The same, in the words that were found in another file."""
        self._file.metadata(KEPT, values)

    def add(self, pair: FramePair) -> None:
        """Appends a pair.

        Raises:
            RecordingError: it could not be written (disk full, or a stamp beyond ROS time); the `.part` file has been
                removed.
        """
        stamp_ns = pair.stamp_ns
        self._refuse_stamps_beyond_ros(pair)
        if self.pairs == 0:
            self._cdr(TF_STATIC, messages.TF, stamp_ns, outgoing.encode_tf_static(self._rig, self._T_start, stamp_ns))
        self._sweep_and_motion("", pair, self.pairs)
        if pair.camera.depth is not None:
            depth = outgoing.encode_depth(stamp_ns, pair.camera.frame_id, pair.camera.depth)
            self._cdr(self._topic(DEPTH), messages.COMPRESSED_IMAGE, stamp_ns, depth)
        info = outgoing.encode_camera_info(self._rig, stamp_ns)
        self._cdr(self._topic(CAMERA_INFO), messages.CAMERA_INFO, stamp_ns, info)
        image_type, image = outgoing.encode_image(pair.camera)
        name = IMAGE if image_type == messages.IMAGE else COMPRESSED
        self._cdr(self._topic(name), image_type, stamp_ns, image)
        self._file.sync()
        self.pairs += 1

    def add_between(self, pair: FramePair) -> None:
        """Appends a thinned pair, whose image is compressed. It is on the disk with the next one of the window.

        Raises:
            RecordingError: as for `add`.
        """
        self._refuse_stamps_beyond_ros(pair)
        self._sweep_and_motion(BETWEEN, pair, self._between)
        image_type, image = outgoing.encode_image(pair.camera)
        self._cdr(self._topic(BETWEEN_IMAGE), image_type, pair.stamp_ns, image, self._between)
        self._between += 1

    def finish(self) -> RecordedWindow:
        """Writes the index, syncs, and gives the file its final name.

        Raises:
            RecordingError: it could not be written; the `.part` file has been removed.
        """
        return RecordedWindow.of(self._file.finish(), self._window_id, self.pairs)

    def abandon(self) -> None:
        """Removes the `.part` file. May be called at any time before `finish`, and more than once."""
        self._file.abandon()

    def _sweep_and_motion(self, below: str, pair: FramePair, index: int) -> None:
        lidar, motion = pair.lidar, pair.motion
        points = outgoing.encode_cloud(lidar)
        self._cdr(self._topic(below + POINTS), messages.POINT_CLOUD, lidar.stamp_ns, points, index)
        if motion is not None:
            motion_type, data = outgoing.encode_motion(motion)
            name = below + (IMU if motion_type == messages.IMU else ODOMETRY)
            self._cdr(self._topic(name), motion_type, motion.stamp_ns, data, index)

    def _refuse_stamps_beyond_ros(self, pair: FramePair) -> None:
        try:
            for frame in (pair.camera, pair.lidar, pair.motion):
                if frame is not None:
                    check_stamp(frame.stamp_ns)
        except RecordingError:
            self.abandon()
            raise

    def _topic(self, name: str) -> str:
        return topic(self._rig.pair, name)

    def _cdr(self, topic_name: str, type_name: str, stamp_ns: int, data: bytes, index: int | None = None) -> None:
        """A message of the pair of this index, or of the one that is being added."""
        sequence = self.pairs if index is None else index
        self._file.ros(RosChannel(topic_name, type_name), stamp_ns, sequence, data)
