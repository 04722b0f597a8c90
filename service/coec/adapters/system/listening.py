"""Listening sockets of this computer, of any process, from the kernel's tables (proc(5))."""

from __future__ import annotations

import ipaddress
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

Address = ipaddress.IPv4Address | ipaddress.IPv6Address
Transport = Literal["tcp", "udp"]

TABLES = {"tcp": ("tcp", "tcp6"), "udp": ("udp", "udp6")}
WAITS = {"tcp": "0A", "udp": "07"}
"""Their state in the tables: LISTEN for TCP, and CLOSE for UDP, the state of a socket without a peer."""

PROC = Path("/proc/net")
"""Tables of the network namespace of this process."""


def addresses_of_port(protocol: Transport, port: int, tables: Path = PROC) -> set[Address]:
    """Addresses at which a process listens on a port.

    Raises:
        OSError: this system does not tell.
    """
    texts = [(tables / name).read_text() for name in TABLES[protocol] if name == protocol or (tables / name).exists()]
    return {address for text in texts for address, found in _waiting(text, WAITS[protocol]) if found == port}


def _waiting(table: str, state: str) -> Iterator[tuple[Address, int]]:
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
    words = (data[start : start + 4] for start in range(0, len(data), 4))
    return b"".join(word[::-1] if sys.byteorder == "little" else word for word in words)
