"""The quality of service of a topic, as far as it is sent on the wire.

Source: `liveliness_utils.cpp` of rmw_zenoh 0.6.7, checked against it on the wire.
"""

from __future__ import annotations

from dataclasses import dataclass

DEFAULT_DEPTH = 42
"""The depth that rmw_zenoh leaves out of the text."""


@dataclass(frozen=True, slots=True)
class Qos:
    """Keep last `depth`; deadline, lifespan and liveliness are not set."""

    reliable: bool = True
    transient_local: bool = False
    depth: int = DEFAULT_DEPTH

    @property
    def text(self) -> str:
        """`reliability:durability:history,depth:deadline:lifespan:liveliness`; defaults are left empty."""
        reliability = "" if self.reliable else "2"
        durability = "1" if self.transient_local else ""
        depth = "" if self.depth == DEFAULT_DEPTH else str(self.depth)
        return f"{reliability}:{durability}:,{depth}:,:,:,,"


SENSOR_DATA = Qos(reliable=False, depth=5)
"""`rmw_qos_profile_sensor_data`, for subscribers of sensors."""

STATIC = Qos(transient_local=True, depth=1)
"""For publishers of `/tf_static`: late subscribers get the last message (tf2_ros/qos.hpp, StaticBroadcasterQoS)."""

STATIC_LISTENER = Qos(transient_local=True, depth=100)
"""For subscribers of `/tf_static`: the last message of up to 100 publishers (tf2_ros/qos.hpp, StaticListenerQoS)."""
