"""Asks and commands a running service, from a program with an event loop.

    import asyncio
    from coec.client import Vehicle

    async def main() -> None:
        async with Vehicle("shuttle-7", connect="tcp/192.168.1.2:7447") as vehicle:
            print((await vehicle.extrinsic()).camera_from_lidar.matrix)
            async for change in vehicle.changes():
                print(change.pair, change.kind, change.value)

    asyncio.run(main())

Replies are the pydantic models of `coec.schemas.replies`, which CONTRACT and `schemas/v1` describe.
"""

import asyncio
import json
import math
import threading
from collections import deque
from collections.abc import AsyncGenerator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import zenoh
from pydantic import BaseModel

from coec.config import Config, ZenohConfig
from coec.errors import UsageError
from coec.io.zenoh import query_client
from coec.io.zenoh.command_auth import CommandSender
from coec.io.zenoh.query_client import MSGPACK
from coec.io.zenoh.session import connected_of, credentials_in, read_settings
from coec.io.zenoh.subscriptions import PairUpdate, subscribed
from coec.schemas.commands import COMMAND_NAMES, Acknowledgement, CommandName
from coec.schemas.keys import Keys
from coec.schemas.message import from_msgpack
from coec.schemas.replies import ExtrinsicReply, HealthReply, HistoryReply, StatusReply, WindowsReply

__all__ = ["PairUpdate", "Vehicle"]

MAX_QUEUED_CHANGES = 1024
"""Changes that may wait until the program takes them, some 10 MB. Beyond that the oldest are dropped and counted."""

M = TypeVar("M", bound=BaseModel)


class Vehicle:
    """A running service of one vehicle: questions, commands and changes.

    It is an asynchronous context manager: ask within its block. Any number of questions may be under way at once, all
    from one event loop. A task that is cancelled gives up its question at once; the service may have carried out a
    command all the same.
    """

    def __init__(
        self,
        name: str,
        *,
        connect: str | Sequence[str] | None = None,
        prefix: str | None = None,
        settings: str | PathLike[str] | None = None,
        timeout_s: float = 5.0,
    ) -> None:
        """Does not connect yet: entering the `async with` block does.

        Args:
            name: name of the vehicle in the configuration of its service.
            connect: Zenoh endpoints of the router; the first that answers is used. None: those of the file, else
                `tcp/127.0.0.1:7447`.
            prefix: first part of all keys; None: `coec`.
            settings: file with the Zenoh configuration of the session (JSON5). If it names a certificate, that
                certificate proves the commands.
            timeout_s: how long to wait for the router, and for each answer unless the call says otherwise.

        Raises:
            UsageError: the name or the prefix cannot be part of a key, or `timeout_s` is not positive and finite.
            ConfigError: the file cannot be used.
        """
        fields = Config.model_fields
        self._keys = Keys(fields["prefix"].default if prefix is None else prefix, name)
        query_client.single_key(self._keys.status)  # every other key is below it
        self._timeout_s = _seconds(timeout_s)
        file = None if settings is None else Path(settings)
        read = None if file is None else read_settings(file)
        given = (connect,) if isinstance(connect, str) else tuple(connect or ())
        endpoints = given or (() if read is None else connected_of(read)) or ZenohConfig().router
        self._way = query_client.RouterAddress(tuple(endpoints), file)
        self._credentials = None if read is None else credentials_in(read)
        self._connection: AbstractContextManager[zenoh.Session] | None = None
        self._open: zenoh.Session | None = None
        self._listeners: set[_ChangeQueue] = set()

    def __repr__(self) -> str:
        return f"<coec.client.Vehicle {self._keys.root}>"

    async def __aenter__(self) -> Self:
        """Connects.

        Raises:
            ConnectionFailedError: no router has answered within `timeout_s`.
            UsageError: an endpoint is malformed.
        """
        if self._connection is not None:
            raise UsageError("the vehicle is already connected: create another Vehicle for a second connection")
        connection = query_client.connected_by(self._way, self._timeout_s)
        opening = asyncio.get_running_loop().run_in_executor(None, connection.__enter__)
        try:
            self._open = await asyncio.shield(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(lambda done: _close_once_open(done, connection))
            raise
        self._connection = connection
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Disconnects: every loop over `changes` ends."""
        connection, self._connection, self._open = self._connection, None, None
        for waiting in tuple(self._listeners):
            waiting.close()
        if connection is not None:
            closing = asyncio.get_running_loop().run_in_executor(None, connection.__exit__, None, None, None)
            await asyncio.shield(closing)

    async def pairs(self) -> tuple[str, ...]:
        """Names of the pairs that the vehicle serves.

        Raises:
            NotFoundError, RemoteError: as `extrinsic`.
        """
        return tuple(pair.name for pair in (await self.status()).pairs)

    async def status(self, *, timeout_s: float | None = None) -> StatusReply:
        """State of the service: its worker, its storage, and the counters of each pair.

        Raises:
            NotFoundError, RemoteError: as `extrinsic`.
        """
        return await self._reply(StatusReply, self._keys.status, timeout_s)

    async def extrinsic(self, pair: str | None = None, *, timeout_s: float | None = None) -> ExtrinsicReply:
        """The calibration to use now. Before the first result this is the nominal one.

        Args:
            pair: name of the pair; None: the only pair of the vehicle.
            timeout_s: how long to wait for the answer; None: as given to `Vehicle`.

        Raises:
            UsageError: the name cannot be part of a key, `pair` is None and the vehicle does not serve exactly one
                pair, or the vehicle is not connected.
            NotFoundError: nobody answered: the vehicle is not there, or the router's rules do not allow the question.
            RemoteError: the service refuses; `reply_code` is its code, or `timeout` if it did not answer in time.
            DecodeError: the reply is not one of the expected kind.
        """
        return await self._reply(ExtrinsicReply, self._keys.extrinsic(await self._pair(pair)), timeout_s)

    async def health(self, pair: str | None = None, *, timeout_s: float | None = None) -> HealthReply:
        """Whether the calibration is still right, and on which evidence. Arguments and errors as `extrinsic`."""
        return await self._reply(HealthReply, self._keys.health(await self._pair(pair)), timeout_s)

    async def windows(self, pair: str | None = None, *, timeout_s: float | None = None) -> WindowsReply:
        """Recorded windows, oldest first. Arguments and errors as `extrinsic`."""
        return await self._reply(WindowsReply, self._keys.windows(await self._pair(pair)), timeout_s)

    async def history(
        self, pair: str | None = None, *, limit: int = 100, timeout_s: float | None = None
    ) -> HistoryReply:
        """Past results and other events: the newest `limit` of them, oldest first. Arguments and errors as
        `extrinsic`."""
        key = self._keys.history(await self._pair(pair))
        return await self._reply(HistoryReply, f"{key}?limit={limit}", timeout_s)

    async def command(
        self,
        name: CommandName,
        pair: str | None = None,
        payload: Mapping[str, Any] | None = None,
        *,
        timeout_s: float | None = None,
    ) -> Acknowledgement:
        """Gives a command and waits for the acknowledgement, which says whether the service carries it out, or why not.

        Args:
            name: `calibrate`, `apply`, `rollback`, `reset`, `commission` or `hold`.
            pair: name of the pair; None: the only pair of the vehicle.
            payload: arguments of the command; JSON must be able to hold them.
            timeout_s: how long to wait for the acknowledgement. The service does not carry out a command that it could
                not begin by then.

        Raises:
            UsageError: no such command, or a payload that JSON cannot hold; else as `extrinsic`.
            NotProvenError: with a certificate: the one who answered is not the service.
            NotFoundError, RemoteError, DecodeError: as `extrinsic`.
        """
        if name not in COMMAND_NAMES:
            raise UsageError(f"no command {name!r}: known are {', '.join(COMMAND_NAMES)}")
        waits_s = self._timeout_s if timeout_s is None else _seconds(timeout_s)
        key = self._keys.command(await self._pair(pair), name)
        selector = f"{query_client.single_key(key)}?timeout_ms={query_client.patience_ms(waits_s)};format=msgpack"
        try:
            encoded = None if payload is None else json.dumps(dict(payload), allow_nan=False).encode()
        except (TypeError, ValueError) as error:
            raise UsageError(f"payload of {name}: {error}") from error
        if self._credentials is None:
            return from_msgpack(
                Acknowledgement, (await self._query(selector, waits_s, encoded, query_client.myself())).payload
            )
        speaker = CommandSender(self._credentials, self._keys.vehicle)
        session = self._session
        reply = await asyncio.get_running_loop().run_in_executor(
            None, lambda: query_client.send_authenticated(session, selector, encoded, waits_s, speaker, MSGPACK)
        )
        return from_msgpack(Acknowledgement, reply.payload)

    async def changes(self, pair: str | None = None) -> AsyncGenerator[PairUpdate]:
        """Yields the present state (`extrinsic`, `health`, `alive` of each pair), then every change as it comes, until
        the loop over it ends or the vehicle is disconnected. From an absent vehicle nothing comes until it appears. For
        one that goes away, `alive` False comes, and its changes come again when it is back.

        At most 1024 changes wait. Beyond that the oldest are dropped, and `Change.lost` of the next one counts them.

        Args:
            pair: name of the pair; None: all pairs.

        Raises:
            UsageError: the name cannot be part of a key, or the vehicle is not connected.
        """
        if pair is not None:
            query_client.single_key(pair)
        queue = _ChangeQueue(asyncio.get_running_loop())
        subscription = subscribed(
            self._session, self._keys, pair or "*", self._timeout_s, queue.push, queue.count_invalid
        )
        self._listeners.add(queue)
        try:
            with subscription:
                while (change := await queue.next()) is not None:
                    yield change
        finally:
            self._listeners.discard(queue)

    # --- inside -----------------------------------------------------------------------------------------------------

    @property
    def _session(self) -> zenoh.Session:
        if self._open is None:
            raise UsageError("the vehicle is not connected: `async with Vehicle(...) as vehicle:`")
        return self._open

    async def _pair(self, pair: str | None) -> str:
        if pair is not None:
            return query_client.single_key(pair)
        names = await self.pairs()
        if len(names) != 1:
            raise UsageError(f"the vehicle serves {len(names)} pairs, name one: {', '.join(names)}")
        return names[0]

    async def _reply(self, model: type[M], selector: str, timeout_s: float | None) -> M:
        query_client.single_key(selector.partition("?")[0])
        waits_s = self._timeout_s if timeout_s is None else _seconds(timeout_s)
        return from_msgpack(model, (await self._query(selector, waits_s)).payload)

    async def _query(
        self, selector: str, timeout_s: float, payload: bytes | None = None, attachment: bytes | None = None
    ) -> query_client.Reply:
        loop = asyncio.get_running_loop()
        finished = asyncio.Event()

        def on_finished() -> None:
            with suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(finished.set)

        replies = query_client.Replies(selector, timeout_s, on_finished)
        try:
            replies.query(self._session, payload, attachment)
            async with asyncio.timeout(timeout_s + query_client.GRACE_S):
                await finished.wait()
        except TimeoutError:
            raise query_client.too_late(selector, timeout_s) from None
        finally:
            replies.close()
        answers = replies.result()
        if not answers:
            raise query_client.no_reply_error(selector)
        return answers[0]


class _ChangeQueue:
    """Queue of changes from Zenoh's threads to one event loop."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._lock = threading.Lock()
        self._changes: deque[PairUpdate] = deque()
        self._lost = 0
        self._wakes = False
        self._woken = asyncio.Event()
        self._closed = False

    def push(self, change: PairUpdate) -> None:
        """Queues a change; called on any thread."""
        with self._lock:
            if len(self._changes) >= MAX_QUEUED_CHANGES:
                self._changes.popleft()
                self._lost += 1
            self._changes.append(change)
            wakes, self._wakes = self._wakes, True
        if not wakes:  # while the loop is busy a single wake-up waits for it, not one for each change
            with suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._wake)

    def count_invalid(self) -> None:
        """Counts a message that was no valid change; called on any thread."""
        with self._lock:
            self._lost += 1

    def close(self) -> None:
        """No more changes come; called on the loop."""
        self._closed = True
        self._woken.set()

    async def next(self) -> PairUpdate | None:
        """The next change; None: no more come."""
        while True:
            self._woken.clear()
            with self._lock:
                if self._changes:
                    change, lost, self._lost = self._changes.popleft(), self._lost, 0
                    return replace(change, lost=lost)
            if self._closed:
                return None
            await self._woken.wait()

    def _wake(self) -> None:
        with self._lock:
            self._wakes = False
        self._woken.set()


def _close_once_open(opening: asyncio.Future[zenoh.Session], connection: AbstractContextManager[zenoh.Session]) -> None:
    """Closes a connection that came up after its caller had been cancelled."""
    if not opening.cancelled() and opening.exception() is None:
        threading.Thread(target=connection.__exit__, args=(None, None, None), daemon=True).start()


def _seconds(timeout_s: float) -> float:
    if not 0.0 < timeout_s < math.inf:
        raise UsageError(f"timeout_s={timeout_s!r}: give seconds, above 0")
    return timeout_s
