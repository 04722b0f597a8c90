"""The rig: what is put together is told to the pairs at one sensor time, kept, and the same every time."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from coec.io.storage import StateFile
from coec.schemas.keys import Keys
from coec.schemas.message import from_json, to_json
from coec.schemas.rig_state import RigReply
from coec.service.api.problems import INCONSISTENT, rig_problems
from coec.service.api.rig_answers import RigAnswers, reply_of
from coec.service.engine.rig import LAG_NS, QUIET_TICKS, RigSnapshot
from coec.service.records.rig_store import RIG_FILE, RigStore
from support.rigs import (
    CAMERAS,
    NS,
    POSES,
    SIGMA,
    RigEstimatorBench,
    moved_poses,
    pair_check,
    pair_config,
    pair_pose,
    pair_state,
    pair_window,
    served_extrinsic,
)

DISPLACED_S = 45.0
AFTER = moved_poses("roof")


def drive(reported: RigEstimatorBench, until_s: float, seed: int | None = None, begin_s: float = 0.0) -> None:
    """Checks every 5 s, the LiDAR knocked at `KNOCKED_S`, a window of each pair 12 s after it. A seed draws which of
    the pairs comes first, and how long it is in front."""
    errors, rng = np.random.default_rng(5), random.Random(seed)
    stamps = np.arange(begin_s, until_s, 1.0).tolist()
    for at_s in stamps:
        cameras = list(CAMERAS)
        if seed is not None:
            rng.shuffle(cameras)
        rendered = {camera: SIGMA * errors.normal(size=6) for camera in CAMERAS}
        for camera in cameras:
            poses = POSES if at_s - 5.0 < DISPLACED_S else AFTER
            due = at_s >= 5.0 and at_s % 5.0 == CAMERAS.index(camera)
            reported.must_wait(camera, at_s, waits=due)
            if due:
                reported.put(camera, at_s, pair_check(camera, poses, at_s - 5.0, rendered[camera]))
            if at_s == DISPLACED_S + 30.0:
                reported.put(camera, at_s, pair_window(camera, AFTER, DISPLACED_S + 12.0))
                reported.put(camera, at_s, served_extrinsic(camera, AFTER, DISPLACED_S + 12.0))
            reported.must_wait(camera, at_s)
            if seed is None or rng.random() < 0.5:
                reported.settle()
    reported.settle()


def reply(reported: RigEstimatorBench) -> RigReply:
    return reply_of("vehicle", reported.known)


def states(reported: RigEstimatorBench) -> dict[str, str]:
    return {sensor.name: sensor.state for sensor in reply(reported).sensors}


@pytest.mark.fault("the LiDAR of a vehicle is knocked", "it is named, and all pairs are told from one sensor time on")
def test_a_correction_comes_to_all_pairs_at_one_sensor_time(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    reported = RigEstimatorBench(tmp_path)
    drive(reported, DISPLACED_S + 25.0)
    assert states(reported) == {
        "front": "calibrated",
        "left": "calibrated",
        "rear": "calibrated",
        "roof": "lidar_moved",
    }
    drive(reported, DISPLACED_S + 32.0, begin_s=DISPLACED_S + 25.0)
    last = reply(reported).correction
    assert last is not None
    assert last.sensors == ("roof",)
    assert last.from_ns == round((DISPLACED_S + 30.0) * NS) + LAG_NS
    for camera in CAMERAS:
        assert reported.pairs[camera].corrections(last.from_ns - 1) == []
        (correction,) = reported.pairs[camera].corrections(last.from_ns)
        assert "roof" in correction.text
        assert correction.joint_pose.T_a_b == pytest.approx(pair_pose(camera, AFTER), abs=1e-4)
        assert reported.pairs[camera].corrections(last.from_ns) == []
    record_property("figure", f"{LAG_NS / NS:.0f} s")


def test_windows_of_a_named_sensor_are_requested_of_all_its_pairs_from_one_sensor_time_on(tmp_path: Path) -> None:
    reported = RigEstimatorBench(tmp_path)
    drive(reported, DISPLACED_S + 25.0)
    move = reply(reported).move
    assert move is not None
    from_ns = move.since_ns + 5 * NS + LAG_NS  # a look counts five seconds later
    for camera in CAMERAS:
        assert reported.pairs[camera].pop_window_request(from_ns - 1) is None
        since_ns = reported.pairs[camera].pop_window_request(from_ns)
        assert since_ns is not None
        assert DISPLACED_S * NS <= since_ns <= move.since_ns, "of no frames from before the knock"
        assert reported.pairs[camera].pop_window_request(from_ns) is None, "once"


def test_what_was_requested_of_another_time_is_forgotten(tmp_path: Path) -> None:
    reported = RigEstimatorBench(tmp_path)
    drive(reported, DISPLACED_S + 25.0)
    reported.pairs["left"].time_stepped_back(round(1.0 * NS))
    reported.settle()
    assert all(reported.pairs[camera].pop_window_request(2**62) is None for camera in CAMERAS)


@pytest.mark.fault("pairs of a rig are known in another order in a replay", "the same reply, to the byte")
def test_a_replay_says_the_same_to_the_byte(tmp_path: Path) -> None:
    report = set()
    for seed in (None, 1):
        reported = RigEstimatorBench(tmp_path / str(seed))
        drive(reported, DISPLACED_S + 40.0, seed)
        report.add(to_json(reply(reported)))
    assert len(report) == 1


def test_frames_wait_until_the_rig_has_decided_what_counts_for_them(tmp_path: Path) -> None:
    reported = RigEstimatorBench(tmp_path)
    for camera in CAMERAS:
        reported.must_wait(camera, 10.0)
    reported.must_wait("left", 11.0, waits=True)
    assert not reported.must_wait("front", 10.0 + LAG_NS / NS)
    assert reported.must_wait("front", 10.1 + LAG_NS / NS)
    reported.must_wait("rear", 20.0)
    reported.put("left", 11.0, pair_check("left", POSES, 6.0, np.zeros(6)))
    reported.must_wait("left", 11.0)
    reported.must_wait("left", 20.0)
    reported.settle()
    assert not reported.must_wait("front", 10.1 + LAG_NS / NS)


def test_a_vehicle_of_one_pair_has_no_rig_and_waits_for_none(tmp_path: Path) -> None:
    reported = RigEstimatorBench(tmp_path, ("front",))
    assert not reported.must_wait("front", 10.0)
    assert not reported.must_wait("front", 1000.0)
    reported.put("front", 5.0, pair_check("front", POSES, 5.0, np.zeros(6)))
    reported.settle()
    assert len(reported.states) == 2
    assert states(reported) == {"front": "undecided", "roof": "undecided"}
    assert [sensor.probability for sensor in reply(reported).sensors] == [None, None]


@pytest.mark.fault("a LiDAR is knocked while the service is down", "named by the first checks after the restart")
def test_what_was_known_outlives_a_restart(tmp_path: Path) -> None:
    reported = RigEstimatorBench(tmp_path)
    drive(reported, 44.0)
    reported.estimator.finish()
    reported.disk_writer.write_due()
    again = RigEstimatorBench(tmp_path)
    drive(again, DISPLACED_S + 25.0, begin_s=DISPLACED_S + 5.0)
    assert states(again)["roof"] == "lidar_moved"


def test_a_sensor_that_had_moved_is_so_after_a_restart(tmp_path: Path) -> None:
    reported = RigEstimatorBench(tmp_path)
    drive(reported, DISPLACED_S + 25.0)
    reported.estimator.finish()
    reported.disk_writer.write_due()
    again = RigEstimatorBench(tmp_path)
    assert states(again) == {"front": "unknown", "left": "unknown", "rear": "unknown", "roof": "lidar_moved"}
    (sensor,) = [one for one in reply(again).sensors if one.name == "roof"]
    assert [reason.code for reason in sensor.reasons] == ["last_known"]


MIRRORED = np.diag([-1.0, 1.0, 1.0, 1.0]).tolist()
GOOD_EDGE = {"nominal": np.eye(4).tolist(), "T_camera_lidar": np.eye(4).tolist(), "sigma": [None] * 6}
BAD_EDGE = {"nominal": np.eye(4).tolist(), "T_camera_lidar": np.ones((4, 4)).tolist(), "sigma": [None] * 6}


GOOD_EVENT = {"sensors": ["roof"], "since_ns": 0, "stepped_ns": 0, "named": ["roof"]}
GOOD_KNOWN = {
    "T_camera_lidar": np.eye(4).tolist(),
    "noise": np.diag(SIGMA**2).tolist(),
    "systematic": {"lens_down": [1e-4] * 6},
    "stamp_ns": 0,
}


def after(before: dict[str, object]) -> dict[str, object]:
    """A file of a move that goes on, with what was known before it."""
    return {"edges": {}, "event": {**GOOD_EVENT, "before": before}}


@pytest.mark.fault("the file of the rig was written by somebody else", "refused, counted, kept aside; learnt anew")
@pytest.mark.parametrize(
    "body",
    [
        {"edges": {"front-roof": BAD_EDGE}},
        {"edges": {"front-roof": {**BAD_EDGE, "T_camera_lidar": np.eye(4).tolist(), "sigma": [-1.0] * 6}}},
        {"edges": {str(number): BAD_EDGE for number in range(100)}},
        {"edges": {}, "event": {"sensors": ["x"] * 40, "since_ns": 0, "stepped_ns": 0, "named": []}},
        {"edges": {}, "event": {"sensors": ["x"], "since_ns": 2**70, "stepped_ns": 0, "named": []}},
        {"edges": [1, 2]},
        {"edges": {"front-roof": {**GOOD_EDGE, "sigma": [1e300] * 6}}},
        {"edges": {"front-roof": {**GOOD_EDGE, "nominal": [[1.0] * 4] * 3}}},
        {"edges": {"front-roof": {**GOOD_EDGE, "T_camera_lidar": MIRRORED}}},
        {"edges": {"x" * 10_000: GOOD_EDGE}},
        {"edges": {}, "event": {"sensors": [], "since_ns": 0, "stepped_ns": 0, "named": []}},
        {"edges": {}, "event": {"sensors": ["roof"], "since_ns": 0.5, "stepped_ns": 0, "named": []}},
        {"edges": {}, "event": "roof moved"},
        after({"front-roof": {**GOOD_KNOWN, "noise": np.ones((6, 6)).tolist()}}),
        after({"front-roof": {**GOOD_KNOWN, "T_camera_lidar": MIRRORED}}),
        after({"front-roof": {**GOOD_KNOWN, "systematic": {"x": [1e9] * 6}}}),
        after({str(number): GOOD_KNOWN for number in range(200)}),
        {},
    ],
)
def test_a_hostile_file_is_refused(tmp_path: Path, body: dict[str, object]) -> None:
    StateFile(tmp_path / RIG_FILE).save(body)
    reported = RigEstimatorBench(tmp_path)
    assert [reason.code for reason in reported.known.why] == ["rig_state_damaged"]
    assert reported.known.losses == {"state_damaged": 1}
    reported.estimator.finish()
    reported.disk_writer.write_due()
    assert (tmp_path / f"{RIG_FILE}.broken").exists()
    assert RigEstimatorBench(tmp_path).known.why == ()


@pytest.mark.fault("an edge, or a move, in the file of the rig that cannot be read", "the other edges are kept")
@pytest.mark.parametrize(
    ("name", "value", "retained"),
    [
        ("edges", {"front-roof": GOOD_EDGE, "rear-roof": BAD_EDGE}, {"front-roof"}),
        ("edges", {"front-roof": 3, "rear-roof": GOOD_EDGE}, {"rear-roof"}),
        ("event", "roof moved", {"front-roof", "rear-roof"}),
    ],
)
def test_an_edge_that_cannot_be_read_falls_back_alone(
    tmp_path: Path, name: str, value: object, retained: set[str]
) -> None:
    body: dict[str, object] = {"edges": {"front-roof": GOOD_EDGE, "rear-roof": GOOD_EDGE}, "event": GOOD_EVENT}
    StateFile(tmp_path / RIG_FILE).save(body | {name: value})
    file = RigStore(tmp_path)
    assert [reason.code for reason in file.damage] == ["rig_state_damaged"]
    assert set(file._edges) == retained
    assert (file._event is None) == (name == "event")


def test_fields_that_a_newer_version_added_to_the_file_of_the_rig_are_ignored(tmp_path: Path) -> None:
    edges = {"front-roof": {**GOOD_EDGE, "trust": 3}}
    StateFile(tmp_path / RIG_FILE).save({"edges": edges, "event": {**GOOD_EVENT, "who": {}}, "links": []})
    file = RigStore(tmp_path)
    assert file.damage == ()
    assert set(file._edges) == {"front-roof"}


@pytest.mark.fault(
    "the file of the rig says that an edge was a kilometre off", "looks count as usual, and the reply is whole"
)
def test_a_file_that_lies_within_its_form_harms_nothing(tmp_path: Path) -> None:
    far = np.eye(4)
    far[0, 3] = 1000.0
    edges = {f"{camera}-roof": {"nominal": pair_pose(camera, POSES).tolist(), "T_camera_lidar": far.tolist(),
                                "sigma": [9.0] * 6} for camera in CAMERAS}  # fmt: skip
    event = {"sensors": ["front"], "since_ns": 2**62, "stepped_ns": 2**62, "named": ["front"]}
    StateFile(tmp_path / RIG_FILE).save({"edges": edges, "event": event})
    reported = RigEstimatorBench(tmp_path)
    assert reported.known.why == ()
    drive(reported, 44.0)
    assert reported.known.losses.get("refused", 0) == 0, "looks are taken as any"
    from_json(RigReply, to_json(reply(reported)))


@pytest.mark.fault("the file of the rig is damaged", "refused, counted; learnt anew")
def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / RIG_FILE).write_text(json.dumps({"body": {"edges": {}}, "checksum": "0", "schema_version": 1}))
    assert RigEstimatorBench(tmp_path).known.losses == {"state_damaged": 1}


def test_sensors_of_an_event_that_the_vehicle_has_no_more_are_forgotten(tmp_path: Path) -> None:
    event = {"sensors": ["trunk"], "since_ns": 5, "stepped_ns": 4, "named": ["trunk"]}
    StateFile(tmp_path / RIG_FILE).save({"edges": {}, "event": event})
    assert set(states(RigEstimatorBench(tmp_path)).values()) == {"unknown"}


def test_numbers_that_are_no_evidence_are_counted_and_harm_nothing(tmp_path: Path) -> None:
    reported = RigEstimatorBench(tmp_path)
    bad = pair_window("front", POSES, 1.0)
    bad.measurement.uncertainty.noise[:] = np.ones((6, 6))
    reported.put("front", 5.0, bad)
    for camera in CAMERAS:
        reported.must_wait(camera, 6.0)
    reported.settle()
    assert reported.known.losses == {"refused": 1}
    drive(reported, 30.0, begin_s=10.0)
    assert set(states(reported).values()) == {"calibrated"}


def test_the_clock_of_the_sensors_steps_back_and_the_drive_goes_on(tmp_path: Path) -> None:
    reported = RigEstimatorBench(tmp_path)
    drive(reported, 40.0)
    reported.pairs["front"].time_stepped_back(0)
    reported.pairs["left"].time_stepped_back(0)
    reported.pairs["rear"].time_stepped_back(0)
    drive(reported, DISPLACED_S + 25.0)
    assert states(reported)["roof"] == "lidar_moved"
    assert reported.known.losses == {"time_stepped_back": 3}


class Publishing(list[RigSnapshot]):
    """Publishes what is appended."""

    def __init__(self, publish: Callable[[RigSnapshot], None]) -> None:
        super().__init__()
        self._publish = publish

    def append(self, snapshot: RigSnapshot) -> None:
        super().append(snapshot)
        self._publish(snapshot)


def test_the_reply_survives_the_wire_and_is_published_on_change(tmp_path: Path) -> None:
    published: list[str] = []
    answers = RigAnswers(Keys("coec", "vehicle"), lambda key, _: published.append(key))
    reported = RigEstimatorBench(tmp_path)
    reported.states = Publishing(answers.on_update)
    drive(reported, 20.0)
    assert set(published) == {"coec/@v1/vehicle/rig"}
    count = len(published)
    drive(reported, 40.0, begin_s=20.0)
    assert len(published) == count
    report = answers.reply
    assert from_json(RigReply, to_json(report)) == report
    assert report.looks == {"front-roof": 7, "left-roof": 7, "rear-roof": 7}
    assert answers.problems("front-roof") == ()


def test_a_single_lidar_closes_no_loop_and_no_pair_is_inconsistent(tmp_path: Path) -> None:
    reported = RigEstimatorBench(tmp_path)
    drive(reported, DISPLACED_S + 40.0)
    rig = reported.known.rig
    assert rig is not None
    assert rig_problems(rig) == {}
    joint = reply(reported).joint
    assert joint is not None
    assert joint.freedom == 0
    assert INCONSISTENT not in str(joint)


@pytest.mark.fault("all cameras of a vehicle stop", "what they said last is still combined")
def test_once_all_streams_have_stopped_nothing_waits_any_more(tmp_path: Path) -> None:
    reported = RigEstimatorBench(tmp_path)
    for camera in CAMERAS:
        reported.must_wait(camera, 10.0)
        reported.put(camera, 15.0, pair_check(camera, POSES, 10.0, np.zeros(6)))
    reported.settle()
    assert reply(reported).looks == {}
    for _ in range(QUIET_TICKS):
        assert not reported.estimator.is_quiet
        reported.estimator.tick()
    assert reported.estimator.is_quiet
    reported.settle()
    assert reply(reported).looks == {"front-roof": 1, "left-roof": 1, "rear-roof": 1}


def test_a_pair_that_joins_later_finds_what_the_first_has_come_to(tmp_path: Path) -> None:
    reported = RigEstimatorBench(tmp_path, ("front",))
    reported.put("front", 5.0, pair_window("front", POSES, 1.0))
    reported.put("front", 5.0, served_extrinsic("front", POSES, 1.0))
    reported.settle()
    reported.pairs["left"] = reported.estimator.join(pair_config("left"), pair_pose("left", POSES), pair_state("left"))
    reported.settle()
    rig = reported.known.rig
    assert rig is not None
    assert rig.serves["front-roof"].start_ns == NS
    assert list(rig.windows) == ["front-roof"]
    assert {sensor.state for sensor in reply(reported).sensors} == {"unknown"}
