"""Ensures one daemon per vehicle: daemons show themselves by liveliness tokens and look for others, and only one stays.

A daemon holds a claim from before it looks for others until it stops answering: first `starting`, then `serving`. A
claim is a liveliness token, and a queryable on the same key. A daemon looks through a separate client session, which
sees what the router holds; its own session would see its own claim at once, wherever else that is known. Once a daemon
sees its own claim there, every daemon that looks later sees it, too. Therefore, of two that start at the same time, at
least one sees the other:

- A daemon leaves if it sees another that serves, or one that starts with a smaller Zenoh id.
- A daemon waits if it sees others that start with larger ids. Either they leave, or they had looked before it started
  and are about to serve.
- A daemon that sees nobody serves, and goes on looking. Two daemons that started on different sides of a broken
  network, or before their router, see each other once it is there; then the one with the larger id leaves.

Another daemon counts only if it answers: a query for its claim, or, if it is of an earlier version, `status` with the
time of its start. Any program that may declare tokens could hold the token of a daemon; a token for which nobody
answers for `PROOF_S` is ignored and reported. If a daemon gets no answer of its own, the router's rules forbid these
queries. Then tokens count without an answer, and the same rules have to say who may declare them.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from typing import Literal

import zenoh

from coec.config import LimitsConfig, ZenohConfig
from coec.errors import DecodeError, UnavailableError, UsageError
from coec.io.system import ServiceThread
from coec.io.zenoh.bus import closed
from coec.io.zenoh.query_client import GRACE_S
from coec.io.zenoh.session import mode_of, open_client, settings_of, to_observer
from coec.schemas.keys import Claim, Keys
from coec.schemas.message import from_json
from coec.schemas.replies import StatusReply

_log = logging.getLogger(__name__)

CONNECT_S = 1.0
"""Timeout for opening the session to look with; a router on the same network answers in milliseconds."""

QUERY_S = 1.0
"""Timeout of one look."""

SEEN_S = 5.0
"""Timeout until a daemon sees its own claim: it is a message to the router, and the processor may be busy. If it takes
longer, access control hides the claim."""

DECIDED_S = 5.0
"""How long to wait for other starting daemons to leave or to serve. They need less; one that hangs is not waited
for."""

PROOF_S = 2.0
"""How long to wait, at the start, for an answer of whoever holds a token. A daemon answers in milliseconds; one that is
too busy for it is seen later, while both serve."""

MAX_OTHERS = 64
"""Most tokens of others that are kept from one look. Anybody may declare any number; daemons that are there answer,
whatever tokens are left out."""

POLL_S = 0.05
"""Pause between two looks while waiting."""

MAX_STATUS_BYTES = 2**20
"""Largest answer to `status` that is read, as for other documents; one of a vehicle with many pairs has some 100 kB."""

FORBIDDEN = 2
"""So many looks without an answer of its own, and a daemon takes its queries for forbidden."""

WATCH_S = 5.0
"""Pause between two looks while serving."""


def next_step(own: str, others: Iterable[Claim]) -> Literal["serve", "wait", "leave"]:
    """What a starting daemon with this Zenoh id does if it sees these claims."""
    claims = list(others)
    if any(claim.serving or claim.daemon < own for claim in claims):
        return "leave"
    return "wait" if claims else "serve"


def outranking(own: str, others: Iterable[Claim]) -> Claim | None:
    """A serving daemon to which the serving daemon with this Zenoh id must leave the vehicle; None: there is none."""
    return next((claim for claim in others if claim.serving and claim.daemon < own), None)


@dataclass(frozen=True, slots=True)
class RouterView:
    """What the router holds about one vehicle.

    Attributes:
        routed: whether there is a router that can hold anything; False if the daemon itself is the router.
        own: whether the daemon's own claim is there.
        others: claims of other daemons that have a token.
        tokens: liveliness tokens of pairs, whoever holds them.
        answers: claims of other daemons that answered.
    """

    routed: bool = False
    own: bool = False
    others: tuple[Claim, ...] = ()
    tokens: tuple[str, ...] = ()
    answers: tuple[Claim, ...] = ()

    @property
    def silent(self) -> tuple[Claim, ...]:
        """Claims of other daemons that have a token, but did not answer."""
        answering = {claim.daemon for claim in self.answers}
        return tuple(claim for claim in self.others if claim.daemon not in answering)


class SingletonGuard:
    """Presence of one daemon. `thread` looks for others while the daemon serves.

    Attributes:
        rival: another daemon to which this one has to leave the vehicle.
        hidden: whether the router does not show the tokens, so that no daemon sees another.
        unproven: keys of tokens that claim the vehicle, though nobody answers for them.
    """

    def __init__(
        self, session: zenoh.Session, config: ZenohConfig, limits: LimitsConfig, keys: Keys, since_ns: int
    ) -> None:
        """Neither claims nor looks yet.

        Args:
            session: the daemon's.
            since_ns: wall clock at the start of the daemon, for the messages of other daemons.
        """
        self.thread = ServiceThread("singleton-guard", self._watch)
        self.rival: Claim | None = None
        self.hidden = False
        self.unproven: tuple[str, ...] = ()
        self._session = session
        self._config, self._limits = config, limits
        self._keys = keys
        self._daemon = str(session.info.zid())
        self._since_ns = since_ns
        self._through: zenoh.Session | None = None
        self._claimed: list[tuple[zenoh.LivelinessToken, zenoh.Queryable[None]]] = []
        self._unanswered = 0
        self._answered = False
        self._sightings = 0
        self._serving = False
        self._stop = threading.Event()

    def claim(self, stop: threading.Event) -> None:
        """Claim the vehicle unless another daemon has it. For a thread that may wait; returns early if `stop` is set.

        Raises:
            UnavailableError: another daemon serves the vehicle, or is about to; says which. Then nothing stays claimed.
        """
        self._declare(serving=False)
        try:
            self._decide(stop)
        except UnavailableError:
            self._withdraw()
            raise

    def close(self, deadline_s: float) -> bool:
        """Stop looking and withdraw the claim; call it once the daemon has stopped answering. False if it took longer
        than the deadline."""
        end_s = time.monotonic() + deadline_s
        self.thread.request_stop()
        self._stop.set()
        joined, through = self.thread.join(deadline_s), self._through
        self._withdraw()
        if not joined or through is None or through is self._session:
            return joined
        return closed(through, max(end_s - time.monotonic(), 0.0))

    def _decide(self, stop: threading.Event) -> None:
        seen = self._query_until_seen(stop)
        started_s = time.monotonic()
        while not stop.is_set():
            waited_s = time.monotonic() - started_s
            silent = waited_s > PROOF_S
            rivals = self._rivals(seen, tokens_count=silent and self._forbidden)
            step = next_step(self._daemon, rivals)
            if step == "leave" or (step == "wait" and waited_s > DECIDED_S):
                raise UnavailableError(rival_text(self._keys.vehicle, min(rivals, key=lambda claim: not claim.serving)))
            unproven = self._unproven(seen, rivals)
            if silent and unproven and self._forbidden:
                raise UnavailableError(
                    f"vehicle {self._keys.vehicle!r} is already served: another session holds the token {unproven[0]!a}"
                )
            if step == "serve" and (silent or not unproven):
                self._report(unproven)
                # The first claim stays until the second is there, so that others always find one of them.
                self._declare(serving=True)
                self._undeclare_first()
                return
            stop.wait(POLL_S)
            seen = self._query_router()

    def _rivals(self, seen: RouterView, *, tokens_count: bool) -> tuple[Claim, ...]:
        """Claims of the other daemons that are there. `tokens_count`: a token suffices, because the router's rules
        forbid the queries."""
        if tokens_count:
            return tuple({*seen.answers, *seen.others})
        if not seen.silent and (seen.answers or not seen.tokens or self._serving):
            return seen.answers
        started = self._started_by_status()
        known = [claim for claim in seen.silent if claim.since_ns in started]
        nameless = started - {claim.since_ns for claim in known}
        # While this daemon does not serve, whoever answers `status` is another.
        unnamed = () if self._serving or known else tuple(Claim("", since_ns, serving=True) for since_ns in nameless)
        return (*seen.answers, *known, *unnamed)

    def _unproven(self, seen: RouterView, rivals: tuple[Claim, ...]) -> tuple[str, ...]:
        """Keys of tokens that claim the vehicle and belong to none of the rivals."""
        there = {claim.daemon for claim in rivals}
        keys = tuple(self._keys.claim(claim) for claim in seen.silent if claim.daemon not in there)
        # While a daemon serves, the tokens of its pairs may be its own.
        return keys if keys or rivals or self._serving else seen.tokens

    def _report(self, unproven: tuple[str, ...]) -> None:
        """Notes the tokens for which nobody answers; the first and then every 2^n-th sighting is logged."""
        self.unproven = unproven
        if not unproven:
            return
        self._sightings += 1
        if self._sightings & (self._sightings - 1) == 0:
            _log.warning(unproven_text(unproven), extra={"fields": {"vehicle": self._keys.vehicle}})

    def _declare(self, *, serving: bool) -> None:
        key = self._keys.claim(Claim(self._daemon, self._since_ns, serving))
        all_claims = zenoh.KeyExpr(self._keys.claims)

        def answer(query: zenoh.Query) -> None:
            with query, suppress(zenoh.ZError):  # the one who asked is gone
                if all_claims.includes(query.key_expr):  # a wider query asks for what the service has to say
                    query.reply(key, b"")

        # Whoever sees the token must get an answer, so that the queryable comes first.
        queryable = self._session.declare_queryable(key, zenoh.handlers.Callback(answer, indirect=False))
        self._claimed.append((self._session.liveliness().declare_token(key), queryable))
        self._serving = serving

    def _undeclare_first(self) -> None:
        token, queryable = self._claimed.pop(0)
        token.undeclare()
        queryable.undeclare()

    def _withdraw(self) -> None:
        while self._claimed:
            self._undeclare_first()

    # --- looking ----------------------------------------------------------------------------------------------------

    def _watch(self, thread: ServiceThread) -> None:
        unseen, before = 0, self.unproven
        while not self._stop.wait(WATCH_S):
            thread.beat()
            seen = self._query_router()
            rivals = self._rivals(seen, tokens_count=self._forbidden)
            unproven = self._unproven(seen, rivals)
            # A daemon that leaves withdraws its token and its answer one after the other.
            self._report(tuple(key for key in unproven if key in before))
            before = unproven
            rival = outranking(self._daemon, rivals)
            if rival is not None:
                self.rival = rival
            if seen.routed:
                # A router that has just come back learns of the tokens within one look.
                unseen = 0 if seen.own else unseen + 1
                self.hidden = unseen > 1 or (self.hidden and not seen.own)

    def _query_until_seen(self, stop: threading.Event) -> RouterView:
        """The first look that sees the own claim, or the last look within `SEEN_S`."""
        deadline_s = time.monotonic() + SEEN_S
        while not (seen := self._query_router()).own:
            if not seen.routed and not list(self._session.info.routers_zid()):
                _log.warning("no router answers yet; other daemons of the vehicle are checked once one does")
                break
            if time.monotonic() > deadline_s or stop.wait(POLL_S):
                self.hidden = seen.routed
                _log.warning("the liveliness tokens of this vehicle cannot be queried; two daemons may serve it")
                break
        return seen

    def _query_router(self) -> RouterView:
        """What the router holds now; nothing while there is no router."""
        if self._through is None:
            self._through = self._open_observer()
        if self._through is None:
            return RouterView()
        routed = bool(list(self._through.info.routers_zid()))
        held, answered, tokens = set[Claim](), set[Claim](), set[str]()

        def add(claims: set[Claim], sample: zenoh.Sample) -> None:
            with suppress(UsageError):  # anybody may hold a token of any name
                claim = self._keys.parse_claim(str(sample.key_expr))
                if claim.daemon == self._daemon or len(claims) <= MAX_OTHERS:
                    claims.add(claim)

        def add_token(sample: zenoh.Sample) -> None:
            if len(tokens) < MAX_OTHERS:
                tokens.add(str(sample.key_expr))

        self._each_token(self._keys.claims, partial(add, held))
        self._each_token(self._keys.alive("*"), add_token)
        self._each_reply(self._keys.claims, partial(add, answered))
        own = any(claim.daemon == self._daemon for claim in held)
        self._answered |= any(claim.daemon == self._daemon for claim in answered)
        self._unanswered += own
        others, answers = (
            tuple(claim for claim in claims if claim.daemon != self._daemon) for claims in (held, answered)
        )
        return RouterView(routed, own, others, tuple(sorted(tokens)), answers)

    @property
    def _forbidden(self) -> bool:
        """Whether the router's rules seem to forbid the query for claims: not even the own one was answered."""
        return not self._answered and self._unanswered >= FORBIDDEN

    def _started_by_status(self) -> set[int]:
        """When the services of the vehicle that answer `status` were started, ns, except this one."""
        started: set[int] = set()

        def add(sample: zenoh.Sample) -> None:
            if len(sample.payload) > MAX_STATUS_BYTES or len(started) >= MAX_OTHERS:
                return
            with suppress(DecodeError):
                status = from_json(StatusReply, sample.payload.to_bytes())
                if status.vehicle == self._keys.vehicle:
                    started.add(status.started_ns)

        self._each_reply(self._keys.status, add, "?format=json")
        return started - {self._since_ns}

    def _each_token(self, key: str, take: Callable[[zenoh.Sample], None]) -> None:
        """Calls `take`, on Zenoh's thread, for each token that is held; for none while the router is away."""
        if self._through is not None:
            with suppress(zenoh.ZError), _within(take) as (handler, given_up):
                self._through.liveliness().get(key, handler, timeout=QUERY_S, cancellation_token=given_up)

    def _each_reply(self, key: str, take: Callable[[zenoh.Sample], None], parameters: str = "") -> None:
        """Calls `take`, on Zenoh's thread, for each answer to a query; for none while the router is away."""
        if self._through is not None:
            with suppress(zenoh.ZError), _within(take) as (handler, given_up):
                self._through.get(
                    f"{key}{parameters}",
                    handler,
                    target=zenoh.QueryTarget.ALL,
                    consolidation=zenoh.ConsolidationMode.NONE,
                    timeout=QUERY_S,
                    cancellation_token=given_up,
                )

    def _open_observer(self) -> zenoh.Session | None:
        """The session to look through: the daemon's own if it is the router, otherwise a client session beside it.
        None: there is no router."""
        settings = settings_of(self._config, self._limits)
        if mode_of(settings) == "router":
            return self._session
        try:
            return open_client(to_observer(settings), CONNECT_S)
        except zenoh.ZError:
            return None


@contextmanager
def _within(
    take: Callable[[zenoh.Sample], None],
) -> Iterator[tuple[zenoh.handlers.Callback[zenoh.Reply], zenoh.CancellationToken]]:
    """Handler and token of a query that is sent within the block; the block ends when all its replies have come, or
    after its time."""
    finished, given_up = threading.Event(), zenoh.CancellationToken()

    def receive(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            take(reply.ok)

    yield zenoh.handlers.Callback(receive, finished.set, indirect=False), given_up
    finished.wait(QUERY_S + GRACE_S)
    given_up.cancel()


def rival_text(vehicle: str, other: Claim) -> str:
    """A sentence for people that says which daemon has the vehicle."""
    since = datetime.fromtimestamp(other.since_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    does = "is served" if other.serving else "is about to be served"
    who = f"another daemon, started {since}, Zenoh id {other.daemon or 'unknown'}"
    return f"vehicle {vehicle!r} {does} by {who}: end one of the two, or give them different vehicles"


def unproven_text(unproven: Sequence[str]) -> str:
    """A sentence for people about tokens for which nobody answers."""
    more = f" and {len(unproven) - 1} more" if len(unproven) > 1 else ""
    return (
        f"A program holds the liveliness token {unproven[0]!a}{more}, which says that another daemon serves the "
        "vehicle, but no daemon answers for it; it is ignored. Find that program and end it, and let the router's "
        "rules allow such tokens to the service alone."
    )
