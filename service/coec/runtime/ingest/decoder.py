"""From a sample to a frame: which decoder, whose frame, what size, which number; everything refused is counted."""

from __future__ import annotations

import logging
from collections import Counter, defaultdict, deque
from dataclasses import dataclass

import numpy as np

from coec.adapters.frames import msgpack_frames
from coec.adapters.ros import incoming
from coec.adapters.system.logs import LossCounter
from coec.adapters.zenoh.inputs import CDR, Sample
from coec.calibration.frames.concatenation import SeveralOrigins
from coec.calibration.frames.origin import ApparentOrigin, OriginCheck, from_origin
from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
from coec.config import LimitsConfig, PairConfig
from coec.errors import DecodeError
from coec.runtime.ingest.inbox import Parcel
from coec.runtime.ingest.sequence_numbers import SequenceNumbers

_log = logging.getLogger(__name__)

CAMERA, LIDAR, EGO = "camera", "lidar", "ego"

WRONG_TYPE = "wrong_type"
"""Cause of a loss: a message that makes no frame of the stream."""

EXPLAINED = frozenset({ApparentOrigin.cause, SeveralOrigins.cause, WRONG_TYPE})
"""Causes that the log explains by the sentence of the error, which is ours."""

NUMBERED = b"\xa8sequence"
"""How a native frame that has a number is told from what is no frame without decoding it: the name of the field, found
in some 10 ms in the largest message. One that is not recognised is counted as lost on its way, too."""

Frame = CameraFrame | LidarFrame | EgoMotion


@dataclass(frozen=True, slots=True)
class StreamCounts:
    """Samples that came, and frames that were made of them."""

    received: int
    accepted: int


class Decoder:
    """Decodes and checks the samples of one pair's streams."""

    def __init__(self, pair: PairConfig, limits: LimitsConfig, losses: LossCounter) -> None:
        self._pair = pair
        self._streams = pair.streams
        self._limits = limits
        self._losses = losses
        self._numbers: defaultdict[str, SequenceNumbers] = defaultdict(SequenceNumbers)
        self._overruns: deque[str] = deque()
        self._received: Counter[str] = Counter()
        self._accepted: Counter[str] = Counter()
        self._T_cloud_lidar = np.array(pair.lidar.T_cloud_lidar, dtype=np.float64)
        self._origin = OriginCheck()

    def counts(self, stream: str) -> StreamCounts:
        """Counters of a stream since the start."""
        return StreamCounts(self._received[stream], self._accepted[stream])

    def overrun(self, parcel: Parcel) -> None:
        """A sample went before it was decoded. Any thread."""
        self._losses.add(parcel.stream, "overrun")
        if NUMBERED in parcel.sample.payload:
            self._overruns.append(parcel.stream)

    def frame(self, parcel: Parcel) -> Frame | None:
        """The frame in a sample, or None when it was refused (and counted). Never raises for what a sender sent."""
        stream = parcel.stream
        self._received[stream] += 1
        while self._overruns:
            self._numbers[self._overruns.popleft()].counted()
        try:
            if len(parcel.sample.payload) > self._limits.max_message_bytes:
                raise DecodeError("message_too_large", "larger than limits.max_message_bytes")
            frame = self._decode(stream, parcel.sample)
            if frame.sequence is not None and (lost := self._numbers[stream].lost_by(frame.sequence)):
                self._losses.add(stream, "sequence_gap", lost)
            frame = self._checked(frame)
        except DecodeError as error:
            self._losses.add(stream, error.reason, detail=str(error) if error.reason in EXPLAINED else "")
            return None
        except Exception:
            # A fault of a decoder must cost the message, not the service.
            _log.exception("a decoder failed", extra={"fields": {"pair": self._pair.name, "stream": stream}})
            self._losses.add(stream, "decoder_fault")
            return None
        self._accepted[stream] += 1
        return frame

    def _decode(self, stream: str, sample: Sample) -> Frame:
        configured = self._streams[stream]
        encoding, _, schema = sample.encoding.partition(";")
        if encoding not in ("application/msgpack", CDR):
            encoding = f"application/{configured.encoding}"
        if encoding == CDR:
            type_name = schema or configured.assumed_type
            if type_name not in configured.types:
                expected = " or ".join(configured.types)
                raise DecodeError(WRONG_TYPE, f"a message of another type on {configured.place}: expected {expected}")
            return incoming.decode(type_name, sample.payload, self._limits, source=self._pair.lidar.source)
        if stream == CAMERA:
            return msgpack_frames.decode_camera(sample.payload, self._limits)
        if stream == LIDAR:
            return msgpack_frames.decode_lidar(sample.payload, self._limits)
        return msgpack_frames.decode_ego(sample.payload, self._limits)

    def _checked(self, frame: Frame) -> Frame:
        if isinstance(frame, CameraFrame):
            self._check_camera(frame)
        elif isinstance(frame, LidarFrame):
            return self._from_origin(frame)
        return frame

    def _from_origin(self, cloud: LidarFrame) -> LidarFrame:
        """The sweep in the LiDAR's own frame, from which its ranges must have been measured."""
        if cloud.frame_id != (self._pair.lidar.cloud_frame_id or self._pair.lidar.frame_id):
            raise DecodeError("frame_id", "not the frame id of the configuration")
        sweep = from_origin(cloud, self._T_cloud_lidar, self._pair.lidar.frame_id)
        contradiction = self._origin.look(sweep)
        if contradiction is not None:
            raise DecodeError(contradiction.cause, f"{contradiction.sentence} See lidar.{contradiction.setting}.")
        return sweep

    def _check_camera(self, frame: CameraFrame) -> None:
        camera = self._pair.camera
        if frame.frame_id != camera.frame_id:
            raise DecodeError("frame_id", "not the frame id of the configuration")
        if (frame.image.width, frame.image.height) != (camera.intrinsics.width, camera.intrinsics.height):
            raise DecodeError("image_size", "not the size of the intrinsics")
