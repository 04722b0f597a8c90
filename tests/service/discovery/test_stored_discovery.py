"""What was found stays found: over restarts, for the same question, whatever lies on the disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from coec.config import Config, PairConfig
from coec.io.storage import StateFile
from coec.service.discovery import NOMINAL_FILE, DiscoveredPair, DiscoveryStore, completed

INTRINSICS = {"model": "pinhole", "width": 8, "height": 6, "fx": 4.0, "fy": 4.0, "cx": 4.0, "cy": 3.0}
TRANSFORM = [[0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, 1 / 3], [1.0, 0.0, 0.0, -0.7], [0.0, 0.0, 0.0, 1.0]]


def configured(ros: dict[str, Any] | None = None, **of: Any) -> Config:
    given = {"name": "front", "camera": "/front/image", "points": "/top/points", **of}
    pair = {name: value for name, value in given.items() if value is not None}
    return Config.model_validate({"middleware": "rmw_zenoh", "ros": ros or {}, "pairs": [pair]})


def result() -> DiscoveredPair:
    document = {
        "name": "front",
        "camera": {"topic": "/front/image", "frame_id": "cam", "intrinsics": INTRINSICS},
        "lidar": {"topic": "/top/points", "frame_id": "top"},
        "T_camera_lidar": TRANSFORM,
    }
    return DiscoveredPair(
        PairConfig.model_validate(document), {"T_camera_lidar": "/tf_static, between 'cam' and 'top'"}
    )


def keep(folder: Path, config: Config) -> None:
    retained = DiscoveryStore(folder)
    retained.update(result(), config.awaited[0], config, 1_700_000_000 * 10**9)
    retained.flush()


def test_a_restart_has_the_same_to_the_bit_and_says_since_when(tmp_path: Path) -> None:
    config = configured()
    keep(tmp_path, config)
    again = DiscoveryStore(tmp_path).load(config)["front"]
    assert again.pair == result().pair
    assert again.origins["T_camera_lidar"].endswith("kept since 2023-11-14 22:13:20 UTC")
    whole = completed(config, {"front": again.pair})
    assert ([pair.name for pair in whole.pairs], whole.awaited) == (["front"], ())
    assert Config.model_validate_json(whole.model_dump_json()) == whole


def test_other_settings_are_taken_and_other_queries_are_not_answered(tmp_path: Path) -> None:
    keep(tmp_path, configured())
    lidar = {"topic": "/top/points", "sweep": {"period_s": 0.05}}
    other = configured(window={"pairs": 12, "min_pairs": 4}, points=None, lidar=lidar)
    again = DiscoveryStore(tmp_path).load(other)["front"].pair
    assert again.window.pairs == 12
    assert again.lidar.sweep is not None
    assert again.T_camera_lidar == result().pair.T_camera_lidar
    for requested in (
        configured(camera="/rear/image"),
        configured(camera={"topic": "/front/image", "info_topic": "/calibration"}),
        configured(T_camera_lidar=TRANSFORM),
        configured(ego="/odometry"),
        configured(ros={"domain": 7}),
    ):
        assert DiscoveryStore(tmp_path).load(requested) == {}


@pytest.mark.parametrize("damage", [b"", b"{}", b"\x00" * 100, b'{"body":{"pairs":{"front":{}}}}'])
def test_what_is_damaged_is_searched_anew(tmp_path: Path, damage: bytes) -> None:
    config = configured()
    keep(tmp_path, config)
    (tmp_path / NOMINAL_FILE).write_bytes(damage)
    retained = DiscoveryStore(tmp_path)
    assert retained.load(config) == {}
    retained.update(result(), config.awaited[0], config, 5)
    retained.flush()
    assert DiscoveryStore(tmp_path).load(config)["front"].pair == result().pair


@pytest.mark.fault("a kept nominal calibration with settings that only another version has", "it is used all the same")
def test_settings_of_another_version_next_to_what_was_discovered_are_ignored(tmp_path: Path) -> None:
    config = configured()
    keep(tmp_path, config)
    file = StateFile(tmp_path / NOMINAL_FILE)
    body = file.load().body
    assert body is not None
    pair = body["pairs"]["front"]["pair"]
    pair["stereo"] = {"baseline_m": 0.2}
    pair["camera"]["shutter"] = "rolling"
    del pair["monitor"]
    file.save(body)
    retained = DiscoveryStore(tmp_path)
    assert retained.load(config)["front"].pair == result().pair
    retained.flush()
    assert StateFile(tmp_path / NOMINAL_FILE).load().body == body
