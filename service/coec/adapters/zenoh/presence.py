"""Ensures one daemon per vehicle: daemons show themselves by liveliness tokens and look for others, and only one stays.

A daemon holds a claim from before it looks for others until it stops answering: first `starting`, then `serving`.
Routers forward nothing between two peers, so that a peer looks through a separate client session, which sees what the
router holds. Once a daemon sees its own claim there, every daemon that looks later sees it, too. Therefore, of two that
start at the same time, at least one sees the other:

- A daemon leaves if it sees another that serves, or one that starts with a smaller Zenoh id.
- A daemon waits if it sees others that start with larger ids. Either they leave, or they had looked before it started
  and are about to serve.
- A daemon that sees nobody serves, and goes on looking. Two daemons that started on different sides of a broken
  network, or before their router, see each other once it is there; then the one with the larger id leaves.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

import zenoh

from coec.adapters.system.threads import ServiceThread
from coec.adapters.zenoh.bus import closed
from coec.adapters.zenoh.settings import beside, mode_of, settings_of
from coec.config import LimitsConfig, ZenohConfig
from coec.errors import UnavailableError, UsageError
from coec.schemas.keys import Claim, Keys

_log = logging.getLogger(__name__)

CONNECT_S = 1.0
"""Timeout for opening the session to look with; a router on the same network answers in milliseconds."""

LOOK_S = 1.0
"""Timeout of one look."""

SEEN_S = 5.0
"""Timeout until a daemon sees its own claim: it is a message to the router, and the processor may be busy. If it takes
longer, access control hides the claim."""

DECIDED_S = 5.0
"""How long to wait for other starting daemons to leave or to serve. They need less; one that hangs is not waited
for."""

POLL_S = 0.05
"""Pause between two looks while waiting."""

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
class Seen:
    """What the router holds about one vehicle.

    Attributes:
        routed: whether there is a router that can hold anything; False if the daemon itself is the router.
        own: whether the daemon's own claim is there.
        others: claims of other daemons.
        tokens: liveliness tokens of pairs, whoever holds them.
    """

    routed: bool
    own: bool
    others: tuple[Claim, ...]
    tokens: tuple[str, ...]


class Presence:
    """Presence of one daemon. `thread` looks for others while the daemon serves.

    Attributes:
        rival: another daemon to which this one has to leave the vehicle.
        hidden: whether the router does not show the tokens, so that no daemon sees another.
    """

    def __init__(
        self, session: zenoh.Session, config: ZenohConfig, limits: LimitsConfig, keys: Keys, since_ns: int
    ) -> None:
        """Neither claims nor looks yet.

        Args:
            session: the daemon's.
            since_ns: wall clock at the start of the daemon, for the messages of other daemons.
        """
        self.thread = ServiceThread("look-out", self._watch)
        self.rival: Claim | None = None
        self.hidden = False
        self._session = session
        self._config, self._limits = config, limits
        self._keys = keys
        self._daemon = str(session.info.zid())
        self._since_ns = since_ns
        self._through: zenoh.Session | None = None
        self._tokens: list[zenoh.LivelinessToken] = []
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
        ended, through = self.thread.join(deadline_s), self._through
        self._withdraw()
        if not ended or through is None or through is self._session:
            return ended
        return closed(through, max(end_s - time.monotonic(), 0.0))

    def _decide(self, stop: threading.Event) -> None:
        seen = self._look_until_seen(stop)
        deadline_s = time.monotonic() + DECIDED_S
        while not stop.is_set():
            if seen.tokens and not seen.others:
                raise UnavailableError(
                    f"vehicle {self._keys.vehicle!r} is served already: somebody holds the token {seen.tokens[0]}"
                )
            step = next_step(self._daemon, seen.others)
            if step == "serve":
                # The first token stays until the second is there, so that others always find one of them.
                self._declare(serving=True)
                self._tokens.pop(0).undeclare()
                return
            if step == "leave" or time.monotonic() > deadline_s:
                raise UnavailableError(told(self._keys.vehicle, min(seen.others, key=lambda claim: not claim.serving)))
            stop.wait(POLL_S)
            seen = self._look()

    def _declare(self, *, serving: bool) -> None:
        key = self._keys.claim(Claim(self._daemon, self._since_ns, serving))
        self._tokens.append(self._session.liveliness().declare_token(key))

    def _withdraw(self) -> None:
        for token in self._tokens:
            token.undeclare()
        self._tokens.clear()

    # --- looking ----------------------------------------------------------------------------------------------------

    def _watch(self, thread: ServiceThread) -> None:
        unseen = 0
        while not self._stop.wait(WATCH_S):
            thread.beat()
            seen = self._look()
            rival = outranking(self._daemon, seen.others)
            if rival is not None:
                self.rival = rival
            if seen.routed:
                # A router that has just come back learns of the tokens within one look.
                unseen = 0 if seen.own else unseen + 1
                self.hidden = unseen > 1 or (self.hidden and not seen.own)

    def _look_until_seen(self, stop: threading.Event) -> Seen:
        """The first look that sees the own claim, or the last look within `SEEN_S`."""
        deadline_s = time.monotonic() + SEEN_S
        while not (seen := self._look()).own:
            if not seen.routed and not list(self._session.info.routers_zid()):
                _log.warning("no router answers yet: whether another daemon serves the vehicle is seen when one does")
                break
            if time.monotonic() > deadline_s or stop.wait(POLL_S):
                self.hidden = seen.routed
                _log.warning("the liveliness tokens of this vehicle cannot be seen: two daemons may serve it")
                break
        return seen

    def _look(self) -> Seen:
        """What the router holds now; nothing while there is no router."""
        if self._through is None:
            self._through = self._looking_glass()
        if self._through is None:
            return Seen(False, False, (), ())
        claims = {claim for key in _tokens(self._through, self._keys.claims) if (claim := self._claim_of(key))}
        return Seen(
            routed=bool(list(self._through.info.routers_zid())),
            own=any(claim.daemon == self._daemon for claim in claims),
            others=tuple(claim for claim in claims if claim.daemon != self._daemon),
            tokens=tuple(_tokens(self._through, self._keys.alive("*"))),
        )

    def _looking_glass(self) -> zenoh.Session | None:
        """The session to look through: the daemon's own, or, if that is a peer, a client session, which sees the tokens
        of other peers. None: there is no router."""
        settings = settings_of(self._config, self._limits)
        if mode_of(settings) != "peer":
            return self._session
        try:
            return zenoh.open(beside(settings, CONNECT_S))
        except zenoh.ZError:
            return None

    def _claim_of(self, key: str) -> Claim | None:
        try:
            return self._keys.parse_claim(key)
        except UsageError:  # anybody may hold a token of any name
            return None


def told(vehicle: str, other: Claim) -> str:
    """A sentence for people that says which daemon has the vehicle."""
    since = datetime.fromtimestamp(other.since_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    does = "is served" if other.serving else "is about to be served"
    return (
        f"vehicle {vehicle!r} {does} by another daemon, started {since}, Zenoh id {other.daemon}: end one of the two, "
        "or give them different vehicles"
    )


def _tokens(session: zenoh.Session, key: str) -> list[str]:
    """Keys of the tokens that are held; none while the router is away."""
    try:
        replies = list(session.liveliness().get(key, timeout=LOOK_S))
    except zenoh.ZError:
        return []
    return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
