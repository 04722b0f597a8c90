"""The worker process: infers depth and solves windows, one job at a time, for the service that started it.

Started as `python -m coec.runtime.worker.process SOCKET PARENT`; see `link` for the wire. It dies with its parent,
ignores the signals that are meant for the service, and answers every question under its number: see `dispatch`.
"""

from __future__ import annotations

import contextlib
import gc
import os
import sys

from coec.adapters.system import allocator, logs
from coec.config import Config
from coec.errors import CoecError
from coec.runtime.worker.link import Link
from coec.runtime.worker.parent import tie_to

START = "start"
"""Kind of the first message, and of every later one that brings another configuration."""

DEPTH_MAPS_KEPT = 64
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
        allocator.return_large()
        _serve(link, config)
    return 0


def _serve(link: Link, config: Config) -> None:
    # Imported here because numba and onnxruntime take most of a second, and the process is tied to its parent before.
    # The imported objects stay for good: without `freeze`, looking through them for garbage took a tenth of the start.
    gc.disable()
    from coec.runtime.worker.dispatch import answer
    from coec.runtime.worker.second_compiler import second_compiler
    from coec.runtime.worker.tasks import Solver

    gc.freeze()
    gc.enable()
    solver: Solver | None = None
    while True:
        try:
            if solver is None:
                solver = Solver(config, DEPTH_MAPS_KEPT)
            else:
                solver.use(config)
            with second_compiler(config):
                solver.warm_up()
        except CoecError as error:
            link.send({"kind": "unusable", "code": error.reply_code, "text": str(error)})
            return
        link.send({"kind": "ready"})
        while (message := link.receive())["kind"] != START:
            solver.forget_abandoned()
            link.send(answer(solver, message))
        config = Config.model_validate_json(message["settings"])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
