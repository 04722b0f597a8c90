"""The worker process: infers depth and solves windows, one job at a time, for the service that started it.

Started as `python -m coec.runtime.worker.process SOCKET PARENT`; see `link` for the wire. It dies with its parent,
leaves signals meant for the service alone, and answers every job: a window that cannot be solved is an answer, too.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import logging
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coec.adapters.system import allocator, logs
from coec.config import Config
from coec.errors import CoecError
from coec.runtime.worker.link import Link
from coec.schemas.base import to_msgpack

if TYPE_CHECKING:
    from coec.runtime.worker.tasks import Solver

_log = logging.getLogger(__name__)

PR_SET_PDEATHSIG = 1  # prctl(2)

INTERNAL_ERROR = "internal_error"
"""Code of an answer to work in which the program failed."""

DEPTH_MAPS_KEPT = 64
"""Maps kept per network: two windows of 25 and some; a map at network resolution is about 1 MB."""


def main(arguments: list[str]) -> int:
    """Serve until the service goes away; the exit status is 0 then."""
    descriptor, parent = (int(argument) for argument in arguments)
    _tie_to(parent)
    link = Link(descriptor)
    with contextlib.suppress(EOFError, OSError):
        config = Config.model_validate_json(link.receive()["settings"])
        logs.configure(config.log_level)
        os.nice(config.worker.niceness)
        allocator.return_large()
        _serve(link, config)
    return 0


def _serve(link: Link, config: Config) -> None:
    # Imported here: numba and onnxruntime take most of a second, and the ties to the parent come first. All of that
    # stays: to look through it for garbage took a tenth of the start.
    gc.disable()
    from coec.runtime.worker.tasks import Solver

    gc.freeze()
    gc.enable()
    try:
        solver = Solver(config, DEPTH_MAPS_KEPT)
        solver.warm_up()
    except CoecError as error:
        link.send({"kind": "unusable", "code": error.reply_code, "text": str(error)})
        return
    link.send({"kind": "ready"})
    while True:
        link.send(_answer(solver, link.receive()))


def _answer(solver: Solver, message: dict[str, Any]) -> dict[str, Any]:
    """The answer to one job. Of a window what is not a `CoecError` ends the process: the service replaces it and tries
    again, within bounds."""
    try:
        return _solved(solver, message) if message["kind"] == "solve" else _errand(solver, message)
    except CoecError as error:
        return {"kind": "refused", "code": error.reply_code, "text": str(error)}


def _solved(solver: Solver, message: dict[str, Any]) -> dict[str, Any]:
    solution = solver.solve(Path(message["path"]))
    note = solution.note
    return {"kind": "solved", "result": to_msgpack(solution.result), "note": (note.code, note.text) if note else None}


def _errand(solver: Solver, message: dict[str, Any]) -> dict[str, Any]:
    """The answer to work that is done once or not at all. A fault of the program in it is an answer, too: checks come
    every few seconds, and a worker that each of them ended would solve no window any more."""
    try:
        match message["kind"]:
            case "prefetch":
                solver.prefetch(message["pair"], message["frame"])
                return {"kind": "done"}
            case "check":
                return {"kind": "observed", **solver.observe(message["pair"], message["pose"], message["frames"])}
            case "overlay":
                path, pose = Path(message["path"]), message["pose"]
                return {"kind": "drawn", "jpeg": solver.overlay(path, pose, message["title"])}
            case "commission":
                paths = [Path(path) for path in message["paths"]]
                return {"kind": "commissioned", **solver.commission(message["pair"], message["pose"], paths)}
        raise ValueError(f"there is no work of the kind {message['kind']!r}")
    except (CoecError, MemoryError):
        raise
    except Exception as error:
        _log.exception("the work failed", extra={"fields": {"kind": message["kind"], "pair": message.get("pair")}})
        text = f"The program failed ({type(error).__name__}: {error}); the log has the traceback."
        return {"kind": "refused", "code": INTERNAL_ERROR, "text": text}


def _tie_to(parent: int) -> None:
    """Die with the parent thread that started this process; leave the signals of a terminal or a manager to it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it died before the tie was made
        sys.exit(0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
