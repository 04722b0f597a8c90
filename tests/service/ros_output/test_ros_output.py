"""What is published to ROS, and when, of a pair whose camera is knocked."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest

from coec.calibration.types import Rig
from coec.config import Config, RosConfig
from coec.geometry.cameras import build
from coec.io.ros.message_encoding import ServicePhase
from coec.io.ros.wire_format import STATIC, Qos
from coec.io.zenoh.ros_node import RosPublishers
from coec.service.ros_output import PairOutput, RosOutputs, VehicleOutput
from coec.service.worker.supervisor import Worker
from support.fake_worker import wait_until
from support.recorded_topics import RetainedTopic, RetainedTopics
from support.vehicles import BEGIN_S, DRIVE_END_S, STEP_S, OracleWorker, PairBench

OK, WARN, ERROR, STALE = range(4)
INFO, OVERLAY = "/coec/front/camera/camera_info", "/coec/front/overlay/compressed"
ALL = RosConfig(publish=("diagnostics", "tf_static", "camera_info", "overlay"))


class Reported:
    """Outputs on kept topics, of what a bench knows."""

    def __init__(self, bench: PairBench, ros: RosConfig) -> None:
        self.bench = bench
        self.service: ServicePhase = "running"
        self.rig: Rig | None = bench.answers.rig
        self.topics = RetainedTopics()
        self.config: Config = bench.config.model_copy(update={"ros": ros, "middleware": "rmw_zenoh"})
        self.outputs = RosOutputs(cast("RosPublishers", self.topics), self.config, cast("Worker", OracleWorker()))

    def view(self) -> VehicleOutput:
        answers = self.bench.answers
        return VehicleOutput(
            self.service, (PairOutput(answers.health_reply, "SN-1", answers.extrinsic_reply, self.rig),)
        )

    def topic(self, name: str) -> RetainedTopic:
        wait_until(lambda: name in self.topics.topics, name)
        return self.topics.topics[name]

    def status_that(self, condition: Callable[[Any], bool]) -> Any:
        """The first diagnostics of the pair, from now on, that are so."""
        self.topic("/diagnostics").rest()
        self.outputs.wake()
        while True:
            (status,) = self.topic("/diagnostics").next().status
            if condition(status):
                return status

    def drive_until(self, state: str, second: int) -> int:
        """On from a second, to the first at which the pair is in this state."""
        while self.bench.answers.health_reply.state != state:
            assert second < DRIVE_END_S, state
            self.bench.drive(second, second + 1)
            second += 1
        return second

    def values(self) -> dict[str, str]:
        return {value.key: value.value for value in self.status_that(lambda _: True).values}


@pytest.fixture
def reported(tmp_path: Path) -> Iterator[Reported]:
    reported = Reported(PairBench(tmp_path), ALL)
    reported.outputs.start(reported.view)
    yield reported
    assert reported.outputs.close(20.0)


def test_topics_are_declared_as_ros_expects_them(reported: Reported) -> None:
    reported.status_that(lambda _: True)
    assert {name: (topic.type_name, topic.qos) for name, topic in reported.topics.topics.items()} == {
        "/diagnostics": ("diagnostic_msgs/msg/DiagnosticArray", Qos(depth=1)),
        "/tf_static": ("tf2_msgs/msg/TFMessage", STATIC),
        INFO: ("sensor_msgs/msg/CameraInfo", STATIC),
        OVERLAY: ("sensor_msgs/msg/CompressedImage", Qos(depth=1)),
    }


@pytest.mark.fault("a knock", "ERROR on ROS's diagnostics, and the new frame once it is served")
def test_a_knock_is_an_error_until_the_new_calibration_is_served(reported: Reported) -> None:
    assert reported.status_that(lambda _: True).level == STALE
    assert reported.topic("/tf_static").rest() == []
    assert reported.values()["tf"] == "not published: nominal still"

    reported.bench.drive(BEGIN_S, STEP_S)
    fine = reported.status_that(lambda status: status.level == OK)
    assert (fine.name, fine.hardware_id) == ("coec: front_calibration", "SN-1")
    before = reported.topic("/tf_static").next()
    assert before.transforms[0].child_frame_id == "camera_calibrated"

    second = reported.drive_until("miscalibrated", STEP_S)
    assert reported.status_that(lambda status: status.level == ERROR).message.startswith("miscalibrated: ")
    reported.drive_until("healthy", second)
    reported.status_that(lambda status: status.level == OK)
    after = reported.topic("/tf_static").next()
    assert after.transforms[0].transform.rotation != before.transforms[0].transform.rotation


def test_diagnostics_come_unasked(reported: Reported) -> None:
    stamps = [reported.topic("/diagnostics").next().header.stamp for _ in range(2)]
    times_s = [stamp.sec + stamp.nanosec / 1e9 for stamp in stamps]
    assert times_s == sorted(times_s)


@pytest.mark.fault("the thread that decides about a pair stands still", "STALE on ROS's diagnostics, whatever it said")
def test_what_nobody_renews_is_stale(reported: Reported, monkeypatch: pytest.MonkeyPatch) -> None:
    reported.bench.drive(BEGIN_S, STEP_S)
    assert reported.status_that(lambda status: status.level == OK)
    monkeypatch.setattr("coec.service.api.reply_builders.OLD_S", -1.0)
    assert "service_stuck" in str(reported.status_that(lambda status: status.level == STALE).values)


def test_the_last_word_is_that_the_service_stops(tmp_path: Path) -> None:
    reported = Reported(PairBench(tmp_path), ALL)
    reported.outputs.start(reported.view)
    reported.status_that(lambda _: True)
    reported.service = "stopping"
    assert reported.outputs.close(20.0)
    (last,) = reported.topic("/diagnostics").rest()[-1].status
    assert (last.level, last.message) == (STALE, "unknown, service stopping: No window has been evaluated yet.")
    assert all(topic.closed for topic in reported.topics.topics.values())


def test_intrinsics_are_reported_as_they_are_or_fitted_or_not_at_all(reported: Reported) -> None:
    assert reported.topic(INFO).next().distortion_model == "plumb_bob"
    assert reported.values()["camera_info"] == "as configured"
    size = {"width": 640, "height": 480, "fx": 300.0, "fy": 310.0, "cx": 320.0, "cy": 235.0}
    rig = reported.bench.answers.rig

    reported.rig = replace(rig, camera=build("double_sphere", **size, xi=-0.2, alpha=0.59))
    assert "at most 0.00" in reported.status_that(lambda s: "equidistant" in str(s.values)).values[-1].value
    while reported.topic(INFO).next().distortion_model != "equidistant":
        pass

    reported.rig = replace(
        rig, camera=build("mei", **size | {"fx": 700.0}, xi=2.2, k1=0.0168, k2=1.6549, p1=0.05, p2=0.0004)
    )
    reported.status_that(lambda status: "more than 0.5 px" in str(status.values))


def test_of_a_pair_that_is_not_known_yet_health_alone_is_reported(tmp_path: Path) -> None:
    reported = Reported(PairBench(tmp_path), ALL)
    reported.outputs.start(
        lambda: VehicleOutput("starting", (PairOutput(reported.bench.answers.health_reply, None, None, None),)),
    )
    status = reported.status_that(lambda _: True)
    assert (status.level, status.hardware_id) == (STALE, "test/front")
    assert reported.outputs.close(20.0)
    assert reported.topic("/tf_static").rest() == reported.topic(INFO).rest() == []


def test_who_wants_nothing_reported_has_no_thread_and_no_topic(tmp_path: Path) -> None:
    reported = Reported(PairBench(tmp_path), RosConfig())
    reported.outputs.start(reported.view)
    assert reported.outputs.threads == ()
    assert reported.outputs.close(1.0)
    assert reported.topics.topics == {}
    deaf = RosOutputs(None, reported.config.model_copy(update={"ros": ALL}), cast("Worker", OracleWorker()))
    deaf.start(reported.view)
    deaf.wake()
    assert deaf.threads == ()
    assert deaf.close(1.0)
