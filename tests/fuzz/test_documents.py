"""Any document, well-formed but for what it says: values of every type where another is expected."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator
from typing import Any

import msgpack
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fuzz.formats import canonical, with_checksum
from fuzz.loop import tried
from fuzz.targets import TARGETS
from support.strategies import documents

WRITERS: dict[str, Callable[[Any], bytes]] = {
    "camera": msgpack.packb,
    "lidar": msgpack.packb,
    "ego": msgpack.packb,
    "command": lambda document: b"\x02\x00" + canonical(document),
    "worker": lambda document: b"\x01" + msgpack.packb(document),
    "state": lambda document: with_checksum(canonical({"pairs": {"front": document}})),
    "baseline": lambda document: with_checksum(canonical({"pairs": {"front": document}})),
    "configuration": lambda document: json.dumps(document).encode(),
    "manifest": lambda document: json.dumps(document).encode(),
    "model_card": lambda document: json.dumps(document).encode(),
}

NAMES = {
    "camera": ("stamp_ns", "frame_id", "image", "format", "data", "depth", "sequence"),
    "lidar": ("stamp_ns", "frame_id", "points", "ring", "intensity", "time_offset_s"),
    "ego": ("stamp_ns", "frame_id", "linear_mps", "angular_radps"),
    "command": ("to", "release"),
    "worker": ("id", "result", "refused", "code", "text", "observation"),
    "state": ("T_camera_lidar", "latest", "accepted", "track", "monitor", "changes", "rig_sha256"),
    "baseline": ("T_camera_lidar", "scene", "limits", "monitor", "rotation", "pose"),
    "configuration": ("pairs", "zenoh", "state", "vehicle", "limits", "name", "camera"),
    "manifest": ("pair", "camera", "T_camera_lidar", "frames", "mask", "image"),
    "model_card": ("name", "card", "input", "output", "size", "licence", "source"),
}
"""Fields that a document of the kind may have: most draws put a wrong value into a right one."""


@pytest.fixture(autouse=True, scope="module")
def _silent() -> Iterator[None]:
    logging.disable()
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize("name", WRITERS)
@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(data=st.data())
def test_any_document_ends_in_a_value_or_an_error_of_ours(
    tmp_path_factory: pytest.TempPathFactory, name: str, data: st.DataObject
) -> None:
    folder = tmp_path_factory.getbasetemp() / f"documents-{name}"
    folder.mkdir(exist_ok=True)
    document = data.draw(documents(NAMES[name]))
    assert tried(TARGETS[name], WRITERS[name](document), folder).problem is None
