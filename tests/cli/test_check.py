"""`coec check`: a table for people, a document for programs, and an exit code."""

from __future__ import annotations

import re
from pathlib import Path

from cli.conftest import SMALL, Coec
from golden.scene import Drive, write
from support.recordings import Bag, drive_messages


def test_a_good_recording_is_tabulated_and_tried(coec: Coec, tmp_path: Path) -> None:
    outcome = coec("check", write(Drive(seed=2), tmp_path), "--depth", "stereo")
    assert outcome.status == 0
    assert "camera" in outcome.out
    assert "100% of the camera frames have a sweep" in outcome.out
    assert "8 pairs, tried at the recording's own extrinsic" in outcome.out
    assert "will refuse" not in outcome.out


def test_a_recording_that_calibrate_refuses_is_predicted_to_be(coec: Coec) -> None:
    outcome = coec("check", SMALL, "--depth", "stereo")
    assert outcome.status == 1
    assert "fail  calibrate will refuse this, because " in outcome.out
    calibrated = coec("calibrate", SMALL, "--depth", "stereo", "--json")
    assert calibrated.status == 1
    (first, *_) = calibrated.document["verdict"]["reasons"]
    assert first["text"] in outcome.out


def test_json_has_the_same(coec: Coec) -> None:
    document = coec("check", SMALL, "--depth", "stereo", "--json").document
    assert document["prediction"] == "refused"
    assert document["remarks"][0]["level"] == "fail"
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


def test_a_single_frame_that_calibrate_accepts_is_not_predicted_to_be_refused(coec: Coec, sample_data: Path) -> None:
    source = sample_data / "kitti360_fisheye"
    accepted = coec("calibrate", source).status == 0
    predicted = coec("check", source, "--json")
    assert predicted.document["camera"]["frames"] == 1
    assert predicted.document["prediction"] != ("refused" if accepted else "accepted")
    assert predicted.status == int(predicted.document["prediction"] == "refused")


def test_damaged_frames_are_counted_by_check_and_calibrate(coec: Coec, tmp_path: Path) -> None:
    source = write(Drive(seed=2), tmp_path)
    image = sorted(source.glob("**/*.png"))[0]
    image.write_bytes(image.read_bytes()[:-20])
    checked = coec("check", source, "--depth", "stereo")
    assert f"warn  Frames or records are left out, 1 damaged (1 image_truncated); the first: {image}" in checked.out
    document = coec("calibrate", source, "--depth", "stereo", "--objective", "mi", "--json").document
    assert document["pairs"] == 7
    assert [one["code"] for one in document["recognitions"]] == ["damaged_frames"]
