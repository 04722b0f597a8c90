"""Pairs that wait for what the bus tells: what they share is listened to once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import pytest

from coec.adapters.zenoh.bus import Bus
from coec.adapters.zenoh.inputs import Input, Sample, input_of
from coec.config import AnyStreamConfig, config_of
from coec.runtime.nominal.findings import Found
from coec.runtime.nominal.watch import NominalWatch
from coec.runtime.waiting_room import WaitingRoom
from pair_bench import Bench


@dataclass
class Ears:
    """In place of the bus."""

    heard: Counter[str] = field(default_factory=Counter)
    takers: dict[str, Callable[[Sample], None]] = field(default_factory=dict)
    ended: list[str] = field(default_factory=list)

    def subscribe(self, stream: Input, take: Callable[[Sample], None]) -> Callable[[], None]:
        (key,) = stream.expressions
        self.subscribe_latched(stream, take)
        return lambda: self.ended.append(key)

    def subscribe_latched(self, stream: Input, take: Callable[[Sample], None]) -> None:
        (key,) = stream.expressions
        self.heard[key] += 1
        self.takers[key] = take


def test_what_several_pairs_wait_for_is_listened_to_once_until_the_last_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cameras = [{"name": name, "topic": f"/{name}/image_raw"} for name in ("front", "rear")]
    lidars = [{"name": name, "topic": f"/{name}/points"} for name in ("roof", "left")]
    config = config_of({"middleware": "ros2dds", "cameras": cameras, "lidars": lidars, "pairs": "all"})
    told: list[tuple[str, str]] = []
    monkeypatch.setattr(NominalWatch, "take_frame", lambda _, pair, kind, __: told.append((pair, kind)))
    room, ears = WaitingRoom(config, tmp_path), Ears()
    monkeypatch.setattr(room._watch.thread, "start", lambda: None)
    room.open(config, Bench(tmp_path / "bench").outside)

    def input_of_stream(stream: AnyStreamConfig) -> Input:
        return input_of(stream, config)

    room.listen(cast("Bus", ears), input_of_stream)
    topics = {f"{name}/image_raw" for name in ("front", "rear")} | {f"{name}/points" for name in ("roof", "left")}
    infos = {"front/camera_info", "rear/camera_info"}
    assert ears.heard == Counter(topics | infos | {"tf_static"})
    ears.takers["roof/points"](Sample(b"", ""))
    assert told == [("front-roof", "lidar"), ("rear-roof", "lidar")]
    (pair,) = Bench(tmp_path / "other").config.pairs
    ready = iter([{"front-roof": Found(pair, {})}, {"front-left": Found(pair, {})}])
    monkeypatch.setattr(room._watch, "ready", lambda: next(ready))
    assert [*room.found(), *room.found()] == ["front-roof", "front-left"]
    assert ears.ended == ["front/image_raw"]
    told.clear()
    ears.takers["roof/points"](Sample(b"", ""))
    assert told == [("rear-roof", "lidar")]
