"""What an engineer reads in the log of a run: the story of windows, checks and streams, at a bounded rate."""

from __future__ import annotations

import logging
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, ImageFormat, LidarFrame, Reason
from coec.io.frame_validation import Refusal
from coec.io.logs import LOST, LossCounter, loss_text
from coec.service.engine import frame_selector
from coec.service.ingest.decoder import EXPLAINED, QUIET_S, RATE_FRAMES, SILENT_S, StreamLog
from coec.service.worker.compilation import Compiling
from support.vehicles import BEGIN_S, DRIVE_END_S, NS_PER_S, STEP_S, PairBench, SlowWorker, frame_pair_at


def lines(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records]


def camera(stamp_ns: int) -> CameraFrame:
    return CameraFrame(stamp_ns, "front_camera", EncodedImage(ImageFormat.MONO8, 160, 120, b""))


# --- windows and checks -----------------------------------------------------------------------------------------------


def test_a_drive_in_which_the_mount_moves_is_a_story_of_a_few_lines(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frame_selector, "PROGRESS_S", 0.0)
    caplog.set_level(logging.INFO)
    PairBench(tmp_path / "state").drive(BEGIN_S, DRIVE_END_S)
    reported = lines(caplog)
    for expected in (
        "window: 1 of 10 pairs",
        "window ended with 10 pairs: it is recorded",
        "health: healthy, before unknown",
        "checks: they agree with what is served",
        "health: suspect, before healthy",
    ):
        assert expected in reported, reported
    solved = next(line for line in reported if line.startswith("window solved, accepted: 0."))
    assert "σ 0.03°" in solved
    assert all(line != before for before, line in pairwise(reported)), "nothing is said twice in a row"


def test_pairs_of_a_window_are_logged_at_a_bounded_rate(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A drive of minutes goes through the bench in far less than `PROGRESS_S`."""
    caplog.set_level(logging.INFO)
    PairBench(tmp_path / "state").drive(BEGIN_S, STEP_S)
    reported = lines(caplog)
    windows = sum(line.startswith("window ended") for line in reported)
    assert windows > 1
    assert sum(line.startswith("window: ") for line in reported) <= windows + 1, reported


def test_checks_are_logged_when_what_they_say_changes(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    bench = PairBench(tmp_path / "state")
    bench.drive(BEGIN_S, STEP_S)
    assert bench.pair.engine.snapshot().checks > 10
    assert len([line for line in lines(caplog) if line.startswith("checks: ")]) < 5


def test_checks_that_the_worker_did_not_begin_do_not_make_the_monitor_blind(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bench = PairBench(tmp_path / "state")
    bench.worker.fault = Compiling(3, 38, 1.0).reason
    bench.drive(BEGIN_S, BEGIN_S + 60)
    codes = {reason.code for reason in bench.pair.engine.snapshot().problems}
    assert "monitor_blind" not in codes
    assert bench.losses["monitor", "check_compiling_kernels"] > 3
    assert any("compiles its kernels" in line for line in lines(caplog))
    bench.worker.fault = Reason("dark", "It is dark.")
    bench.drive(BEGIN_S + 60, BEGIN_S + 120)
    assert "monitor_blind" in {reason.code for reason in bench.pair.engine.snapshot().problems}


def test_the_stream_does_not_wait_for_a_worker_that_compiles_its_kernels(tmp_path: Path) -> None:
    bench = PairBench(tmp_path / "state", worker=SlowWorker)

    def drive(begin_s: int, end_s: int) -> None:
        for stamp_ns in range(begin_s * NS_PER_S, end_s * NS_PER_S, NS_PER_S // 2):
            bench.hold(frame_pair_at(stamp_ns))
            while bench.pair.advance(bench.clock.monotonic_s()):
                pass

    drive(BEGIN_S, BEGIN_S + 60)
    assert len(bench.pair.stream.held.pairs) > 0
    bench.worker.warms_up = True
    drive(BEGIN_S + 60, BEGIN_S + 120)
    assert len(bench.pair.stream.held.pairs) == 0
    assert ("monitor", "not_awaited") not in bench.losses
    assert bench.recorder.recorded > 1, "windows are recorded meanwhile"


# --- streams ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "frame", "shape"),
    [
        ("camera", camera(0), "160×120, frame 'front_camera'"),
        ("lidar", LidarFrame(0, "roof", np.zeros((7, 3), np.float32)), "7 points, frame 'roof'"),
        ("ego", EgoMotion(0, "base", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), "frame 'base'"),
    ],
)
def test_the_first_frame_of_a_stream_is_described(
    kind: str, frame: CameraFrame | LidarFrame | EgoMotion, shape: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    log = StreamLog(kind, "in/sensor")
    log.push(frame, 0.0)
    log.push(frame, 0.0)
    assert lines(caplog) == [f"first {kind} frame: {shape}"]


def test_the_rate_of_a_stream_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    log = StreamLog("camera", "in/camera")
    for number in range(3 * RATE_FRAMES):
        log.push(camera(number * NS_PER_S // 10), 0.0)
    assert lines(caplog)[1:] == ["camera frames arrive at 10.0 Hz by their stamps"]


def test_a_stream_that_is_lost_and_comes_back_is_logged_at_a_bounded_rate(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    now_s = 0.0
    log = StreamLog("lidar", "in/lidar")
    log.tick(now_s)
    assert lines(caplog) == [], "a stream from which nothing has come is reported by health"
    sweep = LidarFrame(0, "roof", np.zeros((7, 3), np.float32))
    for _ in range(20):
        log.push(sweep, now_s)
        for _ in range(2 * int(SILENT_S)):
            now_s += 1.0
            log.tick(now_s)
    log.push(sweep, now_s)
    reported = lines(caplog)
    silent = [line for line in reported if line.startswith("no lidar frames for")]
    again = [line for line in reported if line.startswith("lidar frames arrive again after")]
    assert reported[1] == "no lidar frames for 5 s: check the sensor and the network"
    assert 0 < len(silent) <= 20 * 2 * SILENT_S / QUIET_S + 1
    assert len(again) == len(silent)


# --- losses -----------------------------------------------------------------------------------------------------------


def test_a_loss_is_described_as_text(caplog: pytest.LogCaptureFixture) -> None:
    losses = LossCounter(logging.getLogger("test"), "front")
    losses.add("monitor", "not_awaited")
    losses.add("camera", "wrong_type", detail="expected an image")
    (first, second) = caplog.records
    assert first.getMessage().startswith("lost, monitor: frames were used before the answer")
    assert first.fields == {"pair": "front", "place": "monitor", "reason": "not_awaited", "count": 1}  # type: ignore[attr-defined]
    assert second.getMessage() == "lost, camera: expected an image"


def test_every_refusal_of_a_message_has_text() -> None:
    assert {reason.value for reason in Refusal if reason not in EXPLAINED} <= set(LOST)
    assert loss_text("camera", "a_new_reason") == "lost, camera: a new reason"
