"""Kernels are compiled by two processes where there is a processor for both: by the worker, as its warm-up comes to
them, and by another that begins with those that the warm-up comes to last.

Each finds in the cache on the disk what the other has done, so nobody divides the work, and they meet somewhere in the
middle. Where nothing has to be compiled there is no second process.

Started as `python -m coec.runtime.worker.second_compiler PARENT`, with the configuration on its standard input.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from coec.config import Config
from coec.geometry import compile_news
from coec.runtime.worker.parent import tie_to


@contextmanager
def second_compiler(config: Config) -> Iterator[None]:
    """Within, the first kernel that has to be compiled starts it. Whether it gets anywhere changes nothing but time."""
    children: list[subprocess.Popen[bytes]] = []

    def hear(_: str) -> None:
        if not children and len(os.sched_getaffinity(0)) > 1:
            children.append(_started(config))

    try:
        with compile_news.heard_by(hear):
            yield
    finally:
        for child in children:
            child.kill()
            child.wait()


def _started(config: Config) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", __name__, str(os.getpid())]
    child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)
    assert child.stdin is not None
    with contextlib.suppress(OSError), child.stdin:
        child.stdin.write(config.model_dump_json().encode())
    return child


def main(arguments: list[str]) -> int:
    """One pair of each lens model after the other."""
    (parent,) = (int(argument) for argument in arguments)
    tie_to(parent)
    config = Config.model_validate_json(sys.stdin.buffer.read())
    from coec.adapters.files.rig import rig_of
    from coec.runtime.worker.late_kernels import late_kernels

    cameras = {type(camera): camera for camera in (rig_of(pair).camera for pair in config.pairs)}
    for camera in cameras.values():
        for run in late_kernels(camera):
            run()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
