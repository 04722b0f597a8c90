"""Prints what a service says about itself, a line per change. It asks and listens, and never gives a command."""

from __future__ import annotations

import queue
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

import zenoh

from coec.adapters.zenoh.changes import Change, listening
from coec.adapters.zenoh.client import connected_by
from coec.cli.commands.watch import Options
from coec.cli.query import Asked
from coec.cli.stopping import until_signal
from coec.reports import console
from coec.reports.instants import second
from coec.reports.page.words import count
from coec.runtime.worker import compilation
from coec.schemas.keys import Keys
from coec.schemas.replies import HealthReply

WAITING = 1024
"""Changes that may wait to be written, some 10 MB; further ones are counted and left out."""

POLL_S = 0.2
"""Time between two checks whether to stop."""


def run(options: Options, asked: Asked) -> int:
    """Writes a line per change until told to stop, or for some seconds; returns 1 if nothing was heard at all.

    Raises:
        ConnectionFailedError: no router answered.
    """
    heard = 0
    connection = connected_by(asked.way, options.timeout_s)
    with until_signal() as stop, connection as session, _changes(session, asked, options.timeout_s) as changes:
        end_s = None if options.seconds is None else time.monotonic() + options.seconds
        while not stop.is_set():
            try:
                change = changes.get(timeout=POLL_S)
            except queue.Empty:
                if end_s is not None and time.monotonic() >= end_s:
                    break
                continue
            heard += 1
            _write(change, asked.vehicle, as_json=options.as_json)
    return 0 if heard else 1


@contextmanager
def _changes(session: zenoh.Session, asked: Asked, timeout_s: float) -> Iterator[queue.Queue[Change]]:
    """The present state, and every change from then on."""
    waiting: queue.Queue[Change] = queue.Queue(WAITING)
    lost = Counter[str]()

    def take(change: Change) -> None:
        try:
            waiting.put_nowait(change)
        except queue.Full:
            refuse()

    def refuse() -> None:
        lost["messages"] += 1

    with listening(session, Keys(asked.prefix, asked.vehicle), "*", timeout_s, take, refuse):
        yield waiting
    if lost:
        told = count(lost.total(), "message was", "messages were")
        console.say(f"coec: {told} not shown: no document of ours, or more than could be written")


def _write(change: Change, vehicle: str, *, as_json: bool) -> None:
    """Prints a change: for people with the time, and with its vehicle."""
    value, pair = change.value, f"{vehicle}/{change.pair}"
    if as_json:
        document = value if isinstance(value, bool) else value.model_dump(mode="json")
        console.print_json({"key": change.key, "value": document})
        return
    if isinstance(value, bool):
        text = "is served" if value else "is no longer served"
    elif isinstance(value, HealthReply):
        # Compilation's text says how far it is.
        why = ", ".join(reason.text if reason.code == compilation.CODE else reason.code for reason in value.reasons)
        text = f"{value.state}{f': {why}' if why else ''}"
    else:
        text = f"extrinsic {value.provenance}, {console.attempt(value.status)}"
    console.show(f"{second(time.time_ns())}  {pair}  {text}")
