"""What ROS publishes on the vehicle, for the author of a configuration."""

from __future__ import annotations

from collections.abc import Iterator
from typing import get_args

from coec.adapters.zenoh.ros_topics import Topics, listed
from coec.cli.doctor.found import fail, ok, warn
from coec.cli.doctor.router import cause_of_silence
from coec.config import CameraMessage, Config, EgoMessage, LidarMessage
from coec.schemas.doctor import Finding

TAKEN = frozenset((*get_args(CameraMessage), *get_args(LidarMessage), *get_args(EgoMessage)))
"""Message types that a stream may have."""

NAMED = 40
"""Most topics that are named; a vehicle with more sensors is better examined with ROS's own tools."""


def topic_findings(here: Topics, topics: Topics, config: Config) -> Iterator[Finding]:
    """Findings on topics: types and nodes of those that may be streams, and the number of others; and those of them
    that the service does not see.

    Args:
        here: topics seen through a session as the service opens it.
        topics: those that a client of the router sees.
    """
    is_rmw = config.middleware == "rmw_zenoh"
    where = f"domain {config.ros.domain}" if is_rmw else f"bridge {config.ros.namespace}".strip()
    if not topics.publishers:
        advice = (
            "see that nodes and bridge use this router, that ros.domain or ros.namespace is theirs, and that the "
            "router's rules let this certificate see @ros2_lv/** (docs/security.md)"
        )
        yield warn("topics", where, "nobody on this router says that it publishes a topic of ROS", advice)
    else:
        types = topics.types()
        lines = [
            f"{topic} ({', '.join(kinds)}{_from(topics, topic)})"
            for topic, kinds in types.items()
            if not TAKEN.isdisjoint(kinds)
        ]
        more = f"; {len(lines) - NAMED} more such" if len(lines) > NAMED else ""
        others = len(types) - len(lines)
        named = "; ".join(lines[:NAMED]) if lines else "none that may be a stream"
        yield ok("topics", where, f"{named}{more}; {others} of other types")
        unseen = [topic for topic in types if not here.of(topic)]
        if unseen:
            cause, advice = cause_of_silence(config)
            yield fail("topics", where, f"the service does not see {listed(unseen)}: {cause}", advice)
    if topics.left_out:
        counted = ", ".join(f"{count} {cause}" for cause, count in sorted(topics.left_out.items()))
        advice = "see who declares them: no node of ROS does"
        yield warn("topics", where, f"liveliness tokens that were not read: {counted}", advice)


def _from(topics: Topics, topic: str) -> str:
    nodes = sorted({one.node for one in topics.of(topic) if one.node})
    return f", by {', '.join(nodes)}" if nodes else ""
