"""How a topic of ROS 2 lies in an MCAP file: its definition, the quality of service that players ask for, and whether
its messages shrink."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

from coec.adapters.mcap.files import Schema
from coec.adapters.ros import messages
from coec.adapters.ros.topics import qos_of
from coec.errors import RecordingError

CDR = "cdr"

QOS = "offered_qos_profiles"
"""In the metadata of a channel: required by the profile `ros2`. Without it `ros2 bag play` offers `/tf_static` to
nobody who comes later."""

MAX_STAMP_NS = 2**31 * 1_000_000_000
"""ROS 2 time has signed 32-bit seconds."""

SHRINK = frozenset({messages.POINT_CLOUD, messages.IMAGE})
"""Types whose messages lz4 makes smaller: clouds by a tenth, raw images by more. Encoded images it makes no smaller."""

_FOREVER = "{sec: 9223372036, nsec: 854775807}"
"""What rosbag2 writes where there is no deadline."""


def check_stamp(stamp_ns: int) -> None:
    """Whether a message can carry it.

    Raises:
        RecordingError: it cannot.
    """
    if not 0 <= stamp_ns < MAX_STAMP_NS:
        raise RecordingError(f"stamp {stamp_ns} ns does not fit the 32-bit seconds of ROS 2")


@dataclass(frozen=True, slots=True)
class RosChannel:
    """A topic and the type of its messages."""

    topic: str
    type_name: str

    @property
    def schema(self) -> Schema:
        """The definition of the type, as readers that do not know it need it."""
        return _schema(self.type_name)

    @property
    def metadata(self) -> Mapping[str, str]:
        """The quality of service that the topic is played with."""
        return {QOS: _qos_text(self.topic)}


@lru_cache(maxsize=64)
def _qos_text(topic: str) -> str:
    """As rosbag2 writes it up to version 8 of its metadata, in numbers: so it is read where no `metadata.yaml` says
    another version (`rmw_qos_*_policy_t` of rmw/types.h; rosbag2_storage/qos.cpp)."""
    qos = qos_of(topic)
    return "\n".join(
        (
            "- history: 1",  # keep last
            f"  depth: {qos.depth}",
            f"  reliability: {1 if qos.reliable else 2}",
            f"  durability: {1 if qos.transient_local else 2}",
            f"  deadline: {_FOREVER}",
            f"  lifespan: {_FOREVER}",
            "  liveliness: 1",  # automatic
            f"  liveliness_lease_duration: {_FOREVER}",
            "  avoid_ros_namespace_conventions: false",
        )
    )


@lru_cache(maxsize=16)
def _schema(type_name: str) -> Schema:
    return Schema(0, type_name, "ros2msg", messages.definition(type_name).encode())
