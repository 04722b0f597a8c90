"""A vehicle that answers on a real session: one pair with the threads that it has in the service, and a worker that
knows the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from coec.adapters.tls.conversation import Listener, credentials_of
from coec.adapters.zenoh.bus import Bus, open_session
from coec.adapters.zenoh.reach import Reach
from coec.adapters.zenoh.settings import settings_of
from coec.config import AuthorityConfig, LimitsConfig, UplinkConfig, ZenohConfig
from coec.runtime.api.authority import Authority
from coec.runtime.api.configuration import shown
from coec.runtime.api.last_words import LastWords
from coec.runtime.api.reception import Reception, Rules
from coec.runtime.api.rig import RigAnswers
from coec.runtime.api.routes import VehicleAnswers
from coec.runtime.api.snapshots import Snapshot
from coec.runtime.api.uplink import Uplink
from coec.schemas.keys import Keys
from pair_bench import Bench
from statuses import a_status

VEHICLE = "vehicle"
PAIR = "front"
KEYS = Keys("coec", VEHICLE)
LIMITS = LimitsConfig()
END_S = 20.0


@dataclass(frozen=True)
class Vehicle:
    """What answers, and what it is made of."""

    bench: Bench
    bus: Bus
    uplink: Uplink

    @property
    def is_held(self) -> bool:
        """Whether the last `hold` was one that held."""
        return self.bench.store.state.hold is not None

    @property
    def commands(self) -> dict[str, int]:
        """Counts, as `status` says them."""
        return self.bench.answers.status().commands


def serve(bench: Bench, config: ZenohConfig, bus: Bus) -> Vehicle:
    """Declare all that a vehicle answers, as the daemon does."""
    pair, authority = bench.pair, bench.config.authority
    credentials = credentials_of(authority)
    rules = Rules(
        Authority(authority, Reach(settings_of(config, LIMITS)).outside),
        None if credentials is None else Listener(credentials),
    )
    reception = Reception(rules, {pair.name: pair.commands})
    document = Snapshot.of_document({"schema_version": 1, "config_hash": "0", "config": shown(bench.config)})

    def status() -> Snapshot:
        told = a_status(vehicle=VEHICLE, pairs=(pair.answers.status(),))
        return Snapshot.of(told)

    uplink = Uplink(UplinkConfig())
    words = LastWords(KEYS, "0", UplinkConfig(), bus.publish)
    VehicleAnswers(
        KEYS,
        {pair.name: pair.answers},
        reception,
        status,
        lambda: b"# EOF\n",
        lambda: document,
        RigAnswers(KEYS, bus.publish),
        words,
        uplink,
    ).declare(bus)
    words.renew("running", "0", [pair.answers])
    for name, answer in (("extrinsic", pair.answers.extrinsic), ("health", pair.answers.health)):
        bus.publish(f"{KEYS.root}/{pair.name}/{name}", answer("msgpack"))
    bus.declare_alive(KEYS.alive(pair.name))
    return Vehicle(bench, bus, uplink)


@contextmanager
def serving(
    folder: Path,
    config: ZenohConfig,
    authority: AuthorityConfig | None = None,
    before: Callable[[Bench], None] = lambda _: None,
) -> Iterator[Vehicle]:
    """A vehicle in a session of its own, until the end of the block; `before` is what it did before it was asked."""
    bench = Bench(folder, vehicle=VEHICLE, authority=authority)
    before(bench)
    bus = Bus(open_session(config, LIMITS))
    threads = (*bus.threads, bench.intake.thread, bench.pair.decider.thread)
    for thread in threads:
        thread.start()
    try:
        yield serve(bench, config, bus)
    finally:
        bus.undeclare_inputs()
        bench.intake.request_stop()
        bench.pair.decider.request_stop()
        for thread in threads:
            thread.request_stop()
        assert all(thread.join(END_S) for thread in threads)
        bus.undeclare_queryables()
        assert bus.close(END_S)
