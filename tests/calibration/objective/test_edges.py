"""The edge cue of a window: its levels, whatever the camera, and its points."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.objective.edges import (
    BANDS,
    CELL_RAD,
    COARSEST_BLUR_RAD,
    MAX_PIXELS,
    MOST_STRENGTH,
    RANGE,
    RANKED_POINTS,
    REFLECTANCE,
    THINNED_POINTS,
    EdgeCue,
    EdgesAlone,
    build_edges,
)
from coec.calibration.types import Rig, Window
from coec.config import LimitsConfig
from coec.errors import CalibrationError
from coec.geometry import se3
from coec.geometry.cameras import Camera, build
from coec.geometry.edges.alignment import EdgeFrames, frame_alignment, significances
from coec.geometry.edges.charts import CELLS_PER_BLUR, MAX_CHART_POINTS
from coec.geometry.edges.image_edges import BLUR_SIGMA_PX, STRENGTH_STEPS, VOID, EdgeScales
from coec.geometry.edges.range_edges import range_edges
from coec.geometry.edges.scan_lines import scan_lines
from coec.geometry.projection import project, unproject
from coec.io.images import GreyImages

GREY = GreyImages(LimitsConfig())

Points = NDArray[np.float32]


def with_camera(window: Window, camera: Camera) -> EdgeCue:
    """The edges of one pair, seen through another lens in an image of noise."""
    pair, rig = window.pairs[0], replace(window.rig, camera=camera, mask=None)
    grey = np.random.default_rng(0).integers(0, 255, (camera.height, camera.width)).astype(np.uint8)
    return build_edges([pair], lambda _, selected: pair.lidar.xyz_m[selected], [grey], rig)


def pinhole(width: int, height: int, focal_px: float) -> Camera:
    return build(
        "pinhole", width=width, height=height, fx=focal_px, fy=focal_px, cx=(width - 1) / 2, cy=(height - 1) / 2
    )


CAMERAS = {
    "common": pinhole(1280, 480, 700.0),
    "odd": pinhole(701, 333, 400.0),
    "narrow": pinhole(1024, 512, 3000.0),
    "coarse": pinhole(160, 120, 100.0),
    "huge": pinhole(3200, 2400, 1800.0),
    "fisheye": build(
        "kannala_brandt", width=700, height=700, fx=220.0, fy=220.0, cx=350.0, cy=350.0, k1=0.0, k2=0.0, k3=0.0, k4=0.0
    ),
}


def seen_blur_rad(camera: Camera) -> float:
    """The angle of the blur's pixels next to the optical axis."""
    (axis,), _ = project(camera, np.array([[0.0, 0.0, 1.0]]))
    rays, _ = unproject(camera, np.stack([axis, axis + np.array([BLUR_SIGMA_PX, 0.0])]))
    return float(np.linalg.norm(np.cross(rays[0], rays[1])))


@pytest.mark.parametrize(
    "lens", [pytest.param(name, marks=pytest.mark.slow) if name in ("common", "huge") else name for name in CAMERAS]
)
def test_levels_double_and_end_at_the_same_angle_for_any_lens(street: Window, lens: str) -> None:
    camera = CAMERAS[lens]
    edges = with_camera(street, camera)
    assert len(edges.bands) == len(edges.band_blur_rad) == BANDS
    assert edges.band_blur_rad == pytest.approx([edges.band_blur_rad[0] * 2**k for k in range(BANDS)])
    for frames, blur_rad in zip(edges.bands, edges.band_blur_rad, strict=True):
        assert frames.maps.shape == (1, frames.camera.height, frames.camera.width)
        assert blur_rad == pytest.approx(seen_blur_rad(frames.camera), rel=0.01)
    assert edges.blur_rad == pytest.approx(seen_blur_rad(edges.sharp.camera), rel=0.01)
    assert edges.blur_rad <= edges.band_blur_rad[0]
    assert edges.whole.maps.shape[1:] == tuple(side // 2 for side in edges.sharp.maps.shape[1:])
    assert edges.sharp.maps.size <= MAX_PIXELS
    # Unless the image is too coarse for it.
    if seen_blur_rad(camera) * 2 ** (BANDS - 1) < COARSEST_BLUR_RAD:
        assert COARSEST_BLUR_RAD <= edges.band_blur_rad[-1] < 2.0 * COARSEST_BLUR_RAD


def test_maps_are_those_of_the_images_with_strong_edges_cut_off(sharp_street: Window, sharp_edges: EdgeCue) -> None:
    rig = sharp_street.rig
    lit = rig.mask if rig.mask is not None else np.ones((rig.camera.height, rig.camera.width), np.bool_)
    scales = EdgeScales(lit, 0, BANDS - 1, rig.T_camera_lidar_nominal[:2, 2])
    most = np.int8(MOST_STRENGTH * STRENGTH_STEPS)
    for f in (0, len(sharp_street.pairs) - 1):
        pyramid = scales.pyramid(GREY.grey(sharp_street.pairs[f].camera))
        np.testing.assert_array_equal(sharp_edges.sharp.maps[f], np.minimum(pyramid.sharp, most))
        np.testing.assert_array_equal(sharp_edges.whole.maps[f], np.minimum(pyramid.whole, most))
        for frames, band in zip(sharp_edges.bands, pyramid.bands, strict=True):
            np.testing.assert_array_equal(frames.maps[f], np.minimum(band, most))


def test_points_are_the_range_edges_where_they_were_at_the_exposure(sharp_street: Window, sharp_edges: EdgeCue) -> None:
    edges = sharp_edges.kinds_alone[RANGE].sharp
    first = edges.first_point
    for f, pair in enumerate(sharp_street.pairs):
        result = range_edges(scan_lines(pair.lidar.xyz_m, pair.lidar.ring))
        cloud = compensate(pair, sharp_street.rig, enabled=True)
        at_m = cloud[result.index] + result.shift_m
        np.testing.assert_array_equal(edges.xyz_m[:, first[f] : first[f + 1]].T, at_m)
        weight = edges.weight[first[f] : first[f + 1]]
        assert (weight <= result.weight).all()
        # What has no neighbour within a cell's diagonal keeps its weight.
        near = pair.lidar.xyz_m[result.index]
        rays = near / np.linalg.norm(near, axis=1, keepdims=True)
        alone = (rays @ rays.T > np.cos(2.0 * CELL_RAD)).sum(axis=1) == 1
        np.testing.assert_array_equal(weight[alone], result.weight[alone])
        assert (weight[~alone] < result.weight[~alone]).any()


def with_reflectance(window: Window, values: Callable[[int, Points], NDArray[np.float32] | None]) -> EdgeCue:
    """The edges of a window whose sweeps have other reflectances: by their index and points (N, 3)."""
    pairs = [
        replace(pair, lidar=replace(pair.lidar, intensity=values(index, pair.lidar.xyz_m)))
        for index, pair in enumerate(window.pairs)
    ]
    greys = (GREY.grey(pair.camera) for pair in pairs)
    return build_edges(
        pairs, lambda f, selected: compensate(pairs[f], window.rig, enabled=True, selection=selected), greys, window.rig
    )


def test_the_weight_of_a_kind_of_edges_is_its_mean_strength(sharp_street: Window, sharp_edges: EdgeCue) -> None:
    truth = sharp_street.T_camera_lidar_start
    balanced = sharp_edges.balanced_at(truth)
    band = balanced.bands[0]
    whole = frame_alignment(band, truth).significance
    by_kind = balanced.significances(band, truth)
    assert sharp_edges.count(REFLECTANCE) > 100
    assert min(by_kind) > 5.0
    # With the best weights the squares of both add, and any other weights give less.
    assert whole == pytest.approx(np.linalg.norm(by_kind), rel=1e-3)
    for factors in ([1.0, 0.5], [0.5, 1.0], [1.0, 0.0]):
        weight = np.array(factors, np.float32)[balanced.kinds[1]] * band.weight
        assert frame_alignment(replace(band, weight=weight), truth).significance < whole
    assert balanced.effective_count > balanced.count(RANGE)


def test_reflectance_of_other_places_weighs_nothing_and_none_changes_nothing(sharp_street: Window) -> None:
    truth, rng = sharp_street.T_camera_lidar_start, np.random.default_rng(0)
    known = [pair.lidar.intensity for pair in sharp_street.pairs if pair.lidar.intensity is not None]
    shuffled = with_reflectance(
        sharp_street, lambda f, xyz_m: np.roll(np.resize(known[f - 1], len(xyz_m)), int(rng.integers(100, 10_000)))
    )
    assert shuffled.count(REFLECTANCE) > 100
    balance = shuffled.balanced_at(truth).balance
    assert balance[RANGE] == 1.0
    assert balance[REFLECTANCE] < 0.2
    without = with_reflectance(sharp_street, lambda *_: None)
    constant = with_reflectance(sharp_street, lambda _, xyz_m: np.full(len(xyz_m), 3.0, np.float32))
    for cue in (without, constant):
        assert cue.count(REFLECTANCE) == 0
        assert cue.balanced_at(truth) is cue
        np.testing.assert_array_equal(cue.sharp.weight, without.sharp.weight)
        assert [len(alone.sharp.weight) for alone in cue.kinds_alone] == [len(without.sharp.weight)]


def test_before_a_pose_is_known_reflectance_weighs_no_more_than_range(sharp_street: Window) -> None:
    """Stripes on everything: several times as many edges as there are silhouettes."""

    def striped(_: int, xyz_m: Points) -> NDArray[np.float32]:
        stripes = np.degrees(np.arctan2(xyz_m[:, 1], xyz_m[:, 0])) % 4.0 < 2.0
        return (100.0 * stripes + np.arange(len(stripes)) % 3).astype(np.float32)

    cue = with_reflectance(sharp_street, striped)
    assert cue.count(REFLECTANCE) > 2 * cue.count(RANGE)
    square = [
        np.square(cue.sharp.weight[cue.kinds[0] == kind], dtype=np.float64).sum() for kind in (RANGE, REFLECTANCE)
    ]
    assert square[REFLECTANCE] == pytest.approx(square[RANGE], rel=1e-4)


def test_charts_are_of_the_coarse_bands_with_all_of_their_points_or_some(sharp_edges: EdgeCue) -> None:
    for charts, band, blur_rad in zip(
        sharp_edges.charts, sharp_edges.bands[:0:-1], sharp_edges.band_blur_rad[:0:-1], strict=True
    ):
        assert charts.cells_per_unit == pytest.approx(2.0 * CELLS_PER_BLUR / blur_rad)
        np.testing.assert_array_equal(charts.xyz_m, band.xyz_m)
        np.testing.assert_array_equal(np.bincount(charts.frame), np.diff(band.first_point))
    for thinned, charts in zip(sharp_edges.thinned, sharp_edges.charts, strict=True):
        assert thinned.xyz_m.shape[1] == THINNED_POINTS < charts.xyz_m.shape[1]
        assert thinned.cells is charts.cells
        # Every frame keeps its share, within four standard deviations of a draw.
        share, of_frames = THINNED_POINTS / charts.xyz_m.shape[1], np.bincount(charts.frame)
        deviation = np.sqrt(share * (1.0 - share) / of_frames)
        assert (np.abs(np.bincount(thinned.frame) / of_frames - share) < 4.0 * deviation).all()


def test_basins_are_ranked_with_some_of_the_points_where_there_are_very_many(
    street: Window, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert RANKED_POINTS <= MAX_CHART_POINTS
    monkeypatch.setattr("coec.calibration.objective.edges.RANKED_POINTS", 200)
    edges = with_camera(street, CAMERAS["coarse"])
    assert [charts.xyz_m.shape[1] for charts in (*edges.charts, *edges.thinned)] == [200] * 4
    assert [band.xyz_m.shape[1] for band in edges.bands] == [200] * BANDS
    assert edges.sharp.xyz_m.shape[1] > 200
    # The ones that are kept are the same everywhere, with their weights.
    every = {tuple(column) for column in np.vstack([edges.sharp.xyz_m, edges.sharp.weight]).T}
    assert all(tuple(column) in every for column in np.vstack([edges.bands[0].xyz_m, edges.bands[0].weight]).T)


@pytest.mark.parametrize("grown", [(1, 0), (0, 1), (-1, 0), (0, -1)])
def test_an_image_of_another_size_is_refused(street: Window, grown: tuple[int, int]) -> None:
    pair, camera = street.pairs[0], street.rig.camera
    grey = np.zeros((camera.height + grown[0], camera.width + grown[1]), np.uint8)
    with pytest.raises(CalibrationError, match="px, the camera model"):
        build_edges([pair], lambda _, selected: pair.lidar.xyz_m[selected], [grey], street.rig)


def test_a_mask_hides_pixels_on_every_level(street: Window) -> None:
    camera = street.rig.camera
    mask = np.ones((camera.height, camera.width), np.bool_)
    mask[camera.height // 2 :] = False
    rig: Rig = replace(street.rig, mask=mask)
    pair = street.pairs[0]
    edges = build_edges([pair], lambda _, selected: pair.lidar.xyz_m[selected], [GREY.grey(pair.camera)], rig)
    for frames in (edges.sharp, edges.whole, *edges.bands):
        height = frames.maps.shape[1]
        assert (frames.maps[0, -(height // 2) :] == VOID).all()
        assert (frames.maps[0, : height // 2] != VOID).all()


def test_the_cue_alone_is_an_objective_whose_score_is_the_significance() -> None:
    camera = build("pinhole", width=40, height=30, fx=30.0, fy=30.0, cx=19.5, cy=14.5)
    rng = np.random.default_rng(7)
    # Pixels at integers, where both ways to look up a pixel agree.
    u, v = rng.integers(2, 37, 50), rng.integers(2, 27, 50)
    xyz = np.stack([(u - 19.5) / 30.0, (v - 14.5) / 30.0, np.ones(50)]).astype(np.float32)
    maps = np.repeat(rng.integers(-40, 40, (2, 30, 1)), 40, axis=2).astype(np.int8)
    frames = EdgeFrames(camera, xyz, np.ones(50, np.float32), np.array([0, 30, 50]), maps)
    alone = EdgesAlone(frames, 0.01)
    at = alone.evaluate(np.eye(4))
    assert at.score == pytest.approx(float(significances(frames, np.eye(4)[None])[0]), abs=1e-3)
    assert at.frame_scores.shape == (2,)
    assert at.frame_scores.mean() == pytest.approx(at.score)
    assert alone.step_rad == 0.01
    assert alone.evaluate(se3.exp(np.array([0, 3.0, 0, 0, 0, 0]))).score == 0.0
