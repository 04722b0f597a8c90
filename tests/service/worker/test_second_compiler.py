"""The process that helps the worker to compile its kernels."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from coec.config import Config
from coec.geometry import compilation_events
from coec.service.worker import warm_up
from support.rigs import pair_config

CONFIG = Config(pairs=(pair_config("front"),))


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[bytes]]:
    """Every one that is started, without its work."""
    children: list[subprocess.Popen[bytes]] = []

    def start(_: Config) -> subprocess.Popen[bytes]:
        children.append(subprocess.Popen(["sleep", "60"]))
        return children[-1]

    monkeypatch.setattr(warm_up, "_started", start)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    return children


def test_there_is_none_where_nothing_is_compiled(started: list[subprocess.Popen[bytes]]) -> None:
    with warm_up.second_compiler(CONFIG):
        pass
    compilation_events.notify("a kernel of somebody else's")
    assert started == []


def test_there_is_one_from_the_first_kernel_to_the_end_of_the_warm_up(started: list[subprocess.Popen[bytes]]) -> None:
    with warm_up.second_compiler(CONFIG):
        compilation_events.notify("one")
        compilation_events.notify("another")
        (child,) = started
        assert child.poll() is None
    assert child.returncode is not None


def test_there_is_none_next_to_a_single_processor(
    started: list[subprocess.Popen[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    with warm_up.second_compiler(CONFIG):
        compilation_events.notify("one")
    assert started == []


def test_it_takes_a_configuration_and_ends_when_all_is_compiled() -> None:
    command = [sys.executable, "-m", "coec.service.worker.warm_up", str(os.getpid())]
    done = subprocess.run(command, input=CONFIG.model_dump_json().encode(), capture_output=True)
    assert (done.returncode, done.stderr) == (0, b"")
