"""`coec sim`: writes drives of a simulated vehicle to files."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from coec.adapters.files.output import require_absent, write
from coec.adapters.mcap.bag_writer import write_bag
from coec.adapters.ros import messages, outgoing
from coec.adapters.ros.topics import Frame
from coec.calibration.types import CameraFrame
from coec.cli.commands import sim_view
from coec.cli.commands.sim_drive import Options
from coec.errors import OutputError, UsageError
from coec.reports import console
from coec.reports.page.words import count
from coec.simulation.source import open_rig, open_sim

if TYPE_CHECKING:
    from coec.simulation.drive import SimulatedDrive
    from coec.simulation.rig_drive import RigDrive

MOST_PROCESSES = 4
"""Most processes, because each keeps its own street in memory."""
TRUTH_TOPIC = "/ground_truth/tf"
"""True `camera` <- `lidar` and `world` <- `ego` at each exposure. No source reads it, so the service cannot know."""


def opened(options: Options) -> SimulatedDrive:
    """The drive. Raises UsageError, SourceError: see `open_sim`."""
    return open_sim(_query(options, ("lidar", "go_s", "stop_s", "rolling_shutter_s", "intrinsics_off")))


def opened_rig(options: Options) -> RigDrive:
    """The drive of the rig. Raises UsageError, SourceError: see `open_rig`."""
    own = (("--lidar", options.lidar != "64"), ("--rolling-shutter", options.rolling_shutter_s != 0.0))
    if not_its := [name for name, given in (*own, ("--intrinsics-off", options.intrinsics_off is not None)) if given]:
        raise UsageError(f"{', '.join(not_its)} of a rig: its sensors are what they are; leave it out")
    if options.stop_s:
        raise UsageError("--stop of a rig: its vehicle makes no stops; leave it out")
    return open_rig(_query(options, ("rig",)))


def drive(options: Options) -> int:
    """Writes a drive as a ROS 2 bag, frame by frame.

    Raises:
        UsageError: the output is no .mcap, or an option does not fit.
        SourceError: the optional extra is not installed.
        OutputError: it cannot be written, or is there already.
    """
    output = options.output
    if output.suffix != ".mcap":
        raise UsageError(f"{output}: the drive is written as a ROS 2 bag, its name must end in .mcap")
    require_absent(output, force=options.force)
    made = opened(options)
    from coec.simulation.parallel import messages_by

    processes = min(os.cpu_count() or 1, MOST_PROCESSES)
    part = output.with_name(f"{output.name}.part")
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with console.progress() as bars:
            task = bars.add_task("pictures", total=len(made.camera_stamps_ns), note="")
            write_bag(
                part,
                made.rig,
                made.T_camera_lidar_start,
                messages_by(made.config, processes),
                lambda frame: bars.advance(task) if isinstance(frame, CameraFrame) else None,
                lambda frame: _truth(made, frame),
            )
        part.replace(output)
    except OSError as error:
        raise OutputError(f"cannot write {output}: {error.strerror}") from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
    if options.as_json:
        console.print_json(
            {"written": str(output), "bytes": output.stat().st_size, "frames": len(made.camera_stamps_ns)}
        )
    else:
        console.show(f"{output}  {count(len(made.camera_stamps_ns), 'picture')}  {output.stat().st_size} bytes")
    return 0


def view(options: sim_view.Options) -> int:
    """Writes the picture nearest to a time.

    Raises:
        UsageError, SourceError, OutputError: as for `drive`.
    """
    output = options.output
    if output.suffix not in (".jpg", ".jpeg"):
        raise UsageError(f"{output}: the picture is a JPEG, its name must end in .jpg")
    drive = Options(
        output,
        seed=options.seed,
        seconds=options.at_s + 1.0,
        camera=options.camera,
        scene=options.scene,
        speed_mps=options.speed_mps,
        faults=options.faults,
    )
    made = opened(drive)
    index = min(round(options.at_s * drive.camera_hz), len(made.camera_stamps_ns) - 1)
    frame = next(frame for frame in made.messages([index]) if isinstance(frame, CameraFrame))
    path = write(output, frame.image.data)
    if options.as_json:
        console.print_json({"written": str(path)})
    else:
        console.show(str(path))
    return 0


def _query(options: Options, more: tuple[str, ...]) -> dict[str, str]:
    """The query of `simulation.source` that the options mean."""
    names = ("seed", "seconds", "camera", "camera_hz", "lidar_hz", "scene", "speed_mps", "workshop", *more)
    query = {name: str(getattr(options, name)) for name in names if getattr(options, name) is not None}
    if options.faults:
        query["faults"] = ";".join(options.faults)
    return query


def _truth(made: SimulatedDrive, frame: Frame) -> list[tuple[str, str, bytes]]:
    if not isinstance(frame, CameraFrame):
        return []
    stamp_ns = frame.stamp_ns
    extrinsic = outgoing.encode_tf_static(made.rig, made.truth(stamp_ns), stamp_ns)
    pose = outgoing.encode_tf_static(
        replace(made.rig, camera_frame="world", lidar_frame="ego"), made.true_pose(stamp_ns), stamp_ns
    )
    return [(TRUTH_TOPIC, messages.TF, extrinsic), (TRUTH_TOPIC, messages.TF, pose)]
