"""What a service says of itself, a line a change. It asks and listens, and never gives a command."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import zenoh

from coec.adapters.zenoh.client import connected_by
from coec.cli.commands.watch import Options
from coec.cli.query import Asked
from coec.cli.stopping import until_signal
from coec.errors import DecodeError
from coec.reports import console
from coec.schemas.base import from_msgpack
from coec.schemas.keys import Keys
from coec.schemas.replies import ExtrinsicReply, HealthReply

WAITING = 1024
"""Changes that may wait to be written, some 10 MB; what comes beyond is counted and left out."""

POLL_S = 0.2
"""Between two looks whether to stop."""


@dataclass(frozen=True, slots=True)
class Change:
    """One thing that was said. `value` is the document, or for `alive` whether the pair is served."""

    key: str
    kind: str
    value: Any


def run(options: Options, asked: Asked) -> int:
    """Writes a line a change until told to stop, or for some seconds; 1 if nothing was heard at all.

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
            _write(change, as_json=options.as_json)
    return 0 if heard else 1


@contextmanager
def _changes(session: zenoh.Session, asked: Asked, timeout_s: float) -> Iterator[queue.Queue[Change]]:
    """What is so now, and every change from then on."""
    keys = Keys(asked.prefix, asked.vehicle)
    waiting: queue.Queue[Change] = queue.Queue(WAITING)
    changed: set[str] = set()
    order = threading.Lock()
    lost = 0

    def take(sample: zenoh.Sample) -> None:
        nonlocal lost
        try:
            waiting.put_nowait(_change(sample))
        except (queue.Full, DecodeError):
            lost += 1

    def hear(sample: zenoh.Sample) -> None:
        with order:
            changed.add(str(sample.key_expr))
            take(sample)

    handler = zenoh.handlers.Callback(hear, indirect=False)
    with ExitStack() as stack:
        for key in (keys.health("*"), keys.extrinsic("*")):
            stack.callback(session.declare_subscriber(key, handler).undeclare)
        tokens = session.liveliness().declare_subscriber(keys.alive("*"), handler, history=True)
        stack.callback(tokens.undeclare)
        for key in (keys.health("*"), keys.extrinsic("*")):
            for reply in session.get(key, target=zenoh.QueryTarget.ALL, timeout=timeout_s):
                with order:
                    # What has changed meanwhile is newer than this answer, or the same.
                    if reply.ok is not None and str(reply.ok.key_expr) not in changed:
                        take(reply.ok)
        yield waiting
    if lost:
        console.say(f"coec: {lost} messages were not shown: no document of ours, or more than could be written")


def _change(sample: zenoh.Sample) -> Change:
    """Raises: DecodeError: no document of ours."""
    key = str(sample.key_expr)
    kind = key.rpartition("/")[2]
    if kind == "alive":
        return Change(key, kind, sample.kind == zenoh.SampleKind.PUT)
    model = HealthReply if kind == "health" else ExtrinsicReply
    return Change(key, kind, from_msgpack(model, sample.payload.to_bytes()).model_dump(mode="json"))


def _write(change: Change, *, as_json: bool) -> None:
    if as_json:
        console.print_json({"key": change.key, "value": change.value})
        return
    pair, value = change.key.split("/")[-2], change.value
    if change.kind == "alive":
        console.show(f"{pair}  {'is served' if value else 'is no longer served'}")
    elif change.kind == "health":
        why = ", ".join(reason["code"] for reason in value["reasons"])
        console.show(f"{pair}  {value['state']}{f': {why}' if why else ''}")
    else:
        console.show(f"{pair}  extrinsic {value['provenance']}, latest attempt {value['status']}")
