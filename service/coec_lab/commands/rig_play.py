"""What `coec play` and the demonstration need of a simulated rig: its frames on a bus, and the configuration of its
service.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from coec.geometry.se3 import inverse
from coec.io.rig_files import intrinsics_config, mask_to_png, matrix_rows
from coec.io.ros.message_encoding import PlacedFrame
from coec.io.ros.topics import SensorTopics, TopicInfo, TopicMessage, VehicleSensors
from coec.io.user_files import write_output
from coec.io.zenoh.player import SensorKeys
from coec_lab.simulation.rig_drive import RigDrive


def document_of(drive: RigDrive, lidars: Sequence[str], folder: Path) -> dict[str, Any]:
    """`cameras`, `lidars`, `ego` and `pairs: all`, with the poses that the workshop assumes, for frames on
    `sensors/<sensor>`. Writes the masks into the folder.

    Args:
        lidars: those LiDARs of the drive that are to be paired.

    Raises:
        OutputError: a mask cannot be written.
    """
    keys = SensorKeys(("ego", *lidars, *drive.cameras)).keys()
    poses = {name: matrix_rows(inverse(drive.T_sensor_ego_nominal(name))) for name in (*lidars, *drive.cameras)}
    intrinsics = intrinsics_config(drive.camera).model_dump(exclude_none=True)
    cameras = []
    for name in drive.cameras:
        mask = f"{name}_mask.png"
        write_output(folder / mask, mask_to_png(drive.mask(name)))
        cameras.append(
            {"name": name, "key": keys[name], "intrinsics": intrinsics, "mask": mask, "T_vehicle_camera": poses[name]}
        )
    return {
        "cameras": cameras,
        "lidars": [{"name": name, "key": keys[name], "T_vehicle_lidar": poses[name]} for name in lidars],
        "ego": {"key": keys["ego"]},
        "pairs": "all",
    }


def vehicle_of(drive: RigDrive) -> VehicleSensors:
    """Description of the vehicle for ROS, with the poses that the workshop assumes."""
    lidar = drive.lidars[0]
    cameras = {camera: drive.pair(camera, lidar).rig for camera in drive.cameras}
    sensors = (*drive.lidars, *drive.cameras)
    return VehicleSensors(
        cameras, [PlacedFrame("ego", name, inverse(drive.T_sensor_ego_nominal(name))) for name in sensors]
    )


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
