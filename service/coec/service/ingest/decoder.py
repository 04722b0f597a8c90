"""From a sample to a frame: chooses the decoder, checks frame id, size and number, and follows the senders of the
stream. Every refusal is counted. The stream of one sensor is decoded once, whatever number of pairs uses it.

Senders: who sends, whether several send at the same time, and how many messages of each were lost. ROS publishers name
themselves beside each message. Other senders are told apart by the session or router that stamped their messages, as
far as it did, and by their numbers, or without numbers by their stamps: numbers and stamps of one sender go on, while
those of two senders alternate between two sequences.

A missing number counts as lost once it is late, because a frame that was only overtaken comes within a few others. An
overtaken frame is no loss of the network: if it is dropped later, the part that drops it counts it, once.
"""

from __future__ import annotations

import logging
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames import lidar_origin, message_evidence
from coec.calibration.types import NS_PER_S, CameraFrame, EgoMotion, Frame, LidarFrame
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
from coec.geometry.points import distinct_rings
from coec.io import msgpack_frames
from coec.io.frame_validation import Refusal
from coec.io.logs import LossCounter
from coec.io.ros import message_decoding, messages, packet_streams
from coec.io.ros.packet_streams import PacketAssembler, PacketSensor
from coec.io.ros.transforms import MovingFrame, OdometryMotion
from coec.io.ros.wire_format import MessageAttachment
from coec.io.zenoh.bus import CDR, InputSample
from coec.service.timing import QUICK_S, Histogram

MAX_GAP = 100_000
"""A larger step means that the sender counts anew: at 100 Hz this gap would be a quarter of an hour of loss."""

LATE_FRAMES = 16
"""How many frames may overtake another: 1.6 s at 10 Hz, the depth of the inbox."""


class SequenceNumbers:
    """The numbers of one sender; one thread uses it."""

    def __init__(self) -> None:
        self._newest: int | None = None
        self._missing: set[int] = set()
        self._counted = 0
        self._since_counted = 0

    def counted(self) -> None:
        """A frame came, was lost in this process, and has been counted already, so its gap is not counted again. The
        frame may have had no number at all; therefore only a gap soon afterwards is taken for its gap."""
        self._counted += 1
        self._since_counted = 0

    def lost_by(self, number: int) -> int:
        """How many frames are now known to be lost on their way, given that this number has come."""
        lost = self._left_out_by(number)
        known = min(lost, self._counted)
        self._since_counted += 1
        self._counted = 0 if self._since_counted > 2 * LATE_FRAMES else self._counted - known
        return lost - known

    def _left_out_by(self, number: int) -> int:
        newest = self._newest
        if newest is not None and newest - LATE_FRAMES <= number <= newest:  # late, or for the second time
            self._missing.discard(number)
            return 0
        self._newest = number
        if newest is None or not newest < number <= newest + MAX_GAP:
            # The sender counts anew: numbers that are missing from the old count do not come any more.
            lost = len(self._missing)
            self._missing.clear()
            return lost
        oldest = number - LATE_FRAMES
        self._missing.update(range(max(newest + 1, oldest), number))
        late = {missing for missing in self._missing if missing < oldest}
        self._missing -= late
        return max(0, oldest - newest - 1) + len(late)


REMEMBERED = 8
"""How many senders' numbers are followed: that of the present sender and of some earlier ones."""

RECENT = 64
"""Recent messages that show whether senders take turns: two seconds of a camera."""

TRIAL = 3
"""So many messages in a row, and a new sender has replaced the one before; until then that may come back."""

STEP_NS = 2 * 10**9
"""Stamps without numbers that differ by less belong to one sequence, ns."""


@dataclass(slots=True, eq=False)
class _Track:
    """The sequence of messages of one sender that does not name itself.

    Attributes:
        id: stands for the sender.
        origin: who stamped its messages for Zenoh.
        numbers: its numbers; while it is on trial after another track of this origin (`before`), they wait.
        recent: sensor stamp by number, of the latest messages.
    """

    id: bytes
    origin: bytes
    before: _Track | None = None
    numbers: SequenceNumbers = field(default_factory=SequenceNumbers)
    waiting: list[int] = field(default_factory=list)
    recent: OrderedDict[int, int] = field(default_factory=OrderedDict)
    newest: int | None = None
    stamp_ns: int = 0

    def fits(self, number: int | None, stamp_ns: int) -> bool:
        """Whether a message with this number and stamp can be the next of this sender, or a late one."""
        if number is None or self.newest is None:
            return self.newest is number is None and abs(stamp_ns - self.stamp_ns) <= STEP_NS
        if not self.newest - LATE_FRAMES <= number <= self.newest + LATE_FRAMES:
            return False
        # One sender's stamps are in the order of its numbers. Equal stamps say nothing: some senders have none.
        return all(
            stamp_ns == other_ns if number == other else (stamp_ns - other_ns) * (number - other) >= 0
            for other, other_ns in self.recent.items()
        )

    def goes_on(self, number: int | None, stamp_ns: int) -> bool:
        """Whether a message can be of this track, which is on trial, after a gap: where most messages are lost, each of
        those that come follows a gap."""
        if self.before is None or number is None or self.newest is None:
            return False
        return self.newest < number <= self.newest + MAX_GAP and stamp_ns >= self.stamp_ns

    def add(self, number: int | None, stamp_ns: int) -> None:
        """The message is of this sender."""
        self.stamp_ns = stamp_ns
        if number is None:
            return
        self.newest = number if self.newest is None else max(self.newest, number)
        self.recent[number] = stamp_ns
        if len(self.recent) > 2 * LATE_FRAMES:
            self.recent.popitem(last=False)

    def end_trial(self, *, replaces: bool) -> int:
        """Counts the numbers that waited. `replaces`: nobody else has sent meanwhile, so that this is the sender before
        after a gap or a restart; it takes over the id and the numbers. Returns how many messages are known to be
        lost."""
        if replaces and self.before is not None:
            self.id, self.before.id = self.before.id, self.id
            self.numbers, self.before.numbers = self.before.numbers, SequenceNumbers()
        waiting, self.waiting, self.before = self.waiting, [], None
        return sum(self.numbers.lost_by(number) for number in waiting)


class Senders:
    """The senders of one stream; one thread uses it. `lost_by` and `unnamed` come for each message, `took` for each
    whose frame fits the stream.

    A named sender that restarts has a new id, so one change of senders is normal. If the sender changes again within
    `RECENT` messages, two are sending at the same time.
    """

    def __init__(self) -> None:
        self._numbers: OrderedDict[bytes, SequenceNumbers] = OrderedDict()
        self._tracks: deque[_Track] = deque(maxlen=REMEMBERED)
        self._made = 0
        self._recent: deque[tuple[bytes, bool]] = deque(maxlen=RECENT)
        self._changes = 0
        self._in_a_row = TRIAL

    def counted(self, sender: bytes) -> None:
        """A message of this sender came, was lost in this process, and has been counted already. Without an id, it is
        one of the latest unnamed sender."""
        if sender:
            self._of(sender).counted()
        elif self._tracks:
            self._tracks[0].numbers.counted()

    def lost_by(self, sender: bytes, number: int) -> int:
        """How many messages of a named sender are now known to be lost on their way, given that this number has
        come."""
        return self._of(sender).lost_by(number)

    def unnamed(self, origin: bytes, number: int | None, stamp_ns: int) -> tuple[bytes, int]:
        """Which sender a message without an id is of, and how many messages are now known to be lost on their way.

        Args:
            origin: who stamped the message for Zenoh; empty if nobody did.
            number: None: its sender gives no numbers.
            stamp_ns: its sensor stamp.
        """
        latest = self._tracks[0] if self._tracks else None
        track = next((one for one in self._tracks if one.origin == origin and one.fits(number, stamp_ns)), None)
        if track is None and latest is not None and latest.origin == origin:
            pause = number is latest.newest is None and stamp_ns > latest.stamp_ns
            track = latest if pause or latest.goes_on(number, stamp_ns) else None
        lost = 0
        if latest is not None and track is not latest and latest.before is not None:
            lost += latest.end_trial(replaces=False)
        if track is None:
            self._made += 1
            before = latest if latest is not None and latest.origin == origin and number is not None else None
            track = _Track(origin + b"#" + str(self._made).encode(), origin, before)
        if track in self._tracks:
            self._tracks.remove(track)
        self._tracks.appendleft(track)
        track.add(number, stamp_ns)
        if number is None:
            return track.id, lost
        if track.before is None:
            return track.id, lost + track.numbers.lost_by(number)
        track.waiting.append(number)
        if len(track.waiting) >= TRIAL:
            new = track.id
            lost += track.end_trial(replaces=True)
            self._rename(new, track.id)
        return track.id, lost

    def took(self, sender: bytes) -> None:
        """A frame of this sender, which may be one of `unnamed`, fits the stream."""
        before = self._recent[-1][0] if self._recent else sender
        changed = before != sender
        if len(self._recent) == RECENT:
            self._changes -= self._recent[0][1]
        self._recent.append((sender, changed))
        self._changes += changed
        self._in_a_row = 1 if changed else min(self._in_a_row + 1, TRIAL)

    def _rename(self, sender: bytes, known: bytes) -> None:
        """Messages of the new `sender` turn out to be of one that is known already."""
        renamed = [known if one == sender else one for one, _ in self._recent]
        self._recent.clear()
        self._changes = 0
        for index, one in enumerate(renamed):
            changed = index > 0 and renamed[index - 1] != one
            self._recent.append((one, changed))
            self._changes += changed

    @property
    def on_trial(self) -> bool:
        """Whether the present sender is new, so that the one before may come back."""
        return self._in_a_row < TRIAL

    @property
    def taking_turns(self) -> tuple[bytes, ...]:
        """Ids of the senders that send at the same time; empty if there is only one."""
        return tuple(sorted({sender for sender, _ in self._recent})) if self._changes > 1 else ()

    def _of(self, sender: bytes) -> SequenceNumbers:
        numbers = self._numbers.setdefault(sender, SequenceNumbers())
        self._numbers.move_to_end(sender)
        if len(self._numbers) > REMEMBERED:
            self._numbers.popitem(last=False)
        return numbers


_log = logging.getLogger(__name__)

CAMERA, LIDAR, EGO = "camera", "lidar", "ego"

WRONG_TYPE = "wrong_type"
"""Cause of a loss: the message is of a type that gives no frame of the stream."""

EXPLAINED = frozenset(
    {
        lidar_origin.ApparentOrigin.cause,
        lidar_origin.SeveralOrigins.cause,
        WRONG_TYPE,
        Refusal.MESSAGE_TYPE,
        Refusal.CLOUD_FIELDS,
        Refusal.CLOUD_TIME,
        Refusal.CLOUD_TIME_AMBIGUOUS,
        Refusal.IMAGE_UNKNOWN_FORMAT,
    }
)
"""Causes for which the log shows the sentence of the error. It is safe to show because coec wrote it, not a sender."""

NUMBERED = b"\xa8sequence"
"""Name of the field by which a native frame with a number is recognised without decoding; the search takes some 10 ms
in the largest message. A frame that is not recognised is also counted as lost on its way."""

UNNAMED_SENDER = b""
"""Id of a sender that does not name itself."""

TWO_SENDERS = "two_senders"
"""Cause of a loss: several senders send on the stream at the same time, and nobody knows whose frames are the
sensor's."""

ONE_RING = (
    "the field `ring` of the clouds holds one number: it is ignored, beams are told apart by their elevation; check "
    "the driver of the LiDAR"
)

OTHERS = frozenset({"frame_id", "image_size"})
"""Causes of the refusal of frames that are another sensor's, or of a sensor with other settings."""


@dataclass(frozen=True, slots=True)
class StreamCounts:
    """Samples that came, and frames that were made of them.

    Attributes:
        taking_turns: ids of the senders if several send at the same time, whose frames are refused; else empty. Some
            are made up, for senders that do not name themselves.
        foreign: whether frames of `OTHERS` come beside the stream's own.
        stamped_by_sender: the latest frame came without a stamp and got the time at which it was sent, by the sender's
            clock.
        notes: what was recognised of the messages, which their fields do not state.
    """

    received: int
    accepted: int
    taking_turns: tuple[bytes, ...] = ()
    foreign: bool = False
    stamped_by_sender: bool = False
    notes: tuple[str, ...] = ()


class SampleReader:
    """Decodes the samples of one stream to frames.

    Attributes:
        packets: makes sweeps of the packets of this stream; None before any came.
    """

    def __init__(self, kind: str, stream: AnyStreamConfig, limits: LimitsConfig) -> None:
        """`kind` is what the stream brings: `CAMERA`, `LIDAR` or `EGO`."""
        self._kind = kind
        self._stream = stream
        self._limits = limits
        ego = stream if isinstance(stream, OpenEgoConfig) else None
        self._moving = None if ego is None else MovingFrame(ego.parent, ego.child)
        self._odometry = None if ego is None else OdometryMotion(ego.motion)
        self.packets: PacketAssembler | None = None
        self._descriptions: deque[bytes] = deque(maxlen=2)
        self._named: PacketSensor | None = None

    def frame(self, sample: InputSample) -> Frame | None:
        """The frame in a sample, or the sweep that it ends; None if it ends none, or holds only transforms of other
        frames than the vehicle's, or the first transforms, or says what the LiDAR is.

        Raises:
            DecodeError: the sample holds no frame, or one of another kind.
        """
        if sample.frame is not None:
            return msgpack_frames.as_decoded(sample.frame, self._limits)
        configured = self._stream
        encoding, _, schema = sample.encoding.partition(";")
        if encoding not in ("application/msgpack", CDR):
            encoding = f"application/{configured.encoding}"
        if encoding == CDR:
            type_name = schema or configured.assumed_type
            if type_name in (messages.STRING, messages.BYTES) and self._kind == LIDAR:
                self._describe(sample.payload)
                return None
            lidar = configured if isinstance(configured, OpenLidarConfig) else None
            if lidar is not None and not schema and lidar.type is None and lidar.has_packets:
                raise DecodeError(WRONG_TYPE, f"{lidar.place}: messages name no type: set lidar.type")
            if type_name not in configured.types:
                expected = " or ".join(configured.types)
                refusal = message_decoding.REFUSED.get(type_name, "a message of another type")
                raise DecodeError(WRONG_TYPE, f"{configured.place}: expected {expected}; {refusal}")
            if type_name in packet_streams.TYPES and lidar is not None:
                return self._sweep(type_name, sample, lidar.metadata)
            if type_name == messages.TF and self._moving is not None:
                return self._moving.motion(sample.payload)
            if type_name == messages.ODOMETRY and self._odometry is not None:
                return self._odometry.motion(sample.payload)
            time, source = (None, None) if lidar is None else (lidar.time, lidar.source)
            return message_decoding.decode(type_name, sample.payload, self._limits, point_time=time, source=source)
        if self._kind == CAMERA:
            return msgpack_frames.decode_camera(sample.payload, self._limits)
        if self._kind == LIDAR:
            return msgpack_frames.decode_lidar(sample.payload, self._limits)
        return msgpack_frames.decode_ego(sample.payload, self._limits)

    @property
    def note(self) -> str:
        """What was recognised of an odometry; empty: nothing."""
        return "" if self._odometry is None else self._odometry.note

    def _describe(self, text: bytes) -> None:
        if packet_streams.is_description(text) and len(text) <= packet_streams.MAX_DESCRIPTION_BYTES:
            if text not in self._descriptions:
                self._descriptions.append(text)
            if self.packets is not None:
                self.packets.describe(text)

    def _sweep(self, type_name: str, sample: InputSample, metadata: Path | None) -> LidarFrame | None:
        if self.packets is None or self.packets.type_name != type_name:
            if metadata is not None:
                try:
                    with metadata.open("rb") as file:
                        self._descriptions = deque([file.read(packet_streams.MAX_DESCRIPTION_BYTES)])
                except OSError as error:
                    text = f"cannot read lidar.metadata: {error.strerror}"
                    raise DecodeError(Refusal.MESSAGE_TYPE, text) from error
            self.packets = PacketAssembler(type_name)
            for described in self._descriptions:
                self.packets.describe(described)
        sent = MessageAttachment.parse(sample.attachment)
        frame = self.packets.add(sample.payload, time.time_ns() if sent is None else sent.source_ns)
        sensor = self.packets.sensor
        if frame is not None and sensor is not None and sensor is not self._named:
            self._named = sensor
            fields = {"sensor": self._stream.sensor}
            _log.info(f"packets of the LiDAR: {sensor.name}", extra={"fields": fields})
            for note in self.packets.notes:
                _log.log(logging.WARNING if note.level == "warn" else logging.INFO, note.text, extra={"fields": fields})
        return frame


class Decoder:
    """Decodes and checks the samples of one stream.

    Attributes:
        timed_by: how the point times of the latest sweep were read, see `LidarFrame`.
    """

    def __init__(self, kind: str, stream: KnownStreamConfig, limits: LimitsConfig, losses: LossCounter) -> None:
        """`kind` is what the stream brings, `CAMERA`, `LIDAR` or `EGO`. Its losses are counted at the place of this
        name."""
        self._kind = kind
        self._stream = stream
        self._samples = SampleReader(kind, stream, limits)
        self._limits = limits
        self._losses = losses
        self._senders = Senders()
        self._overruns: deque[bytes] = deque()
        self._stamped_by_sender = False
        self._own: deque[bool] = deque(maxlen=RECENT)
        self._moving_frame: str | None = None
        self._moved_otherwise = 0
        self._received = self._accepted = 0
        lidar = stream if isinstance(stream, LidarConfig) else None
        self._T_cloud_lidar = np.array(IDENTITY if lidar is None else lidar.T_cloud_lidar, dtype=np.float64)
        self._is_own_frame = lidar is None or (
            lidar.T_cloud_lidar == IDENTITY and lidar.cloud_frame_id in (None, lidar.frame_id)
        )
        self._origin = lidar_origin.OriginCheck()
        self._checked_period: int | None = None
        self._contradicted = False
        self._notes: tuple[str, ...] = ()
        self._covered: list[NDArray[np.bool_]] | None = []
        self._ordered = True
        self.timed_by = ""

    def counts(self) -> StreamCounts:
        """Counters since the start."""
        own = tuple(self._own)
        foreign = any(own) and not all(own)
        turns = self._senders.taking_turns
        return StreamCounts(self._received, self._accepted, turns, foreign, self._stamped_by_sender, self._notes)

    def _note(self, text: str) -> None:
        """Logs what was recognised, once."""
        if text and text not in self._notes:
            self._notes = (*self._notes, text)
            _log.warning(text, extra={"fields": {"sensor": self._stream.sensor}})

    @property
    def on_trial(self) -> bool:
        """Whether the latest frame is of a new sender, so that the one before may come back."""
        return self._senders.on_trial

    @property
    def contested(self) -> bool:
        """Whether several publishers send at the same time."""
        return bool(self._senders.taking_turns)

    def overrun(self, sample: InputSample) -> None:
        """A sample was dropped before it was decoded. For any thread."""
        self._losses.add(self._kind, "overrun")
        attachment = MessageAttachment.parse(sample.attachment)
        if attachment is not None:
            self._overruns.append(attachment.gid)
        elif sample.attachment is None and NUMBERED in sample.payload:
            self._overruns.append(UNNAMED_SENDER)

    def frame(self, sample: InputSample) -> Frame | None:
        """The frame in a sample, or the sweep that it ends. None if it was refused (and counted), or gives none (see
        `SampleReader.frame`). Never raises, whatever a sender sent."""
        self._received += 1
        while self._overruns:
            self._senders.counted(self._overruns.popleft())
        attachment = None if sample.attachment is None else self._attachment_of(sample.attachment)
        try:
            if len(sample.payload) > self._limits.max_message_bytes:
                raise DecodeError("message_too_large", "larger than limits.max_message_bytes")
            frame = self._samples.frame(sample)
            self._note(self._samples.note)
            if frame is None:
                return None
            self._check_times(frame)
            sender = self._sender(sample, frame) if attachment is None else attachment.gid
            frame = self._checked(self._stamped(frame, attachment), was_read=sample.frame is not None)
            self._own.append(True)
            if sender is not None:
                self._senders.took(sender)
            if self.contested:
                raise DecodeError(TWO_SENDERS, "several publishers send at the same time")
        except DecodeError as error:
            if error.reason in OTHERS:
                self._own.append(False)
            self._losses.add(self._kind, error.reason, detail=str(error) if error.reason in EXPLAINED else "")
            return None
        except Exception:
            # A fault of a decoder may cost the message, not the service.
            _log.exception("a decoder failed", extra={"fields": {"sensor": self._stream.sensor, "stream": self._kind}})
            self._losses.add(self._kind, "decoder_fault")
            return None
        self._accepted += 1
        if isinstance(frame, LidarFrame):
            self.timed_by = frame.timed_by
        return frame

    def _attachment_of(self, packed: bytes) -> MessageAttachment | None:
        """The attachment of the sender; its number is counted. A message with an unreadable attachment is still
        taken."""
        attachment = MessageAttachment.parse(packed)
        if attachment is None:
            self._losses.add(self._kind, "attachment_malformed")
        else:
            self._number(attachment.gid, attachment.sequence)
        return attachment

    def _number(self, sender: bytes, number: int) -> None:
        lost = self._senders.lost_by(sender, number)
        if lost:
            self._losses.add(self._kind, "sequence_gap", lost)

    def _sender(self, sample: InputSample, frame: Frame) -> bytes | None:
        """The id that stands for the sender of a message without a readable attachment; its number is counted. None: an
        attachment should name the sender, but cannot be read."""
        if sample.attachment is not None:
            return None
        sender, lost = self._senders.unnamed(sample.origin, frame.sequence, frame.stamp_ns)
        if lost:
            self._losses.add(self._kind, "sequence_gap", lost)
        return sender

    def _stamped(self, frame: Frame, attachment: MessageAttachment | None) -> Frame:
        """A frame without a stamp gets the time at which it was sent, instead of that of the measurement."""
        without = frame.stamp_ns == 0 and attachment is not None and attachment.source_ns > 0
        self._stamped_by_sender = without
        return replace(frame, stamp_ns=attachment.source_ns) if attachment is not None and without else frame

    def _checked(self, frame: Frame, *, was_read: bool) -> Frame:
        stream = self._stream
        if isinstance(frame, CameraFrame) and isinstance(stream, CameraConfig):
            _check_camera(frame, stream)
        elif isinstance(frame, LidarFrame) and isinstance(stream, LidarConfig):
            return self._from_origin(frame, stream, was_read=was_read)
        elif isinstance(frame, EgoMotion):
            self._check_motion(frame)
        return frame

    def _check_motion(self, motion: EgoMotion) -> None:
        """Ego-motion keeps to one frame, that of the first message, until `RECENT` in a row have another."""
        if motion.frame_id == self._moving_frame:
            self._moved_otherwise = 0
            return
        self._moved_otherwise += 1
        if self._moving_frame is not None and self._moved_otherwise < RECENT:
            raise DecodeError("frame_id", "differs from the frame id of earlier messages")
        self._moving_frame, self._moved_otherwise = motion.frame_id, 0

    def _from_origin(self, cloud: LidarFrame, lidar: LidarConfig, *, was_read: bool) -> LidarFrame:
        """The sweep in the LiDAR's own frame, after checking that its ranges were measured from the origin of that
        frame. The reader of a recording has checked those that it read."""
        if cloud.frame_id != (lidar.cloud_frame_id or lidar.frame_id):
            raise DecodeError("frame_id", "differs from the frame id in the configuration")
        sweep = cloud
        if self._covered is not None and not was_read:
            self._compare_sectors(cloud, self._covered)
        if not self._is_own_frame:
            sweep = lidar_origin.from_origin(cloud, self._T_cloud_lidar, lidar.frame_id)
        contradiction = None if was_read else self._contradiction(sweep)
        if contradiction is not None:
            raise DecodeError(contradiction.cause, f"{contradiction.sentence} See lidar.{contradiction.setting}.")
        return sweep if self._ordered else lidar_origin.unordered(sweep)

    def _compare_sectors(self, cloud: LidarFrame, covered: list[NDArray[np.bool_]]) -> None:
        """Whether the first clouds of a stream are parts of a turn; one that covers a whole turn ends the question."""
        covered.append(message_evidence.sectors(cloud))
        whole = covered[-1].sum() >= message_evidence.WHOLE * message_evidence.SECTORS
        if not whole and len(covered) < message_evidence.MOST_CLOUDS:
            return
        self._covered = None
        in_turn = 1 if whole else message_evidence.clouds_in_turn(covered)
        if in_turn > 1:
            self._note(
                f"each cloud covers a part of the turn, {in_turn} in a row the whole, and each is taken as a sweep: "
                "let the driver send whole turns (Velodyne: npackets, rpm, cut_angle)"
            )

    def _contradiction(self, sweep: LidarFrame) -> lidar_origin.ApparentOrigin | lidar_origin.SeveralOrigins | None:
        """What in a sweep contradicts the configured origin; None: nothing. Also notes whether rings are scan lines.
        Looks at the first sweep of each period of sensor time, and at every sweep while there is a contradiction."""
        period = sweep.stamp_ns // lidar_origin.PERIOD_NS
        if period == self._checked_period and not self._contradicted:
            return None
        self._checked_period = period
        if sweep.ring is not None and distinct_rings(sweep.ring) is None:
            self._note(ONE_RING)
        contradiction = self._origin.inspect(sweep)
        self._ordered = self._origin.has_scan_lines(sweep)
        if not self._ordered and ONE_RING not in self._notes:
            self._note(lidar_origin.NO_SCAN_LINES.text)
        self._contradicted = contradiction is not None
        return contradiction

    def _check_times(self, frame: Frame) -> None:
        time = self._stream.time if isinstance(self._stream, LidarConfig) else None
        if time is not None and isinstance(frame, LidarFrame) and frame.time_offset_s is None:
            what = f"the cloud has no field {time.field} of one number a point, which `lidar.time` names"
            raise DecodeError(Refusal.CLOUD_FIELDS, what)


def _check_camera(frame: CameraFrame, camera: CameraConfig) -> None:
    if frame.frame_id != camera.frame_id:
        raise DecodeError("frame_id", "differs from the frame id in the configuration")
    if (frame.image.width, frame.image.height) != (camera.intrinsics.width, camera.intrinsics.height):
        raise DecodeError("image_size", "differs from the size in the intrinsics")


# --- the stream of one sensor -----------------------------------------------------------------------------------------

RATE_FRAMES = 30
"""The rate is measured over the first so many frames."""

SILENT_S = 5.0
"""A stream counts as silent after so long without a frame, s."""

QUIET_S = 60.0
"""Time between two lines about the silence of one stream, s: an unsteady network must not fill the log."""


class StreamLog:
    """Belongs to the thread of the engine."""

    def __init__(self, kind: str, sensor: str) -> None:
        """`kind`: `camera`, `lidar` or `ego`. `sensor`: its name for people."""
        self._kind = kind
        self._fields = {"stream": kind, "sensor": sensor}
        self._frames = 0
        self._first_ns = 0
        self._latest_s = 0.0
        self._reported_s = -QUIET_S
        self._silent_since_s: float | None = None

    def push(self, frame: Frame, now_s: float) -> None:
        """A frame was accepted. `now_s`: steady clock, s."""
        self._frames += 1
        if self._frames == 1:
            self._first_ns = frame.stamp_ns
            _log.info(f"first {self._kind} frame: {_shape(frame)}", extra={"fields": self._fields})
        elif self._frames == RATE_FRAMES and frame.stamp_ns > self._first_ns:
            rate_hz = (RATE_FRAMES - 1) * NS_PER_S / (frame.stamp_ns - self._first_ns)
            _log.info(f"{self._kind} frames arrive at {rate_hz:.1f} Hz by their stamps", extra={"fields": self._fields})
        if self._silent_since_s is not None:
            silent_s = now_s - self._silent_since_s
            self._silent_since_s = None
            _log.info(f"{self._kind} frames arrive again after {silent_s:.0f} s", extra={"fields": self._fields})
        self._latest_s = now_s

    def tick(self, now_s: float) -> None:
        """Time has passed. `now_s`: steady clock, s."""
        if not self._frames or self._silent_since_s is not None or now_s - self._latest_s < SILENT_S:
            return
        if now_s - self._reported_s >= QUIET_S:
            self._reported_s, self._silent_since_s = now_s, self._latest_s
            text = f"no {self._kind} frames for {now_s - self._latest_s:.0f} s: check the sensor and the network"
            _log.warning(text, extra={"fields": self._fields})


def _shape(frame: Frame) -> str:
    match frame:
        case CameraFrame():
            return f"{frame.image.width}×{frame.image.height}, frame {frame.frame_id!r}"
        case LidarFrame():
            return f"{len(frame.xyz_m)} points, frame {frame.frame_id!r}"
        case EgoMotion():
            return f"frame {frame.frame_id!r}"


FRAMES_WAITING = 16
"""Samples of a camera or a LiDAR that may wait for the engine: 1.6 s at 10 Hz."""

MOTIONS_WAITING = 512
"""Ego-motion samples that may wait: 2.5 s at 200 Hz."""

PACKETS_WAITING = 4096
"""Messages of a LiDAR's packets that may wait: 2.5 s at 1,600 Hz, within the limit of bytes."""

READ_WITHOUT = frozenset({"name", "mask", "hardware_id", "info_topic", "sweep", "T_lidar_ego"})
"""Settings that do not change how the samples of a stream are read. Streams that differ only in these are one."""


def read_alike(kind: str, stream: KnownStreamConfig) -> tuple[str, str]:
    """A key that is equal for two streams if their samples give the same frames."""
    return kind, stream.model_dump_json(exclude=set(READ_WITHOUT))


Taker = Callable[[Frame, float], None]
"""Takes a frame, and the time of the steady clock at which it came, s."""


class SensorStream:
    """One stream. `counts` and `losses` are for any thread, everything else is for the thread of the engine.

    Attributes:
        kind: what the stream brings: camera frames, LiDAR sweeps or ego-motion.
        number: name of the stream in the inbox.
        log: its lines in the log.
        took: how long the decoding of each sample took.
        takers: functions that are to get each frame, in the order in which the frames came.
    """

    def __init__(self, kind: str, number: str, config: KnownStreamConfig, limits: LimitsConfig) -> None:
        self.kind = kind
        self.number = number
        self.config = config
        self.losses = LossCounter(_log, config.sensor, "sensor")
        self.decoder = Decoder(kind, config, limits, self.losses)
        self.log = StreamLog(kind, config.sensor)
        self.took = Histogram(QUICK_S)
        self.takers: tuple[Taker, ...] = ()
        self._on_trial: list[Frame] = []

    @property
    def depth(self) -> int:
        """How many samples may wait."""
        if isinstance(self.config, LidarConfig) and self.config.has_packets:
            return PACKETS_WAITING
        return MOTIONS_WAITING if self.kind == EGO else FRAMES_WAITING

    def take(self, sample: InputSample, now_s: float) -> list[Frame]:
        """Decodes a sample; returns the frames that may be used now. The first frames of a new sender are kept back
        until it has sent some in a row: if the sender before comes back, two are sending, and the frames of neither may
        be used. `now_s`: steady clock, s."""
        started_s = time.monotonic()
        frame = self.decoder.frame(sample)
        if frame is not None:
            self._on_trial.append(frame)
        usable: list[Frame] = []
        if self.decoder.contested:
            if self._on_trial:
                self.losses.add(self.kind, TWO_SENDERS, len(self._on_trial))
                self._on_trial.clear()
        elif not self.decoder.on_trial:
            usable, self._on_trial = self._on_trial, usable
        for each in usable:
            self.log.push(each, now_s)
        self.took.add(time.monotonic() - started_s, self.kind)
        return usable
