"""A publisher of a topic, as its liveliness token describes it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Publisher:
    """`topic` and `type_name` in ROS form.

    Attributes:
        node: full name of its node; None if it is behind a bridge.
        gid: id of the publisher in its messages; None if its messages have none.
    """

    topic: str
    type_name: str
    node: str | None
    gid: bytes | None
