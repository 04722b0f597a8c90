"""`coec play`: publishes a recording on Zenoh, as frames of a pair or on topics of ROS 2."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from coec.adapters.zenoh.cadence import Played, Stamped, repeated
from coec.adapters.zenoh.client import connected, single_key
from coec.adapters.zenoh.player import Player, Streams, shifted
from coec.calibration.types import CameraFrame, LidarFrame
from coec.cli.commands.play import Middleware, Options
from coec.cli.stopping import until_signal
from coec.config import Config, OpenPairConfig, RosConfig, ZenohConfig, load_config
from coec.errors import SourceError, UsageError
from coec.reports import console
from coec.sources import Recording, open_source
from coec.sources.spec import is_rig, parse_spec

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


def run(options: Options) -> int:
    """Publishes every frame, or every message.

    Raises:
        UsageError, ConfigError, SourceError: no such pair, configuration, recording or topic.
        ConnectionFailedError: no router.
    """
    target = _target(options)
    if target.middleware == "native":
        return _frames(options, target)
    from coec.cli.play_topics import topics

    return topics(options, target, target.middleware)


def _frames(options: Options, target: Target) -> int:
    if options.topics or options.domain is not None:
        raise UsageError("--topics and --domain are of ROS 2: add --middleware rmw_zenoh or ros2dds")
    if is_rig(spec := parse_spec(options.source)):
        from coec.cli.play_rig import frames as frames_of_rig

        return frames_of_rig(options, target, spec)
    recording = open_source(options.source)
    pair = target.pair
    streams = Streams.default(options.pair or recording.rig.pair) if pair is None else Streams.of_pair(pair)
    single_key(streams.camera)
    _warn(recording, pair, options.encoding)
    shift_ns = time.time_ns() - first_stamp_ns(recording) if options.start_now else 0
    with until_signal() as stop, connected(target.endpoints, CONNECT_S) as session:
        player = Player(session, streams, options.encoding)
        deaf = player.wait_for_listener(LISTENER_S)
        say_deaf(deaf)
        frames = repeated(recording.messages, shifted, shift_ns, pause_ns(recording), options.loop)
        started_s = time.monotonic()
        with display(recording.name, len(recording.camera_stamps_ns), options, counted=("camera",)) as heard:
            played = player.play(frames, options.rate, stop, heard)
        elapsed_s = time.monotonic() - started_s
        player.close()
    report(options, played, elapsed_s, deaf, "frames")
    return 0


def _target(options: Options) -> Target:
    given = (options.connect,) if options.connect else None
    if options.config is None:
        endpoints = given or ZenohConfig().router
        return Target(None, endpoints, options.middleware or "native", _ros(RosConfig(), options))
    config = load_config(options.config)
    endpoints = given or config.zenoh.router
    return Target(
        _pair(config, options.pair), endpoints, options.middleware or config.middleware, _ros(config.ros, options)
    )


def _ros(configured: RosConfig, options: Options) -> RosConfig:
    return configured if options.domain is None else configured.model_copy(update={"domain": options.domain})


def _pair(config: Config, name: str | None) -> OpenPairConfig:
    pairs = [pair for pair in config.every_pair if name in (None, pair.name)]
    if len(pairs) == 1:
        return pairs[0]
    known = ", ".join(pair.name for pair in config.every_pair)
    raise UsageError(
        f"the configuration has {'no pair ' + name if name else 'several pairs'}: choose --pair of {known}"
    )


def _warn(recording: Recording, pair: OpenPairConfig | None, encoding: str) -> None:
    """Prints what the receiver is going to refuse or to miss."""
    for frame in recording.messages([0]):
        if isinstance(frame, CameraFrame) and frame.depth is not None and encoding == "cdr":
            say_without_depth()
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


def say_without_depth() -> None:
    """Says that the depth maps of a recording are not sent with its frames."""
    console.say("coec: ROS 2 messages carry no depth maps: the service needs a depth network for these frames")


def say_deaf(deaf: list[str]) -> None:
    """Says on which streams nobody listens, if there are any."""
    if deaf:
        console.say(f"coec: nobody listens to {', '.join(deaf)}; publishing all the same")


def first_stamp_ns(recording: Recording) -> int:
    """Stamp of the first frame of a recording.

    Raises:
        SourceError: the recording has no frame.
    """
    for frame in recording.messages():
        return frame.stamp_ns
    raise SourceError(f"{recording.name} holds no frame")


def pause_ns(recording: Recording) -> int:
    """Time between two passes: the usual period of the camera."""
    stamps = np.diff(np.array(recording.camera_stamps_ns))
    return int(np.median(stamps)) if len(stamps) else DEFAULT_PERIOD_NS


@contextmanager
def display(
    name: str, total: int, options: Options, *, counted: tuple[str, ...]
) -> Iterator[Callable[[Stamped, Played], None]]:
    """A progress bar to call after each frame; it counts the frames of the streams `counted`, `total` in all."""
    rate = "as fast as it goes" if options.rate == 0 else f"× {options.rate:g}"
    with console.progress() as bars:
        task = bars.add_task(f"{name} {rate}", total=None if options.loop else total, note="")

        def heard(_item: Stamped, played: Played) -> None:
            counts = "  ".join(f"{stream} {count}" for stream, count in sorted(played.frames.items()))
            late = f"  {played.latest_late_s:.2f} s late" if played.latest_late_s > 0.1 else ""
            note = f"{counts}  {played.bytes / 1e6:.1f} MB{late}"
            bars.update(task, completed=sum(played.frames[stream] for stream in counted), note=note)

        yield heard


def report(options: Options, played: Played, elapsed_s: float, deaf: list[str], what: str) -> None:
    """Prints what was published: the number of `what` by stream."""
    if options.as_json:
        console.print_json(
            {
                "frames": dict(played.frames),
                "bytes": played.bytes,
                "elapsed_s": elapsed_s,
                "late_s": played.late_s,
                "nobody_listened_to": deaf,
            }
        )
        return
    counts = ", ".join(f"{count} {stream}" for stream, count in sorted(played.frames.items()))
    late = f", at most {played.late_s:.2f} s late" if options.rate > 0 else ""
    console.show(f"published {counts} {what}, {played.bytes / 1e6:.1f} MB in {elapsed_s:.1f} s{late}")
