"""Real processes on loopback: the service and the commands that talk to it."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from coec.adapters.files.rig import mask_to_png
from coec.cli.convert import configuration_for
from coec.config import CalibrationConfig, Config, StateConfig, ZenohConfig, load_config
from coec.geometry.se3 import Array, perturb
from coec.reports.commented_yaml import commented_yaml
from coec.sources import open_source
from conftest import REPOSITORY

COMMAND = [sys.executable, "-m", "coec"]
ANSWER_S = 60.0
"""Within this a step must have come about; on two cores the longest, the first start, takes some 10 s."""

END_S = 15.0
"""SIGTERM to exit."""


def environment() -> dict[str, str]:
    """That of this process, with the package on its path."""
    path = os.pathsep.join(filter(None, [str(REPOSITORY / "service"), os.environ.get("PYTHONPATH")]))
    return {**os.environ, "PYTHONPATH": path}


def coec(*arguments: object, timeout_s: float = ANSWER_S) -> subprocess.CompletedProcess[str]:
    """Runs `coec ARGS` to its end."""
    command = [*COMMAND, *(str(argument) for argument in arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=environment(), timeout=timeout_s)


def free_port() -> int:
    """A TCP port of loopback that nobody listened on a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def write_configuration(
    folder: Path, source: str, perturbation: Array, calibration: CalibrationConfig, min_free_bytes: int = 2**20
) -> Path:
    """A configuration for a recording, on a free port, with a nominal calibration that is off by `perturbation`
    (6,)."""
    recording = open_source(source)
    if recording.rig.mask is not None:
        (folder / "mask.png").write_bytes(mask_to_png(recording.rig.mask))
    mask = None if recording.rig.mask is None else Path("mask.png")
    nominal = perturb(recording.rig.T_camera_lidar_nominal, perturbation)
    pair = configuration_for(recording, nominal, mask).model_copy(update={"calibration": calibration})
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = Config(
        zenoh=ZenohConfig(connect=(endpoint,), listen=(endpoint,)),
        state=StateConfig(directory=Path("state"), min_free_bytes=min_free_bytes),
        pairs=(pair,),
    )
    path = folder / "coec.yaml"
    path.write_text(commented_yaml(config))
    return path


@dataclass
class Service:
    """A running `coec run`."""

    process: subprocess.Popen[bytes]
    endpoint: str
    log: Path

    def query(self, *arguments: object) -> subprocess.CompletedProcess[str]:
        """`coec query ARGS --json`, as a process."""
        return coec("query", *arguments, "--connect", self.endpoint, "--json")

    def ask(self, *arguments: object) -> Any:
        """The document of a query that must succeed."""
        done = self.query(*arguments)
        assert done.returncode == 0, f"{arguments}: {done.stdout}{done.stderr}"
        return json.loads(done.stdout)

    def until(self, key: str, condition: Callable[[Any], bool], what: str, deadline_s: float = ANSWER_S) -> Any:
        """The first answer that fulfils the condition; fails with the service's log after the deadline.

        Each question is a process of its own, which takes half a second: no need to wait between two.
        """
        end_s = time.monotonic() + deadline_s
        last = ""
        while time.monotonic() < end_s:
            assert self.process.poll() is None, f"the service ended ({self.process.returncode}): {self.log.read_text()}"
            done = self.query(key)
            last = done.stdout
            if done.returncode == 0 and condition(json.loads(done.stdout)):
                return json.loads(done.stdout)
        raise AssertionError(f"not within {deadline_s:g} s: {what}; last answer {last}; log {self.log.read_text()}")

    def play(self, source: str, config: Path, rate: float) -> None:
        """`coec play`, to its end."""
        done = coec("play", source, "--config", config, "--rate", rate, "--connect", self.endpoint, "--json")
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["nobody_listened_to"] == []

    def terminate(self) -> int:
        """SIGTERM; the exit status, within the limit."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(END_S)


@contextmanager
def service(config: Path) -> Iterator[Service]:
    """`coec run --embedded-router`, until its worker is warm."""
    log = config.with_name("coec.log")
    with log.open("ab") as stream:
        command = [*COMMAND, "run", "--config", str(config), "--embedded-router"]
        process = subprocess.Popen(command, stdout=stream, stderr=stream, env=environment())
    running = Service(process, load_config(config).zenoh.listen[0], log)
    try:
        running.until("status", lambda status: status["state"] == "running", "the service is up")
        yield running
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
