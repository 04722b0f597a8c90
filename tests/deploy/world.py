"""A network namespace in which every address is this computer's own: whoever is spoken to is there, and answers.

Every packet of the namespace passes by one socket, which tells those to the router from all others.
"""

from __future__ import annotations

import ctypes
import ipaddress
import socket
import struct
import subprocess
import threading
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

NAME_SERVER = "192.0.2.53"
EVERYBODY = "198.51.100.7"
"""What the name server answers to every question (RFC 5737: addresses of nobody)."""

HTTPS = 443
DNS = 53
ETH_P_ALL, PACKET_OUTGOING, ETH_P_IP, ETH_P_IPV6 = 0x0003, 4, 0x0800, 0x86DD
SO_RCVBUFFORCE = 33
WAITING_BYTES = 2**30
"""Of packets that wait to be looked at, as the kernel counts: whole, though it keeps no copy of them."""
SOL_PACKET, PACKET_STATISTICS = 263, 6
TCP_LISTEN = "0A"
CLONE_NEWNET = 0x40000000


@dataclass(frozen=True, slots=True, order=True)
class Flow:
    """Where packets went from and to; ports 0 where the protocol has none."""

    protocol: str
    source: str
    source_port: int
    target: str
    target_port: int

    def is_with(self, endpoints: Iterable[tuple[str, int]]) -> bool:
        """Whether one of its ends is one of these, by TCP."""
        ends = {(self.source, self.source_port), (self.target, self.target_port)}
        return self.protocol == "tcp" and bool(ends & set(endpoints))

    def __str__(self) -> str:
        return f"{self.protocol} {self.source}:{self.source_port} > {self.target}:{self.target_port}"


@dataclass
class World:
    """What passes on the network, and what is said to those who are not the router.

    Attributes:
        names_requested: of the name server.
        reported: to the listener, the first bytes of each caller.
        unseen: packets that came faster than they were looked at; known at the end.
    """

    packets: Counter[Flow] = field(default_factory=Counter)
    names_requested: list[str] = field(default_factory=list)
    reported: list[bytes] = field(default_factory=list)
    unseen: int = 0

    def strangers(self, router: Iterable[tuple[str, int]]) -> dict[str, int]:
        """Packets neither to the router nor from it, by flow."""
        endpoints = list(router)
        return {str(flow): count for flow, count in sorted(self.packets.items()) if not flow.is_with(endpoints)}


def leave_for_another() -> None:
    """From here on this process, and what it starts, has a network of its own, in which every address, of version 4 and
    6, leads to loopback. For a main thread that has started no session yet."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(CLONE_NEWNET) != 0:
        raise OSError(ctypes.get_errno(), "unshare")
    for command in (
        "ip link set lo up",
        "ip route add local 0.0.0.0/0 dev lo",
        "ip -6 route add local ::/0 dev lo",
    ):
        subprocess.run(command.split(), check=True)


@contextmanager
def watched() -> Iterator[World]:
    """The world, with a name server and a listener, until the end."""
    world = World()
    sniffer = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(ETH_P_ALL))
    sniffer.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, WAITING_BYTES)
    names = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    names.bind((NAME_SERVER, DNS))
    listener = socket.create_server(("", HTTPS), family=socket.AF_INET6, dualstack_ipv6=True)
    finished = threading.Event()
    tasks = ((_see, sniffer), (_answer_names, names), (_listen, listener))
    threads = [threading.Thread(target=task, args=(finished, sock, world), daemon=True) for task, sock in tasks]
    for _, sock in tasks:
        sock.settimeout(0.2)
    for thread in threads:
        thread.start()
    try:
        yield world
    finally:
        finished.set()
        for thread in threads:
            thread.join()
        for _, sock in tasks:
            sock.close()


def _see(finished: threading.Event, sniffer: socket.socket, world: World) -> None:
    while not finished.is_set():
        with suppress(TimeoutError):
            data, (_, protocol, kind, *_) = sniffer.recvfrom(128)
            if kind == PACKET_OUTGOING:
                world.packets[flow_of(protocol, data)] += 1
    _, world.unseen = struct.unpack("II", sniffer.getsockopt(SOL_PACKET, PACKET_STATISTICS, 8))


def flow_of(protocol: int, data: bytes) -> Flow:
    """Of a packet without its link header."""
    if protocol == ETH_P_IP:
        inner, header = data[9], (data[0] & 15) * 4
        source, target = (str(ipaddress.IPv4Address(data[at : at + 4])) for at in (12, 16))
    elif protocol == ETH_P_IPV6:
        inner, header = data[6], 40
        source, target = (str(ipaddress.IPv6Address(data[at : at + 16])) for at in (8, 24))
    else:
        return Flow(f"ethertype {protocol:#06x}", "?", 0, "?", 0)
    name = {6: "tcp", 17: "udp"}.get(inner)
    if name is None:
        return Flow(f"ip protocol {inner}", source, 0, target, 0)
    source_port, target_port = struct.unpack_from(">HH", data, header)
    return Flow(name, source, source_port, target, target_port)


def _answer_names(finished: threading.Event, names: socket.socket, world: World) -> None:
    while not finished.is_set():
        with suppress(TimeoutError):
            question, sender = names.recvfrom(512)
            labels, at = [], 12
            while question[at]:
                labels.append(question[at + 1 : at + 1 + question[at]].decode("ascii", "replace"))
                at += 1 + question[at]
            (kind,) = struct.unpack_from(">H", question, at + 1)
            world.names_requested.append(".".join(labels))
            result = struct.pack(">HHHLH4s", 0xC00C, 1, 1, 60, 4, socket.inet_aton(EVERYBODY)) if kind == 1 else b""
            counts = struct.pack(">HHHHH", 0x8180, 1, 1 if result else 0, 0, 0)
            names.sendto(question[:2] + counts + question[12 : at + 5] + result, sender)


def _listen(finished: threading.Event, listener: socket.socket, world: World) -> None:
    while not finished.is_set():
        with suppress(TimeoutError, ConnectionError):
            caller, _ = listener.accept()
            with caller:
                caller.settimeout(1.0)
                world.reported.append(caller.recv(4096))


def open_sockets(pids: Iterable[int]) -> set[str]:
    """What these processes listen on, as `tcp 127.0.0.1:7447`, and which UDP ports they have, whoever they are for."""
    owned = {inode for pid in pids for inode in _inodes(pid)}
    result = set()
    for name in ("tcp", "tcp6", "udp", "udp6", "raw", "raw6"):
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]:
            fields = line.split()
            local, state, inode = fields[1], fields[3], fields[9]
            if inode in owned and (not name.startswith("tcp") or state == TCP_LISTEN):
                address, _, port = local.partition(":")
                result.add(f"{name.removesuffix('6')} {_address(address)}:{int(port, 16)}")
    return result


def _inodes(pid: int) -> Iterator[str]:
    for link in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(OSError):
            target = str(link.readlink())
            if target.startswith("socket:["):
                yield target.removeprefix("socket:[").removesuffix("]")


def _address(hexadecimal: str) -> str:
    """As the kernel writes them: words of 32 bits in the byte order of the machine."""
    text = [int(hexadecimal[at : at + 8], 16) for at in range(0, len(hexadecimal), 8)]
    packed = struct.pack(f"={len(text)}I", *text)
    address = ipaddress.ip_address(packed)
    return f"[{address}]" if address.version == 6 else str(address)
