"""A second process that compiles kernels while the worker warms up, if there is a second processor.

The worker compiles kernels in the order of its warm-up; the second process begins with those that the warm-up needs
last. Each finds the other's kernels in the cache on the disk, so they meet somewhere in the middle without dividing the
work beforehand. If nothing has to be compiled, no second process starts.

Started as `python -m coec.service.worker.second_compiler PARENT`, with the configuration on its standard input.
"""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from coec.config import Config
from coec.geometry import compilation_events
from coec.service.worker.child_process import tie_to


@contextmanager
def second_compiler(config: Config) -> Iterator[None]:
    """Within the block, the first kernel that has to be compiled starts the second process. If that process fails, the
    worker only needs more time."""
    children: list[subprocess.Popen[bytes]] = []

    def on_compilation(_: str) -> None:
        if not children and len(os.sched_getaffinity(0)) > 1:
            children.append(_started(config))

    try:
        with compilation_events.listening(on_compilation):
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
    """Compiles the kernels for one camera of each lens model."""
    (parent,) = (int(argument) for argument in arguments)
    tie_to(parent)
    config = Config.model_validate_json(sys.stdin.buffer.read())
    from coec.io.rig_files import rig_of
    from coec.service.worker.warm_up import late_kernels

    cameras = {type(camera): camera for camera in (rig_of(pair).camera for pair in config.pairs)}
    for camera in cameras.values():
        for run in late_kernels(camera):
            run()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
