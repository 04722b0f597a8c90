"""The picture of a rig from above."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from coec_lab.demo.demo_plots import PlottedEdge, PlottedSensor, label_of, rig_from_above


def placed(x_m: float, y_m: float) -> NDArray[np.float64]:
    transform = np.eye(4)
    transform[:3, 3] = x_m, y_m, 1.7
    return transform


FRONT = PlottedSensor("front", "camera", placed(2.0, 0.0), 190.0, "calibrated", 0.002)
LEFT = PlottedSensor("left", "camera", placed(1.0, 0.8), 190.0, "calibrated", 0.002)
ROOF = PlottedSensor("roof", "lidar", placed(1.0, 0.0), 360.0, "calibrated", 0.002)
EDGES = (PlottedEdge("front", "roof", 0.02, 0.1), PlottedEdge("left", "roof", 0.02, 0.1))


def pixels(*sensors: PlottedSensor, edges: tuple[PlottedEdge, ...] = EDGES) -> NDArray[np.int64]:
    picture = cv2.imdecode(np.frombuffer(rig_from_above(sensors, edges, "title"), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return picture.astype(np.int64)


def strong(picture: NDArray[np.int64], channel: int) -> NDArray[np.bool_]:
    """Pixels of which this channel (BGR) is far above the others."""
    others = np.delete(picture, channel, axis=2).max(axis=2)
    return np.asarray(picture[..., channel] > others + 90)


def test_who_moved_is_marked_in_red_where_it_sits() -> None:
    calm = strong(pixels(FRONT, LEFT, ROOF), 2)
    front = strong(pixels(replace(FRONT, state="camera_moved", probability=0.98, moved_deg=1.0), LEFT, ROOF), 2)
    left = strong(pixels(FRONT, replace(LEFT, state="camera_moved", probability=0.98, moved_deg=1.0), ROOF), 2)
    body = (slice(0, int(0.9 * len(calm))), slice(0, int(0.85 * calm.shape[1])))  # without legend and colour bar
    assert calm[body].sum() < 30
    assert min(front[body].sum(), left[body].sum()) > 150
    (front_y, front_x), (left_y, left_x) = (np.argwhere(red[body]).mean(axis=0) for red in (front, left))
    assert front_y < left_y  # further ahead is higher
    assert left_x < front_x  # further left is further left


def test_an_edge_is_red_when_it_is_sure_and_not_when_it_cannot_decide() -> None:
    def red(edge: PlottedEdge) -> int:
        return int(strong(pixels(FRONT, LEFT, ROOF, edges=(edge, EDGES[1])), 2).sum())

    sure, faint = PlottedEdge("front", "roof", 1.0, 0.1), PlottedEdge("front", "roof", 1.0, 2.0)
    assert red(sure) > red(faint) + 200
    for nothing in (PlottedEdge("front", "roof", np.nan, 0.1), PlottedEdge("front", "roof", 1.0, 0.0)):
        assert nothing.sigmas == 0.0


def test_text_report_state_size_and_probability_and_never_certainty() -> None:
    moved = PlottedSensor("roof", "lidar", placed(1.0, 0.0), 360.0, "lidar_moved", 1.0, 1.04)
    assert label_of(moved).splitlines() == ["roof", "moved by 1°", "> 99 %"]
    assert label_of(replace(moved, state="undecided", probability=0.42)).splitlines() == ["roof", "undecided", "42 %"]
    assert label_of(replace(moved, state="unknown", probability=None)).splitlines() == ["roof", "unknown"]
    assert label_of(ROOF) == "roof"
    assert label_of(replace(ROOF, state="undecided", probability=0.0)).splitlines()[-1] == "< 1 %"


def test_equal_rigs_give_equal_bytes_and_an_edge_to_nowhere_is_refused() -> None:
    assert rig_from_above((FRONT, LEFT, ROOF), EDGES, "t") == rig_from_above((FRONT, LEFT, ROOF), EDGES, "t")
    with pytest.raises(ValueError, match="nose"):
        rig_from_above((FRONT, ROOF), (PlottedEdge("nose", "roof", 1.0, 0.1),), "t")
