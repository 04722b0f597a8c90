"""`coec sim drive --rig`: writes a drive of a vehicle with several cameras and LiDARs as one bag, drawn once."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from coec.adapters.files.output import require_absent, write
from coec.adapters.files.rig import mask_to_png
from coec.adapters.mcap.bag_writer import write_messages
from coec.adapters.ros import messages, outgoing
from coec.adapters.ros.outgoing import Placed
from coec.adapters.ros.sensor_topics import SensorTopics, image_topic, points_topic
from coec.adapters.ros.topics import TopicMessage
from coec.calibration.types import CameraFrame
from coec.cli.commands.sim_drive import Options
from coec.cli.rig_configuration import vehicle_of
from coec.errors import OutputError, UsageError
from coec.geometry.cameras import intrinsics_of, name_of
from coec.geometry.se3 import inverse
from coec.reports import console
from coec.reports.page.words import count
from coec_lab.commands.sim import MOST_PROCESSES, TRUTH_TOPIC, opened_rig

if TYPE_CHECKING:
    from coec.simulation.rig_drive import RigDrive

BAG = "drive.mcap"


def drive(options: Options) -> int:
    """Writes `drive.mcap` with all sensors, and for each camera its mask and a YAML file that names it.

    Raises:
        UsageError: the output is a file, or an option does not fit.
        SourceError: the optional extra is not installed.
        OutputError: it cannot be written, or is there already.
    """
    folder = options.output
    if folder.suffix == ".mcap" or folder.is_file():
        raise UsageError(f"{folder}: a rig is written into a folder, {BAG} and a mask for each camera: name a folder")
    made = opened_rig(options)
    beside = [folder / name for camera in made.cameras for name in (f"{camera}_mask.png", f"{camera}.yaml")]
    require_absent(folder / BAG, *beside, force=options.force)
    present = {path for path in beside if path.exists()}
    from coec.simulation.parallel import messages_by

    total = sum(entry.stream != 0 for entry in made.plan)
    path, part = folder / BAG, folder / f"{BAG}.part"
    told = SensorTopics(vehicle_of(made))

    def topics() -> Iterator[TopicMessage]:
        with console.progress() as bars:
            task = bars.add_task("pictures and sweeps", total=total, note="")
            for frame in messages_by(made.config, min(os.cpu_count() or 1, MOST_PROCESSES)):
                yield from told.of(frame)
                if isinstance(frame, CameraFrame):
                    yield TopicMessage(frame.stamp_ns, TRUTH_TOPIC, messages.TF, _truth(made, frame.stamp_ns))
                if frame.frame_id in (*made.cameras, *made.lidars):
                    bars.advance(task)

    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_messages(part, topics())
        for camera in made.cameras:
            _write_camera(made, camera, folder)
        part.replace(path)
        present.update(beside)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    finally:
        # What a failed run has made would refuse the next.
        for left in (part, *(each for each in beside if each not in present)):
            with suppress(OSError):
                left.unlink(missing_ok=True)
    sources = {f"{camera}-{lidar}": source_of(folder, camera, lidar) for camera, lidar in made.config.layout.pairs}
    if options.as_json:
        console.print_json({"written": str(path), "bytes": path.stat().st_size, "frames": total, "sources": sources})
    else:
        console.show(
            f"{path}  {count(total, 'picture or sweep', 'pictures and sweeps')}  {path.stat().st_size} bytes; "
            "pairs as sources:"
        )
        for camera in made.cameras:
            console.show(f"  '{source_of(folder, camera, made.lidars[0])}'")
        others = ", ".join(points_topic(lidar) for lidar in made.lidars[1:])
        console.show(f"  and so on with points={others}")
    return 0


def source_of(folder: Path, camera: str, lidar: str) -> str:
    """The SOURCE of one pair in the written bag."""
    return f"{folder / BAG}?camera={image_topic(camera)}&points={points_topic(lidar)}&intrinsics={folder / camera}.yaml"


def _write_camera(made: RigDrive, camera: str, folder: Path) -> None:
    """Writes the mask of a camera beside the bag, which has no place for it, and the YAML file that names it."""
    write(folder / f"{camera}_mask.png", mask_to_png(made.mask(camera)))
    intrinsics = {"model": name_of(made.camera), **intrinsics_of(made.camera)}
    lines = ["camera:", *(f"  {key}: {value}" for key, value in intrinsics.items()), f"mask: {camera}_mask.png", ""]
    write(folder / f"{camera}.yaml", "\n".join(lines).encode())


def _truth(made: RigDrive, stamp_ns: int) -> bytes:
    """True poses of all sensors in the vehicle, and of the vehicle in the world."""
    sensors = (*made.lidars, *made.cameras)
    placed = [Placed("ego", name, inverse(made.T_sensor_ego(name, stamp_ns))) for name in sensors]
    return outgoing.encode_transforms([Placed("world", "ego", made.true_pose(stamp_ns)), *placed], stamp_ns)
