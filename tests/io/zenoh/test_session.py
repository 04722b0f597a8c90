"""The service's session with the routers that vehicles have: whom it reaches, and what it does without one."""

from __future__ import annotations

import json
import socket
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path

import pytest
import zenoh

from coec.config import Config, LimitsConfig, ZenohConfig
from coec.io.ros.wire_format import Qos
from coec.io.zenoh.bus import MSGPACK, Answer, Bus, QueryLane, Route, is_connected, open_session
from coec.io.zenoh.query_client import connected
from coec.io.zenoh.ros_node import RosPublishers, RosSide
from coec.schemas.keys import TF_STATIC
from conftest import REPOSITORY
from support import ros
from support.fake_worker import wait_until
from support.ros import RosDriver
from support.router import free_port

LIMITS = LimitsConfig()
PATIENCE_S = 30.0
TOPIC = "/camera/image_raw/compressed"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
ROS = Config.model_validate(
    {
        "vehicle": "shuttle-7",
        "middleware": "rmw_zenoh",
        "pairs": [{"name": "front", "camera": TOPIC, "points": "/points"}],
    }
)

Opened = Callable[[str], AbstractContextManager[zenoh.Session]]


@contextmanager
def shipped(endpoint: str) -> Iterator[zenoh.Session]:
    """The router of deploy/router.json5, with its rules, at the door for programs of its own computer."""
    settings = zenoh.Config.from_file(REPOSITORY / "deploy" / "router.json5")
    settings.insert_json5("listen/endpoints", json.dumps([endpoint]))
    with zenoh.open(settings) as session:
        yield session


def embedded(endpoint: str) -> AbstractContextManager[zenoh.Session]:
    """The service as the router."""
    return open_session(ZenohConfig(embedded_router=True, listen=(endpoint,)), LIMITS)


@contextmanager
def plain(endpoint: str) -> Iterator[zenoh.Session]:
    """A router of Zenoh without any settings."""
    settings = zenoh.Config.from_json5(f'{{ mode: "router", listen: {{ endpoints: ["{endpoint}"] }} }}')
    settings.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(settings) as session:
        yield session


ROUTERS: dict[str, Opened] = {
    "rmw_zenoh's": ros.rmw_router,
    "shipped": shipped,
    "embedded": embedded,
    "plain": plain,
}


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.mark.fault(
    "nodes of rmw_zenoh with its default session file, behind its own router, the shipped one, or another",
    "the service and the nodes receive each other's messages, latched ones too, and see each other",
)
@pytest.mark.parametrize("kind", ROUTERS)
def test_default_nodes_and_the_service_reach_each_other(kind: str, endpoint: str) -> None:
    with ExitStack() as stack:
        stack.enter_context(ROUTERS[kind](endpoint))
        node = stack.enter_context(ros.rmw_node(endpoint))
        service = stack.enter_context(open_session(ZenohConfig(connect=(endpoint,)), LIMITS))
        side = RosSide(service, ROS)
        stack.callback(side.close)
        bus = Bus(service)
        images: list[bytes] = []
        bus.subscribe(side.input_of(ROS.awaited[0].camera), lambda sample: images.append(sample.payload))
        driver = RosDriver(node, TOPIC, "CompressedImage", 1)
        stack.callback(driver.close)
        wait_until(lambda: bool(images) or driver.sends(b"frame"), "the service gets the node's images", PATIENCE_S)
        wait_until(lambda: bool(side.topics().of(TOPIC)), "the service sees the publisher", PATIENCE_S)

        assert side.node is not None
        publishers = RosPublishers(service, side.node)
        stack.callback(publishers.close)
        publishers.publisher(TF_STATIC, TRANSFORMS, Qos(depth=1, transient_local=True)).put(b"latched", 1)
        diagnostics = publishers.publisher("/diagnostics", DIAGNOSTICS, Qos(depth=1))
        got: list[bytes] = []

        def take(sample: zenoh.Sample) -> None:
            got.append(sample.payload.to_bytes())

        node.declare_subscriber("0/diagnostics/*/*", zenoh.handlers.Callback(take, indirect=False))
        late: list[bytes] = []
        Bus(node).subscribe_latched(side.input_of_static_transforms(), lambda sample: late.append(sample.payload))

        def received() -> bool:
            diagnostics.put(b"levels", 1)
            return bool(got)

        wait_until(received, "the node gets /diagnostics", PATIENCE_S)
        wait_until(lambda: b"latched" in late, "the node gets what was published before it subscribed", PATIENCE_S)
        bus.undeclare_inputs()


@pytest.mark.parametrize("kind", ROUTERS)
def test_default_nodes_reach_each_other(kind: str, endpoint: str) -> None:
    with ExitStack() as stack:
        stack.enter_context(ROUTERS[kind](endpoint))
        one, other = (stack.enter_context(ros.rmw_node(endpoint)) for _ in range(2))
        got: list[bytes] = []

        def take(sample: zenoh.Sample) -> None:
            got.append(sample.payload.to_bytes())

        one.declare_subscriber(f"0{TOPIC}/*/*", zenoh.handlers.Callback(take, indirect=False))
        driver = RosDriver(other, TOPIC, "CompressedImage", 1)
        wait_until(lambda: bool(got) or driver.sends(b"frame"), "one node gets what the other sends", PATIENCE_S)
        driver.close()


@pytest.mark.fault(
    "no router at the start, one that restarts, and one that moves to the second endpoint",
    "samples, queries and tokens are there again each time, without a new declaration",
)
def test_a_session_waits_for_its_router_and_finds_it_again(endpoint: str) -> None:
    second = f"tcp/127.0.0.1:{free_port()}"
    with open_session(ZenohConfig(connect=(endpoint, second)), LIMITS) as service:
        assert not is_connected(service)
        bus = Bus(service)
        samples: list[bytes] = []
        bus.subscribe(RosSide(service, ROS).input_of(ROS.awaited[0].camera), lambda one: samples.append(one.payload))
        bus.declare_alive("test/alive")
        bus.serve(
            "test/value", lambda _: [Route("test/value", lambda __: Answer(b"value", MSGPACK), QueryLane.AT_ONCE)]
        )
        bus.publish("test/lost", Answer(b"", MSGPACK))  # to nobody, and at once
        for at in (endpoint, endpoint, second):
            with ros.rmw_router(at), connected((at,), PATIENCE_S) as client:
                driver = RosDriver(client, TOPIC, "CompressedImage", 1)
                wait_until(lambda: bool(list(client.get("test/value", timeout=1.0))), "the answer", PATIENCE_S)
                wait_until(lambda: bool(list(client.liveliness().get("test/alive"))), "the token", PATIENCE_S)
                wait_until(partial(_arrives, samples, driver), "the samples", PATIENCE_S)
                driver.close()
            samples.clear()
            wait_until(lambda: not is_connected(service), "the router is gone", PATIENCE_S)
        bus.undeclare_inputs()
        bus.undeclare_queryables()


def _arrives(samples: list[bytes], driver: RosDriver) -> bool:
    return bool(samples) or driver.sends(b"frame")


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"mode": "client", "connect": {"timeout_ms": -1, "exit_on_failure": False}},
        {"transport": {"link": {"protocols": ["tcp"]}}},
        {"transport": {"auth": {"usrpwd": {"user": "vehicle", "password": "secret"}}}},
        {"transport": {"unicast": {"lowlatency": True, "qos": {"enabled": False}}}},
    ],
    ids=["nothing", "a client that waits", "protocols", "a password", "low latency"],
)
def test_whatever_a_file_sets_the_session_opens_without_a_router_and_connects_to_it(
    more: dict[str, object], endpoint: str, tmp_path: Path
) -> None:
    file, names, rules = tmp_path / "session.json5", tmp_path / "names", tmp_path / "router.json5"
    file.write_text(json.dumps(more))
    names.write_text("vehicle:secret\n")
    requests = (
        {"transport": {"auth": {"usrpwd": {"dictionary_file": str(names)}}}} if "auth" in file.read_text() else {}
    )
    rules.write_text(json.dumps({"mode": "router", "listen": {"endpoints": [endpoint]}} | requests))
    with open_session(ZenohConfig(file=file, connect=(endpoint,)), LIMITS) as service:
        assert not is_connected(service)
        with open_session(ZenohConfig(file=rules), LIMITS) as router:
            wait_until(lambda: list(service.info.routers_zid()) == [router.info.zid()], "the router", PATIENCE_S)


@pytest.mark.fault(
    "the first endpoint refuses, or accepts a connection and is silent", "a client reaches the second one"
)
def test_an_endpoint_that_does_not_answer_takes_no_time_from_the_next(endpoint: str) -> None:
    refusing = f"tcp/127.0.0.1:{free_port()}"
    with closing(socket.create_server(("127.0.0.1", 0))) as silent, embedded(endpoint):
        for first in (refusing, f"tcp/127.0.0.1:{silent.getsockname()[1]}"):
            with connected((first, endpoint), 2.0) as session:
                assert list(session.info.routers_zid())


def test_nobody_can_stand_in_for_the_router_that_a_session_began_with(
    endpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with open_session(ZenohConfig(connect=(endpoint,)), LIMITS):
        assert list(tmp_path.iterdir()) == []


def test_a_file_that_listens_or_gossips_without_a_mode_is_a_peers(tmp_path: Path) -> None:
    port, other = free_port(), free_port()
    listens = tmp_path / "listens.json5"
    listens.write_text(f'{{ listen: {{ endpoints: ["tcp/127.0.0.1:{port}"] }} }}')
    connects = ZenohConfig(connect=(f"tcp/127.0.0.1:{port}", f"tcp/127.0.0.1:{other}"))
    with open_session(ZenohConfig(file=listens, connect=()), LIMITS) as peer, open_session(connects, LIMITS) as client:
        got: list[zenoh.Sample] = []
        peer.declare_subscriber("test", got.append)

        def received() -> bool:
            client.put("test", b"")
            return bool(got)

        wait_until(received, "two sessions without a router", PATIENCE_S)
