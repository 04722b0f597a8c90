"""`coec check`: a table for people, a document for programs, and an exit code."""

from __future__ import annotations

import re
from pathlib import Path

from cli.conftest import SMALL, Coec
from support.recordings import Bag, drive_messages


def test_a_good_recording_is_tabulated_and_tried(coec: Coec) -> None:
    outcome = coec("check", SMALL, "--depth", "stereo")
    assert outcome.status == 0
    assert "camera" in outcome.out
    assert "100% of the camera frames have a sweep" in outcome.out
    assert "6 pairs, tried at the recording's own extrinsic" in outcome.out


def test_json_has_the_same(coec: Coec) -> None:
    document = coec("check", SMALL, "--depth", "stereo", "--json").document
    assert document["camera"]["frames"] == 6
    assert document["trial"]["pairs"] == 6
    assert len(document["trial"]["sigma"]) == 6
    assert document["lidar"]["rate_hz"] == 0.5


def test_a_bag_of_which_nothing_can_come_says_why(coec: Coec, tmp_path: Path) -> None:
    few = [m for m in drive_messages() if m[0] != "/front/image"] + [
        m for m in drive_messages() if m[0] == "/front/image"
    ][:2]
    outcome = coec("check", Bag(few).write(tmp_path / "bag.mcap"))
    assert outcome.status == 1
    assert "fail  2 camera frames; a calibration needs 4." in outcome.out


def test_several_topics_are_listed_with_types_and_counts(coec: Coec, tmp_path: Path) -> None:
    other = [("/rear/points", message) for topic, message in drive_messages() if topic == "/points"]
    outcome = coec("check", Bag([*drive_messages(), *other]).write(tmp_path / "bag.mcap"))
    assert outcome.status == 1
    assert "/rear/points (sensor_msgs/msg/PointCloud2, 8 messages)" in outcome.err
    assert re.search(r"/odom +nav_msgs/msg/Odometry +20 +\d", outcome.out)
    reported = coec("check", tmp_path / "bag.mcap", "--json")
    assert (reported.status, reported.document["error"]["code"]) == (1, "bad_source")
