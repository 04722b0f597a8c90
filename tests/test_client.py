"""`coec.client`: a program asks a vehicle that answers on a real session."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator, Callable, Iterator
from pathlib import Path
from typing import cast

import pytest
import zenoh

import coec
from coec import client
from coec.client import MAX_QUEUED_CHANGES, PairUpdate, Vehicle
from coec.config import LimitsConfig, ZenohConfig
from coec.errors import ConnectionFailedError, DecodeError, NotFoundError, RemoteError, UsageError
from coec.io.zenoh.bus import MSGPACK, Answer, Bus, QueryLane, Request, Route, open_session
from coec.io.zenoh.query_client import OF_ONE_KEY
from coec.schemas.keys import Keys
from coec.schemas.message import to_msgpack
from coec.schemas.replies import HealthReply
from e2e.processes import Router
from support.fake_worker import wait_until
from support.router import free_port
from support.vehicles import KEYS, PAIR, VEHICLE, serving

PATIENCE_S = 20.0
"""Nothing that comes about waits so long."""


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The router of a vehicle with one pair."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with serving(tmp_path_factory.mktemp("vehicle"), ZenohConfig(embedded_router=True, listen=(endpoint,))):
        yield endpoint


@pytest.fixture
def bus(endpoint: str) -> Iterator[Bus]:
    """What else may be said in the name of the vehicle."""
    bus = Bus(open_session(ZenohConfig(connect=(endpoint,)), LimitsConfig()))
    yield bus
    assert bus.close(PATIENCE_S)


@pytest.mark.fault("a program that answers with more replies than a service", "an error of coec that names the bound")
def test_a_flood_of_replies_is_an_error(router: Router) -> None:
    keys, bound = Keys("coec", "flooded"), OF_ONE_KEY.replies

    def flood(query: zenoh.Query) -> None:
        with query:
            for _ in range(bound + 1):
                query.reply(keys.health("a"), b"")

    async def requested() -> None:
        async with Vehicle("flooded", connect=router.endpoint, timeout_s=PATIENCE_S) as vehicle:
            with pytest.raises(RemoteError, match=f"more than {bound} replies"):
                await vehicle.health("a")

    queryable = router.session.declare_queryable(keys.health("a"), flood)
    asyncio.run(requested())
    queryable.undeclare()


@pytest.fixture
def answering(router: Router) -> Iterator[Callable[[str, Callable[[Request], Answer]], Vehicle]]:
    """Serves one key of a vehicle called `odd`, and gives the client that may ask it."""
    bus = Bus(open_session(ZenohConfig(connect=(router.endpoint,)), LimitsConfig()))

    def serve(key: str, answer: Callable[[Request], Answer]) -> Vehicle:
        bus.serve(key, lambda requested: [Route(requested, answer, QueryLane.AT_ONCE)])
        return Vehicle("odd", connect=router.endpoint, timeout_s=PATIENCE_S)

    yield serve
    bus.undeclare_queryables()
    assert bus.close(PATIENCE_S)


async def until(changes: AsyncGenerator[PairUpdate], expected: Callable[[PairUpdate], bool]) -> list[PairUpdate]:
    """All changes to the first that is wanted."""
    seen = []
    async with asyncio.timeout(PATIENCE_S):
        async for change in changes:
            seen.append(change)
            if expected(change):
                break
    return seen


def test_answers_are_the_models_of_the_contract(endpoint: str) -> None:
    async def requested() -> None:
        async with Vehicle(VEHICLE, connect=endpoint, timeout_s=PATIENCE_S) as vehicle:
            assert await vehicle.pairs() == (PAIR,)
            extrinsic, health, windows, history = await asyncio.gather(
                vehicle.extrinsic(), vehicle.health(PAIR), vehicle.windows(), vehicle.history(limit=3)
            )
            assert (extrinsic.pair, extrinsic.provenance, extrinsic.status) == (PAIR, "nominal", "not_accepted")
            assert health.state == "unknown"
            assert windows.windows == ()
            assert history.results == ()

    asyncio.run(requested())


def test_a_command_is_acknowledged_with_its_arguments(endpoint: str) -> None:
    async def requested() -> None:
        async with Vehicle(VEHICLE, connect=endpoint, timeout_s=PATIENCE_S) as vehicle:
            held = await vehicle.command("hold", payload={"release": False})
            assert (held.command, held.accepted) == ("hold", True)
            assert (await vehicle.extrinsic()).held
            freed = await vehicle.command("hold", PAIR, {"release": True})
            assert freed.accepted
            refused = await vehicle.command("apply")
            assert not refused.accepted
            assert refused.text

    asyncio.run(requested())


@pytest.mark.fault(
    "a program asks for something that does not exist", "the service's code and words, as an error of coec"
)
def test_an_error_reply_is_an_error_with_its_code(endpoint: str) -> None:
    async def requested() -> None:
        async with Vehicle(VEHICLE, connect=endpoint, timeout_s=PATIENCE_S) as vehicle:
            with pytest.raises(RemoteError) as refused:
                await vehicle.command("hold", payload={"release": "perhaps"})
            assert refused.value.reply_code == "bad_request"
            with pytest.raises(coec.RemoteError) as absent:
                await vehicle.extrinsic("rear")
            assert absent.value.reply_code == "bad_request"
            for payload in ({"release": float("nan")}, {"release": object()}):
                with pytest.raises(UsageError, match="payload of hold"):
                    await vehicle.command("hold", payload=payload)
            with pytest.raises(UsageError, match="known are calibrate"):
                await vehicle.command("explode")  # type: ignore[arg-type]
            for name in ("*", "a//b", "rear?limit=1"):
                with pytest.raises(UsageError):
                    await vehicle.health(name)
                with pytest.raises(UsageError):
                    await anext(vehicle.changes(name))

    asyncio.run(requested())


@pytest.mark.fault("a program asks for a vehicle that is not there", "an error that says what to check")
def test_a_vehicle_that_is_not_there(router: Router) -> None:
    async def requested() -> None:
        async with Vehicle("nobody", connect=router.endpoint, timeout_s=PATIENCE_S) as vehicle:
            with pytest.raises(NotFoundError, match="coec run"):
                await vehicle.extrinsic()
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(0.2):
                    await anext(vehicle.changes())

    asyncio.run(requested())


def test_without_a_router_it_says_so() -> None:
    async def requested() -> None:
        async with Vehicle(VEHICLE, connect=f"tcp/127.0.0.1:{free_port()}", timeout_s=0.3):
            pytest.fail("there is no router")

    with pytest.raises(ConnectionFailedError, match="no Zenoh router"):
        asyncio.run(requested())


def test_what_is_requested_beyond_the_connection_is_refused(endpoint: str) -> None:
    async def requested() -> None:
        vehicle = Vehicle(VEHICLE, connect=endpoint, timeout_s=PATIENCE_S)
        with pytest.raises(UsageError, match="async with"):
            await vehicle.extrinsic(PAIR)
        async with vehicle:
            with pytest.raises(UsageError, match="already connected"):
                await vehicle.__aenter__()
        with pytest.raises(UsageError, match="async with"):
            await vehicle.extrinsic(PAIR)
        async with vehicle:
            await vehicle.extrinsic(PAIR)

    asyncio.run(requested())


@pytest.mark.parametrize("made", [{"name": "*"}, {"name": ""}, {"name": "a", "prefix": "/b"}])
def test_a_name_that_makes_no_key_is_refused(made: dict[str, str]) -> None:
    with pytest.raises(UsageError):
        Vehicle(**made)  # type: ignore[arg-type]


@pytest.mark.parametrize("timeout_s", [0.0, -1.0, float("nan"), float("inf")])
def test_a_time_that_is_none_is_refused(timeout_s: float) -> None:
    with pytest.raises(UsageError, match="timeout_s"):
        Vehicle(VEHICLE, timeout_s=timeout_s)


@pytest.mark.fault("a service answers a program with rubbish", "a decode error, never a traceback of a library")
def test_rubbish_is_a_decode_error(answering: Callable[[str, Callable[[Request], Answer]], Vehicle]) -> None:
    odd = answering(Keys("coec", "odd").health("a"), lambda _: Answer(b"\xc1\x00", MSGPACK))

    async def requested() -> None:
        async with odd as vehicle:
            with pytest.raises(DecodeError):
                await vehicle.health("a")

    asyncio.run(requested())


@pytest.mark.fault("a service does not answer a program", "the error `timeout` after the time that it gave")
def test_a_question_has_a_deadline_and_can_be_given_up(router: Router) -> None:
    unfinished: list[zenoh.Query] = []
    connection = ZenohConfig(connect=(router.endpoint,))
    with open_session(connection, LimitsConfig()) as session, open_session(connection, LimitsConfig()) as other:
        key = Keys("coec", "mute").extrinsic("a")
        queryable = session.declare_queryable(key, unfinished.append, complete=True)
        querier = other.declare_querier(key)
        wait_until(
            lambda: cast("zenoh.MatchingStatus", querier.matching_status).matching, "the router knows the queryable"
        )

        async def requested() -> None:
            async with Vehicle("mute", connect=router.endpoint, timeout_s=PATIENCE_S) as vehicle:
                with pytest.raises(RemoteError) as late:
                    await vehicle.extrinsic("a", timeout_s=0.2)
                assert late.value.reply_code == "timeout"
                question = asyncio.create_task(vehicle.extrinsic("a"))
                await asyncio.sleep(0)
                began_s = time.monotonic()
                question.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await question
                assert time.monotonic() - began_s < PATIENCE_S / 2

        asyncio.run(requested())
        queryable.undeclare()
        unfinished.clear()


def test_changes_begin_with_what_is_so_now_and_go_on(endpoint: str, bus: Bus) -> None:
    async def requested() -> None:
        async with Vehicle(VEHICLE, connect=endpoint, timeout_s=PATIENCE_S) as vehicle:
            changes = vehicle.changes()
            await until(changes, _all_reported())
            await changes.aclose()
            again = vehicle.changes(PAIR)
            await anext(again)
            held = (await vehicle.extrinsic()).model_copy(update={"held": True})
            bus.publish(KEYS.extrinsic(PAIR), Answer(to_msgpack(held), MSGPACK))
            seen = await until(again, lambda change: change.value == held)
            assert {change.pair for change in seen} == {PAIR}
            assert all(change.lost == 0 for change in seen)
            await again.aclose()

    asyncio.run(requested())


@pytest.mark.fault(
    "a service ends while a program listens", "the program is told, its loop goes on, and it hears the next service"
)
def test_a_service_that_ends_is_reported_and_received_again(router: Router, tmp_path: Path) -> None:
    config = ZenohConfig(connect=(router.endpoint,))

    def alive(value: bool) -> Callable[[PairUpdate], bool]:
        return lambda change: change.kind == "alive" and change.value is value

    async def requested() -> None:
        loop = asyncio.get_running_loop()
        async with Vehicle(VEHICLE, connect=router.endpoint, timeout_s=PATIENCE_S) as vehicle:
            received: asyncio.Queue[PairUpdate] = asyncio.Queue()

            async def listen() -> None:
                async for change in vehicle.changes():
                    received.put_nowait(change)

            async def wait_for(expected: Callable[[PairUpdate], bool]) -> None:
                async with asyncio.timeout(PATIENCE_S):
                    while not expected(await received.get()):
                        pass

            listener = asyncio.create_task(listen())
            for name in ("first", "second"):
                service = serving(tmp_path / name, config)
                await loop.run_in_executor(None, service.__enter__)
                reported: set[str] = set()
                while reported != {"alive", "health", "extrinsic"}:  # in whatever order
                    async with asyncio.timeout(PATIENCE_S):
                        reported.add((await received.get()).kind)
                await loop.run_in_executor(None, service.__exit__, None, None, None)
                await wait_for(alive(False))
            assert not listener.done()
        async with asyncio.timeout(PATIENCE_S):
            await listener  # the vehicle was disconnected: the loop over it has ended

    asyncio.run(requested())


@pytest.mark.fault(
    "a program takes changes slower than they come", "the oldest are dropped and counted; the newest is there"
)
def test_a_slow_listener_loses_the_oldest_and_is_reported(
    endpoint: str, bus: Bus, monkeypatch: pytest.MonkeyPatch, record_property: Callable[[str, object], None]
) -> None:
    waiting, message = 4, 20
    monkeypatch.setattr(client, "MAX_QUEUED_CHANGES", waiting)

    async def requested() -> list[PairUpdate]:
        async with Vehicle(VEHICLE, connect=endpoint, timeout_s=PATIENCE_S) as vehicle:
            health = await vehicle.health()
            slow, prompt = vehicle.changes(), vehicle.changes()
            for changes in (slow, prompt):
                await until(changes, _all_reported())
            for since_ns in range(1, message + 1):
                change = health.model_copy(update={"since_ns": since_ns})
                bus.publish(KEYS.health(PAIR), Answer(to_msgpack(change), MSGPACK))
                await until(prompt, _says(since_ns))
            seen = await until(slow, _says(message))
            await slow.aclose()
            await prompt.aclose()
            return seen

    seen = asyncio.run(requested())
    reported = [change.value.since_ns for change in seen if isinstance(change.value, HealthReply)]
    assert message - waiting <= reported[0]  # the last may have come when the first of those that waited was taken
    assert reported == list(range(reported[0], message + 1))
    assert [change.lost for change in seen] == [reported[0] - 1, *[0] * (len(reported) - 1)]
    record_property("figure", f"{MAX_QUEUED_CHANGES} wait")


def _all_reported() -> Callable[[PairUpdate], bool]:
    """Of one listener: whether it has heard all that is so now."""
    kinds: set[str] = set()

    def reported(change: PairUpdate) -> bool:
        kinds.add(change.kind)
        return kinds == {"alive", "extrinsic", "health"}

    return reported


def _says(since_ns: int) -> Callable[[PairUpdate], bool]:
    return lambda change: isinstance(change.value, HealthReply) and change.value.since_ns == since_ns


def test_a_listener_that_is_cancelled_hears_nothing_more(endpoint: str) -> None:
    async def requested() -> None:
        async with Vehicle(VEHICLE, connect=endpoint, timeout_s=PATIENCE_S) as vehicle:
            received = asyncio.Event()

            async def listen() -> None:
                async for _ in vehicle.changes():
                    received.set()

            listener = asyncio.create_task(listen())
            async with asyncio.timeout(PATIENCE_S):
                await received.wait()
            listener.cancel()
            with pytest.raises(asyncio.CancelledError):
                await listener
            assert (await vehicle.health()).state == "unknown"

    asyncio.run(requested())
