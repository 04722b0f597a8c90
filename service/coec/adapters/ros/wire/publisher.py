"""A publisher of a topic, as its liveliness token tells of it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Publisher:
    """`topic` and `type_name` as ROS says them.

    Attributes:
        node: its full name; None where a bridge stands before it.
        gid: by which its messages tell where they come from; None where they do not.
    """

    topic: str
    type_name: str
    node: str | None
    gid: bytes | None
