"""Foxglove's own libraries in TypeScript, from npm, read the windows that the service records: every chunk with its
checksum, every message by the schema that the file holds for it."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from coec.io.mcap.windows import read_window
from support.fleet import recorded_windows

pytestmark = pytest.mark.slow

Record = Callable[[str, object], None]
"""pytest's `record_property`."""

READER = Path(__file__).with_name("foxglove_reader.mjs")
PACKAGES = (
    "@mcap/core@2.2.2", "@mcap/nodejs@1.0.2", "@mcap/support@1.1.0",
    "@foxglove/rosmsg@5.0.5", "@foxglove/rosmsg2-serialization@3.1.0",
)  # fmt: skip
PATIENCE_S = 300.0


@pytest.fixture(scope="module")
def libraries(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the reader and the libraries."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        pytest.skip("needs node 18 or newer, and npm (Debian: apt-get install nodejs npm)")
    folder = tmp_path_factory.mktemp("foxglove")
    (folder / "package.json").write_text('{"private": true, "type": "module"}')
    command = [npm, "install", "--no-audit", "--no-fund", "--ignore-scripts", *PACKAGES]
    fetched = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=PATIENCE_S)
    if fetched.returncode != 0:
        pytest.skip(f"needs the npm registry, for {', '.join(PACKAGES)}: {fetched.stderr[-300:]}")
    shutil.copy(READER, folder)
    return folder


@pytest.fixture(scope="module")
def window(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A window with its result."""
    (result,) = recorded_windows(tmp_path_factory.mktemp("windows")).glob("one/*.mcap")
    return result


@pytest.fixture(scope="module")
def read(libraries: Path, window: Path) -> Mapping[str, Any]:
    """What Foxglove's libraries find in it."""
    command = ["node", READER.name, str(window)]
    finished = subprocess.run(command, cwd=libraries, capture_output=True, text=True, timeout=PATIENCE_S)
    assert finished.returncode == 0, finished.stderr
    document: Mapping[str, Any] = json.loads(finished.stdout)
    return document


def test_every_message_is_read_by_its_schema(read: Mapping[str, Any], window: Path, record_property: Record) -> None:
    recorded, _ = read_window(window)
    assert read["profile"] == "ros2"
    assert read["inOrder"]
    by_schema: dict[str, list[Mapping[str, Any]]] = {}
    for topic in read["topics"].values():
        by_schema.setdefault(topic["schema"], []).append(topic)
    (clouds,) = by_schema["sensor_msgs/msg/PointCloud2"]
    assert clouds["messages"] == len(recorded.pairs)
    assert {"x", "y", "z"} <= set(clouds["first"]["fields"])
    first = clouds["first"]
    assert first["bytes"] == first["width"] * first["height"] * first["point_step"] > 0
    images = [topic for topic in by_schema["sensor_msgs/msg/CompressedImage"] if topic["first"]["bytes"]]
    assert any(topic["messages"] == len(recorded.pairs) for topic in images)
    (transforms,) = by_schema["tf2_msgs/msg/TFMessage"]
    assert transforms["first"]["children"] == [clouds["first"]["frame"]]
    record_property("figure", f"{sum(topic['messages'] for topic in read['topics'].values())} messages")


def test_the_result_and_the_rig_come_along(read: Mapping[str, Any]) -> None:
    results = [topic for topic in read["topics"].values() if topic["encoding"] == "json"]
    assert results
    assert all(topic["messages"] >= 1 for topic in results)
    assert read["attachments"]
