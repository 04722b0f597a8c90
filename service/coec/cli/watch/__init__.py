"""`coec watch`: shows a fleet on one screen, or prints a line per change of one vehicle, for programs and logs."""

from __future__ import annotations

import queue
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from coec.cli import options
from coec.errors import UsageError
from coec.reports import console
from coec.reports.formatting import count, second
from coec.schemas.keys import Keys

if TYPE_CHECKING:
    import zenoh

    from coec.io.zenoh.subscriptions import PairUpdate

EVERY_VEHICLE = "*"

WAITING = 1024
"""Changes that may wait to be written, some 10 MB; further ones are counted and left out."""

POLL_S = 0.2
"""Time between two checks whether to stop."""


def watch(
    config: options.ServiceConfig = None,
    vehicle: Annotated[
        str | None, typer.Option(help="Show only this vehicle.", show_default="all of them; `vehicle` for lines")
    ] = None,
    prefix: options.Prefix = None,
    connect: options.Connect = None,
    zenoh: options.SessionFile = None,
    states: Annotated[
        list[str] | None,
        typer.Option("--state", help="Only pairs in this state, or `parked`, `silent`; repeatable.", metavar="STATE"),
    ] = None,
    find: Annotated[str | None, typer.Option(help="Only pairs with this text in VEHICLE/PAIR.", metavar="TEXT")] = None,
    once: Annotated[bool, typer.Option("--once", help="Print the board once, and end.")] = False,
    lines: Annotated[
        bool,
        typer.Option(
            "--lines", help="Print one line per change of one vehicle, as when standard output is no terminal."
        ),
    ] = False,
    seconds: Annotated[
        float | None,
        typer.Option(
            help="Print lines for this many seconds: exit 1 if nothing was received.", min=0.1, show_default="for ever"
        ),
    ] = None,
    timeout_s: options.RouterTimeout = 5.0,
    as_json: Annotated[
        bool,
        typer.Option("--json", help="Print one JSON document per line on standard output; with --once, one document."),
    ] = False,
) -> int:
    """Show every vehicle's pairs by urgency, as they change: state, age, drift, reasons. Sends no command.

    In a terminal: r reasons, h history, o overlay of the chosen pair, f filter, q quit. If the output is no terminal: a
    line for each change of health, extrinsic and presence of one vehicle.
    """
    from coec.cli.watch.board import show_fleet

    of_board = once or bool(states) or bool(find)
    of_lines = lines or seconds is not None
    if of_board and of_lines:
        raise UsageError("--once, --state and --find are about the board, --lines and --seconds about lines")
    on_screen = sys.stdout.isatty() and not as_json
    if of_lines or not (of_board or on_screen):
        address = options.service_address(config, vehicle, prefix, connect, zenoh)
        return _print_changes(address, seconds, timeout_s, as_json=as_json)
    address = options.service_address(
        config, EVERY_VEHICLE if vehicle is None and config is None else vehicle, prefix, connect, zenoh
    )
    if not (once or on_screen):
        raise UsageError("the board needs a terminal: give --once, or --lines")
    return show_fleet(address, states or (), find or "", timeout_s, once=once, as_json=as_json)


def _print_changes(address: options.ServiceAddress, seconds: float | None, timeout_s: float, *, as_json: bool) -> int:
    """Writes a line per change until a signal, or for some seconds; returns 1 if nothing was received.

    Raises:
        ConnectionFailedError: no router answered.
    """
    from coec.io.zenoh.query_client import connected_by

    received = 0
    connection = connected_by(address.way, timeout_s)
    with options.until_signal() as stop, connection as session, _changes(session, address, timeout_s) as changes:
        end_s = None if seconds is None else time.monotonic() + seconds
        while not stop.is_set():
            try:
                change = changes.get(timeout=POLL_S)
            except queue.Empty:
                if end_s is not None and time.monotonic() >= end_s:
                    break
                continue
            received += 1
            _write(change, address.vehicle, as_json=as_json)
    return 0 if received else 1


@contextmanager
def _changes(
    session: zenoh.Session, address: options.ServiceAddress, timeout_s: float
) -> Iterator[queue.Queue[PairUpdate]]:
    """The present state, and every change from then on."""
    from coec.io.zenoh.subscriptions import subscribed

    waiting: queue.Queue[PairUpdate] = queue.Queue(WAITING)
    lost = Counter[str]()

    def put(change: PairUpdate) -> None:
        try:
            waiting.put_nowait(change)
        except queue.Full:
            refuse()

    def refuse() -> None:
        lost["messages"] += 1

    with subscribed(session, Keys(address.prefix, address.vehicle), "*", timeout_s, put, refuse):
        yield waiting
    if lost:
        dropped = count(lost.total(), "message was", "messages were")
        console.say(f"coec: {dropped} not shown: invalid, or more than could be written")


def _write(change: PairUpdate, vehicle: str, *, as_json: bool) -> None:
    """Prints a change: for people with the time, and with its vehicle."""
    from coec.schemas.replies import HealthReply
    from coec.service.worker import compilation

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
