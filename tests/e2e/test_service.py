"""The whole way with real processes: frames played, a window recorded and solved, the answer asked for and reached
again."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from coec.calibration.types import Frame
from coec.cli import play
from coec.config import CalibrationConfig, DepthConfig, ObjectiveConfig, WindowConfig
from coec.io.mcap.windows import read_result, read_window
from coec.io.recordings.layouts import open_source
from e2e.drives import NS_PER_S, SHORT, SHORT_PAIRS, Drive, later, rendered
from e2e.processes import Router, Service, coec, coec_here, free_endpoint, service, write_configuration
from support.fake_worker import wait_until
from support.simulated_drives import rendered_drive

SHORT_S = 12
PERTURBATION = np.array([*np.radians([2.0, -1.5, 1.0]), 0.0, 0.0, 0.0])
MAX_ERROR_DEG = 0.35
WINDOW = WindowConfig(pairs=SHORT_PAIRS, min_pairs=4, slice_s=SHORT_S)

MAPS = DepthConfig(model="stereo")
"""Depth from the maps that come with the frames."""

BY_DEPTH = CalibrationConfig(depth=MAPS, objective=ObjectiveConfig(kind="mi"))
"""Six small pictures have too few edges for `fused`."""

SLOW = CalibrationConfig(depth=MAPS, objective=ObjectiveConfig(depth_bins=256, range_bins=256))
"""Sixty-five thousand cells per histogram: a solve takes seconds, so that there is a middle of it."""

OVER_S = 3.0
"""Into the next slice: its first pair is then certain, and the slice before has ended."""

KITTI_SPEED = 20.0
"""Times as fast as recorded: the ten pairs lie 6 to 23 s apart, and are some MB each: too much for a burst."""

COMPUTED_S = 0.2
"""Processor time after which the worker is in that middle."""


@pytest.fixture(scope="module")
def drive() -> Drive:
    pytest.importorskip("embreex", reason="needs embreex")
    return rendered(SHORT)


def _text(document: Any) -> str:
    return json.dumps(document["camera_from_lidar"], sort_keys=True)


def _requested(endpoint: str, *arguments: object) -> Any:
    """The document of `coec query ARGS --json`."""
    done = coec_here("query", *arguments, "--connect", endpoint, "--json")
    assert done.returncode == 0, f"{arguments}: {done.stdout}{done.stderr}"
    return json.loads(done.stdout)


def _played(endpoint: str, source: str | Path, config: Path, rate: float) -> None:
    done = coec_here("play", source, "--config", config, "--rate", rate, "--connect", endpoint, "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["nobody_listened_to"] == []


def _solved(running: Service, endpoint: str, count: int) -> Any:
    """Has the window of so many pictures finished, unless silence did, and solved; the extrinsic that is served
    then."""
    running.until(running.counters, lambda pair: pair["camera"]["received"] == count, "every picture")
    acknowledged = _requested(endpoint, "command/calibrate")
    assert acknowledged["accepted"], acknowledged
    running.until(running.extrinsic, lambda reported: reported["status"] != "not_accepted", "the result")
    return _requested(endpoint, "extrinsic")


def _check_corrected(extrinsic: Any, perturbation: Any) -> None:
    """The nominal calibration was off by -perturbation: that is what must have been corrected."""
    correction = np.array([extrinsic["axes"][axis]["correction"] for axis in ("rx", "ry", "rz")])
    assert np.abs(correction + np.degrees(perturbation[:3])).max() < MAX_ERROR_DEG


def _check_same_by_calibrate(endpoint: str, extrinsic: Any, folder: Path) -> Path:
    """Downloads the window, calibrates it, replays it: the same to the byte."""
    window = folder / "downloaded.mcap"
    _requested(endpoint, f"windows/{extrinsic['window_id']}", "--output", window)
    calibrated = coec_here("calibrate", window, "--json")
    assert calibrated.returncode == 0, calibrated.stderr
    assert _text(json.loads(calibrated.stdout)) == _text(extrinsic)
    assert coec_here("replay", window).returncode == 0
    return window


def _check_exported(endpoint: str, state: Path, config: Path) -> None:
    """The file that the service answers is the one that its state directory exports to."""
    answered = _requested(endpoint, "extrinsic", "--param", "format=kalibr")
    exported = coec_here("export", state, "--config", config, "--format", "kalibr")
    assert exported.returncode == 0, exported.stderr
    assert exported.stdout == answered


def _check_opens_in_ros_tools(window: Path, topic: str, pairs: int) -> None:
    with window.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        clouds = [message for *_, message in reader.iter_decoded_messages([topic])]
    assert len(clouds) == pairs
    assert all(cloud.width * cloud.height > 0 for cloud in clouds)


def test_from_frames_to_extrinsic(
    tmp_path: Path, drive: Drive, router: Router, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coec_lab.simulation.source.open_sim", rendered_drive)
    source = drive.recording
    config = write_configuration(tmp_path, source, router.endpoint, PERTURBATION, calibration=BY_DEPTH, window=WINDOW)
    with service(config, router) as running:
        before = _requested(router.endpoint, "extrinsic")
        assert (before["provenance"], before["status"]) == ("nominal", "not_accepted")
        refused = coec_here("query", "extrinsic", "--param", "format=urdf", "--connect", router.endpoint)
        assert (refused.returncode, "nothing has been accepted yet" in refused.stderr) == (1, True)
        _played(router.endpoint, drive.source, config, 0.0)
        extrinsic = _solved(running, router.endpoint, SHORT_PAIRS)
        assert (extrinsic["provenance"], extrinsic["status"]) == ("estimated", "accepted")
        _check_corrected(extrinsic, PERTURBATION)
        assert _requested(router.endpoint, "health")["state"] == "healthy"
        _check_exported(router.endpoint, tmp_path / "state", config)
        window = _check_same_by_calibrate(router.endpoint, extrinsic, tmp_path)
        (listed,) = _requested(router.endpoint, "windows")["windows"]
        assert listed["decision"] == "accepted"
        _check_opens_in_ros_tools(window, "/coec/sim/lidar/points", listed["pairs"])
        assert running.terminate() == 0


@pytest.mark.slow
def test_kitti360_from_frames_to_extrinsic(tmp_path: Path, sample_data: Path) -> None:
    """Real sensors, and a service that is its own router."""
    source = f"kitti360:{sample_data / 'kitti360'}?camera=image_00"
    perturbation = np.array([*np.radians([3.0, -3.0, 3.0]), 0.0, 0.0, 0.0])
    endpoint = free_endpoint()
    calibration = CalibrationConfig(depth=MAPS)
    config = write_configuration(tmp_path, open_source(source), endpoint, perturbation, calibration=calibration)
    with service(config, None) as running:
        _played(endpoint, source, config, KITTI_SPEED)
        extrinsic = _solved(running, endpoint, 10)
        assert extrinsic["status"] == "accepted"
        _check_corrected(extrinsic, perturbation)
        _check_same_by_calibrate(endpoint, extrinsic, tmp_path)
        assert running.terminate() == 0


def _bring_into_a_solve(running: Service, frames: list[Frame]) -> int:
    """Sends a window, with the frame that ends it, and returns the worker's process once it computes.

    The worker is held while the job comes to it, so that there is time to see it, and let go until it has computed for
    a while: a solve with `SLOW` takes much longer.
    """
    # A new worker prepares kernels while nothing waits; held in that, it would not take the job.
    idle = running.until(running.worker, lambda reported: reported["state"] == "idle", "the worker has nothing to do")
    worker = psutil.Process(idle["pid"])
    worker.suspend()
    running.send(frames)
    running.until(running.worker, lambda reported: reported["state"] == "busy", "the worker has the window")
    before_s = worker.cpu_times().user
    worker.resume()
    wait_until(lambda: worker.cpu_times().user > before_s + COMPUTED_S, "the worker computes")
    return int(worker.pid)


@pytest.mark.slow
@pytest.mark.fault("the worker is killed, then the service stopped, in a solve", "no window is lost")
def test_worker_killed_and_service_stopped_in_a_solve_lose_no_window(
    tmp_path: Path, drive: Drive, router: Router
) -> None:
    config = write_configuration(
        tmp_path, drive.recording, router.endpoint, PERTURBATION, calibration=SLOW, window=WINDOW
    )
    windows = tmp_path / "state" / "windows"
    frames = [*drive.frames, *later(drive.frames, SHORT_S), *later(drive.frames, 2 * SHORT_S)]
    started_ns = drive.start_ns + round((SHORT_S + OVER_S) * NS_PER_S)
    with service(config, router) as running:
        victim = _bring_into_a_solve(running, [frame for frame in frames if frame.stamp_ns < started_ns])
        os.kill(victim, signal.SIGKILL)
        assert running.extrinsic()["status"] == "not_accepted"
        assert running.health()["state"] in ("unknown", "degraded")

        def replaced(worker: Any) -> bool:
            return worker["restarts"] == 1 and worker["pid"] not in (None, victim)

        running.until(running.worker, replaced, "another worker is there")
        reported = running.until(
            running.history, lambda reported: bool(reported["results"]), "the window is solved after all"
        )
        (result,) = reported["results"]
        recorded = read_result(windows / f"{result['window_id']}.mcap")
        assert recorded is not None
        assert recorded.model_dump(mode="json") == result
        assert result["pairs"] == SHORT_PAIRS

        # The rest ends a second window, and leaves a third one open.
        _bring_into_a_solve(running, [frame for frame in frames if frame.stamp_ns >= started_ns])
        assert running.terminate() == 0
    files = sorted(windows.iterdir())
    assert [(path.suffix, read_result(path) is None) for path in files] == [(".mcap", n > 0) for n in range(3)]
    first, *others = (len(read_window(path)[0].pairs) for path in files)
    assert first == SHORT_PAIRS
    # Where another worker takes long to come, silence ends what had begun of a slice, and the next one begins later.
    assert all(WINDOW.min_pairs <= pairs <= SHORT_PAIRS for pairs in others)

    with service(config, router, warm=False) as running:
        reported = running.until(
            running.history, lambda reported: reported["total"] == 3, "what the last run left is solved"
        )
        assert reported["results"][0] == result
        assert {one["window_id"] for one in reported["results"]} == {path.stem for path in files}
        assert running.terminate() == 0


def test_playing_to_nobody_says_so(
    drive: Drive, router: Router, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(play, "LISTENER_S", 0.1)
    source = drive.source.replace(f"seconds={SHORT_S}", "seconds=1")
    assert play.play(source, connect=router.endpoint, rate=0.0, as_json=True) == 0
    stated = capsys.readouterr()
    assert json.loads(stated.out)["nobody_listened_to"] == [
        f"sensors/sim/{stream}" for stream in ("camera", "lidar", "ego")
    ]
    assert "nobody listens" in stated.err


def test_queries_to_nobody_fail() -> None:
    done = coec("query", "health", "--connect", "tcp/127.0.0.1:9", "--timeout", "0.5", "--json")
    assert done.returncode == 1
    assert json.loads(done.stdout)["error"]["code"] == "not_connected"
