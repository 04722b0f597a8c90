"""What is answered about a pair that is awaited: always something, never a pose."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from coec.calibration.types import Reason
from coec.io.exported_extrinsic import ExportFrames
from coec.io.ros.wire_format import Publisher
from coec.io.zenoh.ros_node import RosTopicList
from coec.schemas.commands import COMMAND_NAMES
from coec.service.api.pair_answers import PendingPairAnswers, PendingPairError
from coec.service.discovery_listener import NominalStatus
from support.pending_pairs import CAMERA, INFO, POINTS, World, configured

NO_INFO = Reason("no_camera_info", "No CameraInfo on /front/camera_info yet.")
NO_CLOUD = Reason("no_cloud", "No sweep yet.")


class Pending:
    """A pair that waits for what a test says."""

    def __init__(self, folder: Path) -> None:
        self.nominal = NominalStatus(awaits=(NO_INFO, NO_CLOUD))
        self.world = World(folder, lambda _: self.nominal)
        self.answers = PendingPairAnswers(configured(folder).awaited[0], "vehicle", self.world.context)

    @property
    def health(self) -> dict[str, Any]:
        document: dict[str, Any] = json.loads(self.answers.health("json").payload)
        return document


@pytest.fixture
def pending(tmp_path: Path) -> Pending:
    return Pending(tmp_path)


def codes(health: dict[str, Any]) -> list[str]:
    return [reason["code"] for reason in health["reasons"]]


def test_its_health_is_unknown_and_says_what_is_missing(pending: Pending) -> None:
    health = pending.health
    assert (health["state"], health["level"], health["evaluated_ns"]) == ("unknown", 3, None)
    assert codes(health) == ["no_camera_info", "no_cloud"]
    assert health["needs"][:2] == [NO_INFO.text, NO_CLOUD.text]


def test_topics_that_nobody_publishes_are_named_with_those_that_are_there(pending: Pending) -> None:
    there = [Publisher(CAMERA, "sensor_msgs/msg/CompressedImage", "/driver", bytes(16))]
    there.append(Publisher("/rear/points", "sensor_msgs/msg/PointCloud2", "/driver", bytes(16)))
    pending.world.topics = RosTopicList(tuple(there))
    pending.answers.renew()
    needs = pending.health["needs"]
    assert f"no publisher of {POINTS}; there are: /rear/points" in needs
    assert any(need.startswith(f"no publisher of {INFO}") for need in needs)
    assert not any(need.startswith(f"no publisher of {CAMERA}") for need in needs)


def test_health_is_published_when_its_reasons_change_and_not_otherwise(pending: Pending) -> None:
    assert [key for key, _ in pending.world.published] == ["coec/@v1/vehicle/front/health"]
    pending.answers.renew()
    assert len(pending.world.published) == 1
    pending.nominal = NominalStatus(awaits=(NO_CLOUD,))
    pending.answers.renew()
    pending.world.problems = (Reason("disk_full", "The disk is full."),)
    pending.answers.renew()
    pending.answers.fail(Reason("thread_died", "The thread discovery died."))
    assert len(pending.world.published) == 4
    assert codes(pending.health) == ["no_cloud", "disk_full", "thread_died"]


@pytest.mark.fault("a question about a pair that has no nominal calibration yet", "an error that says what is missing")
@pytest.mark.parametrize(
    "query",
    [
        lambda a: a.calibrated.extrinsic("json"),
        lambda a: a.calibrated.exported("urdf", ExportFrames(None, None)),
        lambda a: a.calibrated.history(0, 2**63 - 1, 10),
        lambda a: a.calibrated.windows("json"),
        lambda a: a.calibrated.read_window("front-1", 0, 1),
        lambda a: a.calibrated.events(),
        lambda a: a.calibrated.event("1"),
        lambda a: a.calibrated.event_overlay("1", "before"),
        lambda a: a.calibrated.overlay(None, nominal=True),
    ],
)
def test_every_other_question_ends_in_an_error_that_says_what_is_missing(
    pending: Pending, query: Callable[[PendingPairAnswers], object]
) -> None:
    with pytest.raises(
        PendingPairError, match=r"waits for its nominal calibration\. No CameraInfo .* No sweep yet"
    ) as why:
        query(pending.answers)
    assert why.value.reply_code == "awaiting"
    pending.nominal = NominalStatus(awaits=(NO_CLOUD,))
    with pytest.raises(PendingPairError, match=r"calibration\. No sweep yet"):
        query(pending.answers)


@pytest.mark.parametrize("name", COMMAND_NAMES)
def test_a_command_is_acknowledged_refused_and_counted(pending: Pending, name: str) -> None:
    reported = pending.answers.commands.carry_out(name, {}, "operator")
    assert (reported.accepted, reported.code, reported.command) == (False, "awaiting", name)
    assert NO_INFO.text in reported.text
    pending.answers.commands.note_refused(name, "stranger", PendingPairError("no"))
    pending.answers.commands.note_refused("\x1b[2J" * 100, "stranger", PendingPairError("no"))
    assert pending.answers.status().commands == {
        f"{name}_refused": 1,
        f"{name}_not_allowed": 1,
        "unknown_not_allowed": 1,
    }


def test_its_status_has_what_was_lost_and_what_was_discovered_so_far(pending: Pending) -> None:
    pending.nominal = NominalStatus(
        awaits=(NO_CLOUD,), origins={"camera.frame_id": "the latest image"}, losses={"info_wrong_type": 3}
    )
    status = pending.answers.status()
    assert [reason.code for reason in status.awaits] == ["no_cloud"]
    assert (status.found, status.losses) == ({"camera.frame_id": "the latest image"}, {"info_wrong_type": 3})
    assert status.ego is None, "it has no such stream"
