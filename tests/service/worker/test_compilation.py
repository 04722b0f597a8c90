"""How the service follows the compilation of kernels, and which kernels the worker counts."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field
from typing import Any, cast

import pytest

from coec.config import Config
from coec.geometry import compilation_events
from coec.service.worker import worker_main
from coec.service.worker.child_process import Link
from coec.service.worker.compilation import LINE_S, STALLED_S, Compilation, Compiling, compiled
from coec.service.worker.tasks import Solver
from support.rigs import pair_config


@dataclass
class Clock:
    now_s: float = 100.0

    def __call__(self) -> float:
        return self.now_s


@dataclass
class Sent:
    """Stands in for the link to the service."""

    messages: list[dict[str, Any]] = field(default_factory=list)
    gone: bool = False

    def send(self, message: dict[str, Any]) -> None:
        if self.gone:
            raise BrokenPipeError
        self.messages.append(message)


def progress(done: int) -> dict[str, Any]:
    return {"kind": "compiling", "done": done, "total": 9}


def test_the_clock_stands_still_while_kernels_are_compiled() -> None:
    clock = Clock()
    compilation = Compilation(clock)
    assert compilation.take(progress(3))
    clock.now_s += 50.0
    assert (compilation.now_s(), compilation.paused_s) == (100.0, 50.0)
    assert compilation.status == Compiling(3, 9, 50.0)
    compilation.take({"kind": "compiled"})
    clock.now_s += 7.0
    assert (compilation.now_s(), compilation.paused_s) == (107.0, 50.0)
    assert compilation.status == Compiling(3, 9, 57.0), "the next kernel may follow"
    compilation.take(progress(4))
    clock.now_s += 5.0
    compilation.end()
    clock.now_s += 1.0
    assert (compilation.now_s(), compilation.paused_s) == (108.0, 55.0)
    assert not compilation.status


def test_it_has_stalled_when_nothing_is_reported_for_long_while_a_kernel_is_compiled() -> None:
    clock = Clock()
    compilation = Compilation(clock)
    compilation.take(progress(3))
    clock.now_s += STALLED_S
    assert not compilation.has_stalled
    compilation.take(progress(3))
    clock.now_s += STALLED_S + 1.0
    assert compilation.has_stalled
    compilation.take({"kind": "compiled"})
    assert not compilation.has_stalled


@pytest.mark.parametrize(
    "message", [{}, {"kind": "ready"}, {"kind": "compiling", "done": 1}, {"kind": "compiling", "done": "1", "total": 2}]
)
def test_other_messages_are_left_to_others(message: dict[str, Any]) -> None:
    compilation = Compilation(Clock())
    assert not compilation.take(message)
    assert compilation.status is None


def test_the_log_says_how_far_it_is_at_a_bounded_rate(caplog: pytest.LogCaptureFixture) -> None:
    clock = Clock()
    compilation = Compilation(clock)
    with caplog.at_level(logging.INFO):
        for second in range(40):
            clock.now_s = 100.0 + second
            compilation.take(progress(second // 5))
        compilation.end()
    lines = [record.getMessage() for record in caplog.records]
    assert lines == [
        "compiling kernels, once on this machine: 0 of 9 are there",
        f"compiling kernels: 3 of 9, after {LINE_S:.0f} s",
        f"compiling kernels: 6 of 9, after {2 * LINE_S:.0f} s",
        "kernels compiled in 39 s: those that are needed now",
    ]


def test_the_worker_reports_when_it_begins_a_kernel_at_a_bounded_rate_and_when_it_has_finished_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock, sent = Clock(), Sent()
    monkeypatch.setattr(time, "monotonic", clock)
    with worker_main._reported(cast("Link", sent), 1):
        for _ in range(3):
            compilation_events.notify("a pass")
        clock.now_s += worker_main.REPORT_S
        compilation_events.notify("a pass")
        compilation_events.end("kernel")
        compilation_events.notify("another kernel")
        sent.gone = True
        compilation_events.end("another kernel")
    assert [message["kind"] for message in sent.messages] == ["compiling", "compiling", "compiled", "compiling"]
    assert sent.messages[0]["total"] == compiled(1).total


def test_the_warm_up_makes_exactly_the_kernels_that_are_counted() -> None:
    """Those that are the same for every lens, and those of one lens."""
    solver = Solver(Config(pairs=(pair_config("front"),)), 1)
    assert solver.lenses == 1
    solver.warm_up_checks()
    steps = len(list(solver.warm_up_windows()))
    assert steps > 5, "other work goes first in between"
    reached = compiled(solver.lenses)
    assert reached.done == reached.total
    assert str(reached) == f"{reached.total} of {reached.total}"
