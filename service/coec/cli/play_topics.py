"""`coec play --middleware rmw_zenoh|ros2dds`: plays a bag on its own topics, other recordings on those of a pair."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

from coec.adapters.ros.later import shifted
from coec.adapters.ros.topics import FrameTopics, PairTopics, TopicInfo, TopicMessage
from coec.adapters.zenoh.cadence import repeated
from coec.adapters.zenoh.client import connected
from coec.adapters.zenoh.topic_player import Middleware, TopicPlayer, dialect_of, is_playable
from coec.calibration.types import CameraFrame, Rig
from coec.cli.commands.play import Options
from coec.cli.play import (
    CONNECT_S,
    DEFAULT_PERIOD_NS,
    LISTENER_S,
    Target,
    display,
    pause_ns,
    report,
    say_deaf,
    say_without_depth,
)
from coec.cli.stopping import until_signal
from coec.config import OpenPairConfig
from coec.errors import DecodeError, SourceError, UsageError
from coec.reports import console
from coec.reports.page.words import count
from coec.schemas.ros_names import TF_STATIC
from coec.sources import open_source
from coec.sources.spec import SourceSpec, is_bag, is_rig, parse_spec


@dataclass(frozen=True, slots=True)
class Programme:
    """A recording as topics that can be played.

    Attributes:
        infos: the topics; counts are of one pass.
        messages: one pass over the messages of given topics, ascending by stamp.
        pause_ns: time between two passes.
    """

    name: str
    infos: Mapping[str, TopicInfo]
    messages: Callable[[Iterable[str]], Iterator[TopicMessage]]
    pause_ns: int


def topics(options: Options, target: Target, middleware: Middleware) -> int:
    """Publishes every message of the requested topics, or of all.

    Raises:
        UsageError, SourceError: no such recording or topic, or a message whose stamps cannot be shifted to now.
        ConnectionFailedError: no router.
    """
    if options.encoding != "msgpack":
        raise UsageError("--encoding is of frames on the keys of a pair: topics of ROS 2 carry CDR")
    spec = parse_spec(options.source)
    programme = _programme(spec, options, target)
    chosen = _chosen(programme, _split(options.topics), middleware)
    first = next(programme.messages(chosen), None)
    if first is None:
        raise SourceError(f"{programme.name} holds no message on {', '.join(chosen)}")
    shift_ns = time.time_ns() - first.stamp_ns if options.start_now else 0
    with until_signal() as stop, connected(target.endpoints, CONNECT_S) as session:
        dialect = dialect_of(middleware, session, target.ros.domain, target.ros.namespace)
        player = TopicPlayer(session, dialect, {topic: info.type_name for topic, info in chosen.items()})
        deaf = player.wait_for_listener(_awaited(chosen, target.pair), LISTENER_S, stop)
        say_deaf(deaf)
        passes = repeated(lambda: programme.messages(chosen), shifted, shift_ns, programme.pause_ns, options.loop)
        started_s = time.monotonic()
        total = sum(info.count for info in chosen.values())
        try:
            with display(programme.name, total, options, counted=tuple(chosen)) as heard:
                played = player.play(passes, options.rate, stop, heard)
        except DecodeError as error:
            raise SourceError(f"{programme.name}: {error}") from error
        finally:
            player.close()
        elapsed_s = time.monotonic() - started_s
    report(options, played, elapsed_s, deaf, "messages")
    return 0


def _programme(spec: SourceSpec, options: Options, target: Target) -> Programme:
    if is_bag(spec):
        return _bag(spec)
    if is_rig(spec):
        from coec.cli.play_rig import programme_of

        return programme_of(spec)
    return _frames(options, target.pair)


def _bag(spec: SourceSpec) -> Programme:
    from coec.sources.bag.topics import open_topics

    if not spec.path.exists():
        raise SourceError(f"{spec.path} does not exist")
    bag = open_topics(spec)
    return Programme(bag.name, bag.infos, lambda topics: bag.messages(frozenset(topics)), DEFAULT_PERIOD_NS)


def _frames(options: Options, pair: OpenPairConfig | None) -> Programme:
    """A recording that is no bag, on the topics of the configuration's pair, or else on those below `/<pair>/`."""
    recording = open_source(options.source)
    rig: Rig = recording.rig
    named = PairTopics.default(options.pair or rig.pair) if pair is None else PairTopics.of_pair(pair)

    def told(cameras: list[int] | None = None) -> Iterator[TopicMessage]:
        frames = FrameTopics(rig, recording.T_camera_lidar_start, named)
        for frame in recording.messages(cameras):
            yield from frames.of(frame)

    if any(isinstance(frame, CameraFrame) and frame.depth is not None for frame in recording.messages([0])):
        say_without_depth()
    images = len(recording.camera_stamps_ns)
    motions = len(recording.motion_stamps_ns)
    counts = {named.points: len(recording.sweep_stamps_ns), named.motion: motions, named.turns: motions}
    infos = {message.topic: TopicInfo(message.type_name, images) for message in told([0])}
    infos = {topic: TopicInfo(info.type_name, counts.get(topic, info.count)) for topic, info in infos.items()}
    return Programme(recording.name, infos, lambda _: told(), pause_ns(recording))


def _split(asked: list[str] | None) -> tuple[str, ...]:
    return tuple(topic for given in asked or () for topic in given.split(","))


def _chosen(programme: Programme, asked: tuple[str, ...], middleware: Middleware) -> dict[str, TopicInfo]:
    """The topics to play: the requested ones, else all that can be played; says which are left out."""
    infos = programme.infos
    unknown = [topic for topic in asked if topic not in infos]
    if unknown:
        told = ", ".join(f"{topic} ({info.type_name}, {count(info.count, 'message')})" for topic, info in infos.items())
        raise UsageError(f"{programme.name} has no topic {', '.join(unknown)}; there: {told or 'none'}")
    wanted = {topic: info for topic, info in infos.items() if not asked or topic in asked}
    chosen = {topic: info for topic, info in wanted.items() if is_playable(middleware, topic, info.type_name)}
    left = ", ".join(f"{topic!a} ({info.type_name!a})" for topic, info in wanted.items() if topic not in chosen)
    if left and (asked or not chosen):
        raise UsageError(f"{left} cannot be played: no names of ROS, or rmw_zenoh's hash of the type is not known")
    if left:
        console.say(f"coec: not played, no names of ROS, or types of which rmw_zenoh's hash is not known: {left}")
    return chosen


def _awaited(chosen: Iterable[str], pair: OpenPairConfig | None) -> list[str]:
    """The topics that need a listener before the first message is sent: those of the configured pair, or all."""
    ours = [topic for topic in chosen if topic != TF_STATIC]
    configured = {stream.topic for stream in pair.streams.values()} if pair is not None else None
    missing = sorted(topic for topic in configured or () if topic is not None and topic not in ours)
    if missing and pair is not None:
        console.say(f"coec: pair {pair.name} listens to {', '.join(missing)}, which is not played")
    return ours if configured is None else [topic for topic in ours if topic in configured]
