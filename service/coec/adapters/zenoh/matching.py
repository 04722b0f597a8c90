"""Whether a publisher has subscribers."""

from __future__ import annotations

from typing import cast

import zenoh


def has_subscribers(publisher: zenoh.Publisher) -> bool:
    """Whether somebody subscribes to the publisher's key."""
    # The stubs of eclipse-zenoh 1.10 declare a bool, but it is a `MatchingStatus` object, which is always truthy.
    return cast("zenoh.MatchingStatus", publisher.matching_status).matching
