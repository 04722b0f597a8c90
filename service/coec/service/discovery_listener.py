"""The thread that listens for what the configuration leaves out: first frames, `CameraInfo`, `/tf_static`.

Samples wait in bounded queues that the network's threads fill; everything else belongs to this thread. The main thread
takes what was found, and builds the pairs. Afterwards the thread goes on listening to `/tf_static` and `CameraInfo`. If
they then say something else, that is reported but changes nothing.
"""

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame, Reason
from coec.config import Config, OpenPairConfig
from coec.errors import DecodeError
from coec.io.logs import loss_text
from coec.io.ros import messages
from coec.io.ros.camera_info import MAX_INFO_BYTES, decode_info
from coec.io.ros.packet_streams import PacketSensor, is_description
from coec.io.ros.transforms import MAX_MESSAGE_BYTES, StaticTransform, StaticTransforms, decode_static_transforms
from coec.io.system import ServiceThread
from coec.io.zenoh.bus import CDR, InputSample
from coec.service.discovery import DiscoveredPair, ReceivedImage, ReceivedMetadata, change_since, discover
from coec.service.ingest.decoder import CAMERA, EXPLAINED, LIDAR, SampleReader

_log = logging.getLogger(__name__)

TRANSFORMS_WAITING = 512
"""How many messages of static transforms may wait. A vehicle has some ten publishers with one message each."""

MAX_WAITING_BYTES = 8 * 2**20
"""Limit for all these messages together, bytes: several thousand transforms."""

TOO_LARGE = InputSample(bytes(MAX_INFO_BYTES + 1), CDR)
"""Waits in place of a `CameraInfo` that is too large."""

TRANSFORMS_A_TURN = 64
"""How many messages are taken in one turn. With a turn every `IDLE_S` a flood costs at most some 250 messages a
second."""

IDLE_S = 0.25
"""Time between two turns, s."""

POINTS = 2000
"""How many points of a cloud show which frame is the camera's."""

INFO = "info"
"""Place of a loss: a `CameraInfo`. The streams `camera` and so on are places, too."""

DESCRIPTION = "description"
"""Place of a loss: a message in which a LiDAR says what it is."""

TRANSFORMS = "tf_static"
"""Place of a loss: a message of static transforms."""


@dataclass(frozen=True, slots=True)
class NominalStatus:
    """What is known of a pair's nominal calibration.

    Attributes:
        awaits: a reason for each thing that is missing; empty for a pair that is built.
        origins: where each found value comes from, by its place in the configuration.
        changed: in what the bus contradicts the values by now; None: in nothing.
        losses: number of samples that could not be used, by place and cause; those of `/tf_static` are counted for the
            whole vehicle.
    """

    awaits: tuple[Reason, ...] = ()
    origins: Mapping[str, str] = field(default_factory=dict)
    changed: Reason | None = None
    losses: Mapping[str, int] = field(default_factory=dict)


NOTHING_RECEIVED = NominalStatus(
    awaits=(Reason("no_look_yet", "The discovery of what the configuration leaves out has not begun yet."),)
)


BEING_BUILT = Reason("being_built", "Everything that the configuration leaves out is known; the pair is being built.")


@dataclass(slots=True)
class _PendingPair:
    """An awaited pair and what was heard of it."""

    pair: OpenPairConfig
    samples: Mapping[str, SampleReader]
    received: ReceivedMetadata = field(default_factory=ReceivedMetadata)
    discovered: DiscoveredPair | None = None
    built: bool = False
    refused: Reason | None = None
    news: bool = True
    lost: Counter[str] = field(default_factory=Counter)

    def count_loss(self, place: str, cause: str) -> None:
        self.news = True
        self.lost[f"{place}_{cause}"] += 1
        _log_loss(place, cause, self.lost[f"{place}_{cause}"])


class DiscoveryListener:
    """Listens for the awaited pairs of a vehicle. `take_*` are for the network's threads, `update` for this thread, all
    else for any."""

    def __init__(self, config: Config, earlier: Mapping[str, DiscoveredPair]) -> None:
        """`config` is the configuration as it was read. `earlier` holds those of its awaited pairs that are built with
        values from before the start."""
        self.thread = ServiceThread("discovery", self._run)
        self._config = config
        requested = {pair.name: pair for pair in config.awaited}
        self._pairs = {
            name: _PendingPair(
                pair,
                {stream: SampleReader(stream, one, config.limits) for stream, one in pair.streams.items()},
                ReceivedMetadata(max_message_bytes=config.limits.max_message_bytes),
                discovered=earlier.get(name),
                built=name in earlier,
            )
            for name, pair in requested.items()
        }
        self._transforms = StaticTransforms()
        self._condition = threading.Condition()
        # Under the condition.
        self._waiting: deque[InputSample] = deque()
        self._waiting_bytes = 0
        self._latest: dict[tuple[str, str], InputSample] = {}
        self._transforms_lost: Counter[str] = Counter()
        self._ready: dict[str, DiscoveredPair] = {}
        self._outcomes: dict[str, DiscoveredPair | Reason] = {}
        self._nominals: Mapping[str, NominalStatus] = MappingProxyType(
            {
                name: _of_built(earlier[name], None) if each.built else NOTHING_RECEIVED
                for name, each in self._pairs.items()
            }
        )

    # --- on the network's threads -----------------------------------------------------------------------------------

    def take_transforms(self, sample: InputSample) -> None:
        """A message on `/tf_static` came."""
        with self._condition:
            if len(sample.payload) > MAX_MESSAGE_BYTES:
                self._transforms_lost["message_too_large"] += 1
                return
            self._waiting.append(sample)
            self._waiting_bytes += len(sample.payload)
            while len(self._waiting) > TRANSFORMS_WAITING or self._waiting_bytes > MAX_WAITING_BYTES:
                self._waiting_bytes -= len(self._waiting.popleft().payload)
                self._transforms_lost["overrun"] += 1

    def take_info(self, pair: str, sample: InputSample) -> None:
        """A `CameraInfo` of a pair came; the newest counts."""
        bounded = sample if len(sample.payload) <= MAX_INFO_BYTES else TOO_LARGE
        with self._condition:
            self._latest[pair, INFO] = bounded

    def take_frame(self, pair: str, stream: str, sample: InputSample) -> None:
        """A frame of a pair that is awaited came, or a packet, or what a LiDAR says of itself; the newest of each
        counts."""
        of_packets = stream == LIDAR and self._pairs[pair].pair.lidar.has_packets
        with self._condition:
            self._latest[pair, DESCRIPTION if of_packets and is_description(sample.payload) else stream] = sample

    # --- on any -----------------------------------------------------------------------------------------------------

    def nominal(self, pair: str) -> NominalStatus:
        """The nominal calibration of a pair; empty for a pair whose configuration gives everything."""
        return self._nominals.get(pair, NominalStatus())

    def ready(self) -> dict[str, DiscoveredPair]:
        """Takes out the pairs that were completed since the last call."""
        with self._condition:
            ready, self._ready = self._ready, {}
        return ready

    def end(self, pair: str, outcome: DiscoveredPair | Reason) -> None:
        """Reports what became of a pair that was ready: it is built; or it cannot be built, for a reason, and is
        awaited until something else is heard."""
        with self._condition:
            self._outcomes[pair] = outcome

    # --- on the thread ----------------------------------------------------------------------------------------------

    def _run(self, thread: ServiceThread) -> None:
        while not thread.stopping:
            thread.beat()
            self.update()
            time.sleep(IDLE_S)

    def update(self) -> None:
        """Takes what has come, and judges each pair anew."""
        with self._condition:
            count = min(len(self._waiting), TRANSFORMS_A_TURN)
            transforms = [self._waiting.popleft() for _ in range(count)]
            self._waiting_bytes -= sum(len(sample.payload) for sample in transforms)
            latest, self._latest = self._latest, {}
            outcomes, self._outcomes = self._outcomes, {}
        for sample in transforms:
            self._take_transforms(sample)
        for (name, stream), sample in latest.items():
            self._take_latest(self._pairs[name], stream, sample)
        for name, outcome in outcomes.items():
            self._take_outcome(self._pairs[name], outcome)
        fresh = {name: self._nominal(each) for name, each in self._pairs.items() if each.news or transforms}
        if fresh:
            self._nominals = MappingProxyType({**self._nominals, **fresh})

    def _take_outcome(self, each: _PendingPair, outcome: DiscoveredPair | Reason) -> None:
        each.news = True
        if isinstance(outcome, DiscoveredPair):
            each.built, each.discovered = True, outcome
            for place, origin in outcome.origins.items():
                fields = {"pair": each.pair.name, "place": place, "from": origin}
                _log.info("discovered what the configuration omits", extra={"fields": fields})
        else:
            each.refused = outcome

    def _take_transforms(self, sample: InputSample) -> None:
        refused: list[str] = []

        def add() -> None:
            decoded = decode_static_transforms(_payload(sample, messages.TF))
            refused.extend(error.reason for error in decoded.refused.values())
            self._transforms.refuse(decoded.refused)
            self._transforms.add(decoded.joints)

        error = _attempt(add)
        for lost in (*refused, *([] if error is None else [error.reason])):
            with self._condition:
                self._transforms_lost[lost] += 1
                count = self._transforms_lost[lost]
            _log_loss(TRANSFORMS, lost, count)

    def _take_latest(self, each: _PendingPair, stream: str, sample: InputSample) -> None:
        if each.built and stream != INFO:
            return
        take = self._take_info if stream == INFO else self._take_frame
        error = _attempt(lambda: take(each, stream, sample))
        refused = each.received.refused
        if error is None:
            each.news |= refused.pop(stream, None) is not None
            return
        refused[stream] = str(error) if error.reason in EXPLAINED else error.reason
        each.count_loss(stream, error.reason)

    def _take_info(self, each: _PendingPair, stream: str, sample: InputSample) -> None:
        del stream
        info = decode_info(_payload(sample, messages.CAMERA_INFO))
        known = each.received.info
        if info.k[0] == 0.0 and known is not None and known.k[0] != 0.0:
            # A driver that starts, or a second camera that is not calibrated, takes nothing away.
            each.count_loss(INFO, "uncalibrated")
            return
        each.news |= info != known
        each.received.info = info
        if each.received.dropped_bytes(each.pair):
            # Zenoh drops such images, and tells nobody: each CameraInfo stands for one.
            each.count_loss(CAMERA, "message_too_large")  # an image above `limits.max_message_bytes`

    def _take_frame(self, each: _PendingPair, stream: str, sample: InputSample) -> None:
        received, reader = each.received, each.samples[LIDAR if stream == DESCRIPTION else stream]
        before = (received.image, received.cloud, received.ego, received.packets, _names(received))
        frame = reader.frame(sample)
        if stream == LIDAR and reader.packets is not None and reader.packets.sensor is not None:
            # Of a turn, some packets come here: enough to know the sensor.
            sensor = reader.packets.sensor
            received.packets = " ".join((f"{sensor.name}.", *(note.text for note in reader.packets.notes)))
            received.cloud = sensor.frame_id
            received.add_name(stream, sensor.frame_id)
            self._place(sensor)
            frame = None
        match frame:
            case CameraFrame() as frame:
                received.image = ReceivedImage(frame.frame_id, frame.image.width, frame.image.height)
                received.add_name(stream, frame.frame_id)
            case LidarFrame() as frame:
                received.cloud, received.points_m = frame.frame_id, frame.xyz_m[:: len(frame.xyz_m) // POINTS + 1]
                received.add_name(stream, frame.frame_id)
            case EgoMotion() as frame:
                received.ego = frame.frame_id
        each.news |= before != (received.image, received.cloud, received.ego, received.packets, _names(received))

    def _place(self, sensor: PacketSensor) -> None:
        """Adds where the sensor says that its frame is, if nobody else does."""
        frames = self._transforms.frames
        if sensor.pose is not None and sensor.frame_id not in frames and sensor.pose[0] in frames:
            self._transforms.add((StaticTransform(sensor.pose[0], sensor.frame_id, sensor.pose[1]),))

    def _nominal(self, each: _PendingPair) -> NominalStatus:
        each.news = False
        return replace(self._judged(each), losses=self._lost(each))

    def _judged(self, each: _PendingPair) -> NominalStatus:
        if each.built and each.discovered is not None:
            return _of_built(each.discovered, change_since(each.discovered, each.pair, each.received, self._transforms))
        result = discover(each.pair, each.received, self._transforms)
        if not isinstance(result, DiscoveredPair):
            each.discovered = each.refused = None
            return NominalStatus(awaits=result)
        if each.discovered is None or each.discovered.pair != result.pair:
            each.discovered, each.refused = result, None
            with self._condition:
                self._ready[each.pair.name] = result
        return NominalStatus(awaits=(each.refused or BEING_BUILT,), origins=result.origins)

    def _lost(self, each: _PendingPair) -> dict[str, int]:
        with self._condition:
            of_transforms = {f"{TRANSFORMS}_{cause}": count for cause, count in self._transforms_lost.items()}
        return {**of_transforms, **each.lost}


def _names(received: ReceivedMetadata) -> set[tuple[str, str]]:
    return {(stream, name) for stream, names in received.names.items() for name in names}


def _attempt(take: Callable[[], None]) -> DecodeError | None:
    """Takes a sample; returns the error if that fails. A fault of a decoder costs the sample, not the service."""
    try:
        take()
    except DecodeError as error:
        return error
    except Exception:
        _log.exception("a decoder failed")
        return DecodeError("decoder_fault", "the decoder failed: its log says why")
    return None


def _log_loss(place: str, cause: str, count: int) -> None:
    """Logs the first loss of each kind, and then every 2^n-th."""
    if count & (count - 1) == 0:
        fields = {"place": place, "reason": cause, "count": count}
        _log.warning(loss_text(place, cause), extra={"fields": fields})


def _of_built(discovered: DiscoveredPair, otherwise: Reason | None) -> NominalStatus:
    return NominalStatus(origins=discovered.origins, changed=otherwise)


def _payload(sample: InputSample, expected: str) -> bytes:
    """The bytes of a sample of this type.

    Raises:
        DecodeError: the sample says that it is of another type.
    """
    encoding, _, type_name = sample.encoding.partition(";")
    if encoding == CDR and type_name not in ("", expected):
        raise DecodeError("wrong_type", f"a message of another type: expected {expected}")
    return sample.payload
