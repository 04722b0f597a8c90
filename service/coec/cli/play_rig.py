"""A simulated rig as `coec play` publishes it: all sensors, each on its own key or topics."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from coec.adapters.ros.sensor_topics import SensorTopics
from coec.adapters.ros.topics import TopicInfo, TopicMessage
from coec.adapters.zenoh.player import SensorKeys
from coec.cli.rig_configuration import vehicle_of
from coec.simulation.rig_drive import RigDrive
from coec.simulation.source import open_rig
from coec.sources.spec import SourceSpec


class PlayedRig:
    """The drive of a rig. Frames are on `sensors/<sensor>`, ego-motion on `sensors/ego`.

    Attributes:
        sensors: LiDARs and cameras; `frames`: number of their frames in a pass.
        keys: the key of each sensor.
        period_ns: time between two passes.
        has_depth: whether images come with depth maps, which topics of ROS have no place for.
    """

    def __init__(self, drive: RigDrive) -> None:
        self._drive = drive
        self._vehicle = vehicle_of(drive)
        self.name = drive.name
        self.sensors = (*drive.lidars, *drive.cameras)
        self.frames = sum(entry.stream != drive.stream("ego") for entry in drive.plan)
        self.keys = SensorKeys(("ego", *self.sensors))
        self.first_stamp_ns = drive.plan[0].stamp_ns
        self.period_ns = round(1e9 / drive.config.camera_hz)
        self.has_depth = drive.config.depth

    def messages(self) -> Iterator[Any]:
        """One pass over the frames, ascending by stamp."""
        yield from self._drive.messages()

    def topic_messages(self) -> Iterator[TopicMessage]:
        """One pass over the messages of all topics."""
        topics = SensorTopics(self._vehicle)
        for frame in self._drive.messages():
            yield from topics.of(frame)

    def topic_infos(self) -> dict[str, TopicInfo]:
        """The topics, with the number of messages in a pass."""
        drive, topics = self._drive, SensorTopics(self._vehicle)
        infos: dict[str, TopicInfo] = {}
        for sensor in ("ego", *self.sensors):
            entries = [entry for entry in drive.plan if entry.stream == drive.stream(sensor)]
            for message in topics.of(drive.message(entries[0])) if entries else ():
                infos[message.topic] = TopicInfo(message.type_name, len(entries))
        return infos


def open_played_rig(spec: SourceSpec) -> PlayedRig:
    """The rig that a source names.

    Raises:
        UsageError, SourceError: see `open_rig`.
    """
    return PlayedRig(open_rig(spec.query))
