"""What rmw_zenoh and the bridge have in common: a topic has a key, a publisher a token and something beside each
message."""

from __future__ import annotations

from typing import Protocol

from coec.adapters.ros.wire.qos import Qos


class Dialect(Protocol):
    """How one session speaks to ROS 2. `topic` begins with `/`, `type_name` is ROS's own (`sensor_msgs/msg/Image`)."""

    @property
    def node_token(self) -> str | None:
        """Liveliness token of the session's node; None where sessions are none."""

    def key(self, topic: str, type_name: str) -> str:
        """The Zenoh key of a topic."""

    def publisher_token(self, number: int, topic: str, type_name: str, qos: Qos) -> str:
        """Liveliness token of a publisher; `number` counts the session's entities."""

    def attachment(self, token: str, sequence: int, source_ns: int) -> bytes | None:
        """What a message carries, the `sequence`-th (from 1) of the publisher of `token`; `source_ns` is the sender's
        wall clock. None: nothing."""
