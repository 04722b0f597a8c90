"""zenoh-bridge-ros2dds: keys of topics, and the tokens by which a bridge finds publishers and subscribers.

Read in the source of zenoh-plugin-ros2dds 1.10.0.
"""

from __future__ import annotations


def topic_key(namespace: str, topic: str) -> str:
    """`[namespace/]topic`, without the slashes at the ends."""
    return "/".join(part for part in (namespace.strip("/"), topic.strip("/")) if part)
