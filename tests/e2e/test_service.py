"""The whole way with real processes: frames played, a window recorded and solved, the answer asked for and reached
again."""

from __future__ import annotations

import json
import os
import signal
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from coec.adapters.mcap.windows import read_result, read_window
from coec.adapters.zenoh.bus import open_session
from coec.config import CalibrationConfig, DepthConfig, LimitsConfig, ObjectiveConfig, ZenohConfig
from e2e.processes import ANSWER_S, Service, coec, free_port, service, write_configuration
from fakes import wait_until

SYNTHETIC = "synthetic:?frames=12&width=240"
PERTURBATION = np.array([*np.radians([2.0, -1.5, 1.0]), 0.0, 0.0, 0.0])
MAX_ERROR_DEG = 0.35

MAPS = DepthConfig(model="stereo")
STEREO = CalibrationConfig(depth=MAPS)
"""Depth from the maps that come with the frames."""

BY_DEPTH = CalibrationConfig(depth=MAPS, objective=ObjectiveConfig(kind="mi"))
"""The synthetic street has too few pixels for edges."""

SLOW = CalibrationConfig(depth=MAPS, objective=ObjectiveConfig(depth_bins=256, range_bins=256))
"""Sixty-five thousand cells per histogram: a solve takes seconds, so that there is a middle of it."""

COMPUTED_S = 0.2
"""Processor time after which the worker is in that middle."""


def _received(count: int, stream: str = "lidar") -> Any:
    return lambda status: status["pairs"][0][stream]["received"] >= count


def _solved(status: Any) -> bool:
    return bool(status["pairs"][0]["solved"])


def _text(document: Any) -> str:
    return json.dumps(document["camera_from_lidar"], sort_keys=True)


def _play_and_solve(running: Service, source: str, config: Path, rate: float, frames: int) -> Any:
    """Has a window recorded and solved; the extrinsic that is served then."""
    running.play(source, config, rate)
    running.until("status", _received(frames), "every frame has arrived")
    acknowledged = running.ask("command/calibrate")
    assert acknowledged["accepted"], acknowledged
    running.until("status", _solved, "the window is solved")
    return running.ask("extrinsic")


def _bring_into_a_solve(running: Service, source: str, config: Path) -> int:
    """Plays until the slice has ended of itself and the worker computes; the worker's process.

    The worker is held while the job comes to it, so that there is time to see it, and let go until it has computed for
    a while: a solve with `SLOW` takes much longer.
    """
    worker = psutil.Process(running.ask("status")["worker"]["pid"])
    worker.suspend()
    running.play(source, config, 40.0)
    running.until("status", lambda status: status["worker"]["state"] == "busy", "the worker has the window")
    before_s = worker.cpu_times().user
    worker.resume()
    wait_until(lambda: worker.cpu_times().user > before_s + COMPUTED_S, "the worker computes")
    return int(worker.pid)


def _check_same_by_calibrate(running: Service, extrinsic: Any, folder: Path) -> Path:
    """Downloads the window, calibrates it, replays it: the same to the byte."""
    window = folder / "downloaded.mcap"
    running.ask(f"windows/{extrinsic['window_id']}", "--output", window)
    calibrated = coec("calibrate", window, "--json")
    assert calibrated.returncode == 0, calibrated.stderr
    assert _text(json.loads(calibrated.stdout)) == _text(extrinsic)
    assert coec("replay", window).returncode == 0
    return window


def _check_opens_in_ros_tools(window: Path, topic: str, pairs: int) -> None:
    with window.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        clouds = [message for *_, message in reader.iter_decoded_messages([topic])]
    assert len(clouds) == pairs
    assert all(cloud.width * cloud.height > 0 for cloud in clouds)


def test_synthetic_drive_from_frames_to_extrinsic(tmp_path: Path) -> None:
    config = write_configuration(tmp_path, SYNTHETIC, PERTURBATION, BY_DEPTH)
    with service(config) as running:
        before = running.ask("extrinsic")
        assert (before["provenance"], before["status"]) == ("nominal", "not_accepted")
        extrinsic = _play_and_solve(running, SYNTHETIC, config, 40.0, 12)
        assert (extrinsic["provenance"], extrinsic["status"]) == ("estimated", "accepted")
        # The nominal calibration was off by -PERTURBATION: that is what must have been corrected.
        correction = np.array([extrinsic["axes"][axis]["correction"] for axis in ("rx", "ry", "rz")])
        assert np.abs(correction + np.degrees(PERTURBATION[:3])).max() < MAX_ERROR_DEG
        assert running.ask("health")["state"] == "healthy"
        window = _check_same_by_calibrate(running, extrinsic, tmp_path)
        listed = running.ask("windows")["windows"]
        assert [item["decision"] for item in listed] == ["accepted"]
        _check_opens_in_ros_tools(window, "/coec/synthetic/lidar/points", listed[0]["pairs"])
        assert running.terminate() == 0

    with service(config) as running:
        again = running.ask("extrinsic")
        assert again["provenance"] == "restored"
        assert _text(again) == _text(extrinsic)
        assert running.terminate() == 0


def test_worker_killed_in_a_solve_is_replaced_and_the_estimate_comes(tmp_path: Path) -> None:
    source = "synthetic:?frames=10&width=160"
    config = write_configuration(tmp_path, source, PERTURBATION, SLOW)
    with service(config) as running:
        victim = _bring_into_a_solve(running, source, config)
        os.kill(victim, signal.SIGKILL)

        assert running.ask("extrinsic")["status"] == "not_accepted"
        assert running.ask("health")["state"] in ("unknown", "degraded")

        def _replaced(status: Any) -> bool:
            worker = status["worker"]
            return worker["restarts"] == 1 and worker["pid"] not in (None, victim)

        running.until("status", _replaced, "another worker is there")
        running.until("status", _solved, "the window is solved after all", 2 * ANSWER_S)
        (result,) = running.ask("history")["results"]
        recorded = read_result(tmp_path / "state" / "windows" / f"{result['window_id']}.mcap")
        assert recorded is not None
        assert recorded.model_dump(mode="json") == result

        # Another drive, left open: its window is finished when the service is told to stop.
        running.play(f"{source}&seed=1", config, 40.0)
        running.until("status", _received(20), "every frame has arrived again")
        assert running.terminate() == 0
    files = sorted((tmp_path / "state" / "windows").iterdir())
    assert all(path.suffix == ".mcap" for path in files), files
    assert sum(len(read_window(path)[0].pairs) for path in files) > result["pairs"]


def test_sigterm_in_a_solve_ends_in_time_and_the_next_start_solves_it(tmp_path: Path) -> None:
    source = "synthetic:?frames=10&width=160"
    config = write_configuration(tmp_path, source, PERTURBATION, SLOW)
    with service(config) as running:
        _bring_into_a_solve(running, source, config)
        assert running.terminate() == 0
    (path,) = (tmp_path / "state" / "windows").iterdir()
    assert read_result(path) is None
    with service(config) as running:
        running.until("history", lambda history: bool(history["results"]), "the window of the last run is solved")
        assert running.terminate() == 0


def test_kitti360_from_frames_to_extrinsic(tmp_path: Path, sample_data: Path) -> None:
    source = f"kitti360:{sample_data / 'kitti360'}?camera=image_00"
    perturbation = np.array([*np.radians([3.0, -3.0, 3.0]), 0.0, 0.0, 0.0])
    config = write_configuration(tmp_path, source, perturbation, STEREO)
    with service(config) as running:
        extrinsic = _play_and_solve(running, source, config, 20.0, 10)
        assert extrinsic["status"] == "accepted"
        correction = np.array([extrinsic["axes"][axis]["correction"] for axis in ("rx", "ry", "rz")])
        assert np.abs(correction + np.degrees(perturbation[:3])).max() < MAX_ERROR_DEG
        _check_same_by_calibrate(running, extrinsic, tmp_path)
        assert running.terminate() == 0


def test_demonstration(tmp_path: Path) -> None:
    pytest.importorskip("embreex", reason="needs ray casting")
    done = coec("demo", "--json", "--output", tmp_path / "demo", timeout_s=10 * ANSWER_S)
    assert done.returncode == 0, done.stdout + done.stderr
    document = json.loads(done.stdout)
    assert document["passed"]
    assert document["error_after_deg"] < MAX_ERROR_DEG < 2.5 < document["error_before_deg"]
    assert document["knock_s"] < document["alarm_s"] <= document["repaired_s"]
    states = [moment["health"] for moment in document["timeline"]]
    assert states[0] == "unknown"
    assert states[-1] == "healthy"
    assert "miscalibrated" in states
    written = [Path(path) for path in document["files"]]
    assert all(path.stat().st_size > 0 for path in written)
    assert {"timeline.png", "overlay_before.png", "overlay_after.png", "report.html"} <= {path.name for path in written}
    (window,) = (path for path in written if path.suffix == ".mcap")
    assert coec("replay", window, timeout_s=2 * ANSWER_S).returncode == 0


def test_playing_to_nobody_says_so() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with closing(open_session(ZenohConfig(embedded_router=True, listen=(endpoint,)), LimitsConfig())):
        done = coec("play", "synthetic:?frames=1&width=64", "--connect", endpoint, "--rate", "0", "--json")
    assert done.returncode == 0
    assert json.loads(done.stdout)["nobody_listened_to"] == [
        f"sensors/synthetic/{stream}" for stream in ("camera", "lidar", "ego")
    ]
    assert "nobody listens" in done.stderr


def test_questions_to_nobody_fail() -> None:
    done = coec("query", "health", "--connect", "tcp/127.0.0.1:9", "--timeout", "0.5", "--json")
    assert done.returncode == 1
    assert json.loads(done.stdout)["error"]["code"] == "not_connected"
