"""Whether only programs on this computer reach a session: as far as it can be told, and never more than that."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from pathlib import Path

import pytest

from coec.config import LimitsConfig, ZenohConfig
from coec.io.system import IpAddress, Transport
from coec.io.zenoh.session import Reach, settings_of

LIMITS = LimitsConfig()


def context(config: ZenohConfig, *waiting: tuple[Transport, int, str]) -> str | None:
    """Why others reach a session, on a computer where these wait at ports."""

    def addresses(protocol: Transport, port: int) -> set[IpAddress]:
        return {ipaddress.ip_address(address) for kind, at, address in waiting if (kind, at) == (protocol, port)}

    return Reach(settings_of(config, LIMITS), addresses).exposure()


def to(*endpoints: str) -> ZenohConfig:
    return ZenohConfig(connect=endpoints)


@pytest.mark.parametrize(
    ("config", "waiting"),
    [
        (to("tcp/127.0.0.1:7447"), ()),
        (to("tcp/127.0.0.1:7447"), [("tcp", 7447, "127.0.0.1"), ("tcp", 7448, "0.0.0.0"), ("udp", 7447, "::")]),
        (to("tcp/[::1]:7447", "unixsock-stream/run/zenoh.sock"), [("tcp", 7447, "::1")]),
        (ZenohConfig(embedded_router=True), ()),
    ],
)
def test_loopback_is_this_computer(config: ZenohConfig, waiting: Iterable[tuple[Transport, int, str]]) -> None:
    assert context(config, *waiting) is None


@pytest.mark.parametrize(
    ("config", "waiting", "why"),
    [
        (to("tcp/10.0.0.2:7447"), (), "it connects to tcp/10.0.0.2:7447"),
        (to("tls/router:7448#password=secret"), (), "it connects to tls/router:7448#password=***"),
        (to("tcp/127.0.0.1:7447"), [("tcp", 7447, "0.0.0.0")], "its router's port 7447 is open at 0.0.0.0, too"),
        (to("quic/127.0.0.1:7447"), [("udp", 7447, "::")], "its router's port 7447 is open at ::, too"),
        (to("tcp/127.0.0.1:1", "tcp/127.0.0.1:2"), [("tcp", 2, "192.168.1.5")], "port 2 is open at 192.168.1.5"),
        (
            ZenohConfig(embedded_router=True, listen=("tcp/127.0.0.1:1", "tcp/[::]:7447"), insecure=True),
            (),
            "it listens at tcp/[::]:7447",
        ),
    ],
)
def test_whatever_else_is_not(config: ZenohConfig, waiting: Iterable[tuple[Transport, int, str]], why: str) -> None:
    assert why in str(context(config, *waiting))


@pytest.mark.parametrize(
    ("reported", "finds"),
    [
        ('mode: "peer", scouting: { gossip: { enabled: true } }', True),
        ('mode: "router", scouting: { gossip: { enabled: true, autoconnect: ["peer"] } }', True),
        ('mode: "peer", scouting: { gossip: { enabled: true, autoconnect: { router: ["peer"], peer: [] } } }', False),
        ('mode: "peer"', False),
        ('mode: "router", scouting: { gossip: { enabled: true } }', False),
        ("scouting: { gossip: { enabled: true } }", True),
        ('mode: "client", scouting: { gossip: { enabled: true } }', False),  # it has its router alone
    ],
)
def test_a_peer_that_gossips_may_connect_to_anybody(tmp_path: Path, reported: str, finds: bool) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(f'{{ {reported}, listen: {{ endpoints: ["tcp/127.0.0.1:0"] }} }}')
    assert context(ZenohConfig(file=file)) == ("it connects to peers that it learns of by gossip" if finds else None)


def test_what_cannot_be_determined_is_not_this_computers_alone() -> None:
    def untold(_: Transport, __: int) -> set[IpAddress]:
        raise FileNotFoundError

    reach = Reach(settings_of(to("tcp/127.0.0.1:7447"), LIMITS), untold)
    assert reach.exposure() == "this system does not show where its router listens"
