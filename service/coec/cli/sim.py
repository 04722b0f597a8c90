"""`coec sim`: drives of a vehicle that does not exist, as files."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from coec.adapters.files.output import OutputError, write
from coec.adapters.mcap.bag_writer import write_bag
from coec.adapters.ros import messages, outgoing
from coec.adapters.ros.topics import Frame
from coec.calibration.types import CameraFrame
from coec.errors import UsageError
from coec.reports import console
from coec.simulation.source import open_rig, open_sim

if TYPE_CHECKING:
    from coec.simulation.drive import SimulatedDrive
    from coec.simulation.rig_drive import RigDrive

MOST_PROCESSES = 4
"""Each keeps its own street in memory."""
TRUTH_TOPIC = "/ground_truth/tf"
"""True `camera` <- `lidar` and `world` <- `ego` at each exposure. No source reads it: the service cannot know."""


@dataclass(frozen=True, slots=True)
class Options:
    """What was asked for; the words of `simulation.source`."""

    seed: int
    seconds: float
    camera: str
    lidar: str = "64"
    scene: str = "street"
    speed_mps: float | None = None
    rolling_shutter_s: float = 0.0
    intrinsics_off: str | None = None
    camera_hz: float = 10.0
    lidar_hz: float = 10.0
    faults: tuple[str, ...] = ()
    workshop: str | None = None
    rig: str | None = None

    def open(self) -> SimulatedDrive:
        """The drive. Raises UsageError, SourceError: see `open_sim`."""
        return open_sim(self._query(("lidar", "rolling_shutter_s", "intrinsics_off")))

    def open_rig(self) -> RigDrive:
        """The drive of the rig. Raises UsageError, SourceError: see `open_rig`."""
        own = (("--lidar", self.lidar != "64"), ("--rolling-shutter", self.rolling_shutter_s != 0.0))
        if not_its := [name for name, given in (*own, ("--intrinsics-off", self.intrinsics_off is not None)) if given]:
            raise UsageError(f"{', '.join(not_its)} of a rig: its sensors are what they are; leave it out")
        return open_rig(self._query(("rig",)))

    def _query(self, more: tuple[str, ...]) -> dict[str, str]:
        names = ("seed", "seconds", "camera", "camera_hz", "lidar_hz", "scene", "speed_mps", "workshop", *more)
        query = {name: str(getattr(self, name)) for name in names if getattr(self, name) is not None}
        if self.faults:
            query["faults"] = ";".join(self.faults)
        return query


def drive(options: Options, output: Path, *, as_json: bool) -> int:
    """Writes a drive as a ROS 2 bag, frame by frame.

    Raises:
        UsageError: the output is no .mcap, or an option does not fit.
        SourceError: the optional extra is not installed.
        OutputError: it cannot be written.
    """
    if output.suffix != ".mcap":
        raise UsageError(f"{output}: the drive is written as a ROS 2 bag, its name must end in .mcap")
    made = options.open()
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
    if as_json:
        console.print_json(
            {"written": str(output), "bytes": output.stat().st_size, "frames": len(made.camera_stamps_ns)}
        )
    else:
        console.show(f"{output}  {len(made.camera_stamps_ns)} pictures  {output.stat().st_size} bytes")
    return 0


def view(options: Options, at_s: float, output: Path, *, as_json: bool) -> int:
    """Writes the picture nearest to a time.

    Raises:
        UsageError, SourceError, OutputError: as for `drive`.
    """
    if output.suffix not in (".jpg", ".jpeg"):
        raise UsageError(f"{output}: the picture is a JPEG, its name must end in .jpg")
    made = options.open()
    index = min(round(at_s * options.camera_hz), len(made.camera_stamps_ns) - 1)
    frame = next(frame for frame in made.messages([index]) if isinstance(frame, CameraFrame))
    path = write(output, frame.image.data)
    if as_json:
        console.print_json({"written": str(path)})
    else:
        console.show(str(path))
    return 0


def _truth(made: SimulatedDrive, frame: Frame) -> list[tuple[str, str, bytes]]:
    if not isinstance(frame, CameraFrame):
        return []
    stamp_ns = frame.stamp_ns
    extrinsic = outgoing.encode_tf_static(made.rig, made.truth(stamp_ns), stamp_ns)
    pose = outgoing.encode_tf_static(
        replace(made.rig, camera_frame="world", lidar_frame="ego"), made.true_pose(stamp_ns), stamp_ns
    )
    return [(TRUTH_TOPIC, messages.TF, extrinsic), (TRUTH_TOPIC, messages.TF, pose)]
