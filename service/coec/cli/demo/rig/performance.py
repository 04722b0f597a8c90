"""Plays the acts of the demonstration of a rig, one after the other."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from coec.cli.demo.rig import report, story
from coec.cli.demo.rig.outcome import Outcome, is_over, outcome_of
from coec.cli.demo.rig.story import Act
from coec.cli.demo.rig.told import Beholder, Told
from coec.cli.demo.rig.vehicle import RigVehicle
from coec.reports import console


def run(output: Path, *, as_json: bool) -> int:
    """Plays all of it; 1 if an act did not come true.

    Raises:
        CalibrationError: a picture cannot be decoded.
        OutputError: a file cannot be written.
    """
    started_s = time.monotonic()
    console.say("demo: the street is built; on the first run of a machine kernels are compiled, for a minute")
    vehicle = RigVehicle()
    acts: list[report.Performance] = []
    with console.progress() as bars:
        task = bars.add_task("instants of the drives", total=len(story.ACTS) * len(vehicle.plan), note="")
        for act in story.ACTS:
            acts.append(_play(vehicle, act, lambda note: bars.update(task, advance=1, note=note)))
            bars.update(task, completed=len(acts) * len(vehicle.plan))
    files = report.write(output, vehicle.as_built, acts)
    if as_json:
        console.print_json(report.document(acts, files, time.monotonic() - started_s))
    else:
        report.show(acts, files)
    return 0 if all(outcome.passed for outcome, _ in acts) else 1


def _play(vehicle: RigVehicle, act: Act, heard: Callable[[str], None]) -> tuple[Outcome, list[Told]]:
    """Until the story is told, or the drive is over; `heard` is told of every instant."""
    teller = Beholder(vehicle.as_built, story.LIDAR)
    said: list[Told] = []
    outcome = outcome_of(act, said)
    for frames in vehicle.frames(act):
        heard(f"{act.name}: {frames.second:.0f} s of driving")
        for told in teller.hear(frames):
            before = said[-1] if said else None
            said.append(told)
            if before is None or before.named != told.named:
                console.say(f"demo: {act.name}: {told.second:5.1f} s of driving: {_words(told)}")
        outcome = outcome_of(act, said)
        if said and is_over(outcome, said[-1]):
            break
    return outcome, said


def _words(told: Told) -> str:
    return f"{' and '.join(sorted(told.named))} moved" if told.named else "nobody is said to have moved"
