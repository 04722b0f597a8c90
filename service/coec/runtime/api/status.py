"""The answer to `status` for each pair, the worker and the budget: counters since the start."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from coec.runtime.api.health import drops_of
from coec.runtime.budget.budget import BudgetReport
from coec.runtime.decisions.decider import PairSnapshot
from coec.runtime.ingest.decoder import CAMERA, EGO, LIDAR, StreamCounts
from coec.runtime.ingest.inbox import Arrivals
from coec.runtime.ingest.stream_statistics import StreamStatistics
from coec.runtime.worker.jobs import Fate
from coec.runtime.worker.supervisor import Worker, WorkerState
from coec.schemas import replies


def pair_status_of(
    name: str,
    known: PairSnapshot,
    report: StreamStatistics,
    losses: Mapping[tuple[str, str], int],
    recorded: int,
    commands: dict[str, int],
    arrivals: Mapping[str, Arrivals],
    unwritten: int,
    *,
    has_ego: bool,
) -> replies.PairStatus:
    """Status of a pair. `losses` are its losses by place and cause, `recorded` the number of its windows on the disk,
    `unwritten` the number of pairs that wait for the disk."""
    drops, selection = drops_of(losses, report.unpaired), report.selection

    def stream(name: str) -> replies.StreamStatus:
        counts = report.streams.get(name, StreamCounts(0, 0))
        arrival = arrivals[name]
        return replies.StreamStatus(
            received=counts.received,
            accepted=counts.accepted,
            waiting=arrival.waiting,
            age_s=arrival.age_s,
            losses=drops.get(name, {}),
        )

    return replies.PairStatus(
        name=name,
        camera=stream(CAMERA),
        lidar=stream(LIDAR),
        ego=stream(EGO) if has_ego else None,
        pairs=report.pairs,
        held=report.held,
        unanswered=selection.unanswered,
        selected=selection.selected,
        unwritten=unwritten,
        rejections=dict(selection.rejections),
        losses={**drops.get("window", {}), **drops.get("storage", {}), **drops.get("monitor", {})},
        windows=recorded,
        solved=known.solved,
        checks=known.checks,
        transitions=dict(known.transitions),
        commands=commands,
    )


def worker_status_of(worker: Worker) -> replies.WorkerStatus:
    """Status of the worker."""
    status = worker.status()
    states: dict[WorkerState, Literal["starting", "idle", "busy", "stopped"]] = {
        WorkerState.STARTING: "starting",
        WorkerState.READY: "idle",
        WorkerState.BUSY: "busy",
        WorkerState.STOPPED: "stopped",
    }
    job = status.in_progress
    return replies.WorkerStatus(
        state=states[status.state],
        compiling=None
        if status.compiling is None
        else replies.CompilingStatus(
            done=status.compiling.done, total=status.compiling.total, elapsed_s=status.compiling.elapsed_s
        ),
        pid=worker.pid,
        restarts=max(status.starts - 1, 0),
        queued=sum(status.waiting.values()),
        waiting=dict(status.waiting),
        job=None if job is None else job.kind,
        job_age_s=None if job is None else job.age_s,
        commissioning=dict(status.commissionings),
        outcomes={fate.value: status.outcomes.get(fate, 0) for fate in Fate},
        losses=dict(status.losses),
        faults={fault.value: count for fault, count in status.faults.items()},
    )


def budget_status_of(report: BudgetReport) -> replies.BudgetStatus:
    """Status of the budget."""
    kinds = sorted({kind for kind, _ in report.totals_s})
    return replies.BudgetStatus(
        cores=report.cores,
        spent=report.spent,
        wanted=report.demand,
        stretched_by=report.stretched_by,
        in_store_s=report.in_store_s,
        spent_s={kind: sum(cpu_s for (each, _), cpu_s in report.totals_s.items() if each == kind) for kind in kinds},
        pairs={
            name: replies.BudgetShare(
                look_s=share.check_s,
                window_s=share.window_s,
                unseen_s=report.unseen_s.get(name),
                suspected=share.suspected,
                waiting=share.waiting,
                active=share.active,
            )
            for name, share in report.pairs.items()
        },
    )
