"""Which key is answered by what: the routes of a vehicle (CONTRACT, "Keys")."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import zenoh
from pydantic import BaseModel

from coec.adapters.zenoh.bus import Answer, Bus, Request, Route
from coec.errors import UsageError
from coec.runtime.api import metrics as metrics_text
from coec.runtime.api import payloads
from coec.runtime.api.commands import Commands
from coec.runtime.api.pair_answers import PairAnswers
from coec.runtime.api.snapshots import Snapshot, answer_of
from coec.schemas.keys import (
    Format,
    Keys,
    parse_command_selector,
    parse_evidence_selector,
    parse_history_selector,
    parse_overlay_selector,
    parse_range_selector,
    parse_selector,
)

OCTETS = "application/octet-stream"
JPEG = "image/jpeg"


class VehicleAnswers:
    """Routes of the vehicle and of each of its pairs."""

    def __init__(
        self,
        keys: Keys,
        pairs: Mapping[str, PairAnswers],
        commands: Mapping[str, Commands],
        status: Callable[[], Snapshot],
        metrics: Callable[[], bytes],
        config: Snapshot,
    ) -> None:
        """`status()` and `config` are serialised before; `metrics()` is rendered when asked."""
        self._keys = keys
        self._pairs = pairs
        self._commands = commands
        self._vehicle_routes = {
            keys.status: Route(keys.status, lambda request: status().answer(_format(request)), quick=True),
            keys.config: Route(keys.config, lambda request: config.answer(_format(request)), quick=True),
            keys.metrics: Route(keys.metrics, lambda _: Answer(metrics(), metrics_text.ENCODING), quick=False),
        }
        self._pair_routes = {name: self._readable(pair) for name, pair in pairs.items()}

    def declare(self, bus: Bus) -> None:
        """Serve everything on the bus. The last queryable is there for the keys of pairs that are not: it does not
        claim to be `complete`, so that it takes no query from another service of the vehicle."""
        for key, route in self._vehicle_routes.items():
            bus.serve(key, _always(route))
        for name in self._pairs:
            bus.serve(f"{self._keys.root}/{name}/**", self._finder(name))
        bus.serve(f"{self._keys.root}/**", self._find_unknown, complete=False)

    def _finder(self, pair: str) -> Callable[[str], Sequence[Route]]:
        return lambda key: self._find(pair, key)

    def _find(self, pair: str, key: str) -> Sequence[Route]:
        """Who answers a key, or a key expression, of the pair.

        Raises:
            UsageError: nobody.
        """
        readable = self._pair_routes[pair]
        if key in readable:
            return [readable[key]]
        if _has_wildcard(key):
            asked = zenoh.KeyExpr(key)
            matching = [route for known, route in readable.items() if asked.intersects(zenoh.KeyExpr(known))]
            # A picture is drawn for whoever asks for one, not for everything at once.
            return matching if key.endswith("/overlay") else [route for route in matching if not route.draws]
        address = self._keys.parse(key)
        if address.resource == "windows" and address.argument is not None:
            return [Route(key, self._window(self._pairs[pair], address.argument), quick=False, draws=True)]
        if address.resource == "command":
            return [Route(key, self._command(self._commands[pair], str(address.argument)), quick=False)]
        if address.resource == "evidence" and address.argument is not None:
            return [Route(key, self._evidence(self._pairs[pair], address.argument), quick=False, draws=True)]
        raise UsageError("`alive` is a liveliness token: ask for liveliness")

    def _find_unknown(self, key: str) -> Sequence[Route]:
        """Nobody, in silence where another queryable answers: a session hands a query to all that match.

        Raises:
            UsageError: the key names no pair of this vehicle.
        """
        pair = key.removeprefix(f"{self._keys.root}/").partition("/")[0]
        if _has_wildcard(key) or key in self._vehicle_routes or pair in self._pairs:
            return []
        raise UsageError(f"no such pair or resource; pairs served here: {', '.join(self._pairs)}")

    def _readable(self, pair: PairAnswers) -> dict[str, Route]:
        keys, name = self._keys, pair.name
        routes = (
            Route(keys.extrinsic(name), lambda request: pair.extrinsic(_format(request)), quick=True),
            Route(keys.health(name), lambda request: pair.health(_format(request)), quick=True),
            Route(keys.history(name), lambda request: _history(pair, request), quick=False),
            Route(keys.windows(name), lambda request: _in_format(request, pair.windows), quick=False),
            Route(keys.evidence(name), lambda request: _in_format(request, pair.events), quick=False),
            Route(keys.overlay(name), lambda request: _overlay(pair, request), quick=False, draws=True),
        )
        return {route.key: route for route in routes}

    def _window(self, pair: PairAnswers, window_id: str) -> Callable[[Request], Answer]:
        def answer(request: Request) -> Answer:
            chosen = parse_range_selector(request.parameters)
            return Answer(pair.read_window(window_id, chosen.offset, chosen.length), OCTETS)

        return answer

    def _evidence(self, pair: PairAnswers, event_id: str) -> Callable[[Request], Answer]:
        def answer(request: Request) -> Answer:
            chosen = parse_evidence_selector(request.parameters)
            if chosen.overlay is not None:
                return Answer(pair.event_overlay(event_id, chosen.overlay), JPEG)
            return answer_of(pair.event(event_id), chosen.format)

        return answer

    def _command(self, commands: Commands, name: str) -> Callable[[Request], Answer]:
        def answer(request: Request) -> Answer:
            chosen = parse_command_selector(request.parameters)
            arguments, sender = payloads.parse(name, request.payload), payloads.sender_of(request.attachment)
            deadline_s = request.received_s + chosen.timeout_ms / 1e3
            return answer_of(commands.carry_out(name, arguments, sender, deadline_s), chosen.format)

        return answer


def _overlay(pair: PairAnswers, request: Request) -> Answer:
    chosen = parse_overlay_selector(request.parameters)
    return Answer(pair.overlay(chosen.window_id, nominal=chosen.at == "nominal"), JPEG)


def _history(pair: PairAnswers, request: Request) -> Answer:
    chosen = parse_history_selector(request.parameters)
    return answer_of(pair.history(chosen.since_ns, chosen.until_ns, chosen.limit), chosen.format)


def _in_format(request: Request, make: Callable[[], BaseModel]) -> Answer:
    form = _format(request)
    return answer_of(make(), form)


def _format(request: Request) -> Format:
    return parse_selector(request.parameters).format


def _always(route: Route) -> Callable[[str], Sequence[Route]]:
    return lambda _: [route]


def _has_wildcard(key: str) -> bool:
    return "*" in key
