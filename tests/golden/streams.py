"""The decisions of whole drives, in order: of a pair that is driven without threads, of the rig it belongs to, and of
two LiDARs. No window is solved here: the worker knows the truth, so that a drive takes a second."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calibration.rig.test_inconsistent_edges import EDGE, RIG
from coec.calibration.frames.window import SliceClosed
from coec.calibration.rig.rig_estimator import rig_alarms
from coec.calibration.types import Matrix4
from golden.reference import plain
from service import test_pair_disturbed as pair_drive
from service.engine.test_lidar_pairs import DISPLACED_S, displaced
from support.rigs import POSES, LidarBench, RigDrive, moved_poses
from support.vehicles import BEGIN_S, DRIVE_END_S, OracleWorker, PairBench

LIDARS = ("roof", "bumper")


def _matrix(data: bytes) -> list[float]:
    """(12) the upper rows of a pose."""
    return [float(value) for value in np.frombuffer(data)[:12]]


def entries(bench: PairBench) -> list[dict[str, Any]]:
    """What the history says of states and extrinsics, without the clock on the wall and what hangs on it."""
    changed = {"wall_ns": 0, "previous_sha256": "", "sequence": 0}
    return [entry.model_copy(update=changed).model_dump(mode="json") for entry in bench.entries("state", "extrinsic")]


def evidence(bench: PairBench) -> list[dict[str, Any]]:
    """What the monitor concludes of each check. The state of health beside it may be the clock's on the wall to say."""
    names = (
        "stamp_ns",
        "outcome",
        "evidence",
        "offset",
        "sigma",
        "drift",
        "drift_sigma",
        "flagged",
        "undecided",
        "weak",
    )
    replies = [check.model_dump(mode="json") for check in bench.store.publishable_records().checks]
    return [{"reply": {name: reply[name] for name in names}} for reply in replies]


def _windows(events: list[Any]) -> Iterator[dict[str, Any]]:
    """Every window: stamps of its pairs, pose at its begin, and how it ended."""
    stamps: list[int] = []
    poses: list[list[float]] = []
    for event in events:
        if isinstance(event, SliceClosed):
            yield {"window": plain(event), "stamps_ns": stamps, "poses": poses}
            stamps, poses = [], []
        else:
            _, stamp_ns, pose = event
            stamps.append(stamp_ns)
            if not poses or poses[-1] != _matrix(pose):
                poses.append(_matrix(pose))


def of_pair(watched: pair_drive.Watched) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The whole stream of a pair: states, and everything else."""
    checks = [
        {"check": np.array(pose)[:3].ravel().tolist(), "stamps_ns": [stamp_ns for stamp_ns, _ in pairs]}
        for pose, pairs in watched.checks
    ]
    history = entries(watched.bench)
    states = [{"entry": entry} for entry in history if entry["kind"] == "state"]
    decided: list[dict[str, Any]] = [
        *({"entry": entry} for entry in history if entry["kind"] != "state"),
        *checks,
        *evidence(watched.bench),
        *_windows(watched.windows),
        {"losses": sorted([*reason, count] for reason, count in watched.bench.losses.items())},
        {"states": watched.reported["states"], "unpaired": plain(watched.reported["unpaired"])},
    ]
    return states, decided


def undisturbed(folder: Path) -> pair_drive.Watched:
    """The drive in the order of its stamps, before a worker that answers at once."""
    watched = pair_drive.Watched(folder, OracleWorker)
    frames = [frame for stream in pair_drive.streams().values() for frame in stream]
    for frame in sorted(frames, key=lambda frame: frame.stamp_ns):
        watched.push(frame)
    watched.finish()
    return watched


def driven(folder: Path, apply: str) -> list[dict[str, Any]]:
    """A drive over the step that reads its state again on the way."""
    bench = PairBench(folder, apply=apply)
    checked: list[tuple[int, ...]] = []
    for begin_s, end_s in ((BEGIN_S, BEGIN_S + 70), (BEGIN_S + 70, BEGIN_S + 130), (BEGIN_S + 130, DRIVE_END_S)):
        bench.drive(begin_s, end_s)
        checked += bench.worker.checked
        bench.restart()
    return [
        *({"entry": entry} for entry in entries(bench)),
        *({"stamps_ns": list(stamps)} for stamps in checked),
        *evidence(bench),
        {"pose": bench.pose[:3].ravel().tolist(), "health": bench.health},
    ]


def two_lidars(folder: Path, seed: int | None) -> list[dict[str, Any]]:
    """One of two LiDARs is knocked: what is served of the rig, every five seconds in short and at the end in full."""
    bench = LidarBench(folder, displaced("bumper"), seed=seed, lidars=LIDARS)
    lines: list[dict[str, Any]] = []
    for at_s in range(0, int(DISPLACED_S) + 60, 5):
        bench.drive(float(at_s), at_s + 5.0)
        reply = bench.reply.model_dump(mode="json")
        short = {name: [sensor["state"], sensor["probability"]] for name, sensor in _by_name(reply["sensors"])}
        between = {
            name: [one["state"], one["stamp_ns"], one["looks"], one["sigma"]]
            for name, one in _by_name(reply["lidars"])
        }  # fmt: skip
        lines.append({"at_s": at_s + 5, "sensors": short, "lidars": between})
    observations = sorted([*observation] for observation in bench.worker.stamps)
    return [*lines, {"reply": bench.reply.model_dump(mode="json")}, {"looks": observations}]


def _by_name(parts: list[dict[str, Any]]) -> list[tuple[str, dict[str, Any]]]:
    return [(part["name"], part) for part in parts]


def rig_of_two_lidars(displaced_lidar: str) -> list[dict[str, Any]]:
    """Three cameras and two LiDARs, one of which is knocked, named, and put right in all of its pairs at once."""
    drive = RigDrive(RIG)
    lines: list[dict[str, Any]] = []
    corrections: list[object] = [None]

    def note() -> None:
        state = drive.state
        health = {name: of.value for name, of in sorted(drive.health().items())}
        against = {name: of.value for name, of in sorted(rig_alarms(state).items())}
        lines.append({"at_s": drive.at_s, "health": health, "against": against})
        if state.correction is not corrections[-1]:
            corrections.append(state.correction)
            lines.append({"correction": plain(state.correction)})

    def turn(poses: Mapping[str, Matrix4], rounds: int) -> None:
        for _ in range(rounds):
            drive.add_checks(poses, 1)
            note()
        drive.add_lidar_check(EDGE, poses)
        note()

    turn(POSES, 3)
    turn(POSES, 3)
    poses, displaced_s = moved_poses(displaced_lidar), drive.at_s
    turn(poses, 3)
    turn(poses, 3)
    for edge in RIG.edges:
        if displaced_lidar in (edge.a, edge.b) and edge.name != EDGE:
            drive.add_window(edge.name, poses, displaced_s + 1.0)
            note()
    turn(poses, 3)
    return lines
