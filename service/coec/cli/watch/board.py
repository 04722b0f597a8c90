"""A fleet on one screen: the last heartbeat of each pair, and at a key press the history or overlay of one pair."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

import zenoh
from rich.console import Group, RenderableType
from rich.live import Live
from rich.text import Text

from coec.cli.options import ServiceAddress, until_signal
from coec.errors import CoecError, UsageError
from coec.fleet.fleet_state import RANKS, FleetFilter, FleetState, PairName, parse_states
from coec.io.system import pressed_keys as keyboard
from coec.io.zenoh.query_client import connected_by, query_one
from coec.io.zenoh.subscriptions import HeartbeatReceiver
from coec.reports import console, fleet_board
from coec.reports.replies import results_table
from coec.schemas.documents import FleetNow, PairNow
from coec.schemas.keys import Keys
from coec.schemas.message import from_msgpack
from coec.schemas.replies import HistoryReply

FRAME_S = 0.5
"""Time between two updates of the screen, which shows ages in seconds."""

QUERY_PERIOD_S = 10.0
QUERIES_AT_ONCE = 16
"""How many silent pairs are queried every `QUERY_PERIOD_S` for a heartbeat that may have been lost: at most 2 kB/s,
whatever the fleet."""

RESULTS = 10
"""Most results of a pair's history: 50 kB."""

ANSWER_S = 10.0
"""Timeout for the answer to a key press; a picture takes so long over a bad link."""

PANE_ROWS = 16
"""Lines for the details of one pair."""

QUICK_FILTERS: tuple[tuple[str, frozenset[str]], ...] = (
    ("", frozenset()),
    ("not healthy", frozenset(RANKS) - {"healthy", "parked"}),
    ("red or suspect", frozenset({"miscalibrated", "suspect"})),
    ("silent", frozenset({"silent"})),
    ("parked", frozenset({"parked"})),
)


def show_fleet(
    address: ServiceAddress, states: Sequence[str], find: str, timeout_s: float, *, once: bool, as_json: bool
) -> int:
    """Shows the board until the user leaves it, or once; returns 1 if no pair has sent a heartbeat.

    Raises:
        ConnectionFailedError: no router answered.
        UsageError: an unknown state.
    """
    selected = FleetFilter(parse_states(states, UsageError), find)
    with (
        until_signal() as stop,
        connected_by(address.way, timeout_s) as session,
        connected_by(address.way, timeout_s) as of_tokens,
    ):
        heartbeats = HeartbeatReceiver(session, of_tokens, Keys(address.prefix, address.vehicle), timeout_s)
        with heartbeats.subscribed():
            board = Board(FleetState(), heartbeats, selected, PairQuery(session, address.prefix))
            if once:
                while not heartbeats.initial_query_done.wait(FRAME_S) and not stop.is_set():
                    pass
                fleet = board.once()
                console.report(
                    fleet,
                    lambda: console.out.print(fleet_board.board(fleet, -1, 0, fleet.matching, "")),
                    as_json=as_json,
                )
                return 0 if fleet.known else 1
            with (
                board.query,
                keyboard() as poll,
                Live(console=console.out, screen=True, auto_refresh=False) as live,
            ):
                while not stop.is_set() and board.press(poll(FRAME_S)):
                    live.update(board.frame(console.out.width, console.out.height), refresh=True)
    return 0 if board.once().known else 1


class PairQuery:
    """Queries one pair at a time in its own thread, so that the screen goes on; shows the reply when it arrives."""

    def __init__(self, session: zenoh.Session, prefix: str) -> None:
        self._session = session
        self._prefix = prefix
        self._thread = ThreadPoolExecutor(1, "query")
        self._future: Future[RenderableType] | None = None
        self._what = ""

    def __enter__(self) -> PairQuery:
        return self

    def __exit__(self, *raised: object) -> None:
        self._thread.shutdown(wait=False, cancel_futures=True)

    def begin(self, what: str, name: PairName, size: tuple[int, int]) -> None:
        """Query `history` or `overlay`, unless a query is still open; `size` in characters."""
        if self._future is not None and not self._future.done():
            return
        self._what = f"{what} of {name[0]}/{name[1]}"
        make = {"history": self._history, "overlay": self._overlay}[what]
        self._future = self._thread.submit(make, name, size)

    def shown(self) -> RenderableType:
        """The answer, or that it has not arrived yet."""
        if self._future is None or not self._future.done():
            return Text(f"waiting for the {self._what} …", "dim")
        try:
            return self._future.result()
        except CoecError as error:
            return Text(f"no {self._what}: {error}", "yellow")

    def _history(self, name: PairName, _: tuple[int, int]) -> RenderableType:
        key = Keys(self._prefix, name[0]).history(name[1])
        reply = from_msgpack(HistoryReply, query_one(self._session, f"{key}?limit={RESULTS}", ANSWER_S).payload)
        return results_table(reply)

    def _overlay(self, name: PairName, size: tuple[int, int]) -> RenderableType:
        key = Keys(self._prefix, name[0]).overlay(name[1])
        return fleet_board.half_block_text(query_one(self._session, key, ANSWER_S).payload, *size)


@dataclass(slots=True)
class Board:
    """The content of the screen, and what keys do to it. Owned by one thread.

    Attributes:
        index: of the selected pair among those that are shown.
        name: of the pair that a key selected, which stays selected wherever it moves; None: the first pair is selected.
    """

    state: FleetState
    heartbeats: HeartbeatReceiver
    given: FleetFilter
    query: PairQuery
    clock: Callable[[], float] = time.monotonic
    pane: str = "reasons"
    quick: int = 0
    index: int = 0
    name: PairName | None = None
    queried_s: float = field(default=-QUERY_PERIOD_S)
    fleet: FleetNow | None = None

    def once(self) -> FleetNow:
        """The fleet, with everything that has arrived by now."""
        self._update()
        return self.state.now(self.clock(), self.given)

    def press(self, key: str | None) -> bool:
        """Act on a key; returns False if the key leaves the board."""
        pairs = self.fleet.pairs if self.fleet is not None else ()
        pair = pairs[self.index] if self.index < len(pairs) else None
        step = {"up": -1, "k": -1, "down": 1, "j": 1, "page up": -10, "page down": 10}.get(key or "", 0)
        if step and pairs:
            self.index = min(max(self.index + step, 0), len(pairs) - 1)
            self.name = _name(pairs[self.index])
            self.pane = "reasons"
        elif key == "f":
            self.quick = (self.quick + 1) % len(QUICK_FILTERS)
        elif key in ("r", "enter"):
            self.pane = "reasons"
        elif key in ("h", "o") and pair is not None:
            self.name = _name(pair)
            self.pane = {"h": "history", "o": "overlay"}[key]
            self.query.begin(self.pane, self.name, (console.out.width, PANE_ROWS * 2))
        return key != "q"

    def frame(self, width: int, height: int) -> RenderableType:
        """The screen as it is now."""
        del width
        self._update()
        label, states = QUICK_FILTERS[self.quick]
        shown = FleetFilter(states or self.given.states, self.given.text)
        pane_rows = PANE_ROWS * (2 if self.pane == "overlay" else 1)
        rows = max(height - pane_rows - 5, 3)
        self.fleet = self.state.now(self.clock(), shown, max(rows, self.index + rows))
        pairs = self.fleet.pairs
        at = [index for index, pair in enumerate(pairs) if _name(pair) == self.name]
        self.index = at[0] if at else min(self.index if self.name else 0, max(len(pairs) - 1, 0))
        pair = pairs[self.index] if pairs else None
        first = max(min(self.index - rows // 2, len(pairs) - rows), 0)
        filtered = ", ".join(filter(None, (label or ", ".join(sorted(shown.states)), shown.text)))
        parts: list[RenderableType] = [fleet_board.board(self.fleet, self.index, first, rows, filtered)]
        if not self.heartbeats.is_connected:
            parts.insert(0, Text("no router: nothing new arrives, ages go on", "bold red"))
        parts += [Text(fleet_board.KEYS, "dim"), self._pane(pair)]
        return Group(*parts)

    def _pane(self, pair: PairNow | None) -> RenderableType:
        if pair is None:
            answered = self.heartbeats.initial_query_done.is_set()
            return Text("no pair has sent a heartbeat" if answered else "looking for pairs …", "dim")
        return fleet_board.detail(pair) if self.pane == "reasons" else self.query.shown()

    def _update(self) -> None:
        now_s = self.clock()
        for message in self.heartbeats.pending():
            if message.kind == "said":
                self.state.on_heartbeat(message.key, message.payload, message.at_s)
            elif message.kind == "kept":
                self.state.restore(message.key, message.payload, message.at_s, time.time_ns())
            else:
                vehicle, pair = message.key.split("/")[-3:-1]
                self.state.on_liveliness(vehicle, pair, is_there=bool(message.payload))
        for cause, count in self.heartbeats.refused().items():
            self.state.count_refused(cause, count)
        if now_s - self.queried_s >= QUERY_PERIOD_S and self.heartbeats.initial_query_done.is_set():
            self.queried_s = now_s
            for vehicle, pair in self.state.overdue(now_s, QUERIES_AT_ONCE):
                self.heartbeats.query(vehicle, pair)


def _name(pair: PairNow) -> PairName:
    return pair.word.vehicle, pair.word.pair
