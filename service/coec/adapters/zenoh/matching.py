"""Whether anybody listens."""

from __future__ import annotations

from typing import cast

import zenoh


def is_heard(publisher: zenoh.Publisher) -> bool:
    """Whether somebody subscribes to what it publishes."""
    # The stubs of eclipse-zenoh 1.10 call it a bool; it is a `MatchingStatus`, which is always true.
    return cast("zenoh.MatchingStatus", publisher.matching_status).matching
