"""What `status` and `metrics` say of the worker: how each question to it ended, what waits, what is with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coec.config import CalibrationConfig, WorkerConfig
from coec.schemas.replies import WorkerStatus
from coec.service.api import metrics
from coec.service.api.metrics import MetricsInput
from coec.service.api.reply_builders import worker_status_of
from coec.service.worker import worker_jobs
from coec.service.worker.job_queue import WAITING, Lane
from coec.service.worker.supervisor import Worker
from support.messages import status_reply


def lines_of(worker: WorkerStatus) -> list[str]:
    status = status_reply(worker=worker)
    return metrics.render(MetricsInput(status, {})).decode().splitlines()


def test_every_end_is_counted_by_fate_and_cause_and_what_waits_by_kind() -> None:
    worker = Worker(WorkerConfig(), "{}")
    for number in range(WAITING[Lane.CHECK] + 1):
        worker.submit(worker_jobs.check("front", CalibrationConfig(), np.eye(4), (), lambda _: None))
        worker.submit(worker_jobs.solve("front", Path(f"w{number}"), f"w{number}", lambda _: None, live=False))
    status = worker_status_of(worker)
    assert (status.state, status.queued, status.job, status.job_age_s) == ("starting", 9, None, None)
    assert status.waiting == {"check": 4, "backlog": 5}
    assert status.outcomes == {"result": 0, "failed": 0, "superseded": 1, "deadline_passed": 0}
    assert status.losses == {"superseded": 1}
    worker.request_stop()
    status = worker_status_of(worker)
    assert (status.queued, status.outcomes["failed"], status.losses["stopping"]) == (0, 9, 9)
    lines = lines_of(status)
    assert 'coec_worker_jobs_total{fate="failed"} 9' in lines
    assert 'coec_worker_jobs_total{fate="result"} 0' in lines, "a series is there before its first event"
    assert 'coec_worker_losses_total{cause="superseded"} 1' in lines


def test_what_is_with_the_worker_has_an_age_and_faults_a_cause() -> None:
    lines = lines_of(WorkerStatus(state="busy", job="solve", job_age_s=12.5, waiting={"check": 2}, faults={"died": 3}))
    assert 'coec_worker_job_age_seconds{kind="solve"} 12.5' in lines
    assert 'coec_worker_waiting{kind="check"} 2' in lines
    assert 'coec_worker_faults_total{cause="died"} 3' in lines
    assert not [line for line in lines_of(WorkerStatus(state="idle")) if line.startswith("coec_worker_job_age_seconds")]
