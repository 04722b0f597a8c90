"""From a sample to a frame: which decoder, whose frame, what size, which number; everything refused is counted."""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from coec.adapters.frames import msgpack_frames
from coec.adapters.frames.incoming import Refusal
from coec.adapters.ros import incoming, messages
from coec.adapters.ros.moving_frames import MovingFrame
from coec.adapters.ros.wire.rmw_zenoh import Attachment
from coec.adapters.system.logs import LossCounter
from coec.adapters.zenoh.inputs import CDR, Sample
from coec.calibration.frames.concatenation import SeveralOrigins
from coec.calibration.frames.origin import ApparentOrigin, OriginCheck, from_origin
from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
from coec.config import (
    IDENTITY,
    AnyStreamConfig,
    CameraConfig,
    KnownStreamConfig,
    LidarConfig,
    LimitsConfig,
    OpenEgoConfig,
    OpenLidarConfig,
)
from coec.errors import DecodeError
from coec.geometry.edges.scan_lines import telling
from coec.runtime.ingest.senders import Senders

_log = logging.getLogger(__name__)

CAMERA, LIDAR, EGO = "camera", "lidar", "ego"

WRONG_TYPE = "wrong_type"
"""Cause of a loss: a message that makes no frame of the stream."""

ORIGIN_PERIOD_NS = 10**9
"""Of sensor time, between two looks at where points were measured from: 1 ms each."""

EXPLAINED = frozenset(
    {
        ApparentOrigin.cause,
        SeveralOrigins.cause,
        WRONG_TYPE,
        Refusal.MESSAGE_TYPE,
        Refusal.CLOUD_FIELDS,
        Refusal.CLOUD_TIME,
        Refusal.CLOUD_TIME_AMBIGUOUS,
        Refusal.IMAGE_UNKNOWN_FORMAT,
    }
)
"""Causes that the log explains by the sentence of the error, which is ours."""

NUMBERED = b"\xa8sequence"
"""How a native frame that has a number is told from what is no frame without decoding it: the name of the field, found
in some 10 ms in the largest message. One that is not recognised is counted as lost on its way, too."""

NOBODY = b""
"""Id of whoever does not say who it is."""

Frame = CameraFrame | LidarFrame | EgoMotion


@dataclass(frozen=True, slots=True)
class StreamCounts:
    """Samples that came, and frames that were made of them.

    Attributes:
        taking_turns: ids of several senders that send at a time; none where it is one, or nobody says who it is.
        stamped_by_sender: the latest frame had no stamp, and has that of the clock of whoever sent it.
    """

    received: int
    accepted: int
    taking_turns: tuple[bytes, ...] = ()
    stamped_by_sender: bool = False


class SampleReader:
    """Frames of the samples of one stream, as they come."""

    def __init__(self, kind: str, stream: AnyStreamConfig, limits: LimitsConfig) -> None:
        """`kind` is what the stream brings: `CAMERA`, `LIDAR` or `EGO`."""
        self._kind = kind
        self._stream = stream
        self._limits = limits
        self._moving = MovingFrame(stream.parent, stream.child) if isinstance(stream, OpenEgoConfig) else None

    def frame(self, sample: Sample) -> Frame | None:
        """The frame in a sample; None where it holds transforms of other frames than the vehicle's, or the first ones.

        Raises:
            DecodeError: there is none, or one of another kind.
        """
        configured = self._stream
        encoding, _, schema = sample.encoding.partition(";")
        if encoding not in ("application/msgpack", CDR):
            encoding = f"application/{configured.encoding}"
        if encoding == CDR:
            type_name = schema or configured.assumed_type
            if type_name not in configured.types:
                expected = " or ".join(configured.types)
                told = incoming.REFUSED.get(type_name, "a message of another type")
                raise DecodeError(WRONG_TYPE, f"{configured.place}: expected {expected}; {told}")
            if type_name == messages.TF and self._moving is not None:
                return self._moving.motion(sample.payload)
            time, source = None, None
            if isinstance(configured, OpenLidarConfig):
                time, source = configured.time, configured.source
            return incoming.decode(type_name, sample.payload, self._limits, point_time=time, source=source)
        if self._kind == CAMERA:
            return msgpack_frames.decode_camera(sample.payload, self._limits)
        if self._kind == LIDAR:
            return msgpack_frames.decode_lidar(sample.payload, self._limits)
        return msgpack_frames.decode_ego(sample.payload, self._limits)


class Decoder:
    """Decodes and checks the samples of one stream.

    Attributes:
        timed_by: of the latest sweep, see `LidarFrame`.
    """

    def __init__(self, kind: str, stream: KnownStreamConfig, limits: LimitsConfig, losses: LossCounter) -> None:
        """`kind` is what the stream brings, `CAMERA`, `LIDAR` or `EGO`, and the place at which its losses are
        counted."""
        self._kind = kind
        self._stream = stream
        self._samples = SampleReader(kind, stream, limits)
        self._limits = limits
        self._losses = losses
        self._senders = Senders()
        self._overruns: deque[bytes] = deque()
        self._stamped_by_sender = False
        self._received = self._accepted = 0
        lidar = stream if isinstance(stream, LidarConfig) else None
        self._T_cloud_lidar = np.array(IDENTITY if lidar is None else lidar.T_cloud_lidar, dtype=np.float64)
        self._origin = OriginCheck()
        self._looked_in: int | None = None
        self._contradicted = self._ring_told = False
        self.timed_by = ""

    def counts(self) -> StreamCounts:
        """Counters since the start."""
        return StreamCounts(self._received, self._accepted, self._senders.taking_turns, self._stamped_by_sender)

    def overrun(self, sample: Sample) -> None:
        """A sample went before it was decoded. Any thread."""
        self._losses.add(self._kind, "overrun")
        told = Attachment.parse(sample.attachment)
        if told is not None:
            self._overruns.append(told.gid)
        elif sample.attachment is None and NUMBERED in sample.payload:
            self._overruns.append(NOBODY)

    def frame(self, sample: Sample) -> Frame | None:
        """The frame in a sample, or None when it was refused (and counted), or holds none: transforms of other frames
        than the vehicle's. Never raises for what a sender sent."""
        self._received += 1
        while self._overruns:
            self._senders.counted(self._overruns.popleft())
        told = self._told(sample)
        try:
            if len(sample.payload) > self._limits.max_message_bytes:
                raise DecodeError("message_too_large", "larger than limits.max_message_bytes")
            frame = self._samples.frame(sample)
            if frame is None:
                return None
            self._check_times(frame)
            if told is None and frame.sequence is not None:
                self._number(NOBODY, frame.sequence)
            frame = self._checked(self._stamped(frame, told))
        except DecodeError as error:
            self._losses.add(self._kind, error.reason, detail=str(error) if error.reason in EXPLAINED else "")
            return None
        except Exception:
            # A fault of a decoder must cost the message, not the service.
            _log.exception("a decoder failed", extra={"fields": {"sensor": self._stream.sensor, "stream": self._kind}})
            self._losses.add(self._kind, "decoder_fault")
            return None
        self._accepted += 1
        if isinstance(frame, LidarFrame):
            self.timed_by = frame.timed_by
        return frame

    def _told(self, sample: Sample) -> Attachment | None:
        """What the sender tells beside the message; a message beside which something else lies is taken, too."""
        told = Attachment.parse(sample.attachment)
        if told is not None:
            self._number(told.gid, told.sequence)
        elif sample.attachment is not None:
            self._losses.add(self._kind, "attachment_malformed")
        return told

    def _number(self, sender: bytes, number: int) -> None:
        lost = self._senders.lost_by(sender, number)
        if lost:
            self._losses.add(self._kind, "sequence_gap", lost)

    def _stamped(self, frame: Frame, told: Attachment | None) -> Frame:
        """A frame without a stamp gets the sender's: when it was sent, not when the sensor saw."""
        without = frame.stamp_ns == 0 and told is not None and told.source_ns > 0
        self._stamped_by_sender = without
        return replace(frame, stamp_ns=told.source_ns) if told is not None and without else frame

    def _checked(self, frame: Frame) -> Frame:
        stream = self._stream
        if isinstance(frame, CameraFrame) and isinstance(stream, CameraConfig):
            _check_camera(frame, stream)
        elif isinstance(frame, LidarFrame) and isinstance(stream, LidarConfig):
            return self._from_origin(frame, stream)
        return frame

    def _from_origin(self, cloud: LidarFrame, lidar: LidarConfig) -> LidarFrame:
        """The sweep in the LiDAR's own frame, from which its ranges must have been measured."""
        if cloud.frame_id != (lidar.cloud_frame_id or lidar.frame_id):
            raise DecodeError("frame_id", "not the frame id of the configuration")
        sweep = from_origin(cloud, self._T_cloud_lidar, lidar.frame_id)
        contradiction = self._contradiction(sweep)
        if contradiction is not None:
            raise DecodeError(contradiction.cause, f"{contradiction.sentence} See lidar.{contradiction.setting}.")
        return sweep

    def _contradiction(self, sweep: LidarFrame) -> ApparentOrigin | SeveralOrigins | None:
        """Of the first sweep of each period of sensor time, and of all while one was found: frames of drivers change
        with their configuration, not from sweep to sweep."""
        period = sweep.stamp_ns // ORIGIN_PERIOD_NS
        if period == self._looked_in and not self._contradicted:
            return None
        self._looked_in = period
        if sweep.ring is not None and telling(sweep.ring) is None and not self._ring_told:
            self._ring_told = True
            _log.warning(
                "the field `ring` of the clouds holds one number: it is ignored, beams are told by their elevation; "
                "see to the driver of the LiDAR",
                extra={"fields": {"sensor": self._stream.sensor}},
            )
        found = self._origin.look(sweep)
        self._contradicted = found is not None
        return found

    def _check_times(self, frame: Frame) -> None:
        time = self._stream.time if isinstance(self._stream, LidarConfig) else None
        if time is not None and isinstance(frame, LidarFrame) and frame.time_offset_s is None:
            what = f"the cloud has no field {time.field} of one number a point, which `lidar.time` names"
            raise DecodeError(Refusal.CLOUD_FIELDS, what)


def _check_camera(frame: CameraFrame, camera: CameraConfig) -> None:
    if frame.frame_id != camera.frame_id:
        raise DecodeError("frame_id", "not the frame id of the configuration")
    if (frame.image.width, frame.image.height) != (camera.intrinsics.width, camera.intrinsics.height):
        raise DecodeError("image_size", "not the size of the intrinsics")
