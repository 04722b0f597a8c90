"""How many independent looks frames are worth: many on a drive past facades, few on a motorway, one of a vehicle that
stands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.conftest import window_of
from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.objective.edges import (
    EdgeCue,
    build_edges,
    effective_sample_size,
    independent_samples_at,
    intraclass_correlation,
)
from coec.calibration.types import Window
from coec.config import LimitsConfig
from coec.geometry.edges.alignment import EdgeFrames, frame_alignment
from coec.io.images import GreyImages
from support.simulated_drives import rendered_source

FRAMES = 10
MOTORWAY = "sim:seed=7&seconds=12&camera_hz=0.5&lidar_hz=0.5&scene=highway&camera=pinhole640x400&lidar=64"


def selected(edges: EdgeFrames, frames: list[int]) -> EdgeFrames:
    """The frames with these numbers, in this order; a number may come again."""
    first = edges.first_point
    points = np.concatenate([np.arange(first[f], first[f + 1]) for f in frames])
    counts = np.diff(first)[frames]
    return replace(
        edges,
        xyz_m=np.ascontiguousarray(edges.xyz_m[:, points]),
        weight=edges.weight[points],
        first_point=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        maps=np.ascontiguousarray(edges.maps[frames]),
    )


def sharp_edges_of(window: Window) -> EdgeFrames:
    rig, pairs, images = window.rig, window.pairs, GreyImages(LimitsConfig())
    return build_edges(
        pairs,
        lambda frame, points: compensate(pairs[frame], rig, enabled=True, selection=points),
        (images.grey(pair.camera) for pair in pairs),
        rig,
    ).sharp


def test_each_place_of_a_drive_past_facades_is_an_observation(sharp_edges: EdgeCue, sharp_street: Window) -> None:
    seen = independent_samples_at(sharp_edges.sharp, sharp_street.T_camera_lidar_start)
    assert 0.8 * FRAMES < seen.count <= FRAMES


@pytest.mark.parametrize("frames", [FRAMES, 25])
def test_frames_of_a_standing_vehicle_are_one_observation(
    frames: int, sharp_edges: EdgeCue, sharp_street: Window
) -> None:
    pose = sharp_street.T_camera_lidar_start
    once = independent_samples_at(selected(sharp_edges.sharp, [0]), pose)
    standing = independent_samples_at(selected(sharp_edges.sharp, [0] * frames), pose)
    assert once.count == 1.0
    assert standing.count == pytest.approx(1.0, abs=1e-9)
    assert standing.significance == pytest.approx(once.significance, rel=1e-4)


def test_a_few_frames_are_as_significant_as_ten_of_their_kind(sharp_edges: EdgeCue, sharp_street: Window) -> None:
    """Otherwise a limit would ask for a number of frames, not for what they show."""
    pose = sharp_street.T_camera_lidar_start
    ten = independent_samples_at(sharp_edges.sharp, pose).significance
    assert independent_samples_at(selected(sharp_edges.sharp, [0, 3, 6, 8]), pose).significance == pytest.approx(
        ten, rel=0.25
    )


def test_a_motorway_is_in_between() -> None:
    window = window_of(rendered_source(MOTORWAY))
    count = independent_samples_at(sharp_edges_of(window), window.T_camera_lidar_start).count
    assert 1.2 < count < 0.7 * len(window.pairs)


@pytest.mark.parametrize("times", [2, 3])
def test_the_same_frames_again_are_no_further_observations(
    sharp_edges: EdgeCue, sharp_street: Window, times: int
) -> None:
    frames, pose = selected(sharp_edges.sharp, [0, 3, 6]), sharp_street.T_camera_lidar_start
    again = selected(frames, [0, 1, 2] * times)
    # Edges of one frame fit those of others a little worse than chance does, which is cut off without copies.
    assert independent_samples_at(again, pose).count == pytest.approx(
        independent_samples_at(frames, pose).count, rel=0.15
    )


def test_frames_in_reverse_are_the_same_observations(sharp_edges: EdgeCue, sharp_street: Window) -> None:
    frames, pose = selected(sharp_edges.sharp, [0, 3, 6, 8]), sharp_street.T_camera_lidar_start
    backwards = independent_samples_at(selected(frames, [3, 2, 1, 0]), pose)
    assert backwards.count == independent_samples_at(frames, pose).count
    assert backwards.significance == pytest.approx(independent_samples_at(frames, pose).significance, rel=1e-6)


def test_independent_frames_keep_their_significance(sharp_edges: EdgeCue, sharp_street: Window) -> None:
    pose = sharp_street.T_camera_lidar_start
    seen = independent_samples_at(sharp_edges.sharp, pose)
    whole = frame_alignment(sharp_edges.sharp, pose).significance
    assert seen.significance == pytest.approx(whole * np.sqrt(seen.count / FRAMES))


def agreement(alike: float, own: float = 5.0) -> NDArray[np.float64]:
    """(F, F), the agreement with other frames being so much of that with the own one."""
    return own * (alike + (1.0 - alike) * np.eye(FRAMES))


def test_the_more_stands_still_the_fewer_observations() -> None:
    shares = [intraclass_correlation(agreement(alike)) for alike in np.linspace(0.0, 1.0, 21)]
    counts = [effective_sample_size(alike, FRAMES) for alike in shares]
    assert counts[0] == FRAMES
    assert counts[-1] == pytest.approx(1.0)
    assert (np.diff(counts) < 0.0).all()


@pytest.mark.parametrize("alike", [-3.0, -0.2, 1.5])
def test_observations_are_never_more_than_frames_nor_less_than_one(alike: float) -> None:
    count = effective_sample_size(intraclass_correlation(agreement(alike)), FRAMES)
    assert count == (FRAMES if alike < 0.0 else 1.0)


@pytest.mark.fault("frames that agree nowhere", "they count as one look, and no number ends the service")
@pytest.mark.parametrize("own", [0.0, -2.0])
def test_frames_that_do_not_agree_with_themselves_are_one_observation(own: float) -> None:
    assert effective_sample_size(intraclass_correlation(agreement(0.3, own)), FRAMES) == 1.0
