"""One drive, three times: live, restarted in the middle, and replayed from MCAP at another speed. The decisions are the
same, whatever the machine does meanwhile; replayed, they are so to the last digit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from e2e.rides import SECONDS, Ride, between, configured, drive, error_deg, riding, without_depth

from coec.adapters.mcap.bag_writer import write_bag
from coec.config import CalibrationConfig, DepthConfig
from e2e.processes import coec

pytest.importorskip("embreex", reason="needs the optional extra `sim`")

RESTART_S = 52
"""After the step, before it is certain."""

REPLAY_SPEED = 12.0
PLAYED_S = 180.0
MAX_ERROR_DEG = 0.35

DECISIONS = ("estimate", "extrinsic", "state")


@pytest.fixture
def calibration(sample_data: Path) -> CalibrationConfig:
    """With a network: a bag of sensors holds no depth maps."""
    return CalibrationConfig(depth=DepthConfig(model=str(sample_data / "depth" / "tcsmallnet_dyn.onnx")))


def decisions(ride: Ride) -> dict[str, Any]:
    """Everything that was decided, without the wall clock and what hangs on it."""
    entries = [{**entry, "wall_ns": 0, "previous_sha256": ""} for entry in ride.entries(*DECISIONS)]
    windows = ride.ask(ride.keys.windows(ride.pair))["windows"]
    return {
        "entries": entries,
        "results": ride.ask(ride.keys.history(ride.pair))["results"],
        "windows": [(window["window_id"], window["pairs"], window["decision"]) for window in windows],
        "extrinsic": ride.extrinsic()["camera_from_lidar"],
        "checks": ride.ask(ride.keys.history(ride.pair))["checks"],
        "losses": ride.status()["losses"],
    }


def states(decided: dict[str, Any]) -> list[tuple[str, str]]:
    return [(entry["code"], entry["text"]) for entry in decided["entries"] if entry["kind"] == "state"]


@pytest.mark.slow
def test_live_restarted_and_replayed_the_decisions_are_the_same(tmp_path: Path, calibration: CalibrationConfig) -> None:
    whole = [without_depth(frame) for frame in between(0, SECONDS + 1)]
    with riding(configured(tmp_path / "live", calibration)) as ride:
        ride.send(whole)
        ride.rest()
        ride.end()
        live = decisions(ride)
    assert {code for code, _ in states(live)} >= {"healthy", "suspect", "miscalibrated"}
    assert states(live)[-1][0] == "healthy"

    bag = tmp_path / "drive.mcap"
    recording = drive()[0]
    write_bag(bag, recording.rig, recording.T_camera_lidar_start, whole, lambda _: None)
    config = configured(tmp_path / "replayed", calibration)
    with riding(config) as ride:
        told = ("--config", config, "--rate", REPLAY_SPEED, "--connect", ride.running.endpoint)
        played = coec("play", bag, *told, "--json", timeout_s=PLAYED_S)
        assert played.returncode == 0, played.stderr
        ride.rest()
        ride.end()
        replayed = decisions(ride)
    assert replayed == live

    config = configured(tmp_path / "restarted", calibration)
    with riding(config) as ride:
        ride.send([without_depth(frame) for frame in between(0, RESTART_S)])
        ride.rest()
    with riding(config) as ride:
        ride.send([without_depth(frame) for frame in between(RESTART_S, SECONDS + 1)])
        ride.rest()
        ride.end()
        restarted = decisions(ride)
        assert error_deg(ride.extrinsic(), SECONDS) < MAX_ERROR_DEG
    assert [code for code, _ in states(restarted)] == [code for code, _ in states(live)]
