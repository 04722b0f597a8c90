"""zenoh-bridge-ros2dds: keys of topics, and the tokens by which a bridge finds publishers and subscribers.

Read in the source of zenoh-plugin-ros2dds 1.10.0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from coec.adapters.ros.wire.qos import Qos

SLASH: Final = "§"
"""Stands for `/` where a key or a type is one chunk of a token."""


def topic_key(namespace: str, topic: str) -> str:
    """`[namespace/]topic`, without the slashes at the ends."""
    return "/".join(part for part in (namespace.strip("/"), topic.strip("/")) if part)


@dataclass(frozen=True, slots=True)
class Ros2dds:
    """The dialect of a session beside a bridge. `session` is its Zenoh id, hexadecimal; `namespace` that of the bridge,
    empty for none. Messages carry nothing but themselves."""

    session: str
    namespace: str

    @property
    def node_token(self) -> None:
        """Bridges tell of routes, not of nodes."""
        return None

    def key(self, topic: str, type_name: str) -> str:
        """See `Dialect`; the type is no part of it."""
        del type_name
        return topic_key(self.namespace, topic)

    def publisher_token(self, number: int, topic: str, type_name: str, qos: Qos) -> str:
        """See `Dialect`; there is one publisher of a topic in a session, which therefore has no number."""
        del number
        key, type_chunk = (name.replace("/", SLASH) for name in (self.key(topic, type_name), type_name))
        return f"@/{self.session}/@ros2_lv/MP/{key}/{type_chunk}/{qos_text(qos)}"

    def attachment(self, token: str, sequence: int, source_ns: int) -> bytes | None:
        """Nothing: the bridge reads none."""
        del token, sequence, source_ns
        return None


def qos_text(qos: Qos) -> str:
    """`keyed:reliability:durability:history,depth`, the numbers those of Cyclone DDS; ROS's topics are keyless."""
    return f":{int(qos.reliable)}:{int(qos.transient_local)}:0,{qos.depth}"
