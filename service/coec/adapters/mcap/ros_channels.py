"""ROS 2 topics as channels of an MCAP file: type definition, quality of service for players, and whether messages
shrink when compressed."""

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
"""Key in the metadata of a channel, required by the profile `ros2`. Without it `ros2 bag play` does not offer
`/tf_static` to late subscribers."""

MAX_STAMP_NS = 2**31 * 1_000_000_000
"""End of ROS 2 time, which has signed 32-bit seconds."""

SHRINK = frozenset({messages.POINT_CLOUD, messages.IMAGE})
"""Types whose messages lz4 makes smaller: clouds by a tenth, raw images by more. Encoded images do not shrink."""

_FOREVER = "{sec: 9223372036, nsec: 854775807}"
"""What rosbag2 writes if there is no deadline."""


def check_stamp(stamp_ns: int) -> None:
    """Checks that a ROS message can carry a stamp.

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
        """The definition of the type, for readers that do not know it."""
        return _schema(self.type_name)

    @property
    def metadata(self) -> Mapping[str, str]:
        """The quality of service with which the topic is to be played."""
        return {QOS: _qos_text(self.topic)}


@lru_cache(maxsize=64)
def _qos_text(topic: str) -> str:
    """The quality of service in numbers, as rosbag2 writes it up to version 8 of its metadata. Readers assume that
    version unless a `metadata.yaml` gives another (`rmw_qos_*_policy_t` of rmw/types.h; rosbag2_storage/qos.cpp)."""
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
