"""What a configuration may say of ROS."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from coec.config import Config, RosConfig
from support.vehicles import pair_configuration


def document(ros: dict[str, Any], middleware: str = "rmw_zenoh", *names: str) -> dict[str, Any]:
    """Of a service with pairs of these names."""
    whole = pair_configuration(Path("state")).model_dump(mode="json")
    pairs = [{**whole["pairs"][0], "name": name} for name in names or ("front",)]
    return {**whole, "pairs": pairs, "middleware": middleware, "ros": ros}


def test_ros_is_reported_nothing_unless_requested() -> None:
    assert RosConfig().publish == ()
    assert not RosConfig().replace_camera_frames


@pytest.mark.parametrize("middleware", ["rmw_zenoh", "ros2dds"])
def test_one_line_makes_a_service_speak_to_ros(middleware: str) -> None:
    selected = ["diagnostics", "tf_static", "camera_info", "overlay"]
    assert Config.model_validate(document({"publish": selected}, middleware)).ros.publish == tuple(selected)


@pytest.mark.parametrize(
    ("document", "complaint"),
    [
        (document({"publish": ["diagnostics"]}, "native"), "set `middleware` to `rmw_zenoh` or `ros2dds`"),
        (document({"publish": ["diagnostics", "diagnostics"]}), "something twice"),
        (document({"publish": ["tf"]}), "Input should be 'diagnostics'"),
        (document({"publish": ["overlay"]}, "rmw_zenoh", "front-left", "front.left"), "must differ in letters"),
        (document({"calibrated_suffix": ""}), "calibrated_suffix"),
        (document({"calibrated_suffix": "/x"}), "calibrated_suffix"),
    ],
)
def test_what_cannot_be_determined_is_refused_with_a_reason(document: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ValidationError, match=complaint):
        Config.model_validate(document)
