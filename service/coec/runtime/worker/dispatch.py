"""Turns each question to the worker into work, and its end into an answer. A refusal is an answer, too: a window that
cannot be solved, for example."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from coec.calibration.types import Reason
from coec.config import CalibrationConfig
from coec.errors import CoecError
from coec.runtime.worker import jobs
from coec.runtime.worker.answers import pack_answer, pack_refusal, pack_underway
from coec.runtime.worker.jobs import Answer, Kind, Underway
from coec.runtime.worker.tasks import Solver

_log = logging.getLogger(__name__)

INTERNAL_ERROR = "internal_error"
"""Code of the refusal if the program failed in the work."""


def answer_request(solver: Solver, message: dict[str, Any]) -> dict[str, Any]:
    """The answer to one question, under its number. If the solve of a window raises anything but a `CoecError`, the
    process ends; the service replaces it and tries again, a limited number of times."""
    number = message["id"]
    try:
        end = solver.solve(Path(message["path"])) if message["kind"] == Kind.SOLVE else _answer_once(solver, message)
    except CoecError as error:
        end = Reason(error.reply_code, str(error))
    if isinstance(end, Reason):
        return pack_refusal(number, end)
    return pack_underway(number, end) if isinstance(end, Underway) else pack_answer(number, end)


def _answer_once(solver: Solver, message: dict[str, Any]) -> Answer | Underway | Reason | None:
    """The answer to work that is tried only once. A fault of the program is an answer, too, because checks come every
    few seconds: if each of them ended the worker, it would solve no more windows.

    Raises:
        CoecError: the work has no result.
        MemoryError: the process has to end.
    """
    try:
        match message["kind"]:
            case Kind.CHECK:
                return solver.observe(message["pair"], _configuration(message), message["pose"], message["frames"])
            case Kind.OVERLAY if "poses" in message:
                return solver.comparison(Path(message["path"]), message["poses"], message["names"])
            case Kind.OVERLAY:
                return solver.overlay(Path(message["path"]), message["pose"], message["title"])
            case Kind.PICTURE:
                return solver.picture(
                    message["pair"], _configuration(message), message["pose"], message["frames"], message["title"]
                )
            case Kind.COMMISSION:
                paths = [Path(path) for path in message["paths"]]
                return solver.commission(message["run"], _configuration(message), message["pose"], paths)
            case Kind.REGISTER:
                return solver.register(message["lidars"], message["frames"])
            case jobs.PREFETCH:
                solver.prefetch(message["pair"], message["frame"])
                return None
        raise ValueError(f"there is no work of the kind {message['kind']!r}")
    except (CoecError, MemoryError):
        raise
    except Exception as error:
        _log.exception("the work failed", extra={"fields": {"kind": message["kind"], "pair": message.get("pair")}})
        text = f"The program failed ({type(error).__name__}: {error}); the log has the traceback."
        return Reason(INTERNAL_ERROR, text)


def _configuration(message: dict[str, Any]) -> CalibrationConfig:
    return CalibrationConfig.model_validate(message["configuration"])
