"""A drive is replayed through the engine: the same decisions however its workers dawdle, and a log that says them."""

from __future__ import annotations

import gc
import json
import random
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from coec.calibration.types import CameraFrame, EgoMotion, FramePair, LidarFrame
from coec.config import Config
from coec.errors import SourceError
from coec.service import camera_lidar_pair as runtime_pair
from coec.service import drive_replay
from coec.service.api.rig_answers import reply_of
from coec.service.decision_log import (
    Decision,
    ReplayedDrive,
    differences,
    outline,
    read_log,
    write_log,
    write_replay_page,
)
from coec.service.drive_replay import DriveReplay, read_ahead
from coec.service.worker.worker_jobs import WorkerJob
from service.test_pair_disturbed import streams
from service.test_pair_rig import CAMERAS, RigBench, rig_configuration
from support.vehicles import (
    BEGIN_S,
    NS_PER_S,
    STEP_S,
    InstantRecorder,
    OracleWorker,
    PairBench,
    frame_pair_at,
    pair_configuration,
)

PAIR = "front"


class Dawdling:
    """Worker processes that know the truth, and answer out of order on threads of their own."""

    warms_up = False
    compiled_s = 0.0
    seed = 0

    def __init__(self, config: Config, number: int) -> None:
        del config, number
        self.oracle = OracleWorker()
        self.rng = random.Random(self.seed)
        self.threads: list[threading.Thread] = []

    @contextmanager
    def running(self) -> Iterator[None]:
        yield
        for thread in self.threads:
            thread.join()

    def submit(self, job: WorkerJob) -> None:
        thread = threading.Timer(0.002 * self.rng.random(), self.oracle.submit, (job,))
        self.threads = [*(one for one in self.threads if one.is_alive()), thread]
        thread.start()

    def prefetch(self, pair: str, frame: bytes) -> None:
        """Nothing is inferred."""

    def commissioning(self, pair: str) -> str | None:
        del pair
        return None


def replayed(folder: Path, monkeypatch: pytest.MonkeyPatch, seed: int = 0) -> ReplayedDrive:
    frames: list[CameraFrame | LidarFrame | EgoMotion] = sorted(
        (frame for stream in streams().values() for frame in stream), key=lambda frame: frame.stamp_ns
    )
    folder.mkdir()
    monkeypatch.setattr(Dawdling, "seed", seed)
    monkeypatch.setattr(drive_replay, "_ReplayWorkers", Dawdling)
    monkeypatch.setattr(runtime_pair, "Recorder", InstantRecorder)
    drive = DriveReplay(pair_configuration(folder), folder, frames[0].stamp_ns, 1)
    cast("InstantRecorder", drive._pairs[0].recorder).worker = cast("Dawdling", drive._workers).oracle
    return drive.run({PAIR: iter(frames)}, lambda _: None)[PAIR]


@pytest.mark.fault("a replay whose workers answer late and out of order", "the same decisions, to the byte")
def test_the_decisions_of_a_drive_do_not_depend_on_the_workers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record_property: Callable[[str, object], None]
) -> None:
    drives = [replayed(tmp_path / str(seed), monkeypatch, seed) for seed in range(2)]
    logs = [[decision.line(PAIR) for decision in drive.decisions] for drive in drives]
    assert logs[0] == logs[1]
    record_property("figure", f"{len(logs[0])} decisions, all equal")
    kinds = {decision.kind for decision in drives[0].decisions}
    assert kinds == {"check", "estimate", "extrinsic", "state"}
    states = [decision.name for decision in drives[0].decisions if decision.kind == "state"]
    assert [name for name in states if name != "unknown"] == ["healthy", "suspect", "miscalibrated", "healthy"]
    assert drives[0].health == "healthy"
    assert drives[0].driven_s == pytest.approx(200.0, abs=1.0)


@pytest.mark.fault("a replayed rig whose LiDAR is knocked, workers that dawdle", "one correction, the same to the byte")
@pytest.mark.parametrize("seeds", [(1,), pytest.param((0, 1), marks=pytest.mark.slow)])
def test_a_rig_is_replayed_as_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seeds: tuple[int, ...]) -> None:
    monkeypatch.setattr(drive_replay, "_ReplayWorkers", Dawdling)
    monkeypatch.setattr(runtime_pair, "Recorder", InstantRecorder)
    stamps_ns = range((STEP_S - 45) * NS_PER_S, (STEP_S + 45) * NS_PER_S, NS_PER_S // 2)
    logs, rigs = [], []
    for seed in seeds:
        monkeypatch.setattr(Dawdling, "seed", seed)
        folder = tmp_path / str(seed)
        folder.mkdir()
        drive = DriveReplay(rig_configuration(folder, "within_limits"), folder, stamps_ns[0], 1)
        for pair in drive._pairs:
            cast("InstantRecorder", pair.recorder).worker = cast("Dawdling", drive._workers).oracle
        drives = drive.run({name: frames_at(stamps_ns) for name in CAMERAS}, lambda _: None)
        logs.append({name: [one.line(name) for one in of_pair.decisions] for name, of_pair in drives.items()})
        rigs.append(reply_of("test", drive.rig))
        assert {name: of_pair.losses for name, of_pair in drives.items()} == {name: {} for name in CAMERAS}
        assert {of_pair.health for of_pair in drives.values()} == {"healthy"}
    assert logs == [logs[0]] * len(seeds)
    assert rigs == [rigs[0]] * len(seeds)
    assert rigs[0].correction is not None
    assert (rigs[0].correction.sensors, set(rigs[0].correction.pairs)) == (("roof",), set(CAMERAS))
    bench = RigBench(tmp_path / "live")
    bench.drive(STEP_S - 45, STEP_S + 45)
    assert bench.reply.correction == rigs[0].correction


def frames_at(stamps_ns: Iterable[int]) -> Iterator[CameraFrame | LidarFrame | EgoMotion]:
    for stamp_ns in stamps_ns:
        pair = frame_pair_at(stamp_ns)
        assert pair.motion is not None
        yield from (pair.motion, pair.lidar, pair.camera)


def frames_of(sizes: Sequence[int], read: list[int]) -> Iterator[tuple[str, LidarFrame]]:
    for stamp_ns, size in enumerate(sizes):
        read.append(stamp_ns)
        yield "0", LidarFrame(stamp_ns, "lidar", np.zeros((size, 3), np.float32))


def test_frames_are_read_ahead_in_their_order_and_within_the_bytes() -> None:
    read: list[int] = []
    most = 12 * 100
    for number, (_, frame) in enumerate(read_ahead(frames_of([40, 70, 300, 1, 1, 90, 20] * 9, read), most)):
        assert frame.stamp_ns == number
        assert len(read) <= number + 1 + 1 + 5, "those that wait, and one that has no room"
    assert read == list(range(63))


def test_an_error_of_the_reader_comes_after_the_frames_before_it() -> None:
    def broken() -> Iterator[tuple[str, LidarFrame]]:
        yield from frames_of([1, 1], [])
        raise SourceError("cut off")

    frames = read_ahead(broken(), 10)
    assert [next(frames)[1].stamp_ns for _ in range(2)] == [0, 1]
    with pytest.raises(SourceError, match="cut off"):
        next(frames)


def test_a_reader_ends_with_those_who_use_its_frames() -> None:
    read: list[int] = []
    frames = read_ahead(frames_of([100] * 50, read), 12 * 100)
    assert next(frames)[1].stamp_ns == 0
    frames.close()  # type: ignore[attr-defined]  # a generator
    assert len(read) < 10
    assert "reader" not in [thread.name for thread in threading.enumerate()]


@pytest.mark.fault("a drive that is longer than the memory", "no frame that was evaluated stays in memory")
def test_a_replay_keeps_no_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = replayed(tmp_path / "replay", monkeypatch)
    gc.collect()
    frames = [one for one in gc.get_objects() if isinstance(one, FramePair)]
    assert len(drive.transitions) > 100
    assert len(frames) < 40, "those that wait for the next check or partner"


def test_a_log_is_read_as_it_was_written_and_that_of_a_vehicle_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drive = replayed(tmp_path / "replay", monkeypatch)
    write_log(tmp_path / "log.jsonl", {PAIR: drive.decisions, "rear": drive.decisions[:3]})
    assert differences(read_log(tmp_path / "log.jsonl", PAIR), drive.decisions) == ()
    assert differences(read_log(tmp_path / "log.jsonl", "rear"), drive.decisions[:3]) == ()
    bench = PairBench(tmp_path / "live")
    bench.drive(BEGIN_S, BEGIN_S + 60)
    vehicle = read_log(tmp_path / "live", PAIR)
    assert {decision.kind for decision in vehicle} == {"check", "estimate", "extrinsic", "state"}
    files = sorted(path.name for path in (tmp_path / "live").iterdir())
    with pytest.raises(
        SourceError, match="no records of a pair rear; it has those of front: give the service's --config"
    ):
        read_log(tmp_path / "live", "rear")
    assert files == sorted(path.name for path in (tmp_path / "live").iterdir()), "it is only read"


@pytest.mark.parametrize(
    "text", ["", "{}\n", "[1]\n", '{"kind": "check"}\n', "\x00\xff", '{"kind":1,"stamp_ns":"x"}\n']
)
def test_what_is_no_log_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "log.jsonl"
    path.write_text(text, encoding="latin-1")
    if not text:
        assert read_log(path, PAIR) == ()
        return
    with pytest.raises(SourceError, match="is no log of decisions"):
        read_log(path, PAIR)
    with pytest.raises(SourceError, match="cannot be read"):
        read_log(tmp_path / "none", PAIR)


def test_differences_name_what_differs_where() -> None:
    def check(stamp_ns: int, evidence: float) -> Decision:
        return Decision("check", stamp_ns, "clear", {"evidence": evidence, "metrics": {"mi": 1.0}})

    before = (check(1, 0.0), check(2, 0.0), Decision("state", 2, "healthy", {"code": "healthy"}))
    after = (check(1, 0.0), check(2, 0.5), check(3, 0.0))
    differing = differences(before, after)
    assert [(one.either.kind, one.either.stamp_ns, one.fields) for one in differing] == [
        ("check", 2, ("evidence",)),
        ("state", 2, ()),
        ("check", 3, ()),
    ]
    assert [one.before is None for one in differing] == [False, False, True]
    assert [one.after is None for one in differing] == [False, True, False]


def test_people_read_the_outline_the_steps_and_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = replayed(tmp_path / "replay", monkeypatch)
    lines = list(outline(drive.decisions, drive.begin_ns))
    assert len(lines) < len(drive.decisions), "checks that say the same are counted"
    assert any("more check" in line.text for line in lines)
    moved_s = STEP_S - BEGIN_S
    around = [one for one in drive.transitions if abs((one.stamp_ns - drive.begin_ns) / NS_PER_S - moved_s) < 20.0]
    assert {"frame pair", "job ended: result"} <= {one.event for one in around}
    assert any("check of 5 pairs, counts from" in action for one in around for action in one.actions)
    write_replay_page(tmp_path / "page.html", "drive", {PAIR: drive}, drive.begin_ns, {PAIR: ()})
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "The decisions are equal." in page
    assert "miscalibrated" in page
    assert json.loads(drive.decisions[0].line(PAIR))["kind"] in ("check", "state")
    assert np.isfinite(drive.elapsed_s)
