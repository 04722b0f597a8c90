"""Programs of other people, in environments that `tests/peers/setup` makes; spoken to by lines of JSON."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

REPOSITORY = Path(__file__).parents[2]
PEERS = Path(__file__).parent

TIMEOUT_S = 60.0
"""For a process to end once its input has."""


class Peer:
    """A process that answers a line of JSON with one."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def query(self, **request: Any) -> dict[str, Any]:
        """What it answers; what it complains of fails the test."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        answer: dict[str, Any] = json.loads(self._process.stdout.readline() or '{"error": "it has ended"}')
        assert "error" not in answer, answer["error"]
        return answer


def python_of(environment: str) -> Path:
    """Its interpreter, or the test is skipped."""
    python = REPOSITORY / ".peers" / environment / "bin" / "python"
    if not python.exists():
        pytest.skip(f"no .peers/{environment}: tests/peers/setup makes it, where a package index can be reached")
    return python


@contextmanager
def peer(environment: str, script: str) -> Iterator[Peer]:
    """A process of `script` in an environment, until the block ends."""
    command = [python_of(environment), PEERS / environment / script]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield Peer(process)
        finally:
            assert process.stdin is not None
            process.stdin.close()
            process.wait(TIMEOUT_S)
