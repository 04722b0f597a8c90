"""Simulated drives as files: ROS 2 bags of one pair or of a rig, with their true poses, and single pictures."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from coec.calibration.types import CameraFrame, Frame
from coec.errors import OutputError, UsageError
from coec.geometry.cameras import intrinsics_of, name_of
from coec.geometry.se3 import inverse
from coec.io.mcap.writer import write_bag, write_messages
from coec.io.rig_files import mask_to_png
from coec.io.ros import message_encoding, messages
from coec.io.ros.message_encoding import PlacedFrame
from coec.io.ros.topics import SensorTopics, TopicMessage, image_topic, points_topic
from coec.io.user_files import require_absent, write_output
from coec.reports import console
from coec.reports.formatting import count
from coec_lab.simulation.source import open_rig, open_sim, vehicle_of

if TYPE_CHECKING:
    from coec_lab.simulation.drive import SimulatedDrive
    from coec_lab.simulation.rig_drive import RigDrive

MOST_PROCESSES = 4
"""Most processes, because each keeps its own street in memory."""

TRUTH_TOPIC = "/ground_truth/tf"
"""True `camera` <- `lidar` and `world` <- `ego` at each exposure. No source reads it, so the service cannot know."""

OF_ONE_PAIR = ("lidar", "go_s", "stop_s", "rolling_shutter_s", "intrinsics_off")
"""Parameters of a drive with one camera and one LiDAR; the sensors of a rig are fixed."""

BAG = "drive.mcap"
"""Name of the bag of a rig."""


@dataclass(frozen=True, slots=True)
class DriveOptions:
    """Parameters of a drive, by their names in a SOURCE `sim:...`; None: the default there."""

    seed: int = 0
    seconds: float = 60.0
    camera: str = "fisheye700"
    scene: str = "street"
    speed_mps: float | None = None
    camera_hz: float = 10.0
    lidar_hz: float = 10.0
    workshop: str | None = None
    rig: str | None = None
    lidar: str = "64"
    go_s: float = 20.0
    stop_s: float = 0.0
    rolling_shutter_s: float = 0.0
    intrinsics_off: str | None = None
    intensity: str | None = None
    faults: tuple[str, ...] = ()

    def query(self) -> dict[str, str]:
        """The query of the SOURCE."""
        left_out = {"faults", *(("rig",) if self.rig is None else OF_ONE_PAIR)}
        values = {one.name: getattr(self, one.name) for one in fields(self) if one.name not in left_out}
        query = {name: str(value) for name, value in values.items() if value is not None}
        return query | ({"faults": ";".join(self.faults)} if self.faults else {})


def write_pair(options: DriveOptions, output: Path, *, force: bool, as_json: bool) -> int:
    """Writes a drive as a ROS 2 bag, frame by frame.

    Raises:
        UsageError: the output is no .mcap, or an option does not fit.
        SourceError: the optional extra is not installed.
        OutputError: it cannot be written, or is there already.
    """
    if output.suffix != ".mcap":
        raise UsageError(f"{output}: the drive is written as a ROS 2 bag, its name must end in .mcap")
    require_absent(output, force=force)
    simulated = open_sim(options.query())
    from coec_lab.simulation.parallel import messages_by

    pictures = len(simulated.camera_stamps_ns)
    part = output.with_name(f"{output.name}.part")
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with console.progress() as bars:
            task = bars.add_task("pictures", total=pictures, note="")
            write_bag(
                part,
                simulated.rig,
                simulated.T_camera_lidar_start,
                messages_by(simulated.config, min(os.cpu_count() or 1, MOST_PROCESSES)),
                lambda frame: bars.advance(task) if isinstance(frame, CameraFrame) else None,
                lambda frame: _truth_of_pair(simulated, frame),
            )
        part.replace(output)
    except OSError as error:
        raise OutputError(f"cannot write {output}: {error.strerror}") from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
    size = output.stat().st_size
    console.report(
        {"written": str(output), "bytes": size, "frames": pictures},
        lambda: console.show(f"{output}  {count(pictures, 'picture')}  {size} bytes"),
        as_json=as_json,
    )
    return 0


def write_picture(options: DriveOptions, at_s: float, output: Path, *, as_json: bool) -> int:
    """Writes the picture nearest to a time, in seconds of the drive.

    Raises:
        UsageError: the output is no JPEG, or an option does not fit.
        SourceError: the optional extra is not installed.
        OutputError: it cannot be written.
    """
    if output.suffix not in (".jpg", ".jpeg"):
        raise UsageError(f"{output}: the picture is a JPEG, its name must end in .jpg")
    simulated = open_sim(options.query())
    index = min(round(at_s * options.camera_hz), len(simulated.camera_stamps_ns) - 1)
    frame = next(frame for frame in simulated.messages([index]) if isinstance(frame, CameraFrame))
    path = write_output(output, frame.image.data)
    console.report({"written": str(path)}, lambda: console.show(str(path)), as_json=as_json)
    return 0


def write_rig(options: DriveOptions, folder: Path, *, force: bool, as_json: bool) -> int:
    """Writes `drive.mcap` with all sensors, and for each camera its mask and a YAML file that names it.

    Raises:
        UsageError: the output is a file, or an option does not fit.
        SourceError: the optional extra is not installed.
        OutputError: it cannot be written, or is there already.
    """
    if folder.suffix == ".mcap" or folder.is_file():
        raise UsageError(f"{folder}: a rig is written into a folder, {BAG} and a mask for each camera: name a folder")
    simulated = _open_rig(options)
    companions = [folder / name for camera in simulated.cameras for name in (f"{camera}_mask.png", f"{camera}.yaml")]
    require_absent(folder / BAG, *companions, force=force)
    present = {path for path in companions if path.exists()}
    from coec_lab.simulation.parallel import messages_by

    total = sum(entry.stream != 0 for entry in simulated.plan)
    path, part = folder / BAG, folder / f"{BAG}.part"
    topics = SensorTopics(vehicle_of(simulated))

    def of_topics() -> Iterator[TopicMessage]:
        with console.progress() as bars:
            task = bars.add_task("pictures and sweeps", total=total, note="")
            for frame in messages_by(simulated.config, min(os.cpu_count() or 1, MOST_PROCESSES)):
                yield from topics.of(frame)
                if isinstance(frame, CameraFrame):
                    yield TopicMessage(
                        frame.stamp_ns, TRUTH_TOPIC, messages.TF, _truth_of_rig(simulated, frame.stamp_ns)
                    )
                if frame.frame_id in (*simulated.cameras, *simulated.lidars):
                    bars.advance(task)

    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_messages(part, of_topics())
        for camera in simulated.cameras:
            _write_camera(simulated, camera, folder)
        part.replace(path)
        present.update(companions)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    finally:
        # What a failed run has made would refuse the next.
        for left in (part, *(each for each in companions if each not in present)):
            with suppress(OSError):
                left.unlink(missing_ok=True)
    sources = {f"{camera}-{lidar}": source_of(folder, camera, lidar) for camera, lidar in simulated.config.layout.pairs}
    if as_json:
        console.print_json({"written": str(path), "bytes": path.stat().st_size, "frames": total, "sources": sources})
    else:
        console.show(
            f"{path}  {count(total, 'picture or sweep', 'pictures and sweeps')}  {path.stat().st_size} bytes; "
            "pairs as sources:"
        )
        for camera in simulated.cameras:
            console.show(f"  '{source_of(folder, camera, simulated.lidars[0])}'")
        others = ", ".join(points_topic(lidar) for lidar in simulated.lidars[1:])
        console.show(f"  and so on with points={others}")
    return 0


def _open_rig(options: DriveOptions) -> RigDrive:
    """Raises UsageError: an option is not one of a rig; UsageError, SourceError: see `open_rig`."""
    default = DriveOptions()
    named = {"--lidar": "lidar", "--rolling-shutter": "rolling_shutter_s", "--intrinsics-off": "intrinsics_off"}
    if given := [name for name, of in named.items() if getattr(options, of) != getattr(default, of)]:
        raise UsageError(f"{', '.join(given)} of a rig: its sensors are fixed; leave it out")
    if options.stop_s:
        raise UsageError("--stop of a rig: its vehicle makes no stops; leave it out")
    return open_rig(options.query())


def source_of(folder: Path, camera: str, lidar: str) -> str:
    """The SOURCE of one pair in the written bag."""
    return f"{folder / BAG}?camera={image_topic(camera)}&points={points_topic(lidar)}&intrinsics={folder / camera}.yaml"


def _write_camera(simulated: RigDrive, camera: str, folder: Path) -> None:
    """Writes the mask of a camera next to the bag, which has no place for it, and the YAML file that names it."""
    write_output(folder / f"{camera}_mask.png", mask_to_png(simulated.mask(camera)))
    intrinsics = {"model": name_of(simulated.camera), **intrinsics_of(simulated.camera)}
    lines = ["camera:", *(f"  {key}: {value}" for key, value in intrinsics.items()), f"mask: {camera}_mask.png", ""]
    write_output(folder / f"{camera}.yaml", "\n".join(lines).encode())


def _truth_of_rig(simulated: RigDrive, stamp_ns: int) -> bytes:
    """True poses of all sensors in the vehicle, and of the vehicle in the world."""
    sensors = (*simulated.lidars, *simulated.cameras)
    placed = [PlacedFrame("ego", name, inverse(simulated.T_sensor_ego(name, stamp_ns))) for name in sensors]
    return message_encoding.encode_transforms(
        [PlacedFrame("world", "ego", simulated.true_pose(stamp_ns)), *placed], stamp_ns
    )


def _truth_of_pair(simulated: SimulatedDrive, frame: Frame) -> list[tuple[str, str, bytes]]:
    if not isinstance(frame, CameraFrame):
        return []
    stamp_ns, rig = frame.stamp_ns, simulated.rig
    of_world = replace(rig, camera_frame="world", lidar_frame="ego")
    extrinsic = message_encoding.encode_tf_static(rig, simulated.truth(stamp_ns), stamp_ns)
    pose = message_encoding.encode_tf_static(of_world, simulated.true_pose(stamp_ns), stamp_ns)
    return [(TRUTH_TOPIC, messages.TF, extrinsic), (TRUTH_TOPIC, messages.TF, pose)]
