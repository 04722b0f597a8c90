"""Two extrinsics in pictures: what is drawn, what stands beside it, what is left out."""

from __future__ import annotations

from dataclasses import replace
from math import radians
from pathlib import Path

import cv2
import numpy as np
import pytest

from coec.geometry import se3
from coec.reports.close_ups import Caption
from coec.reports.page import Compare, Pictures, Text
from coec.reports.pictures import Comparison, write_comparison
from support import scenes


def rendered(folder: Path, observations: float | None) -> Comparison:
    window = scenes.post_window((-8.0, 8.0))
    window, truth = replace(window, pairs=window.pairs * 4), window.T_camera_lidar_start
    moved = se3.perturb(truth, np.array([0.0, radians(0.5), 0.0, 0.0, 0.0, 0.0]))
    return write_comparison(folder, window, moved, truth, Caption("start", "result"), True, observations)


@pytest.mark.parametrize("observations", [None, 4.0, 2.0])
def test_a_map_of_residuals_is_rendered_where_the_pairs_determine_of_several_scenes(
    tmp_path: Path, observations: float | None
) -> None:
    comparison = rendered(tmp_path, observations)
    assert [path.name for path in comparison.files] == [
        "overlay_before.png", "overlay_after.png", "close_ups.png", "residuals.png"
    ]  # fmt: skip
    assert all(path.is_file() for path in comparison.files)
    assert comparison.left_out == ()


def test_it_is_left_out_with_the_reason_where_they_show_one_again_and_again(tmp_path: Path) -> None:
    comparison = rendered(tmp_path, 1.3)
    assert not (tmp_path / "residuals.png").exists()
    (why,) = comparison.left_out
    assert "4 pairs that are worth 1.3 independent looks" in why
    assert Text((why,), quiet=True) in comparison.blocks


def test_what_a_slider_moves_over_has_no_text_in_it(tmp_path: Path) -> None:
    comparison = rendered(tmp_path, None)
    slid, near = comparison.blocks
    assert isinstance(slid, Compare)
    assert isinstance(near, Pictures)
    assert "start" in slid.before.caption
    assert "result" in slid.after.caption
    file = cv2.imread(str(tmp_path / "overlay_before.png"))
    shown = cv2.imdecode(np.frombuffer(slid.before.data, np.uint8), cv2.IMREAD_COLOR)
    assert file is not None
    assert shown is not None
    assert file.shape[0] > shown.shape[0], "the file has its title"
    below = file[-shown.shape[0] :]
    assert np.corrcoef(below.ravel(), shown.ravel())[0, 1] > 0.9, "and the same picture below it"
