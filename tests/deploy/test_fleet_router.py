"""The router of a fleet as it is shipped, with a vehicle's router as it is shipped, certificates, and a stand-in for
the storage: `zenohd` and its plugins cannot be had here, so that what the storage manager makes of its section is not
seen; the stand-in keeps what that section names (`tests/storages.py`).
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest
import zenoh

from coec.config import ZenohConfig
from coec.io.zenoh.bus import MSGPACK, Answer
from coec.io.zenoh.query_client import RouterAddress, connected, connected_by, query_all
from coec.io.zenoh.session import unguarded
from coec.schemas import heartbeat as last_word
from coec.schemas.keys import Keys
from conftest import REPOSITORY
from support.fake_worker import wait_until
from support.messages import heartbeat, packed_heartbeat
from support.router import ROUTER_RULES, MemoryStorage, TestAuthority, free_port
from support.vehicles import KEYS, PAIR, serving

DEPLOY = REPOSITORY / "deploy"
FLEET_RULES = DEPLOY / "fleet-router.json5"
USES = "basicConstraints=critical,CA:FALSE\nextendedKeyUsage=serverAuth\nsubjectAltName=DNS:localhost,IP:127.0.0.1\n"
PATIENCE_S = 20.0
ALL = Keys("coec", "*")
STORAGES = json.loads(zenoh.Config.from_file(FLEET_RULES).get_json("plugins/storage_manager"))


@dataclass(frozen=True)
class Fleet:
    """A fleet's router with a storage, and one vehicle behind its own router."""

    authority: TestAuthority
    router: zenoh.Session
    endpoint: str
    of_vehicle: str
    storage: MemoryStorage

    def way(self, name: str) -> RouterAddress:
        return RouterAddress((self.endpoint,), self.authority.session(name, self.endpoint))


def replaced(text: str, *pairs: tuple[str, str]) -> str:
    for shipped, here in pairs:
        assert shipped in text, shipped
        text = text.replace(shipped, here)
    return text


@pytest.fixture(scope="module")
def fleet(authority: TestAuthority, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    authority.sign("fleet", "fleet", uses=USES)
    folder, ports = tmp_path_factory.mktemp("fleet"), [free_port() for _ in range(3)]
    tls = ("/etc/zenoh/tls", str(authority.folder))
    central = folder / "fleet-router.json5"
    central.write_text(replaced(FLEET_RULES.read_text(), tls, ("tls/[::]:7448", f"tls/127.0.0.1:{ports[0]}")))
    of_vehicle = folder / "router.json5"
    (line,) = [line.strip("/ \n") for line in ROUTER_RULES.read_text().splitlines() if "tls/FLEET" in line]
    text = replaced(
        ROUTER_RULES.read_text(), ("connect: { endpoints: [] }", f"connect: {{ endpoints: [{line}] }}"), tls
    )
    doors = (
        ("tls/FLEET:7448", f"tls/localhost:{ports[0]}"),
        ("tls/[::]:7448", f"tls/127.0.0.1:{ports[1]}"),
        ("tcp/127.0.0.1:7447", f"tcp/127.0.0.1:{ports[2]}"),
    )
    of_vehicle.write_text(replaced(text, *doors))
    endpoint, loopback = f"tls/localhost:{ports[0]}", f"tcp/127.0.0.1:{ports[2]}"
    with ExitStack() as stack:
        router = stack.enter_context(zenoh.open(zenoh.Config.from_file(central)))
        reported = STORAGES["storages"]["last_words"]
        storage = stack.enter_context(MemoryStorage(router, reported["key_expr"], complete=reported["complete"]))
        stack.enter_context(zenoh.open(zenoh.Config.from_file(of_vehicle)))
        yield Fleet(authority, router, endpoint, loopback, storage)


def test_the_storage_keeps_what_is_reported_last_and_nothing_else() -> None:
    (storage,) = STORAGES["storages"].values()
    assert storage["volume"]["id"] in STORAGES["volumes"]
    retained = zenoh.KeyExpr(storage["key_expr"])
    assert retained == zenoh.KeyExpr(ALL.last("*"))
    others = (
        KEYS.health(PAIR),
        KEYS.status,
        KEYS.command(PAIR, "hold"),
        KEYS.window(PAIR, "front-1"),
        KEYS.alive(PAIR),
    )
    assert not [key for key in others if retained.intersects(zenoh.KeyExpr(key))]


def test_no_door_of_the_fleet_is_open_to_everybody() -> None:
    assert unguarded(zenoh.Config.from_file(FLEET_RULES)) == ()


@pytest.mark.fault("the vehicle is switched off", "its last word is still available, marked as such")
def test_a_vehicle_that_was_received_once_can_be_requested_about_when_it_has_gone(fleet: Fleet, tmp_path: Path) -> None:
    with connected_by(fleet.way("viewer"), PATIENCE_S) as viewer:
        config = ZenohConfig(connect=(fleet.of_vehicle,))
        with serving(tmp_path, config) as vehicle:
            wait_until(lambda: bool(query_all(viewer, KEYS.health(PAIR), 5.0)), "the viewer reaches the vehicle")
            vehicle.bus.publish(KEYS.last(PAIR), vehicle_answer())
            wait_until(lambda: KEYS.last(PAIR) in fleet.storage.samples, "the fleet has kept its word")
            assert [reply.key for reply in query_all(viewer, "coec/@v1/*/*/health", 5.0)] == [KEYS.health(PAIR)]
        wait_until(lambda: not query_all(viewer, KEYS.health(PAIR), 5.0), "it has gone")
        for expression in (KEYS.last(PAIR), ALL.last("*")):
            (reply,) = query_all(viewer, expression, 5.0)
            assert last_word.decode_heartbeat(reply.key, reply.payload).state == "suspect"


def vehicle_answer() -> Answer:
    return Answer(packed_heartbeat(heartbeat(state="suspect")), MSGPACK)


@pytest.mark.fault("a vehicle that speaks for another", "the fleet's router does not let it through")
def test_a_vehicle_speaks_for_itself_alone(fleet: Fleet) -> None:
    other = Keys("coec", "other").last(PAIR)
    mark = Keys("coec", "vehicle").last("mark")
    with connected([fleet.of_vehicle], 5.0) as onboard:
        for key, vehicle, pair in ((other, "other", PAIR), (mark, "vehicle", "mark")):
            onboard.put(key, packed_heartbeat(heartbeat(vehicle, pair)), timestamp=onboard.new_timestamp())
        wait_until(lambda: mark in fleet.storage.samples, "its own word is kept")
    assert other not in fleet.storage.samples, "each link keeps the order"


@pytest.mark.fault(
    "a command that comes over the fleet's router", "the vehicle's router, as shipped, does not let it through"
)
def test_nobody_commands_over_the_fleet_unless_he_is_let(fleet: Fleet, tmp_path: Path) -> None:
    config = ZenohConfig(connect=(fleet.of_vehicle,))
    with (
        serving(tmp_path, config) as vehicle,
        connected_by(fleet.way("operator"), PATIENCE_S) as operator,
        connected([fleet.of_vehicle], 5.0) as onboard,
    ):
        wait_until(lambda: bool(query_all(operator, KEYS.health(PAIR), 5.0)), "the operator reaches the vehicle")
        assert query_all(operator, KEYS.command(PAIR, "hold"), 2.0) == []
        assert not vehicle.is_held
        assert query_all(onboard, KEYS.command(PAIR, "hold"), 5.0) != []
        assert vehicle.is_held
