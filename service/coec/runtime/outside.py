"""What all pairs of a vehicle share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from coec.adapters.files.scribe import DiskWriter
from coec.adapters.zenoh.bus import Answer
from coec.adapters.zenoh.ros_topics import RosTopicList
from coec.calibration.types import FramePair, Matrix4, Reason
from coec.config import PairConfig
from coec.runtime.budget.budget import Budget
from coec.runtime.decisions.state_store import StateStore
from coec.runtime.ingest.intake import Intake
from coec.runtime.nominal.watch import NominalStatus
from coec.runtime.recording.snippet_store import SnippetStore
from coec.runtime.recording.window_store import WindowStore
from coec.runtime.rig.keeper import RigEstimatorThread
from coec.runtime.worker.supervisor import Worker
from coec.schemas.keys import Keys


def configured_nominal(pair: str) -> NominalStatus:
    """Default of `Outside.nominal`: the pair's configuration gives its nominal calibration."""
    del pair
    return NominalStatus()


def no_rig_problems(pair: str) -> tuple[Reason, ...]:
    """Default of `Outside.rig_troubles`: the pair contradicts no other."""
    del pair
    return ()


@dataclass(frozen=True, slots=True)
class VehicleContext:
    """Everything that a pair shares with the others. The callables may be called from any thread.

    Attributes:
        intake: takes the samples of all pairs.
        show: `show(pair, drawn, pose)` reports a pair of frames that is being checked at an extrinsic (4, 4).
        topics: the topics that the vehicle's ROS publishes now.
        nominal: where the nominal calibration of a pair, given by name, comes from.
        rig_troubles: in what a pair, given by name, contradicts the vehicle's other pairs.
        snippets: store for the seconds around an event; None: they are not kept.
    """

    keys: Keys
    intake: Intake
    store: StateStore
    disk_writer: DiskWriter
    folder: WindowStore
    worker: Worker
    budget: Budget
    rig: RigEstimatorThread
    publish: Callable[[str, Answer], None]
    vehicle_problems: Callable[[], tuple[Reason, ...]]
    show: Callable[[PairConfig, FramePair, Matrix4], None]
    topics: Callable[[], RosTopicList]
    nominal: Callable[[str], NominalStatus] = configured_nominal
    rig_problems: Callable[[str], tuple[Reason, ...]] = no_rig_problems
    snippets: SnippetStore | None = None
