"""What pairs of a vehicle share: each stream is taken, decoded and counted once, and its frames go to all of them."""

from __future__ import annotations

import gc
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, FramePair, ImageFormat, LidarFrame
from coec.config import Config, PairConfig
from coec.io.disk_writer import DiskWriter
from coec.io.logs import LossCounter
from coec.io.msgpack_frames import encode_camera, encode_ego, encode_lidar
from coec.io.zenoh.bus import InputSample
from coec.service.camera_lidar_pair import CameraLidarPair
from coec.service.cpu_budget import Budget
from coec.service.engine.messages import Action, Evaluate, Event, SensorTime
from coec.service.engine.pair import Pair
from coec.service.engine.rig import RigEstimator
from coec.service.engine.vehicle import Vehicle
from coec.service.ingest.decoder import CAMERA, EGO, FRAMES_WAITING, LIDAR, read_alike
from coec.service.ingest.pair_stream import PairBuffer, PairStream, SelectionStatistics
from coec.service.recording.recorder import Recorder
from coec.service.vehicle_context import VehicleContext
from support.vehicles import HEIGHT, WIDTH, pair_configuration

HZ10_NS = 100_000_000
BEGIN_NS = 10**18
ENCODING = "application/msgpack"
MB = 2**20


def rig_of(cameras: int, lidars: int, **limits: int) -> Config:
    """Every camera with every LiDAR, and one ego-motion for all; nobody waits for it."""
    document = pair_configuration(Path("state")).pairs[0].model_dump(exclude={"ego"}, exclude_none=True)
    pairs = [
        {
            **document,
            "name": f"{camera}-{lidar}",
            "camera": {**document["camera"], "key": f"camera/{camera}"},
            "lidar": {**document["lidar"], "key": f"lidar/{lidar}"},
        }
        for camera in range(cameras)
        for lidar in range(lidars)
    ]
    return Config.model_validate({"limits": limits, "pairs": pairs})


@dataclass
class Observations:
    """In place of the state machine of a pair: the frame pairs that it was given, and when its slice was ended."""

    statistics: SelectionStatistics = field(default_factory=SelectionStatistics)
    slice_end_ns: int | None = None
    pairs: list[FramePair] = field(default_factory=list)
    finished: list[int] = field(default_factory=list)
    is_waiting: bool = False
    keeps: bool = True
    unanswered: int = 0
    warms_up: bool = False
    is_unpublished: bool = False
    ticked_s: float = inf

    @property
    def selector(self) -> Observations:
        return self

    def step(self, event: Event) -> list[Action]:
        if isinstance(event, Evaluate):
            self.statistics = replace(self.statistics, last_ns=event.pair.stamp_ns)
            if self.keeps:
                self.pairs.append(event.pair)
        elif isinstance(event, SensorTime) and event.stamp_ns == self.slice_end_ns:
            self.finished.append(event.stamp_ns)
            self.slice_end_ns = None
        return []


class ObservedPair(CameraLidarPair):
    """A pair of the service, before `Observations`."""

    def __init__(self, pair: PairConfig, config: Config, engine: Vehicle, observations: Observations) -> None:
        self.name = pair.name
        held = PairBuffer(engine.waiting_frames, config.worker.timeout_s)
        losses = LossCounter(logging.getLogger("test"), pair.name)
        self.stream = PairStream(pair, engine.sensors_of(pair), held, losses)
        self.engine = cast("Pair", observations)
        self.recorder = cast("Recorder", SimpleNamespace(has_room=True))
        worker = SimpleNamespace(warms_up=False)
        self._context = cast("VehicleContext", SimpleNamespace(vehicle=engine, worker=worker))
        engine.join(self)


class VehicleBench:
    """An engine without a thread, and what its pairs come to."""

    def __init__(self, config: Config) -> None:
        self.config = config
        disk_writer = DiskWriter(Path("state"))
        rig = RigEstimator(Path("state"), (), disk_writer)
        self.engine = Vehicle(config.limits, Budget(config.budget, lambda: 0.0), rig, lambda _: None)
        self.observations: dict[str, Observations] = {}
        self.pairs: dict[str, ObservedPair] = {}
        for pair in config.pairs:
            self.join(pair.name)
        self.received: dict[str, Callable[[InputSample], None]] = {}
        self.listen()

    @property
    def streams(self) -> dict[str, PairStream]:
        return {name: pair.stream for name, pair in self.pairs.items()}

    def join(self, name: str) -> None:
        (pair,) = [one for one in self.config.pairs if one.name == name]
        self.observations[name] = Observations()
        self.pairs[name] = ObservedPair(pair, self.config, self.engine, self.observations[name])

    def listen(self) -> list[str]:
        streams = {stream.place: take for stream, take in self.engine.new_streams()}
        self.received.update(streams)
        return list(streams)

    def put(self, key: str, frame: CameraFrame | LidarFrame | EgoMotion | bytes) -> None:
        match frame:
            case CameraFrame():
                payload = encode_camera(frame)
            case LidarFrame():
                payload = encode_lidar(frame)
            case EgoMotion():
                payload = encode_ego(frame)
            case bytes():
                payload = frame
        self.received[key](InputSample(payload, ENCODING))

    def settle(self) -> None:
        while self.engine.turn(0.0):
            pass
        for pair in self.pairs.values():
            pair.stream.renew_report(pair.engine.selector.statistics, self.engine.clock.monotonic_s())

    def drive(self, numbers: Sequence[int], cameras: int, lidars: int) -> None:
        for number in numbers:
            for index in range(lidars):
                self.put(f"lidar/{index}", sweep(number))
            for index in range(cameras):
                self.put(f"camera/{index}", image(number, index))
            self.settle()


def image(number: int, seed: int = 0, sequence: int | None = None) -> CameraFrame:
    pixels = np.random.default_rng((number, seed)).bytes(WIDTH * HEIGHT)
    encoded = EncodedImage(ImageFormat.MONO8, WIDTH, HEIGHT, pixels)
    return CameraFrame(BEGIN_NS + number * HZ10_NS, "camera", encoded, sequence)


def sweep(number: int, points: int = 2) -> LidarFrame:
    xyz_m = np.linspace([5.0, -5.0, 0.0], [20.0, 5.0, 1.0], points).astype(np.float32)
    return LidarFrame(BEGIN_NS + number * HZ10_NS + 5_000_000, "lidar", xyz_m)


def test_a_stream_is_listened_to_once_however_many_pairs_it_is_of() -> None:
    vehicle = VehicleBench(rig_of(cameras=8, lidars=3))
    assert sorted(vehicle.received) == sorted([*(f"camera/{i}" for i in range(8)), *(f"lidar/{i}" for i in range(3))])
    assert vehicle.listen() == [], "once"


def test_every_pair_gets_the_same_frame_and_it_is_counted_once() -> None:
    vehicle = VehicleBench(rig_of(cameras=2, lidars=2))
    vehicle.drive(range(6), 2, 2)
    pairs = {name: observations.pairs for name, observations in vehicle.observations.items()}
    assert [len(each) for each in pairs.values()] == [5, 5, 5, 5], "the last may have a nearer partner still"
    for one, other in zip(pairs["0-0"], pairs["1-0"], strict=True):
        assert one.lidar is other.lidar
        assert one.camera is not other.camera
    for one, other in zip(pairs["0-0"], pairs["0-1"], strict=True):
        assert one.camera is other.camera
    for sensor in vehicle.engine.sensors:
        assert (sensor.decoder.counts().received, sensor.decoder.counts().accepted) == (6, 6)
    assert [stream.report.streams[LIDAR].accepted for stream in vehicle.streams.values()] == [6] * 4


def test_a_pair_of_a_rig_is_given_what_it_would_be_given_alone() -> None:
    rng = np.random.default_rng(1)
    together, alone = VehicleBench(rig_of(2, 1)), VehicleBench(rig_of(1, 1))
    waiting: dict[str, list[CameraFrame | LidarFrame]] = {
        "camera/0": [image(number) for number in range(40) if number % 7],
        "camera/1": [image(number, 1) for number in range(40) if number % 5],
        "lidar/0": [sweep(number) for number in range(40) if number % 11],
    }
    while keys := [key for key, frames in waiting.items() if frames]:
        key = str(rng.choice(keys))
        frame = waiting[key].pop(0)
        together.put(key, frame)
        if key != "camera/1":
            alone.put(key, frame)
        if rng.random() < 0.3:
            together.settle()
            alone.settle()
    for vehicle in (together, alone):
        vehicle.settle()
        vehicle.pairs["0-0"].finish_pairs()

    def reported(vehicle: VehicleBench) -> list[tuple[int, int]]:
        return [(pair.camera.stamp_ns, pair.lidar.stamp_ns) for pair in vehicle.observations["0-0"].pairs]

    assert reported(together) == reported(alone)
    assert len(reported(alone)) > 25
    assert together.streams["0-0"].losses() == alone.streams["0-0"].losses()


def test_what_is_lost_of_a_stream_is_counted_once_and_every_pair_of_it_reports() -> None:
    vehicle = VehicleBench(rig_of(2, 1))
    vehicle.put("lidar/0", b"rubbish")
    vehicle.put("camera/0", image(0, sequence=0))
    vehicle.put("camera/0", image(20, sequence=20))
    vehicle.put("camera/0", image(40, sequence=40))
    vehicle.put("camera/0", image(60, sequence=60))
    vehicle.settle()
    assert vehicle.streams["0-0"].losses() == {(LIDAR, "message_malformed"): 1, (CAMERA, "sequence_gap"): 41}
    assert vehicle.streams["1-0"].losses() == {(LIDAR, "message_malformed"): 1}


def test_only_what_is_read_alike_is_one_stream() -> None:
    (pair,) = rig_of(1, 1).pairs
    lidar = pair.lidar
    alike = lidar.model_copy(update={"name": "roof"})
    assert read_alike(LIDAR, lidar) == read_alike(LIDAR, alike)
    masked = pair.camera.model_copy(update={"mask": Path("mask.png"), "hardware_id": "7"})
    assert read_alike(CAMERA, pair.camera) == read_alike(CAMERA, masked)
    for other in ({"source": 1}, {"frame_id": "left"}, {"key": "lidar/1"}, {"cloud_frame_id": "base"}):
        assert read_alike(LIDAR, lidar) != read_alike(LIDAR, lidar.model_copy(update=other))


def test_two_lidars_in_one_cloud_are_two_streams_of_one_key() -> None:
    config = rig_of(1, 2)
    pairs = [
        pair.model_copy(update={"lidar": pair.lidar.model_copy(update={"key": "lidar/0", "source": number})})
        for number, pair in enumerate(config.pairs)
    ]
    vehicle = VehicleBench(config.model_copy(update={"pairs": tuple(pairs)}))
    assert [sensor.kind for sensor in vehicle.engine.sensors] == [CAMERA, LIDAR, LIDAR]


def test_a_pair_that_joins_later_gets_what_comes_then() -> None:
    config = rig_of(2, 1)
    vehicle = VehicleBench(config.model_copy(update={"pairs": config.pairs[:1]}))
    vehicle.drive(range(5), 1, 1)
    vehicle.config = config
    vehicle.join("1-0")
    assert vehicle.listen() == ["camera/1"], "its LiDAR is listened to"
    vehicle.drive(range(5, 10), 2, 1)
    assert [len(observations.pairs) for observations in vehicle.observations.values()] == [9, 4]
    assert vehicle.observations["1-0"].pairs[0].lidar is vehicle.observations["0-0"].pairs[5].lidar


@pytest.mark.fault("a pair whose answers are late", "the other pairs of the vehicle are looked at meanwhile")
def test_a_pair_that_waits_keeps_no_other_waiting(record_property: Callable[[str, object], None]) -> None:
    vehicle = VehicleBench(rig_of(2, 1))
    vehicle.observations["0-0"].is_waiting = True
    vehicle.drive(range(30), 2, 1)
    reported = [len(observations.pairs) for observations in vehicle.observations.values()]
    record_property("figure", f"{reported[1]} of 29 pairs of the other")
    assert reported == [0, 29]
    assert vehicle.streams["0-0"].report.held == 29
    vehicle.observations["0-0"].is_waiting = False
    vehicle.settle()
    assert len(vehicle.observations["0-0"].pairs) == 29


@pytest.mark.fault("a sensor that floods one stream", "other streams of the vehicle lose nothing")
def test_each_stream_has_room_of_its_own(record_property: Callable[[str, object], None]) -> None:
    vehicle = VehicleBench(rig_of(2, 1))
    vehicle.settle()
    for number in range(10):
        vehicle.put("camera/1", image(number, 1))
        vehicle.put("lidar/0", sweep(number))
    for number in range(500):
        vehicle.put("camera/0", image(number))
    vehicle.settle()
    lost = {
        (sensor.config.place, *cause): count
        for sensor in vehicle.engine.sensors
        for cause, count in sensor.losses.snapshot().items()
    }
    record_property("figure", f"{sum(lost.values())} of 500 samples of the flood, none of others")
    assert lost == {("camera/0", CAMERA, "overrun"): 500 - FRAMES_WAITING}
    assert len(vehicle.observations["1-0"].pairs) == 9


@pytest.mark.fault("pairs that are never released", "memory of a vehicle's frames is bounded, each counted once")
def test_frames_of_all_pairs_are_bounded_together_and_each_counts_once(
    record_property: Callable[[str, object], None],
) -> None:
    vehicle = VehicleBench(rig_of(4, 1, max_held_bytes=MB))
    points = 8192  # 96 kB
    for number in range(40):
        vehicle.put("lidar/0", sweep(number, points))
        for index in range(4):
            vehicle.put(f"camera/{index}", image(number, index))
        vehicle.settle()
    held = {
        id(pair.lidar): pair.lidar.xyz_m.nbytes
        for observations in vehicle.observations.values()
        for pair in observations.pairs
    }
    record_property("figure", f"{sum(held.values()) / MB:.2f} MiB of 1.5 in sweeps")
    assert 1.2 * MB < sum(held.values()) <= 1.5 * MB
    (lidar,) = [sensor for sensor in vehicle.engine.sensors if sensor.kind == LIDAR]
    assert lidar.losses.snapshot()[LIDAR, "memory_full"] > 0
    held.clear()
    for observations in vehicle.observations.values():
        observations.pairs.clear()
        observations.keeps = False
    vehicle.drive(range(100, 110), 4, 1)
    gc.collect()
    before = lidar.losses.snapshot()
    vehicle.drive(range(110, 120), 4, 1)
    assert lidar.losses.snapshot() == before, "there is room again"


@pytest.mark.fault("checks pile up before a worker that does not answer", "pairs wait no more; no frame is refused")
def test_pairs_wait_no_more_before_frames_are_refused(record_property: Callable[[str, object], None]) -> None:
    vehicle = VehicleBench(rig_of(2, 2, max_held_bytes=MB))
    vehicle.observations["1-1"].is_waiting, vehicle.observations["1-1"].keeps = True, False
    points = 2048  # 24 kB
    for number in range(120):
        for index in range(2):
            vehicle.put(f"lidar/{index}", sweep(number, points))
            vehicle.put(f"camera/{index}", image(number, index))
        vehicle.settle()
        retained = vehicle.observations["0-0"].pairs
        del (
            retained[: max(len(retained) - 45, 0)],
            vehicle.observations["0-1"].pairs[:],
            vehicle.observations["1-0"].pairs[:],
        )
    held = vehicle.streams["1-1"].report.held
    record_property("figure", f"{held} pairs wait instead of 42, none refused")
    assert 0 < held < 20
    assert all(
        (kind, "memory_full") not in sensor.losses.snapshot()
        for sensor in vehicle.engine.sensors
        for kind in (CAMERA, LIDAR)
    )


@pytest.mark.fault("one camera of a vehicle falls silent", "its slice ends by the clock although all others go on")
def test_silence_of_a_pair_is_noticed_while_others_speak(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    vehicle = VehicleBench(rig_of(2, 2))
    vehicle.observations["0-0"].slice_end_ns = vehicle.observations["1-1"].slice_end_ns = BEGIN_NS + 20 * HZ10_NS + 1
    for number in range(20):
        now_s += 0.1
        vehicle.drive([number], 2, 2)
    for number in range(20, 400):
        now_s += 0.1
        vehicle.put("camera/1", image(number, 1))
        vehicle.put("lidar/1", sweep(number))
        vehicle.settle()
        for pair in vehicle.pairs.values():
            waiting = {sensor.number for sensor in pair.sensors.values()} & vehicle.engine.inbox.waiting()
            pair.tick(now_s, waiting=bool(waiting))
    assert vehicle.observations["0-0"].finished == [BEGIN_NS + 20 * HZ10_NS + 1]
    assert vehicle.observations["1-1"].finished == []


@pytest.mark.fault("frames that are held up for long, and come then", "the window that ended too early is counted")
@pytest.mark.parametrize(("comes", "counted"), [(20, 1), (400, 0)])
def test_frames_of_a_slice_that_silence_has_finished_are_counted(
    monkeypatch: pytest.MonkeyPatch, comes: int, counted: int
) -> None:
    now_s = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    vehicle = VehicleBench(rig_of(1, 1))
    observations, stream = vehicle.observations["0-0"], vehicle.streams["0-0"]
    observations.slice_end_ns = BEGIN_NS + 50 * HZ10_NS
    for number in range(20):
        now_s += 0.1
        vehicle.drive([number], 1, 1)
    for _ in range(400):
        now_s += 0.1
        vehicle.settle()
        vehicle.pairs["0-0"].tick(now_s, waiting=False)
    assert observations.finished == [BEGIN_NS + 50 * HZ10_NS]
    vehicle.drive([comes, comes + 1], 1, 1)
    assert stream.losses().get(("window", "ended_too_early"), 0) == counted


def test_motion_is_of_every_lidar_that_it_moves() -> None:
    config = rig_of(1, 2)
    T = [[1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    documents: list[dict[str, Any]] = [pair.model_dump(exclude_none=True) for pair in config.pairs]
    documents[0]["ego"] = {"key": "odometry"}
    documents[1]["ego"] = {"key": "odometry", "T_lidar_ego": T}
    vehicle = VehicleBench(Config.model_validate({"pairs": documents}))
    assert [sensor.kind for sensor in vehicle.engine.sensors].count(EGO) == 1
    for number in range(5):
        vehicle.put("odometry", EgoMotion(BEGIN_NS + number * HZ10_NS, "ego", (5.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
        vehicle.drive([number], 1, 2)
    assert all(pair.motion is not None for observations in vehicle.observations.values() for pair in observations.pairs)
    assert [len(observations.pairs) for observations in vehicle.observations.values()] == [4, 4]
