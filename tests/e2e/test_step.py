"""A mount that moves by one degree while the service runs: noticed, told, corrected, remembered; with `apply: never`
told, and left to people. Sensor time is compressed."""

from __future__ import annotations

from pathlib import Path

import pytest
from e2e.rides import SECONDS, STEP_S, between, configured, drive, error_deg, riding

from coec.adapters.zenoh.client import ask_one
from coec.config import CalibrationConfig, DepthConfig, PolicyConfig
from fakes import wait_until

pytest.importorskip("embreex", reason="needs the optional extra `sim`")

NOTICED_S = 60.0
"""Of driving."""

MAX_ERROR_DEG = 0.35

STEREO = CalibrationConfig(depth=DepthConfig(model="stereo"))


def test_a_step_is_noticed_corrected_and_remembered(tmp_path: Path) -> None:
    config = configured(tmp_path, STEREO)
    with riding(config) as ride:
        ride.send(between(0, STEP_S))
        ride.rest()
        before = ride.extrinsic()
        assert ride.health()["state"] == "healthy"
        assert error_deg(before, 0) < MAX_ERROR_DEG
        ride.send(between(STEP_S, SECONDS + 1))
        ride.rest()
        step_ns = drive()[0].camera_stamps_ns[0] + STEP_S * 1_000_000_000
        states = {entry["code"]: (entry["stamp_ns"] - step_ns) / 1e9 for entry in ride.entries("state")}
        assert [entry["code"] for entry in ride.entries("state")][:1] == ["healthy"], "no false alarm"
        assert 0 < states["suspect"] <= states["miscalibrated"] < NOTICED_S
        assert states["miscalibrated"] < states["healthy"]
        assert ride.health()["state"] == "healthy"
        after = ride.extrinsic()
        assert error_deg(after, SECONDS) < MAX_ERROR_DEG

        (event,) = ride.ask(ride.keys.evidence(ride.pair))["events"]
        assert event["resolution"].startswith("healthy")
        assert {event["window_before"], event["window_after"]} <= {
            item["window_id"] for item in ride.ask(ride.keys.windows(ride.pair))["windows"]
        }
        assert event["overlays"] == ["before", "after"]
        whole = ride.ask(ride.keys.evidence_of(ride.pair, event["event_id"]))
        assert len(whole["metrics"]) > 5
        picture = ask_one(
            ride.session, f"{ride.keys.evidence_of(ride.pair, event['event_id'])}?overlay=after", 10.0
        ).payload
        assert picture[:3] == b"\xff\xd8\xff"
        for parameters in ("", "?at=nominal", f"?window={event['window_before']}"):
            drawn = ask_one(ride.session, f"{ride.keys.overlay(ride.pair)}{parameters}", 20.0)
            assert drawn.encoding == "image/jpeg"
            assert drawn.payload[:3] == b"\xff\xd8\xff"

        back = ride.command("rollback")
        assert back["code"] == "rolled_back"
        assert ride.extrinsic()["camera_from_lidar"] == before["camera_from_lidar"]
        assert ride.health()["state"] == "unknown"
        assert ride.command("hold")["code"] == "held"
        assert ride.command("reset")["code"] == "held"
        entries = ride.ask(ride.keys.history(ride.pair))["entries"]

    with riding(config) as ride:
        again = ride.extrinsic()
        assert again["camera_from_lidar"] == before["camera_from_lidar"]
        assert (again["provenance"], again["held"]) == ("restored", True)
        # What was open when the service stopped is solved now, and moves nothing.
        assert ride.ask(ride.keys.history(ride.pair))["entries"][: len(entries)] == entries
        assert ride.command("hold", b'{"release":true}')["code"] == "released"
        assert ride.command("reset")["code"] == "reset"
        assert ride.extrinsic()["provenance"] == "nominal"


def test_with_never_the_candidate_waits_and_nothing_else_changes(tmp_path: Path) -> None:
    with riding(configured(tmp_path, STEREO, PolicyConfig(apply="never"))) as ride:
        ride.send(between(0, STEP_S))
        ride.rest()
        before = ride.extrinsic()
        assert before["provenance"] == "nominal"
        assert ride.health()["state"] == "healthy", "a window agrees with nominal"
        ride.send(between(STEP_S, SECONDS + 1))
        ride.rest()
        after = ride.extrinsic()
        assert after["camera_from_lidar"] == before["camera_from_lidar"]
        assert after["provenance"] == "nominal"
        assert ride.health()["state"] == "miscalibrated"
        assert after["pending"] is not None
        assert error_deg(after["pending"], SECONDS) < MAX_ERROR_DEG
        assert ride.command("apply")["code"] == "applied"
        applied = ride.extrinsic()
        assert applied["camera_from_lidar"] == after["pending"]["camera_from_lidar"]
        assert (applied["provenance"], applied["pending"]) == ("estimated", None)
        wait_until(lambda: ride.health()["state"] == "healthy", "health after the command")
