"""The command line in this process: arguments in, exit status and streams out."""

from __future__ import annotations

import hashlib
import json
import math
import pickle
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest

from coec.calibration.types import DepthModel, Estimate, ImageReader, Mistake, Progress, Window
from coec.cli.main import main
from coec.config import CalibrationConfig
from coec.recording import calibrated
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
class ReportedSteps:
    """Hands on the steps of a solve, and keeps them."""

    progress: Progress
    steps: list[tuple[str, int, int]]

    def step(self, stage: str, done: int, total: int) -> None:
        self.steps.append((stage, done, total))
        self.progress.step(stage, done, total)


@pytest.fixture(autouse=True)
def mistakes_unsought(monkeypatch: pytest.MonkeyPatch) -> None:
    """No mistake in the inputs is looked for where a window is refused, which takes ten times as long as its solve:
    `test_mistakes` replaces this."""
    monkeypatch.setattr("coec.recording.probable_mistake", unsought)


def unsought(*_: object) -> None:
    """`coec.recording.probable_mistake`, which names none."""


@pytest.fixture(scope="session")
def calibrated_once() -> Callable[..., tuple[Estimate, Mistake | None]]:
    """`coec.recording.calibrated`, which solves a window once for all commands that are given it with the same network
    and configuration. What `replay` compares it with is solved each time."""
    known: dict[bytes, tuple[tuple[Estimate, Mistake | None], list[tuple[str, int, int]]]] = {}

    def once(
        window: Window, depth: DepthModel, images: ImageReader, configuration: CalibrationConfig, progress: Progress
    ) -> tuple[Estimate, Mistake | None]:
        identity = hashlib.sha256(pickle.dumps((window, depth.identity, configuration))).digest()
        if identity not in known:
            reported = ReportedSteps(progress, [])
            known[identity] = calibrated(window, depth, images, configuration, reported), reported.steps
        else:
            for step in known[identity][1]:
                progress.step(*step)
        return known[identity][0]

    return once


@pytest.fixture(autouse=True)
def solved_once(
    monkeypatch: pytest.MonkeyPatch, calibrated_once: Callable[..., tuple[Estimate, Mistake | None]]
) -> None:
    """A window is solved by the first command that is given it."""
    monkeypatch.setattr("coec.recording.calibrated", calibrated_once)


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
