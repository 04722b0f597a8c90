"""What rmw_zenoh and the bridge have in common: keys of topics, tokens of publishers, attachments of messages."""

from __future__ import annotations

from typing import Protocol

from coec.adapters.ros.wire.qos import Qos


class Dialect(Protocol):
    """How one session speaks to ROS 2. `topic` begins with `/`; `type_name` is in ROS form
    (`sensor_msgs/msg/Image`)."""

    @property
    def node_token(self) -> str | None:
        """Liveliness token of the session's node; None if sessions are no nodes."""

    def key(self, topic: str, type_name: str) -> str:
        """The Zenoh key of a topic."""

    def publisher_token(self, number: int, topic: str, type_name: str, qos: Qos) -> str:
        """Liveliness token of a publisher; `number` counts the session's entities."""

    def subscriber_token(self, number: int, topic: str, type_name: str, qos: Qos) -> str | None:
        """Liveliness token of a subscriber; None if subscribing is enough."""

    def attachment(self, token: str, sequence: int, source_ns: int) -> bytes | None:
        """Attachment of the `sequence`-th message (from 1) of the publisher with `token`; `source_ns` is the sender's
        wall clock. None: no attachment."""
