"""Sockets of this computer that wait for others, whoever they belong to, as the kernel tells them (proc(5))."""

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
"""Their state in the table: LISTEN; and CLOSE, in which a UDP socket is that is connected to nobody."""

PROC = Path("/proc/net")
"""Of the network namespace of this process."""


def addresses_of_port(protocol: Transport, port: int, tables: Path = PROC) -> set[Address]:
    """Addresses at which somebody waits at a port.

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
            # A socket of IPv6 may be bound to an address of IPv4.
            yield getattr(address, "ipv4_mapped", None) or address, int(port, 16)


def _in_network_order(digits: str) -> bytes:
    """The kernel writes an address as words of 32 bits in the order of the machine."""
    data = bytes.fromhex(digits)
    words = (data[start : start + 4] for start in range(0, len(data), 4))
    return b"".join(word[::-1] if sys.byteorder == "little" else word for word in words)
