"""zenoh-bridge-ros2dds: keys of topics, and the tokens by which a bridge finds publishers and subscribers.

Taken from the source of zenoh-plugin-ros2dds 1.10.0.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from coec.adapters.ros.wire.publisher import Publisher
from coec.adapters.ros.wire.qos import Qos

SLASH: Final = "§"
"""Stands for `/` in a key or a type that is one chunk of a token."""

_BRIDGE_TOPIC: Final = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_BRIDGE_TYPE: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*/msg/[A-Za-z][A-Za-z0-9_]*")


def topic_key(namespace: str, topic: str) -> str:
    """`[namespace/]topic`, without slashes at the ends."""
    return "/".join(part for part in (namespace.strip("/"), topic.strip("/")) if part)


@dataclass(frozen=True, slots=True)
class Ros2dds:
    """The dialect of a session beside a bridge. `session` is its Zenoh id, hexadecimal; `namespace` is that of the
    bridge, empty for none. Messages have no attachment."""

    session: str
    namespace: str

    @property
    def node_token(self) -> None:
        """None: bridges announce routes, not nodes."""
        return None

    def key(self, topic: str, type_name: str) -> str:
        """See `Dialect`; the type is not part of the key."""
        del type_name
        return topic_key(self.namespace, topic)

    def publisher_token(self, number: int, topic: str, type_name: str, qos: Qos) -> str:
        """See `Dialect`. A session has one publisher per topic, so that the token has no number."""
        del number
        key, type_chunk = (name.replace("/", SLASH) for name in (self.key(topic, type_name), type_name))
        return f"@/{self.session}/@ros2_lv/MP/{key}/{type_chunk}/{qos_text(qos)}"

    def subscriber_token(self, number: int, topic: str, type_name: str, qos: Qos) -> None:
        """None: a bridge notices the subscription itself."""
        del number, topic, type_name, qos

    def attachment(self, token: str, sequence: int, source_ns: int) -> bytes | None:
        """None: the bridge reads no attachments."""
        del token, sequence, source_ns
        return None


PUBLISHER_TOKENS: Final = "@/*/@ros2_lv/MP/*/*/*"
"""A key expression that matches the tokens of all publishers, of every bridge."""

MAX_BRIDGE_TOKEN: Final = 1024
"""Most characters of a token that is read; tokens of real bridges have some 150."""


def bridge_publisher(token: str, namespace: str) -> Publisher | None:
    """The publisher behind a bridge that a token describes; None if it describes none, one of another namespace, or one
    that is impossible in ROS."""
    chunks = token.split("/") if len(token) <= MAX_BRIDGE_TOKEN else []
    if len(chunks) != 7 or chunks[0] != "@" or chunks[2:4] != ["@ros2_lv", "MP"]:
        return None
    key, type_name = (chunk.replace(SLASH, "/") for chunk in chunks[4:6])
    within = topic_key(namespace, "")
    topic = f"/{key}".removeprefix(f"/{within}" if within else "")
    if not (_BRIDGE_TOPIC.fullmatch(topic) and _BRIDGE_TYPE.fullmatch(type_name)):
        return None
    return Publisher(topic, type_name, None, None)


def qos_text(qos: Qos) -> str:
    """`keyed:reliability:durability:history,depth`, with the numbers of Cyclone DDS; ROS topics are keyless."""
    return f":{int(qos.reliable)}:{int(qos.transient_local)}:0,{qos.depth}"
