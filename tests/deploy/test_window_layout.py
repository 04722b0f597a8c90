"""The layout for recorded windows: it can be read, and everything that it shows is in a window."""

from __future__ import annotations

import json
from typing import Any

import cv2
import numpy as np
import pytest

from coec.io.mcap.windows import write_result
from conftest import REPOSITORY
from deploy.test_layout import panels_in, texts_in
from support.readers import RecordingContents, read_recording
from support.windows import a_result, a_window

LAYOUT = REPOSITORY / "deploy" / "foxglove-window-layout.json"

KNOWN_TO_ALL = {"/tf_static"}
"""Taken by every 3D panel, unasked."""


@pytest.fixture(scope="module")
def layout() -> dict[str, Any]:
    document: dict[str, Any] = json.loads(LAYOUT.read_text())
    return document


@pytest.fixture(scope="module")
def window(tmp_path_factory: pytest.TempPathFactory) -> RecordingContents:
    """Of the pair `front`, with all that a window may hold."""
    path = a_window(tmp_path_factory.mktemp("window") / "front-1.mcap").path
    picture = cv2.imencode(".jpg", np.zeros((48, 64, 3), np.uint8))[1].tobytes()
    write_result(path, a_result(), picture)
    return read_recording(path)


def test_every_panel_has_a_place_and_every_place_a_panel(layout: dict[str, Any]) -> None:
    assert sorted(panels_in(layout["layout"])) == sorted(layout["configById"])


def test_every_topic_in_it_is_in_a_window_and_every_topic_of_a_window_in_it(
    layout: dict[str, Any], window: RecordingContents
) -> None:
    named = {text.partition(".")[0] for text in texts_in(layout["configById"]) if text.startswith("/")}
    assert named == window.counts.keys() - KNOWN_TO_ALL


def test_pictures_are_shown_as_images_and_clouds_as_clouds(layout: dict[str, Any], window: RecordingContents) -> None:
    panels = layout["configById"]
    modes = [panel["imageMode"] for name, panel in panels.items() if name.startswith("Image!")]
    assert next(mode["imageTopic"] for mode in modes) == "/coec/front/overlay"
    assert {window.types[mode["imageTopic"]] for mode in modes} == {"sensor_msgs/msg/CompressedImage"}
    infos = {mode["calibrationTopic"] for mode in modes if "calibrationTopic" in mode}
    assert {window.types[topic] for topic in infos} == {"sensor_msgs/msg/CameraInfo"}
    assert window.types[panels["DiagnosticSummary!coec"]["topicToRender"]] == "diagnostic_msgs/msg/DiagnosticArray"
    assert panels["RawMessages!coec"]["topicPath"] in window.documents
    cloud = next(topic for topic in panels["3D!coec"]["topics"] if topic.endswith("points"))
    coloured_by = panels["3D!coec"]["topics"][cloud]["colorField"]
    assert coloured_by in {field.name for field in window.first[cloud].fields}


def test_every_field_that_is_plotted_is_in_its_message(layout: dict[str, Any], window: RecordingContents) -> None:
    paths = [path["value"] for path in layout["configById"]["Plot!coec-motion"]["paths"]]
    assert len(paths) == 2
    for path in paths:
        topic, *fields = path.split(".")
        value = window.first[topic]
        for name in fields:
            value = getattr(value, name)
        assert isinstance(value, float), path
