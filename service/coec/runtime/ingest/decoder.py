"""From a sample to a frame: which decoder, whose frame, what size, which number; everything refused is counted."""

from __future__ import annotations

import logging
from collections import Counter, defaultdict, deque
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
from coec.config import LimitsConfig, OpenPairConfig, PairConfig
from coec.errors import DecodeError
from coec.runtime.ingest.inbox import Parcel
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
    """Frames of the samples of a pair's streams, as they come."""

    def __init__(self, pair: OpenPairConfig, limits: LimitsConfig) -> None:
        self._streams = pair.streams
        self._limits = limits
        self._lidar = pair.lidar
        self._moving = None if pair.ego is None else MovingFrame(pair.ego.parent, pair.ego.child)

    def frame(self, stream: str, sample: Sample) -> Frame | None:
        """The frame in a sample of a stream, `CAMERA`, `LIDAR` or `EGO`; None where it holds transforms of other frames
        than the vehicle's, or the first ones.

        Raises:
            DecodeError: there is none, or one of another kind.
        """
        configured = self._streams[stream]
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
            time, source = self._lidar.time, self._lidar.source
            return incoming.decode(type_name, sample.payload, self._limits, point_time=time, source=source)
        if stream == CAMERA:
            return msgpack_frames.decode_camera(sample.payload, self._limits)
        if stream == LIDAR:
            return msgpack_frames.decode_lidar(sample.payload, self._limits)
        return msgpack_frames.decode_ego(sample.payload, self._limits)


class Decoder:
    """Decodes and checks the samples of one pair's streams.

    Attributes:
        timed_by: of the latest sweep, see `LidarFrame`.
    """

    def __init__(self, pair: PairConfig, limits: LimitsConfig, losses: LossCounter) -> None:
        self._pair = pair
        self._samples = SampleReader(pair, limits)
        self._limits = limits
        self._losses = losses
        self._senders: defaultdict[str, Senders] = defaultdict(Senders)
        self._overruns: deque[tuple[str, bytes]] = deque()
        self._stamped_by_sender: dict[str, bool] = {}
        self._received: Counter[str] = Counter()
        self._accepted: Counter[str] = Counter()
        self._T_cloud_lidar = np.array(pair.lidar.T_cloud_lidar, dtype=np.float64)
        self._origin = OriginCheck()
        self._looked_in: int | None = None
        self._contradicted = False
        self.timed_by = ""

    def counts(self, stream: str) -> StreamCounts:
        """Counters of a stream since the start."""
        return StreamCounts(
            self._received[stream],
            self._accepted[stream],
            self._senders[stream].taking_turns,
            self._stamped_by_sender.get(stream, False),
        )

    def overrun(self, parcel: Parcel) -> None:
        """A sample went before it was decoded. Any thread."""
        self._losses.add(parcel.stream, "overrun")
        sample = parcel.sample
        told = Attachment.parse(sample.attachment)
        if told is not None:
            self._overruns.append((parcel.stream, told.gid))
        elif sample.attachment is None and NUMBERED in sample.payload:
            self._overruns.append((parcel.stream, NOBODY))

    def frame(self, parcel: Parcel) -> Frame | None:
        """The frame in a sample, or None when it was refused (and counted), or holds none: transforms of other frames
        than the vehicle's. Never raises for what a sender sent."""
        stream = parcel.stream
        self._received[stream] += 1
        while self._overruns:
            overrun, sender = self._overruns.popleft()
            self._senders[overrun].counted(sender)
        told = self._told(stream, parcel.sample)
        try:
            if len(parcel.sample.payload) > self._limits.max_message_bytes:
                raise DecodeError("message_too_large", "larger than limits.max_message_bytes")
            frame = self._samples.frame(stream, parcel.sample)
            if frame is None:
                return None
            self._check_times(frame)
            if told is None and frame.sequence is not None:
                self._number(stream, NOBODY, frame.sequence)
            frame = self._checked(self._stamped(stream, frame, told))
        except DecodeError as error:
            self._losses.add(stream, error.reason, detail=str(error) if error.reason in EXPLAINED else "")
            return None
        except Exception:
            # A fault of a decoder must cost the message, not the service.
            _log.exception("a decoder failed", extra={"fields": {"pair": self._pair.name, "stream": stream}})
            self._losses.add(stream, "decoder_fault")
            return None
        self._accepted[stream] += 1
        if isinstance(frame, LidarFrame):
            self.timed_by = frame.timed_by
        return frame

    def _told(self, stream: str, sample: Sample) -> Attachment | None:
        """What the sender tells beside the message; a message beside which something else lies is taken, too."""
        told = Attachment.parse(sample.attachment)
        if told is not None:
            self._number(stream, told.gid, told.sequence)
        elif sample.attachment is not None:
            self._losses.add(stream, "attachment_malformed")
        return told

    def _number(self, stream: str, sender: bytes, number: int) -> None:
        lost = self._senders[stream].lost_by(sender, number)
        if lost:
            self._losses.add(stream, "sequence_gap", lost)

    def _stamped(self, stream: str, frame: Frame, told: Attachment | None) -> Frame:
        """A frame without a stamp gets the sender's: when it was sent, not when the sensor saw."""
        without = frame.stamp_ns == 0 and told is not None and told.source_ns > 0
        self._stamped_by_sender[stream] = without
        return replace(frame, stamp_ns=told.source_ns) if told is not None and without else frame

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
        found = self._origin.look(sweep)
        self._contradicted = found is not None
        return found

    def _check_times(self, frame: Frame) -> None:
        time = self._pair.lidar.time
        if time is not None and isinstance(frame, LidarFrame) and frame.time_offset_s is None:
            what = f"the cloud has no field {time.field} of one number a point, which `lidar.time` names"
            raise DecodeError(Refusal.CLOUD_FIELDS, what)

    def _check_camera(self, frame: CameraFrame) -> None:
        camera = self._pair.camera
        if frame.frame_id != camera.frame_id:
            raise DecodeError("frame_id", "not the frame id of the configuration")
        if (frame.image.width, frame.image.height) != (camera.intrinsics.width, camera.intrinsics.height):
            raise DecodeError("image_size", "not the size of the intrinsics")
