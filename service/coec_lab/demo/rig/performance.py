"""Plays the acts of the demonstration of a rig, one after the other."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from coec.reports import console
from coec_lab.demo.daemon import DemoError
from coec_lab.demo.rig import report, story
from coec_lab.demo.rig.outcome import Outcome, is_over, outcome_of
from coec_lab.demo.rig.service import serving
from coec_lab.demo.rig.story import Act
from coec_lab.demo.rig.told import Asker, Told
from coec_lab.demo.rig.vehicle import RigVehicle, driving


def run(output: Path, *, as_json: bool) -> int:
    """Plays all acts; returns 1 if one did not come true.

    Raises:
        DemoError: the service does not start, answer or end.
        OutputError: a file cannot be written.
    """
    started_s = time.monotonic()
    console.say("demo: the street is built; on the first run of a machine kernels are compiled, for about a minute")
    acts: list[report.Performance] = []
    with driving() as vehicle, console.progress() as bars:
        task = bars.add_task("instants of the drives", total=len(story.ACTS) * len(vehicle.plan), note="")
        for act in story.ACTS:
            acts.append(_play(vehicle, act, lambda note: bars.update(task, advance=1, note=note)))
            bars.update(task, completed=len(acts) * len(vehicle.plan))
        as_built = vehicle.as_built
    files = report.write(output, as_built, acts)
    if as_json:
        console.print_json(report.document(acts, files, time.monotonic() - started_s))
    else:
        report.show(acts, files)
    return 0 if all(outcome.passed for outcome, _ in acts) else 1


def _play(vehicle: RigVehicle, act: Act, heard: Callable[[str], None]) -> tuple[Outcome, list[Told]]:
    """Plays an act, with a service of its own that knows nothing of other acts, until the story is told or the drive is
    over. `heard` is called for every instant.

    Raises:
        DemoError: the service does not start, answer or end, or looks at nothing.
    """
    said: list[Told] = []
    with serving(vehicle.as_built, story.LIDAR) as service:
        drawn = vehicle.frames(act)
        service.until_ready()
        teller = Asker(service)
        for frames in drawn:
            heard(f"{act.name}: {frames.second:.0f} s of driving")
            _hear(act, said, teller.hear(frames))
            if said and is_over(outcome_of(act, said), said[-1]):
                break
        else:
            _hear(act, said, teller.rest())
    if not said:
        raise DemoError("the service has looked at none of its pairs")
    return outcome_of(act, said), said


def _hear(act: Act, said: list[Told], new: list[Told]) -> None:
    """Keeps what is new, and says when the named sensors change."""
    for told in new:
        before = said[-1].named if said else None
        said.append(told)
        if before != told.named:
            console.say(f"demo: {act.name}: {told.second:5.1f} s of driving: {_words(told)}")


def _words(told: Told) -> str:
    return f"{' and '.join(sorted(told.named))} moved" if told.named else "nobody is said to have moved"
