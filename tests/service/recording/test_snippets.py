"""Seconds around an event on the disk: whole, bounded, found again after a kill, and read by everybody."""

from __future__ import annotations

import errno
import hashlib
import logging
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from coec.calibration.types import (
    CameraFrame,
    EgoMotion,
    EncodedImage,
    Frame,
    ImageFormat,
    LidarFrame,
    Rig,
    SweepTiming,
)
from coec.errors import NotFoundError, UsageError
from coec.geometry.cameras import build
from coec.io.logs import LossCounter
from coec.io.mcap.writer import SnippetFile
from coec.io.recordings.bag import open_bag
from coec.io.recordings.recording_source import parse_spec
from coec.service.ingest.pair_stream import Snippet
from coec.service.recording.snippets import SnippetRecorder, SnippetStore
from support.disk import FullDisk
from support.readers import read_recording

S = 1_000_000_000
BEGIN_NS = 1_700_000_000 * S
WIDTH, HEIGHT = 64, 48
RIG = Rig(
    "front",
    build("pinhole", width=WIDTH, height=HEIGHT, fx=40.0, fy=40.0, cx=31.5, cy=23.5),
    "camera",
    "lidar",
    np.array([[0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, 0.2], [1.0, 0.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]]),
    np.eye(4),
    sweep=SweepTiming(0.1, -1),
)
JPEG = cv2.imencode(".jpg", np.zeros((HEIGHT, WIDTH, 3), np.uint8))[1].tobytes()


def frames(count: int = 10, points: int = 500) -> Iterator[Frame]:
    rng = np.random.default_rng(4)
    for index in range(count):
        stamp_ns = BEGIN_NS + index * S // 10
        cloud = rng.normal(size=(points, 3)).astype(np.float32)
        yield LidarFrame(stamp_ns, "lidar", cloud)
        yield EgoMotion(stamp_ns, "ego", (5.0, 0.0, 0.0), (0.0, 0.0, 0.1))
        yield CameraFrame(stamp_ns, "camera", EncodedImage(ImageFormat.JPEG, WIDTH, HEIGHT, JPEG))


def snippet(after_s: int = 0, **options: int) -> Snippet:
    return Snippet("suspect", BEGIN_NS + after_s * S, RIG.T_camera_lidar_nominal, tuple(frames(**options)))


class Bench:
    def __init__(self, folder: Path, max_bytes: int = 2**30) -> None:
        self.folder = folder / "snippets"
        self.store = SnippetStore(self.folder, max_bytes, 0)
        self.losses = LossCounter(logging.getLogger("test"), "front")
        self.recorder = SnippetRecorder(RIG, {"vehicle": "v7"}, self.store, self.losses, packed=True)

    def record(self, one: Snippet) -> None:
        self.recorder.submit(one)
        while self.recorder.write():
            pass

    @property
    def ids(self) -> list[str]:
        return [info.snippet_id for info in self.store.listing("front")]

    @property
    def files(self) -> set[str]:
        return {path.name for path in self.folder.iterdir()}


def test_it_opens_everywhere_is_listed_and_is_a_source(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.record(snippet())
    (info,) = bench.store.listing("front")
    path = bench.store.path(info.snippet_id)
    data = path.read_bytes()
    assert (info.event, info.stamp_ns, info.size_bytes) == ("suspect", BEGIN_NS, len(data))
    assert info.sha256 == hashlib.sha256(data).hexdigest()
    assert bench.store.listing("rear") == ()
    bag = read_recording(path)
    assert bag.types == {
        "/front/lidar/points": "sensor_msgs/msg/PointCloud2",
        "/front/odometry": "nav_msgs/msg/Odometry",
        "/front/camera/camera_info": "sensor_msgs/msg/CameraInfo",
        "/front/camera/image/compressed": "sensor_msgs/msg/CompressedImage",
        "/tf_static": "tf2_msgs/msg/TFMessage",
    }
    assert bag.latched == {"/tf_static"}
    assert bag.counts["/front/camera/image/compressed"] == bag.counts["/front/lidar/points"] == 10
    recording = open_bag(parse_spec(str(path)))
    assert len(recording.camera_stamps_ns) == 10
    np.testing.assert_allclose(recording.T_camera_lidar_start, RIG.T_camera_lidar_nominal, atol=1e-9)
    assert bench.store.read("front", info.snippet_id, 5, 10) == data[5:15]
    with pytest.raises(UsageError, match="offset"):
        bench.store.read("front", info.snippet_id, len(data) + 1, 1)
    for pair, name in (("rear", info.snippet_id), ("front", "../state"), ("front", "front-1.snippet")):
        with pytest.raises(NotFoundError):
            bench.store.read(pair, name, 0, 1)


def test_while_one_is_written_another_is_counted_and_then_there_is_room_again(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.recorder.submit(snippet())
    bench.recorder.submit(snippet(1))
    bench.record(snippet(2))
    assert bench.losses.snapshot() == {("window", "snippet_overrun"): 2}
    bench.record(snippet(3))
    assert bench.ids == [f"front-{BEGIN_NS}.snippet", f"front-{BEGIN_NS + 3 * S}.snippet"]


def test_a_large_one_is_written_in_rounds(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.recorder.submit(snippet(count=10, points=150_000))
    rounds = 0
    while bench.recorder.write():
        rounds += 1
        assert rounds > 1 or bench.ids == []
    assert rounds > 3
    assert len(bench.ids) == 1


def test_the_oldest_go_and_one_that_is_too_large_is_not_written(tmp_path: Path) -> None:
    bench = Bench(tmp_path, max_bytes=500_000)
    for second in range(4):
        bench.record(snippet(second, points=1500))  # 200 kB each
    assert bench.ids == [f"front-{BEGIN_NS + second * S}.snippet" for second in (2, 3)]
    bench.record(snippet(9, points=10_000))
    assert bench.losses.snapshot() == {("window", "snippet_failed"): 1}
    assert len(bench.ids) == 2
    assert len(bench.files) == 4


@pytest.mark.fault(
    "kill -9 while a snippet is written, or before it is listed",
    "what was written of it is found, listed and read by everybody",
)
def test_what_a_killed_service_left_is_taken_up(tmp_path: Path, record_property: Any) -> None:
    bench = Bench(tmp_path)
    bench.record(snippet(5))
    untold = bench.store.listing("front")[0]
    (bench.folder / f"{untold.snippet_id}.json").unlink()
    path = bench.store.path(f"front-{BEGIN_NS}.snippet")
    file = SnippetFile(path, RIG, RIG.T_camera_lidar_nominal, {"event": "degraded"}, packed=True)
    for frame in frames(points=50_000):
        file.add(frame)
    part = path.with_name(f"{path.name}.part")
    killed_here = part.read_bytes()
    file.abandon()
    result = []
    for share in (0.0, 0.3, 0.6, 1.0):
        part.write_bytes(killed_here[: round(share * len(killed_here))])
        again = Bench(tmp_path)
        again.recorder.resume(lambda: None)
        assert not part.exists()
        reported = {info.snippet_id: info for info in again.store.listing("front")}
        assert reported.pop(untold.snippet_id) == untold
        if share == 0.0:
            assert not reported
            continue
        (info,) = reported.values()
        assert info.event == "degraded"
        result.append(read_recording(path).counts["/front/lidar/points"])
        assert Bench(tmp_path).store.listing("front") == again.store.listing("front"), "now it is told"
        path.unlink()
        (bench.folder / f"{info.snippet_id}.json").unlink()
    record_property("figure", f"{result} of 10 sweeps by the place of the cut")
    assert result == sorted(result)
    assert result[-1] >= 6


@pytest.mark.fault("a disk that is full at any write of a snippet", "it is lost and counted, and the next is written")
@pytest.mark.parametrize("step", [4, pytest.param(1, marks=pytest.mark.slow)])
def test_a_full_disk_costs_the_snippet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record_property: Any, step: int
) -> None:
    points, refused = 0, True
    while refused:
        first, folder = points * step, tmp_path / str(points)
        bench = Bench(folder)
        with monkeypatch.context() as patch:
            disk = FullDisk(folder, patch, errno.ENOSPC)
            disk.refuses = range(first, first + 2)
            bench.record(snippet(count=2))
            refused = disk.operations > first
            disk.refuses = ()
            bench.record(snippet(1, count=2))
        assert bench.ids[0] == f"front-{BEGIN_NS}.snippet" or bench.losses.snapshot() == {
            ("window", "snippet_failed"): 1
        }
        assert bench.ids[-1] == f"front-{BEGIN_NS + S}.snippet"
        again = Bench(folder)
        again.recorder.resume(lambda: None)
        assert set(again.ids) >= set(bench.ids)
        assert not [name for name in again.files if name.endswith(".part")]
        for name in again.ids:
            assert len(open_bag(parse_spec(str(again.store.path(name)))).camera_stamps_ns) == 2
        points += 1
    record_property("figure", f"{points} points")


@pytest.mark.parametrize(("stop_s", "sweeps"), [(60.0, 10), (0.0, 2)])
def test_a_stop_keeps_what_can_be_written_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop_s: float, sweeps: int
) -> None:
    monkeypatch.setattr("coec.service.recording.snippets.STOP_S", stop_s)
    monkeypatch.setattr("coec.service.recording.snippets.ROUND_S", 60.0)
    bench = Bench(tmp_path)
    bench.recorder.submit(snippet(count=10, points=200_000))  # a round are two sweeps
    bench.recorder.write()
    bench.recorder.close()
    assert bench.losses.snapshot() == ({("window", "snippet_cut_short"): 1} if sweeps < 10 else {})
    (name,) = bench.ids
    assert read_recording(bench.store.path(name)).counts["/front/lidar/points"] == sweeps


@pytest.mark.fault(
    "the folder of snippets is removed under the running service", "the next snippet is recorded in a new one"
)
def test_snippets_that_somebody_removed_are_not_listed_and_the_next_one_is_recorded(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.record(snippet())
    (before,) = bench.ids
    shutil.rmtree(bench.folder)
    bench.store.flush()
    assert bench.ids == []
    bench.record(snippet())
    assert bench.ids == [before]
    assert bench.store.path(before).exists()
