"""Session and router of rmw_zenoh as its own files make them, where nobody changes them.

From `rmw_zenoh_cpp/config/DEFAULT_RMW_ZENOH_{SESSION,ROUTER}_CONFIG.json5` of https://github.com/ros2/rmw_zenoh, commit
076f2e715b54132d00a605e1c45e13401d5e7342 (Apache-2.0). Here stands only what differs from Zenoh's own defaults; values
that a file repeats from them are left out.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import zenoh

_BOTH: Mapping[str, object] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/target": {"router": ["router", "peer"], "peer": ["router"]},
    "timestamping/enabled": {"router": True, "peer": True, "client": True},
    "queries_default_timeout": 600_000,
    "transport/unicast/open_timeout": 60_000,
    "transport/unicast/accept_timeout": 60_000,
    "transport/unicast/accept_pending": 10_000,
    "transport/unicast/max_sessions": 10_000,
    "transport/link/tx/lease": 60_000,
    "transport/link/tx/keep_alive": 2,
    "transport/shared_memory/enabled": False,
    "adminspace/enabled": True,
}

RMW_SESSION: Mapping[str, object] = {
    **_BOTH,
    "mode": "peer",
    "connect/endpoints": ["tcp/localhost:7447"],
    "listen/endpoints": ["tcp/localhost:0"],
    "scouting/gossip/autoconnect_strategy": {"peer": {"to_router": "always", "to_peer": "greater-zid"}},
    "transport/link/tx/queue/congestion_control/block/wait_before_close": 60_000_000,
}
"""Of every node."""

RMW_ROUTER: Mapping[str, object] = {
    **_BOTH,
    "mode": "router",
    "listen/endpoints": ["tcp/[::]:7447"],
    "routing/router/peers_failover_brokering": False,
}
"""Of `rmw_zenohd`, the router of a vehicle."""


def rmw_settings(defaults: Mapping[str, object], changed: Mapping[str, object]) -> zenoh.Config:
    """Settings of a session, some of them other than the file says."""
    made = zenoh.Config()
    for key, value in {**defaults, **changed}.items():
        made.insert_json5(key, json.dumps(value))
    return made


@contextmanager
def rmw_node(endpoint: str) -> Iterator[zenoh.Session]:
    """The session of a node that connects to the router at this endpoint."""
    with zenoh.open(rmw_settings(RMW_SESSION, {"connect/endpoints": [endpoint]})) as session:
        yield session


@contextmanager
def rmw_router(endpoint: str) -> Iterator[zenoh.Session]:
    """The router, at this endpoint."""
    with zenoh.open(rmw_settings(RMW_ROUTER, {"listen/endpoints": [endpoint]})) as session:
        yield session
