"""The router's rules as they are shipped, with real sessions and certificates: what they allow works, and nothing else.

To a client a denied query is an empty list, as if nobody were there: Zenoh tells no more. What reads it for people is
`coec query` (`tests/cli`).
"""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest
import zenoh
from zenoh.ext import (
    CacheConfig,
    HistoryConfig,
    MissDetectionConfig,
    declare_advanced_publisher,
    declare_advanced_subscriber,
)

from coec.config import IDENTITY, Config, SenderConfig, ZenohConfig
from coec.errors import ConnectionFailedError, UnavailableError
from coec.io.zenoh.bus import JSON, on_key, open_session
from coec.io.zenoh.command_auth import CommandSender
from coec.io.zenoh.query_client import RouterAddress, connected_by, is_alive, send_authenticated
from coec.io.zenoh.ros_node import RosSide
from coec.io.zenoh.singleton import SingletonGuard
from support.fake_worker import wait_until
from support.ros import RosDriver, type_chunks
from support.router import ShippedRouter, TestAuthority, make_authority, shipped_router
from support.vehicles import KEYS, PAIR, VEHICLE_LIMITS, ServingVehicle, serving

PATIENCE_S = 20.0
REFUSED_S = 0.5
"""A session that is let in is open in some 20 ms."""

BRIEF_S = 6
"""Of a certificate; openssl counts whole seconds."""

FRAMES = "sensors/front/camera"
IMAGE_TOPIC = "/front/image_raw/compressed"
ROS_VEHICLE = Config.model_validate(
    {
        "middleware": "rmw_zenoh",
        "pairs": [
            {
                "name": PAIR,
                "camera": {
                    "topic": IMAGE_TOPIC,
                    "intrinsics": {"model": "pinhole", "width": 8, "height": 6, "fx": 4, "fy": 4, "cx": 4, "cy": 3},
                },
                "lidar": "/top/points",
                "T_camera_lidar": IDENTITY,
            }
        ],
    }
)
READABLE = {
    "extrinsic": KEYS.extrinsic(PAIR),
    "health": KEYS.health(PAIR),
    "history": KEYS.history(PAIR),
    "windows": KEYS.windows(PAIR),
    "a window": KEYS.window(PAIR, "front-1"),
    "overlay": KEYS.overlay(PAIR),
    "evidence": KEYS.evidence(PAIR),
    "an incident": KEYS.evidence_of(PAIR, "front-1"),
    "status": KEYS.status,
    "metrics": KEYS.metrics,
    "config": KEYS.config,
    "health of all": "coec/@v1/*/*/health",
    "rig": KEYS.rig,
    "a last word": KEYS.last(PAIR),
    "last words of all": "coec/@v1/*/last/*",
}
CHECKED_FOR = MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5)
COMMAND = KEYS.command(PAIR, "hold")
NOT_READABLE = (f"{KEYS.root}/**", "coec/@v1/**", "coec/**", "**", "@/**", "@/*/router", "@/**/config/**", FRAMES)


@pytest.fixture(scope="module")
def door(authority: TestAuthority, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ShippedRouter]:
    with shipped_router(authority, tmp_path_factory.mktemp("router")) as made:
        yield made


@dataclass(frozen=True)
class Town:
    """A vehicle, and one session of everybody."""

    vehicle: ServingVehicle
    vehicle_session: zenoh.Session
    sensors: zenoh.Session
    operator: zenoh.Session
    viewer: zenoh.Session
    ros: zenoh.Session
    side: RosSide
    frames: list[bytes]
    images: list[bytes]

    def of(self, name: str) -> zenoh.Session:
        session = getattr(self, name)
        assert isinstance(session, zenoh.Session)
        return session


@pytest.fixture(scope="module", params=["on the router's computer", "on another computer"])
def town(
    request: pytest.FixtureRequest, door: ShippedRouter, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Town]:
    away = request.param == "on another computer"
    file = door.authority.session("vehicle", door.certified) if away else None
    config = ZenohConfig(connect=(door.loopback,), file=file)
    frames: list[bytes] = []
    images: list[bytes] = []
    may = door.authority.of_service(SenderConfig(name="operator"))
    with ExitStack() as stack:
        vehicle = stack.enter_context(serving(tmp_path_factory.mktemp("state"), config, may))
        vehicle.bus.subscribe(on_key(FRAMES), lambda sample: frames.append(sample.payload))
        side = RosSide(vehicle.bus._session, ROS_VEHICLE)
        stack.callback(side.close)
        camera = side.input_of(ROS_VEHICLE.every_pair[0].camera)
        vehicle.bus.subscribe(camera, lambda sample: images.append(sample.payload))
        sessions = {
            name: stack.enter_context(connected_by(door.connection(name), PATIENCE_S))
            for name in ("sensors", "operator", "viewer", "ros")
        }
        made = Town(vehicle, vehicle.bus._session, side=side, frames=frames, images=images, **sessions)
        wait_until(lambda: bool(answers(made.operator, KEYS.status)), "the operator reaches the vehicle")
        wait_until(lambda: bool(answers(made.viewer, KEYS.status)), "the viewer reaches the vehicle")
        yield made


def answers(session: zenoh.Session, key: str, payload: bytes | None = None) -> list[zenoh.Reply]:
    """Good ones and error replies of the service."""
    elsewhere = zenoh.Locality.REMOTE  # a session has an admin space of its own
    replies = list(session.get(key, payload=payload, timeout=PATIENCE_S, allowed_destination=elsewhere))
    errors = [reply.err.payload.to_bytes() for reply in replies if reply.err is not None]
    assert b"Timeout" not in errors
    return replies


def seen(town: Town, name: str) -> None:
    """What a session did before has come through the router and to the vehicle, if it comes at all: each link keeps the
    order."""
    list(town.of(name).get(KEYS.status, timeout=PATIENCE_S))
    assert answers(town.operator, KEYS.status)


@pytest.mark.parametrize("what", READABLE)
@pytest.mark.parametrize("name", ["operator", "viewer"])
def test_operator_and_viewer_read_everything(town: Town, name: str, what: str) -> None:
    assert answers(town.of(name), READABLE[what])


@pytest.mark.fault(
    "somebody with a certificate of sensors or ROS nodes asks, by name or wildcard", "nothing is answered"
)
@pytest.mark.parametrize("key", [*READABLE.values(), COMMAND])
@pytest.mark.parametrize("name", ["sensors", "ros"])
def test_sensors_and_nodes_read_nothing(town: Town, name: str, key: str) -> None:
    assert answers(town.of(name), key) == []


@pytest.mark.fault("wildcards, the admin space, and frames asked for with a certificate", "nothing is answered")
@pytest.mark.parametrize("key", NOT_READABLE)
@pytest.mark.parametrize("name", ["operator", "viewer", "sensors", "ros"])
def test_what_includes_more_than_is_allowed_is_not_answered(town: Town, name: str, key: str) -> None:
    assert answers(town.of(name), key) == []


def test_the_operator_commands(town: Town, door: ShippedRouter) -> None:
    speaker = CommandSender(door.authority.credentials("operator"), "vehicle")
    reported = send_authenticated(town.operator, f"{COMMAND}?format=json", None, PATIENCE_S, speaker, JSON)
    assert json.loads(reported.payload)["code"] == "held"


@pytest.mark.fault(
    "a command with the certificate of a viewer, a sensor or a node", "the router does not let it through"
)
@pytest.mark.parametrize("name", ["viewer", "sensors", "ros"])
def test_nobody_else_commands(town: Town, name: str) -> None:
    before = town.vehicle.commands
    assert answers(town.of(name), COMMAND) == []
    assert answers(town.of(name), "coec/@v1/*/*/command/*") == []
    assert town.vehicle.commands == before


@pytest.mark.fault("forged frames with the certificate of an operator or a viewer", "the vehicle gets none")
def test_frames_come_from_sensors_only(town: Town) -> None:
    town.frames.clear()
    for name in ("operator", "viewer"):
        town.of(name).put(FRAMES, name.encode())
        seen(town, name)
    publisher = town.sensors.declare_publisher(FRAMES)
    wait_until(lambda: bool(town.frames or publisher.put(b"true")), "a frame of the sensors")
    publisher.undeclare()
    assert set(town.frames) == {b"true"}


@pytest.mark.fault("somebody with the certificate of a viewer subscribes to frames", "no frame comes")
def test_frames_go_to_the_vehicle_only(town: Town) -> None:
    got: list[bytes] = []

    def receive(sample: zenoh.Sample) -> None:
        got.append(sample.payload.to_bytes())

    handler = zenoh.handlers.Callback(receive, indirect=False)
    subscribers = [town.of(name).declare_subscriber("sensors/**", handler) for name in ("viewer", "operator")]
    for name in ("viewer", "operator"):
        seen(town, name)
    town.frames.clear()
    wait_until(lambda: bool(town.frames or town.sensors.put(FRAMES, b"true")), "a frame of the sensors")
    for name in ("viewer", "operator"):
        seen(town, name)
    assert got == []
    for subscriber in subscribers:
        subscriber.undeclare()


@pytest.mark.fault("spoofed health, and a spoofed answer, with any certificate", "nobody sees either")
@pytest.mark.parametrize("name", ["operator", "viewer", "sensors", "ros"])
def test_nobody_speaks_for_the_vehicle(town: Town, name: str) -> None:
    asker = "viewer" if name == "operator" else "operator"
    received: list[bytes] = []

    def listen(sample: zenoh.Sample) -> None:
        received.append(sample.payload.to_bytes())

    def pretend(query: zenoh.Query) -> None:
        with query:
            query.reply(READABLE["health"], b"spoofed")

    subscriber = town.of(asker).declare_subscriber(READABLE["health"], zenoh.handlers.Callback(listen, indirect=False))
    spoof = town.of(name).declare_queryable(
        READABLE["health"], zenoh.handlers.Callback(pretend, indirect=False), complete=True
    )
    town.of(name).put(READABLE["health"], b"spoofed")
    seen(town, name)
    replies = town.of(asker).get(READABLE["health"], target=zenoh.QueryTarget.ALL, timeout=PATIENCE_S)
    reported = [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]
    assert len(reported) == 1
    assert b"spoofed" not in reported + received
    town.vehicle.bus.publish(READABLE["health"], town.vehicle.bench.answers.health("msgpack"))
    wait_until(lambda: bool(received), "the vehicle's own word")
    assert b"spoofed" not in received
    subscriber.undeclare()
    spoof.undeclare()


@pytest.mark.fault("spoofed liveliness tokens with any certificate", "nobody sees them")
@pytest.mark.parametrize("name", ["operator", "viewer", "sensors", "ros"])
def test_nobody_is_alive_for_the_vehicle(town: Town, name: str) -> None:
    tokens = [town.of(name).liveliness().declare_token(key) for key in (KEYS.alive("ghost"), "sensors/ghost")]
    seen(town, name)
    asker = town.viewer if name == "operator" else town.operator
    replies = list(asker.liveliness().get(KEYS.alive("*"), timeout=PATIENCE_S))
    assert [str(reply.ok.key_expr) for reply in replies if reply.ok is not None] == [KEYS.alive(PAIR)]
    assert is_alive(asker, KEYS, PATIENCE_S)
    for token in tokens:
        token.undeclare()


# --- topics of ROS -----------------------------------------------------------------------------------------------


@pytest.fixture
def driver(town: Town) -> Iterator[RosDriver]:
    """A node that publishes the vehicle's images."""
    made = RosDriver(town.ros, IMAGE_TOPIC, "CompressedImage", 10)
    yield made
    made.close()


def test_nodes_and_the_service_see_each_other(town: Town, driver: RosDriver) -> None:
    del driver
    wait_until(lambda: bool(town.side.topics().of(IMAGE_TOPIC)), "the service sees the driver")
    assert town.side.topics().of(IMAGE_TOPIC)[0].node == "/driver"

    def nodes_seen() -> set[str]:
        replies = list(town.ros.liveliness().get("@ros2_lv/0/**", timeout=PATIENCE_S))
        return {str(reply.ok.key_expr).split("/")[5] for reply in replies if reply.ok is not None}

    wait_until(lambda: nodes_seen() >= {"NN", "MS"}, "a node sees the service and its subscription")


@pytest.mark.fault("messages forged on a sensor's topic with any certificate but a node's", "the vehicle gets none")
def test_topics_come_from_nodes_only(town: Town, driver: RosDriver) -> None:
    town.images.clear()
    for name in ("operator", "viewer", "sensors"):
        town.of(name).put(str(driver.publisher.key_expr), name.encode())
        seen(town, name)
    wait_until(lambda: bool(town.images) or driver.sends(b"true"), "an image of the driver")
    assert set(town.images) == {b"true"}


@pytest.mark.fault("a topic subscribed to, or nodes listed, with another certificate than a node's", "nothing comes")
@pytest.mark.parametrize("name", ["operator", "viewer", "sensors"])
def test_topics_go_to_nodes_and_the_vehicle_only(town: Town, driver: RosDriver, name: str) -> None:
    got: list[str] = []

    def receive(sample: zenoh.Sample) -> None:
        got.append(str(sample.key_expr))

    handler = zenoh.handlers.Callback(receive, indirect=False)
    subscribers = [town.of(name).declare_subscriber(key, handler) for key in ("0/**", str(driver.publisher.key_expr))]
    list(town.of(name).get(KEYS.status, timeout=PATIENCE_S))
    town.images.clear()
    wait_until(lambda: bool(town.images) or driver.sends(b"true"), "an image of the driver")
    list(town.of(name).get(KEYS.status, timeout=PATIENCE_S))
    assert got == []
    assert list(town.of(name).liveliness().get("@ros2_lv/**", timeout=PATIENCE_S)) == []
    for subscriber in subscribers:
        subscriber.undeclare()


def test_who_comes_late_gets_the_static_transforms(town: Town) -> None:
    """Either way: of a node to the service, and of the service to a node."""
    key = "0/tf_static/tf2_msgs::msg::dds_::TFMessage_/TypeHashNotSupported"
    for speaker, listener in ((town.ros, town.vehicle_session), (town.vehicle_session, town.ros)):
        publisher = declare_advanced_publisher(
            speaker, key, publisher_detection=True, cache=CacheConfig(1), sample_miss_detection=CHECKED_FOR
        )
        publisher.put(b"transforms")
        got: list[bytes] = []

        def listen(sample: zenoh.Sample, got: list[bytes] = got) -> None:
            got.append(sample.payload.to_bytes())

        subscriber = declare_advanced_subscriber(
            listener,
            "0/tf_static/*/*",
            zenoh.handlers.Callback(listen, indirect=False),
            history=HistoryConfig(detect_late_publishers=True, max_samples=10),
            subscriber_detection=True,
        )
        wait_until(lambda got=got: got == [b"transforms"], "what was put before")  # type: ignore[misc]
        subscriber.undeclare()
        publisher.undeclare()


def test_the_service_speaks_to_ros_but_is_no_driver(town: Town, door: ShippedRouter) -> None:
    by_certificate = door.authority.session("vehicle", door.certified)
    got: list[str] = []

    def listen(sample: zenoh.Sample) -> None:
        got.append(str(sample.key_expr))

    subscriber = town.ros.declare_subscriber("0/**", zenoh.handlers.Callback(listen, indirect=False))
    forged = f"0{IMAGE_TOPIC}/{type_chunks('CompressedImage')}"
    with connected_by(RouterAddress((door.certified,), by_certificate), PATIENCE_S) as session:
        wait_until(lambda: bool(got or session.put("0/diagnostics/a/b", b"x")), "what the service says")
        session.put(forged, b"forged")
        session.put("0/coec/front/overlay/a/b", b"x")
        wait_until(lambda: any(key.startswith("0/coec/") for key in got), "what the service draws")
    assert forged not in got
    subscriber.undeclare()


@pytest.mark.fault("a session with a certificate that has expired, is foreign, or none", "it is not opened")
@pytest.mark.parametrize("kind", ["expired", "foreign", "none", "plain tcp"])
def test_who_shows_no_good_certificate_gets_no_session(door: ShippedRouter, tmp_path: Path, kind: str) -> None:
    file: Path | None = None
    endpoint = door.certified
    if kind == "expired":
        file = door.authority.session(door.authority.sign("operator", "expired-session", days=-1), endpoint)
    elif kind == "foreign":
        foreign = make_authority(tmp_path / "foreign")
        foreign.root.write_bytes(door.authority.root.read_bytes())
        file = foreign.session("operator", endpoint)
    elif kind == "none":
        file = tmp_path / "none.json5"
        tls = {"root_ca_certificate": str(door.authority.root)}
        file.write_text(json.dumps({"transport": {"link": {"tls": tls}}}))
    else:
        endpoint = f"tcp/127.0.0.1:{endpoint.rpartition(':')[2]}"
    with pytest.raises(ConnectionFailedError), connected_by(RouterAddress((endpoint,), file), REFUSED_S):
        pass


@pytest.mark.slow
@pytest.mark.fault("a certificate that expires while its session is open", "the session is closed")
def test_a_session_ends_with_its_certificate(
    authority: TestAuthority, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    with ExitStack() as stack:
        door = stack.enter_context(shipped_router(authority, tmp_path))
        brief = authority.sign_for("operator", "brief", seconds=BRIEF_S)
        began_s = time.monotonic()
        session = stack.enter_context(connected_by(door.connection(brief), PATIENCE_S))
        assert list(session.info.routers_zid())
        wait_until(lambda: not list(session.info.routers_zid()), "the end of the session")
        closed_s = time.monotonic() - began_s
        assert closed_s > BRIEF_S - 2
        record_property("figure", f"certificate of {BRIEF_S} s, closed after {closed_s:.1f} s")


@pytest.mark.fault(
    "a second daemon on another computer, through the shipped router with certificates", "it sees the first"
)
def test_a_second_daemon_on_another_computer_sees_the_first(authority: TestAuthority, tmp_path: Path) -> None:
    with ExitStack() as stack:
        door = stack.enter_context(shipped_router(authority, tmp_path))
        service = ZenohConfig(file=authority.session("vehicle", door.certified))
        here, there = (stack.enter_context(open_session(service, VEHICLE_LIMITS)) for _ in range(2))
        first, second = (SingletonGuard(session, service, VEHICLE_LIMITS, KEYS, 1) for session in (here, there))
        first.claim(threading.Event())
        with pytest.raises(UnavailableError, match="by another daemon"):
            second.claim(threading.Event())
        assert first.close(PATIENCE_S)
        assert second.close(PATIENCE_S)


@pytest.mark.fault("100 sockets opened on the router's loopback door that say nothing", "an operator gets in at once")
def test_sockets_that_say_nothing_keep_nobody_out(
    authority: TestAuthority, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    with ExitStack() as stack:
        door = stack.enter_context(shipped_router(authority, tmp_path))
        port = int(door.loopback.rpartition(":")[2])
        for _ in range(100):
            stack.enter_context(socket.create_connection(("127.0.0.1", port)))
        began_s = time.monotonic()
        with connected_by(door.connection("operator"), PATIENCE_S):
            record_property("figure", f"{time.monotonic() - began_s:.2f} s")
