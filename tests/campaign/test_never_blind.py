"""A mount that moves by one degree twice a pass, while the worker is killed, stopped, and answers rubbish: for how long
does the service say `healthy` of a pose that is wrong?"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil
import pytest

from campaign.drives import Drive, Truth
from campaign.figures import Figure, at_most, exactly, is_long, publish
from campaign.health_timeline import (
    PERIOD_S,
    Sample,
    ServiceFinishedError,
    Watch,
    as_rows,
    configured,
    longest,
    transitions,
    watching,
)

pytest.importorskip("embreex", reason="needs embreex")
pytestmark = pytest.mark.slow

DRIVE = Drive(1, 100, ("step:40:ry=1",))
"""Back again where the next pass begins."""
RUBBISH = Path(__file__).with_name("rubbish")
PATIENCE_S = 300.0


def rate() -> float:
    """Seconds of driving per second: what two cores that others use can follow."""
    return float(os.environ.get("CAMPAIGN_RATE", "2"))


def killed(watch: Watch, times: int, rng: np.random.Generator) -> int:
    """Kills the worker at so many random moments, whatever it does then; how often there was one to kill."""
    done = 0
    for _ in range(times):
        watch.passing(float(rng.uniform(1.0, 12.0)))
        assert watch.until(lambda sample: sample.worker_pid is not None, PATIENCE_S), "no worker comes any more"
        with suppress(psutil.NoSuchProcess):
            psutil.Process(watch.last.worker_pid).kill()
            done += 1
    return done


def before_a_step(watch: Watch, truth: Truth) -> None:
    """Watches until the mount is about to move."""
    assert watch.until(lambda sample: 35.0 < truth.second(sample.stamp_ns) < 39.0, PATIENCE_S)


def stopped(watch: Watch, seconds: float) -> None:
    """Stops the worker, and lets whichever of that number is left go on."""
    pid = watch.last.worker_pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    watch.passing(seconds)
    if psutil.pid_exists(pid):
        os.kill(pid, signal.SIGCONT)


@dataclass
class Course:
    """What happened, phase by phase.

    Attributes:
        kills: how often there was a worker to kill.
        threads_lost: of the service, over all phases.
        recovery_s: sensor time from the last fault to a right pose called healthy; None: not within the patience.
        finished: why the service ended before its time; None if it did not.
    """

    phases: dict[str, list[Sample]] = field(default_factory=dict)
    kills: int = 0
    threads_lost: int = 0
    recovery_s: float | None = None
    state: str = "ended"
    finished: str | None = None

    @contextmanager
    def phase(self, watch: Watch, name: str) -> Iterator[None]:
        """Keeps what is seen in it, also where it ends early."""
        first = len(watch.samples)
        try:
            yield
        finally:
            self.phases[name] = watch.samples[first:]


def run(watch: Watch, truth: Truth, flag: Path, course: Course) -> None:
    """All phases, one after the other, on a drive that goes round and round."""
    kills, seconds, passes = (50, 60.0, 2) if is_long() else (3, 20.0, 1)
    a_pass_s = DRIVE.seconds / rate()
    assert watch.until(lambda sample: sample.state == "healthy", PATIENCE_S), watch.last
    service = psutil.Process(watch.running.process.pid)
    threads = service.num_threads()
    with course.phase(watch, "without faults"):
        watch.passing(passes * a_pass_s)
    with course.phase(watch, "killed"):
        course.kills = killed(watch, kills, np.random.default_rng(13))
    before_a_step(watch, truth)
    with course.phase(watch, "stopped"):
        stopped(watch, seconds)
    watch.passing(20.0 / rate())
    before_a_step(watch, truth)
    with course.phase(watch, "rubbish"):
        flag.touch()
        watch.passing(seconds)
        flag.unlink()
    with course.phase(watch, "afterwards"):
        began_s = time.monotonic()
        if watch.until(lambda sample: sample.state == "healthy" and not sample.blind, PATIENCE_S):
            course.recovery_s = (time.monotonic() - began_s) * rate()
        watch.passing(a_pass_s)
    course.threads_lost = max(threads - service.num_threads(), 0)
    course.state = watch.query(watch.keys.status)["state"]


@pytest.mark.fault(
    "a mount that moves by a degree again and again, while the worker is killed, stopped and answers rubbish",
    "`healthy` while wrong for three periods longer than without the faults at most; it recovers by itself",
)
def test_never_healthy_for_long_while_wrong(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    recording = DRIVE.recorded(tmp_path)
    truth = Truth(recording)
    flag = tmp_path / "rubbish"
    path = os.pathsep.join(filter(None, [str(RUBBISH), os.environ.get("PYTHONPATH")]))
    course = Course()
    with watching(configured(tmp_path, DRIVE), truth, {"PYTHONPATH": path, "CAMPAIGN_RUBBISH": str(flag)}) as watch:
        watch.play(recording, rate(), loop=True)
        try:
            run(watch, truth, flag, course)
        except ServiceFinishedError as error:
            course.finished = str(error)
        errors = watch.errors_logged()

    blind = {name: longest(samples, lambda sample: sample.blind, rate()) for name, samples in course.phases.items()}
    limit_s = blind["without faults"] + 3 * PERIOD_S
    figures = [
        at_most(f"`healthy` while wrong, {name} (sensor time)", limit_s, value, "s") for name, value in blind.items()
    ]
    recovery = "no" if course.recovery_s is None else f"after {course.recovery_s:.3g} s"
    figures += [
        Figure("moments at which a worker was killed", "some", str(course.kills), course.kills > 0),
        exactly("threads of the service that died", 0, course.threads_lost),
        Figure("the service goes on", "running", course.finished or course.state, course.state == "running"),
        Figure("recovers by itself (sensor time)", "yes", recovery, course.recovery_s is not None),
    ]
    details = {
        "rate": rate(),
        "errors_logged": errors,
        "changes": {name: len(transitions(samples, truth.second)) for name, samples in course.phases.items()},
        "samples": {name: as_rows(samples) for name, samples in course.phases.items()},
    }
    record_property("figure", f"for {max(blind.values()):.3g} s at most; recovers {recovery}")
    publish("never_blind", tmp_path, figures, details)
