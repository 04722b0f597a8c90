"""The service's Zenoh session: subscriptions never block its receive thread, and every query is answered; and where
the samples of a stream come from: native keys, rmw_zenoh or a bridge.

Callbacks run on Zenoh's own threads (`indirect=False`). They copy bytes into a bounded queue, or answer with bytes that
are already serialised. Slower answers are made on a thread per lane, behind a bounded queue. No exception leaves a
callback, and every query is finished, because an unfinished one makes its client wait for the whole timeout.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from typing import Any, Protocol

import zenoh
from zenoh.ext import HistoryConfig, RecoveryConfig, declare_advanced_subscriber

from coec.calibration.types import Frame
from coec.config import Config, LimitsConfig, OpenLidarConfig, StreamConfig, ZenohConfig
from coec.errors import CoecError, UnavailableError, UsageError
from coec.io.ros import messages, wire_format
from coec.io.system import ServiceThread
from coec.io.zenoh import session as zenoh_session
from coec.schemas.message import to_json, to_msgpack
from coec.schemas.replies import ErrorReply

CDR = "application/cdr"

NO_TYPE = "?"
"""Stands for the type of a message if its key holds none."""


@dataclass(frozen=True, slots=True)
class InputSample:
    """A message as it was received.

    Attributes:
        encoding: as the sender gives it, for example `application/cdr;TYPE`.
        attachment: bytes beside the message in which the sender should give a sequence number and its id; empty if they
            cannot be that. None: messages of this stream have no attachment.
        origin: id of the session that stamped the message for Zenoh: the sender's, or that of the first router on its
            way. Empty if nobody did.
        frame: that of a recording which is replayed, in place of a message; `payload` is empty then.
    """

    payload: bytes
    encoding: str
    attachment: bytes | None = None
    origin: bytes = b""
    frame: Frame | None = None


@dataclass(frozen=True, slots=True)
class StreamInput:
    """How to listen to one stream: key expressions to subscribe to, and a function that reads the samples.

    Attributes:
        token: liveliness token that shows the subscription to others; None if none is needed.
        described_on: key expressions of latched topics on which a LiDAR may say what it is. Their samples belong to the
            stream, as messages of `std_msgs/msg/String`.
    """

    expressions: tuple[str, ...]
    read: Callable[[zenoh.Sample], InputSample]
    token: str | None = None
    described_on: tuple[str, ...] = ()

    def declared(self, session: zenoh.Session, receive: Callable[..., None]) -> list[Undeclarable]:
        """Subscribers of the stream. `receive(sample, is_description=...)` is called on Zenoh's threads; the LiDAR says
        what it is in a description."""
        of_frames, of_descriptions = (direct(partial(receive, is_description=one)) for one in (False, True))
        return [
            *(_declare_latched(session, each, of_descriptions) for each in self.described_on),
            *(session.declare_subscriber(each, of_frames) for each in self.expressions),
        ]

    def sample(self, sample: zenoh.Sample, is_description: bool) -> InputSample:
        """The sample as the stream reads it."""
        read = self.read(sample)
        return replace(read, encoding=f"{CDR};{messages.STRING}") if is_description else read


def input_of(stream: StreamConfig, config: Config) -> StreamInput:
    """The input of a stream of this configuration."""
    if stream.key is not None:
        return on_key(stream.key)
    topics = stream.metadata_topics if isinstance(stream, OpenLidarConfig) else ()
    if config.middleware == "ros2dds":
        own, *others = (wire_format.topic_key(config.ros.namespace, topic) for topic in (stream.place, *topics))
        return replace(on_key(own), described_on=tuple(others))
    domain = config.ros.domain
    described_on = tuple(each for topic in topics for each in wire_format.topic_expressions(domain, topic))
    own_expressions = wire_format.topic_expressions(domain, stream.place)
    return StreamInput(own_expressions, _typed_by_key, described_on=described_on)


def on_key(key: str) -> StreamInput:
    """The input for everything that is put on one key."""
    return StreamInput((key,), _as_it_is)


def _as_it_is(sample: zenoh.Sample) -> InputSample:
    stamp = sample.timestamp
    origin = b"" if stamp is None else str(stamp.get_id()).encode()
    return InputSample(sample.payload.to_bytes(), str(sample.encoding), origin=origin)


def _typed_by_key(sample: zenoh.Sample) -> InputSample:
    """Reads a sample from rmw_zenoh, whose key holds the type; its encoding says nothing."""
    try:
        type_name = wire_format.TopicKey.parse(str(sample.key_expr)).type_name
    except UsageError:
        type_name = NO_TYPE
    received = sample.attachment
    readable = received is not None and len(received) <= wire_format.MAX_ATTACHMENT
    attachment = received.to_bytes() if received is not None and readable else b""
    return InputSample(sample.payload.to_bytes(), f"{CDR};{type_name}", attachment)


_log = logging.getLogger(__name__)

MSGPACK = "application/msgpack"
JSON = "application/json"

MAX_COMMAND_BYTES = 65_536
"""Largest payload of a query; commands are a few numbers."""

LATCHED_SAMPLES = 100
"""Most samples taken from each publisher that keeps some for late subscribers; the value of rmw_zenoh."""

POLL_S = 0.2


class QueryLane(Enum):
    """Where an answer is made: at once on Zenoh's thread, or on a thread that serves only queries of one kind."""

    AT_ONCE = "at-once"
    """The answer is already serialised; takes microseconds."""
    COMMANDS = "commands"
    """Waits until a command is carried out, but never behind queries that read files."""
    FILES = "files"
    """Reads a disk, or much of the history."""
    DRAWING = "drawing"
    """Waits for the worker."""


WAITING = {QueryLane.COMMANDS: 32, QueryLane.FILES: 32, QueryLane.DRAWING: 8}
"""Most queries that wait for each thread; the next one is answered `busy`. Commands: one for each pair that a vehicle
may have. Answers from files take 16 MB of memory each, pictures a second of the worker."""


@dataclass(frozen=True, slots=True)
class Request:
    """The parts of a query that an answer depends on. `key` has no wildcards; `attachment` says, in any form, who asks;
    `received_s` is when the query came (steady clock), since it may have waited."""

    key: str
    parameters: str
    payload: bytes
    received_s: float
    attachment: bytes | None = None


@dataclass(frozen=True, slots=True)
class Answer:
    """Bytes and their encoding."""

    payload: bytes
    encoding: str


@dataclass(frozen=True, slots=True)
class Route:
    """The function that answers a key, and the lane that it runs in."""

    key: str
    answer: Callable[[Request], Answer]
    lane: QueryLane


def open_session(config: ZenohConfig, limits: LimitsConfig, *, again: bool = False) -> zenoh.Session:
    """The service's session: by default that of a client, which connects and reconnects to the router, or that of the
    router itself. `again`: one of the same kind that may run at the same time as the service's.

    Raises:
        ConfigError: as `settings_of`, or a certificate or key cannot be used.
        UnavailableError: a port is taken, or an address is not there.
    """
    zenoh.init_log_from_env_or("error")
    settings = zenoh_session.settings_of(config, limits)
    if again:
        settings = zenoh_session.to_second_session(settings)
    zenoh_session.check_certificates(settings, zenoh_session.settings_source(config))
    try:
        return (
            zenoh_session.open_waiting(settings)
            if zenoh_session.mode_of(settings) == "client"
            else zenoh.open(settings)
        )
    except zenoh.ZError as error:
        text = zenoh_session.without_secrets(str(error), zenoh_session.endpoints_of(config))
        raise UnavailableError(
            f"cannot open the Zenoh session ({zenoh_session.settings_source(config)}): {text}"
        ) from None


def is_connected(session: zenoh.Session) -> bool:
    """Whether a session is connected to a router or a peer now."""
    return bool(list(session.info.routers_zid()) or list(session.info.peers_zid()))


def closed(session: zenoh.Session, deadline_s: float) -> bool:
    """Close a session; False if it did not close within `deadline_s` (on a lossy network it can take 10 s)."""
    closer = threading.Thread(target=session.close, name="zenoh-close", daemon=True)
    closer.start()
    closer.join(deadline_s)
    return not closer.is_alive()


_Waiting = queue.Queue[tuple[zenoh.Query, Sequence[Route], float]]


class Undeclarable(Protocol):
    """A subscriber of any kind."""

    def undeclare(self) -> None: ...


class Bus:
    """Everything the service declares in a session. Its methods are called from the daemon's threads; `threads` make
    the answers that are not made at once."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._subscribers: list[Undeclarable] = []
        self._queryables: list[zenoh.Queryable[None]] = []
        self._tokens: list[zenoh.LivelinessToken] = []
        self._waiting: dict[QueryLane, _Waiting] = {lane: queue.Queue(most) for lane, most in WAITING.items()}
        self.threads = tuple(
            ServiceThread(f"{lane.value}-queries", partial(_answer_from, waiting, self._answer))
            for lane, waiting in self._waiting.items()
        )

    @property
    def prompt_threads(self) -> tuple[ServiceThread, ...]:
        """The `threads` that wait neither for a disk nor for the worker."""
        return tuple(
            thread for lane, thread in zip(self._waiting, self.threads, strict=True) if lane is QueryLane.COMMANDS
        )

    def subscribe(self, stream: StreamInput, on_sample: Callable[[InputSample], None]) -> Callable[[], None]:
        """Call `on_sample` for every put on the stream, on Zenoh's thread. Returns a function that ends this."""
        receive = self._receiver(stream, on_sample)
        token = self._shown(stream)
        declared = stream.declared(self._session, receive)
        self._subscribers += declared

        def end() -> None:
            for subscriber in declared:
                self._subscribers.remove(subscriber)
                subscriber.undeclare()
            if token is not None:
                self._tokens.remove(token)
                token.undeclare()

        return end

    def subscribe_latched(self, stream: StreamInput, on_sample: Callable[[InputSample], None]) -> None:
        """As `subscribe`, and also for earlier samples if their publisher keeps them for late subscribers (ROS calls
        that transient local). Puts of this session itself are not heard."""
        receive = self._receiver(stream, on_sample)
        self._shown(stream)
        self._subscribers += [_declare_latched(self._session, each, direct(receive)) for each in stream.expressions]

    def _shown(self, stream: StreamInput) -> zenoh.LivelinessToken | None:
        """Declares the liveliness token that shows others that this stream is subscribed; None if it has no token."""
        if stream.token is None:
            return None
        token = self._session.liveliness().declare_token(stream.token)
        self._tokens.append(token)
        return token

    @staticmethod
    def _receiver(stream: StreamInput, on_sample: Callable[[InputSample], None]) -> Callable[..., None]:
        def receive(sample: zenoh.Sample, is_description: bool = False) -> None:
            try:
                if sample.kind == zenoh.SampleKind.PUT:
                    on_sample(stream.sample(sample, is_description))
            except Exception:
                _log.exception("a subscription failed", extra={"fields": {"key": stream.expressions[0]}})

        return receive

    def serve(self, key: str, find: Callable[[str], Sequence[Route]], *, complete: bool = True) -> None:
        """Answer queries that match `key`. `find` gets the query's key, which may hold wildcards. It returns the routes
        that answer (none: the query ends without a reply), or raises a `CoecError` for an error reply."""

        def receive(query: zenoh.Query) -> None:
            try:
                self._receive(query, find)
            except Exception:
                _log.exception("a query failed", extra={"fields": {"key": key}})
                query.drop()

        self._queryables.append(self._session.declare_queryable(key, direct(receive), complete=complete))

    def publish(self, key: str, answer: Answer) -> None:
        """Put a value; it is silently lost while there is no router."""
        timestamp = self._session.new_timestamp()
        try:
            self._session.put(key, answer.payload, encoding=answer.encoding, express=True, timestamp=timestamp)
        except zenoh.ZError:
            _log.exception("a value could not be published", extra={"fields": {"key": key}})

    def declare_alive(self, key: str) -> None:
        """Hold a liveliness token."""
        self._tokens.append(self._session.liveliness().declare_token(key))

    def undeclare_inputs(self) -> None:
        """Withdraw the tokens and receive no more samples."""
        for token in self._tokens:
            token.undeclare()
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._tokens.clear()
        self._subscribers.clear()

    def undeclare_queryables(self) -> None:
        """Receive no more queries, and finish those that wait with an error reply."""
        for queryable in self._queryables:
            queryable.undeclare()
        self._queryables.clear()
        for waiting in self._waiting.values():
            while not waiting.empty():
                query, _, _ = waiting.get_nowait()
                with query:
                    _reply_error(query, "stopping", "the service is stopping; ask again when it is back")

    @property
    def waiting(self) -> dict[str, int]:
        """Number of waiting queries, by queue."""
        return {lane.value: waiting.qsize() for lane, waiting in self._waiting.items()}

    def reaches_somebody(self) -> bool:
        """Whether the session is connected to a router or a peer now."""
        return is_connected(self._session)

    def close(self, deadline_s: float) -> bool:
        """Close the session; False if it did not close within `deadline_s`."""
        return closed(self._session, deadline_s)

    def _receive(self, query: zenoh.Query, find: Callable[[str], Sequence[Route]]) -> None:
        received_s = time.monotonic()
        try:
            routes = find(str(query.key_expr))
            if query.payload is not None and len(query.payload) > MAX_COMMAND_BYTES:
                raise UsageError(f"the payload is larger than {MAX_COMMAND_BYTES} bytes")
        except CoecError as error:
            with query:
                _reply_error(query, error.reply_code, str(error))
            return
        lanes = {route.lane for route in routes}
        slowest = next(
            (lane for lane in (QueryLane.DRAWING, QueryLane.FILES, QueryLane.COMMANDS) if lane in lanes),
            QueryLane.AT_ONCE,
        )
        if slowest is QueryLane.AT_ONCE:
            self._answer(query, routes, received_s)
            return
        try:
            self._waiting[slowest].put_nowait((query, routes, received_s))
        except queue.Full:
            with query:
                _reply_error(query, "busy", "too many queries wait; ask again in a moment")

    def _answer(self, query: zenoh.Query, routes: Sequence[Route], received_s: float) -> None:
        with query:
            payload = query.payload.to_bytes() if query.payload is not None else b""
            attachment = query.attachment.to_bytes() if query.attachment is not None else None
            for route in routes:
                try:
                    answer = route.answer(Request(route.key, str(query.parameters), payload, received_s, attachment))
                except CoecError as error:
                    _reply_error(query, error.reply_code, str(error))
                except Exception:
                    _log.exception("a query failed", extra={"fields": {"key": route.key}})
                    _reply_error(query, "internal", "the service failed on this query; its log says why")
                else:
                    timestamp = self._session.new_timestamp()
                    query.reply(route.key, answer.payload, encoding=answer.encoding, timestamp=timestamp)


def _answer_from(
    waiting: _Waiting, answer: Callable[[zenoh.Query, Sequence[Route], float], None], thread: ServiceThread
) -> None:
    while not thread.stopping:
        thread.beat()
        try:
            query, routes, received_s = waiting.get(timeout=POLL_S)
        except queue.Empty:
            continue
        try:
            answer(query, routes, received_s)
        except zenoh.ZError:  # the client is gone
            _log.debug("a reply could not be delivered")


def _declare_latched(session: zenoh.Session, expression: str, handler: zenoh.handlers.Callback[Any]) -> Undeclarable:
    return declare_advanced_subscriber(
        session,
        expression,
        handler,
        allowed_origin=zenoh.Locality.REMOTE,
        history=HistoryConfig(detect_late_publishers=True, max_samples=LATCHED_SAMPLES),
        recovery=RecoveryConfig(periodic_queries=None, heartbeat=True),
        subscriber_detection=True,
    )


def direct(callback: Callable[..., None]) -> zenoh.handlers.Callback[Any]:
    """A handler that calls on Zenoh's own threads, without a queue in between."""
    return zenoh.handlers.Callback(callback, indirect=False)


def _reply_error(query: zenoh.Query, code: str, message: str) -> None:
    """Sends an error reply in the requested format, whatever else is wrong with the query."""
    error = ErrorReply(code=code, message=message)
    if "format=json" in str(query.parameters).split(";"):
        query.reply_err(to_json(error), encoding=JSON)
    else:
        query.reply_err(to_msgpack(error), encoding=MSGPACK)
