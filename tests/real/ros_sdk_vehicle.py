"""Sensors and a listener of a ROS 2 vehicle by zenoh-ros2-sdk, a client that is not ours. Runs in an environment of its
own, with the session of rmw_zenoh's default file that the SDK brings.

    python ros_sdk_vehicle.py PORT     PORT: that of the router on this computer

Reads lines from standard input, `TOPIC TYPE FILE`: publishes the message in the file (CDR) and answers `sent`. For
every message that it gets it writes a line of JSON.
"""

from __future__ import annotations

import json
import sys
import threading
from dataclasses import fields
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber  # type: ignore[import-not-found]
from zenoh_ros2_sdk.qos import QosDurability, QosProfile  # type: ignore[import-not-found]

TYPES = get_typestore(Stores.ROS2_JAZZY)
PORT = int(sys.argv[1])

DIAGNOSTICS, TRANSFORMS = "/diagnostics", "/tf_static"
OVERLAY, INFO = "/coec/front/overlay/compressed", "/coec/front/camera/camera_info"

_lock = threading.Lock()


def reported(**line: Any) -> None:
    with _lock:
        print(json.dumps(line), flush=True)


def definition(type_name: str) -> dict[str, Any]:
    """What the SDK would otherwise read from a repository that it clones."""
    text, _ = TYPES.generate_msgdef(type_name, ros_version=2)
    return {"msg_definition": text, "type_hash": TYPES.hash_rihs01(type_name), "router_port": PORT}


def diagnostics(message: Any) -> None:
    for status in message.status:
        level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
        reported(topic=DIAGNOSTICS, name=status.name, level=level, message=status.message)


def transforms(message: Any) -> None:
    for one in message.transforms:
        reported(topic=TRANSFORMS, parent=one.header.frame_id, child=one.child_frame_id)


def overlay(message: Any) -> None:
    reported(topic=OVERLAY, format=message.format, jpeg=bytes(message.data[:2]) == b"\xff\xd8")


def info(message: Any) -> None:
    reported(topic=INFO, width=message.width, model=message.distortion_model)


def main() -> None:
    late = QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1)
    subscribers = []
    for topic, kind, take, qos in (
        (DIAGNOSTICS, "diagnostic_msgs/msg/DiagnosticArray", diagnostics, None),
        (TRANSFORMS, "tf2_msgs/msg/TFMessage", transforms, late),
        (INFO, "sensor_msgs/msg/CameraInfo", info, late),
        (OVERLAY, "sensor_msgs/msg/CompressedImage", overlay, None),
    ):
        subscribers.append(ROS2Subscriber(topic, kind, take, qos=qos, **definition(kind)))
    publishers: dict[str, Any] = {}
    reported(ready=True)
    for line in sys.stdin:
        topic, kind, file = line.split()
        if topic not in publishers:
            publishers[topic] = ROS2Publisher(topic, kind, node_name="driver", **definition(kind))
        publisher = publishers[topic]
        message = publisher.session_mgr.store.deserialize_cdr(Path(file).read_bytes(), kind)
        names = [one.name for one in fields(message) if not one.name.startswith("__")]
        publisher.publish(**{name: getattr(message, name) for name in names})
        reported(sent=topic)
    for one in (*publishers.values(), *subscribers):
        one.close()


if __name__ == "__main__":
    main()
