"""A mount that moves by one degree twice a pass, while the worker is killed, stopped, and answers rubbish: for how long
does the service say `healthy` of a pose that is wrong?"""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from campaign.drives import Drive, Truth
from campaign.figures import Figure, at_most, exactly, is_long, publish
from campaign.watching import PERIOD_S, Sample, Watch, as_rows, configured, longest, watching
from coec.geometry.se3 import Array

pytest.importorskip("embreex", reason="needs the optional extra `sim`")
pytestmark = pytest.mark.slow

DRIVE = Drive(1, 100, ("step:40:ry=1",))
"""Back again where the next pass begins."""
RUBBISH = Path(__file__).with_name("rubbish")
PATIENCE_S = 300.0


def rate() -> float:
    """Seconds of driving per second: what two cores that others use can follow."""
    return float(os.environ.get("CAMPAIGN_RATE", "2"))


def killed(watch: Watch, times: int, rng: np.random.Generator) -> int:
    """Kills the worker at random moments; how often there was one to kill."""
    done = 0
    for _ in range(times):
        watch.passing(float(rng.uniform(1.0, 12.0)))
        pid = watch.last.worker_pid
        if pid is not None and psutil.pid_exists(pid):
            os.kill(pid, signal.SIGKILL)
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


def test_never_healthy_for_long_while_wrong(tmp_path: Path) -> None:
    rng = np.random.default_rng(13)
    recording = DRIVE.recorded(tmp_path)
    truth = Truth(recording)
    flag = tmp_path / "rubbish"
    path = os.pathsep.join(filter(None, [str(RUBBISH), os.environ.get("PYTHONPATH")]))
    phases: dict[str, list[Sample]] = {}
    kills, stop_s, rubbish_s, passes = (50, 60.0, 60.0, 2) if is_long() else (3, 20.0, 20.0, 1)
    with watching(configured(tmp_path, DRIVE), truth, {"PYTHONPATH": path, "CAMPAIGN_RUBBISH": str(flag)}) as watch:

        def phase(name: str, first: int) -> None:
            phases[name] = watch.samples[first:]

        watch.play(recording, rate(), loop=True)
        assert watch.until(lambda sample: sample.state == "healthy", PATIENCE_S), watch.last
        threads = psutil.Process(watch.running.process.pid).num_threads()
        first = len(watch.samples)
        watch.passing(passes * DRIVE.seconds / rate())
        phase("without faults", first)
        first = len(watch.samples)
        done = killed(watch, kills, rng)
        phase("killed", first)
        before_a_step(watch, truth)
        first = len(watch.samples)
        stopped(watch, stop_s)
        phase("stopped", first)
        watch.passing(20.0 / rate())
        before_a_step(watch, truth)
        first = len(watch.samples)
        flag.touch()
        watch.passing(rubbish_s)
        phase("rubbish", first)
        flag.unlink()
        began_s = time.monotonic()
        first = len(watch.samples)
        well = watch.until(lambda sample: sample.state == "healthy" and not sample.blind, PATIENCE_S)
        recovery_s = (time.monotonic() - began_s) * rate()
        watch.passing(DRIVE.seconds / rate())
        phase("afterwards", first)
        threads_left = psutil.Process(watch.running.process.pid).num_threads()
        state = watch.ask(watch.keys.status)["state"]
        errors = watch.errors_logged()

    blind = {name: longest(samples, lambda sample: sample.blind, rate()) for name, samples in phases.items()}
    limit_s = blind["without faults"] + 3 * PERIOD_S
    figures = [
        at_most(f"`healthy` while wrong, {name} (sensor time)", limit_s, value, "s") for name, value in blind.items()
    ]
    figures += [
        exactly("kills that met a worker", kills, done),
        exactly("threads that died", 0, max(threads - threads_left, 0)),
        exactly("state of the service at the end", "running", state),
        Figure("recovers by itself (sensor time)", "yes", f"{'yes' if well else 'no'}, {recovery_s:.3g} s", well),
    ]
    details = {
        "rate": rate(),
        "poll_error_deg": float(_worst(phases["afterwards"]).max(initial=0.0)),
        "errors_logged": errors,
        "samples": {name: as_rows(samples) for name, samples in phases.items()},
    }
    publish("never_blind", tmp_path, figures, details)


def _worst(samples: list[Sample]) -> Array:
    return np.array([sample.error_deg for sample in samples if sample.error_deg is not None])
