"""How many vehicles one router takes: their tokens, queryables and last words, on this machine.

    python -m bench.fleet_scale [VEHICLES [QUERYABLES]]     from tests/, prints one JSON document

Four kinds of processes: a router; a stand-in for the storage (in Python, where the real one is a plugin in Rust); one
that is all vehicles, which share its sessions, and declares and answers what a service does for each; and this one,
which watches as `coec watch` does. Processor time is that of the process, not the wall's: other work on the machine
costs latency, and no more.
"""

from __future__ import annotations

import json
import multiprocessing
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.synchronize import Event
from typing import Any

import msgpack
import numpy as np
import psutil
import zenoh

from coec.fleet.fleet_state import FleetState
from coec.io.zenoh.subscriptions import HeartbeatReceiver
from coec.schemas.heartbeat import decode_heartbeat
from coec.schemas.keys import Keys
from coec.schemas.message import to_msgpack
from support.messages import heartbeat
from support.router import MemoryStorage, free_port

ALL = Keys("coec", "*")
SPAWN = multiprocessing.get_context("spawn")
"""A fork and Zenoh do not go together."""

STEADY_S = 20.0
PATIENCE_S = 90.0
SESSIONS = 50
"""That all vehicles share: each costs the machine a connection and its buffers, and the router's tables nothing."""

QUERYABLES = ("status", "config", "rig", "metrics", "front/**", "rig/**", "**")
"""Beside that of last words, as `runtime.api.routes` declares them. A measurement takes the first so many of them: what
they cost a router's tables is more than what they cost a vehicle."""


def main(vehicles: int = 10_000, queryables: int = 0) -> dict[str, Any]:
    """Measures, in at most three minutes."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    reported: dict[str, Any] = {"vehicles": vehicles, "declarations": vehicles * (queryables + 2)}
    with process(_router, endpoint) as router:
        reported["router_rss_mb_empty"] = _rss_mb(router)
        with process(_server, endpoint) as server, _watching(endpoint) as (text, fleet_state):
            orders, answers = SPAWN.Queue(), SPAWN.Queue()
            with process(_fleet, endpoint, vehicles, queryables, orders, answers) as fleet:
                before_s, started_s = _cpu_s(router), time.monotonic()
                answers.get(timeout=PATIENCE_S * 3)
                _settle(router)
                reported["declared_s"] = time.monotonic() - started_s
                reported["router_cpu_s_declaring"] = _cpu_s(router) - before_s
                reported["router_rss_mb_declared"] = _rss_mb(router)
                for name, seconds in (("storm", 0.0), ("steady", STEADY_S)):
                    reported[name] = _phase(seconds, vehicles, text, fleet_state, orders, (router, server, fleet))
                with _watching(endpoint) as (late, empty):
                    started_s = time.monotonic()
                    late.initial_query_done.wait(PATIENCE_S)
                    reported["late_watcher_s"] = time.monotonic() - started_s
                    _receive(late, empty, [])
                    reported["late_watcher_knows"] = empty.now(time.monotonic()).known
                started_s = time.process_time()
                board = fleet_state.now(time.monotonic(), most=50)
                reported["board_ms"] = 1e3 * (time.process_time() - started_s)
                reported["board"] = {"known": board.known, "states": board.states, "refused": board.refused}
                reported["watcher_rss_mb"] = _rss_mb(psutil.Process())
                reported["keeper_rss_mb"] = _rss_mb(server)
                reported["router_rss_mb_end"] = _rss_mb(router)
                orders.put(None)
    reported["word_bytes"] = len(to_msgpack(heartbeat("v00000")))
    return reported


@contextmanager
def process(target: Any, *arguments: Any) -> Iterator[psutil.Process]:
    """A process of its own, until the end of the block."""
    ready, stop = SPAWN.Event(), SPAWN.Event()
    started = SPAWN.Process(target=target, args=(ready, stop, *arguments), daemon=True)
    started.start()
    assert ready.wait(PATIENCE_S)
    try:
        yield psutil.Process(started.pid)
    finally:
        stop.set()
        started.join(PATIENCE_S)


def _router(ready: Event, stop: Event, endpoint: str) -> None:
    settings = zenoh.Config()
    for key, value in (
        ("mode", "router"),
        ("listen/endpoints", [endpoint]),
        ("scouting/multicast/enabled", False),
        ("transport/unicast/max_sessions", 20_000),
        ("transport/shared_memory/enabled", False),
    ):
        settings.insert_json5(key, json.dumps(value))
    with suppress(zenoh.ZError), zenoh.open(settings):
        ready.set()
        stop.wait()


def _client(endpoint: str) -> zenoh.Session:
    settings = zenoh.Config()
    for key, value in (
        ("mode", "client"),
        ("connect/endpoints", [endpoint]),
        ("scouting/multicast/enabled", False),
        ("timestamping/enabled", True),
        ("transport/shared_memory/enabled", False),
    ):
        settings.insert_json5(key, json.dumps(value))
    return zenoh.open(settings)


def _server(ready: Event, stop: Event, endpoint: str) -> None:
    with _client(endpoint) as session, MemoryStorage(session, ALL.last("*")):
        ready.set()
        stop.wait()


def _fleet(ready: Event, stop: Event, endpoint: str, vehicles: int, queryables: int, orders: Any, answers: Any) -> None:
    """Says each word once in as many seconds as it is told; None ends it."""
    ready.set()
    opened = [_client(endpoint) for _ in range(SESSIONS)]
    word = msgpack.unpackb(to_msgpack(heartbeat()))
    every: list[tuple[zenoh.Session, Keys]] = []
    for number in range(vehicles):
        session, keys = opened[number % SESSIONS], Keys("coec", f"v{number:05}")
        every.append((session, keys))
        session.liveliness().declare_token(keys.alive("front"))
        for name in QUERYABLES[:queryables]:
            session.declare_queryable(f"{keys.root}/{name}", zenoh.handlers.Callback(_silent, indirect=False))
        answer = zenoh.handlers.Callback(_Answer(keys, word), indirect=False)
        session.declare_queryable(keys.last("front"), answer, complete=True)
    answers.put("declared")
    while (seconds := orders.get()) is not None and not stop.is_set():
        started_s = time.monotonic()
        for number, (session, keys) in enumerate(every):
            wait_s = started_s + seconds * number / vehicles - time.monotonic()
            if wait_s > 0.0:
                time.sleep(wait_s)
            session.put(keys.last("front"), _packed(keys, word), timestamp=session.new_timestamp(), express=True)
        answers.put(time.monotonic() - started_s)
    with suppress(zenoh.ZError):  # a router that is behind by minutes does not take leave in time
        for session in opened:
            session.close()


class _Answer:
    """What a service says when it is asked for its last word."""

    def __init__(self, keys: Keys, word: dict[str, Any]) -> None:
        self._keys, self._word = keys, word

    def __call__(self, query: zenoh.Query) -> None:
        with query:
            query.reply(self._keys.last("front"), _packed(self._keys, self._word))


def _silent(query: zenoh.Query) -> None:
    query.drop()


def _packed(keys: Keys, word: dict[str, Any]) -> bytes:
    packed: bytes = msgpack.packb({**word, "vehicle": keys.vehicle, "said_ns": time.time_ns()})
    return packed


@contextmanager
def _watching(endpoint: str) -> Iterator[tuple[HeartbeatReceiver, FleetState]]:
    with _client(endpoint) as session, _client(endpoint) as of_tokens:
        text = HeartbeatReceiver(session, of_tokens, ALL, PATIENCE_S)
        with text.subscribed():
            yield text, FleetState()


def _phase(
    seconds: float,
    vehicles: int,
    text: HeartbeatReceiver,
    fleet_state: FleetState,
    orders: Any,
    others: tuple[psutil.Process, ...],
) -> dict[str, Any]:
    """Every vehicle says its word once, in so many seconds."""
    latencies_s: list[float] = []
    _receive(text, fleet_state, [])
    before = [_cpu_s(each) for each in (*others, psutil.Process())]
    started_s = time.monotonic()
    orders.put(seconds)
    quiet_s = time.monotonic()
    while time.monotonic() - started_s < seconds + PATIENCE_S:
        if _receive(text, fleet_state, latencies_s):
            quiet_s = time.monotonic()
        elif len(latencies_s) >= vehicles or time.monotonic() - quiet_s > max(5.0, 0.5 * seconds):
            break
        time.sleep(0.005)
    took_s = quiet_s - started_s
    names = ("router", "keeper", "fleet", "watcher")
    spent = [_cpu_s(each) - cpu_s for each, cpu_s in zip((*others, psutil.Process()), before, strict=True)]
    p50, p99, most = (float(value) for value in np.quantile(latencies_s or [0.0], (0.5, 0.99, 1.0)))
    return {
        "heard": len(latencies_s),
        "took_s": took_s,
        "words_per_s": len(latencies_s) / max(took_s, 1e-9),
        "latency_ms": {"p50": 1e3 * p50, "p99": 1e3 * p99, "max": 1e3 * most},
        "cpu_us_per_word": {
            name: 1e6 * cpu_s / max(len(latencies_s), 1) for name, cpu_s in zip(names, spent, strict=True)
        },
    }


def _receive(text: HeartbeatReceiver, fleet_state: FleetState, latencies_s: list[float]) -> int:
    """What has come; how many words were said as they came."""
    count = 0
    for received in text.pending():
        if received.kind == "said":
            count += 1
            fleet_state.on_heartbeat(received.key, received.payload, received.at_s)
            latencies_s.append((time.time_ns() - decode_heartbeat(received.key, received.payload).said_ns) * 1e-9)
        elif received.kind == "kept":
            fleet_state.restore(received.key, received.payload, received.at_s, time.time_ns())
    for cause, number in text.refused().items():
        fleet_state.count_refused(cause, number)
    return count


def _settle(router: psutil.Process) -> None:
    """Until the router has nothing to do any more, for half a second."""
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        before_s = _cpu_s(router)
        time.sleep(0.5)
        if _cpu_s(router) - before_s < 0.02:
            return


def _cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def _rss_mb(process: psutil.Process) -> float:
    return float(process.memory_info().rss) / 1e6


if __name__ == "__main__":
    print(json.dumps(main(*(int(argument) for argument in sys.argv[1:])), indent=2))
