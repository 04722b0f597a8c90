"""Whether programs on other computers may reach a session, as far as this computer can tell."""

from __future__ import annotations

from collections.abc import Callable

import zenoh

from coec.adapters.system.listening import IpAddress, Transport, listening_addresses
from coec.adapters.zenoh.endpoints import WITH_PORT, Endpoint, redacted
from coec.adapters.zenoh.settings import connected_of, finds_peers, listened_of

OVER_UDP = frozenset({"udp", "quic"})


class Reach:
    """Reach of a session with these settings."""

    def __init__(
        self, settings: zenoh.Config, addresses: Callable[[Transport, int], set[IpAddress]] = listening_addresses
    ) -> None:
        """`addresses(protocol, port)` returns the addresses of this computer at which somebody listens on a port.

        Raises:
            ConfigError: an endpoint is malformed.
        """
        self._listened = listened_of(settings)
        self._connected = connected_of(settings)
        self._finds_peers = finds_peers(settings)
        self._addresses = addresses

    def exposure(self) -> str | None:
        """A clause that says why programs on other computers may reach the session; None: as far as this computer can
        tell they cannot. Examined anew at each call, because a router may be started or stopped at any time."""
        if self._finds_peers:
            return "it connects to peers that it learns of by gossip"
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
            addresses = self._addresses(protocol, port)
        except OSError:
            return "this system does not show where its router listens"
        wide = sorted(str(address) for address in addresses if not address.is_loopback)
        return f"its router's port {port} is open at {wide[0]}, too" if wide else None
