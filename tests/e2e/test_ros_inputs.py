"""The running service on a vehicle that speaks ROS 2, with drivers that behave as drivers do on a bad day."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Any

import pytest

from coec.calibration.types import CameraFrame
from e2e.drives import SHORT, Drive, rendered
from e2e.processes import Router, Service, by_topics, coec, service, write_configuration
from support.fake_worker import wait_until
from support.ros import HASHES, RosDriver, cdr_message

pytest.importorskip("embreex", reason="needs embreex")

TOPICS = {"camera": "/front/image_raw/compressed", "lidar": "/top/points", "ego": "/odometry"}
FLOOD = 4200
"""Tokens; the service keeps 4,096."""


@pytest.fixture(scope="module")
def drive() -> Drive:
    return rendered(SHORT)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory, drive: Drive, router: Router) -> Iterator[Service]:
    folder = tmp_path_factory.mktemp("ros")
    config = by_topics(write_configuration(folder, drive.recording, router.endpoint), "rmw_zenoh", TOPICS)
    with service(config, router, warm=False) as running:
        yield running
        assert running.terminate() == 0


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def driver(
    stack: ExitStack, router: Router, topic: str, type_name: str, number: int, node: str = "driver"
) -> RosDriver:
    made = RosDriver(router.session, topic, type_name, number, node)
    stack.callback(made.close)
    return made


def pictures(drive: Drive) -> Iterator[bytes]:
    """One after the other, each later than the one before."""
    first = next(frame for frame in drive.frames if isinstance(frame, CameraFrame))
    number = 0
    while True:
        number += 1
        yield cdr_message(replace(first, stamp_ns=first.stamp_ns + number * 10**8, depth=None))


def losses(running: Service) -> Any:
    return running.counters()["camera"]["losses"]


def reasons(running: Service) -> dict[str, str]:
    return {reason["code"]: reason["text"] for reason in running.health()["reasons"]}


def test_ros_sees_who_listens_and_a_topic_that_nobody_publishes_is_reported(
    stack: ExitStack, running: Service, router: Router
) -> None:
    driver(stack, router, "/rear/image_raw/compressed", "CompressedImage", 10, "rear_camera")

    def reported(health: Any) -> bool:
        expected = f"camera: no publisher of {TOPICS['camera']}; there are: /rear/image_raw/compressed"
        return expected in health["needs"]

    running.until(running.health, reported, "who is missing, and who is there")
    replies = list(router.session.liveliness().get("@ros2_lv/0/*/0/*/*/%/%vehicle/coec/**", timeout=20.0))
    kinds = sorted(str(reply.ok.key_expr).split("/")[5] for reply in replies if reply.ok is not None)
    assert kinds == ["MS", "MS", "MS", "NN"]
    examined = coec("doctor", "--config", running.log.with_name("coec.yaml"), "--seconds", 1)
    assert "/rear/image_raw/compressed (sensor_msgs/msg/CompressedImage, by /rear_camera)" in examined.stdout
    assert f"no publisher of {TOPICS['camera']}" in examined.stdout


def _has_received(pictures: int, pair: Any) -> bool:
    return bool(pair["camera"]["received"] >= pictures)


@pytest.mark.fault("two publishers on one topic of a running service", "health names their nodes until one ends")
def test_two_drivers_on_one_topic_are_a_problem_with_their_names(
    stack: ExitStack, running: Service, router: Router, drive: Drive
) -> None:
    images, sent = pictures(drive), running.counters()["camera"]["received"]
    left, right = (
        driver(stack, router, TOPICS["camera"], "CompressedImage", number, node)
        for number, node in ((10, "left_driver"), (20, "right_driver"))
    )
    for _ in range(6):
        left.put(next(images))
        right.put(next(images))
        sent += 2
    reported = running.until(lambda: reasons(running), lambda reported: "two_senders" in reported, "two senders")
    assert reported["two_senders"].startswith(
        f"2 publishers send on {TOPICS['camera']} at the same time: /left_driver, /right_driver."
    )
    for _ in range(8):  # in portions that the inbox holds, each once the counters know of the one before
        for _ in range(9):
            left.put(next(images))
            sent += 1
        running.until(running.counters, partial(_has_received, sent), "they are taken")
    running.until(lambda: reasons(running), lambda reported: "two_senders" not in reported, "one sender")
    assert "sequence_gap" not in losses(running)


@pytest.mark.fault(
    "a ROS driver that sends rubbish: other types, attachments cut short, numbers that jump",
    "each counted by its cause",
)
def test_what_babbles_is_counted_by_its_cause(stack: ExitStack, running: Service, router: Router, drive: Drive) -> None:
    images, before, sent = pictures(drive), losses(running), running.counters()["camera"]["received"]
    true = driver(stack, router, TOPICS["camera"], "CompressedImage", 10)
    clouds = driver(stack, router, TOPICS["camera"], "PointCloud2", 20, "another")
    clouds.put(b"\0\1\0\0")
    true.publisher.put(next(images), attachment=b"cut short")
    true.publisher.put(next(images), attachment=None)
    sent += 3
    for number in (1, 900, *range(901, 918)):
        true.put(next(images), number)
        sent += 1
        running.until(running.counters, partial(_has_received, sent), "it is taken")

    def new(losses: Any) -> dict[str, int]:
        return {
            cause: losses.get(cause, 0) - before.get(cause, 0)
            for cause in ("wrong_type", "attachment_malformed", "sequence_gap")
        }

    expected = {"wrong_type": 1, "attachment_malformed": 2, "sequence_gap": 898}
    running.until(lambda: losses(running), lambda reported: new(reported) == expected, "every cause")


@pytest.mark.fault(
    "thousands of liveliness tokens on the vehicle's network", "the service answers, and hears its topic"
)
def test_a_flood_of_tokens_leaves_the_service_as_it_is(
    stack: ExitStack, running: Service, router: Router, drive: Drive
) -> None:
    zid = router.session.info.zid()
    for number in range(FLOOD):
        token = f"@ros2_lv/0/{zid}/9/{number}/MP/%/%/flood/%t{number}/std_msgs::msg::dds_::String_/{HASHES['Image']}/::"
        stack.callback(router.session.liveliness().declare_token(token).undeclare)
    before = running.until(running.counters, lambda _: True, "an answer")["camera"]["accepted"]
    true = driver(stack, router, TOPICS["camera"], "CompressedImage", 10)
    images = pictures(drive)
    wait_until(
        lambda: running.counters()["camera"]["accepted"] > before or true.sends(next(images)), "a picture is taken"
    )
