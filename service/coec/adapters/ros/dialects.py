"""Chooses how the service speaks to ROS 2 on a vehicle."""

from __future__ import annotations

from coec.adapters.ros.messages import type_hash
from coec.adapters.ros.wire.dialect import Dialect
from coec.adapters.ros.wire.rmw_zenoh import Node, RmwZenoh
from coec.adapters.ros.wire.ros2dds import Ros2dds
from coec.config import Config
from coec.schemas.ros_names import NODE, ros_name


def dialect_of(config: Config, session: str) -> Dialect | None:
    """The dialect of a session with this Zenoh id, hexadecimal, towards the vehicle's ROS; None without ROS."""
    match config.middleware:
        case "rmw_zenoh":
            return RmwZenoh(Node(config.ros.domain, session, 0, f"/{ros_name(config.vehicle)}", NODE), type_hash)
        case "ros2dds":
            return Ros2dds(session, config.ros.namespace)
        case "native":
            return None
