"""A simulated drive as a SOURCE: `sim:seed=1&seconds=60&camera=fisheye700&faults=step:30:rx=3;dark:50-55`; and what
`coec play` and the demonstration need of a simulated rig: its frames on a bus, and the configuration of its service."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coec.errors import SourceError, UsageError
from coec.geometry.se3 import inverse
from coec.io.rig_files import intrinsics_config, mask_to_png, matrix_rows
from coec.io.ros.message_encoding import PlacedFrame
from coec.io.ros.topics import SensorTopics, TopicInfo, TopicMessage, VehicleSensors
from coec.io.user_files import write_output
from coec.io.zenoh.player import SensorKeys
from coec_lab.simulation.faults import parse_fault, parse_sensor_fault
from coec_lab.simulation.rig_drive import RigDrive

if TYPE_CHECKING:
    from coec.io.recordings.layouts import LidarRecording
    from coec_lab.simulation.drive import DriveConfig, SimulatedDrive
    from coec_lab.simulation.rig_drive import RigDrive, SimulatedRigPair


NUMBERS: dict[str, tuple[float, float]] = {
    "seed": (0, 2**31 - 1),
    "seconds": (0.1, 86400),
    "half_view_deg": (20, 110),
    "camera_hz": (0.01, 100),
    "lidar_hz": (0.01, 10),
    "ego_hz": (0.1, 1000),
    "camera_delay_s": (0, 1),
    "start_m": (0, 1e6),
    "speed_mps": (0, 45),
    "go_s": (1, 86400),
    "stop_s": (0, 86400),
    "rolling_shutter_s": (0, 0.1),
}
"""Query keys with a number, and its least and greatest value. The defaults are those of `DriveConfig`."""
WHOLE = ("seed",)
NAMES = ("scene", "camera", "lidar", "intensity")
"""Query keys with a name; `DriveConfig` says which names exist."""
SWITCHES = ("depth", "traffic")
TEXT_KEYS = (*NAMES, *SWITCHES, "faults", "workshop", "intrinsics_off")


MOST_OFF_PERCENT = 20.0
"""Intrinsics that are wrong by more than this belong to another camera."""


def open_sim(query: dict[str, str]) -> SimulatedDrive:
    """The drive of `sim:KEY=VALUE&...`, see `drive_config_of`.

    Raises:
        UsageError: an unknown key, or a value that does not fit; names the key.
        SourceError: the optional extra is not installed.
    """
    config = drive_config_of(query)
    from coec_lab.simulation.drive import SimulatedDrive

    return SimulatedDrive(config)


def drive_config_of(query: dict[str, str]) -> DriveConfig:
    """The configuration that `sim:KEY=VALUE&...` describes; every key may be left out.

    `faults` are separated by `;` (see `faults.FORMS`), `workshop` is rx,ry,rz[,tx,ty,tz] in degrees and metres,
    `intrinsics_off` is FOCAL[,CX,CY] in percent, `depth` and `traffic` are `yes` or `no`.

    Raises:
        UsageError: an unknown key, or a value that does not fit; names the key.
        SourceError: the optional extra is not installed.
    """
    require_embree()
    from coec_lab.simulation.drive import DriveConfig

    known = (*NUMBERS, *TEXT_KEYS)
    if unknown := sorted(set(query) - set(known)):
        raise UsageError(f"unknown query key {', '.join(unknown)} of a simulated drive; known: {', '.join(known)}")
    values = _values(query)
    if "faults" in query:
        values["faults"] = tuple(parse_fault(text) for text in query["faults"].split(";"))
    if "workshop" in query:
        values["workshop"] = _six(query["workshop"])
    if "intrinsics_off" in query:
        values["intrinsics_off"] = _three(query["intrinsics_off"])
    return DriveConfig(**values)  # type: ignore[arg-type]  # checked key by key above


def require_embree() -> None:
    """Raises SourceError, which says what to install, if ray casting is not installed."""
    if importlib.util.find_spec("embreex") is None:
        raise SourceError("a simulated drive needs embreex, which coec-lab requires: pip install coec-lab")


RIG_KEYS = (
    *("seed", "seconds", "camera_hz", "lidar_hz", "ego_hz", "start_m", "speed_mps"),
    *("rig", "pair", "scene", "camera", "intensity", "depth", "traffic", "faults", "workshop"),
)
"""Query keys of a rig; numbers have the limits of `NUMBERS`."""


def open_rig(query: dict[str, str]) -> RigDrive:
    """The drive of `sim:rig=four-fisheyes&KEY=VALUE&...`; all keys but `rig` may be left out, `pair` is ignored.

    `faults` are separated by `;`; those of a sensor begin with its name (see `faults.parse_sensor_fault`). `workshop`
    is SENSOR:rx,ry,rz[,tx,ty,tz] in degrees and metres about the sensor's axes, separated by `;`.

    Raises:
        UsageError: an unknown key, or a value that does not fit; names the key.
        SourceError: the optional extra is not installed.
    """
    require_embree()
    from coec_lab.simulation.rig_drive import RIGS, RigDrive, RigDriveConfig

    if unknown := sorted(set(query) - set(RIG_KEYS)):
        raise UsageError(f"unknown query key {', '.join(unknown)} of a simulated rig; known: {', '.join(RIG_KEYS)}")
    if query["rig"] not in RIGS:
        raise UsageError(f"there is no rig {query['rig']!r}; choose one of {', '.join(RIGS)}")
    layout = RIGS[query["rig"]]
    values = _values({key: value for key, value in query.items() if key not in ("rig", "pair", "lidar")})
    if not query.get("camera", "fisheye").startswith("fisheye"):
        raise UsageError(f"camera={query['camera']}: this rig has fisheyes; write fisheye700 (any width)")
    if "faults" in query:
        cameras, lidars = ([sensor.name for sensor in kind] for kind in (layout.cameras, layout.lidars))
        values["faults"] = tuple(parse_sensor_fault(text, cameras, lidars) for text in query["faults"].split(";"))
    if "workshop" in query:
        parts = [part.partition(":") for part in query["workshop"].split(";")]
        if not all(colon for _, colon, _ in parts):
            raise UsageError(f"workshop={query['workshop']} of a rig: of which sensor? Write roof:0,0,1;front:0,1,0")
        values["workshop"] = tuple((sensor, _six(numbers)) for sensor, _, numbers in parts)
    return RigDrive(RigDriveConfig(layout, **values))  # type: ignore[arg-type]  # checked key by key above


def open_pair_of_rig(query: dict[str, str]) -> SimulatedRigPair:
    """The recording of `sim:rig=...&pair=CAMERA-LIDAR&...`.

    Raises:
        UsageError, SourceError: as `open_rig`, and if `pair` is missing or there is no such pair.
    """
    drive = open_rig(query)
    pairs = [f"{camera}-{lidar}" for camera, lidar in drive.config.layout.pairs]
    if query.get("pair") not in pairs:
        raise UsageError(f"one pair of the rig is a recording: write pair=... with one of {', '.join(pairs)}")
    camera, _, lidar = query["pair"].partition("-")
    return drive.pair(camera, lidar)


def _values(query: dict[str, str]) -> dict[str, object]:
    """Numbers, names and switches of a query.

    Raises:
        UsageError: a value that does not fit; names the key.
    """
    values: dict[str, object] = {key: _number(key, query[key]) for key in NUMBERS if key in query}
    values |= {key: int(query[key]) for key in WHOLE if key in query}
    values |= {key: query[key] for key in NAMES if key in query}
    for key in SWITCHES:
        if key in query:
            if query[key] not in ("yes", "no"):
                raise UsageError(f"{key}={query[key]} of a simulated drive: write yes or no")
            values[key] = query[key] == "yes"
    return values


def _number(key: str, text: str) -> float:
    low, high = NUMBERS[key]
    try:
        value = float(int(text)) if key in WHOLE else float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        kind = "a whole number" if key in WHOLE else "a number"
        raise UsageError(f"{key}={text} of a simulated drive: expected {kind} from {low:.10g} to {high:.10g}")
    return value


def _six(text: str) -> tuple[float, ...]:
    numbers = _numbers(text)
    if len(numbers) not in (3, 6):
        raise UsageError(f"workshop={text} of a simulated drive: write rx,ry,rz or rx,ry,rz,tx,ty,tz (degrees, metres)")
    return (*numbers, 0.0, 0.0, 0.0)[:6]


def _three(text: str) -> tuple[float, ...]:
    numbers = _numbers(text)
    if len(numbers) not in (1, 3) or max(map(abs, numbers)) > MOST_OFF_PERCENT:
        raise UsageError(
            f"intrinsics_off={text} of a simulated drive: write FOCAL or FOCAL,CX,CY in percent, "
            f"each {MOST_OFF_PERCENT:g} at most"
        )
    return (*numbers, 0.0, 0.0)[:3]


def _numbers(text: str) -> tuple[float, ...]:
    """The numbers of a comma-separated list; empty if one of them is not a finite number."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        return ()
    return numbers if all(math.isfinite(number) for number in numbers) else ()


def open_recording(query: dict[str, str]) -> SimulatedDrive | SimulatedRigPair:
    """The drive of one pair that `sim:KEY=VALUE&...` describes: of a rig, if the query has one.

    Raises:
        UsageError, SourceError: see `open_sim` and `open_pair_of_rig`.
    """
    return open_pair_of_rig(query) if "rig" in query else open_sim(query)


def open_lidars(query: dict[str, str], a: str, b: str) -> LidarRecording:
    """Sweeps of two LiDARs of a simulated rig, for `coec lidars`.

    Raises:
        UsageError: no such LiDAR, or the query does not fit.
        SourceError: the optional extra is not installed.
    """
    from coec.calibration.rig.lidar_sampling import LidarRig
    from coec.calibration.types import EgoMotion, LidarFrame
    from coec.geometry.se3 import inverse
    from coec.io.recordings.layouts import FrameStream, LidarRecording

    drive = open_rig(query)
    if unknown := [name for name in (a, b) if name not in drive.lidars]:
        raise UsageError(f"the rig has no LiDAR {', '.join(unknown)}; it has {', '.join(drive.lidars)}")

    def frames(sensor: str) -> FrameStream:
        places = [entry for entry in drive.plan if entry.stream == drive.stream(sensor)]

        def load(place: int) -> LidarFrame | EgoMotion:
            frame = drive.message(places[place])
            assert isinstance(frame, LidarFrame | EgoMotion)
            return frame

        return FrameStream(tuple(entry.stamp_ns for entry in places), load)

    T_a_ego = drive.T_sensor_ego_nominal(a)
    rig = LidarRig(a, b, T_a_ego @ inverse(drive.T_sensor_ego_nominal(b)), T_a_ego)
    return LidarRecording(
        drive.name, rig, frames(a), frames(b), frames("ego"),
        lambda stamp_ns: drive.T_sensor_ego(a, stamp_ns) @ inverse(drive.T_sensor_ego(b, stamp_ns)),
    )  # fmt: skip


def open_played_rig(query: dict[str, str]) -> PlayedRig:
    """A simulated rig, for `coec play`.

    Raises:
        UsageError, SourceError: see `open_rig`.
    """

    return PlayedRig(open_rig(query))


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
