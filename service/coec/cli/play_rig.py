"""`coec play sim:rig=...`: publishes all sensors of a simulated rig, each on its own key or topics."""

from __future__ import annotations

import time
from collections.abc import Iterator

from coec.adapters.ros.sensor_topics import SensorTopics
from coec.adapters.ros.topics import TopicInfo, TopicMessage
from coec.adapters.zenoh.cadence import repeated
from coec.adapters.zenoh.client import connected
from coec.adapters.zenoh.player import Player, SensorKeys, shifted
from coec.cli.commands.play import Options
from coec.cli.play import CONNECT_S, LISTENER_S, Target, display, report, say_deaf, say_without_depth
from coec.cli.play_topics import Programme
from coec.cli.rig_configuration import vehicle_of
from coec.cli.stopping import until_signal
from coec.errors import UsageError
from coec.simulation.source import open_rig
from coec.sources.spec import SourceSpec


def frames(options: Options, target: Target, spec: SourceSpec) -> int:
    """Publishes every frame on `sensors/<sensor>`, ego-motion on `sensors/ego`.

    Raises:
        UsageError, SourceError: see `open_rig`; or a configuration was given, whose keys are those of one pair.
        ConnectionFailedError: no router.
    """
    if options.config is not None or options.pair is not None:
        raise UsageError(f"{spec.text} is all sensors of a rig: leave --config and --pair out, or add &pair=...")
    drive = open_rig(spec.query)
    keys = SensorKeys(("ego", *drive.lidars, *drive.cameras))
    sensors = (*drive.lidars, *drive.cameras)
    shift_ns = time.time_ns() - drive.plan[0].stamp_ns if options.start_now else 0
    with until_signal() as stop, connected(target.endpoints, CONNECT_S) as session:
        player = Player(session, keys, options.encoding)
        deaf = player.wait_for_listener(LISTENER_S)
        say_deaf(deaf)
        passes = repeated(drive.messages, shifted, shift_ns, _pause_ns(drive.config.camera_hz), options.loop)
        started_s = time.monotonic()
        total = sum(entry.stream != drive.stream("ego") for entry in drive.plan)
        with display(drive.name, total, options, counted=sensors) as heard:
            played = player.play(passes, options.rate, stop, heard)
        elapsed_s = time.monotonic() - started_s
        player.close()
    report(options, played, elapsed_s, deaf, "frames")
    return 0


def programme_of(spec: SourceSpec) -> Programme:
    """The rig as topics of ROS 2.

    Raises:
        UsageError, SourceError: see `open_rig`.
    """
    drive = open_rig(spec.query)
    vehicle = vehicle_of(drive)
    if drive.config.depth:
        say_without_depth()

    def told() -> Iterator[TopicMessage]:
        topics = SensorTopics(vehicle)
        for frame in drive.messages():
            yield from topics.of(frame)

    infos: dict[str, TopicInfo] = {}
    topics = SensorTopics(vehicle)
    for sensor in ("ego", *drive.lidars, *drive.cameras):
        places = [entry for entry in drive.plan if entry.stream == drive.stream(sensor)]
        for message in topics.of(drive.message(places[0])) if places else ():
            infos[message.topic] = TopicInfo(message.type_name, len(places))
    return Programme(drive.name, infos, lambda _: told(), _pause_ns(drive.config.camera_hz))


def _pause_ns(hz: float) -> int:
    return round(1e9 / hz)
