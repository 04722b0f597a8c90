"""`coec play`: publishes a recording on Zenoh, as frames of a pair or on topics of ROS 2."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from coec.cli.options import Connect, Json, Source, until_signal
from coec.errors import DecodeError, SourceError, UsageError
from coec.reports import console
from coec.reports.formatting import count
from coec.schemas.keys import TF_STATIC

if TYPE_CHECKING:
    from coec.calibration.types import Rig
    from coec.config import Config, OpenPairConfig, RosConfig
    from coec.io.recordings.layouts import RecordingSource
    from coec.io.recordings.recording_source import SourceSpec
    from coec.io.ros.topics import TopicInfo, TopicMessage
    from coec.io.zenoh.player import Played, SensorKeys, Stamped, StreamKeys

RosMiddleware = Literal["rmw_zenoh", "ros2dds"]
Middleware = Literal["native", "rmw_zenoh", "ros2dds"]
"""How a recording speaks on the bus."""

Encoding = Literal["msgpack", "cdr"]
"""Of frames."""

CONNECT_S = 10.0

LISTENER_S = 5.0
"""How long to wait for a router, and for a listener."""

DEFAULT_PERIOD_NS = 100_000_000
"""Time between two passes of a recording with a single frame: 10 Hz."""


@dataclass(frozen=True, slots=True)
class Target:
    """Where to publish: the pair of the configuration, if there is one, the routers, and the middleware there."""

    pair: OpenPairConfig | None
    endpoints: tuple[str, ...]
    middleware: Middleware
    ros: RosConfig


@dataclass(frozen=True, slots=True)
class Pace:
    """How to play: multiple of the recorded speed (0: without waiting), repeatedly or once, and with stamps shifted to
    now or as recorded."""

    rate: float
    loop: bool
    start_now: bool

    def shift_ns(self, first_stamp_ns: int) -> int:
        """By how much stamps are shifted."""
        return time.time_ns() - first_stamp_ns if self.start_now else 0


@dataclass(frozen=True, slots=True)
class FrameProgramme:
    """Frames to publish on the keys of sensors.

    Attributes:
        keys: the key of each stream.
        messages: one pass over the frames, ascending by stamp.
        counted: streams whose frames a progress bar counts, `total` in a pass.
        period_ns: time between two passes.
    """

    name: str
    keys: StreamKeys | SensorKeys
    messages: Callable[[], Iterator[Any]]
    first_stamp_ns: int
    counted: tuple[str, ...]
    total: int
    period_ns: int


@dataclass(frozen=True, slots=True)
class TopicProgramme:
    """Topics of ROS 2 to publish.

    Attributes:
        infos: the topics; counts are of one pass.
        messages: one pass over the messages of given topics, ascending by stamp.
        period_ns: time between two passes.
    """

    name: str
    infos: Mapping[str, TopicInfo]
    messages: Callable[[Iterable[str]], Iterator[TopicMessage]]
    period_ns: int


@dataclass(frozen=True, slots=True)
class Published:
    """What was published, of frames or messages, and which streams have no subscriber."""

    played: Played
    elapsed_s: float
    unsubscribed: list[str]


def play(
    source: Source,
    config: Annotated[Path | None, typer.Option(help="Take the keys of the pair from this file.", metavar="FILE")] = (
        None
    ),
    pair: Annotated[
        str | None,
        typer.Option(
            help="Pair of the configuration; without --config, the name in `sensors/<pair>/camera|lidar|ego`."
        ),
    ] = None,
    middleware: Annotated[
        Middleware | None,
        typer.Option(
            help="native: frames on the keys of a pair. rmw_zenoh, ros2dds: a bag on its own topics, byte for byte; "
            "any other recording on those of the configuration's pair, or below `/<pair>/`.",
            show_default="that of --config, else native",
        ),
    ] = None,
    topics: Annotated[
        list[str] | None,
        typer.Option(
            "--topics", help="Play only these ROS 2 topics; separated by commas, or repeatable.", show_default="all"
        ),
    ] = None,
    domain: Annotated[
        int | None,
        typer.Option(help="ROS_DOMAIN_ID (rmw_zenoh).", min=0, max=232, show_default="that of --config, else 0"),
    ] = None,
    rate: Annotated[float, typer.Option(help="Factor on the recorded speed; 0 = without waiting.", min=0)] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", help="Repeat for ever; sensor time goes on.")] = False,
    connect: Connect = None,
    encoding: Annotated[Encoding, typer.Option(help="Encoding of the frames.")] = "msgpack",
    start_now: Annotated[bool, typer.Option("--start-now", help="Shift all stamps so that the first is now.")] = False,
    as_json: Json = False,
) -> int:
    """Publish a recording on Zenoh, as its sensors would have."""
    from coec.io.recordings.recording_source import is_rig, parse_spec

    target = _target(config, pair, middleware, domain, connect)
    pace = Pace(rate, loop, start_now)
    if target.middleware != "native":
        if encoding != "msgpack":
            raise UsageError("--encoding is of frames on the keys of a pair: topics of ROS 2 carry CDR")
        published = _publish_topics(_topics(source, pair, target), _split(topics), target, target.middleware, pace)
        _report(published, pace, "messages", as_json=as_json)
        return 0
    if topics or domain is not None:
        raise UsageError("--topics and --domain apply to ROS 2: add --middleware rmw_zenoh or ros2dds")
    spec = parse_spec(source)
    if is_rig(spec):
        if config is not None or pair is not None:
            raise UsageError(f"{source} contains all sensors of a rig: omit --config and --pair, or add &pair=...")
        programme = _rig_frames(spec)
    else:
        programme = _frames(source, pair, target, encoding)
    _report(_publish_frames(programme, target, encoding, pace), pace, "frames", as_json=as_json)
    return 0


def _target(
    file: Path | None, pair: str | None, middleware: Middleware | None, domain: int | None, connect: str | None
) -> Target:
    from coec.config import RosConfig, ZenohConfig, load_config

    given = (connect,) if connect else None
    if file is None:
        return Target(None, given or ZenohConfig().router, middleware or "native", _ros(RosConfig(), domain))
    config = load_config(file)
    endpoints = given or config.zenoh.router
    return Target(_pair(config, pair), endpoints, middleware or config.middleware, _ros(config.ros, domain))


def _ros(configured: RosConfig, domain: int | None) -> RosConfig:
    return configured if domain is None else configured.model_copy(update={"domain": domain})


def _pair(config: Config, name: str | None) -> OpenPairConfig:
    pairs = [pair for pair in config.every_pair if name in (None, pair.name)]
    if len(pairs) == 1:
        return pairs[0]
    known = ", ".join(pair.name for pair in config.every_pair)
    raise UsageError(
        f"the configuration has {'no pair ' + name if name else 'several pairs'}: name one with --pair: {known}"
    )


def _publish_frames(programme: FrameProgramme, target: Target, encoding: Encoding, pace: Pace) -> Published:
    """Publishes every frame.

    Raises:
        ConnectionFailedError: no router.
    """
    from coec.io.zenoh.player import Player, repeated, shifted
    from coec.io.zenoh.query_client import connected

    shift_ns = pace.shift_ns(programme.first_stamp_ns)
    with until_signal() as stop, connected(target.endpoints, CONNECT_S) as session:
        player = Player(session, programme.keys, encoding)
        unsubscribed = player.wait_for_listener(LISTENER_S)
        _warn_unsubscribed(unsubscribed)
        passes = repeated(programme.messages, shifted, shift_ns, programme.period_ns, pace.loop)
        started_s = time.monotonic()
        with _progress(programme.name, programme.total, pace, counted=programme.counted) as on_item:
            played = player.play(passes, pace.rate, stop, on_item)
        elapsed_s = time.monotonic() - started_s
        player.close()
    return Published(played, elapsed_s, unsubscribed)


def _publish_topics(
    programme: TopicProgramme, requested: tuple[str, ...], target: Target, middleware: RosMiddleware, pace: Pace
) -> Published:
    """Publishes every message of the requested topics, or of all.

    Raises:
        UsageError, SourceError: no such topic, or a message whose stamps cannot be shifted to now.
        ConnectionFailedError: no router.
    """
    from coec.io.ros import messages
    from coec.io.ros.topics import shifted as shifted_message
    from coec.io.zenoh.player import TopicPlayer, dialect_of, repeated
    from coec.io.zenoh.query_client import connected

    selected = _select(programme, requested, middleware)
    first = next(programme.messages(selected), None)
    if first is None:
        raise SourceError(f"{programme.name} holds no message on {', '.join(selected)}")
    shift_ns = pace.shift_ns(first.stamp_ns)
    inside = sorted(topic for topic, info in selected.items() if info.type_name in messages.OTHER_TYPES)
    if inside and pace.start_now:
        console.say(f"coec: stamps stay as recorded, because they are within packets: {', '.join(inside)}")
    with until_signal() as stop, connected(target.endpoints, CONNECT_S) as session:
        dialect = dialect_of(middleware, session, target.ros.domain, target.ros.namespace)
        player = TopicPlayer(session, dialect, {topic: info.type_name for topic, info in selected.items()})
        unsubscribed = player.wait_for_listener(_needing_listener(selected, target.pair), LISTENER_S, stop)
        _warn_unsubscribed(unsubscribed)
        passes = repeated(
            lambda: programme.messages(selected), shifted_message, shift_ns, programme.period_ns, pace.loop
        )
        started_s = time.monotonic()
        total = sum(info.count for info in selected.values())
        try:
            with _progress(programme.name, total, pace, counted=tuple(selected)) as on_item:
                played = player.play(passes, pace.rate, stop, on_item)
        except DecodeError as error:
            raise SourceError(f"{programme.name}: {error}") from error
        finally:
            player.close()
        elapsed_s = time.monotonic() - started_s
    return Published(played, elapsed_s, unsubscribed)


def _frames(source: str, name: str | None, target: Target, encoding: Encoding) -> FrameProgramme:
    from coec.io.recordings.layouts import open_source
    from coec.io.zenoh.player import StreamKeys
    from coec.io.zenoh.query_client import single_key

    recording, pair = open_source(source), target.pair
    streams = StreamKeys.default(name or recording.rig.pair) if pair is None else StreamKeys.of_pair(pair)
    single_key(streams.camera)
    _warn(recording, pair, encoding)
    return FrameProgramme(
        recording.name,
        streams,
        recording.messages,
        _first_stamp_ns(recording),
        ("camera",),
        len(recording.camera_stamps_ns),
        _period_ns(recording),
    )


def _rig_frames(spec: SourceSpec) -> FrameProgramme:
    from coec.io.recordings.recording_source import installed_layout

    rig = installed_layout("sim").open_played_rig(spec.query)
    return FrameProgramme(rig.name, rig.keys, rig.messages, rig.first_stamp_ns, rig.sensors, rig.frames, rig.period_ns)


def _topics(source: str, pair: str | None, target: Target) -> TopicProgramme:
    """The topics of a recording: those of a bag as they are, those of a simulated rig, else those of the configured
    pair, or below `/<pair>/`."""
    from coec.io.recordings.bag import open_topics
    from coec.io.recordings.recording_source import installed_layout, is_bag, is_rig, parse_spec

    spec = parse_spec(source)
    if is_bag(spec):
        if not spec.path.exists():
            raise SourceError(f"{spec.path} does not exist")
        bag = open_topics(spec)
        return TopicProgramme(bag.name, bag.infos, lambda topics: bag.messages(frozenset(topics)), DEFAULT_PERIOD_NS)
    if is_rig(spec):
        rig = installed_layout("sim").open_played_rig(spec.query)
        if rig.has_depth:
            _warn_no_depth()
        return TopicProgramme(rig.name, rig.topic_infos(), lambda _: rig.topic_messages(), rig.period_ns)
    return _pair_topics(source, pair, target.pair)


def _pair_topics(source: str, name: str | None, pair: OpenPairConfig | None) -> TopicProgramme:
    from coec.calibration.types import CameraFrame
    from coec.io.recordings.layouts import open_source
    from coec.io.ros.topics import FrameTopics, PairTopics, TopicInfo

    recording = open_source(source)
    rig: Rig = recording.rig
    named = PairTopics.default(name or rig.pair) if pair is None else PairTopics.of_pair(pair)

    def messages(cameras: list[int] | None = None) -> Iterator[TopicMessage]:
        frames = FrameTopics(rig, recording.T_camera_lidar_start, named)
        for frame in recording.messages(cameras):
            yield from frames.of(frame)

    if any(isinstance(frame, CameraFrame) and frame.depth is not None for frame in recording.messages([0])):
        _warn_no_depth()
    images = len(recording.camera_stamps_ns)
    motions = len(recording.motion_stamps_ns)
    counts = {named.points: len(recording.sweep_stamps_ns), named.motion: motions, named.turns: motions}
    infos = {message.topic: TopicInfo(message.type_name, images) for message in messages([0])}
    infos = {topic: TopicInfo(info.type_name, counts.get(topic, info.count)) for topic, info in infos.items()}
    return TopicProgramme(recording.name, infos, lambda _: messages(), _period_ns(recording))


def _split(requested: list[str] | None) -> tuple[str, ...]:
    return tuple(topic for given in requested or () for topic in given.split(","))


def _select(programme: TopicProgramme, requested: tuple[str, ...], middleware: RosMiddleware) -> dict[str, TopicInfo]:
    """The topics to play: the requested ones, else all that can be played; prints which are left out."""
    from coec.io.zenoh.player import is_playable

    infos = programme.infos
    unknown = [topic for topic in requested if topic not in infos]
    if unknown:
        known = ", ".join(
            f"{topic} ({info.type_name}, {count(info.count, 'message')})" for topic, info in infos.items()
        )
        raise UsageError(f"{programme.name} has no topic {', '.join(unknown)}; there: {known or 'none'}")
    candidates = {topic: info for topic, info in infos.items() if not requested or topic in requested}
    selected = {topic: info for topic, info in candidates.items() if is_playable(middleware, topic, info.type_name)}
    left = ", ".join(f"{topic!a} ({info.type_name!a})" for topic, info in candidates.items() if topic not in selected)
    if left and (requested or not selected):
        raise UsageError(f"{left} cannot be played: no names of ROS, or rmw_zenoh's hash of the type is not known")
    if left:
        console.say(f"coec: not played, no names of ROS, or types of which rmw_zenoh's hash is not known: {left}")
    return selected


def _needing_listener(selected: Iterable[str], pair: OpenPairConfig | None) -> list[str]:
    """The topics that need a listener before the first message is sent: those of the configured pair, or all."""
    ours = [topic for topic in selected if topic != TF_STATIC]
    configured = {stream.topic for stream in pair.streams.values()} if pair is not None else None
    missing = sorted(topic for topic in configured or () if topic is not None and topic not in ours)
    if missing and pair is not None:
        console.say(f"coec: pair {pair.name} listens to {', '.join(missing)}, which is not played")
    return ours if configured is None else [topic for topic in ours if topic in configured]


def _warn(recording: RecordingSource, pair: OpenPairConfig | None, encoding: str) -> None:
    """Prints what the receiver will refuse or miss."""
    from coec.calibration.types import CameraFrame, LidarFrame

    for frame in recording.messages([0]):
        if isinstance(frame, CameraFrame) and frame.depth is not None and encoding == "cdr":
            _warn_no_depth()
        expected = None
        if pair is not None and isinstance(frame, CameraFrame):
            expected = pair.camera.frame_id
        elif pair is not None and isinstance(frame, LidarFrame):
            expected = pair.lidar.frame_id
        if expected not in (None, frame.frame_id):
            console.say(
                f"coec: pair {pair.name if pair else ''} expects frame id {expected!r}, these frames have "
                f"{frame.frame_id!r}: the service will refuse them"
            )


def _warn_no_depth() -> None:
    """Prints that the depth maps of a recording are not sent with its frames."""
    console.say("coec: ROS 2 messages carry no depth maps: the service needs a depth network for these frames")


def _warn_unsubscribed(streams: list[str]) -> None:
    """Prints which streams have no subscriber."""
    if streams:
        console.say(f"coec: nobody listens to {', '.join(streams)}; publishing all the same")


def _first_stamp_ns(recording: RecordingSource) -> int:
    """Stamp of the first frame of a recording.

    Raises:
        SourceError: the recording has no frame.
    """
    for frame in recording.messages():
        return frame.stamp_ns
    raise SourceError(f"{recording.name} holds no frame")


def _period_ns(recording: RecordingSource) -> int:
    """Time between two passes: the usual period of the camera."""
    import numpy as np

    stamps = np.diff(np.array(recording.camera_stamps_ns))
    return int(np.median(stamps)) if len(stamps) else DEFAULT_PERIOD_NS


@contextmanager
def _progress(
    name: str, total: int, pace: Pace, *, counted: tuple[str, ...]
) -> Iterator[Callable[[Stamped, Played], None]]:
    """A progress bar to call after each frame; it counts the frames of the streams `counted`, `total` in all."""
    rate = "as fast as it goes" if pace.rate == 0 else f"× {pace.rate:g}"
    with console.progress() as bars:
        task = bars.add_task(f"{name} {rate}", total=None if pace.loop else total, note="")

        def on_item(_item: Stamped, played: Played) -> None:
            counts = "  ".join(f"{stream} {count}" for stream, count in sorted(played.frames.items()))
            late = f"  {played.latest_late_s:.2f} s late" if played.latest_late_s > 0.1 else ""
            note = f"{counts}  {played.bytes / 1e6:.1f} MB{late}"
            bars.update(task, completed=sum(played.frames[stream] for stream in counted), note=note)

        yield on_item


def _report(published: Published, pace: Pace, what: str, *, as_json: bool) -> None:
    """Prints what was published: the number of `what` by stream."""
    played, elapsed_s = published.played, published.elapsed_s
    if as_json:
        console.print_json(
            {
                "frames": dict(played.frames),
                "bytes": played.bytes,
                "elapsed_s": elapsed_s,
                "late_s": played.late_s,
                "nobody_listened_to": published.unsubscribed,
            }
        )
        return
    counts = ", ".join(f"{count} {stream}" for stream, count in sorted(played.frames.items()))
    late = f", at most {played.late_s:.2f} s late" if pace.rate > 0 else ""
    console.show(f"published {counts} {what}, {played.bytes / 1e6:.1f} MB in {elapsed_s:.1f} s{late}")
