"""What a command says of its progress where nobody sees bars, by a clock of the test's."""

from __future__ import annotations

import io
from typing import Any

import pytest
from rich.console import Console

from coec.geometry import compilation_events
from coec.reports.console import COMPILING, COMPILING_S, LINE_S, Bars


class Clock:
    """Seconds that the test passes."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def reported() -> list[str]:
    return []


@pytest.fixture
def bars(clock: Clock, reported: list[str]) -> Bars:
    return Bars(Console(file=io.StringIO()), reported.append, counted=True, now_s=clock)


def test_what_is_quick_says_nothing(bars: Bars, clock: Clock, reported: list[str]) -> None:
    with bars:
        task = bars.add_task("starts", total=100, note="")
        for done in range(100):
            clock.now_s += 0.9 * LINE_S / 100
            bars.update(task, completed=done, note="")
    assert not reported


def test_what_is_long_says_a_line_now_and_then(bars: Bars, clock: Clock, reported: list[str]) -> None:
    with bars:
        task = bars.add_task("starts", total=100, note="")
        for done in range(1, 101):
            clock.now_s += 5.0
            bars.update(task, completed=done, note=f"{done - 1} hits")
    assert len(reported) == pytest.approx(500.0 / LINE_S, abs=1)
    assert reported[0] == "coec: starts: 6 of 100, 5 hits"


def test_what_is_not_counted_says_what_it_does(clock: Clock, reported: list[str]) -> None:
    with Bars(Console(file=io.StringIO()), reported.append, counted=False, now_s=clock) as bars:
        task = bars.add_task("processes", total=None, note="")
        clock.now_s += LINE_S
        bars.update(task, description="the daemon starts")
        clock.now_s += LINE_S
        bars.update(task, note="3 s left")
    assert reported == ["coec: the daemon starts", "coec: the daemon starts: 3 s left"]


def test_a_download_says_how_much_is_there(clock: Clock, reported: list[str]) -> None:
    with Bars(Console(file=io.StringIO()), reported.append, counted=False, now_s=clock) as bars:
        received = bars.add_download("a window")
        clock.now_s += LINE_S
        received(1_500_000, 12_000_000)
    assert reported == ["coec: a window: 1.5 of 12.0 MB"]


def test_a_compiler_at_work_is_reported_once_and_then_now_and_then(
    bars: Bars, clock: Clock, reported: list[str]
) -> None:
    with bars:
        compilation_events.notify("first")
        assert not reported
        clock.now_s += COMPILING_S
        compilation_events.notify("second")
        compilation_events.notify("second")
        assert reported == [f"coec: {COMPILING}: 2 so far"]
        clock.now_s += LINE_S
        compilation_events.notify("third")
        assert reported[1:] == [f"coec: {COMPILING}: 3 so far"]
    clock.now_s += LINE_S
    compilation_events.notify("fourth")
    assert len(reported) == 2, "who has ended hears no more"


def test_kernels_from_the_cache_are_no_news() -> None:
    from coec.geometry.compiler import njit

    def twice(x: float) -> float:
        return x * 2.0

    received: list[str] = []
    kernel: Any = njit(twice)
    with compilation_events.listening(received.append):
        assert kernel(2.0) == 4.0
        assert any("twice" in name for name in received)
        received.clear()
        assert kernel(3.0) == 6.0
        assert not received
