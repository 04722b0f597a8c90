"""Real nodes of ROS 2, and a relay between them and Zenoh that speaks the keys of zenoh-bridge-ros2dds."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import zenoh
from rosbags.typesys import Stores, get_typestore
from zenoh.ext import (
    CacheConfig,
    HistoryConfig,
    MissDetectionConfig,
    RecoveryConfig,
    declare_advanced_publisher,
    declare_advanced_subscriber,
)

from peers.environments import PEERS, TIMEOUT_S, python_of

STORE = get_typestore(Stores.ROS2_HUMBLE)

Received = Callable[[str, bytes], None]

DOMAINS = 101
"""ROS_DOMAIN_ID from 0 on: above, its ports may be those that Linux gives to others."""


LATCHED = 100
"""Messages that a latched topic keeps."""


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a node; one that is latched is told to whoever comes later."""

    type: str
    latched: bool = False


class Node:
    """A node in a process of its own."""

    def __init__(self, process: subprocess.Popen[bytes], received: Received) -> None:
        self._process = process
        self._received = received
        self._writing = threading.Lock()
        self._changed = threading.Condition()
        self._peers: dict[str, int] = {}
        self._reader = threading.Thread(target=self._read, name="node-reader")
        self._reader.start()

    def publish(self, topic: str, payload: bytes) -> None:
        """Have a message in CDR published. Any thread."""
        head = json.dumps({"topic": topic, "bytes": len(payload)}).encode()
        assert self._process.stdin is not None
        with self._writing:
            self._process.stdin.write(struct.pack(">I", len(head)) + head + payload)
            self._process.stdin.flush()

    def wait_for_peers(self, *topics: str) -> None:
        """Until somebody is at the other end of each topic."""
        with self._changed:
            done = self._changed.wait_for(lambda: all(self._peers.get(topic, 0) for topic in topics), TIMEOUT_S)
        assert done, f"nobody at the other end: {self._peers}, of {topics}"

    def close(self) -> None:
        """End it."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(TIMEOUT_S)
        self._reader.join(TIMEOUT_S)

    def _read(self) -> None:
        stream = self._process.stdout
        assert stream is not None
        while len(length := stream.read(4)) == 4:
            head: dict[str, Any] = json.loads(stream.read(*struct.unpack(">I", length)))
            payload = stream.read(head["bytes"])
            if "matched" in head:
                with self._changed:
                    self._peers[head["matched"]] = head["peers"]
                    self._changed.notify_all()
            else:
                self._received(head["topic"], payload)


@contextmanager
def node(name: str, publish: Mapping[str, Topic], subscribe: Mapping[str, Topic], received: Received) -> Iterator[Node]:
    """A real node; `heard` gets what it receives, in CDR, on a thread of its own."""
    reported = {
        "name": name,
        "publish": {topic: {"type": one.type, "latched": one.latched} for topic, one in publish.items()},
        "subscribe": {topic: {"type": one.type, "latched": one.latched} for topic, one in subscribe.items()},
    }
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(os.getpid() % DOMAINS),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
    }
    command = [str(python_of("ros2")), str(PEERS / "ros2" / "node_worker.py"), json.dumps(reported)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, env=environment) as process:
        running = Node(process, received)
        try:
            yield running
        finally:
            running.close()


@contextmanager
def relay(session: zenoh.Session, to_zenoh: Mapping[str, Topic], to_ros: Mapping[str, Topic]) -> Iterator[Node]:
    """What the bridge does: topics of ROS as keys, raw CDR, no attachment, no encoding, latched ones by the advanced
    publisher and subscriber. What it brought itself it does not take back, on either side."""
    brought: set[tuple[str, bool, str]] = set()
    publishers: dict[str, Any] = {}
    for topic, one in to_zenoh.items():
        key = topic.lstrip("/")
        publishers[topic] = (
            declare_advanced_publisher(
                session,
                key,
                cache=CacheConfig(LATCHED),
                publisher_detection=True,
                sample_miss_detection=MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
            )
            if one.latched
            else session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
        )

    def to_key(topic: str, payload: bytes) -> None:
        reported = values_of(to_zenoh[topic].type, payload)
        if (topic, True, reported) not in brought:
            brought.add((topic, False, reported))
            publishers[topic].put(payload)

    with node("relay", to_ros, to_zenoh, to_key) as running:
        subscribers = []
        for topic, one in to_ros.items():

            def to_topic(sample: zenoh.Sample, topic: str = topic) -> None:
                payload = sample.payload.to_bytes()
                reported = values_of(to_ros[topic].type, payload)
                if (topic, False, reported) not in brought:
                    brought.add((topic, True, reported))
                    running.publish(topic, payload)

            key = topic.lstrip("/")
            subscribers.append(
                declare_advanced_subscriber(
                    session,
                    key,
                    to_topic,
                    history=HistoryConfig(detect_late_publishers=True, max_samples=LATCHED),
                    recovery=RecoveryConfig(periodic_queries=None, heartbeat=True),
                    subscriber_detection=True,
                )
                if one.latched
                else session.declare_subscriber(key, to_topic)
            )
        try:
            yield running
        finally:
            for declared in (*subscribers, *publishers.values()):
                declared.undeclare()


def values_of(type_name: str, payload: bytes) -> str:
    """A message by its values: what fills the gaps between them differs from writer to writer."""
    return repr(STORE.deserialize_cdr(payload, type_name))


class Inbox:
    """What a node has heard, by topic."""

    def __init__(self) -> None:
        self._messages: dict[str, list[bytes]] = {}
        self._changed = threading.Condition()

    def receive(self, topic: str, payload: bytes) -> None:
        """A message came."""
        with self._changed:
            self._messages.setdefault(topic, []).append(payload)
            self._changed.notify_all()

    def messages(self, topic: str) -> list[bytes]:
        """All that came, in their order."""
        with self._changed:
            return list(self._messages.get(topic, ()))

    def until(self, topic: str, condition: Callable[[list[bytes]], bool], what: str, within_s: float) -> list[bytes]:
        """The messages of a topic, once they fulfil the condition."""
        deadline_s = time.monotonic() + within_s
        with self._changed:
            while not condition(list(self._messages.get(topic, ()))):
                left_s = deadline_s - time.monotonic()
                assert left_s > 0, f"not within {within_s:g} s: {what}; {len(self._messages.get(topic, ()))} messages"
                self._changed.wait(left_s)
            return list(self._messages[topic])
