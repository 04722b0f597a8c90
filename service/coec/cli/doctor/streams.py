"""Findings of `coec doctor` on the streams of pairs, from samples of some seconds, and on the topics of ROS.

The service is not disturbed: the doctor has a session of its own, and the service receives the same samples.
"""

import logging
import time
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import get_args

import numpy as np
import zenoh

from coec.calibration.types import NS_PER_S, CameraFrame, EgoMotion, Frame, LidarFrame
from coec.cli.doctor.environment import cause_of_silence, fail, ok, warn
from coec.config import IDENTITY, CameraMessage, Config, EgoMessage, LidarMessage, PacketMessage, PairConfig
from coec.errors import DecodeError
from coec.io.depth.depth_maps import STEREO
from coec.io.images import Inspector
from coec.io.logs import LossCounter
from coec.io.recordings.bag_recognition import compensated
from coec.io.recordings.clocks import offset_cause
from coec.io.zenoh.bus import Bus, InputSample, StreamInput, direct
from coec.io.zenoh.ros_node import RosSide, RosTopicList, listed
from coec.schemas.documents import Finding
from coec.schemas.keys import TF_STATIC
from coec.service.api.problems import PROBLEMS, stream_problems
from coec.service.discovery import info_topic_of, needs_transforms
from coec.service.ingest.decoder import CAMERA, EGO, LIDAR, PACKETS_WAITING, Decoder, StreamCounts

SAMPLES_WAITING = 8
"""Most samples of a stream that wait to be decoded; further ones are only counted."""

MOTIONS_WAITING = 512

SWEEPS = 6
"""Sweeps in which a compensation of the driver is looked for."""

SAMPLES_COUNTED = 200_000
"""Most samples of a stream whose arrival and size are noted: a minute at 3 kHz. A flood beyond that is not counted."""

POLL_S = 0.01

OFF_S = 1.0
"""Most time between the stamp of a frame and its arrival: a sweep takes 0.1 s, and its way here as much again."""

PACE = 0.1
"""Share by which sensor time may run faster or slower than this computer's clock, as in a replay."""

PARTNERS = 0.9
"""Least share of the camera frames that should have a sweep near in time."""

PERIOD = 0.1
"""Share by which the rate of sweeps may differ from `sweep.period_s`."""

LARGE = 0.8
"""Share of the largest accepted message from which on there is a warning."""

STREAM_TYPES = frozenset(
    name for known in (CameraMessage, LidarMessage, PacketMessage, EgoMessage) for name in get_args(known)
)
"""Message types that a stream may have."""

NAMED = 40
"""Most topics that are named; a vehicle with more sensors is better examined with ROS's own tools."""

_SILENT = logging.Logger("doctor")
_SILENT.addHandler(logging.NullHandler())


@dataclass(slots=True)
class StreamSamples:
    """The samples of one stream.

    Attributes:
        place: its key or topic.
        expressions: key expressions that its samples match.
        arrivals_s: when (steady clock) each sample arrived.
        sizes: bytes of each.
        stamps: sensor time of each frame, and the wall clock when its sample arrived, ns, in the order of arrival.
        refused: samples that made no frame, by reason.
        latest: the last frame.
        first: the first sweeps; of ego-motion, the first `MOTIONS_WAITING`.
        counts: counts of the senders, at the end.
        elsewhere: number of samples that a client of the same router got.
    """

    place: str
    expressions: tuple[str, ...] = ()
    arrivals_s: list[float] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)
    stamps: list[tuple[int, int]] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)
    latest: Frame | None = None
    first: list[Frame] = field(default_factory=list)
    counts: StreamCounts | None = None
    elsewhere: int = 0

    def count(self, sample: InputSample) -> None:
        """Counts a sample that is not decoded."""
        if len(self.arrivals_s) < SAMPLES_COUNTED:
            self.arrivals_s.append(time.monotonic())
            self.sizes.append(len(sample.payload))

    @property
    def rate_hz(self) -> float | None:
        """Samples per second; None with fewer than two samples."""
        if len(self.arrivals_s) < 2:
            return None
        spread_s = self.arrivals_s[-1] - self.arrivals_s[0]
        return (len(self.arrivals_s) - 1) / spread_s if spread_s > 0 else None


@dataclass(frozen=True, slots=True)
class Samples:
    """The samples that were received.

    Attributes:
        pairs: by stream, for each complete pair of the configuration.
        undiscovered: by place, the streams of pairs whose configuration is not complete. None of them is decoded.
    """

    pairs: list[dict[str, StreamSamples]]
    undiscovered: dict[str, StreamSamples]


def listen(
    session: zenoh.Session,
    client: zenoh.Session,
    ros: RosSide,
    config: Config,
    seconds: float,
    on_time: Callable[[float], None],
) -> Samples:
    """The samples received through a session as the service has it, and the number that a client of the same router
    receives. `on_time` is called now and then with the seconds that have passed."""
    pairs = [_PairSubscription(session, ros, pair, config) for pair in config.pairs]
    undiscovered, bus = _undiscovered(session, ros, config)
    every = [one for each in pairs for one in each.samples.values()] + list(undiscovered.values())
    counters = [counter for one in every for counter in _count_elsewhere(client, one)]
    started_s = time.monotonic()
    try:
        while (passed_s := time.monotonic() - started_s) < seconds:
            if sum(each.decode_next() for each in pairs) == 0:
                time.sleep(POLL_S)
            on_time(passed_s)
    finally:
        for each in pairs:
            each.close()
        bus.undeclare_inputs()
        for counter in counters:
            counter.undeclare()
    return Samples([each.samples for each in pairs], undiscovered)


def _undiscovered(session: zenoh.Session, ros: RosSide, config: Config) -> tuple[dict[str, StreamSamples], Bus]:
    """Listens, as the service does, to the streams of pairs that are not discovered yet."""
    bus, undiscovered = Bus(session), dict[str, StreamSamples]()

    def listen_to(
        place: str, stream: StreamInput, subscribe: Callable[[StreamInput, Callable[[InputSample], None]], object]
    ) -> None:
        if place not in undiscovered:
            undiscovered[place] = StreamSamples(place, stream.expressions)
            subscribe(stream, undiscovered[place].count)

    for pair in config.awaited:
        for stream in pair.streams.values():
            listen_to(stream.place, ros.input_of(stream), bus.subscribe)
        topic = info_topic_of(pair)
        if topic is not None:
            listen_to(topic, ros.input_of_info(topic), bus.subscribe_latched)
        if needs_transforms(pair):
            listen_to(TF_STATIC, ros.input_of_static_transforms(), bus.subscribe_latched)
    return undiscovered, bus


def _count_elsewhere(client: zenoh.Session, samples: StreamSamples) -> list[zenoh.Subscriber[None]]:
    def count(sample: zenoh.Sample) -> None:
        samples.elsewhere += sample.kind == zenoh.SampleKind.PUT

    return [client.declare_subscriber(expression, direct(count)) for expression in samples.expressions]


class _PairSubscription:
    """Subscribes to the streams of one pair."""

    def __init__(self, session: zenoh.Session, ros: RosSide, pair: PairConfig, config: Config) -> None:
        inputs = {name: ros.input_of(stream) for name, stream in pair.streams.items()}
        self.samples = {
            name: StreamSamples(stream.place, inputs[name].expressions) for name, stream in pair.streams.items()
        }
        depths = {EGO: MOTIONS_WAITING, LIDAR: PACKETS_WAITING if pair.lidar.has_packets else SAMPLES_WAITING}
        self._waiting: dict[str, deque[tuple[int, InputSample]]] = {
            name: deque(maxlen=depths.get(name, SAMPLES_WAITING)) for name in self.samples
        }
        self._losses = LossCounter(_SILENT, pair.name)
        self._decoders = {
            name: Decoder(name, stream, config.limits, self._losses) for name, stream in pair.streams.items()
        }
        self._subscribers = [
            one for name, stream in inputs.items() for one in stream.declared(session, self._receiver(name, stream))
        ]
        tokens = [stream.token for stream in inputs.values() if stream.token is not None]
        self._tokens = [session.liveliness().declare_token(token) for token in tokens]

    def close(self) -> None:
        """Stop listening, and decode what still waits."""
        for token in self._tokens:
            token.undeclare()
        for subscriber in self._subscribers:
            subscriber.undeclare()
        while self.decode_next():
            pass
        for name, samples in self.samples.items():
            samples.counts = self._decoders[name].counts()

    def decode_next(self) -> bool:
        """Decode the next sample of each stream; returns whether there was one."""
        any_sample = False
        for name, waiting in self._waiting.items():
            if not waiting:
                continue
            any_sample = True
            wall_ns, sample = waiting.popleft()
            frame = self._decoders[name].frame(sample)
            samples = self.samples[name]
            if frame is not None:
                samples.latest = frame
                if len(samples.first) < {LIDAR: SWEEPS, EGO: MOTIONS_WAITING}.get(name, 0):
                    samples.first.append(frame)
                samples.stamps.append((frame.stamp_ns, wall_ns))
            samples.refused = Counter(
                {
                    reason: count
                    for (place, reason), count in self._losses.snapshot().items()
                    if place == name and reason != "sequence_gap"  # samples that are not decoded leave gaps, too
                }
            )
        return any_sample

    def _receiver(self, name: str, stream: StreamInput) -> Callable[[zenoh.Sample, bool], None]:
        samples, waiting = self.samples[name], self._waiting[name]

        def receive(sample: zenoh.Sample, is_description: bool) -> None:
            if sample.kind != zenoh.SampleKind.PUT or len(samples.arrivals_s) >= SAMPLES_COUNTED:
                return
            received = stream.sample(sample, is_description)
            if not is_description:
                samples.count(received)
            waiting.append((time.time_ns(), received))

        return receive


def stream_findings(
    pair: PairConfig, streams: Mapping[str, StreamSamples], config: Config, seconds: float, topics: RosTopicList
) -> Iterator[Finding]:
    """Findings on the streams of one pair."""
    for name, one in streams.items():
        yield from _stream(pair, name, one, config, seconds, topics)
    counts = {name: one.counts for name, one in streams.items() if one.counts is not None}
    for reason in stream_problems(counts, pair, topics):
        yield warn("senders", pair.name, reason.text, PROBLEMS[reason.code].advice)
    for name, of_stream in counts.items():
        for text in of_stream.notes:
            yield warn("recognised", streams[name].place, f"{name}: {text}", "see that it is so; docs/recordings.md")
    camera, lidar, ego = streams[CAMERA], streams[LIDAR], streams.get(EGO)
    if camera.stamps and lidar.stamps:
        yield _in_step(pair, camera.stamps, lidar.stamps)
    if camera.stamps and ego is not None and ego.stamps:
        yield _with_motion(pair, camera.stamps, ego.stamps)
    if ego is not None and pair.calibration.motion_compensation:
        yield from _compensated(pair, lidar.first, ego.first)
    if isinstance(lidar.latest, LidarFrame):
        yield _point_times(pair, lidar.latest, None if pair.lidar.has_packets else lidar.rate_hz)
    if isinstance(camera.latest, CameraFrame):
        yield from _image(pair, camera.latest, config)


def _stream(
    pair: PairConfig, name: str, samples: StreamSamples, config: Config, seconds: float, topics: RosTopicList
) -> Iterator[Finding]:
    if not samples.arrivals_s:
        stream = pair.streams[name]
        absent = None if stream.topic is None else topics.absent(stream.topic, stream.types)
        yield _silent(name, samples, config, seconds, absent)
        return
    yield _rate(pair, name, samples, seconds)
    largest, limit = max(samples.sizes), config.limits.max_message_bytes
    if largest > LARGE * limit:
        text = f"{name}: {largest / 1e6:.1f} MB in the largest sample, of {limit / 1e6:.1f} that are accepted"
        yield warn("size", samples.place, text, "raise limits.max_message_bytes, here and at the router, or send less")
    if samples.refused:
        causes = ", ".join(f"{count} {reason}" for reason, count in samples.refused.most_common())
        advice = "check that encoding, type, frame id and image size are those of the configuration, and its limits"
        if samples.latest is None:
            yield fail("decoding", samples.place, f"{name}: no sample can be decoded: {causes}", advice)
        else:
            yield warn("decoding", samples.place, f"{name}: some samples cannot be decoded: {causes}", advice)
    if samples.stamps:
        yield _clock(name, samples)


def undiscovered_findings(
    undiscovered: Mapping[str, StreamSamples], config: Config, seconds: float, topics: RosTopicList
) -> Iterator[Finding]:
    """Findings on the streams of pairs whose configuration is not complete."""
    for place, samples in undiscovered.items():
        if samples.arrivals_s:
            count = len(samples.arrivals_s)
            rate = f"{samples.rate_hz:.1f} Hz" if samples.rate_hz else f"{count} message{'s' if count > 1 else ''}"
            yield ok("stream", place, f"{rate}, {median(samples.sizes) / 1e3:.1f} kB each")
        else:
            absent = None if topics.of(place) else f"no publisher of {place}"
            yield _silent("awaited", samples, config, seconds, absent)


def _silent(name: str, samples: StreamSamples, config: Config, seconds: float, absent: str | None) -> Finding:
    """The finding on a stream without samples; `absent` says that nobody publishes its topic."""
    text = f"{name}: no sample in {seconds:g} s"
    if samples.elsewhere:
        cause, advice = cause_of_silence(config)
        got = f"a client of the same router got {samples.elsewhere} samples"
        return fail("stream", samples.place, f"{text}, while {got}: {cause}", advice)
    if absent is not None:
        return fail("stream", samples.place, f"{text}: {absent}", "start its node, or name the topic that is meant")
    advice = (
        "check that its publisher runs, on this router, with this key or topic; and that the router's rules allow this "
        "certificate subscribe to it"
    )
    return fail("stream", samples.place, text, advice)


def _rate(pair: PairConfig, name: str, samples: StreamSamples, seconds: float) -> Finding:
    # From a single sample only this much is known: the next one did not come while the doctor listened.
    rate_hz = samples.rate_hz or 2.0 / seconds
    rate = f"{rate_hz:.1f} Hz" if samples.rate_hz else f"one sample in {seconds:g} s"
    load = sum(samples.sizes) / seconds / 1e6
    text = f"{name}: {rate}, {median(samples.sizes) / 1e3:.1f} kB each, {load:.1f} MB/s"
    monitor = pair.monitor
    if name == EGO:
        full_hz = least_hz = 0.5 / pair.pairing.motion_tolerance_s
        why = f"pairs need one within {pair.pairing.motion_tolerance_s:g} s"
    else:
        full_hz, least_hz = monitor.pairs / monitor.period_s, monitor.min_pairs / monitor.period_s
        why = f"a check uses {monitor.pairs} pairs in {monitor.period_s:g} s, and needs {monitor.min_pairs}"
    advice = "a faster stream, or a longer monitor.period_s"
    if rate_hz < least_hz:
        return fail("stream", samples.place, f"{text}: {why}", advice)
    if samples.rate_hz is None:
        return warn("stream", samples.place, f"{text}: {why}", "listen for longer (--seconds)")
    if rate_hz < full_hz:
        return warn("stream", samples.place, f"{text}: {why}", advice)
    return ok("stream", samples.place, text)


def _clock(name: str, samples: StreamSamples) -> Finding:
    """Compares the stamps with the clock of this computer."""
    late_s = median((wall_ns - stamp_ns) / NS_PER_S for stamp_ns, wall_ns in samples.stamps)
    back = sum(b[0] < a[0] for a, b in zip(samples.stamps, samples.stamps[1:], strict=False))
    sensor_s = (samples.stamps[-1][0] - samples.stamps[0][0]) / NS_PER_S
    here_s = (samples.stamps[-1][1] - samples.stamps[0][1]) / NS_PER_S
    if back:
        advice = "check the clock of the sensor: it steps back, or two sensors publish on one key"
        return warn("stamps", samples.place, f"{name}: {back} stamps step back", advice)
    if abs(late_s) > OFF_S:
        side = "behind" if late_s > 0 else "ahead of"
        text = f"{name}: its stamps are {abs(late_s):.1f} s {side} the clock of this computer"
        advice = "synchronise the sensor's clock (PTP); the calibration goes on, dates of the history are those stamps"
        return warn("stamps", samples.place, text, advice)
    if here_s > 1.0 and abs(sensor_s / here_s - 1.0) > PACE:
        text = f"{name}: its time runs {sensor_s / here_s:.2f} times as fast as this computer's"
        return warn("stamps", samples.place, text, "nothing, if this is a replay; else check the sensor's clock")
    return ok("stamps", samples.place, f"{name}: {1e3 * late_s:.0f} ms from stamp to arrival")


def _partners(
    stamps: Sequence[tuple[int, int]], of_others: Sequence[tuple[int, int]], tolerance_s: float
) -> tuple[float, float]:
    """Share of the frames with one of the others within a tolerance, and the median signed distance to the nearest,
    s."""
    others = sorted(stamp for stamp, _ in of_others)
    away_ns = []
    for stamp, _ in stamps:
        index = bisect_left(others, stamp)
        away_ns.append(min((one - stamp for one in others[max(index - 1, 0) : index + 1]), key=abs))
    # At both ends of the recorded time a partner may be missing.
    inside = away_ns[1:-1] or away_ns
    share = sum(abs(away) <= tolerance_s * NS_PER_S for away in inside) / len(inside)
    return share, median(away_ns) / NS_PER_S


def _in_step(pair: PairConfig, camera: Sequence[tuple[int, int]], lidar: Sequence[tuple[int, int]]) -> Finding:
    """Whether camera and LiDAR are in step, by their stamps."""
    where, tolerance_s = pair.name, pair.pairing.tolerance_s
    share, typical_s = _partners(camera, lidar, tolerance_s)
    text = f"camera and LiDAR: {100 * share:.0f} % of the frames have a sweep within {tolerance_s:g} s"
    if share == 0.0:
        cause = offset_cause(typical_s, camera[0][0] / NS_PER_S, lidar[0][0] / NS_PER_S)
        text += f"; they are {abs(typical_s):.3f} s apart{cause}"
        return fail("in_step", where, text, "put both sensors on one clock (PTP), or correct the driver's stamps")
    if share < PARTNERS:
        advice = "trigger the camera by the LiDAR, or raise pairing.tolerance_s; frames without a partner are dropped"
        return warn("in_step", where, text, advice)
    return ok("in_step", where, f"{text}, typically {1e3 * typical_s:+.1f} ms")


def _with_motion(pair: PairConfig, camera: Sequence[tuple[int, int]], ego: Sequence[tuple[int, int]]) -> Finding:
    tolerance_s = pair.pairing.motion_tolerance_s
    share, _ = _partners(camera, ego, tolerance_s)
    text = f"ego-motion: {100 * share:.0f} % of the frames have one within {tolerance_s:g} s"
    if share < PARTNERS:
        advice = "put both on one clock; without ego-motion sweeps are not compensated, and standing is not seen"
        return warn("in_step", pair.name, text, advice)
    return ok("in_step", pair.name, text)


def _compensated(pair: PairConfig, sweeps: Sequence[Frame], motions: Sequence[Frame]) -> Iterator[Finding]:
    """The finding on sweeps that the driver has compensated for motion; none while the vehicle stands."""
    of_lidar = [one for one in sweeps if isinstance(one, LidarFrame)]
    of_vehicle = [one for one in motions if isinstance(one, EgoMotion)]
    T_lidar_ego = np.array(pair.ego.T_lidar_ego if pair.ego is not None else IDENTITY, np.float64)
    instant, _ = compensated(of_lidar, of_vehicle, T_lidar_ego)
    if instant is not None:
        text = f"the points are compensated for motion already, for the {instant} of each sweep"
        advice = "let the driver publish raw points, or set calibration.motion_compensation: false"
        yield warn("compensation", pair.lidar.place, text, advice)


def _point_times(pair: PairConfig, cloud: LidarFrame, rate_hz: float | None) -> Finding:
    """The finding on the times of points within a sweep."""
    key, times_s = pair.lidar.place, cloud.time_offset_s
    count = len(cloud.xyz_m)
    if count == 0:
        return fail("point_times", key, "the last sweep has no point", "check the LiDAR")
    if times_s is None:
        return _by_azimuth(pair, rate_hz)
    first_s, last_s = float(np.min(times_s)), float(np.max(times_s))
    read = cloud.timed_by or f"measured {1e3 * first_s:+.1f} to {1e3 * last_s:+.1f} ms from the stamp"
    text = f"{count} points, {read}"
    period_s = 1.0 / rate_hz if rate_hz else 0.1
    if max(abs(first_s), abs(last_s)) > 2.0 * period_s:
        advice = "the field holds another unit, or time since another moment: correct it in the driver"
        return fail("point_times", key, f"{text}: further than two sweeps", advice)
    if last_s == first_s:
        advice = "have the driver fill in the field, or leave it out and set lidar.sweep"
        return warn("point_times", key, f"{text}: all equal, so sweeps cannot be compensated", advice)
    return ok("point_times", key, text)


def _by_azimuth(pair: PairConfig, rate_hz: float | None) -> Finding:
    key, sweep = pair.lidar.place, pair.lidar.sweep
    if sweep is None:
        if not pair.calibration.motion_compensation:
            return ok("point_times", key, "none, and none are needed: sweeps are not compensated")
        advice = "have the driver send a time of each point, or set lidar.sweep for a spinning LiDAR"
        return warn("point_times", key, "points have no time: sweeps cannot be compensated", advice)
    if rate_hz is not None and abs(rate_hz * sweep.period_s - 1.0) > PERIOD:
        text = f"lidar.sweep.period_s is {sweep.period_s:g} s, but sweeps come every {1.0 / rate_hz:.3f} s"
        return warn("point_times", key, text, "correct lidar.sweep, or find out why sweeps are lost")
    return ok("point_times", key, "of the azimuth, by lidar.sweep")


def _image(pair: PairConfig, frame: CameraFrame, config: Config) -> Iterator[Finding]:
    """Findings on the picture itself, which the service inspects when it cuts a window."""
    key, window = pair.camera.place, pair.window
    try:
        quality = Inspector(config.limits).inspect(frame)
    except DecodeError as error:
        yield fail("image", key, f"the image cannot be decoded: {error}", "check the camera's encoder")
        return
    levels = f"level {quality.mean_level:.0f} of 255, {100 * quality.clipped:.0f} % clipped"
    levels += f", sharpness {quality.sharpness:.3f}"
    defects = [
        word
        for word, wrong in (
            ("too dark", quality.mean_level < window.min_mean_level),
            ("clipped", quality.clipped > window.max_clipped),
            ("blurred", quality.sharpness < window.min_sharpness),
        )
        if wrong
    ]
    if defects:
        advice = "clean the lens, check exposure and focus; windows are not cut from such pictures (pair window.*)"
        yield warn("image", key, f"{levels}: {', '.join(defects)}", advice)
    else:
        yield ok("image", key, levels)
    if pair.calibration.depth.model == STEREO and frame.depth is None:
        advice = "send depth maps with the frames, or name a network in calibration.depth.model"
        yield fail("depth", key, "frames carry no depth map, and the configuration requires them", advice)


def topic_findings(here: RosTopicList, topics: RosTopicList, config: Config) -> Iterator[Finding]:
    """Findings on topics: types and nodes of those that may be streams, and the number of others; and those of them
    that the service does not see.

    Args:
        here: topics seen through a session as the service opens it.
        topics: those that a client of the router sees.
    """
    is_rmw = config.middleware == "rmw_zenoh"
    where = f"domain {config.ros.domain}" if is_rmw else f"bridge {config.ros.namespace}".strip()
    if not topics.publishers:
        advice = (
            "check that nodes and bridge use this router, that ros.domain or ros.namespace is theirs, and that the "
            "router's rules let this certificate see @ros2_lv/** (docs/security.md)"
        )
        yield warn("topics", where, "no node on this router announces a topic of ROS", advice)
    else:
        types = topics.types()
        lines = [
            f"{topic} ({', '.join(kinds)}{_from(topics, topic)})"
            for topic, kinds in types.items()
            if not STREAM_TYPES.isdisjoint(kinds)
        ]
        more = f"; {len(lines) - NAMED} more such" if len(lines) > NAMED else ""
        others = len(types) - len(lines)
        named = "; ".join(lines[:NAMED]) if lines else "none that may be a stream"
        yield ok("topics", where, f"{named}{more}; {others} of other types")
        unseen = [topic for topic in types if not here.of(topic)]
        if unseen:
            cause, advice = cause_of_silence(config)
            yield fail("topics", where, f"the service does not see {listed(unseen)}: {cause}", advice)
    if topics.left_out:
        counted = ", ".join(f"{count} {cause}" for cause, count in sorted(topics.left_out.items()))
        advice = "check which program declares them: no node of ROS does"
        yield warn("topics", where, f"liveliness tokens that were not read: {counted}", advice)


def _from(topics: RosTopicList, topic: str) -> str:
    nodes = sorted({one.node for one in topics.of(topic) if one.node})
    return f", by {', '.join(nodes)}" if nodes else ""
