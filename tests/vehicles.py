"""A vehicle that answers on a real session: one pair with the threads that it has in the service, and a worker that
knows the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from coec.adapters.tls.conversation import CommandListener, credentials_of
from coec.adapters.zenoh.bus import Bus, open_session
from coec.adapters.zenoh.reach import Reach
from coec.adapters.zenoh.settings import settings_of
from coec.config import AuthorityConfig, LimitsConfig, UplinkConfig, ZenohConfig
from coec.runtime.api.authority import Authority
from coec.runtime.api.configuration import redacted_configuration
from coec.runtime.api.last_words import Heartbeats
from coec.runtime.api.reception import CommandHandler, CommandRules
from coec.runtime.api.rig import RigAnswers
from coec.runtime.api.routes import VehicleRoutes
from coec.runtime.api.snapshots import SerializedReply
from coec.runtime.api.uplink import Uplink
from coec.schemas.keys import Keys
from pair_bench import PairBench
from statuses import status_reply

VEHICLE = "vehicle"
PAIR = "front"
KEYS = Keys("coec", VEHICLE)
VEHICLE_LIMITS = LimitsConfig()
STOP_TIMEOUT_S = 20.0


@dataclass(frozen=True)
class ServingVehicle:
    """What answers, and what it is made of."""

    bench: PairBench
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


def serve(bench: PairBench, config: ZenohConfig, bus: Bus) -> ServingVehicle:
    """Declare all that a vehicle answers, as the daemon does."""
    pair, authority = bench.pair, bench.config.authority
    credentials = credentials_of(authority)
    rules = CommandRules(
        Authority(authority, Reach(settings_of(config, VEHICLE_LIMITS)).exposure),
        None if credentials is None else CommandListener(credentials),
    )
    command_handler = CommandHandler(rules, {pair.name: pair.commands})
    document = SerializedReply.of_document(
        {"schema_version": 1, "config_hash": "0", "config": redacted_configuration(bench.config)}
    )

    def status() -> SerializedReply:
        reply = status_reply(vehicle=VEHICLE, pairs=(pair.answers.status(),))
        return SerializedReply.of(reply)

    uplink = Uplink(UplinkConfig())
    heartbeats = Heartbeats(KEYS, "0", UplinkConfig(), bus.publish)
    VehicleRoutes(
        KEYS,
        {pair.name: pair.answers},
        command_handler,
        status,
        lambda: b"# EOF\n",
        lambda: document,
        RigAnswers(KEYS, bus.publish),
        heartbeats,
        uplink,
    ).declare(bus)
    heartbeats.renew("running", "0", [pair.answers])
    for name, answer in (("extrinsic", pair.answers.extrinsic), ("health", pair.answers.health)):
        bus.publish(f"{KEYS.root}/{pair.name}/{name}", answer("msgpack"))
    bus.declare_alive(KEYS.alive(pair.name))
    return ServingVehicle(bench, bus, uplink)


@contextmanager
def serving(
    folder: Path,
    config: ZenohConfig,
    authority: AuthorityConfig | None = None,
    before: Callable[[PairBench], None] = lambda _: None,
) -> Iterator[ServingVehicle]:
    """A vehicle in a session of its own, until the end of the block; `before` is what it did before it was asked."""
    bench = PairBench(folder, vehicle=VEHICLE, authority=authority)
    before(bench)
    bus = Bus(open_session(config, VEHICLE_LIMITS))
    threads = (*bus.threads, bench.intake.thread, bench.pair.manager.thread)
    for thread in threads:
        thread.start()
    try:
        yield serve(bench, config, bus)
    finally:
        bus.undeclare_inputs()
        bench.intake.request_stop()
        bench.pair.manager.request_stop()
        for thread in threads:
            thread.request_stop()
        assert all(thread.join(STOP_TIMEOUT_S) for thread in threads)
        bus.undeclare_queryables()
        assert bus.close(STOP_TIMEOUT_S)
