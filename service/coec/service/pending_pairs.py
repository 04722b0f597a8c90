"""Awaited pairs, whose configuration leaves out what the bus will tell. The service listens for the missing parts,
answers for these pairs meanwhile, and hands each over when everything is found.

Used on the daemon's main thread; the thread of `discovery_listener` reads what is received.
"""

import logging
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from coec.calibration.types import Reason
from coec.config import Config, PairConfig
from coec.errors import ConfigError
from coec.io.rig_files import check_given, rig_of
from coec.io.system import ServiceThread
from coec.io.zenoh.bus import Bus, InputSample
from coec.io.zenoh.ros_node import RosSide
from coec.service import discovery
from coec.service.api.pair_answers import PendingPairAnswers
from coec.service.discovery_listener import DiscoveryListener, NominalStatus
from coec.service.vehicle_context import VehicleContext

_log = logging.getLogger(__name__)


class _SharedSubscription:
    """One subscription to a topic or key, shared by all pairs that wait for it."""

    def __init__(self) -> None:
        self._takers: dict[str, Callable[[InputSample], None]] = {}
        self.end: Callable[[], None] = lambda: None

    @property
    def is_new(self) -> bool:
        """Whether only one pair has joined."""
        return len(self._takers) == 1

    def join(self, name: str, take: Callable[[InputSample], None]) -> None:
        """A pair waits for it."""
        self._takers = {**self._takers, name: take}

    def leave(self, name: str) -> bool:
        """A pair waits no longer. If it was the last, ends the subscription and returns True."""
        waited = name in self._takers
        self._takers = {other: take for other, take in self._takers.items() if other != name}
        if not waited or self._takers:
            return False
        self.end()
        return True

    def take(self, sample: InputSample) -> None:
        """Hands a sample to every pair that waits; called on the network's thread."""
        for taker in self._takers.values():
            taker(sample)


class PendingPairs:
    """The awaited pairs of a vehicle.

    Attributes:
        answers: answers of each pair that is still awaited. The dictionary is replaced as a whole, so that other
            threads may iterate over it.
    """

    def __init__(self, config: Config, folder: Path) -> None:
        """`config` is the configuration as it was read, `folder` the state directory, which holds earlier findings.

        Raises:
            ConfigError: what the configuration gives for an awaited pair cannot be used.
        """
        for pair in config.awaited:
            check_given(pair)
        self._requested = {pair.name: pair for pair in config.awaited}
        self._read = config
        self._store = discovery.DiscoveryStore(folder)
        earlier = self._store.load(config)
        self._listener = DiscoveryListener(config, earlier)
        self._streams: dict[str, _SharedSubscription] = {}
        self._context: VehicleContext
        self.answers: dict[str, PendingPairAnswers] = {}

    @property
    def threads(self) -> tuple[ServiceThread, ...]:
        """The running threads; none if no pair is awaited."""
        return (self._listener.thread,) if self._requested else ()

    def complete(self, config: Config) -> Config:
        """The configuration as it was read, completed by what has been found for pairs that still ask for the same."""
        return discovery.completed(
            config, {name: discovered.pair for name, discovered in self._store.load(config).items()}
        )

    def nominal(self, pair: str) -> NominalStatus:
        """Where a pair's nominal calibration comes from. Any thread."""
        return self._listener.nominal(pair)

    def origins(self) -> dict[str, dict[str, str]]:
        """Where each found value comes from, by pair and place in the configuration."""
        by_pair = {name: dict(self.nominal(name).origins) for name in self._requested}
        return {name: origins for name, origins in by_pair.items() if origins}

    def open(self, config: Config, context: VehicleContext) -> Mapping[str, PendingPairAnswers]:
        """Makes answers for the pairs that are still awaited in this configuration."""
        self._context = context
        if self._requested:
            context.disk_writer.register(self._store)
        self.answers = {pair.name: PendingPairAnswers(pair, config.vehicle, context) for pair in config.awaited}
        return self.answers

    def listen(self, bus: Bus, side: RosSide) -> None:
        """Subscribes to what the configuration leaves out; `side` knows the keys. `/tf_static` and `CameraInfo` stay
        subscribed for as long as the service runs."""
        for thread in self.threads:
            thread.start()
        if any(discovery.needs_transforms(pair) for pair in self._requested.values()):
            bus.subscribe_latched(side.input_of_static_transforms(), self._listener.take_transforms)
        infos: dict[str, _SharedSubscription] = {}
        for name, pair in self._requested.items():
            topic = discovery.info_topic_of(pair)
            if topic is not None:
                shared = infos.setdefault(topic, _SharedSubscription())
                shared.join(name, partial(self._listener.take_info, name))
                if shared.is_new:
                    bus.subscribe_latched(side.input_of_info(topic), shared.take)
            for kind, stream in pair.streams.items() if name in self.answers else ():
                shared = self._streams.setdefault(stream.place, _SharedSubscription())
                shared.join(name, partial(self._listener.take_frame, name, kind))
                if shared.is_new:
                    shared.end = bus.subscribe(side.input_of(stream), shared.take)

    def pop_discovered(self) -> dict[str, PairConfig]:
        """Pairs of which everything is known by now and that can be built. Each is returned once."""
        good: dict[str, PairConfig] = {}
        for name, discovered in self._listener.ready().items():
            if name not in self.answers:
                continue
            try:
                rig_of(discovered.pair)
            except ConfigError as error:
                self.refuse(name, str(error))
                continue
            self._admit(name, discovered)
            good[name] = discovered.pair
        return good

    def _admit(self, name: str, discovered: discovery.DiscoveredPair) -> None:
        for place, shared in list(self._streams.items()):
            if shared.leave(name):
                del self._streams[place]
        self.answers = {other: answers for other, answers in self.answers.items() if other != name}
        self._store.update(discovered, self._requested[name], self._read, time.time_ns())
        self._context.disk_writer.write(self._store)
        self._listener.end(name, discovered)

    def refuse(self, name: str, why: str) -> None:
        """What was found for a pair cannot be used. The pair is awaited again until something else is heard."""
        _log.error(f"the discovered calibration of a pair cannot be used: {why}", extra={"fields": {"pair": name}})
        self._listener.end(
            name, Reason(discovery.CANNOT_BE_BUILT, f"The discovered calibration cannot be used: {why}.")
        )

    def renew(self) -> None:
        """Renews the answers; called once a second."""
        for answers in self.answers.values():
            answers.renew()

    def fail(self, reason: Reason) -> None:
        """The service is about to end, for this reason."""
        for answers in self.answers.values():
            answers.fail(reason)
