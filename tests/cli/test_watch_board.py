"""`coec watch` as a board: over a router, with somebody who kept the words of vehicles that have gone."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
import pytest
import zenoh
from rich.console import Console

from cli.conftest import Coec
from coec.cli.watch.board import Board, PairQuery
from coec.config import LimitsConfig, ZenohConfig
from coec.errors import DecodeError
from coec.fleet.fleet_state import FleetFilter, FleetState
from coec.io import system
from coec.io.images import encode_jpeg
from coec.io.zenoh.bus import open_session
from coec.io.zenoh.query_client import connected
from coec.io.zenoh.subscriptions import HeartbeatReceiver
from coec.reports import fleet_board
from coec.schemas.keys import Keys
from coec.schemas.message import to_msgpack
from coec.schemas.replies import HistoryReply
from e2e.processes import Router, free_endpoint
from support.fake_worker import wait_until
from support.messages import heartbeat, packed_heartbeat
from support.router import MemoryStorage

ALL = Keys("coec", "*")


def say(session: zenoh.Session, vehicle: str, **reported: Any) -> None:
    key = Keys("coec", vehicle).last("front")
    session.put(key, packed_heartbeat(heartbeat(vehicle, **reported)), timestamp=session.new_timestamp())


def test_what_was_retained_is_reported_once_most_urgent_first(coec: Coec, router: Router) -> None:
    with MemoryStorage(router.session, ALL.last("*")) as storage, connected([router.endpoint], 5.0) as vehicle:
        say(vehicle, "truck-1")
        say(vehicle, "truck-2", state="miscalibrated", event="front-7")
        say(vehicle, "truck-3", service="stopping")
        wait_until(lambda: len(storage.samples) == 3, "the words are kept")
        outcome = coec("watch", "--once", "--connect", router.endpoint, "--json")
        reported = [(pair["word"]["vehicle"], pair["standing"]) for pair in outcome.document["pairs"]]
        assert reported == [("truck-2", "silent"), ("truck-1", "silent"), ("truck-3", "parked")], "all long ago"
        labels = coec("watch", "--once", "--connect", router.endpoint, "--state", "parked", "--find", "truck")
        assert labels.status == 0
        assert "3 vehicles, 3 pairs: 2 silent, 1 parked" in labels.out
        assert "parked (healthy)" in labels.out
        assert "truck-1" not in labels.out
        one = coec("watch", "--once", "--vehicle", "truck-2", "--connect", router.endpoint, "--json")
        assert [pair["word"]["event"] for pair in one.document["pairs"]] == ["front-7"]


def test_a_fleet_that_says_nothing_is_a_failure(coec: Coec, router: Router) -> None:
    outcome = coec("watch", "--once", "--connect", router.endpoint, "--timeout", "1", "--json")
    assert (outcome.status, outcome.document["known"]) == (1, 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--once", "--lines"), "are about the board"),
        (("--state", "healthy"), "needs a terminal"),
        (("--once", "--state", "splendid"), "is no state"),
    ],
)
def test_what_does_not_go_together_is_a_usage_error(
    coec: Coec, router: Router, arguments: tuple[str, ...], message: str
) -> None:
    outcome = coec("watch", *arguments, "--connect", router.endpoint)
    assert outcome.status == 2
    assert message in outcome.err


# ----------------------------------------------------------------------------------------------------- on a screen


@contextmanager
def board_of(router: Router) -> Iterator[Board]:
    with connected([router.endpoint], 5.0) as session, connected([router.endpoint], 5.0) as of_tokens:
        labels = HeartbeatReceiver(session, of_tokens, ALL, 2.0)
        with labels.subscribed(), PairQuery(session, "coec") as asking:
            yield Board(FleetState(), labels, FleetFilter(), asking)


def text(board: Board) -> str:
    console = Console(width=160, height=50, record=True, file=open(os.devnull, "w"))  # noqa: SIM115, PTH123
    with console.file:
        console.print(board.frame(160, 50))
    return console.export_text()


def test_keys_select_a_pair_and_report_its_reasons_history_and_overlay(router: Router) -> None:
    keys = Keys("coec", "truck-2")
    picture = encode_jpeg(np.full((90, 160, 3), 200, np.uint8))
    history = to_msgpack(HistoryReply(vehicle="truck-2", pair="front", total=0, results=()))
    with connected([router.endpoint], 5.0) as vehicle, board_of(router) as board:

        def answer(payload: bytes) -> Any:
            def reply(query: zenoh.Query) -> None:
                with query:
                    query.reply(query.key_expr, payload)

            return reply

        vehicle.declare_queryable(keys.history("front"), answer(history))
        vehicle.declare_queryable(keys.overlay("front"), answer(picture))
        reason = {"code": "moved", "text": "The mount has moved.\x1b[2J"}

        def received() -> bool:
            say(vehicle, "truck-1")  # until the route is laid
            say(vehicle, "truck-2", state="miscalibrated", reasons=[reason])
            return "2 vehicles, 2 pairs: 1 miscalibrated, 1 healthy" in text(board)

        wait_until(received, "both are told")
        shown = text(board)
        assert "moved: The mount has moved." in shown, "the most urgent is chosen"
        assert "\x1b" not in shown, "what a terminal would obey is not passed on"
        assert board.press("h")
        wait_until(lambda: "verdict" in text(board), "the history is there")
        assert board.press("o")
        wait_until(lambda: "▀▀▀▀" in text(board), "the picture is there")
        assert board.press("down")
        assert "truck-1/front" in text(board)
        assert "no reasons" in text(board)
        say(vehicle, "truck-1", state="suspect", drift=(3.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        wait_until(lambda: "1 miscalibrated, 1 suspect" in text(board), "a change is told")
        assert "truck-1/front" in text(board), "the chosen pair stays chosen"
        assert board.press("f")
        assert "showing 2: not healthy" in text(board)
        assert not board.press("q")


@pytest.mark.fault("a pair that does not answer what is asked of it", "the board goes on, and says so")
def test_what_is_not_answered_is_reported(router: Router) -> None:
    with connected([router.endpoint], 5.0) as vehicle, board_of(router) as board:

        def received() -> bool:
            say(vehicle, "truck-9")  # until the route is laid
            return "1 vehicle, 1 pair" in text(board)

        wait_until(received, "it is told")
        assert board.press("o")
        wait_until(lambda: "no overlay of truck-9/front: nobody answered" in text(board), "nobody answers")


def test_a_text_that_was_lost_is_requested(router: Router) -> None:
    """Of a pair that is overdue and has not taken its leave."""
    key = Keys("coec", "truck-5").last("front")
    now_s = 1000.0
    with connected([router.endpoint], 5.0) as vehicle, board_of(router) as board:
        wait_until(lambda: board.heartbeats.initial_query_done.is_set(), "nobody has said anything")

        def answer(query: zenoh.Query) -> None:
            with query:
                query.reply(key, packed_heartbeat(heartbeat("truck-5", said_ns=2**62)))

        vehicle.declare_queryable(key, answer)
        board.state.on_heartbeat(key, packed_heartbeat(heartbeat("truck-5", state="suspect")), -now_s)
        assert "silent (suspect)" in text(board)
        board.queried_s = -now_s
        wait_until(lambda: "1 healthy" in text(board), "it has answered")


@contextmanager
def router_at(endpoint: str) -> Iterator[zenoh.Session]:
    with open_session(ZenohConfig(embedded_router=True, listen=(endpoint,)), LimitsConfig()) as session:
        yield session


@pytest.mark.fault("the link to the fleet's router breaks", "the board says so, ages go on, words come again with it")
def test_a_link_that_breaks_is_reported_and_text_come_again_with_it(
    record_property: Callable[[str, object], None],
) -> None:
    endpoint = free_endpoint()
    with ExitStack() as stack:
        with router_at(endpoint) as session:
            board = stack.enter_context(board_of(Router(session, endpoint)))
            wait_until(lambda: board.heartbeats.initial_query_done.is_set(), "nobody has said anything")
            say(session, "truck-1")
            wait_until(lambda: "1 vehicle, 1 pair: 1 healthy" in text(board), "it is told")
        wait_until(lambda: "no router: nothing new arrives" in text(board), "the link is gone")
        board.clock = lambda: time.monotonic() + 200.0
        assert "silent (healthy)" in text(board), "its last state is not taken for the present one"
        board.clock = time.monotonic
        with router_at(endpoint) as session:
            started_s = time.monotonic()
            wait_until(lambda: board.heartbeats.is_connected, "the link is back")
            again = iter(range(1000))
            wait_until(lambda: _hears(board, session, next(again)), "a word comes again")
            record_property("figure", f"{time.monotonic() - started_s:.1f} s")


def _hears(board: Board, session: zenoh.Session, attempt: int) -> bool:
    say(session, "truck-2", state="suspect", windows=attempt)
    return "1 suspect" in text(board)


def test_keys_are_read_as_they_are_pressed(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = os.openpty()
    with os.fdopen(theirs) as terminal, os.fdopen(ours, "wb", buffering=0) as hand:
        monkeypatch.setattr(sys, "stdin", terminal)
        with system.pressed_keys() as poll:
            assert poll(0.0) is None
            for sent, key in ((b"\x1b[A", "up"), (b"q", "q"), (b"\xff", None), (b"\x1b[B", "down")):
                hand.write(sent)
                assert poll(5.0) == key


@pytest.mark.fault("an invalid picture from a vehicle", "refused, the board goes on")
def test_a_picture_that_is_none_is_refused() -> None:
    with pytest.raises(DecodeError):
        fleet_board.half_block_text(b"\xff\xd8\xff not a picture", 80, 24)
    rendered = fleet_board.half_block_text(encode_jpeg(np.zeros((100, 400, 3), np.uint8)), 80, 24).plain
    rows = rendered.splitlines()
    assert (len(rows), {len(row) for row in rows}) == (10, {80})
