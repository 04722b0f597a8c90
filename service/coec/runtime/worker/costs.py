"""What the worker process takes of the processor, and what for."""

from __future__ import annotations

from dataclasses import dataclass

from coec.runtime.worker.jobs import PREFETCH, Job, Kind, Prefetch

START, IDLE, BACKLOG = "start", "idle", "backlog"
"""Kinds that are no job of the moment: a new process until it is ready, one that waits, windows of an earlier run."""


@dataclass(frozen=True, slots=True)
class Cost:
    """Processor time of all threads of the worker, s.

    Attributes:
        kind: of the job, or one of the above, or `prefetch`.
        pair: for which; empty for none.
        cpu_s: how much.
    """

    kind: str
    pair: str
    cpu_s: float


def cost_of(work: Job | Prefetch, cpu_s: float) -> Cost:
    """Of a piece of work."""
    if isinstance(work, Prefetch):
        return Cost(PREFETCH, work.pair, cpu_s)
    kind = BACKLOG if work.kind is Kind.SOLVE and not work.live else work.kind.value
    return Cost(kind, work.pair, cpu_s)
