"""One drive as native frames, as CDR on a pair's keys, on topics of rmw_zenoh, on the keys of a bridge, out of an MCAP
bag and out of an SQLite one: the same windows, and the same decisions to the byte."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag2 import StoragePlugin
from ruamel.yaml import YAML

from coec.config import CalibrationConfig, DepthConfig, WindowConfig
from coec.io.mcap.writer import write_bag
from coec.io.ros.topics import PairTopics
from e2e.drives import STEPPED, Drive, rendered, without_depth
from e2e.processes import Router, coec, service, write_configuration
from e2e.test_same_decisions import WORKSHOP, decisions
from support.recordings import converted

pytest.importorskip("embreex", reason="needs embreex")

SLICE_S, SLICES = 12, 2
FINISHED_S = SLICES * SLICE_S
CERTAIN_S = 2
"""Of driving, until the pair that ends a window is certain."""

SPEED = 4.0
"""Seconds of driving per second of play."""


def configured(folder: Path, drive: Drive, router: Router, middleware: str) -> Path:
    """A pair on keys of its own, or on the topics under which a recording is played."""
    path = write_configuration(
        folder,
        drive.recording,
        router.endpoint,
        WORKSHOP,
        window=WindowConfig(pairs=SLICE_S, min_pairs=8, slice_s=SLICE_S),
        calibration=CalibrationConfig(depth=DepthConfig()),
    )
    if middleware != "native":
        document = YAML().load(path.read_text())
        (pair,) = document["pairs"]
        topics = PairTopics.default(pair["name"])
        for stream, topic in (("camera", topics.image), ("lidar", topics.points), ("ego", topics.motion)):
            for name in ("key", "encoding"):
                pair[stream].pop(name, None)
            pair[stream]["topic"] = topic
        document["middleware"] = middleware
        with path.open("w") as stream_out:
            YAML().dump(document, stream_out)
    return path


@pytest.mark.slow
@pytest.mark.fault(
    "the same drive over another middleware, or out of another file", "the same windows and decisions, to the byte"
)
def test_the_same_drive_is_decided_alike_however_it_comes(tmp_path: Path, router: Router) -> None:
    drive = rendered(STEPPED)
    frames = without_depth(drive.between(0, FINISHED_S + CERTAIN_S))
    with service(configured(tmp_path / "live", drive, router, "native"), router) as running:
        running.send(frames)
        running.rest()
        running.end()
        live = decisions(running)
        assert running.terminate() == 0
    assert len(live["windows"]) == FINISHED_S // SLICE_S

    bag = tmp_path / "drive.mcap"
    write_bag(bag, drive.recording.rig, drive.recording.T_camera_lidar_start, frames, lambda _: None)
    database = converted(bag, tmp_path / "folder", StoragePlugin.SQLITE3)
    directions: list[tuple[str, Path, tuple[Any, ...]]] = [
        ("native", bag, ()),
        ("native", database, ("--encoding", "cdr")),
        ("rmw_zenoh", bag, ()),
        ("rmw_zenoh", database, ()),
        ("ros2dds", bag, ()),
    ]
    for number, (middleware, source, options) in enumerate(directions):
        config = configured(tmp_path / str(number), drive, router, middleware)
        with service(config, router) as running:
            reported = ("--config", config, "--rate", SPEED, "--connect", router.endpoint, "--json")
            played = coec("play", source, *reported, *options)
            assert played.returncode == 0, played.stderr
            running.sent = Counter(camera=len([f for f in frames if type(f).__name__ == "CameraFrame"]))
            running.rest()
            running.end()
            assert decisions(running) == live, f"{middleware} {source.name}"
            assert running.terminate() == 0
