"""Opens client sessions: within a time limit, or at once with a connection that follows when a router answers.

Zenoh's own waiting (`connect/timeout_ms`) is switched off. With any other value than 0 a client tries the first
endpoint alone until the time is over, whatever other endpoints there are, and with -1 it never returns (Zenoh 1.10).
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import zenoh

from coec.adapters.zenoh.settings import connected_of

RETRY_S = 0.1
"""Pause between two attempts to reach a router within a time limit."""

LEFT_S = 2.0
"""Timeout until a session has left the router that it was opened with; takes milliseconds."""

_PROTOCOLS = "transport/link/protocols"
_USER = "transport/auth/usrpwd"
_UNIX = "unixsock-stream"


def open_client(settings: zenoh.Config, within_s: float) -> zenoh.Session:
    """A client session with the first of the endpoints that answers. Changes `settings`.

    Raises:
        ZError: none answered within the time limit.
    """
    endpoints = max(len(connected_of(settings)), 1)
    _insert(settings, "connect/timeout_ms", 0)
    _insert(settings, "connect/exit_on_failure", True)
    # An endpoint that takes connections and never answers must not use up the time of the others.
    _insert(settings, "transport/unicast/open_timeout", max(round(within_s * 1000 / endpoints), 1))
    deadline_s = time.monotonic() + within_s
    while True:
        try:
            return zenoh.open(settings)
        except zenoh.ZError:
            if time.monotonic() + RETRY_S >= deadline_s:
                raise
        time.sleep(RETRY_S)


def open_waiting(settings: zenoh.Config) -> zenoh.Session:
    """A client session that is open at once, whether or not a router answers. It connects to the first endpoint that
    answers, as soon as one does, and again whenever its router has gone. Changes `settings`.

    Zenoh opens no client session without a router, but one that has lost its router connects again by itself, for ever.
    So where no router answers, the session is opened with a router of this process, which then ends.

    Raises:
        ZError: the session cannot be opened even so.
    """
    _insert(settings, "connect/timeout_ms", 0)
    _insert(settings, "connect/exit_on_failure", True)
    with suppress(zenoh.ZError):
        return zenoh.open(settings)
    with tempfile.TemporaryDirectory(prefix="coec-") as folder:
        # The session keeps the endpoint for good. By this path nobody can listen there once the folder is removed, not
        # even who makes a folder of the same name; it holds while the descriptor is open: as long as the process runs.
        place = os.open(folder, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
        endpoint = f"{_UNIX}//proc/self/fd/{place}/router"
        with zenoh.open(_router_for(settings, endpoint, Path(folder))) as router:
            _insert(settings, "connect/endpoints", [endpoint, *connected_of(settings)])
            allowed = json.loads(settings.get_json(_PROTOCOLS))
            if allowed:
                _insert(settings, _PROTOCOLS, [*allowed, _UNIX])
            session = zenoh.open(settings)
            own = str(router.info.zid())
    deadline_s = time.monotonic() + LEFT_S
    while own in map(str, session.info.routers_zid()) and time.monotonic() < deadline_s:
        time.sleep(0.001)
    return session


def _router_for(client: zenoh.Config, endpoint: str, folder: Path) -> zenoh.Config:
    """Settings of a router that this client accepts, and that accepts it; the folder is nobody else's."""
    settings = zenoh.Config()
    _insert(settings, "mode", "router")
    _insert(settings, "listen/endpoints", [endpoint])
    _insert(settings, "scouting/multicast/enabled", False)
    _insert(settings, "scouting/gossip/enabled", False)
    _insert(settings, "scouting/delay", 0)
    _insert(settings, "transport/shared_memory/enabled", False)
    user = json.loads(client.get_json(_USER))
    if user.get("user") is not None:
        # A client that gives a name and a password leaves a router that does not ask for them.
        names = folder / "names"
        names.touch(mode=0o600)
        names.write_text(f"{user['user']}:{user.get('password')}\n")
        _insert(settings, f"{_USER}/dictionary_file", str(names))
    return settings


def _insert(settings: zenoh.Config, key: str, value: object) -> None:
    settings.insert_json5(key, json.dumps(value))
