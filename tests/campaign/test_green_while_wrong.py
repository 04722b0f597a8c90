"""Faults that the checks of the service see: for how long is it `healthy` over an extrinsic that is wrong?"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from campaign.drives import NS_PER_S, RATE_HZ, Drive, Truth, part
from campaign.figures import Figure, at_most, exactly, is_long, publish
from campaign.health_timeline import (
    PERIOD_S,
    Sample,
    Transition,
    as_rows,
    configured,
    most_per_minute,
    transitions,
    watching,
)
from campaign.test_never_blind import rate

pytest.importorskip("embreex", reason="needs embreex")
pytestmark = pytest.mark.slow

WRONG_DEG, WRONG_M = 1.0, 0.1
LIMIT_S = 3 * PERIOD_S + 2 / RATE_HZ
"""An acquitting check vouches until the third one after it is answered. That needs the newest pair of this check, which
is complete two images after its own."""
MINUTE_S = 60.0
PATIENCE_S = 300.0
SEED = 41
STANDS = (("go_s", "60"), ("stop_s", "7200"))
STOP_AND_GO = (("go_s", "20"), ("stop_s", "15"))


def through(scenario: Scenario, folder: Path, truth: Truth) -> list[Sample]:
    """Plays the drive from begin to end."""
    with watching(configured(folder, scenario.drive), truth) as watch:
        watch.play_through(scenario.drive.recorded(folder), rate(), _patience_s(scenario))
        return watch.samples


def with_the_service_off(scenario: Scenario, folder: Path, truth: Truth) -> list[Sample]:
    """Plays the drive, with the service off for a while around the fault."""
    recording, samples = scenario.drive.recorded(folder), []
    path = configured(folder, scenario.drive)
    off = (scenario.begin_s - 3.0, scenario.begin_s + 3.0)
    for name, begin_s, end_s in (("before", 0.0, off[0]), ("after", off[1], float(scenario.drive.seconds))):
        played = folder / f"{name}.mcap"
        part(recording, begin_s, end_s, 0.0, played)
        with watching(path, truth) as watch:
            watch.play_through(played, rate(), _patience_s(scenario))
            samples += watch.samples
    return samples


def with_a_rollback(scenario: Scenario, folder: Path, truth: Truth) -> list[Sample]:
    """Plays the drive, and at `begin_s` serves again what was served before the mount moved."""
    with watching(configured(folder, scenario.drive), truth) as watch:
        watch.play(scenario.drive.recorded(folder), rate())
        first: list[str] = []

        def goes_on(sample: Sample) -> bool:
            if sample.state == "healthy" and not first:
                first.append(watch.query(watch.keys.extrinsic(watch.pair))["window_id"])
            return truth.second(sample.stamp_ns) >= scenario.begin_s

        assert watch.until(goes_on, _patience_s(scenario))
        assert first, "it never was healthy before"
        before = len(watch.samples)
        watch.running.command("rollback", json.dumps({"to": first[0]}).encode())
        assert watch.until(lambda _: not watch.playing, _patience_s(scenario))
        return [*watch.samples[: before - 1], *watch.samples[before:]]


@dataclass(frozen=True, slots=True)
class Scenario:
    """A drive with a fault, and what must hold.

    Attributes:
        begin_s: second of the drive at which the fault begins.
        limit_s: sensor time for which health may be `healthy` while wrong, all together.
        wrong_deg, wrong_m: the served pose is wrong if it is so far from the truth; None: it is wrong from `begin_s`
            on, wherever it is, because the data cannot be trusted or no pose is right.
        named: codes of reasons; one of them is reported after the fault.
        never: codes of reasons that must not be reported.
        short: whether it belongs to the short form.
        play: plays the drive.
    """

    name: str
    drive: Drive
    begin_s: float
    limit_s: float = LIMIT_S
    wrong_deg: float | None = WRONG_DEG
    wrong_m: float | None = WRONG_M
    named: tuple[str, ...] = ()
    never: tuple[str, ...] = ()
    short: bool = False
    play: Callable[[Scenario, Path, Truth], list[Sample]] = through


IN_FORCE: dict[str, Any] = {"wrong_deg": None, "wrong_m": None}
OTHER_CAUSES = ("time_offset", "ego_motion_wrong")

SCENARIOS = (
    Scenario("3° while the vehicle stands", Drive(SEED, 115, ("step:75:rx=3",), STANDS), 75, short=True),
    Scenario(
        "3° while the service is off and the vehicle stands", Drive(SEED, 115, ("step:75:rx=3",), STANDS), 75,
        limit_s=0.0, play=with_the_service_off,
    ),
    Scenario(
        "a rollback to a pose that is 3° off, while the vehicle stands",
        Drive(SEED, 165, ("step:50:ry=3",), (("go_s", "120"), ("stop_s", "7200"))), 135,
        limit_s=0.0, play=with_a_rollback,
    ),
    Scenario("3° in stop-and-go traffic", Drive(SEED, 140, ("step:75:ry=3",), STOP_AND_GO), 75),
    Scenario(
        "3° while odometry reports a standing vehicle", Drive(SEED, 115, ("zero-ego:65", "step:75:ry=3")), 75,
        named=("ego_motion_wrong",), short=True,
    ),
    Scenario("40°", Drive(SEED, 115, ("step:70:ry=40",)), 70),
    Scenario("180°", Drive(SEED, 115, ("step:70:ry=180",)), 70),
    Scenario(
        "the LiDAR repeats its last sweep", Drive(SEED, 110, ("lidar_frozen:70",)), 70,
        named=("lidar_frozen",), short=True, **IN_FORCE,
    ),
    Scenario(
        "both drivers repeat their last frames, and odometry reports a standing vehicle",
        Drive(SEED, 110, ("frozen:70", "lidar_frozen:70", "zero-ego:70")), 70, named=("camera_frozen",), **IN_FORCE,
    ),
    Scenario(
        "10 cm, which windows with three degrees of freedom do not see", Drive(SEED, 180, ("step:70:tx=0.12",)), 70
    ),
    Scenario(
        "a mount that swings by 0.8°", Drive(SEED, 160, ("swing:70:rx=0.8,period_s=2.3",)), 70,
        limit_s=MINUTE_S, **IN_FORCE,
    ),
    Scenario(
        # A check sees the mean of a swing, which may be right by chance, once or twice.
        "a mount that swings by 1.5°", Drive(SEED, 120, ("swing:70:rx=1.5,period_s=2.3",)), 70,
        limit_s=LIMIT_S + 2 * PERIOD_S, short=True, **IN_FORCE,
    ),
    *(
        Scenario(
            f"a focal length that is {percent} % wrong", Drive(SEED, 90, (), (("intrinsics_off", percent),)), 0,
            named=("intrinsics_off",), never=OTHER_CAUSES, **IN_FORCE,
        )
        for percent in ("2", "5")
    ),
    Scenario(
        "a drift of 0.05° a minute", Drive(SEED, 1260, ("drift:60-1260:rx=1.0",)), 60,
        limit_s=0.0, wrong_deg=0.3, wrong_m=None,
    ),
)  # fmt: skip

RIGHT = (
    ("parked for an hour", Drive(SEED, 3700, (), STANDS)),
    ("twenty minutes of stop-and-go", Drive(SEED, 1260, (), STOP_AND_GO)),
)


@pytest.mark.fault(
    "steps at a standstill and in traffic, stuck odometry, frozen sensors, turned and loose mounts, another lens",
    "`healthy` until the third check after it is answered at most while the extrinsic is wrong",
)
def test_healthy_while_wrong(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    figures: list[Figure] = []
    details: dict[str, Any] = {}
    most_s = 0.0
    for number, scenario in enumerate(one for one in SCENARIOS if one.short or is_long()):
        folder = tmp_path / f"scenario{number}"
        folder.mkdir()
        truth = Truth(scenario.drive.recorded(folder))
        samples = [one for one in scenario.play(scenario, folder, truth) if one.stamp_ns > 0]
        blind_s = healthy_while_wrong(scenario, samples, truth)
        most_s = max(most_s, blind_s)
        figures += figures_of(scenario, samples, truth, blind_s)
        changes = transitions(samples, truth.second)
        _show(scenario.name, changes)
        details[scenario.name] = {"changes": [_row(one) for one in changes], "samples": as_rows(samples)}
    record_property("figure", f"for {most_s:.3g} s at most, in {len(details)} scenarios")
    publish("green_while_wrong", tmp_path, figures, {"rate": rate(), "scenarios": details})


@pytest.mark.skipif(not is_long(), reason="takes an hour and a half: CAMPAIGN=long")
def test_a_right_mount_stays_healthy(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    figures: list[Figure] = []
    details: dict[str, Any] = {}
    for name, drive in RIGHT:
        folder = tmp_path / name.replace(" ", "_")
        folder.mkdir()
        scenario = Scenario(name, drive, 0)
        truth = Truth(drive.recorded(folder))
        changes = transitions(through(scenario, folder, truth), truth.second)
        _show(name, changes)
        first = next((place for place, one in enumerate(changes) if one.after == "healthy"), len(changes))
        later = changes[first + 1 :]
        accused = [one for one in later if one.after not in ("healthy", "degraded")]
        figures += [
            exactly(f"{name}: becomes healthy", True, first < len(changes)),
            exactly(f"{name}: changes to anything but degraded (and back)", 0, len(accused)),
            at_most(f"{name}: changes in any minute", 1, most_per_minute(later), ""),
        ]
        details[name] = [_row(one) for one in changes]
    record_property("figure", f"{sum(map(len, details.values()))} changes in all")
    publish("right_mount", tmp_path, figures, {"rate": rate(), "changes": details})


def figures_of(scenario: Scenario, samples: Sequence[Sample], truth: Truth, blind_s: float) -> list[Figure]:
    """What must hold of a scenario."""
    name = scenario.name
    later = [one for one in samples if truth.second(one.stamp_ns) >= scenario.begin_s]
    reasons = {code for one in later if one.state != "healthy" for code in one.reasons}
    figures = [at_most(f"{name}: `healthy` while wrong (sensor time)", scenario.limit_s, blind_s, "s")]
    if scenario.begin_s > 0:
        before = [one.state for one in samples if truth.second(one.stamp_ns) < scenario.begin_s]
        figures.append(exactly(f"{name}: healthy before", True, "healthy" in before))
    if scenario.named:
        reported = ", ".join(sorted(reasons)) or "nothing"
        named = not reasons.isdisjoint(scenario.named)
        figures.append(Figure(f"{name}: reasons", " or ".join(scenario.named), reported, named))
    if scenario.never:
        wrongly = sorted(reasons.intersection(scenario.never))
        figures.append(exactly(f"{name}: reasons that are not true", [], wrongly))
    return figures


def healthy_while_wrong(scenario: Scenario, samples: Sequence[Sample], truth: Truth) -> float:
    """Sensor time, seconds, for which health was `healthy` while the extrinsic was wrong, all together."""

    def is_wrong(sample: Sample) -> bool:
        if truth.second(sample.stamp_ns) < scenario.begin_s:
            return False
        off = [
            error >= limit
            for error, limit in ((sample.error_deg, scenario.wrong_deg), (sample.error_m, scenario.wrong_m))
            if limit is not None and error is not None
        ]
        return any(off) if off else True

    return sum(
        (after.stamp_ns - before.stamp_ns) / NS_PER_S
        for before, after in pairwise(samples)
        if before.state == "healthy" and is_wrong(before)
    )


def _patience_s(scenario: Scenario) -> float:
    return PATIENCE_S + scenario.drive.seconds / rate()


def _show(name: str, changes: Sequence[Transition]) -> None:
    print(f"\n{name}")
    for one in changes:
        print(f"  {one.second:6.1f} s  {one.before} -> {one.after}  {', '.join(one.reasons)}")


def _row(one: Transition) -> dict[str, Any]:
    return {"second": one.second, "before": one.before, "after": one.after, "reasons": list(one.reasons)}
