"""What a service is on a vehicle that speaks ROS 2."""

from __future__ import annotations

import re

from coec.adapters.ros.messages import type_hash
from coec.adapters.ros.wire.dialect import Dialect
from coec.adapters.ros.wire.rmw_zenoh import Node, RmwZenoh
from coec.adapters.ros.wire.ros2dds import Ros2dds
from coec.config import Config

NODE_NAME = "coec"


def dialect_of(config: Config, session: str) -> Dialect | None:
    """How a session of this Zenoh id, hexadecimal, speaks to the vehicle's ROS; None where there is none."""
    match config.middleware:
        case "rmw_zenoh":
            return RmwZenoh(Node(config.ros.domain, session, 0, namespace_of(config.vehicle), NODE_NAME), type_hash)
        case "ros2dds":
            return Ros2dds(session, config.ros.namespace)
        case "native":
            return None


def namespace_of(vehicle: str) -> str:
    """The namespace of a vehicle: names of ROS have no other characters, and begin with no digit
    (rmw/validate_full_topic_name.h)."""
    name = re.sub(r"[^A-Za-z0-9_]+", "_", vehicle)
    return f"/_{name}" if name[:1].isdecimal() else f"/{name}"
