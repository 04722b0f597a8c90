"""Who may reach a session: only programs on this computer, as far as it can be told, or others, too."""

from __future__ import annotations

import json
from collections.abc import Callable

import zenoh

from coec.adapters.system.listening import Address, Transport, addresses_of_port
from coec.adapters.zenoh.endpoints import WITH_PORT, Endpoint, redacted
from coec.adapters.zenoh.settings import connected_of, listened_of

OVER_UDP = frozenset({"udp", "quic"})


class Reach:
    """That of a session with these settings."""

    def __init__(
        self, settings: zenoh.Config, addresses: Callable[[Transport, int], set[Address]] = addresses_of_port
    ) -> None:
        """`addresses(protocol, port)` tells where somebody waits at a port of this computer.

        Raises:
            ConfigError: an endpoint is none.
        """
        self._listened = listened_of(settings)
        self._connected = connected_of(settings)
        self._gossip = bool(json.loads(settings.get_json("scouting/gossip/enabled")))
        self._addresses = addresses

    def outside(self) -> str | None:
        """Why programs on other computers may reach the session, in a clause; None: they do not, as far as it can be
        told. A router may be started and stopped at any time, so that it is looked at anew each time."""
        if self._gossip:
            return "it connects to whom gossip tells it of"
        for text in (*self._listened, *self._connected):
            endpoint = Endpoint.parse(text)
            if not endpoint.on_loopback:
                does = "listens at" if text in self._listened else "connects to"
                return f"it {does} {redacted(text)}"
        for text in self._connected:
            endpoint = Endpoint.parse(text)
            if endpoint.protocol in WITH_PORT and (why := self._also_elsewhere(endpoint)):
                return why
        return None

    def _also_elsewhere(self, router: Endpoint) -> str | None:
        protocol: Transport = "udp" if router.protocol in OVER_UDP else "tcp"
        port = router.port
        try:
            found = self._addresses(protocol, port)
        except OSError:
            return "this system does not tell where its router listens"
        wide = sorted(str(address) for address in found if not address.is_loopback)
        return f"its router's port {port} is open at {wide[0]}, too" if wide else None
