"""Which window a process has next, and what becomes of those whose process ended."""

from __future__ import annotations

import random

import pytest

from coec.fleet.jobs import Job
from coec.fleet.worker_pool import WINDOWS_PER_WORKER, WindowQueue

PROBLEM = ("process_died", "it ended")


def jobs(count: int) -> list[Job]:
    return [Job(f"{index}.mcap") for index in range(count)]


def test_a_process_has_one_window_ahead_and_no_more() -> None:
    queue = WindowQueue(jobs(5))
    has: list[Job] = []
    while (job := queue.next_for(has)) is not None:
        has.append(job)
    assert has == jobs(5)[:WINDOWS_PER_WORKER]
    assert queue


def test_after_an_end_each_window_is_tried_by_itself_and_the_second_end_is_its_own() -> None:
    one, two, three = jobs(3)
    queue = WindowQueue([one, two, three])
    assert [queue.next_for([]), queue.next_for([one])] == [one, two]
    assert list(queue.retry_alone([one, two], *PROBLEM)) == []
    assert queue.next_for([three]) is None  # a process that has others gets no suspected one
    assert queue.next_for([]) == one
    assert queue.next_for([one]) is None  # nor does one that has it get others
    (row,) = queue.retry_alone([one], *PROBLEM)
    assert (row.url, row.error_code, row.error) == (one.url, *PROBLEM)
    assert [queue.next_for([]), queue.next_for([])] == [two, three]


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.fault("windows that end the process which judges them", "a row each; every other window is judged")
def test_whoever_is_poisoned_nobody_else_is_lost(seed: int) -> None:
    rng = random.Random(seed)
    everything = jobs(rng.randrange(1, 30))
    poisoned = set(rng.sample(everything, rng.randrange(len(everything) + 1)))
    queue = WindowQueue(everything)
    seats: list[list[Job]] = [[] for _ in range(rng.randrange(1, 5))]
    judged: list[Job] = []
    lost: list[str] = []
    while queue or any(seats):
        for has in seats:
            while (job := queue.next_for(has)) is not None:
                has.append(job)
        has = rng.choice([has for has in seats if has])
        job = rng.choice(has)
        if job in poisoned:
            lost += [row.url for row in queue.retry_alone(has, *PROBLEM)]
            has.clear()
        else:
            has.remove(job)
            judged.append(job)
    assert sorted(lost) == sorted(job.url for job in poisoned)
    assert sorted(judged, key=lambda job: job.url) == sorted(set(everything) - poisoned, key=lambda job: job.url)
