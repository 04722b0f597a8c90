"""The daemon as a process, over Zenoh: frames in, windows, estimates, an orderly end, a restart; two pairs."""

from __future__ import annotations

import json
import queue
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from coec.calibration.types import LidarFrame
from coec.config import (
    CalibrationConfig,
    DepthConfig,
    ObjectiveConfig,
    SearchConfig,
    WindowConfig,
    ZenohConfig,
    load_config,
)
from coec.errors import ExitCode, RemoteError
from coec.io.mcap.windows import read_result, read_window
from coec.io.msgpack_frames import encode_lidar
from coec.io.zenoh.bus import MSGPACK
from coec.reports.commented_yaml import commented_yaml
from coec.schemas import heartbeat
from coec.schemas.message import from_msgpack
from coec.schemas.replies import HealthReply
from e2e.drives import SHORT, SHORT_PAIRS, Drive, later, rendered
from e2e.processes import COMMAND, PATIENCE_S, Router, Service, environment, routing, service, write_configuration
from e2e.ros_listener import listening, speaking_to_ros
from support.fake_worker import wait_until
from support.router import MemoryStorage, free_port

SHORT_S = 12
LATER_S = 60.0
"""When the second drive begins, after the first."""

EXIT_TRY_AGAIN = 75
FRONT, REAR = "sim", "rear"
ERROR, STALE = 2, 3
BROKEN = (
    sys.executable,
    "-c",
    "import sys\n"
    "from coec.calibration.frames.pairing import Pairer\n"
    "def broken(*_):\n"
    "    raise RuntimeError('broken')\n"
    "Pairer.push = broken\n"
    "from coec.cli.main import main\n"
    "sys.exit(main())",
)
"""`coec` with a fault of the program in it: the first frame ends the thread that takes it."""

STUBBORN = (
    sys.executable,
    "-c",
    "import sys\n"
    "from coec.io.zenoh.bus import Bus\n"
    "from coec.service.camera_lidar_pair import CameraLidarPair\n"
    "def broken(*_):\n"
    "    raise RuntimeError('broken')\n"
    "Bus.undeclare_inputs = Bus.undeclare_queryables = CameraLidarPair.finish_window = broken\n"
    "from coec.cli.main import main\n"
    "sys.exit(main())",
)
"""`coec` whose end has three steps that raise."""


@pytest.fixture(scope="module")
def drive() -> Drive:
    pytest.importorskip("embreex", reason="needs embreex")
    return rendered(SHORT)


def configured(folder: Path, drive: Drive, router: Router, depth: str = "stereo", drives: int = 1) -> Path:
    """Two pairs, of which one has no camera. Windows are as long as so many drives: silence ends them so late."""
    path = write_configuration(
        folder,
        drive.recording,
        router.endpoint,
        window=WindowConfig(pairs=drives * SHORT_PAIRS, min_pairs=3, slice_s=drives * SHORT_S, min_points_in_view=100),
        calibration=CalibrationConfig(
            depth=DepthConfig(model=depth),
            objective=ObjectiveConfig(kind="mi"),
            search=SearchConfig(max_evaluations=60),
        ),
    )
    config = load_config(path)
    (front,) = config.pairs
    camera = front.camera.model_copy(update={"key": "sensors/rear/camera"})
    rear = front.model_copy(update={"name": REAR, "camera": camera})
    path.write_text(commented_yaml(config.model_copy(update={"pairs": (front, rear)})))
    return path


@pytest.fixture(scope="module")
def idle(tmp_path_factory: pytest.TempPathFactory, drive: Drive) -> Iterator[Service]:
    """A daemon, on a router of its own, that nobody has sent anything: for questions that change nothing."""
    with routing() as router:
        config = configured(tmp_path_factory.mktemp("idle"), drive, router)
        with service(config, router, warm=False) as running:
            yield running
            assert running.terminate() == 0


def code(running: Service, key: str, parameters: str = "", payload: bytes | None = None) -> str:
    """Of the one reply, good or bad."""
    try:
        return str(running.query(key, parameters, payload)["code"])
    except RemoteError as error:
        return error.reply_code


def test_a_drive_an_end_and_a_restart(tmp_path: Path, drive: Drive, router: Router) -> None:
    config = configured(tmp_path, drive, router, drives=20)
    with service(config, router) as running:
        nominal = [list(row) for row in running.config.pairs[0].T_camera_lidar]
        before = running.extrinsic()
        assert (before["provenance"], before["status"], before["percent_complete"]) == ("nominal", "not_accepted", 0)
        assert before["camera_from_lidar"]["matrix"] == nominal
        health = running.health()
        assert (health["state"], health["level"]) == ("unknown", 3)
        assert "3 more pairs" in health["needs"]

        router.session.put("sensors/sim/camera", b"\x81\xa1x\xc1", encoding=MSGPACK)
        running.sent["camera"] += 1
        running.send(drive.frames)
        running.until_received()
        # The last pair is certain only when the streams go on, or end.
        pair = running.until(running.counters, lambda pair: pair["selected"] >= SHORT_PAIRS - 1, "the pairs")
        assert sum(pair["camera"]["losses"].values()) == 1
        running.until(running.extrinsic, lambda reported: reported["percent_complete"] > 0, "how full the window is")

        changes: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        subscriber = router.session.declare_subscriber(running.keys.extrinsic(FRONT), changes.put)
        acknowledged = running.command("calibrate")
        assert acknowledged["accepted"], acknowledged
        assert acknowledged["code"] == "window_finished"
        changes.get(timeout=PATIENCE_S)
        subscriber.undeclare()

        after = running.extrinsic()
        window_id = acknowledged["window_id"]
        path = tmp_path / "state" / "windows" / f"{window_id}.mcap"
        window, _ = read_window(path)
        assert len(window.pairs) == SHORT_PAIRS
        result = read_result(path)
        assert result is not None
        (retained,) = running.history()["results"]
        assert retained == json.loads(result.model_dump_json())
        assert (after["provenance"], after["status"]) == ("estimated", "accepted")
        assert after["camera_from_lidar"] == retained["camera_from_lidar"]
        assert after["window_id"] == window_id
        health = running.health()
        assert health["state"] == "healthy"
        assert 0 <= health["age_s"] < PATIENCE_S
        assert running.query(running.keys.health(REAR))["state"] == "unknown"

        (info,) = running.windows()
        assert (info["window_id"], info["pairs"], info["decision"]) == (window_id, SHORT_PAIRS, "accepted")
        (part,) = router.session.get(f"{running.keys.window(FRONT, window_id)}?offset=8;length=100")
        assert part.ok is not None
        assert part.ok.payload.to_bytes() == path.read_bytes()[8:108]

        again = running.command("calibrate")
        assert (again["code"], again["window_id"]) == ("window_again", window_id)
        reported = running.until(running.history, lambda reported: reported["total"] == 2, "the second solve")
        one, two = reported["results"]
        assert one == two, "the same window and configuration give the same result"
        with MemoryStorage(router.session, running.keys.last("*")) as storage:
            assert running.terminate() == 0
    labels = {
        key: heartbeat.decode_heartbeat(key, retained.payload.to_bytes()) for key, retained in storage.samples.items()
    }
    assert {word.service for word in labels.values()} == {"stopping"}, "it takes its leave"
    front = labels[running.keys.last(FRONT)]
    assert (front.state, front.provenance, front.windows) == ("healthy", "estimated", 1)

    with service(configured(tmp_path, drive, router), router) as running:
        restored = running.extrinsic()
        assert restored["camera_from_lidar"] == after["camera_from_lidar"]
        assert restored["provenance"] == "restored"
        assert running.history()["results"] == reported["results"]
        running.send(later(drive.frames, LATER_S))  # and silence: the slice ends by itself
        reported = running.until(running.history, lambda reported: reported["total"] == 3, "the end of the slice")
        assert reported["results"][-1]["pairs"] == SHORT_PAIRS
        assert running.terminate() == 0


@pytest.mark.fault("the service is killed", "its worker goes with it, and its window is salvaged")
def test_a_killed_service_takes_its_worker_along_and_its_window_is_salvaged(
    tmp_path: Path, drive: Drive, router: Router
) -> None:
    config = configured(tmp_path, drive, router)
    with service(config, router, warm=False) as running:
        running.send(drive.frames)
        running.until(running.counters, lambda pair: pair["selected"] >= SHORT_PAIRS - 1, "the pairs")
        pid = running.worker()["pid"]
        running.kill()
        wait_until(lambda: has_finished(pid), "the end of the worker")
    with service(config, router, warm=False) as running:
        reported = running.until(running.history, lambda reported: reported["total"] > 0, "the solve")
        assert reported["results"][0]["pairs"] >= 3
        assert running.terminate() == 0


def has_finished(pid: int) -> bool:
    """Gone, or waiting for a parent that collects it."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except FileNotFoundError:
        return True


@pytest.mark.fault(
    "a thread of the service dies", "the process ends with its own exit code after telling health, and ROS, why"
)
def test_a_thread_that_dies_ends_the_service_after_health_has_reported_why(
    tmp_path: Path, drive: Drive, router: Router
) -> None:
    message: list[bytes] = []

    def receive(sample: zenoh.Sample) -> None:
        message.append(sample.payload.to_bytes())

    config = configured(tmp_path, drive, router)
    speaking_to_ros(config, "diagnostics")
    with (
        listening(router.session, "/diagnostics") as nodes,
        service(config, router, warm=False, program=BROKEN) as running,
    ):
        subscriber = router.session.declare_subscriber(
            running.keys.health(FRONT), zenoh.handlers.Callback(receive, indirect=False)
        )
        sweep = next(frame for frame in drive.frames if isinstance(frame, LidarFrame))
        router.session.put("sensors/sim/lidar", encode_lidar(sweep), encoding=MSGPACK)
        assert running.process.wait(PATIENCE_S) == ExitCode.FAULT
        subscriber.undeclare()
    health = from_msgpack(HealthReply, message[-1])
    (why,) = (reason for reason in health.reasons if reason.code == "thread_died")
    assert "broken" in why.text
    assert nodes.levels(FRONT)[-1] in (ERROR, STALE)
    reported = {value.key: value.value for value in nodes.statuses(FRONT)[-1].values}
    assert reported["service"] == "failing"
    assert "broken" in reported["reason thread_died"]


@pytest.mark.fault("steps of the shutdown raise", "the other steps are still done")
def test_the_end_goes_on_after_steps_that_raise(tmp_path: Path, drive: Drive, router: Router) -> None:
    config = configured(tmp_path, drive, router)
    with service(config, router, warm=False, program=STUBBORN) as running:
        running.send(drive.frames)
        running.until(running.counters, lambda pair: pair["selected"] >= SHORT_PAIRS - 1, "the pairs")
        assert running.terminate() == 0
        log = running.log.read_text()
    for step in ("take no more samples", "finish a window", "withdraw the answers"):
        assert f'"step": "{step}"' in log
    assert '"message": "stopped"' in log
    assert list((tmp_path / "state" / "windows").glob("*.mcap")), "the recorder was ended all the same"


@pytest.mark.fault("wrong keys, parameters and payloads", "each gets an answer with a code")
def test_every_wrong_question_gets_an_answer(idle: Service) -> None:
    keys = idle.keys
    root = keys.root
    for key, parameters, expected in [
        (keys.extrinsic("none"), "", "bad_request"),
        (f"{root}/{FRONT}/nothing", "", "bad_request"),
        (f"{root}/nothing/at/all", "", "bad_request"),
        (keys.extrinsic(FRONT), ";at=1", "bad_request"),
        (keys.history(FRONT), ";limit=-1", "bad_request"),
        (keys.window(FRONT, "sim-12"), "", "not_found"),
        (keys.window(FRONT, "..-12"), "", "not_found"),
        (keys.command(FRONT, "dance"), "", "bad_request"),
        (keys.command(FRONT, "apply"), "", "nothing_pending"),
        (keys.command(FRONT, "rollback"), "", "not_found"),
        (keys.command(FRONT, "commission"), "", "too_few_windows"),
        (keys.overlay(FRONT), "", "not_found"),
        (keys.overlay(FRONT), ";at=somewhere", "bad_request"),
        (keys.evidence_of(FRONT, "sim-12"), "", "not_found"),
        (keys.evidence_of(FRONT, "sim-12"), ";overlay=both", "bad_request"),
    ]:
        assert code(idle, key, parameters) == expected, key
    assert idle.query(keys.evidence(FRONT))["events"] == []
    for name, payload in (("calibrate", b"x"), ("reset", b'{"all":true}'), ("hold", b'{"release":1}')):
        assert code(idle, keys.command(FRONT, name), payload=payload) == "bad_request"
    few = idle.command("calibrate")
    assert (few["accepted"], few["text"]) == (False, "3 more pairs needed.")


def test_queries_about_the_whole_vehicle(idle: Service) -> None:
    keys = idle.keys
    reported = {str(reply.ok.key_expr) for reply in idle.session.get(f"{keys.root}/*/health") if reply.ok}
    assert reported == {keys.health(FRONT), keys.health(REAR)}
    assert idle.query(keys.config)["config"]["vehicle"] == idle.config.vehicle
    (metrics,) = idle.session.get(keys.metrics)
    assert metrics.ok is not None
    text = metrics.ok.payload.to_string()
    assert f'coec_health{{pair="{FRONT}",coec_health="unknown"}} 1' in text
    assert text.endswith("# EOF\n")


@pytest.mark.slow
@pytest.mark.fault(
    "the state directory is in use by another daemon", "exit code 75, which a service manager tries again"
)
def test_a_second_daemon_on_the_same_directory_is_refused(idle: Service) -> None:
    command = [*COMMAND, "run", "--config", str(idle.log.with_name("coec.yaml"))]
    second = subprocess.run(command, env=environment(), capture_output=True, timeout=PATIENCE_S, check=False)
    assert second.returncode == EXIT_TRY_AGAIN
    assert b"in use by another daemon" in second.stdout


@pytest.mark.fault("`insecure: true`", "health and status say so, and no key is shown")
@pytest.mark.fault("a damaged state at the start", "health says so, and nominal is served")
def test_a_door_for_everybody_and_a_damaged_state_are_reported_and_keys_are_hidden(
    tmp_path: Path, drive: Drive, router: Router
) -> None:
    (tmp_path / "state").mkdir()
    (tmp_path / "state" / "state.json").write_text('{"body":{}}')
    path = configured(tmp_path, drive, router)
    config = load_config(path)
    secret = "c2VjcmV0"
    zenoh_config = ZenohConfig(
        embedded_router=True,
        listen=(f"tcp/0.0.0.0:{free_port()}",),
        connect=(f"tls/127.0.0.1:{free_port()}#connect_private_key_base64={secret}",),
        insecure=True,
    )
    path.write_text(commented_yaml(config.model_copy(update={"zenoh": zenoh_config})))
    with service(path, None, warm=False) as running:
        for reported in (running.health(), running.status()):
            assert "insecure" in [reason["code"] for reason in reported["reasons"]]
        assert "state_damaged" in [reason["code"] for reason in running.health()["reasons"]]
        assert running.counters()["losses"] == {"state_damaged": 1}
        assert running.extrinsic()["provenance"] == "nominal"
        (shown,) = running.query(running.keys.config)["config"]["zenoh"]["connect"]
        assert shown.endswith("#connect_private_key_base64=***")
        assert running.terminate() == 0
        assert secret not in running.log.read_text()


@pytest.mark.fault(
    "a second daemon of the same vehicle",
    "it leaves with exit code 75 and says who is there",
)
def test_a_second_daemon_of_the_vehicle_leaves_and_says_who_is_there(idle: Service, tmp_path: Path) -> None:
    config = str(idle.log.with_name("coec.yaml"))
    command = [*COMMAND, "run", "--config", config, "--state-dir", str(tmp_path / "other")]
    second = subprocess.run(command, env=environment(), capture_output=True, timeout=PATIENCE_S, check=False)
    assert second.returncode == EXIT_TRY_AGAIN
    assert b"is served by another daemon, started 20" in second.stdout
    assert b'"code": "unavailable"' in second.stdout
    assert idle.status()["pairs"], "the first goes on"


@pytest.mark.slow
@pytest.mark.fault("the depth network is not there", "a clear error")
def test_a_missing_network_ends_the_service_with_a_clear_error(tmp_path: Path, drive: Drive, router: Router) -> None:
    with service(configured(tmp_path, drive, router, depth="absent.onnx"), router, warm=False) as running:
        assert running.process.wait(PATIENCE_S) == ExitCode.CONFIGURATION
    assert "absent.onnx" in (tmp_path / "coec.log").read_text()
