"""Real processes on loopback: the service, the commands that talk to it, and a client that asks and drives it."""

from __future__ import annotations

import io
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from coec.calibration.types import Frame
from coec.cli.convert import configuration_for
from coec.cli.main import main
from coec.config import BudgetConfig, Config, LimitsConfig, StateConfig, ZenohConfig, load_config
from coec.errors import NotFoundError
from coec.geometry.se3 import Array, perturb
from coec.io.recordings.layouts import RecordingSource
from coec.io.rig_files import mask_to_png
from coec.io.zenoh.bus import open_session
from coec.io.zenoh.player import CAMERA, Played, Player, StreamKeys, stream_of
from coec.io.zenoh.query_client import connected, query_one
from coec.reports.commented_yaml import commented_yaml
from coec.schemas.keys import Keys
from conftest import REPOSITORY

COMMAND: Sequence[str] = [sys.executable, "-m", "coec"]
PATIENCE_S = 600.0
"""Within this a step must have come about; on two idle cores the longest, the first start, takes some 10 s. Nothing
waits so long that comes about: how fast it does is no test's verdict."""

END_S = 15.0
"""SIGTERM to exit, as promised."""

RENEWED_S = 0.05
"""Between two questions for what the service does not publish when it changes: its counters, renewed once a second."""

QUIET_STATUSES = 2
"""Renewals of the status, one after the other, in which nothing waits and nothing is under way: what the recorder
writes is in neither the queue before it nor the one behind it."""

PORTION = 12
"""Pictures that are sent at once: the service lets 16 wait."""

LOG_SHOWN = 8000
"""Characters of the service's log, its last, that a failed test shows."""


def environment() -> dict[str, str]:
    """That of this process, with the package on its path; kernels have one thread there, too, in a parallel run."""
    path = os.pathsep.join(filter(None, [str(REPOSITORY / "service"), os.environ.get("PYTHONPATH")]))
    threads = {"NUMBA_NUM_THREADS": "1"} if "PYTEST_XDIST_WORKER" in os.environ else {}
    return {**threads, **os.environ, "PYTHONPATH": path}


@contextmanager
def added_to_environment(extra: Mapping[str, str]) -> Iterator[None]:
    """Processes that are started meanwhile have these variables, too."""
    before = {name: os.environ.get(name) for name in extra}
    os.environ.update(extra)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name)
            else:
                os.environ[name] = value


def coec(*arguments: object, timeout_s: float = PATIENCE_S) -> subprocess.CompletedProcess[str]:
    """Runs `coec ARGS` to its end."""
    command = [*COMMAND, *(str(argument) for argument in arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=environment(), timeout=timeout_s)


def coec_here(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Runs `coec ARGS` to its end in this process, which saves the start of another."""
    command = ["coec", *(str(argument) for argument in arguments)]
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True) for _ in range(2))
    before, sys.argv = sys.argv, command
    try:
        with redirect_stdout(out), redirect_stderr(err):
            status = main()
    finally:
        sys.argv = before
    reported = [stream.buffer.getvalue().decode() for stream in (out, err)]
    return subprocess.CompletedProcess(command, status, *reported)


def free_endpoint() -> str:
    """A TCP endpoint of loopback that nobody listened on a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@dataclass(frozen=True, slots=True)
class Router:
    """The router of a vehicle, in this process; it stays where services come and go."""

    session: zenoh.Session
    endpoint: str


@contextmanager
def routing() -> Iterator[Router]:
    """A router on a free port."""
    endpoint = free_endpoint()
    with open_session(ZenohConfig(embedded_router=True, listen=(endpoint,)), LimitsConfig()) as session:
        yield Router(session, endpoint)


def write_configuration(
    folder: Path, recording: RecordingSource, endpoint: str, perturbation: Array | None = None, **of_pair: Any
) -> Path:
    """A configuration for a recording.

    Args:
        folder: where it goes, with the state directory beside it; made if need be.
        perturbation: (6,) rad and m by which the nominal calibration is to be off the recording's; None: not.
        of_pair: stages of the pair's configuration that differ from those for the recording.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rig = recording.rig
    mask = None if rig.mask is None else Path("mask.png")
    if mask is not None and rig.mask is not None:
        (folder / mask).write_bytes(mask_to_png(rig.mask))
    nominal = perturb(rig.T_camera_lidar_nominal, np.zeros(6) if perturbation is None else perturbation)
    pair = configuration_for(recording, nominal, mask).model_copy(update=of_pair)
    config = Config(
        # Windows are shorter than the default budget is for, and what is compared must not hang on what they cost.
        budget=BudgetConfig(cores=64.0),
        zenoh=ZenohConfig(connect=(endpoint,), listen=(endpoint,)),
        state=StateConfig(directory=Path("state"), min_free_bytes=0),
        pairs=(pair,),
    )
    path = folder / "coec.yaml"
    path.write_text(commented_yaml(config))
    return path


def by_topics(path: Path, middleware: str, topics: Mapping[str, str]) -> Path:
    """The configuration of one pair, with topics of ROS in place of keys."""
    config = load_config(path)
    (pair,) = config.pairs
    streams = {
        name: {**stream.model_dump(exclude={"key", "encoding"}), "topic": topics[name]}
        for name, stream in pair.streams.items()
    }
    document = {**config.model_dump(), "middleware": middleware, "pairs": [{**pair.model_dump(), **streams}]}
    path.write_text(commented_yaml(Config.model_validate(document)))
    return path


@dataclass
class Service:
    """A running `coec run`, and what a client has of it. Questions are about its first pair where none is
    named; those that are given whole come first.

    Attributes:
        sent: frames that were sent to it, by stream.
    """

    process: subprocess.Popen[bytes]
    session: zenoh.Session
    config: Config
    log: Path
    sent: Counter[str] = field(default_factory=Counter)
    changed: threading.Event = field(default_factory=threading.Event)

    @property
    def keys(self) -> Keys:
        return Keys(self.config.prefix, self.config.vehicle)

    @property
    def pair(self) -> str:
        return self.config.every_pair[0].name

    def query(self, key: str, parameters: str = "", payload: bytes | None = None) -> Any:
        """The document of a query for one key; `parameters` as `;name=value`.

        Raises:
            RemoteError: the service refused.
        """
        return json.loads(query_one(self.session, f"{key}?format=json{parameters}", PATIENCE_S, payload).payload)

    def extrinsic(self) -> Any:
        return self.query(self.keys.extrinsic(self.pair))

    def health(self) -> Any:
        return self.query(self.keys.health(self.pair))

    def history(self) -> Any:
        """All that is kept: the newest hundred of each kind are told unless more are asked for."""
        return self.query(self.keys.history(self.pair), ";limit=1000")

    def windows(self) -> list[Any]:
        result: list[Any] = self.query(self.keys.windows(self.pair))["windows"]
        return result

    def snippets(self) -> list[Any]:
        """What is kept of the seconds around events."""
        result: list[Any] = self.query(self.keys.windows(self.pair))["snippets"]
        return result

    def status(self) -> Any:
        """Of the service."""
        return self.query(self.keys.status)

    def counters(self) -> Any:
        """Of the pair."""
        return self.status()["pairs"][0]

    def worker(self) -> Any:
        return self.status()["worker"]

    def entries(self, *kinds: str) -> list[Any]:
        """Of the history, of these kinds."""
        return [one["entry"] for one in self.history()["entries"] if one["entry"]["kind"] in kinds]

    def command(self, name: str, payload: bytes | None = None) -> Any:
        """The acknowledgement."""
        return self.query(self.keys.command(self.pair, name), payload=payload)

    def until(self, query: Callable[[], Any], condition: Callable[[Any], bool], what: str) -> Any:
        """The first answer that fulfils the condition: asked again when the service has published a change, and soon in
        any case.

        Fails with `what` and the last answer when the service ends before, or it takes too long.
        """
        deadline_s = time.monotonic() + PATIENCE_S
        while True:
            self.changed.clear()
            answer = None
            with suppress(NotFoundError):  # who is announced may not be reached yet, as routes are still being laid
                answer = query()
            if answer is not None and condition(answer):
                return answer
            assert self.process.poll() is None, f"the service ended ({self.process.returncode}), before: {what}"
            assert time.monotonic() < deadline_s, f"not within {PATIENCE_S:g} s: {what}; last answer {answer}"
            self.changed.wait(RENEWED_S)

    def send(self, frames: Sequence[Frame]) -> None:
        """Publishes frames, in portions that its inbox holds: however slow the machine is, none is lost."""
        player = Player(self.session, StreamKeys.of_pair(self.config.pairs[0]), "msgpack")
        try:
            assert not player.wait_for_listener(PATIENCE_S)
            for portion in portions(frames):
                player.play(portion, 0.0, threading.Event(), self._count)
                self.until_received()
        finally:
            player.close()

    def send_by(self, put: Callable[[Frame], None], frames: Sequence[Frame]) -> None:
        """The same, in another form than native frames."""
        for portion in portions(frames):
            for frame in portion:
                put(frame)
                self.sent[stream_of(frame)] += 1
            self.until_received()

    def _count(self, frame: Frame, _: Played) -> None:
        self.sent[stream_of(frame)] += 1

    def until_received(self) -> Any:
        """Until every frame that was sent has come; the pair's counters then."""
        return self.until(self.counters, self._has_received, "every frame that was sent")

    def rest(self) -> None:
        """Until it has every frame that was sent, nothing waits and nothing is under way."""
        quiet: dict[float, Any] = {}

        def rests(status: Any) -> bool:
            worker, pair = status["worker"], status["pairs"][0]
            at_work = worker["state"] != "idle" or worker["queued"] > 0 or pair["held"] > 0 or pair["unanswered"] > 0
            done = {name: pair[name] for name in ("pairs", "windows", "solved", "checks", "losses")}
            if at_work or not self._has_received(pair) or any(before != done for before in quiet.values()):
                quiet.clear()
            else:
                quiet[status["uptime_s"]] = done
            return len(quiet) >= QUIET_STATUSES

        self.until(self.status, rests, "rest")

    def end(self) -> None:
        """Until the streams have been silent for long enough to end the open window, and it was judged."""
        self.until(self.counters, lambda pair: pair["selected"] == 0, "the end of the open window")
        self.rest()

    def _has_received(self, pair: Any) -> bool:
        streams = {name: pair[name] or {"received": 0, "losses": {}} for name in ("camera", "lidar", "ego")}
        return all(
            stream["received"] + stream["losses"].get("overrun", 0) >= self.sent[name]
            for name, stream in streams.items()
        )

    def terminate(self) -> int:
        """SIGTERM; the exit status, within the limit."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(END_S)

    def kill(self) -> None:
        """SIGKILL."""
        self.process.kill()
        self.process.wait()


def portions(frames: Sequence[Frame]) -> Iterator[Sequence[Frame]]:
    pictures = [index for index, frame in enumerate(frames) if stream_of(frame) == CAMERA]
    ends = [0, *(index + 1 for index in pictures[PORTION - 1 :: PORTION]), len(frames)]
    return (frames[begin:end] for begin, end in pairwise(ends) if begin < end)


@contextmanager
def service(
    config: Path, router: Router | None, *, warm: bool = True, program: Sequence[str] = COMMAND
) -> Iterator[Service]:
    """`coec run` with a configuration, until it serves and, if need be, its worker is warm; killed at the end if it
    still runs then. Its log is shown when the test fails.

    Args:
        router: what it connects to; None: it is its own router.
        program: what stands for `coec`.
    """
    log = config.with_name("coec.log")
    loaded = load_config(config)
    own = () if router else ("--embedded-router",)
    with log.open("ab") as stream:
        command = [*program, "run", "--config", str(config), *own]
        process = subprocess.Popen(command, stdout=stream, stderr=stream, env=environment())
    try:
        with nullcontext(router.session) if router else connected(loaded.zenoh.listen, PATIENCE_S) as session:
            running = Service(process, session, loaded, log)
            with _reported_of_changes(running):
                _await_alive(running)
                expected = ("running",) if warm else ("starting", "running", "failing")
                running.until(
                    running.status, lambda status: status["state"] in expected, f"a service that is {expected}"
                )
                yield running
    except BaseException:
        sys.stderr.write(log.read_text()[-LOG_SHOWN:])
        raise
    finally:
        process.kill()
        process.wait()


@contextmanager
def _reported_of_changes(running: Service) -> Iterator[None]:
    """Sets `changed` for everything that the service publishes of its pairs."""

    def received(_: zenoh.Sample) -> None:
        running.changed.set()

    subscribers = [
        running.session.declare_subscriber(key, zenoh.handlers.Callback(received, indirect=False))
        for key in (running.keys.extrinsic("*"), running.keys.health("*"))
    ]
    try:
        yield
    finally:
        for subscriber in subscribers:
            subscriber.undeclare()


def _await_alive(running: Service) -> None:
    """Until every pair is announced, or the process has ended."""
    missing = {running.keys.alive(pair.name) for pair in running.config.every_pair}

    def received(token: zenoh.Sample) -> None:
        if token.kind == zenoh.SampleKind.PUT:
            missing.discard(str(token.key_expr))
            running.changed.set()

    handler = zenoh.handlers.Callback(received, indirect=False)
    tokens = running.session.liveliness().declare_subscriber(running.keys.alive("*"), handler, history=True)
    deadline_s = time.monotonic() + PATIENCE_S
    try:
        while missing:
            assert running.process.poll() is None, f"the service ended ({running.process.returncode})"
            assert time.monotonic() < deadline_s, f"not alive within {PATIENCE_S:g} s: {missing}"
            running.changed.clear()
            if missing:
                running.changed.wait(RENEWED_S)
    finally:
        tokens.undeclare()
