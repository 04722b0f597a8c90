"""Processor time of another process, read while it runs."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

from coec.io.system import processor_time_s


def test_processor_time_is_that_of_the_process_with_all_its_threads() -> None:
    program = (
        "import threading, time\n"
        "def work():\n"
        "    while time.thread_time() < 0.1: pass\n"
        "threads = [threading.Thread(target=work) for _ in range(2)]\n"
        "for thread in threads: thread.start()\n"
        "for thread in threads: thread.join()\n"
        "print(time.process_time(), flush=True)\n"
        "input()"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        own_s = float(process.stdout.readline())
        reported_s = processor_time_s(process.pid)
        assert own_s >= 0.2
        assert reported_s == pytest.approx(own_s, abs=0.05)
        before_s = time.process_time()
        assert processor_time_s(process.pid) == pytest.approx(reported_s, abs=0.01), "one that waits takes none"
        assert time.process_time() - before_s < 0.05
        process.communicate(b"\n")
    with pytest.raises(OSError, match="Invalid argument"):
        processor_time_s(process.pid)
