"""The daemon as a process, over Zenoh: frames in, a window, a killed worker, an estimate, an orderly end, a restart."""

from __future__ import annotations

import json
import os
import queue
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import zenoh

from coec.adapters.files.rig import rig_to_json
from coec.adapters.frames.msgpack_frames import encode_camera, encode_ego, encode_lidar
from coec.adapters.mcap.windows import read_result, read_window
from coec.adapters.system.notify import Notifier
from coec.adapters.zenoh.bus import MSGPACK, open_session
from coec.calibration.types import CameraFrame, LidarFrame
from coec.config import Config, LimitsConfig, ZenohConfig
from coec.daemon import EXIT_THREAD_DIED, Daemon, Signals
from coec.runtime.ingest.stream import Stream
from coec.schemas.keys import Keys
from coec.sources import open_source
from fakes import wait_until

DEADLINE_S = 120.0
"""A first start compiles every kernel."""

STOP_LIMIT_S = 15.0
FRAMES = 6
SOURCE = f"synthetic:?frames={FRAMES}&period_s=2&width=240"
KEYS = Keys("coec", "test")
START = (
    "import sys; from pathlib import Path; from coec.config import load_config; from coec.daemon import run; "
    "path = Path(sys.argv[1]); sys.exit(run(load_config(path), lambda: load_config(path)))"
)


def configuration(folder: Path, endpoint: str, model: str = "stereo") -> dict[str, Any]:
    rig = rig_to_json(open_source(SOURCE).rig)
    front = {
        "name": "front",
        "camera": {"key": "in/camera", "frame_id": rig["camera_frame"], "intrinsics": rig["camera"]},
        "lidar": {"key": "in/lidar", "frame_id": rig["lidar_frame"]},
        "ego": {"key": "in/ego", "T_lidar_ego": rig["T_lidar_ego"]},
        "T_camera_lidar": rig["T_camera_lidar_nominal"],
        "window": {"pairs": FRAMES, "min_pairs": 3, "slice_s": 2.0 * FRAMES, "min_points_in_view": 100},
        "calibration": {"depth": {"model": model}, "search": {"max_evaluations": 60}},
    }
    rear = {**front, "name": "rear", "camera": {**front["camera"], "key": "in/other"}}
    return {
        "vehicle": "test",
        "zenoh": {"embedded_router": True, "listen": [endpoint]},
        "state": {"directory": str(folder / "state"), "min_free_bytes": 0},
        "pairs": [front, rear],
    }


@dataclass
class Served:
    """A running daemon, and a client's view of it."""

    process: subprocess.Popen[bytes]
    client: zenoh.Session

    def get(self, key: str, parameters: str = "", payload: bytes | None = None) -> dict[str, Any]:
        """The one reply, good or bad, in JSON."""
        selector = f"{key}?format=json{parameters}"
        (reply,) = self.client.get(selector, payload=payload, timeout=30.0)
        result: dict[str, Any] = json.loads(reply.result.payload.to_bytes())
        return result

    def worker(self) -> dict[str, Any]:
        worker: dict[str, Any] = self.get(KEYS.status)["worker"]
        return worker

    def stop(self) -> float:
        """SIGTERM; seconds until the end. Fails when the exit status is not 0."""
        started_s = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        assert self.process.wait(STOP_LIMIT_S) == 0
        return time.monotonic() - started_s


@contextmanager
def serving(document: dict[str, Any], folder: Path, endpoint: str) -> Iterator[Served]:
    path = folder / "coec.json"
    path.write_text(json.dumps(document))
    Config.model_validate(document)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[1] / "service")}
    with (folder / "log").open("ab") as log:
        process = subprocess.Popen([sys.executable, "-c", START, str(path)], env=environment, stdout=log, stderr=log)
    try:
        with open_session(ZenohConfig(connect=(endpoint,)), LimitsConfig()) as client:
            alive: queue.SimpleQueue[object] = queue.SimpleQueue()
            token = client.liveliness().declare_subscriber(KEYS.alive("rear"), alive.put, history=True)
            alive.get(timeout=DEADLINE_S)
            token.undeclare()
            yield Served(process, client)
    except BaseException:
        sys.stderr.write((folder / "log").read_text()[-8000:])
        raise
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def publish_drive(client: zenoh.Session) -> None:
    for frame in open_source(SOURCE).messages():
        if isinstance(frame, CameraFrame):
            client.put("in/camera", encode_camera(frame), encoding=MSGPACK)
        elif isinstance(frame, LidarFrame):
            client.put("in/lidar", encode_lidar(frame), encoding=MSGPACK)
        else:
            client.put("in/ego", encode_ego(frame), encoding=MSGPACK)


def test_a_drive_a_killed_worker_an_end_and_a_restart(tmp_path: Path, endpoint: str) -> None:
    document = configuration(tmp_path, endpoint)
    nominal = document["pairs"][0]["T_camera_lidar"]
    with serving(document, tmp_path, endpoint) as served:
        before = served.get(KEYS.extrinsic("front"))
        assert (before["provenance"], before["status"], before["percent_complete"]) == ("nominal", "not_accepted", 0)
        assert before["camera_from_lidar"]["matrix"] == nominal
        health = served.get(KEYS.health("front"))
        assert (health["state"], health["level"]) == ("unknown", 3)
        assert "3 more pairs" in health["needs"]

        wait_until(lambda: served.get(KEYS.status)["state"] == "running", "a warm worker", DEADLINE_S)
        served.client.put("in/camera", b"\x81\xa1x\xc1", encoding=MSGPACK)
        publish_drive(served.client)
        # The last pair is certain only when the streams go on, or end.
        wait_until(lambda: served.get(KEYS.status)["pairs"][0]["camera"]["received"] == FRAMES + 1, "the drive")
        wait_until(lambda: served.get(KEYS.status)["pairs"][0]["selected"] >= FRAMES - 1, "the pairs")
        pair = served.get(KEYS.status)["pairs"][0]
        assert sum(pair["camera"]["losses"].values()) == 1
        assert served.get(KEYS.extrinsic("front"))["percent_complete"] > 0

        changes: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        served.client.declare_subscriber(KEYS.extrinsic("front"), changes.put)
        first = served.worker()
        os.kill(first["pid"], signal.SIGSTOP)
        acknowledged = served.get(KEYS.command("front", "calibrate"))
        assert acknowledged["accepted"], acknowledged
        assert acknowledged["code"] == "window_finished"
        wait_until(lambda: served.worker()["state"] == "busy", "the job with the worker")
        os.kill(first["pid"], signal.SIGKILL)
        assert served.get(KEYS.extrinsic("front"))["provenance"] == "nominal"

        changes.get(timeout=DEADLINE_S)
        after = served.get(KEYS.extrinsic("front"))
        assert served.worker()["restarts"] == 1
        window_id = acknowledged["window_id"]
        path = tmp_path / "state" / "windows" / f"{window_id}.mcap"
        window, _ = read_window(path)
        assert len(window.pairs) == FRAMES
        result = read_result(path)
        assert result is not None
        (kept,) = served.get(KEYS.history("front"))["results"]
        assert kept == json.loads(result.model_dump_json())
        assert after["status"] == result.status
        if result.status == "accepted":
            assert after["provenance"] == "estimated"
            assert after["camera_from_lidar"] == kept["camera_from_lidar"]
            assert after["window_id"] == window_id
        else:
            assert after["camera_from_lidar"]["matrix"] == nominal
        health = served.get(KEYS.health("front"))
        assert health["state"] in ("healthy", "suspect")
        assert 0 <= health["age_s"] < DEADLINE_S
        assert served.get(KEYS.health("rear"))["state"] == "unknown"

        (info,) = served.get(KEYS.windows("front"))["windows"]
        assert (info["window_id"], info["pairs"], info["decision"]) == (window_id, FRAMES, kept["verdict"]["decision"])
        (part,) = served.client.get(f"{KEYS.window('front', window_id)}?offset=8;length=100")
        assert part.ok is not None
        assert part.ok.payload.to_bytes() == path.read_bytes()[8:108]

        again = served.get(KEYS.command("front", "calibrate"))
        assert (again["code"], again["window_id"]) == ("window_again", window_id)
        wait_until(lambda: served.get(KEYS.history("front"))["total"] == 2, "the second solve", DEADLINE_S)
        one, two = served.get(KEYS.history("front"))["results"]
        assert one == two, "the same window and configuration give the same result"
        assert served.stop() < STOP_LIMIT_S

    with serving(document, tmp_path, endpoint) as served:
        restored = served.get(KEYS.extrinsic("front"))
        assert restored["camera_from_lidar"] == after["camera_from_lidar"]
        assert restored["provenance"] == ("restored" if result.status == "accepted" else "nominal")
        assert served.get(KEYS.history("front"))["total"] == 2
        publish_drive(served.client)  # and silence: the slice ends by itself
        wait_until(lambda: served.get(KEYS.history("front"))["total"] == 3, "the end of the slice", DEADLINE_S)
        assert len(read_window(path)[0].pairs) == FRAMES
        served.stop()


def test_the_open_window_outlives_a_stop_and_is_solved_after_the_start(tmp_path: Path, endpoint: str) -> None:
    document = configuration(tmp_path, endpoint)
    with serving(document, tmp_path, endpoint) as served:
        publish_drive(served.client)
        wait_until(lambda: served.get(KEYS.status)["pairs"][0]["selected"] >= FRAMES - 1, "the pairs")
        served.stop()
    (path,) = (tmp_path / "state" / "windows").iterdir()
    assert len(read_window(path)[0].pairs) == FRAMES
    with serving(document, tmp_path, endpoint) as served:
        wait_until(lambda: bool(served.get(KEYS.history("front"))["total"]), "the solve", DEADLINE_S)
        wait_until(lambda: served.get(KEYS.extrinsic("front"))["status"] != "not_accepted", "the result")
        served.stop()


def test_a_killed_service_takes_its_worker_along_and_its_window_is_salvaged(tmp_path: Path, endpoint: str) -> None:
    document = configuration(tmp_path, endpoint)
    with serving(document, tmp_path, endpoint) as served:
        publish_drive(served.client)
        wait_until(lambda: served.get(KEYS.status)["pairs"][0]["selected"] >= FRAMES - 1, "the pairs")
        pid = served.worker()["pid"]
        served.process.kill()
        served.process.wait()
        wait_until(lambda: has_ended(pid), "the end of the worker")
    with serving(document, tmp_path, endpoint) as served:
        wait_until(lambda: bool(served.get(KEYS.history("front"))["total"]), "the solve", DEADLINE_S)
        (result,) = served.get(KEYS.history("front"))["results"]
        assert result["pairs"] >= 3
        served.stop()


def has_ended(pid: int) -> bool:
    """Gone, or waiting for a parent that collects it."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except FileNotFoundError:
        return True


def test_a_thread_that_dies_ends_the_service_after_health_has_said_why(
    tmp_path: Path, endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: Stream) -> None:
        raise RuntimeError("broken")

    monkeypatch.setattr(Stream, "_end_in_silence", fail)
    daemon = Daemon(Config.model_validate(configuration(tmp_path, endpoint)), Notifier(None))
    assert daemon.serve(Signals(), None) == EXIT_THREAD_DIED
    health = json.loads(daemon._pairs["front"].answers.health("json").payload)
    assert [reason["code"] for reason in health["reasons"]] == ["not_evaluated", "thread_died"]
    assert "broken" in health["reasons"][1]["text"]


def test_every_wrong_question_gets_an_answer(tmp_path: Path, endpoint: str) -> None:
    with serving(configuration(tmp_path, endpoint), tmp_path, endpoint) as served:
        root = KEYS.root
        for key, parameters, code in [
            (KEYS.extrinsic("none"), "", "bad_request"),
            (f"{root}/front/nothing", "", "bad_request"),
            (f"{root}/nothing/at/all", "", "bad_request"),
            (KEYS.extrinsic("front"), ";at=1", "bad_request"),
            (KEYS.history("front"), ";limit=-1", "bad_request"),
            (KEYS.window("front", "front-12"), "", "not_found"),
            (KEYS.window("front", "..-12"), "", "not_found"),
            (KEYS.command("front", "dance"), "", "bad_request"),
            (KEYS.command("front", "apply"), "", "nothing_pending"),
            (KEYS.command("front", "rollback"), "", "not_found"),
            (KEYS.command("front", "commission"), "", "too_few_windows"),
            (KEYS.overlay("front"), "", "not_found"),
            (KEYS.overlay("front"), ";at=somewhere", "bad_request"),
            (KEYS.evidence_of("front", "front-12"), "", "not_found"),
            (KEYS.evidence_of("front", "front-12"), ";overlay=both", "bad_request"),
        ]:
            assert served.get(key, parameters).get("code") == code, key
        assert served.get(KEYS.evidence("front"))["events"] == []
        for name, payload in (("calibrate", b"x"), ("reset", b'{"all":true}'), ("hold", b'{"release":1}')):
            assert served.get(KEYS.command("front", name), payload=payload)["code"] == "bad_request"
        few = served.get(KEYS.command("front", "calibrate"))
        assert (few["accepted"], few["text"]) == (False, "3 more pairs needed.")
        keys = {str(reply.ok.key_expr) for reply in served.client.get(f"{root}/*/health") if reply.ok}
        assert keys == {KEYS.health("front"), KEYS.health("rear")}
        assert served.get(KEYS.config)["config"]["vehicle"] == "test"
        (metrics,) = served.client.get(KEYS.metrics)
        assert metrics.ok is not None
        text = metrics.ok.payload.to_string()
        assert 'coec_health{pair="front",coec_health="unknown"} 1' in text
        assert text.endswith("# EOF\n")
        served.process.send_signal(signal.SIGHUP)
        wait_until(lambda: "nothing has changed" in (tmp_path / "log").read_text(), "the configuration read again")
        served.stop()


def test_a_damaged_state_is_said_and_nominal_is_served(tmp_path: Path, endpoint: str) -> None:
    (tmp_path / "state").mkdir()
    (tmp_path / "state" / "state.json").write_text('{"body":{}}')
    with serving(configuration(tmp_path, endpoint), tmp_path, endpoint) as served:
        health = served.get(KEYS.health("front"))
        assert "state_damaged" in [reason["code"] for reason in health["reasons"]]
        assert served.get(KEYS.status)["pairs"][0]["losses"] == {"state_damaged": 1}
        assert served.get(KEYS.extrinsic("front"))["provenance"] == "nominal"
        served.stop()


def test_a_missing_network_ends_the_service_with_a_clear_error(tmp_path: Path, endpoint: str) -> None:
    document = configuration(tmp_path, endpoint, model="absent.onnx")
    with serving(document, tmp_path, endpoint) as served:
        assert served.process.wait(DEADLINE_S) == 1
    assert "absent.onnx" in (tmp_path / "log").read_text()


def test_a_second_daemon_on_the_same_directory_is_refused(tmp_path: Path, endpoint: str) -> None:
    document = configuration(tmp_path, endpoint)
    with serving(document, tmp_path, endpoint) as served:
        second = subprocess.run(
            [sys.executable, "-c", START, str(tmp_path / "coec.json")],
            env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[1] / "service")},
            capture_output=True,
            timeout=60,
            check=False,
        )
        assert second.returncode == 78
        assert b"in use by another daemon" in second.stdout
        served.stop()
