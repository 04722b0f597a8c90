"""A mount that is right, on drives through tunnels, open roads and nights: what does the service say of it?"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from campaign.drives import Drive, Truth
from campaign.figures import Figure, at_most, exactly, is_long, publish
from campaign.health_timeline import WRONG_DEG, Transition, configured, most_per_minute, transitions, watching
from campaign.test_never_blind import rate

pytest.importorskip("embreex", reason="needs embreex")
pytestmark = pytest.mark.slow

SETTLED_S = 40
"""A first window has been taken when the first poor stretch begins."""
ALLOWED = ("healthy", "degraded", "stale")
PATIENCE_S = 300.0


def drives() -> list[Drive]:
    """Ten, each with all three in another order and of another length; two in the short form."""
    kinds = ("tunnel", "open_road", "night")
    selected = []
    for seed in range(10 if is_long() else 2):
        faults, begin_s = [], SETTLED_S
        for place in range(3 if is_long() else 2):
            end_s = begin_s + 12 + 3 * ((seed + place) % 4)
            faults.append(f"{kinds[(seed + place) % 3]}:{begin_s}-{end_s}")
            begin_s = end_s + 12
        selected.append(Drive(seed + 20, begin_s + 10, tuple(faults)))
    return selected


@pytest.mark.fault(
    "tunnels, open roads and nights with a mount that is right",
    "it is not accused; nothing changes without its reason, nor more than once a minute",
)
def test_a_right_mount_is_not_accused(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    result: dict[str, list[Transition]] = {}
    entries: dict[str, Any] = {}
    most_changes, worst_deg = 0, 0.0
    never_well = []
    for drive in drives():
        recording = drive.recorded(tmp_path)
        truth = Truth(recording)
        folder = tmp_path / f"drive{drive.seed}"
        with watching(configured(folder, drive), truth) as watch:
            watch.play_through(recording, rate(), PATIENCE_S + drive.seconds / rate())
            watch.passing(3.0)
            name = f"seed {drive.seed}: {', '.join(drive.faults)}"
            reported = transitions(watch.samples, truth.second)
            if not any(one.after == "healthy" for one in reported):
                never_well.append(drive.seed)
            first = next((place for place, one in enumerate(reported) if one.after == "healthy"), len(reported) - 1)
            result[name] = reported[first + 1 :]
            history = watch.query(watch.keys.history(watch.pair))["entries"]
            entries[name] = [one["entry"] for one in history if one["entry"]["kind"] == "state"]
            errors = [one.error_deg for one in watch.samples if one.error_deg is not None]
            worst_deg = max(worst_deg, *errors)
            most_changes = max(most_changes, most_per_minute(result[name]))
    for name, reported in result.items():
        print(f"\n{name}")
        for one in reported:
            print(f"  {one.second:6.1f} s  {one.before} -> {one.after}  {', '.join(one.reasons)}")
    accused = [one for reported in result.values() for one in reported if one.after not in ALLOWED]
    mute = [one for reported in result.values() for one in reported if one.after != "healthy" and not one.reasons]
    figures: list[Figure] = [
        exactly("drives that never were healthy", [], never_well),
        exactly("changes to anything but stale, degraded (and back)", 0, len(accused)),
        exactly("changes without a reason", 0, len(mute)),
        at_most("served pose off the truth", WRONG_DEG, worst_deg, "deg"),
        at_most("changes of health in any minute of sensor time", 1, most_changes, ""),
    ]
    details: dict[str, Any] = {
        "rate": rate(),
        "transitions": {name: [_row(one) for one in reported] for name, reported in result.items()},
        "history": entries,
    }
    record_property("figure", f"accused {len(accused)} times in {len(result)} drives, {worst_deg:.2f} deg off at most")
    publish("poor_stretches", tmp_path, figures, details)


def _row(one: Transition) -> dict[str, Any]:
    return {"second": one.second, "before": one.before, "after": one.after, "reasons": list(one.reasons)}
