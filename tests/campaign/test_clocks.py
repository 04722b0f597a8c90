"""Clocks that jump: stamps that step back, stamps an hour ahead, a state and windows from another time.

Between two runs, what a service sees of a wall clock that jumped is how far the stamps that it wrote lie from now, so
these are moved the other way: in `state.json` and in the times of the files. During a run `stepping_clock` moves it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from campaign import stepping_clock
from campaign.drives import Drive, Truth, part
from campaign.figures import Figure, at_most, exactly, is_long, publish
from campaign.health_timeline import (
    MIB,
    PERIOD_S,
    Sample,
    Watch,
    as_rows,
    configured,
    longest_unchecked,
    transitions,
    watching,
)
from campaign.test_never_blind import rate
from coec.io.storage import StateFile

pytest.importorskip("embreex", reason="needs embreex")
pytestmark = pytest.mark.slow

DRIVE = Drive(1, 100)
PATIENCE_S = 300.0
HOUR_S, DAY_S = 3600.0, 86_400.0
STALE_AFTER_S = 86_400.0
"""As the service has it unless told otherwise: an older result is not healthy."""
REST_S = 8.0
MEMORY_MIB = 20.0
UNCHECKED, MORE_MEMORY = "`healthy` without a completed check", "memory more than before"
REPORTED = ("unknown", "degraded")
STEPPING_CLOCK = Path(stepping_clock.__file__)
CLOCKS = {"-400 days": -400 * DAY_S, "+1 h": HOUR_S, "+100 days": 100 * DAY_S}


def settled(watch: Watch, recording: Path) -> None:
    """A first pass, after which all is well."""
    watch.play_through(recording, rate(), PATIENCE_S)
    assert watch.until(lambda sample: sample.state == "healthy", PATIENCE_S), watch.last


def windows_of(folder: Path) -> list[str]:
    """Names of the recorded windows."""
    return sorted(path.name for path in (folder / "state" / "windows").glob("*.mcap"))


def after_a_jump(what: str, samples: Sequence[Sample], begin_s: float) -> list[Figure]:
    """What must hold from the moment at which a clock jumped. Memory is compared at its most, with no more pairs
    that wait for the worker than before, or the fewest: they are what a busy computer adds, and go when judged."""
    before = [sample for sample in samples if sample.wall_s < begin_s]
    later = samples[len(before) :]
    seconds = {id(sample): (sample.wall_s - begin_s) * rate() for sample in later}
    reported = [seconds[id(sample)] for sample in later if sample.state in REPORTED and sample.reasons]
    checked = [seconds[id(sample)] for sample in later if sample.checks > later[0].checks]
    held = max(max(sample.held for sample in before), min(sample.held for sample in later))
    most_before = max(sample.rss_bytes for sample in before)
    most = max(sample.rss_bytes for sample in later if sample.held <= held)
    quiet = longest_unchecked(later, rate())
    first = f"after {reported[0]:.3g} s" if reported else "never"
    retained_up = bool(checked) and checked[0] <= 3 * PERIOD_S
    return [
        # Who goes on looking within three periods has nothing to be unknown about.
        Figure(
            f"{what}: unknown or degraded with its reason, unless it goes on looking",
            f"≤ {3 * PERIOD_S:g} s",
            f"{first}; next check {f'after {checked[0]:.3g} s' if checked else 'never'}",
            retained_up or bool(reported and reported[0] <= 3 * PERIOD_S),
        ),
        at_most(f"{what}: {UNCHECKED}", 3 * PERIOD_S + 1.0, quiet, "s"),
        exactly(f"{what}: healthy at the end", "healthy", later[-1].state),
        at_most(f"{what}: {MORE_MEMORY}", MEMORY_MIB, (most - most_before) / MIB, "MiB"),
    ]


def worst(figures: Sequence[Figure]) -> str:
    """What was measured at its worst over all jumps, for the table of faults."""

    def most(what: str) -> str:
        return max(
            (one.measured for one in figures if one.what.endswith(what)), key=lambda text: float(text.split()[0])
        )

    return f"{most(UNCHECKED)} without a check at most, memory {most(MORE_MEMORY)} more"


@pytest.mark.fault(
    "a recording that is played again, and stamps an hour ahead and back",
    "nothing is `healthy` for long without a check, all is well in the end, no window is lost, memory stays",
)
def test_stamps_that_jump(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    recording = DRIVE.recorded(tmp_path)
    truth = Truth(recording)
    figures: list[Figure] = []
    details: dict[str, Any] = {"rate": rate()}
    ahead_s = 60.0 if is_long() else 40.0
    last_s = DRIVE.seconds if is_long() else 60.0
    ahead = part(recording, 0.0, ahead_s, HOUR_S, tmp_path / "ahead.mcap")
    later = part(recording, 0.0, last_s, DRIVE.seconds + 80.0, tmp_path / "later.mcap")

    def played_again(watch: Watch) -> None:
        for number in (2, 3):
            first = watch.play_through(recording, rate(), PATIENCE_S)
            report(f"played again ({number})", watch, first)

    def an_hour_ahead(watch: Watch) -> None:
        first = watch.play_through(ahead, rate(), PATIENCE_S)
        report("a minute an hour ahead", watch, first)
        first = watch.play_through(later, rate(), PATIENCE_S)
        report("back from an hour ahead", watch, first)

    def report(what: str, watch: Watch, first: int) -> None:
        samples = watch.samples[first:]
        begin_s = next((one.wall_s for one in samples if one.stamp_ns != samples[0].stamp_ns), samples[0].wall_s)
        figures.extend(after_a_jump(what, watch.samples, begin_s))
        details[what] = {
            "transitions": [[one.second, one.before, one.after, list(one.reasons)]
                            for one in transitions(samples, truth.second)],
            "samples": as_rows(samples),
        }  # fmt: skip

    for name, jump in (("again", played_again), ("ahead", an_hour_ahead)):
        folder = tmp_path / name
        with watching(configured(folder, DRIVE), truth) as watch:
            settled(watch, recording)
            before = windows_of(folder)
            jump(watch)
            lost = sorted(set(before) - set(windows_of(folder)))
            figures.append(exactly(f"{name}: windows lost", [], lost))
    record_property("figure", worst(figures))
    publish("clocks_stamps", tmp_path, figures, details)


@pytest.mark.fault(
    "a wall clock that was 400 days behind, an hour or 100 days ahead at the start",
    "an old result is not `healthy`, one check makes it so, no window is lost",
)
def test_a_state_and_windows_of_another_time(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    recording = DRIVE.recorded(tmp_path)
    truth = Truth(recording)
    path = configured(tmp_path / "vehicle", DRIVE)
    folder = path.parent
    figures: list[Figure] = []
    details: dict[str, Any] = {"rate": rate()}
    with watching(path, truth) as watch:
        settled(watch, recording)
    # The window that was open at the stop is solved at the next start: done before the clock moves.
    with watching(path, truth) as watch:
        watch.passing(REST_S)
    state = folder / "state" / "state.json"
    retained = StateFile(state).load().body
    assert retained is not None
    times = {one: one.stat().st_mtime for one in (folder / "state" / "windows").glob("*.mcap")}
    assert times

    for number, (name, moved_s) in enumerate(CLOCKS.items()):
        # The drive goes on after the one before: only the wall clock jumps here.
        onward = part(recording, 0.0, DRIVE.seconds, 200.0 * (number + 1), tmp_path / f"onward{number}.mcap")
        # The clock moved by so much: what was written before lies as far the other way.
        _moved(state, retained, -moved_s)
        for window, written_s in times.items():
            if window.exists():
                os.utime(window, (written_s - moved_s, written_s - moved_s))
        before = windows_of(folder)
        with watching(path, truth) as watch:
            start = watch.observation()
            watch.play_through(onward, rate(), PATIENCE_S)
            samples = watch.samples
            first_check = next((one for one in samples if one.checks > start.checks), None)
            lost = sorted(set(before) - set(windows_of(folder)))
            right = first_check is not None and any(
                one.state == "healthy" and one.checks <= first_check.checks + 1
                for one in samples
                if one.wall_s >= first_check.wall_s
            )
        from_future = moved_s < 0
        figures += [
            Figure(
                f"clock {name}: state at the start, nothing looked at yet",
                "unknown or degraded, with a reason" if from_future else "not healthy, or of that age",
                f"{start.state} ({', '.join(start.reasons) or 'no reason'}), age {start.age_s} s",
                (start.state in REPORTED and bool(start.reasons)) if from_future else _plausible(start, moved_s),
            ),
            Figure(f"clock {name}: right again after one check", "yes", "yes" if right else "no", right),
            exactly(f"clock {name}: windows lost", [], lost),
        ]
        details[name] = {"samples": as_rows(samples), "windows": before}
    record_property("figure", f"{len(CLOCKS)} clocks, {len(times)} windows")
    publish("clocks_state", tmp_path, figures, details)


@pytest.mark.fault(
    "a wall clock that steps by -400 days, an hour or 100 days while the service runs",
    "nothing is `healthy` for long without a check, all is well in the end, no window is lost, memory stays",
)
def test_a_clock_that_steps_while_it_runs(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    recording = DRIVE.recorded(tmp_path)
    truth = Truth(recording)
    offset = tmp_path / "offset"
    stepping_clock.put(offset, 0.0)
    path = configured(tmp_path / "vehicle", DRIVE)
    figures: list[Figure] = []
    details: dict[str, Any] = {"rate": rate()}
    seconds = DRIVE.seconds if is_long() else 60.0
    with watching(path, truth, program=(sys.executable, str(STEPPING_CLOCK), str(offset))) as watch:
        settled(watch, recording)
        for number, (name, moved_s) in enumerate(CLOCKS.items()):
            onward = part(recording, 0.0, seconds, 200.0 * (number + 1), tmp_path / f"onward{number}.mcap")
            before = windows_of(path.parent)
            watch.play(onward, rate())
            assert watch.until(lambda _: not watch.playing, seconds / 2.0 / rate()) is False, "half of it is played"
            begin_s = watch.last.wall_s
            stepping_clock.put(offset, moved_s)
            assert watch.until(lambda _: not watch.playing, PATIENCE_S), "the player does not come to its end"
            figures += after_a_jump(f"wall clock {name} while it runs", watch.samples, begin_s)
            lost = sorted(set(before) - set(windows_of(path.parent)))
            figures.append(exactly(f"wall clock {name} while it runs: windows lost", [], lost))
            stepping_clock.put(offset, 0.0)
        details["samples"] = as_rows(watch.samples)
    record_property("figure", worst(figures))
    publish("clocks_running", tmp_path, figures, details)


def _plausible(start: Sample, moved_s: float) -> bool:
    """Who calls a restored state healthy knows how old it is."""
    return start.state != "healthy" or (start.age_s is not None and moved_s <= start.age_s < STALE_AFTER_S)


def _moved(state: Path, body: dict[str, Any], by_s: float) -> None:
    """Writes the state as if it had been written so much later."""
    by_ns = round(by_s * 1e9)
    pairs = {name: _with(pair, lambda value: value + by_ns) for name, pair in body["pairs"].items()}
    file = StateFile(state)
    file.load()
    file.save({**body, "pairs": pairs})


def _with(pair: dict[str, Any], moved: Callable[[int], int]) -> dict[str, Any]:
    known = {name: moved(pair[name]) for name in pair if name.endswith("wall_ns") and pair[name] is not None}
    assert known, "the state holds no wall clock"
    return {**pair, **known}
