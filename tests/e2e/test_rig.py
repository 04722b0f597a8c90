"""Vehicles of several sensors in a running service: nobody is knocked, a LiDAR is, a camera is. Which it was is said of
that sensor, and put right in all pairs of it. Four fisheyes and a LiDAR; two fisheyes and three LiDARs, which are
looked at together, too."""

from __future__ import annotations

import json
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from math import hypot
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

pytest.importorskip("embreex", reason="needs embreex")

from coec.calibration.types import Frame
from coec.geometry.se3 import inverse, rotation_angle_rad
from coec.io.zenoh.player import Player, SensorKeys
from coec.schemas.message import from_msgpack
from coec.schemas.rig_state import RigCorrection, RigReply
from coec_lab.simulation.source import document_of
from e2e.processes import PATIENCE_S, Router, Service, service
from e2e.rig_street import FOUR_AND_ONE, LIDAR, TWO_AND_THREE, Knock, Street, second_of

NAMED_S = 60.0
"""Of driving, within which a sensor that was knocked has to be named."""

MAX_ERROR_DEG = 0.3
MAX_ERROR_TOGETHER_DEG = 0.2
"""Of a pair by itself, and of one that all pairs of a knocked sensor put right together."""

HELD = 8
"""Pairs of frames that may wait in the service before more are sent."""

QUIET_STATUSES = 8
"""Renewals of the status without work, after which nothing comes any more: the rig looks for silence, too."""

ROOF, LEFT = Knock(LIDAR, 1.5), Knock("left", 1.5)

STAGES = {
    # Windows as `coec demo` has them, for a street of one and a half minutes. The rows that are not drawn are black.
    "window": {"pairs": 16, "min_pairs": 8, "slice_s": 24.0, "max_clipped": 0.9},
    "monitor": {"period_s": 5.0, "pairs": 5, "min_pairs": 4, "urgent_slice_s": 12.0},
    "calibration": {"depth": {"model": "stereo"}},
}


@dataclass
class Story:
    """All that the service published of the rig while it was driven, in order, and what it said in the end."""

    street: Street
    reported: list[RigReply]
    last: RigReply

    @property
    def named(self) -> set[str]:
        """Sensors that were said to have moved, at any time."""
        return set().union(*map(moved_in, self.reported))

    @property
    def corrections(self) -> list[RigCorrection]:
        """Those that were told, each once."""
        result = [reported.correction for reported in (*self.reported, self.last) if reported.correction is not None]
        return list({correction.stamp_ns: correction for correction in result}.values())

    def named_s(self, sensor: str) -> float:
        """Seconds of driving between the knock and its being named."""
        stamps = [
            reported.stamp_ns
            for reported in self.reported
            if sensor in moved_in(reported) and reported.stamp_ns is not None
        ]
        return second_of(min(stamps)) - self.street.knock_s

    def turned_deg(self, sensor: str) -> float:
        """By how much it is said to have turned; the move is over."""
        move = self.last.move
        assert move is not None
        assert move.over_ns is not None
        assert move.sensors == (sensor,)
        return hypot(*move.by[sensor].by[:3])

    def lines(self) -> str:
        """What was said when, for who has to find out why it was not what it should be."""
        lines = []
        for reply in (*self.reported, self.last):
            states = {sensor.name: (sensor.state, sensor.probability) for sensor in reply.sensors}
            at_s = None if reply.stamp_ns is None else round(second_of(reply.stamp_ns), 1)
            lines.append(f"{at_s}: {states} {reply.looks} {reply.losses} {reply.correction}")
        return "\n".join(dict.fromkeys(lines))


def moved_in(reply: RigReply) -> set[str]:
    """Sensors that it says have moved."""
    return {sensor.name for sensor in reply.sensors if sensor.state in ("camera_moved", "lidar_moved")}


def configuration(street: Street, folder: Path, router: Router) -> Path:
    """Of a vehicle: sensors, each told once; pairs follow."""
    document = {
        **document_of(street.drive_of(None), street.lidars, folder),
        "budget": {"cores": 64.0},  # sensor time is compressed
        "zenoh": {"connect": [router.endpoint], "listen": [router.endpoint]},
        "state": {"directory": "state", "min_free_bytes": 0},
        "worker": {"niceness": 0},
        "stages": STAGES,
    }
    path = folder / "coec.yaml"
    path.write_text(json.dumps(document))  # which is YAML, too
    return path


def driven(running: Service, street: Street, frames: list[Frame]) -> Story:
    """A second of driving at a time, each once the service has kept up; then until all is judged."""
    sensors = SensorKeys(tuple(sorted({frame.frame_id for frame in frames})))
    player = Player(running.session, sensors, "msgpack")
    reported, sent = [rig_of(running)], Counter[str]()

    def received(sample: zenoh.Sample) -> None:
        reported.append(from_msgpack(RigReply, sample.payload.to_bytes()))

    of_pair = {pair.name: (pair.camera.sensor, pair.lidar.sensor) for pair in running.config.pairs}

    def taken(status: Any) -> bool:
        for pair in status["pairs"]:
            camera, lidar = of_pair[pair["name"]]
            if pair["camera"]["received"] < sent[camera] or pair["lidar"]["received"] < sent[lidar]:
                return False
        return all(pair["held"] < HELD for pair in status["pairs"])

    published = running.session.declare_subscriber(running.keys.rig, zenoh.handlers.Callback(received, indirect=False))
    try:
        assert not player.wait_for_listener(PATIENCE_S)
        for second in range(street.seconds + 1):
            part = [frame for frame in frames if second <= second_of(frame.stamp_ns) < second + 1]
            player.play(part, 0.0, threading.Event(), lambda *_: None)
            sent.update(frame.frame_id for frame in part)
            running.until(running.status, taken, f"second {second} of the drive")
        rest(running)
        return Story(street, reported, rig_of(running))
    finally:
        published.undeclare()
        player.close()


def rig_of(running: Service) -> RigReply:
    """What it says of the rig now."""
    return RigReply.model_validate(running.query(running.keys.rig))


def rest(running: Service) -> None:
    """Until nothing waits, and nothing is under way, for as long as it takes the rig to see that."""
    quiet: dict[float, Any] = {}

    def rests(status: Any) -> bool:
        at_work = status["worker"]["state"] != "idle" or status["worker"]["queued"]
        at_work = at_work or any(pair["held"] or pair["unanswered"] for pair in status["pairs"])
        done = [(pair["checks"], pair["solved"]) for pair in status["pairs"]]
        if at_work or any(before != done for before in quiet.values()):
            quiet.clear()
        else:
            quiet[status["uptime_s"]] = done
        return len(quiet) >= QUIET_STATUSES

    running.until(running.status, rests, "rest")


def errors_deg(running: Service, street: Street, knock: Knock | None) -> dict[str, float]:
    """Of what every pair serves, against the truth at the end of the drive."""
    result = {}
    for pair in running.config.pairs:
        served = np.array(running.query(running.keys.extrinsic(pair.name))["camera_from_lidar"]["matrix"])
        right = street.truth(knock, pair.camera.sensor, pair.lidar.sensor, street.seconds)
        result[pair.name] = float(np.degrees(rotation_angle_rad(served @ inverse(right))))
    return result


def states_of(running: Service, pair: str) -> list[str]:
    """In which its health has been, by what was seen: a drive that is over makes pairs degraded by the clock."""
    entries = [one["entry"] for one in running.query(running.keys.history(pair), ";limit=1000")["entries"]]
    return [entry["code"] for entry in entries if entry["kind"] == "state" and entry["stamp_ns"] is not None]


def reasons_of(running: Service) -> list[list[str]]:
    """Codes that the health of each pair gives now."""
    healths = [running.query(running.keys.health(pair.name)) for pair in running.config.pairs]
    return [[reason["code"] for reason in health["reasons"]] for health in healths]


def corrected(running: Service, pair: str) -> int:
    """How often the rig put a pair right."""
    entries = running.query(running.keys.history(pair), ";limit=1000")["entries"]
    return sum((one["entry"]["kind"], one["entry"]["code"]) == ("command", "corrected") for one in entries)


@pytest.mark.slow
@pytest.mark.fault(
    "nothing happens on a drive of four fisheyes and a LiDAR", "no sensor is said to have moved, no alarm"
)
def test_a_right_rig_raises_no_alarm(
    tmp_path: Path, router: Router, record_property: Callable[[str, object], None]
) -> None:
    with service(configuration(FOUR_AND_ONE, tmp_path, router), router) as running:
        cameras = FOUR_AND_ONE.drive_of(None).cameras
        assert {pair.name for pair in running.config.pairs} == set(cameras)
        story = driven(running, FOUR_AND_ONE, FOUR_AND_ONE.frames_of(None))
        message = story.lines()
        assert {sensor.state for sensor in story.reported[0].sensors} == {"unknown"}
        assert story.named == set(), message
        assert story.corrections == [], message
        assert story.last.move is None, message
        assert {sensor.state for sensor in story.last.sensors} == {"calibrated"}, message
        assert set(story.last.looks) == set(cameras), message
        assert not any("miscalibrated" in states_of(running, camera) for camera in cameras)
        errors = errors_deg(running, FOUR_AND_ONE, None)
        record_property("figure", f"{sum(story.last.looks.values())} looks, ≤ {max(errors.values()):.2f}° off")
        assert max(errors.values()) < MAX_ERROR_DEG, errors
        assert running.terminate() == 0


@pytest.mark.slow
@pytest.mark.fault(
    "the LiDAR of a running vehicle is knocked by 1.5°", "it alone is named, in a minute; one correction for all pairs"
)
def test_a_displaced_lidar_is_named_and_put_right_in_all_its_pairs_at_once(
    tmp_path: Path, router: Router, record_property: Callable[[str, object], None]
) -> None:
    with service(configuration(FOUR_AND_ONE, tmp_path, router), router) as running:
        cameras = FOUR_AND_ONE.drive_of(ROOF).cameras
        story = driven(running, FOUR_AND_ONE, FOUR_AND_ONE.frames_of(ROOF))
        message = story.lines()
        assert story.named == {LIDAR}, message
        assert story.turned_deg(LIDAR) == pytest.approx(ROOF.turn_deg, abs=MAX_ERROR_DEG), message
        assert 0.0 < story.named_s(LIDAR) <= NAMED_S, message
        (correction,) = story.corrections
        assert correction.sensors == (LIDAR,)
        assert set(correction.pairs) == set(cameras), message
        assert [corrected(running, camera) for camera in cameras] == [1] * len(cameras)
        errors = errors_deg(running, FOUR_AND_ONE, ROOF)
        put_right_s = second_of(correction.stamp_ns) - FOUR_AND_ONE.knock_s
        record_property(
            "figure",
            f"named {story.named_s(LIDAR):.0f} s, put right {put_right_s:.0f} s of driving after the knock; then "
            f"{max(errors.values()):.2f}° off at most",
        )
        assert max(errors.values()) <= MAX_ERROR_TOGETHER_DEG, errors
        assert {sensor.state for sensor in story.last.sensors} == {"calibrated"}, message
        last = {camera: states_of(running, camera)[-1] for camera in cameras}
        # A pair whose own looks lie beside what all say may find that they do not add up; none accuses its mount.
        assert set(last.values()) <= {"healthy", "degraded"}, last
        assert running.terminate() == 0


@pytest.mark.slow
@pytest.mark.fault(
    "a camera of a running vehicle is knocked by 1.5°", "it alone is named, in a minute, and put right; no other alarm"
)
def test_a_displaced_camera_is_named_and_put_right_and_no_other(
    tmp_path: Path, router: Router, record_property: Callable[[str, object], None]
) -> None:
    with service(configuration(FOUR_AND_ONE, tmp_path, router), router) as running:
        others = set(FOUR_AND_ONE.drive_of(LEFT).cameras) - {LEFT.sensor}
        story = driven(running, FOUR_AND_ONE, FOUR_AND_ONE.frames_of(LEFT))
        message = story.lines()
        assert story.named == {LEFT.sensor}, message
        assert story.turned_deg(LEFT.sensor) == pytest.approx(LEFT.turn_deg, abs=MAX_ERROR_DEG), message
        assert 0.0 < story.named_s(LEFT.sensor) <= NAMED_S, message
        assert not any("miscalibrated" in states_of(running, camera) for camera in others)
        errors = errors_deg(running, FOUR_AND_ONE, LEFT)
        record_property(
            "figure",
            f"named {story.named_s(LEFT.sensor):.0f} s after the knock; then {errors[LEFT.sensor]:.2f}° off",
        )
        assert max(errors.values()) <= MAX_ERROR_DEG, errors
        assert {sensor.state for sensor in story.last.sensors} == {"calibrated"}, message
        assert states_of(running, LEFT.sensor)[-1] == "healthy"
        assert running.terminate() == 0


@pytest.mark.slow
@pytest.mark.fault(
    "nothing happens on a drive of two fisheyes and three LiDARs",
    "LiDARs are measured; no sensor is said to have moved",
)
def test_three_lidars_that_see_each_other_are_measured_and_nobody_is_named(
    tmp_path: Path, router: Router, record_property: Callable[[str, object], None]
) -> None:
    with service(configuration(TWO_AND_THREE, tmp_path, router), router) as running:
        story = driven(running, TWO_AND_THREE, TWO_AND_THREE.frames_of(None))
        message = story.lines()
        assert story.named == set(), message
        assert story.corrections == [], message
        assert story.last.move is None, message
        edges = {edge.name: edge for edge in story.last.lidars}
        for name in ("roof to near_left", "roof to near_right"):
            assert edges[name].state == "measured", edges[name]
            assert edges[name].looks >= 3, edges[name]
        assert not any("inconsistent_rig" in codes for codes in reasons_of(running)), reasons_of(running)
        checked_at = {sensor.name: sensor.state for sensor in story.last.sensors}
        assert set(checked_at.values()) == {"calibrated"}, message
        record_property("figure", f"{sum(story.last.looks.values())} looks, {len(edges)} edges between LiDARs")
        assert running.terminate() == 0


@pytest.mark.slow
@pytest.mark.fault("one of three LiDARs of a running vehicle is knocked by 1.5°", "it alone is named, in a minute")
def test_of_three_lidars_the_one_that_was_displaced_is_named(
    tmp_path: Path, router: Router, record_property: Callable[[str, object], None]
) -> None:
    with service(configuration(TWO_AND_THREE, tmp_path, router), router) as running:
        story = driven(running, TWO_AND_THREE, TWO_AND_THREE.frames_of(ROOF))
        message = story.lines()
        assert story.named == {LIDAR}, message
        assert 0.0 < story.named_s(LIDAR) <= NAMED_S, message
        by = next(reported.move.by[LIDAR].by for reported in (*story.reported, story.last) if reported.move is not None)
        assert hypot(*by[:3]) == pytest.approx(ROOF.turn_deg, abs=MAX_ERROR_DEG), message
        record_property("figure", f"named {story.named_s(LIDAR):.0f} s of driving after the knock")
        assert running.terminate() == 0
