"""The same drive is decided alike, entry by entry: of a pair, disturbed and not, and of rigs with two LiDARs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from golden import streams
from golden.reference import DATA, Tolerance, check_lines, write_lines
from service import test_pair_disturbed as pair_drive
from service.test_pair_disturbed import Clock, clock
from support.rigs import with_extra
from support.vehicles import SlowWorker

__all__ = ["clock", "with_extra"]

TOLERANCE = Tolerance(relative=1e-4, absolute=1e-7)


def compare(name: str, lines: list[dict[str, Any]], *, writes: bool) -> None:
    path = DATA / f"{name}.jsonl"
    if writes:
        write_lines(path, lines)
    check_lines(path, lines, TOLERANCE)


def test_of_a_pair_that_nothing_disturbs(tmp_path: Path, writes: bool) -> None:
    states, decided = streams.of_pair(streams.undisturbed(tmp_path / "pair"))
    compare("pair_states", states, writes=writes)
    compare("pair", decided, writes=writes)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_of_a_pair_whose_frames_are_late_and_whose_worker_is_slow(
    tmp_path: Path, seed: int, clock: Clock, writes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which states there are while answers are overdue is decided by the clock, which is part of the drive."""
    watched: list[pair_drive.Watched] = []

    class Noted(pair_drive.Watched):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            watched.append(self)

        def finish(self) -> None:
            """The last check may be with the worker still when no pair waits any more."""
            super().finish()
            assert isinstance(self.bench.worker, SlowWorker)
            self.bench.worker.work(share=1.0)
            self.bench.settle()

    monkeypatch.setattr(pair_drive, "Watched", Noted)
    pair_drive.disturbed(tmp_path / "pair", seed, clock)
    (of,) = watched
    states, decided = streams.of_pair(of)
    compare(f"pair_states_{seed}", states, writes=writes)
    compare("pair", decided, writes=False)


@pytest.mark.parametrize("apply", ["within_limits", "never"])
def test_of_a_pair_that_is_restarted_on_the_way(tmp_path: Path, apply: str, writes: bool) -> None:
    compare(f"restarted_{apply}", streams.driven(tmp_path / "pair", apply), writes=writes)


@pytest.mark.usefixtures("with_extra")
@pytest.mark.parametrize("seed", [None, 1])  # of the order in which sweeps and answers come, which decides nothing
def test_of_two_lidars_without_cameras(tmp_path: Path, seed: int | None, writes: bool) -> None:
    compare("two_lidars", streams.two_lidars(tmp_path / "rig", seed), writes=writes and seed is None)


@pytest.mark.parametrize("lidar", ["roof", pytest.param("bumper", marks=pytest.mark.slow)])
def test_of_a_rig_with_three_cameras_and_two_lidars(lidar: str, writes: bool) -> None:
    compare(f"rig_{lidar}", streams.rig_of_two_lidars(lidar), writes=writes)
