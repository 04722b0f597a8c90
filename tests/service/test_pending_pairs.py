"""Pairs that are awaited: what is listened to, when they are handed over, and what a restart knows of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from coec.calibration.types import Reason
from coec.config import AnyStreamConfig, Config, PairConfig, config_of
from coec.errors import ConfigError
from coec.io.zenoh.bus import Bus, InputSample, StreamInput
from coec.io.zenoh.ros_node import RosSide
from coec.service.discovery import DiscoveredPair
from coec.service.discovery_listener import DiscoveryListener
from coec.service.pending_pairs import PendingPairs
from support.fake_worker import wait_until
from support.pending_pairs import CAMERA, INFO, POINTS, SAMPLES, T_CAMERA_LIDAR, TF_STATIC, World, configured
from support.vehicles import PairBench


class Line:
    """A bus and its vehicle: who listens to a topic hears what is put there."""

    def __init__(self) -> None:
        self.received: dict[str, Callable[[InputSample], None]] = {}
        self.latched: list[str] = []
        self.subscribed: list[str] = []
        self.finished: list[str] = []

    def subscribe(self, stream: StreamInput, on_sample: Callable[[InputSample], None]) -> Callable[[], None]:
        (topic,) = stream.expressions
        self.received[topic] = on_sample
        self.subscribed.append(topic)

        def end() -> None:
            self.finished.append(topic)
            del self.received[topic]

        return end

    def subscribe_latched(self, stream: StreamInput, on_sample: Callable[[InputSample], None]) -> None:
        self.subscribe(stream, on_sample)
        self.latched += stream.expressions

    def input_of(self, stream: AnyStreamConfig) -> StreamInput:
        return self.input_of_info(stream.place)

    def input_of_info(self, topic: str) -> StreamInput:
        return StreamInput((topic,), lambda _: InputSample(b"", ""))

    def input_of_static_transforms(self) -> StreamInput:
        return self.input_of_info(TF_STATIC)

    def put(self, *topics: str) -> None:
        for topic in topics:
            if topic in self.received:
                self.received[topic](SAMPLES[topic])


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def opened(stack: ExitStack, config: Config, folder: Path) -> tuple[PendingPairs, Line, World]:
    room, line = PendingPairs(config, folder), Line()
    world = World(folder, room.nominal)
    room.open(room.complete(config), world.context)
    room.listen(cast("Bus", line), cast("RosSide", line))
    for thread in room.threads:
        stack.callback(thread.join, 20.0)
        stack.callback(thread.request_stop)
    return room, line, world


def result(room: PendingPairs) -> dict[str, PairConfig]:
    """Of the first hand-over."""
    handed: list[dict[str, PairConfig]] = []

    def comes() -> bool:
        handed.append(room.pop_discovered())
        return bool(handed[-1])

    wait_until(comes, "the pair is found")
    return handed[-1]


def test_where_nobody_is_pending_nothing_is_listened_to(stack: ExitStack, tmp_path: Path) -> None:
    intrinsics = {"model": "pinhole", "width": 8, "height": 6, "fx": 4, "fy": 4, "cx": 4, "cy": 3}
    camera = {"topic": CAMERA, "intrinsics": intrinsics, "frame_id": "camera"}
    lidar = {"topic": POINTS, "frame_id": "lidar"}
    given = {"T_camera_lidar": T_CAMERA_LIDAR.tolist(), "camera": camera, "lidar": lidar}
    document = configured(tmp_path).model_dump(include={"middleware", "state"})
    config = Config.model_validate({**document, "pairs": [{"name": "front", **given}]})
    room, line, _ = opened(stack, config, tmp_path)
    assert (room.threads, room.answers, line.received, room.pop_discovered()) == ((), {}, {}, {})
    assert room.complete(config) == config


def test_a_pair_is_handed_over_once_everything_is_received(stack: ExitStack, tmp_path: Path) -> None:
    config = configured(tmp_path)
    room, line, world = opened(stack, config, tmp_path)
    assert set(line.received) == {CAMERA, POINTS, INFO, TF_STATIC}
    assert set(line.latched) == {INFO, TF_STATIC}, "what was said before counts, too"
    line.put(INFO, TF_STATIC, POINTS)
    wait_until(lambda: [one.code for one in room.nominal("front").awaits] == ["no_image"], "what is missing is told")
    assert room.pop_discovered() == {}
    room.renew()
    assert b"no_image" in world.published[-1][1].payload

    line.put(CAMERA)
    pair = result(room)["front"]
    np.testing.assert_allclose(pair.T_camera_lidar, T_CAMERA_LIDAR, atol=1e-12)
    assert room.answers == {}, "whoever is handed over is answered for elsewhere"
    assert set(line.received) == {INFO, TF_STATIC}, "changes are told for as long as the service runs"
    line.put(INFO, TF_STATIC)
    assert room.pop_discovered() == {}, "once"


@pytest.mark.fault("a restart of a vehicle whose pairs were found on the bus", "they are served at once, as found")
def test_a_restart_has_what_was_discovered(stack: ExitStack, tmp_path: Path) -> None:
    config = configured(tmp_path)
    room, line, _ = opened(stack, config, tmp_path)
    line.put(*SAMPLES)
    pair = result(room)["front"]

    again = PendingPairs(config, tmp_path)
    complete = again.complete(config)
    assert (complete.pairs, complete.awaited) == ((pair,), ())
    assert "kept since" in again.origins()["front"]["T_camera_lidar"]
    elsewhere = configured(tmp_path, points="/rear/points")
    assert PendingPairs(elsewhere, tmp_path).complete(elsewhere).pairs == (), "of other topics nothing is known"


@pytest.mark.fault("what was found of a pair cannot be used", "it is awaited until something else is heard")
def test_a_pair_that_cannot_be_built_is_pending_again(stack: ExitStack, tmp_path: Path) -> None:
    room, line, world = opened(stack, configured(tmp_path), tmp_path)
    line.put(*SAMPLES)
    wait_until(lambda: [one.code for one in room.nominal("front").awaits] == ["being_built"], "it is found")
    room.refuse("front", "the mask is too small")
    wait_until(lambda: [one.code for one in room.nominal("front").awaits] == ["cannot_be_built"], "it is refused")
    room.renew()
    assert b"the mask is too small" in world.published[-1][1].payload
    assert list(room.answers) == ["front"]


def test_the_end_of_the_service_is_reported_for_those_who_wait(stack: ExitStack, tmp_path: Path) -> None:
    room, _, world = opened(stack, configured(tmp_path), tmp_path)
    room.fail(Reason("thread_died", "The thread discovery died."))
    assert b"thread_died" in world.published[-1][1].payload


def test_what_is_given_and_cannot_be_used_is_reported_at_once(tmp_path: Path) -> None:
    config = configured(tmp_path, T_camera_lidar=np.eye(4).tolist(), camera={"topic": CAMERA, "mask": "absent.png"})
    with pytest.raises(ConfigError, match="absent"):
        PendingPairs(config, tmp_path)


def test_what_several_pairs_wait_for_is_listened_to_once_until_the_last_is_detected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cameras = [{"name": name, "topic": f"/{name}/image_raw"} for name in ("front", "rear")]
    lidars = [{"name": name, "topic": f"/{name}/points"} for name in ("roof", "left")]
    config = config_of({"middleware": "ros2dds", "cameras": cameras, "lidars": lidars, "pairs": "all"})
    reported: list[tuple[str, str]] = []
    monkeypatch.setattr(DiscoveryListener, "take_frame", lambda _, pair, kind, __: reported.append((pair, kind)))
    room, ears = PendingPairs(config, tmp_path), Line()
    monkeypatch.setattr(room._listener.thread, "start", lambda: None)
    room.open(config, PairBench(tmp_path / "bench").context)

    room.listen(cast("Bus", ears), cast("RosSide", ears))
    topics = {f"/{name}/image_raw" for name in ("front", "rear")} | {f"/{name}/points" for name in ("roof", "left")}
    infos = {"/front/camera_info", "/rear/camera_info"}
    assert Counter(ears.subscribed) == Counter(topics | infos | {TF_STATIC})
    ears.received["/roof/points"](InputSample(b"", ""))
    assert reported == [("front-roof", "lidar"), ("rear-roof", "lidar")]
    (pair,) = PairBench(tmp_path / "other").config.pairs
    ready = iter([{"front-roof": DiscoveredPair(pair, {})}, {"front-left": DiscoveredPair(pair, {})}])
    monkeypatch.setattr(room._listener, "ready", lambda: next(ready))
    assert [*room.pop_discovered(), *room.pop_discovered()] == ["front-roof", "front-left"]
    assert ears.finished == ["/front/image_raw"]
    reported.clear()
    ears.received["/roof/points"](InputSample(b"", ""))
    assert reported == [("rear-roof", "lidar")]
