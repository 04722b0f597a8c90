"""Stand-ins for what lies outside: a worker process with chosen faults. Run as a program, this file is that worker."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from coec.runtime.worker.link import Link


def wait_until(condition: Callable[[], bool], what: str, timeout_s: float = 20.0) -> None:
    """Return as soon as `condition` holds; fail with `what` after `timeout_s`. It is asked again and again, as it is of
    threads and processes that tell nobody."""
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline_s:
            raise AssertionError(f"not within {timeout_s:g} s: {what}")
        time.sleep(0.005)


def fake_worker_command(fault: str, marker: Path) -> list[str]:
    """Command of a worker that answers every job with its window's name, except for one fault.

    `fault` is `none`, or one of crash, hang, grow, half (half a message), refuse: done at every solve; with the suffix
    `-once`, only at the first (the file `marker` remembers over processes); `unusable` or `stillborn`: at the start;
    `sick` (dies) or `sick-refuse`: at whatever is no solve.
    """
    return [sys.executable, __file__, fault, str(marker)]


def _serve(fault: str, marker: Path, link: Link) -> None:
    link.receive()
    if fault == "unusable":
        link.send({"kind": "unusable", "code": "bad_model", "text": "no such network"})
        return
    if fault == "stillborn":
        sys.exit(3)
    link.send({"kind": "ready"})
    hoard: list[bytearray] = []
    while True:
        message = link.receive()
        if message["kind"] != "solve":
            if fault == "sick":
                os.kill(os.getpid(), signal.SIGKILL)
            refusal = {"kind": "refused", "code": "bad_window", "text": "empty"}
            link.send(refusal if fault == "sick-refuse" else {"kind": "done", "echo": message})
            continue
        kind, _, once = fault.partition("-")
        if once and marker.exists():
            kind = "none"
        marker.touch()
        if kind == "crash":
            os.kill(os.getpid(), signal.SIGKILL)
        if kind == "hang":
            signal.pause()
        if kind == "half":
            os.write(int(sys.argv[-2]), b"\0\0\1\0half")
            signal.pause()
        while kind == "grow":
            hoard.append(bytearray(b"x" * 2**24))
        if kind == "refuse":
            link.send({"kind": "refused", "code": "bad_window", "text": "empty"})
        else:
            link.send({"kind": "solved", "result": message["path"].encode(), "note": None})


if __name__ == "__main__":
    try:
        _serve(sys.argv[1], Path(sys.argv[2]), Link(int(sys.argv[3])))
    except (EOFError, OSError):
        sys.exit(0)
