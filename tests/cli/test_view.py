"""`coec view` by a real viewer: a recording, and a vehicle whose service comes, changes and goes."""

from __future__ import annotations

import os
import signal
import socket
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("foxglove", reason="needs the optional extra `foxglove`")

from cli.conftest import SMALL, Coec, Outcome
from cli.vehicle_on_screen import CANDIDATE, KEYS, PAIR, RIG, Sensors, Service, configuration, extrinsic, health
from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.types import Rig
from coec.errors import ConfigError, ConnectionFailedError, SourceError, UnavailableError, UsageError
from coec.geometry import se3
from coec.io import viewer_scene
from coec.io.msgpack_frames import encode_lidar
from coec.io.recordings.window_cutting import window_of_recording
from coec.io.serialise import result_of
from coec.io.viewer_scene import POINTS_TOPICS, TOPIC_DESCRIPTIONS, DisplayedPose
from coec.io.zenoh.bus import MSGPACK
from coec.reports import console
from coec.schemas.message import to_json
from e2e.processes import Router, free_endpoint
from support.estimates import estimate
from support.fake_worker import wait_until
from support.readers import Viewer
from support.scenes import BOARD_MOVED, BOARD_NOMINAL
from support.simulated_drives import rendered_source
from support.viewer import places, projected

Record = Callable[[str, object], None]
"""pytest's `record_property`."""

OFTEN_S = 0.2
ANYWHERE = "127.0.0.1:0"

PATIENCE_S = 60.0
"""For what a busy machine does late."""


@pytest.fixture
def viewing(coec: Coec, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Outcome]:
    """Runs `coec view ARGS --json`, and `look(url)` beside it as soon as it is served; then tells it to end. What is
    done every second or other is done more often."""
    for name in ("view.sources.REPEAT_S", "view.sources.QUERY_S", "view.sources.AGAIN_S"):
        monkeypatch.setattr(f"coec.cli.{name}", OFTEN_S)

    def run(observation: Callable[[str], None], *arguments: object) -> Outcome:
        shown = console.print_json
        with ThreadPoolExecutor(1) as neighbour:
            checked: list[Any] = []

            def print_json(document: Any) -> None:
                shown(document)
                checked.append(neighbour.submit(finished_by, observation, document["url"]))

            monkeypatch.setattr(console, "print_json", print_json)
            outcome = coec("view", *arguments, "--listen", ANYWHERE, "--json")
            for one in checked:
                one.result()
        assert checked, outcome.err
        return outcome

    return run


def finished_by(observation: Callable[[str], None], url: str) -> None:
    """Ctrl-C, when whoever looks has seen enough or has failed."""
    try:
        observation(url)
    finally:
        os.kill(os.getpid(), signal.SIGINT)


def stamp_ns(message: Any) -> int:
    return int(message.timestamp.seconds * 10**9 + message.timestamp.nanos)


def received(message: Any) -> np.ndarray:
    """Pixels, their centres at integers."""
    return np.array([(point.x - 0.5, point.y - 0.5) for band in message.points for point in band.points])


# ----------------------------------------------------------------------------------------------------- a recording


def take(stamps: list[int], viewer: Viewer) -> None:
    """The stamp of the next picture; one that rests on the screen is shown again now and then."""
    stamp = stamp_ns(viewer.next_on(viewer_scene.IMAGE_TOPIC))
    if not stamps or stamps[-1] != stamp:
        stamps.append(stamp)


def synchronised(viewer: Viewer, required: set[str]) -> dict[str, Any]:
    """Messages of one stamp, as viewers wait for them: whoever reads slowly misses some."""
    by_stamp: dict[int, dict[str, Any]] = {}
    while True:
        topic, message = viewer.next()
        if topic in required:
            result = by_stamp.setdefault(stamp_ns(message), {})
            result[topic] = message
            if set(result) == required:
                return result


def result_file(folder: Path, rig: Rig, T_camera_lidar: np.ndarray) -> Path:
    """As `coec calibrate --json` would have printed it."""
    result = estimate(3)
    result = replace(result, optimum=replace(result.optimum, T_camera_lidar=T_camera_lidar))
    path = folder / "result.json"
    path.write_bytes(to_json(result_of(result, rig, "vehicle")))
    return path


def test_a_recording_is_shown_and_stays_to_be_seen(viewing: Callable[..., Outcome], tmp_path: Path) -> None:
    recording = rendered_source(SMALL)
    rig = recording.rig
    turned = se3.perturb(rig.T_camera_lidar_nominal, np.radians([3.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    last = window_of_recording(recording, len(recording.camera_stamps_ns), lambda *_: None).window.pairs[-1]
    xyz_m = compensate(last, rig, enabled=True)
    stamps: list[int] = []

    def observation(url: str) -> None:
        with Viewer(url) as viewer:
            viewer.subscribe([viewer_scene.IMAGE_TOPIC, viewer_scene.HEALTH_TOPIC, *POINTS_TOPICS.values()])
            while len(stamps) < len(recording.camera_stamps_ns):
                take(stamps, viewer)
            picture = synchronised(viewer, set(POINTS_TOPICS.values()))  # the last pair, which stays
            for pose, T_camera_lidar in (
                (DisplayedPose.SERVED, rig.T_camera_lidar_nominal), (DisplayedPose.NOMINAL, rig.T_camera_lidar_nominal),
                (DisplayedPose.CANDIDATE, turned),
            ):  # fmt: skip
                rendered = places(received(picture[POINTS_TOPICS[pose]]))
                assert len(rendered) > 500
                assert rendered <= places(projected(rig.camera, T_camera_lidar, xyz_m))
            moment = viewer.next_on(viewer_scene.HEALTH_TOPIC)
        assert (moment["state"], moment["status"], moment["candidate"]) == ("recorded", "accepted", True)
        assert moment["step"]["rx_deg"] == pytest.approx(3.0)
        with Viewer(url) as late:
            late.subscribe([viewer_scene.IMAGE_TOPIC])
            assert stamp_ns(late.next_on(viewer_scene.IMAGE_TOPIC)) == stamps[-1], "who comes late sees the last pair"

    outcome = viewing(observation, SMALL, "--rate", "20", "--result", result_file(tmp_path, rig, turned))
    assert outcome.status == 0
    assert stamps == list(recording.camera_stamps_ns)
    reported = outcome.document
    assert set(reported["topics"]) == set(TOPIC_DESCRIPTIONS)
    assert reported["frames"]["served"] == f"{rig.camera_frame}_served"
    assert reported["url"].startswith("ws://127.0.0.1:")


def test_a_recording_that_is_repeated_goes_on_in_time(viewing: Callable[..., Outcome]) -> None:
    stamps: list[int] = []

    def observation(url: str) -> None:
        with Viewer(url) as viewer:
            viewer.subscribe([viewer_scene.IMAGE_TOPIC, viewer_scene.HEALTH_TOPIC])
            while len(stamps) < 9:
                take(stamps, viewer)
            assert viewer.next_on(viewer_scene.HEALTH_TOPIC)["state"] == "recorded", "however fast it is played"

    assert viewing(observation, SMALL, "--rate", "100", "--repeat").status == 0
    recorded = list(rendered_source(SMALL).camera_stamps_ns)
    assert len(recorded) == 6
    assert stamps[:6] == recorded
    assert np.diff(stamps).min() > 0


# ------------------------------------------------------------------------------------------------------- a vehicle


def until(viewer: Viewer, condition: Callable[[Any], bool], meanwhile: Callable[[], None] = lambda: None) -> Any:
    """The first line of the timeline for which it holds. What is done `meanwhile` may be lost on a busy bus."""
    end_s = time.monotonic() + PATIENCE_S
    while not condition(moment := viewer.next_on(viewer_scene.HEALTH_TOPIC)):
        assert time.monotonic() < end_s, moment
        meanwhile()
    return moment


@pytest.mark.fault("the service dies while somebody looks", "the timeline says so; the picture goes on")
def test_a_vehicle_is_shown_while_its_service_comes_changes_and_goes(
    viewing: Callable[..., Outcome], router: Router, tmp_path: Path, record_property: Record
) -> None:
    def observation(url: str) -> None:
        with Viewer(url) as viewer, Sensors(router.session) as sensors:
            viewer.subscribe([viewer_scene.HEALTH_TOPIC, viewer_scene.LOG_TOPIC])
            assert viewer.next_on(viewer_scene.HEALTH_TOPIC)["state"] == "not_served"
            service = Service(router.session)
            moment = until(viewer, lambda moment: moment["state"] == "healthy" and "provenance" in moment)
            assert (moment["provenance"], moment["level"], moment["candidate"]) == ("estimated", 0, True)
            assert moment["correction"]["rx_deg"] == 2.0
            assert "camera_s" not in moment["ages"]
            assert not sensors.are_received, "nobody looks at pictures"

            viewer.subscribe([viewer_scene.IMAGE_TOPIC, *POINTS_TOPICS.values()])
            picture = synchronised(viewer, {viewer_scene.IMAGE_TOPIC, *POINTS_TOPICS.values()})
            expected = {
                DisplayedPose.SERVED: BOARD_MOVED,
                DisplayedPose.NOMINAL: BOARD_NOMINAL,
                DisplayedPose.CANDIDATE: CANDIDATE,
            }
            for pose, T_camera_lidar in expected.items():
                marks = picture[POINTS_TOPICS[pose]]
                assert places(received(marks)) == places(projected(RIG.camera, T_camera_lidar, PAIR.lidar.xyz_m))
            assert marks.texts[0].text == "candidate: waits for apply"
            assert sensors.are_received
            assert until(viewer, lambda moment: "camera_s" in moment["ages"])["ages"]["camera_s"] < 60.0

            service.say(KEYS.health("front"), health("miscalibrated"))
            moment = until(viewer, lambda moment: moment["state"] == "miscalibrated")
            assert (moment["level"], moment["reasons"], moment["why"]) == (2, ["moved"], "It has moved.")

            died_s = time.monotonic()
            service.end()
            moment = until(viewer, lambda moment: moment["state"] == "not_served")
            record_property("figure", f"{time.monotonic() - died_s:.1f} s")
            assert moment["level"] == 3
            assert moment["provenance"] == "estimated", "the last that is known"
            while "not_served" not in viewer.next_on(POINTS_TOPICS[DisplayedPose.SERVED]).texts[0].text:
                pass
            wait_until(lambda: sensors.are_received, "frames, still")
        with Viewer(url) as other, Sensors(router.session) as sensors:
            other.subscribe([viewer_scene.HEALTH_TOPIC])
            wait_until(lambda: not sensors.are_received, "the end of the subscriptions")

    assert viewing(observation, "--config", configuration(tmp_path, router.endpoint)).status == 0


@pytest.mark.fault(
    "rubbish under the service's keys and the sensors'", "it is counted by cause; what was served stays on the screen"
)
def test_rubbish_is_counted(
    viewing: Callable[..., Outcome], router: Router, tmp_path: Path, record_property: Record
) -> None:
    def observation(url: str) -> None:
        service = Service(router.session)
        with Viewer(url) as viewer, Sensors(router.session) as sensors:
            viewer.subscribe([viewer_scene.HEALTH_TOPIC, viewer_scene.IMAGE_TOPIC])
            until(viewer, lambda moment: moment["state"] == "healthy")
            wait_until(lambda: sensors.are_received, "subscriptions")
            key = KEYS.extrinsic("front")
            stranger = replace(PAIR.lidar, frame_id="elsewhere")

            def babble() -> None:
                for rubbish in (b"\xc1", bytes(2**20 + 1), extrinsic(np.diag([2.0, 1.0, 1.0, 1.0]))):
                    router.session.put(key, rubbish, encoding=MSGPACK)
                router.session.put("in/camera", b"\xc1", encoding=MSGPACK)
                router.session.put("in/lidar", encode_lidar(stranger), encoding=MSGPACK)

            refused = {
                ("service", "message_malformed"), ("service", "message_too_large"), ("service", "message_fields"),
                ("camera", "message_malformed"), ("lidar", "frame_id"),
            }  # fmt: skip
            moment = until(viewer, lambda moment: refused <= counted(moment), babble)
            assert moment["provenance"] == "estimated", "what was served is served"
            viewer.next_on(viewer_scene.IMAGE_TOPIC)
            record_property("figure", f"{len(refused)} causes")
        service.end()

    assert viewing(observation, "--config", configuration(tmp_path, router.endpoint)).status == 0


def counted(moment: Any) -> set[tuple[str, str]]:
    return {(one["stream"], one["cause"]) for one in moment["not_shown"]}


# --------------------------------------------------------------------------------------------------------- refusals


def test_other_computers_do_not_get_in_by_mistake(coec: Coec) -> None:
    outcome = coec("view", SMALL, "--listen", "0.0.0.0:8765")
    assert (outcome.status, "--insecure" in outcome.err) == (UsageError.exit_code, True)


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        (SMALL, "--config", "coec.yaml"),
        (SMALL, "--pair", "front"),
        ("--config", "coec.yaml", "--repeat"),
        ("--config", "coec.yaml", "--result", "result.json"),
    ],
)
def test_what_does_not_go_together_is_reported(coec: Coec, arguments: tuple[str, ...]) -> None:
    assert coec("view", *arguments).status == UsageError.exit_code


def test_what_is_not_there_is_reported(coec: Coec, tmp_path: Path, router: Router) -> None:
    assert coec("view", tmp_path / "absent").status == SourceError.exit_code
    assert coec("view", "--config", tmp_path / "absent.yaml").status == ConfigError.exit_code
    rubbish = tmp_path / "result.json"
    rubbish.write_text("[]")
    outcome = coec("view", SMALL, "--result", rubbish)
    assert (outcome.status, "coec calibrate --json" in outcome.err) == (SourceError.exit_code, True)
    result_file(tmp_path, rendered_source(SMALL).rig, np.diag([2.0, 1.0, 1.0, 1.0]))
    outcome = coec("view", SMALL, "--result", rubbish)
    assert (outcome.status, "not a rigid transform" in outcome.err) == (SourceError.exit_code, True)
    path = configuration(tmp_path, router.endpoint)
    assert coec("view", "--config", path, "--pair", "rear").status == UsageError.exit_code
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        outcome = coec("view", "--config", path, "--listen", f"127.0.0.1:{port}")
    assert outcome.status == UnavailableError.exit_code
    alone = configuration(tmp_path, free_endpoint())
    assert coec("view", "--config", alone, "--timeout", "0.2").status == ConnectionFailedError.exit_code


def test_without_the_extra_it_says_what_to_install(coec: Coec, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    outcome = coec("view", SMALL)
    assert outcome.status == UsageError.exit_code
    assert outcome.err.splitlines() == [
        "coec: coec view needs the optional extra `foxglove`: pip install 'coec[foxglove]'"
    ]
