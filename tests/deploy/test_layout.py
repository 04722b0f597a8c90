"""The layout for viewers: it can be read, and everything that it shows is served."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from coec.cli.view import LAYOUT
from coec.io import viewer_scene
from coec.io.viewer_scene import POINTS_TOPICS, TOPIC_DESCRIPTIONS, DisplayedPose, timeline_schema
from conftest import REPOSITORY


def layout() -> dict[str, Any]:
    document: dict[str, Any] = json.loads((REPOSITORY / LAYOUT).read_text())
    return document


def texts_in(value: Any) -> Iterator[str]:
    """Keys and values, all of them."""
    if isinstance(value, dict):
        for key, one in value.items():
            yield key
            yield from texts_in(one)
    elif isinstance(value, list):
        for one in value:
            yield from texts_in(one)
    elif isinstance(value, str):
        yield value


def panels_in(node: Any) -> Iterator[str]:
    if isinstance(node, str):
        yield node
    else:
        assert node["direction"] in ("row", "column")
        assert 0 < node["splitPercentage"] < 100
        yield from panels_in(node["first"])
        yield from panels_in(node["second"])


def test_every_panel_has_a_place_and_every_place_a_panel() -> None:
    placed = list(panels_in(layout()["layout"]))
    assert sorted(placed) == sorted(layout()["configById"])
    assert {name.partition("!")[0] for name in placed} == {
        "Image", "3D", "StateTransitions", "Plot", "RawMessages", "RosOut",
    }  # fmt: skip


def test_every_topic_in_it_is_served_and_every_topic_served_is_in_it() -> None:
    named = {text.partition(".")[0] for text in texts_in(layout()["configById"]) if text.startswith("/")}
    assert named <= set(TOPIC_DESCRIPTIONS), "a topic of the layout is not served"
    assert set(TOPIC_DESCRIPTIONS) - named == {viewer_scene.TRANSFORMS_TOPIC}, (
        "transforms are taken by every 3D panel, unasked"
    )


def test_every_field_in_it_is_one_of_the_timeline() -> None:
    paths = [text for text in texts_in(layout()["configById"]) if text.startswith(f"{viewer_scene.HEALTH_TOPIC}.")]
    assert len(paths) > 5
    for path in paths:
        node = timeline_schema()
        for name in path.split(".")[1:]:
            node = node["properties"][name]
        assert node["type"] in ("string", "number"), path


def test_an_image_waits_for_the_points_that_it_shows_and_for_no_others() -> None:
    """A viewer that synchronises shows nothing until every topic that is visible has a message with the stamp."""
    images = [panel["imageMode"] for name, panel in layout()["configById"].items() if name.startswith("Image!")]
    visible = []
    for panel in images:
        assert (panel["imageTopic"], panel["synchronize"]) == (viewer_scene.IMAGE_TOPIC, True)
        assert set(panel["annotations"]) == set(POINTS_TOPICS.values())
        visible += [topic for topic, one in panel["annotations"].items() if one["visible"]]
    assert visible == [POINTS_TOPICS[DisplayedPose.SERVED], POINTS_TOPICS[DisplayedPose.CANDIDATE]]
