"""`coec play`: a recording published on Zenoh."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from coec.adapters.zenoh.client import connected, single_key
from coec.adapters.zenoh.player import Frame, Played, Player, Streams, repeated
from coec.calibration.types import CameraFrame, LidarFrame
from coec.cli.stopping import until_signal
from coec.config import Config, PairConfig, ZenohConfig, load_config
from coec.errors import SourceError, UsageError
from coec.reports import console
from coec.sources import Recording, open_source

CONNECT_S = 10.0
LISTENER_S = 5.0
"""How long to wait for a router, and for somebody who listens."""

DEFAULT_PERIOD_NS = 100_000_000
"""Between two passes of a recording with a single frame: 10 Hz."""


@dataclass(frozen=True, slots=True)
class Options:
    """The arguments of the command; None = not given."""

    source: str
    config: Path | None = None
    pair: str | None = None
    rate: float = 1.0
    loop: bool = False
    connect: str | None = None
    encoding: Literal["msgpack", "cdr"] = "msgpack"
    start_now: bool = False
    as_json: bool = False


def run(options: Options) -> int:
    """Publishes every frame.

    Raises:
        UsageError, ConfigError, SourceError: no such pair, configuration or recording.
        ConnectionFailedError: no router.
    """
    recording = open_source(options.source)
    pair, endpoints = _target(options)
    streams = Streams.default(options.pair or recording.rig.pair) if pair is None else Streams.of_pair(pair)
    single_key(streams.camera)
    _warn(recording, pair, options.encoding)
    shift_ns = time.time_ns() - _first_stamp_ns(recording) if options.start_now else 0
    with until_signal() as stop, connected(endpoints, CONNECT_S) as session:
        player = Player(session, streams, options.encoding)
        deaf = player.wait_for_listener(LISTENER_S)
        if deaf:
            console.say(f"coec: nobody listens to {', '.join(deaf)}; publishing all the same")
        frames = repeated(recording.messages, shift_ns, _pause_ns(recording), options.loop)
        started_s = time.monotonic()
        with _display(recording, options) as heard:
            played = player.play(frames, options.rate, stop, heard)
        elapsed_s = time.monotonic() - started_s
        player.close()
    _report(options, played, elapsed_s, deaf)
    return 0


def _target(options: Options) -> tuple[PairConfig | None, tuple[str, ...]]:
    """The pair of the configuration, if there is one, and where to connect."""
    given = (options.connect,) if options.connect else None
    if options.config is None:
        return None, given or ZenohConfig().router
    config = load_config(options.config)
    return _pair(config, options.pair), given or config.zenoh.router


def _pair(config: Config, name: str | None) -> PairConfig:
    pairs = [pair for pair in config.pairs if name in (None, pair.name)]
    if len(pairs) == 1:
        return pairs[0]
    known = ", ".join(pair.name for pair in config.pairs)
    raise UsageError(
        f"the configuration has {'no pair ' + name if name else 'several pairs'}: choose --pair of {known}"
    )


def _warn(recording: Recording, pair: PairConfig | None, encoding: str) -> None:
    """What the receiver is going to refuse, or to miss."""
    for frame in recording.messages([0]):
        if isinstance(frame, CameraFrame) and frame.depth is not None and encoding == "cdr":
            console.say("coec: ROS 2 messages carry no depth maps: the service needs a depth network for these frames")
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


def _first_stamp_ns(recording: Recording) -> int:
    for frame in recording.messages():
        return frame.stamp_ns
    raise SourceError(f"{recording.name} holds no frame")


def _pause_ns(recording: Recording) -> int:
    """Between two passes: the usual period of the camera."""
    stamps = np.diff(np.array(recording.camera_stamps_ns))
    return int(np.median(stamps)) if len(stamps) else DEFAULT_PERIOD_NS


@contextmanager
def _display(recording: Recording, options: Options) -> Iterator[Callable[[Frame, Played], None]]:
    total = None if options.loop else len(recording.camera_stamps_ns)
    rate = "as fast as it goes" if options.rate == 0 else f"× {options.rate:g}"
    with console.progress() as bars:
        task = bars.add_task(f"{recording.name} {rate}", total=total, note="")

        def heard(_frame: Frame, played: Played) -> None:
            counts = "  ".join(f"{stream} {count}" for stream, count in sorted(played.frames.items()))
            late = f"  {played.latest_late_s:.2f} s late" if played.latest_late_s > 0.1 else ""
            note = f"{counts}  {played.bytes / 1e6:.1f} MB{late}"
            bars.update(task, completed=played.frames["camera"], note=note)

        yield heard


def _report(options: Options, played: Played, elapsed_s: float, deaf: list[str]) -> None:
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
    console.show(f"published {counts} frames, {played.bytes / 1e6:.1f} MB in {elapsed_s:.1f} s{late}")
