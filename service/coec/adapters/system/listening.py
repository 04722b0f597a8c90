"""Listening sockets of this computer, of any process, from the kernel's tables (proc(5))."""

from __future__ import annotations

import ipaddress
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

IpAddress = ipaddress.IPv4Address | ipaddress.IPv6Address
Transport = Literal["tcp", "udp"]

SOCKET_TABLES = {"tcp": ("tcp", "tcp6"), "udp": ("udp", "udp6")}
LISTENING_STATES = {"tcp": "0A", "udp": "07"}
"""Their state in the tables: LISTEN for TCP, and CLOSE for UDP, the state of a socket without a peer."""

PROC_NET = Path("/proc/net")
"""Tables of the network namespace of this process."""


def listening_addresses(protocol: Transport, port: int, tables: Path = PROC_NET) -> set[IpAddress]:
    """Addresses at which a process listens on a port.

    Raises:
        OSError: this system does not tell.
    """
    texts = [
        (tables / name).read_text() for name in SOCKET_TABLES[protocol] if name == protocol or (tables / name).exists()
    ]
    return {
        address
        for text in texts
        for address, listening_port in _listening_sockets(text, LISTENING_STATES[protocol])
        if listening_port == port
    }


def _listening_sockets(table: str, state: str) -> Iterator[tuple[IpAddress, int]]:
    for line in table.splitlines()[1:]:
        columns = line.split()
        if columns[3] == state:
            digits, _, port = columns[1].partition(":")
            address = ipaddress.ip_address(_in_network_order(digits))
            # An IPv6 socket may be bound to an IPv4 address.
            yield getattr(address, "ipv4_mapped", None) or address, int(port, 16)


def _in_network_order(digits: str) -> bytes:
    """The bytes of an address; the kernel writes it as words of 32 bits in the byte order of the machine."""
    data = bytes.fromhex(digits)
    groups = (data[start : start + 4] for start in range(0, len(data), 4))
    return b"".join(word[::-1] if sys.byteorder == "little" else word for word in groups)
