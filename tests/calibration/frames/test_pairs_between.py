"""Pairs between those of a window: far enough apart, in so many bytes, and whole in the lines that are kept."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.frames import window
from coec.calibration.frames.window import BetweenPairs, thinned_sweep
from coec.calibration.types import CameraFrame, EncodedImage, FramePair, ImageFormat, LidarFrame
from coec.config import WindowConfig
from coec.errors import DecodeError
from coec.geometry.edges.range_edges import range_edges
from coec.geometry.edges.scan_lines import NEIGHBOUR_RAD, scan_lines

S = 1_000_000_000
FORWARD = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""A camera at the LiDAR, looking along its x axis."""


class AsTheyAre:
    """Nothing of an exposure is too large."""

    def reduced(self, frame: CameraFrame) -> CameraFrame:
        return frame


class Unreadable:
    def reduced(self, frame: CameraFrame) -> CameraFrame:
        raise DecodeError("image_corrupt", f"at {frame.stamp_ns}")


def pair(second: float, image_bytes: int = 100) -> FramePair:
    stamp_ns = round(second * S)
    image = EncodedImage(ImageFormat.JPEG, 4, 3, bytes(image_bytes))
    sweep = LidarFrame(stamp_ns, "lidar", np.array([[5.0, 0.0, 0.0]], np.float32))
    return FramePair(CameraFrame(stamp_ns, "camera", image), sweep)


def picked_s(
    between_pairs: BetweenPairs, seconds: NDArray[np.float64], selected: set[float], image_bytes: int
) -> list[float]:
    result = []
    for second in seconds.tolist():
        if second in selected:
            between_pairs.on_selected(round(second * S))
        elif (thinned := between_pairs.offer(pair(second, image_bytes), FORWARD)) is not None:
            result.append(thinned.stamp_ns / S)
    return result


def started(config: WindowConfig, images: AsTheyAre | Unreadable | None = None) -> BetweenPairs:
    made = BetweenPairs(images or AsTheyAre(), 1.0)
    made.begin(config, 0, round(config.slice_s * S))
    return made


def test_they_lie_so_far_from_the_selected_ones_and_from_each_other() -> None:
    config = WindowConfig(pairs=2, min_pairs=2, slice_s=12.0, between_s=2.0)
    result = picked_s(started(config), np.arange(0.0, 12.0, 0.5), {1.0, 6.5}, 100)
    assert result == [3.0, 5.0, 8.5, 10.5], "before the first pair of a window there is nothing to lie between"


@pytest.mark.parametrize(("slice_s", "between_mib"), [(20.0, 48), (180.0, 0)])
def test_there_are_none_where_pairs_are_near_to_each_other_or_where_none_are_requested(
    slice_s: float, between_mib: int
) -> None:
    config = WindowConfig(pairs=11, min_pairs=2, slice_s=slice_s, between_s=1.0, between_mib=between_mib)
    assert picked_s(started(config), np.arange(0.0, slice_s, 0.5), {0.0}, 100) == []


def test_large_images_are_fewer_and_evenly_spread() -> None:
    config = WindowConfig(pairs=5, min_pairs=2, slice_s=100.0, between_s=1.0, between_mib=1)
    result = picked_s(started(config), np.arange(0.0, 100.0, 0.5), {0.0}, 2**20 // 10 - 100)
    assert len(result) == 10
    assert max(np.diff([*result, 100.0])) <= 11.0


def test_an_image_that_cannot_be_read_is_passed_over() -> None:
    config = WindowConfig(pairs=2, min_pairs=2, slice_s=12.0)
    assert picked_s(started(config, Unreadable()), np.arange(0.0, 12.0, 0.5), {0.0}, 100) == []


def street(rings: int, columns: int, *, numbered: bool) -> LidarFrame:
    """Posts before a wall, all around."""
    azimuth, elevation = np.meshgrid(
        np.linspace(-np.pi, np.pi, columns, endpoint=False), np.radians(np.linspace(-20.0, 5.0, rings))
    )
    range_m = np.where(np.floor(np.degrees(azimuth) / 7.0) % 2 == 0, 8.0, 15.0)
    xyz_m = np.stack(
        [
            range_m * np.cos(elevation) * np.cos(azimuth),
            range_m * np.cos(elevation) * np.sin(azimuth),
            range_m * np.sin(elevation),
        ],
        axis=-1,
    ).reshape(-1, 3)
    ring = np.repeat(np.arange(rings, dtype=np.uint16), columns) if numbered else None
    offset_s = np.tile(np.linspace(0.0, 0.1, columns, dtype=np.float32), rings)
    return LidarFrame(7, "lidar", xyz_m.astype(np.float32), np.ones(len(xyz_m), np.float32), ring, offset_s)


@pytest.mark.parametrize("numbered", [True, False])
def test_range_edges_of_a_thinned_sweep_are_edges_of_the_whole(numbered: bool) -> None:
    whole = street(64, 1800, numbered=numbered)
    thinned = thinned_sweep(whole, FORWARD, np.radians(45.0))
    assert 0.5 * window.POINTS < len(thinned.xyz_m) < 1.2 * window.POINTS
    assert thinned.intensity is None
    assert thinned.time_offset_s is not None
    assert whole.time_offset_s is not None
    places = {point.tobytes(): index for index, point in enumerate(whole.xyz_m)}
    index = np.array([places[point.tobytes()] for point in thinned.xyz_m])
    np.testing.assert_array_equal(thinned.time_offset_s, whole.time_offset_s[index])
    of_whole, of_thinned = (range_edges(scan_lines(sweep.xyz_m, sweep.ring)) for sweep in (whole, thinned))
    result = set(index[of_thinned.index].tolist())
    assert result <= set(of_whole.index.tolist())
    # At the border of what is kept, a neighbour may be missing.
    angle = np.arccos(whole.xyz_m[:, 0] / np.linalg.norm(whole.xyz_m, axis=1))
    retained = set(index[angle[index] < np.radians(45.0) + window.BEYOND_RAD - NEIGHBOUR_RAD].tolist())
    seen = retained & set(of_whole.index.tolist())
    assert seen <= result, "none of the lines that are kept is torn"
    assert len(seen) > 100


def test_a_sweep_of_few_points_stays_whole_where_it_is_in_view() -> None:
    sweep = street(16, 400, numbered=True)
    ahead = thinned_sweep(sweep, FORWARD, np.radians(45.0)).xyz_m
    angle = np.arccos(sweep.xyz_m[:, 0] / np.linalg.norm(sweep.xyz_m, axis=1))
    np.testing.assert_array_equal(ahead, sweep.xyz_m[angle <= np.radians(45.0) + window.BEYOND_RAD])
    np.testing.assert_array_equal(thinned_sweep(sweep, FORWARD, np.pi).xyz_m, sweep.xyz_m)


def test_same_input_same_bits() -> None:
    one, other = (thinned_sweep(street(64, 1800, numbered=False), FORWARD, 0.8) for _ in range(2))
    assert one.xyz_m.tobytes() == other.xyz_m.tobytes()
