"""All sensors of a simulated rig, each described once: as the configuration of a service, and as topics of ROS."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coec.adapters.files.output import write_output
from coec.adapters.files.rig import intrinsics_config, mask_to_png, matrix_rows
from coec.adapters.ros.outgoing import PlacedFrame
from coec.adapters.ros.sensor_topics import VehicleSensors
from coec.adapters.zenoh.player import SensorKeys
from coec.geometry.se3 import inverse

if TYPE_CHECKING:
    from coec.simulation.rig_drive import RigDrive


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
