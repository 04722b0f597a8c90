"""The routes of a vehicle: which function answers which key (CONTRACT, "Keys")."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import zenoh

from coec.errors import UsageError
from coec.io.exported_extrinsic import ExportFrames
from coec.io.exports import FORMATS
from coec.io.zenoh.bus import Answer, Bus, QueryLane, Request, Route
from coec.schemas import keys as bus_keys
from coec.service.api import metrics as metrics_text
from coec.service.api.authorization import CommandHandler
from coec.service.api.pair_answers import PairAnswers, PendingPairAnswers
from coec.service.api.reply_builders import SerializedReply, answer_of
from coec.service.api.rig_answers import RigAnswers
from coec.service.api.uplink import Heartbeats, Uplink
from coec.service.timing import QUICK_S, Histogram

OCTETS = "application/octet-stream"
JPEG = "image/jpeg"


AnyPairAnswers = PairAnswers | PendingPairAnswers
"""What answers about a pair."""


@dataclass(slots=True)
class VehicleReplies:
    """The latest replies about the vehicle. One thread replaces them whole, any thread reads them.

    Attributes:
        status, config: the status of the service and its configuration.
    """

    status: SerializedReply
    config: SerializedReply


class VehicleRoutes:
    """Routes of the vehicle and of each of its pairs.

    Attributes:
        took: time from the arrival of a query to its answer or refusal, by what was asked for.
    """

    def __init__(
        self,
        keys: bus_keys.Keys,
        pairs: Mapping[str, AnyPairAnswers],
        command_handler: CommandHandler,
        vehicle: VehicleReplies,
        metrics: Callable[[], bytes],
        rig: RigAnswers,
        heartbeats: Heartbeats,
        uplink: Uplink,
    ) -> None:
        """`metrics()` is rendered when it is asked for."""
        self.took = Histogram(QUICK_S)
        self._keys = keys
        self._pairs = dict(pairs)
        self._command_handler = command_handler
        self._heartbeats = heartbeats
        self._uplink = uplink
        self._vehicle_routes = {
            keys.status: Route(keys.status, partial(_status, vehicle), QueryLane.AT_ONCE),
            keys.config: Route(keys.config, partial(_config, vehicle), QueryLane.AT_ONCE),
            keys.rig: Route(keys.rig, partial(_rig, rig), QueryLane.AT_ONCE),
            keys.metrics: Route(keys.metrics, partial(_metrics, metrics), QueryLane.FILES),
        }
        self._pair_routes = {name: self._readable(pair) for name, pair in pairs.items()}

    def replace(self, pair: PairAnswers) -> None:
        """Answers about the pair with this object from now on."""
        self._pairs[pair.name], self._pair_routes[pair.name] = pair, self._readable(pair)

    def declare(self, bus: Bus) -> None:
        """Serves everything on the bus. The last queryable answers for keys of pairs that do not exist. It does not
        claim to be `complete`, so that it takes no query away from another service of the vehicle."""
        for key, route in self._vehicle_routes.items():
            bus.serve(key, partial(_always, self._timed(route, key.rpartition("/")[2])))
        for name in self._pairs:
            bus.serve(f"{self._keys.root}/{name}/**", self._finder(name))
        bus.serve(f"{self._keys.rig}/**", self._find_of_rig)
        for name in self._pairs:
            # Each by its own key: a router finds a declared key at once when something is put there, however many
            # vehicles there are. An undeclared key would make it search among all of them each time (docs/fleet.md).
            bus.serve(self._keys.last(name), self._find_last(name))
        bus.serve(f"{self._keys.root}/**", self._find_unknown, complete=False)

    def _finder(self, pair: str) -> Callable[[str], Sequence[Route]]:
        """A function that finds the routes for a key of the pair; their answers are timed."""

        def find(key: str) -> Sequence[Route]:
            return [self._timed(route, self._keys.parse(route.key).resource) for route in self._find(pair, key)]

        return find

    def _timed(self, route: Route, resource: str) -> Route:
        def answer(request: Request) -> Answer:
            try:
                return route.answer(request)
            finally:
                self.took.add(time.monotonic() - request.received_s, resource)

        return replace(route, answer=answer)

    def _find(self, pair: str, key: str) -> Sequence[Route]:
        """The routes for a key, or a key expression, of the pair.

        Raises:
            UsageError: no route answers it.
        """
        readable = self._pair_routes[pair]
        if key in readable:
            return [readable[key]]
        if _has_wildcard(key):
            expression = zenoh.KeyExpr(key)
            matching = [route for known, route in readable.items() if expression.intersects(zenoh.KeyExpr(known))]
            # A picture is drawn only for those who ask for one, not for a query of everything.
            return (
                matching
                if key.endswith("/overlay")
                else [route for route in matching if route.lane is not QueryLane.DRAWING]
            )
        address = self._keys.parse(key)
        if address.resource == "windows" and address.argument is not None:
            return [self._metered(Route(key, partial(_window, self._pairs[pair], address.argument), QueryLane.FILES))]
        if address.resource == "command":
            return [Route(key, partial(self._command_handler.handle, pair, str(address.argument)), QueryLane.COMMANDS)]
        if address.resource == "evidence" and address.argument is not None:
            return [self._metered(Route(key, partial(_event, self._pairs[pair], address.argument), QueryLane.FILES))]
        raise UsageError("`alive` is a liveliness token: ask for liveliness")

    def _find_of_rig(self, key: str) -> Sequence[Route]:
        """The routes for a key, or a key expression, below that of the rig. The rig's own key has another route.

        Raises:
            UsageError: no route answers it.
        """
        if key == self._keys.rig or _has_wildcard(key):
            return []
        address = self._keys.parse(key)
        if address.resource != "command":
            raise UsageError("the rig takes commands; the estimate of the whole rig is at `rig`")
        command = Route(
            key, partial(self._command_handler.handle, bus_keys.RIG, str(address.argument)), QueryLane.COMMANDS
        )
        return [self._timed(command, "command")]

    def _find_last(self, pair: str) -> Callable[[str], Sequence[Route]]:
        """A function that finds the route for the last word of a pair, for queries of that word or of all last words.
        It finds none for queries of something else about a pair that happens to be called `last`."""
        route = self._timed(Route(self._keys.last(pair), partial(self._last, pair), QueryLane.AT_ONCE), bus_keys.LAST)
        return partial(_of_last_word, route)

    def _last(self, pair: str, request: Request) -> Answer:
        return self._heartbeats.answer(pair, _format(request))

    def _find_unknown(self, key: str) -> Sequence[Route]:
        """No routes. Does not raise if another queryable answers, because a session hands a query to all that match.

        Raises:
            UsageError: the key names no pair of this vehicle.
        """
        pair = key.removeprefix(f"{self._keys.root}/").partition("/")[0]
        if _has_wildcard(key) or key in self._vehicle_routes or pair in (*self._pairs, bus_keys.RIG, bus_keys.LAST):
            return []
        raise UsageError(f"no such pair or resource; pairs served here: {', '.join(self._pairs)}")

    def _readable(self, pair: AnyPairAnswers) -> dict[str, Route]:
        keys, name = self._keys, pair.name
        routes = (
            Route(keys.extrinsic(name), partial(_extrinsic, pair), QueryLane.AT_ONCE),
            Route(keys.health(name), partial(_health, pair), QueryLane.AT_ONCE),
            self._metered(Route(keys.history(name), partial(_history, pair), QueryLane.FILES)),
            Route(keys.windows(name), partial(_windows, pair), QueryLane.FILES),
            Route(keys.evidence(name), partial(_events, pair), QueryLane.FILES),
            self._metered(Route(keys.overlay(name), partial(_overlay, pair), QueryLane.DRAWING)),
        )
        return {route.key: route for route in routes}

    def _metered(self, route: Route) -> Route:
        """The same route, as far as the uplink allows."""
        resource = self._keys.parse(route.key).resource

        def answer(request: Request) -> Answer:
            self._uplink.admit(resource)
            answer = route.answer(request)
            self._uplink.count_sent(resource, len(answer.payload))
            return answer

        return replace(route, answer=answer)


def _status(vehicle: VehicleReplies, request: Request) -> Answer:
    return vehicle.status.answer(_format(request))


def _config(vehicle: VehicleReplies, request: Request) -> Answer:
    return vehicle.config.answer(_format(request))


def _rig(rig: RigAnswers, request: Request) -> Answer:
    return rig.answer(_format(request))


def _metrics(metrics: Callable[[], bytes], request: Request) -> Answer:
    del request
    return Answer(metrics(), metrics_text.ENCODING)


def _health(pair: AnyPairAnswers, request: Request) -> Answer:
    return pair.health(_format(request))


def _windows(pair: AnyPairAnswers, request: Request) -> Answer:
    return pair.calibrated.windows(_format(request))


def _window(pair: AnyPairAnswers, window_id: str, request: Request) -> Answer:
    selector = bus_keys.parse_range_selector(request.parameters)
    return Answer(pair.calibrated.read_window(window_id, selector.offset, selector.length), OCTETS)


def _events(pair: AnyPairAnswers, request: Request) -> Answer:
    return answer_of(pair.calibrated.events(), _format(request))


def _event(pair: AnyPairAnswers, event_id: str, request: Request) -> Answer:
    selector = bus_keys.parse_evidence_selector(request.parameters)
    if selector.overlay is not None:
        return Answer(pair.calibrated.event_overlay(event_id, selector.overlay), JPEG)
    return answer_of(pair.calibrated.event(event_id), selector.format)


def _extrinsic(pair: AnyPairAnswers, request: Request) -> Answer:
    selector = bus_keys.parse_extrinsic_selector(request.parameters, FORMATS)
    if selector.export is None:
        return pair.calibrated.extrinsic(selector.format)
    return pair.calibrated.exported(selector.export, ExportFrames(selector.parent, selector.child))


def _overlay(pair: AnyPairAnswers, request: Request) -> Answer:
    selector = bus_keys.parse_overlay_selector(request.parameters)
    return Answer(pair.calibrated.overlay(selector.window_id, nominal=selector.at == "nominal"), JPEG)


def _history(pair: AnyPairAnswers, request: Request) -> Answer:
    selector = bus_keys.parse_history_selector(request.parameters)
    return answer_of(pair.calibrated.history(selector.since_ns, selector.until_ns, selector.limit), selector.format)


def _format(request: Request) -> bus_keys.Format:
    return bus_keys.parse_selector(request.parameters).format


def _always(route: Route, key: str) -> Sequence[Route]:
    del key
    return [route]


def _of_last_word(route: Route, key: str) -> Sequence[Route]:
    return [route] if key.split("/")[-2] == bus_keys.LAST else []


def _has_wildcard(key: str) -> bool:
    return "*" in key
