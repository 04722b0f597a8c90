"""A service that is driven for a long time and watched from outside: what it serves, what it says of it, what it is."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import zenoh

from campaign.drives import Drive, Truth
from coec.config import CalibrationConfig, Config, LimitsConfig, MonitorConfig, PolicyConfig, WindowConfig, load_config
from coec.errors import CoecError
from coec.io.msgpack_frames import decode_ego
from coec.io.recordings.layouts import open_source
from coec.io.zenoh.query_client import query_one
from coec.reports.commented_yaml import commented_yaml
from coec.schemas.keys import Keys
from e2e.processes import (
    COMMAND,
    Service,
    added_to_environment,
    environment,
    free_endpoint,
    service,
    write_configuration,
)

PERIOD_S = 5.0
"""One check per so much sensor time."""
WRONG_DEG = 0.5
"""A served pose further from the truth than this is wrong."""
POLL_S = 0.2
ANSWER_S = 10.0
MIB = 2**20
FINISHED_S = 15.0


def configured(folder: Path, drive: Drive) -> Path:
    """A configuration for a drive: windows and checks as short as the demonstration's, everything else default."""
    path = write_configuration(
        folder,
        open_source(drive.source),
        free_endpoint(),
        calibration=CalibrationConfig(),
        # A drive that goes round steps more in a minute than a policy allows in a day.
        policy=PolicyConfig(apply="always"),
        window=WindowConfig(pairs=16, min_pairs=8, slice_s=32.0),
        monitor=MonitorConfig(period_s=PERIOD_S, pairs=5, min_pairs=4, urgent_slice_s=16.0),
    )
    config = load_config(path)
    # On a vehicle the player does not compete with the worker for the processor.
    worker = config.worker.model_copy(update={"niceness": 0})
    path.write_text(commented_yaml(config.model_copy(update={"worker": worker})))
    return path


class ServiceFinishedError(Exception):
    """The service is gone, although nobody told it to go."""


@dataclass(frozen=True, slots=True)
class Sample:
    """What was seen at one instant.

    Attributes:
        wall_s: steady clock of the one who watches.
        stamp_ns: sensor time of the newest ego-motion on the air.
        error_deg, error_m: of the served pose against the truth then; None without a truth.
        age_s: what health says of its last evaluation.
    """

    wall_s: float
    stamp_ns: int
    state: str
    reasons: tuple[str, ...]
    error_deg: float | None
    error_m: float | None
    age_s: float | None
    checks: int
    solved: int
    held: int
    worker: str
    worker_pid: int | None
    restarts: int
    rss_bytes: int

    @property
    def blind(self) -> bool:
        """Says that all is well, while it is not."""
        return self.state == "healthy" and self.error_deg is not None and self.error_deg > WRONG_DEG


@dataclass
class Watch:
    """One who watches a service.

    Attributes:
        samples: everything seen so far.
    """

    running: Service
    session: zenoh.Session
    config: Config
    path: Path
    truth: Truth | None = None
    samples: list[Sample] = field(default_factory=list)
    _stamp_ns: int = 0
    _player: subprocess.Popen[bytes] | None = None
    _next_s: float = 0.0

    @property
    def keys(self) -> Keys:
        return Keys(self.config.prefix, self.config.vehicle)

    @property
    def pair(self) -> str:
        return self.config.pairs[0].name

    @property
    def last(self) -> Sample:
        """The latest sample."""
        return self.samples[-1]

    def received(self, sample: zenoh.Sample) -> None:
        """Of the ego-motion on the air: the client's own clock of the sensors."""
        self._stamp_ns = decode_ego(sample.payload.to_bytes(), LimitsConfig()).stamp_ns

    def query(self, key: str) -> Any:
        """The document behind a key."""
        return json.loads(query_one(self.session, f"{key}?format=json", ANSWER_S).payload)

    def observation(self) -> Sample:
        """One more sample.

        Raises:
            ServiceEndedError: nobody answers any more, because the service is gone.
        """
        try:
            health, extrinsic = self.query(self.keys.health(self.pair)), self.query(self.keys.extrinsic(self.pair))
            status = self.query(self.keys.status)
        except CoecError as error:
            # A process that closes its session answers nothing for a while before it is gone.
            with suppress(subprocess.TimeoutExpired):
                code = self.running.process.wait(FINISHED_S)
                raise ServiceFinishedError(f"the service has ended with {code}: {self.errors_logged()[-3:]}") from error
            raise
        pair, worker = status["pairs"][0], status["worker"]
        served = np.array(extrinsic["camera_from_lidar"]["matrix"])
        truth = self.truth if self._stamp_ns > 0 else None
        sample = Sample(
            wall_s=time.monotonic(),
            stamp_ns=self._stamp_ns,
            state=health["state"],
            reasons=tuple(reason["code"] for reason in health["reasons"]),
            error_deg=None if truth is None else truth.error_deg(served, self._stamp_ns),
            error_m=None if truth is None else truth.error_m(served, self._stamp_ns),
            age_s=health["age_s"],
            checks=pair["checks"],
            solved=pair["solved"],
            held=pair["held"],
            worker=worker["state"],
            worker_pid=worker["pid"],
            restarts=worker["restarts"],
            rss_bytes=psutil.Process(self.running.process.pid).memory_info().rss,
        )
        self.samples.append(sample)
        return sample

    def until(self, condition: Callable[[Sample], bool], patience_s: float) -> bool:
        """Watches until a sample fulfils the condition, at most so long; whether one did."""
        end_s = time.monotonic() + patience_s
        while time.monotonic() < end_s:
            time.sleep(max(self._next_s - time.monotonic(), 0.0))
            self._next_s = time.monotonic() + POLL_S
            if condition(self.observation()):
                return True
        return False

    def passing(self, seconds: float) -> None:
        """Watches for so long."""
        self.until(lambda _: False, seconds)

    def play(self, recording: Path, rate: float, *, loop: bool = False) -> None:
        """Starts `coec play`."""
        assert self._player is None or self._player.poll() is not None, "something is played already"
        command = [*COMMAND, "play", str(recording), "--config", str(self.path), "--rate", str(rate)]
        command += ["--connect", self.config.zenoh.listen[0], *(["--loop"] if loop else [])]
        log = self.running.log.with_name("play.log").open("ab")
        with log:
            self._player = subprocess.Popen(command, stdout=log, stderr=log, env=environment())

    @property
    def playing(self) -> bool:
        """Whether frames are still being sent."""
        return self._player is not None and self._player.poll() is None

    def play_through(self, recording: Path, rate: float, patience_s: float) -> int:
        """Plays a recording to its end, and watches; the number of the first sample."""
        first = len(self.samples)
        self.play(recording, rate)
        assert self.until(lambda _: not self.playing, patience_s), "the player does not come to its end"
        return first

    def stop_playing(self) -> None:
        """Ends the player."""
        if self._player is not None and self._player.poll() is None:
            self._player.terminate()
            self._player.wait(FINISHED_S)

    def errors_logged(self) -> list[str]:
        """Messages of the service's log at level error or above."""
        result = []
        for line in self.running.log.read_text().splitlines():
            if line.startswith("{") and (entry := json.loads(line)).get("level") in ("error", "critical"):
                result.append(str(entry.get("message", entry)))
        return result


@contextmanager
def watching(
    path: Path,
    truth: Truth | None = None,
    extra_environment: dict[str, str] | None = None,
    program: Sequence[str] = COMMAND,
) -> Iterator[Watch]:
    """A service with this configuration whose worker is ready, and one who watches it. `program` stands for `coec`."""
    with added_to_environment(extra_environment or {}), service(path, None, program=program) as running:
        watch = Watch(running, running.session, running.config, path, truth)
        ego = running.config.pairs[0].ego
        assert ego is not None
        subscriber = running.session.declare_subscriber(ego.place, watch.received)
        try:
            yield watch
        finally:
            watch.stop_playing()
            subscriber.undeclare()
            if running.process.poll() is None:
                running.terminate()


@dataclass(frozen=True, slots=True)
class Transition:
    """A change of health."""

    second: float
    before: str
    after: str
    reasons: tuple[str, ...]


def transitions(samples: Sequence[Sample], second_of: Callable[[int], float]) -> list[Transition]:
    """Every change of state between two samples, with the second of the drive and the reasons of the new state."""
    return [
        Transition(second_of(after.stamp_ns), before.state, after.state, after.reasons)
        for before, after in pairwise(samples)
        if before.state != after.state
    ]


def most_per_minute(changes: Sequence[Transition]) -> int:
    """Changes of health in any minute of the drive. Back to healthy is the end of a change, not another one."""
    begins = [one.second for one in changes if one.after != "healthy"]
    return max((sum(begin <= other < begin + 60.0 for other in begins) for begin in begins), default=0)


def longest(samples: Sequence[Sample], condition: Callable[[Sample], bool], rate: float) -> float:
    """Seconds of sensor time over which the condition held without a break, at most. Sensor time by the steady clock
    of the one who watches and the rate of the player: the stamps themselves may jump."""
    best, begin_s = 0.0, None
    for sample in samples:
        if not condition(sample):
            begin_s = None
        else:
            begin_s = sample.wall_s if begin_s is None else begin_s
            best = max(best, (sample.wall_s - begin_s) * rate)
    return best


def longest_unchecked(samples: Sequence[Sample], rate: float) -> float:
    """Seconds of sensor time in which it was `healthy` and no check was completed, at most."""
    best, begin = 0.0, None
    for sample in samples:
        if sample.state != "healthy" or begin is None or sample.checks != begin.checks:
            begin = sample
        best = max(best, (sample.wall_s - begin.wall_s) * rate if sample.state == "healthy" else 0.0)
    return best


def as_rows(samples: Sequence[Sample]) -> list[dict[str, Any]]:
    """For the report."""
    return [asdict(sample) for sample in samples]
