"""Three pairs of one LiDAR, without threads: it is knocked, and that is one event with one correction."""

from __future__ import annotations

import random
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from coec.calibration.state_machine import HealthState
from coec.config import Config
from coec.errors import NotFoundError
from coec.io.disk_writer import DiskWriter
from coec.io.system import ServiceThread
from coec.io.zenoh.ros_node import RosTopicList
from coec.schemas.commands import Acknowledgement
from coec.schemas.keys import Keys
from coec.schemas.message import to_json
from coec.schemas.replies import HistoryEntry
from coec.schemas.rig_state import RigReply
from coec.service import camera_lidar_pair as runtime_pair
from coec.service.api.command_execution import RigCommands
from coec.service.api.rig_answers import RigAnswers
from coec.service.camera_lidar_pair import CameraLidarPair
from coec.service.cpu_budget import Budget
from coec.service.engine.rig import RigEstimator
from coec.service.engine.vehicle import Vehicle
from coec.service.recording.recorder import RecordingThread
from coec.service.recording.window_store import WindowStore
from coec.service.records.state_store import StateStore
from coec.service.vehicle_context import VehicleContext
from coec.service.worker.supervisor import Worker
from coec.service.worker.worker_jobs import Checked, WorkerJob
from support.vehicles import (
    AFTER,
    NS_PER_S,
    STEP_S,
    InstantDiskWriter,
    InstantRecorder,
    OracleWorker,
    frame_pair_at,
    pair_configuration,
)

CAMERAS = ("front", "left", "rear")


def rig_configuration(folder: Path, apply: str) -> Config:
    config = pair_configuration(folder, apply)
    (pair,) = config.pairs
    lidar = pair.lidar.model_copy(update={"name": "roof"})
    cameras = [pair.camera.model_copy(update={"name": name, "key": f"in/{name}"}) for name in CAMERAS]
    pairs = [pair.model_copy(update={"name": camera.name, "camera": camera, "lidar": lidar}) for camera in cameras]
    return config.model_copy(update={"pairs": tuple(pairs)})


class DimWorker(OracleWorker):
    """Sees in a window what no check shows it."""

    def _check(self, job: WorkerJob) -> Checked:
        checked = super()._check(job)
        vague = np.full(6, 0.2)
        reported = replace(checked.observation, offset=np.zeros(6), sigma=vague, noise=vague, flagged=False)
        return replace(checked, observation=reported)


class RigBench:
    """All pairs of a vehicle, driven in an order that a seed draws."""

    def __init__(self, folder: Path, seed: int = 0, config: Config | None = None, dim: str | None = None) -> None:
        """`dim` is a pair whose checks tell nothing."""
        folder.mkdir(parents=True)
        config = config or rig_configuration(folder, "within_limits")
        self.rng = random.Random(seed)
        self.keys = Keys("coec", config.vehicle)
        disk_writer: DiskWriter = InstantDiskWriter(folder)
        self.answers = RigAnswers(self.keys, lambda *_: None)
        rig = RigEstimator(folder, (), disk_writer)
        self.vehicle = Vehicle(config.limits, Budget(config.budget, lambda: 0.0), rig, self.answers.on_update)
        windows = WindowStore(folder / "windows", config.state)
        context = VehicleContext(
            self.keys,
            self.vehicle,
            StateStore(folder, config.vehicle),
            disk_writer,
            windows,
            RecordingThread(),
            cast("Worker", None),
            lambda *_: None,
            lambda: (),
            lambda *_: None,
            RosTopicList,
            rig_problems=self.answers.problems,
        )
        self.pairs: dict[str, CameraLidarPair] = {}
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(runtime_pair, "Recorder", InstantRecorder)
            for pair in config.pairs:
                worker = DimWorker() if pair.name == dim else OracleWorker()
                own = replace(context, worker=cast("Worker", worker))
                self.pairs[pair.name] = CameraLidarPair(pair, config, own)
                cast("InstantRecorder", self.pairs[pair.name].recorder).worker = worker
        self.settle()

    def drive(self, begin_s: int, end_s: int) -> None:
        """Pairs of frames, twice a second, of each pair in turn; each is settled some time later."""
        for stamp_ns in range(begin_s * NS_PER_S, end_s * NS_PER_S, NS_PER_S // 2):
            for name in self.rng.sample(CAMERAS, 3):
                self.pairs[name].stream.hold(
                    [frame_pair_at(stamp_ns)], self.vehicle.clock.monotonic_s(), set_clock=True
                )
                if self.rng.random() < 0.7:
                    self.turn()
            if stamp_ns % NS_PER_S == 0:
                self.settle()
        self.settle()

    def turn(self) -> None:
        """What the engine does until there is nothing more that it may do."""
        while self.vehicle.turn(0.0):
            pass

    def settle(self) -> None:
        """The same, and its clocks, which it looks at once a second."""
        self.turn()
        for pair in self.pairs.values():
            pair.stream.renew_report(pair.engine.selector.statistics, self.vehicle.clock.monotonic_s())
            pair._tick()

    def do(self, name: str, **arguments: Any) -> Acknowledgement:
        """A command for the rig."""
        commands = {name: pair.commands for name, pair in self.pairs.items()}
        rig = RigCommands("test", commands, self.answers)
        with ThreadPoolExecutor(1) as other:
            report = other.submit(rig.carry_out, name, arguments, "the test")
            while not report.done():
                self.settle()
        self.settle()
        return report.result()

    @property
    def reply(self) -> RigReply:
        return self.answers.reply

    def entries(self, name: str, *kinds: str) -> list[HistoryEntry]:
        store = self.pairs[name].answers._store
        return [retained.entry for retained in store.history.entries() if retained.entry.kind in kinds]

    def report(self) -> dict[str, bytes]:
        """All that a replay must come to again."""
        extrinsics = {name: to_json(pair.answers.extrinsic_reply) for name, pair in self.pairs.items()}
        return {**extrinsics, "rig": to_json(self.reply)}

    def decisions(self) -> dict[str, list[tuple[str, str, int | None]]]:
        return {
            name: [(entry.kind, entry.code, entry.stamp_ns) for entry in self.entries(name, "extrinsic", "state")]
            for name in CAMERAS
        }


@pytest.mark.fault("a knocked LiDAR, three cameras, policy `within_limits`", "one correction, served by all pairs")
def test_a_displaced_lidar_is_corrected_once_for_all_pairs_and_the_same_in_a_replay(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    bench = RigBench(tmp_path / "one")
    bench.drive(STEP_S - 45, STEP_S + 65)
    reply = bench.reply
    assert reply.losses == {}
    assert reply.correction is not None
    assert reply.correction.sensors == ("roof",)
    assert set(reply.correction.pairs) == set(CAMERAS)
    assert {sensor.state for sensor in reply.sensors} == {"calibrated"}
    assert reply.move is not None
    assert (reply.move.sensors, set(reply.move.by)) == (("roof",), {"roof"})
    assert reply.move.over_ns is not None
    for name in CAMERAS:
        (corrected,) = [entry for entry in bench.entries(name, "command") if entry.code == "corrected"]
        assert "roof" in corrected.text
        state = bench.pairs[name].answers._store.state
        assert state.health is HealthState.HEALTHY
        assert state.T_camera_lidar == pytest.approx(AFTER, abs=2e-3)
        served = [entry for entry in bench.entries(name, "extrinsic") if entry.stamp_ns == reply.correction.stamp_ns]
        assert len(served) == 1
    again = RigBench(tmp_path / "two", seed=1)
    again.drive(STEP_S - 45, STEP_S + 65)
    assert again.report() == bench.report()
    assert again.decisions() == bench.decisions()
    record_property("figure", f"{(reply.correction.stamp_ns / NS_PER_S) - STEP_S:.0f} s after the knock")


SLICE_S = 120.0


@pytest.mark.fault(
    "a knocked LiDAR, and one of its pairs suspects nothing", "its window is hurried, and the correction does not wait"
)
def test_a_pair_that_suspects_nothing_has_its_window_as_soon_as_its_sensor_is_named(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    """Its ordinary slice, which begins again when all pairs serve what they found, would end a minute later."""
    config = rig_configuration(tmp_path / "one", "within_limits")
    window = config.pairs[0].window.model_copy(update={"slice_s": SLICE_S})
    config = config.model_copy(
        update={"pairs": tuple(pair.model_copy(update={"window": window}) for pair in config.pairs)}
    )
    bench = RigBench(tmp_path / "one", config=config, dim="rear")
    bench.drive(STEP_S - 45, STEP_S + 60)
    correction = bench.reply.correction
    assert correction is not None
    assert set(correction.pairs) == set(CAMERAS)
    received_s = correction.stamp_ns / NS_PER_S - STEP_S
    record_property("figure", f"{received_s:.0f} s after the knock")
    assert received_s < 60.0


def test_where_people_decide_the_correction_waits_for_them(tmp_path: Path) -> None:
    bench = RigBench(tmp_path / "state", config=rig_configuration(tmp_path / "state", "never"))
    bench.drive(STEP_S - 45, STEP_S + 50)
    assert bench.reply.correction is None or set(bench.reply.correction.pairs) == set(CAMERAS)
    assert {sensor.name: sensor.state for sensor in bench.reply.sensors}["roof"] == "lidar_moved"
    for name in CAMERAS:
        state = bench.pairs[name].answers._store.state
        assert state.pending is not None
        assert not np.allclose(state.T_camera_lidar, AFTER, atol=1e-3)


@pytest.mark.parametrize("number", [1, 24])
def test_the_number_of_threads_does_not_depend_on_that_of_the_pairs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    threads: list[str] = []
    create = ServiceThread.__init__

    def created(self: ServiceThread, name: str, run: Callable[[ServiceThread], None]) -> None:
        threads.append(name)
        create(self, name, run)

    monkeypatch.setattr(ServiceThread, "__init__", created)
    (pair, *_) = rig_configuration(tmp_path, "never").pairs
    pairs = tuple(pair.model_copy(update={"name": f"pair-{index}"}) for index in range(number))
    RigBench(tmp_path / "state", config=rig_configuration(tmp_path, "never").model_copy(update={"pairs": pairs}))
    assert sorted(threads) == ["disk-writer", "engine", "recorder"], "what the pairs share"


def test_a_command_for_a_sensor_is_one_for_each_of_its_pairs(tmp_path: Path) -> None:
    bench = RigBench(tmp_path / "state")
    bench.drive(STEP_S - 20, STEP_S - 10)
    held = bench.do("hold", sensor="left")
    assert (held.accepted, held.code, held.pair) == (True, "held", "rig")
    assert [bench.pairs[name].answers.extrinsic_reply.held for name in CAMERAS] == [False, True, False]
    assert bench.do("hold", sensor="roof").accepted
    assert all(bench.pairs[name].answers.extrinsic_reply.held for name in CAMERAS)
    refused = bench.do("reset", sensor="roof")
    assert (refused.accepted, refused.code) == (False, "held")
    assert all(f"{name}: " in refused.text for name in CAMERAS)
    assert bench.do("hold", sensor="left", release=True).accepted
    in_part = bench.do("reset")
    assert (in_part.accepted, in_part.code) == (False, "in_part")
    with pytest.raises(NotFoundError, match="the rig has front, left, rear, roof"):
        bench.do("hold", sensor="trunk")
