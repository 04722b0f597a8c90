"""In ROS 2's own environment: one node with publishers and subscribers, driven by frames on its pipes.

A frame is four bytes (big endian) with the length of its head, the head in JSON, and as many bytes as its `bytes` says.

    argument  {"name": "vehicle", "publish": {"/topic": {"type": "...", "latched": false}}, "subscribe": {...}}
    in        {"topic": "/topic", "bytes": n} + CDR     publish it, built by rclpy from these bytes
    out       {"topic": "/topic", "bytes": n} + CDR     received, of the message as rclpy holds it
              {"matched": "/topic", "peers": n, "bytes": 0}
"""

from __future__ import annotations

import contextlib
import importlib
import json
import struct
import sys
import threading
from functools import partial
from typing import Any, BinaryIO

import rclpy
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message

DEPTH = 200
"""Messages kept for a reader that is slow: a test loses none."""

writing = threading.Lock()


def report(head: dict[str, Any], payload: bytes = b"") -> None:
    text = json.dumps({**head, "bytes": len(payload)}).encode()
    with writing:
        sys.stdout.buffer.write(struct.pack(">I", len(text)) + text + payload)
        sys.stdout.buffer.flush()


def received(topic: str, message: Any) -> None:
    report({"topic": topic}, bytes(serialize_message(message)))


def matched(topic: str, info: Any) -> None:
    report({"matched": topic, "peers": info.current_count})


def type_of(name: str) -> Any:
    package, _, message = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), message)


def qos_of(*, latched: bool) -> QoSProfile:
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    return QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.RELIABLE, durability=durability)


def frame(stream: BinaryIO) -> tuple[dict[str, Any], bytes] | None:
    length = stream.read(4)
    if len(length) < 4:
        return None
    head = json.loads(stream.read(*struct.unpack(">I", length)))
    return head, stream.read(head["bytes"])


def main() -> None:
    reported = json.loads(sys.argv[1])
    rclpy.init()
    node = rclpy.create_node(reported["name"])
    publishers = {
        topic: node.create_publisher(
            type_of(one["type"]),
            topic,
            qos_of(latched=one["latched"]),
            event_callbacks=PublisherEventCallbacks(matched=partial(matched, topic)),
        )
        for topic, one in reported["publish"].items()
    }
    types = {topic: type_of(one["type"]) for topic, one in reported["publish"].items()}
    for topic, one in reported["subscribe"].items():
        node.create_subscription(
            type_of(one["type"]),
            topic,
            partial(received, topic),
            qos_of(latched=one["latched"]),
            event_callbacks=SubscriptionEventCallbacks(matched=partial(matched, topic)),
        )

    def spin() -> None:
        with contextlib.suppress(ExternalShutdownException):
            rclpy.spin(node)

    spinning = threading.Thread(target=spin)
    spinning.start()
    while (taken := frame(sys.stdin.buffer)) is not None:
        head, payload = taken
        publishers[head["topic"]].publish(deserialize_message(payload, types[head["topic"]]))
    rclpy.shutdown()
    spinning.join()


main()
