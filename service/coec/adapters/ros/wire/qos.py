"""The quality of service of a topic, as far as it is told on the wire.

Source: `liveliness_utils.cpp` of rmw_zenoh 0.6.7, seen on the wire against it.
"""

from __future__ import annotations

from dataclasses import dataclass

DEFAULT_DEPTH = 42
"""What rmw_zenoh leaves unsaid."""


@dataclass(frozen=True, slots=True)
class Qos:
    """Keep last `depth`; deadline, lifespan and liveliness are those of a topic without any."""

    reliable: bool = True
    transient_local: bool = False
    depth: int = DEFAULT_DEPTH

    @property
    def text(self) -> str:
        """`reliability:durability:history,depth:deadline:lifespan:liveliness`, empty where it is the default."""
        reliability = "" if self.reliable else "2"
        durability = "1" if self.transient_local else ""
        depth = "" if self.depth == DEFAULT_DEPTH else str(self.depth)
        return f"{reliability}:{durability}:,{depth}:,:,:,,"


SENSOR_DATA = Qos(reliable=False, depth=5)
"""`rmw_qos_profile_sensor_data`: what subscribers of sensors take."""

STATIC = Qos(transient_local=True, depth=1)
"""Of `/tf_static`: whoever comes later gets the last one (tf2_ros/qos.hpp, StaticBroadcasterQoS)."""

STATIC_LISTENER = Qos(transient_local=True, depth=100)
"""Of who listens to `/tf_static`: the last one of each of so many publishers (tf2_ros/qos.hpp, StaticListenerQoS)."""
