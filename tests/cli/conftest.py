"""The command line in this process: arguments in, exit status and streams out."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest

from coec.cli import main

SMALL = "synthetic:?frames=6&width=160&period_s=2"
"""A recording that is cast in a fraction of a second."""


@dataclass(frozen=True)
class Outcome:
    """What a command left behind."""

    status: int
    out: str
    err: str

    @property
    def document(self) -> Any:
        """The one document on standard output."""
        return json.loads(self.out)


Coec = Callable[..., Outcome]


@pytest.fixture
def coec(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Coec:
    """Runs `coec ARGS`."""

    def run(*arguments: object) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["coec", *(str(argument) for argument in arguments)])
        capsys.readouterr()
        status = main()
        captured = capsys.readouterr()
        return Outcome(status, captured.out, captured.err)

    return run
