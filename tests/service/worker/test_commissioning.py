"""A commissioning in slices, as the worker does it: it gives the same baseline as one without a pause."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.conftest import STREET, window_of
from coec.calibration import commissioning
from coec.calibration.commissioning import commission
from coec.calibration.types import Window
from coec.cli.convert import configuration_for
from coec.config import CalibrationConfig, Config, DepthConfig, LimitsConfig, ObjectiveConfig, SearchConfig, StateConfig
from coec.errors import CalibrationError
from coec.io.images import GreyImages
from coec.io.mcap.windows import WindowWriter
from coec.io.rig_files import BASELINES, baseline_hash, load_baseline
from coec.service.worker import tasks
from coec.service.worker.tasks import Solver
from coec.service.worker.worker_jobs import DEADLINE_S, Commissioned, Kind, Underway, pack_pairs
from support.simulated_drives import rendered_source

CONFIG = CalibrationConfig(
    depth=DepthConfig(model="stereo"), objective=ObjectiveConfig(kind="mi"), search=SearchConfig(reach_deg=8.0)
)


@pytest.fixture(autouse=True)
def small_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few of everything, and a slice for each step."""
    monkeypatch.setattr(commissioning, "CHECKS", 2)
    monkeypatch.setattr(commissioning, "FAR_CHECKS", 1)
    monkeypatch.setattr(commissioning, "HALVES", 2)
    monkeypatch.setattr(commissioning, "SOLVES", 1)
    monkeypatch.setattr(tasks, "SLICE_S", 0.0)


@pytest.fixture(scope="module")
def street() -> Window:
    return window_of(rendered_source(STREET))


@pytest.fixture
def solver(street: Window, tmp_path: Path) -> Solver:
    pair = configuration_for(rendered_source(STREET), street.T_camera_lidar_start, None)
    pair = pair.model_copy(update={"name": street.rig.pair, "calibration": CONFIG})
    return Solver(Config(pairs=(pair,), state=StateConfig(directory=tmp_path)), 4)


@pytest.fixture
def paths(street: Window, tmp_path: Path) -> list[Path]:
    """Two windows on the disk."""
    written = []
    for number in (0, 1):
        path = tmp_path / f"{street.rig.pair}-{number}.mcap"
        writer = WindowWriter(path, street.rig, street.T_camera_lidar_start, path.stem, CONFIG, {})
        for pair in street.pairs[number::2]:
            writer.add(pair)
        writer.finish()
        written.append(path)
    return written


def slices(solver: Solver, street: Window, paths: list[Path], run: int = 1) -> Iterator[Underway | Commissioned]:
    while True:
        reported = solver.commission(run, CONFIG, street.T_camera_lidar_start.tolist(), paths)
        yield reported
        if isinstance(reported, Commissioned):
            return


@pytest.mark.fault("`commission` between checks", "the baseline is that of one without a pause, to the byte")
def test_a_baseline_learned_between_checks_is_the_one_learned_without_a_pause(
    solver: Solver, street: Window, paths: list[Path], tmp_path: Path
) -> None:
    checked = pack_pairs(street.pairs[:4])
    stages: list[str] = []
    for reported in slices(solver, street, paths):
        if len(stages) % 5 == 0:
            solver.observe(street.rig.pair, CONFIG, street.T_camera_lidar_start.tolist(), checked)
        if isinstance(reported, Underway):
            stages.append(str(reported))
    assert isinstance(reported, Commissioned)
    assert stages[:2] == ["windows 1 of 2", "windows 2 of 2"]
    assert {"depth 8 of 8", "spread 2 of 2", "right 2 of 2", "far 1 of 1", "verdicts 2 of 2"} <= set(stages)
    windows = [replace(street, pairs=street.pairs[number::2]) for number in (0, 1)]
    depth, images = solver._network(CONFIG.depth), GreyImages(LimitsConfig())
    whole = commission(windows, depth, images, CONFIG, sensors={}, reference=street.T_camera_lidar_start)
    assert reported.baseline_hash == baseline_hash(whole)
    saved = load_baseline(tmp_path / BASELINES, street.rig.pair)
    assert saved is not None
    assert baseline_hash(saved) == reported.baseline_hash


def test_another_commissioning_takes_the_place_of_one_that_was_started(
    solver: Solver, street: Window, paths: list[Path]
) -> None:
    started = slices(solver, street, paths, run=1)
    assert [str(next(started)), str(next(started))] == ["windows 1 of 2", "windows 2 of 2"]
    other = slices(solver, street, paths, run=2)
    assert str(next(other)) == "windows 1 of 2"
    assert str(next(started)) == "windows 1 of 2", "the first one begins again"


def test_after_an_error_nothing_is_left(solver: Solver, street: Window, paths: list[Path], tmp_path: Path) -> None:
    turned = street.T_camera_lidar_start.copy()
    turned[:3, :3] = turned[:3, :3] @ np.array([[0.999, -0.0447, 0], [0.0447, 0.999, 0], [0, 0, 1]])
    at_turned = replace(street, T_camera_lidar_start=turned)
    with pytest.raises(CalibrationError, match="away from the reference"):
        list(slices(solver, at_turned, paths))
    assert solver._commissioning is None
    assert not (tmp_path / BASELINES).exists()


def test_the_memory_of_a_commissioning_that_was_given_up_is_freed(
    solver: Solver, street: Window, paths: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    next(slices(solver, street, paths))
    solver.forget_abandoned()
    assert solver._commissioning is not None
    later_s = time.monotonic() + DEADLINE_S[Kind.COMMISSION] + 1.0
    monkeypatch.setattr(time, "monotonic", lambda: later_s)
    solver.forget_abandoned()
    assert solver._commissioning is None
