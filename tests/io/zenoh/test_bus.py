"""The bus against an embedded router on a free loopback port, with a client session of its own."""

from __future__ import annotations

import json
import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any

import msgpack
import psutil
import pytest
import zenoh

from coec.config import LimitsConfig, ZenohConfig
from coec.errors import NotFoundError, UnavailableError
from coec.io.zenoh.bus import (
    JSON,
    MSGPACK,
    WAITING,
    Answer,
    Bus,
    InputSample,
    QueryLane,
    Request,
    Route,
    on_key,
    open_session,
)
from support.fake_worker import wait_until
from support.router import Relay, free_port

DEADLINE_S = 20.0


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def bus(endpoint: str) -> Iterator[Bus]:
    session = open_session(ZenohConfig(embedded_router=True, listen=(endpoint,)), LimitsConfig())
    bus = Bus(session)
    for thread in bus.threads:
        thread.start()
    yield bus
    bus.undeclare_inputs()
    for thread in bus.threads:
        thread.request_stop()
    assert all(thread.join(DEADLINE_S) for thread in bus.threads)
    bus.undeclare_queryables()
    assert bus.close(DEADLINE_S)


@pytest.fixture
def client(endpoint: str, bus: Bus) -> Iterator[zenoh.Session]:
    del bus  # the router has to be there first
    with open_session(ZenohConfig(connect=(endpoint,)), LimitsConfig()) as session:
        yield session


def query(client: zenoh.Session, selector: str, payload: bytes | None = None) -> list[zenoh.Reply]:
    return list(client.get(selector, payload=payload, timeout=DEADLINE_S))


def query_ok(client: zenoh.Session, selector: str) -> zenoh.Sample:
    """The one good reply; asks again until the queryable is known to the client."""
    for _ in range(1000):
        replies = query(client, selector)
        if replies:
            break
    (reply,) = replies
    assert reply.ok is not None
    return reply.ok


def query_error(client: zenoh.Session, selector: str, payload: bytes | None = None) -> zenoh.ReplyError:
    (reply,) = query(client, selector, payload)
    assert reply.err is not None
    return reply.err


def serve_value(bus: Bus, key: str, value: bytes) -> None:
    route = Route(key, lambda _: Answer(value, MSGPACK), QueryLane.AT_ONCE)
    bus.serve(key, lambda _: [route])


def test_a_query_is_answered_with_encoding_and_timestamp(bus: Bus, client: zenoh.Session) -> None:
    serve_value(bus, "test/value", b"\x01")
    sample = query_ok(client, "test/value")
    assert sample.payload.to_bytes() == b"\x01"
    assert str(sample.encoding) == MSGPACK
    assert sample.timestamp is not None


def test_errors_are_replies_in_the_format_requested(bus: Bus, client: zenoh.Session) -> None:
    def find(key: str) -> Sequence[Route]:
        if key.endswith("good"):
            return [Route(key, lambda _: Answer(b"", MSGPACK), QueryLane.AT_ONCE)]
        if key.endswith("fault"):
            return [Route(key, fail, QueryLane.AT_ONCE)]
        raise NotFoundError("no such thing")

    def fail(_: Request) -> Answer:
        raise ZeroDivisionError("secret")

    bus.serve("test/**", find)
    query_ok(client, "test/good")
    plain = query_error(client, "test/none")
    assert str(plain.encoding) == MSGPACK
    assert msgpack.unpackb(plain.payload.to_bytes())["code"] == "not_found"
    as_json = query_error(client, "test/none?format=json")
    assert str(as_json.encoding) == JSON
    assert json.loads(as_json.payload.to_bytes())["message"] == "no such thing"
    fault = query_error(client, "test/fault?format=json").payload.to_bytes()
    assert json.loads(fault)["code"] == "internal"
    assert b"secret" not in fault
    too_long = query_error(client, "test/good", bytes(100_000)).payload.to_bytes()
    assert msgpack.unpackb(too_long)["code"] == "bad_request"


@pytest.mark.fault("more slow queries than are answered at once", "quick ones do not wait; surplus ones get an error")
def test_quick_answers_do_not_wait_for_slow_ones_and_too_many_are_reported_so(bus: Bus, client: zenoh.Session) -> None:
    entered, release = threading.Event(), threading.Event()

    def slow(request: Request) -> Answer:
        entered.set()
        assert release.wait(DEADLINE_S)
        return Answer(request.parameters.encode(), MSGPACK)

    serve_value(bus, "test/quick", b"q")
    bus.serve("test/slow", lambda key: [Route(key, slow, QueryLane.FILES)])
    query_ok(client, "test/quick")
    replies: queue.SimpleQueue[zenoh.Reply] = queue.SimpleQueue()
    client.get("test/slow?n=0", replies.put, timeout=DEADLINE_S)
    assert entered.wait(DEADLINE_S)
    for number in range(1, WAITING[QueryLane.FILES] + 2):
        client.get(f"test/slow?n={number}", replies.put, timeout=DEADLINE_S)
    refused = replies.get(timeout=DEADLINE_S)
    assert refused.err is not None
    assert msgpack.unpackb(refused.err.payload.to_bytes())["code"] == "busy"
    assert query_ok(client, "test/quick").payload.to_bytes() == b"q"
    release.set()
    for _ in range(WAITING[QueryLane.FILES] + 1):
        assert replies.get(timeout=DEADLINE_S).ok is not None


READERS = 3
PUBLISHED = 100
LARGE = bytes(2**18)
"""Of which 25 MB are published: more than the sockets of three readers hold."""

SOON_S = 5.0
"""7.7 s were seen where the sender waited for the readers."""


def _note(received: queue.SimpleQueue[int], number: int, _: zenoh.Sample) -> None:
    received.put(number)


@pytest.mark.fault(
    "three subscribers that stopped reading", "publishing does not wait for them, and queries are answered"
)
def test_subscribers_that_stopped_reading_hold_nobody_up(
    bus: Bus, client: zenoh.Session, endpoint: str, record_property: Callable[[str, object], None]
) -> None:
    serve_value(bus, "test/quick", b"q")
    query_ok(client, "test/quick")
    received: queue.SimpleQueue[int] = queue.SimpleQueue()
    with ExitStack() as opened:
        relays = [opened.enter_context(Relay(int(endpoint.rpartition(":")[2]))) for _ in range(READERS)]
        for number, relay in enumerate(relays):
            config = ZenohConfig(connect=(f"tcp/127.0.0.1:{relay.port}",))
            session = opened.enter_context(open_session(config, LimitsConfig()))
            session.declare_subscriber("test/out", partial(_note, received, number))
        reached: set[int] = set()

        def all_receive() -> bool:
            bus.publish("test/out", Answer(b"", MSGPACK))
            with suppress(queue.Empty):
                reached.add(received.get(timeout=0.05))
            return len(reached) == READERS

        wait_until(all_receive, "all subscriptions are known")
        for relay in relays:
            relay.stop_reading()
        answered_s = published_s = 0.0
        for _ in range(PUBLISHED):
            began_s = time.monotonic()
            bus.publish("test/out", Answer(LARGE, MSGPACK))
            published_s = max(published_s, time.monotonic() - began_s)
            began_s = time.monotonic()
            assert query_ok(client, "test/quick").payload.to_bytes() == b"q"
            answered_s = max(answered_s, time.monotonic() - began_s)
    record_property("figure", f"put {published_s * 1e3:.0f} ms, answer {answered_s * 1e3:.0f} ms at most")
    assert max(answered_s, published_s) < SOON_S


@pytest.mark.fault("the service ends while queries wait", "each gets an answer")
def test_queries_that_wait_at_the_end_are_finished(bus: Bus, client: zenoh.Session) -> None:
    for thread in bus.threads:
        thread.request_stop()
        assert thread.join(DEADLINE_S)
    serve_value(bus, "test/quick", b"q")
    bus.serve("test/slow", lambda key: [Route(key, lambda _: Answer(b"", MSGPACK), QueryLane.FILES)])
    query_ok(client, "test/quick")
    replies: queue.SimpleQueue[zenoh.Reply] = queue.SimpleQueue()
    client.get("test/slow", replies.put, timeout=DEADLINE_S)
    query_ok(client, "test/quick")  # one link, one order: the slow query has arrived
    bus.undeclare_queryables()
    error = replies.get(timeout=DEADLINE_S).err
    assert error is not None
    assert msgpack.unpackb(error.payload.to_bytes())["code"] == "stopping"


@pytest.mark.fault("a reader of samples that fails", "the samples behind it are read")
def test_samples_arrive_with_their_encoding_and_a_failing_reader_does_no_harm(bus: Bus, client: zenoh.Session) -> None:
    got: queue.SimpleQueue[tuple[bytes, str]] = queue.SimpleQueue()

    def receive(sample: InputSample) -> None:
        if sample.payload == b"bad":
            raise ValueError
        got.put((sample.payload, sample.encoding))

    bus.subscribe(on_key("test/in"), receive)
    publisher: Any = client.declare_publisher("test/in")
    wait_until(lambda: publisher.matching_status.matching, "the subscription is known to the publisher")
    publisher.put(b"bad")
    publisher.put(b"one", encoding="application/cdr;sensor_msgs/msg/Image")
    publisher.delete()
    publisher.put(b"two")
    assert got.get(timeout=DEADLINE_S) == (b"one", "application/cdr;sensor_msgs/msg/Image")
    assert got.get(timeout=DEADLINE_S) == (b"two", "zenoh/bytes")


def test_a_published_value_and_the_liveliness_token_are_seen(bus: Bus, client: zenoh.Session) -> None:
    alive: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    watcher = client.liveliness().declare_subscriber("test/alive", alive.put, history=True)
    bus.declare_alive("test/alive")
    assert alive.get(timeout=DEADLINE_S).kind == zenoh.SampleKind.PUT
    bus.undeclare_inputs()
    assert alive.get(timeout=DEADLINE_S).kind == zenoh.SampleKind.DELETE
    watcher.undeclare()


@pytest.mark.fault("the port is taken at the start", "a clear error")
def test_a_port_in_use_is_a_clear_error(bus: Bus, endpoint: str) -> None:
    del bus
    with pytest.raises(UnavailableError, match="cannot open the Zenoh session"):
        open_session(ZenohConfig(embedded_router=True, listen=(endpoint,)), LimitsConfig())


@pytest.mark.fault("no router at the start", "the service starts and waits for it")
def test_no_router_is_no_error(endpoint: str) -> None:
    open_session(ZenohConfig(connect=(endpoint,)), LimitsConfig()).close()


@pytest.mark.fault("a Zenoh file with `mode: peer` and no `listen`", "nobody is listened to")
@pytest.mark.parametrize("reported", ['mode: "peer",', 'mode: "client",', ""])
def test_a_file_that_names_no_door_opens_none(endpoint: str, bus: Bus, tmp_path: Path, reported: str) -> None:
    del bus  # a client wants a router
    file = tmp_path / "zenoh.json5"
    file.write_text(f'{{ {reported} connect: {{ endpoints: ["{endpoint}"] }} }}')
    before = listening()
    with open_session(ZenohConfig(file=file), LimitsConfig()):
        assert listening() == before


def test_a_door_that_a_file_names_is_opened(tmp_path: Path) -> None:
    port = free_port()
    file = tmp_path / "zenoh.json5"
    file.write_text(f'{{ mode: "peer", listen: {{ endpoints: ["tcp/127.0.0.1:{port}"] }} }}')
    with open_session(ZenohConfig(file=file), LimitsConfig()):
        assert ("127.0.0.1", port) in listening()


def listening() -> set[tuple[str, int]]:
    """Addresses and ports at which this process waits for others, of either protocol."""
    sockets = psutil.Process().net_connections("inet")
    return {tuple(one.laddr) for one in sockets if one.laddr and one.status in (psutil.CONN_LISTEN, psutil.CONN_NONE)}


def test_the_attachment_of_a_query_is_handed_on(bus: Bus, client: zenoh.Session) -> None:
    seen: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()

    def answer(request: Request) -> Answer:
        seen.put(request.attachment)
        return Answer(b"", MSGPACK)

    bus.serve("test/who", lambda _: [Route("test/who", answer, QueryLane.FILES)])
    query_ok(client, "test/who")
    assert seen.get(timeout=DEADLINE_S) is None
    list(client.get("test/who", attachment=b"me", timeout=DEADLINE_S))
    assert seen.get(timeout=DEADLINE_S) == b"me"


@pytest.mark.fault("a picture that takes long to draw", "no other query waits for it")
def test_a_picture_that_takes_long_keeps_no_other_query_waiting(bus: Bus, client: zenoh.Session) -> None:
    rendered = threading.Event()

    def render(_: Request) -> Answer:
        rendered.wait(DEADLINE_S)
        return Answer(b"jpeg", "image/jpeg")

    bus.serve("test/overlay", lambda _: [Route("test/overlay", render, QueryLane.DRAWING)])
    bus.serve("test/list", lambda _: [Route("test/list", lambda _: Answer(b"list", MSGPACK), QueryLane.FILES)])
    assert query_ok(client, "test/list").payload.to_bytes() == b"list"
    waiting = client.get("test/overlay", timeout=DEADLINE_S)
    assert query_ok(client, "test/list").payload.to_bytes() == b"list"
    rendered.set()
    (reply,) = waiting
    assert reply.ok is not None
    assert reply.ok.payload.to_bytes() == b"jpeg"


@pytest.mark.fault("files are read without an end in sight", "a command is answered all the same")
def test_a_file_that_takes_long_keeps_no_command_waiting(
    bus: Bus, client: zenoh.Session, record_property: Callable[[str, object], None]
) -> None:
    entered, read = threading.Event(), threading.Event()

    def reading(_: Request) -> Answer:
        entered.set()
        assert read.wait(DEADLINE_S)
        return Answer(b"window", MSGPACK)

    bus.serve("test/window", lambda _: [Route("test/window", reading, QueryLane.FILES)])
    bus.serve("test/hold", lambda _: [Route("test/hold", lambda _: Answer(b"held", MSGPACK), QueryLane.COMMANDS)])
    assert query_ok(client, "test/hold").payload.to_bytes() == b"held"
    waiting = client.get("test/window", timeout=DEADLINE_S)
    assert entered.wait(DEADLINE_S)
    began_s = time.monotonic()
    assert query_ok(client, "test/hold").payload.to_bytes() == b"held"
    record_property("figure", f"{(time.monotonic() - began_s) * 1e3:.1f} ms")
    read.set()
    (reply,) = waiting
    assert reply.ok is not None


def test_when_a_query_arrived_is_known_however_long_it_waited(bus: Bus, client: zenoh.Session) -> None:
    arrived: list[float] = []
    entered, release = threading.Event(), threading.Event()

    def slow(request: Request) -> Answer:
        arrived.append(request.received_s)
        entered.set()
        assert release.wait(DEADLINE_S)
        return Answer(b"", MSGPACK)

    serve_value(bus, "test/quick", b"q")
    bus.serve("test/slow", lambda key: [Route(key, slow, QueryLane.FILES)])
    query_ok(client, "test/quick")
    replies: queue.SimpleQueue[zenoh.Reply] = queue.SimpleQueue()
    client.get("test/slow", replies.put, timeout=DEADLINE_S)
    assert entered.wait(DEADLINE_S)
    client.get("test/slow", replies.put, timeout=DEADLINE_S)
    query_ok(client, "test/quick")  # one link, one order: the second has arrived
    arrived_s = time.monotonic()
    release.set()
    for _ in range(2):
        assert replies.get(timeout=DEADLINE_S).ok is not None
    assert arrived[0] <= arrived[1] <= arrived_s
