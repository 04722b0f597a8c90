"""The service of the demonstration: `coec run` as a process of its own, as on a vehicle."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import coec
from coec.errors import CoecError

STOP_S = 15.0
"""Time within which `coec run` promises to stop."""

LAST_WORDS = 5
"""Lines of the service's log that are shown when it fails."""


class DemoError(CoecError):
    """The service of the demonstration did not do its part."""

    reply_code = "demo_failed"


class Daemon:
    """A running service; its log goes to a file."""

    def __init__(self, child: subprocess.Popen[bytes], log: Path) -> None:
        self._child = child
        self._log = log

    def check(self) -> None:
        """Raises DemoError, with the last lines of the log, when the service has ended."""
        if self._child.poll() is not None:
            raise DemoError(f"the service ended with status {self._child.returncode}", self.last_words())

    def last_words(self) -> str:
        """The last lines of the log, for error messages."""
        lines = self._log.read_text(errors="replace").splitlines()[-LAST_WORDS:]
        return "its last words:\n" + "\n".join(_plain(line) for line in lines)

    def end(self) -> None:
        """Asks the service to end, and waits.

        Raises:
            DemoError: it does not end, or not with status 0.
        """
        self._child.send_signal(signal.SIGTERM)
        try:
            status = self._child.wait(STOP_S)
        except subprocess.TimeoutExpired as error:
            raise DemoError(f"the service did not end within {STOP_S:g} s") from error
        if status != 0:
            raise DemoError(f"the service ended with status {status}")


@contextmanager
def running(config: Path, log: Path) -> Iterator[Daemon]:
    """`coec run --embedded-router` with a configuration; killed at the end if it still runs."""
    command = [sys.executable, "-m", "coec", "run", "--config", str(config), "--embedded-router"]
    # The child finds the package where this process did, even if it is not installed.
    path = os.pathsep.join(filter(None, [str(Path(coec.__file__).parent.parent), os.environ.get("PYTHONPATH")]))
    with log.open("wb") as stream:
        child = subprocess.Popen(command, stdout=stream, stderr=stream, env={**os.environ, "PYTHONPATH": path})
    try:
        yield Daemon(child, log)
    finally:
        if child.poll() is None:
            child.kill()
            child.wait()


def free_endpoint() -> str:
    """A Zenoh endpoint on this machine that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return f"tcp/127.0.0.1:{port}"


def _plain(line: str) -> str:
    """The message of a JSON log line; any other line as it is."""
    try:
        record = json.loads(line)
    except ValueError:
        return line
    return f"{record.get('level')}: {record.get('message')}" if isinstance(record, dict) else line
