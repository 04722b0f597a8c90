"""What the worker answers when the program has a fault: looks go on, a window is tried by another process."""

from __future__ import annotations

from typing import Any, cast

import pytest

from coec.errors import CalibrationError
from coec.runtime.worker import process
from coec.runtime.worker.tasks import Solver


class FaultySolver:
    """Fails in whatever it is asked, in the way that it was told."""

    def __init__(self, fault: Exception) -> None:
        self._fault = fault

    def observe(self, *_: object) -> dict[str, Any]:
        raise self._fault

    def overlay(self, *_: object) -> bytes:
        raise self._fault

    def solve(self, _: object) -> None:
        raise self._fault


CHECK = {"kind": "check", "pair": "front", "pose": [], "frames": []}
OVERLAY = {"kind": "overlay", "path": "w", "pose": [], "title": ""}
SOLVE = {"kind": "solve", "pair": "front", "path": "w"}


def answer(fault: Exception, message: dict[str, Any]) -> dict[str, Any]:
    return process._answer(cast("Solver", FaultySolver(fault)), message)


@pytest.mark.parametrize("message", [CHECK, OVERLAY])
def test_a_fault_of_the_program_is_an_answer(message: dict[str, Any]) -> None:
    told = answer(ZeroDivisionError("division by zero"), message)
    assert (told["kind"], told["code"]) == ("refused", "internal_error")
    assert "ZeroDivisionError: division by zero" in told["text"]


@pytest.mark.parametrize("message", [CHECK, OVERLAY, SOLVE])
def test_what_is_wrong_with_the_data_is_told_under_its_own_code(message: dict[str, Any]) -> None:
    told = answer(CalibrationError("no pairs"), message)
    assert (told["kind"], told["code"], told["text"]) == ("refused", CalibrationError.reply_code, "no pairs")


def test_a_window_that_the_program_fails_on_ends_the_process() -> None:
    with pytest.raises(ZeroDivisionError):
        answer(ZeroDivisionError(), SOLVE)


def test_without_memory_the_process_ends() -> None:
    with pytest.raises(MemoryError):
        answer(MemoryError(), CHECK)
