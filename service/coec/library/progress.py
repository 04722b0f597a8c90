"""How a long call reports its progress to the caller."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from rich.progress import Progress as Bars

from coec.evaluation.experiments import Stages

Progress = Callable[[str, int, int], None]
"""Called with the name of a stage, how many of its parts are done, and how many it has (0: unknown)."""


@dataclass(frozen=True, slots=True)
class Told:
    """Adapts the caller's function to `calibration.ports.Progress`, which the flow calls. None: nobody listens."""

    progress: Progress | None

    def step(self, stage: str, done: int, total: int) -> None:
        """See `calibration.ports.Progress`."""
        if self.progress is not None:
            self.progress(stage, done, total)


class ToldStages(Stages):
    """The stages of an evaluation, reported to a function instead of drawn."""

    def __init__(self, progress: Progress | None) -> None:
        super().__init__(Bars(disable=True))
        self._told = Told(progress)

    def begin(self, stage: str, total: int | None) -> Callable[[int, str], None]:
        """See `Stages.begin`."""
        heard = super().begin(stage, total)

        def both(done: int, note: str = "") -> None:
            heard(done, note)
            self._told.step(stage, done, total or 0)

        return both
