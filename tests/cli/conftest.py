"""The command line in this process: arguments in, exit status and streams out."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest

from coec.cli.main import main
from coec_lab.commands import drive_bags  # noqa: F401  so does this
from coec_lab.experiments import check_drives, matrix_drives  # noqa: F401  they render themselves, whichever test loads them first
from support.simulated_drives import rendered_drive

SMALL = "sim:seed=1&seconds=12&camera_hz=0.5&lidar_hz=0.5&camera=fisheye160&lidar=16&depth=yes"
"""Six frames, two seconds apart, with exact depth."""


@pytest.fixture(autouse=True)
def rendered_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A simulated drive is drawn by the first command that opens it, and handed to the others as it is."""
    monkeypatch.setattr("coec_lab.simulation.source.open_sim", rendered_drive)


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
    """Runs `coec ARGS`, without the lines that say how far a command is, which only a slow machine prints."""
    monkeypatch.setattr("coec.reports.console.LINE_S", math.inf)
    monkeypatch.setattr("coec.reports.console.COMPILING_S", math.inf)

    def run(*arguments: object) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["coec", *(str(argument) for argument in arguments)])
        capsys.readouterr()
        status = main()
        captured = capsys.readouterr()
        return Outcome(status, captured.out, captured.err)

    return run
