"""What all pairs of a vehicle share."""

from collections.abc import Callable
from dataclasses import dataclass

from coec.calibration.types import FramePair, Matrix4, Reason
from coec.config import PairConfig
from coec.io.disk_writer import DiskWriter
from coec.io.zenoh.bus import Answer
from coec.io.zenoh.ros_node import RosTopicList
from coec.schemas.keys import Keys
from coec.service.discovery_listener import NominalStatus
from coec.service.engine.vehicle import Vehicle
from coec.service.recording.recorder import RecordingThread
from coec.service.recording.snippets import SnippetStore
from coec.service.recording.window_store import WindowStore
from coec.service.records.state_store import StateStore
from coec.service.worker.supervisor import Worker


@dataclass(frozen=True, slots=True)
class VehicleContext:
    """Everything that a pair shares with the others. The callables may be called from any thread.

    Attributes:
        vehicle: the engine, which all pairs join.
        show: `show(pair, drawn, pose)` reports a pair of frames that is being checked at an extrinsic (4, 4).
        topics: the topics that the vehicle's ROS publishes now.
        nominal: where the nominal calibration of a pair, given by name, comes from; by default its configuration.
        rig_problems: in what a pair, given by name, contradicts the vehicle's other pairs.
        snippets: store for the seconds around an event; None: they are not kept.
    """

    keys: Keys
    vehicle: Vehicle
    store: StateStore
    disk_writer: DiskWriter
    folder: WindowStore
    recording: RecordingThread
    worker: Worker
    publish: Callable[[str, Answer], None]
    vehicle_problems: Callable[[], tuple[Reason, ...]]
    show: Callable[[PairConfig, FramePair, Matrix4], None]
    topics: Callable[[], RosTopicList]
    nominal: Callable[[str], NominalStatus] = lambda _: NominalStatus()
    rig_problems: Callable[[str], tuple[Reason, ...]] = lambda _: ()
    snippets: SnippetStore | None = None
