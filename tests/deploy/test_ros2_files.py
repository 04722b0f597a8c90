"""What the files for the ROS side say, against the names that the service publishes."""

from __future__ import annotations

import re
from typing import Any

import pytest

from coec.config import Config, RosConfig, parse_yaml
from coec.io.ros import messages
from coec.io.ros.message_encoding import MAX_RESIDUAL_PX, DiagnosticLevel
from coec.schemas import keys
from coec.schemas.replies import ROS_LEVELS
from conftest import REPOSITORY

FILES = REPOSITORY / "deploy" / "ros2"
PAGE = (REPOSITORY / "docs" / "ros2.md").read_text()


def shipped(name: str) -> Any:
    return parse_yaml((FILES / name).read_text())


def pairs() -> list[str]:
    return [pair["name"] for pair in shipped("coec.yaml")["pairs"]]


def test_the_configuration_is_the_one_of_the_page_and_speaks_to_ros() -> None:
    (shown,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    document = shipped("coec.yaml")

    assert parse_yaml(shown) == document
    assert len([line for line in shown.splitlines() if not line.startswith("ros:")]) <= 8 - 1
    assert RosConfig.model_validate(document["ros"]).publish == ("diagnostics", "tf_static", "camera_info", "overlay")
    assert set(document) <= set(Config.model_fields)


def test_the_aggregator_takes_every_status_of_the_service() -> None:
    (analyzer,) = (
        value
        for value in shipped("diagnostic-aggregator.yaml")["analyzers"]["ros__parameters"].values()
        if isinstance(value, dict)
    )
    assert analyzer["type"] == "diagnostic_aggregator/GenericAnalyzer"
    assert analyzer["expected"] == [keys.status_name(pair) for pair in pairs()]
    assert all(name.startswith(tuple(analyzer["startswith"])) for name in analyzer["expected"])
    assert analyzer["timeout"] == 5.0


def test_autowares_units_name_the_statuses_as_node_and_name() -> None:
    units = {unit["path"]: unit for unit in shipped("autoware-graph.yaml")["units"]}
    diags = [unit for unit in units.values() if unit["type"] == "diag"]
    (whole,) = (unit for unit in units.values() if unit["type"] == "and")

    assert [f"{unit['node']}: {unit['name']}" for unit in diags] == [keys.status_name(pair) for pair in pairs()]
    assert {child["link"] for child in whole["list"]} == {unit["path"] for unit in diags}


def rows(title: str) -> list[list[str]]:
    """Of the first table under a heading of the page."""
    _, _, below = PAGE.partition(f"# {title}\n")
    lines = below[below.index("|") :].split("\n\n")[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_the_page_names_topics_and_types_as_they_are_published() -> None:
    published = {
        "diagnostics": (keys.DIAGNOSTICS, messages.DIAGNOSTICS),
        "tf_static": (keys.TF_STATIC, messages.TF),
        "camera_info": (keys.camera_info_topic("PAIR"), messages.CAMERA_INFO),
        "overlay": (keys.overlay_topic("PAIR"), messages.COMPRESSED_IMAGE),
    }
    reported = {row[0].strip("`"): (row[1].strip("`"), row[2].strip("`")) for row in rows("Published topics")}
    assert {name: (topic.replace("<pair>", "PAIR"), kind) for name, (topic, kind) in reported.items()} == published


def test_the_page_says_the_level_of_every_state() -> None:
    reported = {row[0]: set(re.findall(r"`(\w+)`", row[1])) for row in rows("/diagnostics")}
    assert reported == {
        level.name: {state for state, number in ROS_LEVELS.items() if number == level} for level in DiagnosticLevel
    }


def test_the_page_says_the_defaults_and_limits() -> None:
    assert f"beyond {MAX_RESIDUAL_PX} px" in PAGE
    assert f"`<camera frame>{RosConfig().calibrated_suffix}`" in PAGE


@pytest.mark.parametrize(
    ("name", "token"),
    [("shuttle-7", "shuttle_7"), ("7-seater", "_7_seater"), ("front.left--top", "front_left_top"), ("a_b", "a_b")],
)
def test_names_become_tokens_of_ros(name: str, token: str) -> None:
    assert keys.ros_name(name) == token
    assert re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", keys.overlay_topic(name))
