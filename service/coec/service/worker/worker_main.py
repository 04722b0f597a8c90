"""The worker process: infers depth and solves windows, one job at a time, for the service that started it.

Started as `python -m coec.service.worker.worker_main SOCKET PARENT`; see `child_process` for the wire. It dies with its
parent, ignores the signals that are meant for the service, and answers every question under its number.
"""

import contextlib
import gc
import logging
import os
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from coec.config import Config
from coec.errors import CoecError
from coec.geometry import compilation_events
from coec.io import logs, system
from coec.service.worker.child_process import Link, tie_to

_log = logging.getLogger(__name__)

REPORT_S = 1.0
"""Time between two reports on a kernel that takes long to compile, s."""

START = "start"
"""Kind of the first message, and of every later one that brings another configuration."""

WARM_UP = "warm_up"
"""Kind of a message that has the next of the kernels compiled that no check needs."""

DEPTH_MAPS_CACHED = 64
"""Number of depth maps kept per network: two windows of 25 and some more. A map at network resolution is about 1 MB."""


def main(arguments: list[str]) -> int:
    """Serves until the service goes away; returns the exit status, 0."""
    descriptor, parent = (int(argument) for argument in arguments)
    tie_to(parent)
    link = Link(descriptor)
    with contextlib.suppress(EOFError, OSError):
        config = Config.model_validate_json(link.receive()["settings"])
        logs.configure(config.log.level, config.log.format)
        os.nice(config.worker.niceness)
        system.return_large_allocations()
        _serve(link, config)
    return 0


def _serve(link: Link, config: Config) -> None:
    # Imported here because numba and onnxruntime take most of a second, and the process is tied to its parent before.
    # The imported objects stay for good: without `freeze`, looking through them for garbage took a tenth of the start.
    gc.disable()
    from coec.service.worker.tasks import Solver, answer_request
    from coec.service.worker.warm_up import second_compiler

    gc.freeze()
    gc.enable()
    solver: Solver | None = None
    while True:
        with ExitStack() as reporting, ExitStack() as helping:
            try:
                if solver is None:
                    solver = Solver(config, DEPTH_MAPS_CACHED)
                else:
                    solver.reconfigure(config)
                helping.enter_context(second_compiler(config))
                reporting.enter_context(_reported(link, solver.lenses))
                solver.warm_up_checks()
                rest = solver.warm_up_windows()
            except CoecError as error:
                link.send({"kind": "unusable", "code": error.reply_code, "text": str(error)})
                return
            link.send({"kind": "ready", "more": True})
            while (message := link.receive())["kind"] != START:
                if message["kind"] == WARM_UP:
                    more = _goes_on(rest)
                    if not more:
                        helping.close()
                    link.send({"kind": "warmed", "more": more})
                    continue
                solver.forget_abandoned()
                link.send(answer_request(solver, message))
            config = Config.model_validate_json(message["settings"])


def _goes_on(rest: Iterator[None]) -> bool:
    """Takes the next step of a warm-up; returns whether there may be more. A kernel that cannot be compiled fails where
    it is needed, with a reason."""
    try:
        next(rest)
    except StopIteration:
        return False
    except Exception:
        _log.exception("the warm-up failed")
        return False
    return True


@contextmanager
def _reported(link: Link, lenses: int) -> Iterator[None]:
    """Inside the context, the service is sent how far the compilation of kernels is, see `compilation`."""
    from coec.service.worker.compilation import compiled

    reported_s: float | None = None

    def step(_: str) -> None:
        nonlocal reported_s
        now_s = time.monotonic()
        if reported_s is None or now_s - reported_s >= REPORT_S:
            reported_s = now_s
            reached = compiled(lenses)
            send({"kind": "compiling", "done": reached.done, "total": reached.total})

    def end(_: str) -> None:
        nonlocal reported_s
        reported_s = None
        send({"kind": "compiled"})

    def send(message: dict[str, Any]) -> None:
        with contextlib.suppress(OSError):  # the service is gone, which the next message to it shows, too
            link.send(message)

    with compilation_events.listening(step, end):
        yield


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
