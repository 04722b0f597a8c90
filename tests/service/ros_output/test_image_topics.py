"""Pictures are drawn for whoever looks, one at a time, and for nobody else."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from coec.calibration.types import Reason
from coec.io.ros.messages import COMPRESSED_IMAGE
from coec.io.ros.wire_format import Qos
from coec.io.zenoh.ros_node import RosPublisher
from coec.service.ros_output import PICTURE_PERIOD_S, CheckPictures
from coec.service.worker.supervisor import Worker
from coec.service.worker.worker_jobs import Fate, JobOutcome, Kind, RenderedImage, WorkerJob
from support.recorded_topics import RetainedTopic
from support.vehicles import frame_pair_at, pair_configuration

STAMP_NS = 1_700_000_000_250_000_000
PAIR = pair_configuration(Path("state")).pairs[0]
RENDERED = JobOutcome(Fate.RESULT, RenderedImage(b"\xff\xd8picture"), None, 0.1)
LATE = JobOutcome(Fate.LATE, None, Reason("late", "The worker was busy."), 15.0)


@dataclass
class Scene:
    """A worker that keeps its jobs, a topic, a clock that stands."""

    jobs: list[WorkerJob] = field(default_factory=list)
    topic: RetainedTopic = field(default_factory=lambda: RetainedTopic(COMPRESSED_IMAGE, Qos()))
    now_s: float = 100.0

    def __post_init__(self) -> None:
        self.pictures = CheckPictures(cast("Worker", self), {"front": cast("RosPublisher", self.topic)})

    def submit(self, job: WorkerJob) -> None:
        self.jobs.append(job)

    def show(self, after_s: float = 0.0) -> None:
        self.now_s += after_s
        self.pictures.show(PAIR, frame_pair_at(STAMP_NS), np.eye(4))


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Scene:
    scene = Scene()
    monkeypatch.setattr("coec.service.ros_output.time.monotonic", lambda: scene.now_s)
    return scene


def test_a_picture_carries_the_stamp_and_the_frame_of_its_image(scene: Scene) -> None:
    scene.show()
    (job,) = scene.jobs
    job.done(RENDERED)

    picture = scene.topic.next()
    assert (picture.header.stamp.sec, picture.header.stamp.nanosec) == (1_700_000_000, 250_000_000)
    assert (picture.header.frame_id, picture.format, picture.data.tobytes()) == (
        "camera",
        "jpeg",
        b"\xff\xd8picture",
    )
    assert (job.kind, job.pair, len(job.body["frames"])) == (Kind.PICTURE, "front", 1)


def test_nothing_is_rendered_for_nobody(scene: Scene) -> None:
    scene.topic.has_subscribers = False
    scene.show()
    assert scene.jobs == []


@pytest.mark.parametrize("end", [RENDERED, LATE])
def test_one_at_a_time_and_none_too_soon(scene: Scene, end: JobOutcome) -> None:
    scene.show()
    scene.show(after_s=2 * PICTURE_PERIOD_S)  # the first is under way still
    assert len(scene.jobs) == 1

    scene.jobs[0].done(end)
    scene.show()
    assert len(scene.jobs) == 2
    scene.jobs[1].done(end)
    scene.show(after_s=0.9 * PICTURE_PERIOD_S)  # too soon
    assert len(scene.jobs) == 2
    assert len(scene.topic.rest()) == (2 if end is RENDERED else 0)


def test_a_pair_without_a_topic_is_not_rendered(scene: Scene) -> None:
    CheckPictures(cast("Worker", scene), {}).show(PAIR, frame_pair_at(STAMP_NS), np.eye(4))
    assert scene.jobs == []
