"""The processor time that the worker process takes, and for what."""

from __future__ import annotations

from dataclasses import dataclass

from coec.runtime.worker.jobs import PREFETCH, Kind, Prefetch, WorkerJob

START, IDLE, BACKLOG = "start", "idle", "backlog"
"""Kinds of cost beside the present jobs: a process that starts, a process that waits, windows of an earlier run."""


@dataclass(frozen=True, slots=True)
class Cost:
    """Processor time of all threads of the worker, s.

    Attributes:
        kind: kind of the job, or one of the above, or `prefetch`.
        pair: the pair for which it was spent; empty for none.
        cpu_s: processor time.
    """

    kind: str
    pair: str
    cpu_s: float


def cost_of(work: WorkerJob | Prefetch, cpu_s: float) -> Cost:
    """The cost of a piece of work."""
    if isinstance(work, Prefetch):
        return Cost(PREFETCH, work.pair, cpu_s)
    kind = BACKLOG if work.kind is Kind.SOLVE and not work.live else work.kind.value
    return Cost(kind, work.pair, cpu_s)
