"""Ten thousand vehicles on one router: nothing is lost where they say what they usually do, and memory is bounded.

    tests/run --all -k fleet_scale        two to three minutes
Figures and what follows from them for larger fleets are in docs/fleet.md.
"""

from __future__ import annotations

from collections.abc import Callable

from bench.fleet_scale import main

VEHICLES = 10_000
LOST = 0.005
"""Share of words that a router may drop while it is busy: each is said again within its period."""


def test_one_router_carries_the_text_of_ten_thousand_vehicles(
    record_property: Callable[[str, object], None],
) -> None:
    reported = main(VEHICLES)
    record_property("figure", reported)
    assert reported["steady"]["heard"] >= (1.0 - LOST) * VEHICLES
    assert reported["late_watcher_knows"] == VEHICLES
    assert reported["board"]["known"] == VEHICLES
    assert reported["board"]["refused"] == {}
    for name in ("router_rss_mb_end", "keeper_rss_mb", "watcher_rss_mb"):
        assert reported[name] < 1000.0, name
