"""What the worker answers: under the number that was asked; when the program has a fault, checks go on, and a window is
tried by another process."""

from __future__ import annotations

from typing import Any, cast

import pytest

from coec.errors import CalibrationError
from coec.service.worker import tasks
from coec.service.worker.tasks import Solver
from coec.service.worker.worker_jobs import RenderedImage


class FaultySolver:
    """Fails in whatever it is asked, in the way that it was told."""

    def __init__(self, fault: Exception) -> None:
        self._fault = fault

    def observe(self, *_: object) -> None:
        raise self._fault

    def overlay(self, *_: object) -> None:
        raise self._fault

    def comparison(self, *_: object) -> None:
        raise self._fault

    def solve(self, _: object) -> None:
        raise self._fault


CHECK = {"id": 3, "kind": "check", "pair": "front", "configuration": {}, "pose": [], "frames": []}
OVERLAY = {"id": 4, "kind": "overlay", "path": "w", "pose": [], "title": ""}
COMPARISON = {"id": 7, "kind": "overlay", "path": "w", "poses": [[], []], "names": ["a", "b"]}
SOLVE = {"id": 5, "kind": "solve", "pair": "front", "path": "w"}


def answer(fault: Exception, message: dict[str, Any]) -> dict[str, Any]:
    return tasks.answer_request(cast("Solver", FaultySolver(fault)), message)


class Painter:
    """Draws its title, and infers whatever it is given."""

    def overlay(self, _path: object, _pose: object, title: str) -> RenderedImage:
        return RenderedImage(title.encode())

    def comparison(self, _path: object, poses: list[object], names: list[str]) -> RenderedImage:
        return RenderedImage(f"{len(poses)} {' '.join(names)}".encode())

    def picture(
        self, pair: str, _configuration: object, _pose: object, frames: list[object], title: str
    ) -> RenderedImage:
        return RenderedImage(f"{pair} {len(frames)} {title}".encode())

    def prefetch(self, _pair: str, _frame: bytes) -> None:
        """Nothing to tell."""


def test_an_answer_goes_under_the_number_of_its_question() -> None:
    painter = cast("Solver", Painter())
    assert tasks.answer_request(painter, {**OVERLAY, "title": "a"}) == {"id": 4, "result": {"jpeg": b"a"}}
    picture = {**CHECK, "kind": "picture", "frames": [[]], "title": "b"}
    assert tasks.answer_request(painter, picture) == {"id": 3, "result": {"jpeg": b"front 1 b"}}
    assert tasks.answer_request(painter, COMPARISON) == {"id": 7, "result": {"jpeg": b"2 a b"}}
    prefetch = {"id": 6, "kind": "prefetch", "pair": "front", "frame": b""}
    assert tasks.answer_request(painter, prefetch) == {"id": 6, "result": None}


def test_a_question_that_nobody_knows_is_refused() -> None:
    reported = tasks.answer_request(cast("Solver", Painter()), {"id": 7, "kind": "sing", "pair": "front"})
    assert reported["refused"]["code"] == "internal_error"
    assert "'sing'" in reported["refused"]["text"]


@pytest.mark.fault("a fault of our own in the worker", "it is an answer, and the worker goes on")
@pytest.mark.parametrize("message", [CHECK, OVERLAY, COMPARISON])
def test_a_fault_of_the_program_is_an_answer(message: dict[str, Any]) -> None:
    reported = answer(ZeroDivisionError("division by zero"), message)
    assert reported.keys() == {"id", "refused"}
    assert reported["id"] == message["id"]
    assert reported["refused"]["code"] == "internal_error"
    assert "ZeroDivisionError: division by zero" in reported["refused"]["text"]


@pytest.mark.parametrize("message", [CHECK, OVERLAY, COMPARISON, SOLVE])
def test_what_is_wrong_with_the_data_is_reported_under_its_own_code(message: dict[str, Any]) -> None:
    reported = answer(CalibrationError("no pairs"), message)
    refused = {"code": CalibrationError.reply_code, "text": "no pairs"}
    assert reported == {"id": message["id"], "refused": refused}


def test_a_window_that_the_program_fails_on_ends_the_process() -> None:
    with pytest.raises(ZeroDivisionError):
        answer(ZeroDivisionError(), SOLVE)


def test_without_memory_the_process_ends() -> None:
    with pytest.raises(MemoryError):
        answer(MemoryError(), CHECK)
