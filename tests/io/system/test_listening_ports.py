"""Who waits at a port, as the kernel's tables tell it."""

from __future__ import annotations

import ipaddress
import socket
from pathlib import Path

import pytest

from coec.io.system import listening_addresses

HEAD = "  sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout inode\n"


@pytest.mark.parametrize(
    ("family", "kind", "protocol", "address"),
    [
        (socket.AF_INET, socket.SOCK_STREAM, "tcp", "127.0.0.1"),
        (socket.AF_INET, socket.SOCK_STREAM, "tcp", "0.0.0.0"),
        (socket.AF_INET6, socket.SOCK_STREAM, "tcp", "::1"),
        (socket.AF_INET6, socket.SOCK_STREAM, "tcp", "::"),
        (socket.AF_INET, socket.SOCK_DGRAM, "udp", "127.0.0.1"),
    ],
)
def test_a_socket_that_waits_is_detected(family: int, kind: int, protocol: str, address: str) -> None:
    with socket.socket(family, kind) as one:
        try:
            one.bind((address, 0))
        except OSError:
            pytest.skip(f"this computer has no {address}")
        if kind == socket.SOCK_STREAM:
            one.listen()
        port = one.getsockname()[1]
        result = listening_addresses("udp" if protocol == "udp" else "tcp", port)
        assert result == {ipaddress.ip_address(address)}
    assert listening_addresses("udp" if protocol == "udp" else "tcp", port) == set()


def test_a_connection_is_nobody_who_waits(tmp_path: Path) -> None:
    (tmp_path / "tcp").write_text(
        HEAD
        + "   0: 0100007F:1D17 00000000:0000 0A 00000000:00000000 00:00000000 00000000     0        0 1 1 0 100 0 0\n"
        + "   1: 0501A8C0:1D17 0601A8C0:9C40 01 00000000:00000000 00:00000000 00000000     0        0 2 1 0 100 0 0\n"
    )
    assert listening_addresses("tcp", 7447, tmp_path) == {ipaddress.ip_address("127.0.0.1")}


def test_an_address_of_ipv4_on_a_socket_of_ipv6_is_one_of_ipv4() -> None:
    with socket.socket(socket.AF_INET6, socket.SOCK_STREAM) as one:
        try:
            one.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
            one.bind(("::ffff:127.0.0.1", 0))
        except OSError:
            pytest.skip("this computer has no IPv6")
        one.listen()
        assert listening_addresses("tcp", one.getsockname()[1]) == {ipaddress.ip_address("127.0.0.1")}


def test_a_system_without_tables_says_so(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="tcp"):
        listening_addresses("tcp", 7447, tmp_path)
