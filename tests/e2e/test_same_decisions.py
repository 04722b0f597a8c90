"""One drive, three times: live, killed or restarted in the middle, and replayed. The decisions are the same, whatever
the machine does meanwhile."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from coec.calibration.types import Frame
from coec.config import (
    CalibrationConfig,
    DepthConfig,
    ObjectiveConfig,
    SearchConfig,
    WindowConfig,
    load_config,
)
from coec.io.mcap.writer import write_bag
from coec.service.decision_log import Decision, differences, read_log
from coec.service.drive_replay import DriveReplay
from e2e.drives import (
    NS_PER_S,
    SECONDS,
    SHORT,
    SHORT_PAIRS,
    STEPPED,
    Drive,
    rendered,
    stepped_configuration,
    without_depth,
)
from e2e.processes import Router, Service, by_topics, coec, coec_here, service, write_configuration
from support.recordings import MODEL_CARD, first_channel_network
from support.ros import RosSensors

pytest.importorskip("embreex", reason="needs embreex")

SLICES = 2
"""Windows; then a third begins. The kill comes in the last solve: what is solved after a start is served at once, in a
stream only when its time has come, so that a later window would start from another pose."""

OVER_S = 3.0
"""Into the next slice: its first pair is then certain, and the slice before has ended."""

WORKSHOP = np.array([*np.radians([0.3, -0.2, 0.2]), 0.0, 0.0, 0.0])
"""By how much nominal is off, so that every window moves what is served."""

RESTART_S = 52
"""Of the long form: after the step, before it is certain."""

REPLAY_SPEED = 12.0
"""Seconds of driving per second, of the recording that is played."""

HALF_PAIR_S = 1.0
"""Half of what is between two pictures of the small drive: no pair is torn."""

MAX_ERROR_DEG = 0.35

SHORT_SLICE_S = 12
SMALL = SHORT.replace("seconds=12", "seconds=28")
BY_DEPTH = CalibrationConfig(depth=DepthConfig(model="stereo"), objective=ObjectiveConfig(kind="mi"))
"""Six small pictures have too few edges for `fused`."""


@pytest.fixture(scope="module")
def drive() -> Drive:
    return rendered(STEPPED)


def reported_of(running: Service, *kinds: str) -> dict[str, Any]:
    """What was decided and is served, and the entries of these kinds, without the wall clock and what hangs on it."""
    entries = [{**entry, "wall_ns": 0, "previous_sha256": "", "sequence": 0} for entry in running.entries(*kinds)]
    return {
        "entries": entries,
        "results": running.history()["results"],
        "windows": [(window["window_id"], window["pairs"], window["decision"]) for window in running.windows()],
        "extrinsic": running.extrinsic()["camera_from_lidar"],
    }


def between(drive: Drive, begin_s: float, end_s: float) -> list[Frame]:
    """The frames between two moments of the small drive."""
    moments = ((frame, (frame.stamp_ns - drive.start_ns) / NS_PER_S + HALF_PAIR_S) for frame in drive.frames)
    return [frame for frame, moment_s in moments if begin_s <= moment_s < end_s]


@pytest.mark.fault("killed in the middle of a solve", "the decisions are those of an undisturbed replay")
def test_killed_in_a_solve_and_replayed_the_decisions_are_the_same(tmp_path: Path, router: Router) -> None:
    small = rendered(SMALL)
    finished_s = SLICES * SHORT_SLICE_S

    window = WindowConfig(pairs=SHORT_PAIRS, min_pairs=4, slice_s=SHORT_SLICE_S)
    config = write_configuration(
        tmp_path / "killed", small.recording, router.endpoint, WORKSHOP, window=window, calibration=BY_DEPTH
    )
    with service(config, router) as running:
        running.send(between(small, 0, finished_s))
        running.rest()
        psutil.Process(running.worker()["pid"]).suspend()
        running.send(between(small, finished_s, finished_s + OVER_S))
        running.until(running.counters, lambda pair: pair["windows"] == SLICES, "the last window is recorded")
        running.kill()
    with service(config, router, warm=False) as running:
        running.until(running.history, lambda reported: reported["total"] == SLICES, "the window that was being solved")
        running.rest()
        killed = reported_of(running, "estimate", "extrinsic")
        assert running.terminate() == 0
    assert [decision for *_, decision in killed["windows"]] == ["accepted"] * SLICES
    assert len({str(entry["camera_from_lidar"]) for entry in killed["entries"] if entry["kind"] == "extrinsic"}) > 1

    folder = tmp_path / "killed" / "state" / "windows"
    replayed = [coec_here("replay", folder / f"{name}.mcap") for name, *_ in killed["windows"]]
    assert [done.returncode for done in replayed] == [0] * SLICES, [done.stdout + done.stderr for done in replayed]
    assert all("identical" in done.stdout for done in replayed)

    pair = load_config(config).pairs[0].name
    vehicle = of_windows(read_log(tmp_path / "killed" / "state", pair))
    frames = between(small, 0, finished_s + OVER_S)
    drive = DriveReplay(load_config(config), tmp_path / "replayed", frames[0].stamp_ns, 1)
    whole = drive.run({pair: iter(frames)}, lambda _: None)[pair]
    assert {one.kind for one in vehicle} == {"estimate", "extrinsic"}
    assert differences(vehicle, of_windows(whole.decisions)) == ()


def of_windows(log: Sequence[Decision]) -> list[Decision]:
    """What windows decided: after a start nothing has been checked, so that the state is another."""
    return [one for one in log if one.kind in ("estimate", "extrinsic")]


def decisions(running: Service) -> dict[str, Any]:
    """All of it, of a run that was not interrupted."""
    return {
        **reported_of(running, "estimate", "extrinsic", "state"),
        "checks": running.history()["checks"],
        "losses": running.counters()["losses"],
    }


def states(decided: dict[str, Any]) -> list[tuple[str, str]]:
    return [(entry["code"], entry["text"]) for entry in decided["entries"] if entry["kind"] == "state"]


def seen_states(decided: dict[str, Any]) -> list[str]:
    """States that data have caused: after a start nothing has been checked, and a last window may come too late."""
    entries = [entry for entry in decided["entries"] if entry["kind"] == "state" and entry["stamp_ns"] is not None]
    return [entry["code"] for entry in entries if entry["code"] != "unknown"]


@pytest.mark.slow
def test_live_restarted_and_replayed_the_decisions_are_the_same(
    tmp_path: Path, drive: Drive, router: Router, sample_data: Path
) -> None:
    # A bag of sensors holds no depth maps.
    network = DepthConfig(model=str(sample_data / "depth" / "tcsmallnet_dyn.onnx"))
    with service(stepped_configuration(tmp_path / "live", router, network), router) as running:
        running.send(without_depth(drive.between(0, SECONDS + 1)))
        running.rest()
        running.end()
        live = decisions(running)
        assert running.terminate() == 0
    assert {code for code, _ in states(live)} >= {"healthy", "suspect", "miscalibrated"}
    # The silence after the drive ends the open window, whose last pairs are then too old to acquit what it changes.
    assert states(live)[-1][0] in ("healthy", "unknown")

    bag = tmp_path / "drive.mcap"
    recording = drive.recording
    whole = without_depth(drive.between(0, SECONDS + 1))
    write_bag(bag, recording.rig, recording.T_camera_lidar_start, whole, lambda _: None)
    config = stepped_configuration(tmp_path / "replayed", router, network)
    with service(config, router) as running:
        reported = ("--config", config, "--rate", REPLAY_SPEED, "--connect", router.endpoint)
        played = coec("play", bag, *reported, "--json")
        assert played.returncode == 0, played.stderr
        running.rest()
        running.end()
        replayed = decisions(running)
        assert running.terminate() == 0
    assert replayed == live

    log = tmp_path / "decisions.jsonl"
    compared = coec("replay", bag, "--config", config, "--against", tmp_path / "live" / "state", "--log", log, "--json")
    assert compared.returncode == 0, (compared.stdout, compared.stderr)
    document = json.loads(compared.stdout)
    assert document["differences"] == []
    assert document["elapsed_s"] < document["driven_s"]

    config = stepped_configuration(tmp_path / "restarted", router, network)
    with service(config, router) as running:
        running.send(without_depth(drive.between(0, RESTART_S)))
        running.rest()
        assert running.terminate() == 0
    with service(config, router) as running:
        running.send(without_depth(drive.between(RESTART_S, SECONDS + 1)))
        running.rest()
        running.end()
        restarted = decisions(running)
        assert drive.error_deg(running.extrinsic(), SECONDS) < MAX_ERROR_DEG
        assert running.terminate() == 0
    assert seen_states(restarted) == seen_states(live)


# --- the way in ---------------------------------------------------------------------------------------------------

TOPICS = {"camera": "/front/image_raw/compressed", "lidar": "/top/points", "ego": "/odometry"}


def decided_by(
    path: Path, router: Router, frames: list[Frame], middleware: str, *, until_silence: bool
) -> dict[str, Any]:
    """What the service decides of frames that come this way, and the digests of the windows that it cuts; with those of
    the slice that is open at the end, if it is to be waited for `until_silence` has ended it."""
    if middleware != "native":
        by_topics(path, middleware, TOPICS)
    with service(path, router) as running:
        if middleware == "native":
            running.send(frames)
        else:
            sensors = RosSensors(router.session, TOPICS, middleware)
            running.send_by(sensors.send, frames)
            sensors.close()
        running.rest()
        if until_silence:
            running.end()
        counters, decided = running.counters(), decisions(running)
        reported = {
            **decided,
            "entries": [entry for entry in decided["entries"] if entry["kind"] != "state"],
            # Whether an answer is overdue is the clock's on the wall to say: a busy machine has more of these.
            "states": [code for code, _ in groupby(code for code, _ in states(decided) if code != "degraded")],
            "files": [window["sha256"] for window in running.windows()],
            "accepted": {name: counters[name]["accepted"] for name in TOPICS},
            "lost": {name: counters[name]["losses"] for name in TOPICS},
        }
        assert running.terminate() == 0
    return reported


@pytest.mark.slow
def test_native_frames_and_topics_of_rmw_zenoh_come_to_the_same(tmp_path: Path, router: Router) -> None:
    small = rendered(SMALL)
    # The first pair of the next slice ends the window, and is none itself.
    frames = without_depth(between(small, 0, SHORT_SLICE_S + OVER_S))
    network = tmp_path / "tiny.onnx"
    network.write_bytes(first_channel_network())
    network.with_suffix(".yaml").write_text(MODEL_CARD)

    def configured(name: str) -> Path:
        window = WindowConfig(pairs=SHORT_PAIRS, min_pairs=4, slice_s=SHORT_SLICE_S, min_points_in_view=100)
        calibration = CalibrationConfig(
            depth=DepthConfig(model=str(network)),
            objective=ObjectiveConfig(kind="mi"),
            search=SearchConfig(max_evaluations=60),
        )
        return write_configuration(
            tmp_path / name, small.recording, router.endpoint, window=window, calibration=calibration
        )

    native, topics = (
        decided_by(configured(way), router, frames, way, until_silence=False) for way in ("native", "rmw_zenoh")
    )
    for reported in (native, topics):
        # The one pair of the next slice, whose end in silence is not waited for.
        reported["losses"].pop("too_few_pairs", None)
    assert len(native["files"]) == len(native["results"]) == 1
    assert topics == native


@pytest.mark.slow
def test_native_frames_rmw_zenoh_and_a_bridge_come_to_the_same(
    tmp_path: Path, drive: Drive, router: Router, sample_data: Path
) -> None:
    network = DepthConfig(model=str(sample_data / "depth" / "tcsmallnet_dyn.onnx"))
    frames = without_depth(drive.between(0, SECONDS + 1))
    # The last slice has pairs enough for a window: unless its end is waited for, whether it has ended when the question
    # comes is a matter of the clock on the wall.
    directions = {
        way: decided_by(stepped_configuration(tmp_path / way, router, network), router, frames, way, until_silence=True)
        for way in ("native", "rmw_zenoh", "ros2dds")
    }
    assert set(directions["native"]["states"]) >= {"healthy", "suspect", "miscalibrated"}
    assert len(directions["native"]["files"]) > 2
    assert directions["rmw_zenoh"] == directions["native"]
    assert directions["ros2dds"] == directions["native"]
