"""Pictures: range against the analytic one, shadows, determinism."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("embreex", reason="needs embreex")

from coec.geometry import cameras
from coec.geometry.projection import unproject
from coec_lab.simulation.drive import fisheye
from coec_lab.simulation.mesh import Material, Mesh, box, join, quads
from coec_lab.simulation.render import render_radiance, tone
from coec_lab.simulation.road import build_road
from coec_lab.simulation.scene import Scene, Town
from coec_lab.simulation.weather import sample_sky

PINHOLE = cameras.build("pinhole", width=61, height=41, fx=40.0, fy=40.0, cx=30.0, cy=20.0)
FISHEYE = fisheye(96, 92.5)
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Camera axes in a world whose x is ahead."""


def a_scene(mesh: Mesh, sun: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> Scene:
    sky = replace(sample_sky(0), towards_sun=np.array(sun, np.float32), sun=(1.0, 1.0, 1.0), clouds=0.0)
    return Scene(build_road(0, -10.0, 10.0), sky, np.array([1000.0, 2000.0, 30.0]), mesh, [])


class RenderedView(NamedTuple):
    bgr: NDArray[np.uint8]
    range_m: NDArray[np.float32]


def render_view(scene: Scene, camera: cameras.Camera, pose: NDArray[np.float64], **options: Any) -> RenderedView:
    radiance = render_radiance(scene, camera, pose, **options)
    return RenderedView(tone(radiance.linear, 0.9), radiance.range_m)


def looking_ahead(height_m: float) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, :3] = AHEAD
    pose[:3, 3] = [1000.0, 2000.0, 30.0 + height_m]
    return pose


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_a_wall_and_a_floor_are_as_far_as_geometry_says(camera: cameras.Camera) -> None:
    wall_m, height_m = 7.0, 1.5
    floor = quads([[-50, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]], (0.3, 0.3, 0.3), Material.CONCRETE)
    wall = quads([[[wall_m, -50, 0], [wall_m, 50, 0], [wall_m, 50, 50], [wall_m, -50, 50]]], 0.5, Material.PLASTER)
    view = render_view(a_scene(join([floor, wall])), camera, looking_ahead(height_m))
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    rays, valid = unproject(camera, np.column_stack([u.ravel(), v.ravel()]).astype(float))
    x, y, z = (rays @ AHEAD.T).T
    with np.errstate(divide="ignore", invalid="ignore"):
        to_wall, to_floor = np.where(x > 1e-9, wall_m / x, np.inf), np.where(z < -1e-9, -height_m / z, np.inf)
        in_wall = (np.abs(y * to_wall) < 50) & (height_m + z * to_wall > 0) & (height_m + z * to_wall < 50)
        in_floor = (np.abs(y * to_floor) < 50) & (np.abs(x * to_floor) < 50)
    expected = np.minimum(np.where(in_wall, to_wall, np.inf), np.where(in_floor, to_floor, np.inf))
    expected = np.where(valid & np.isfinite(expected), expected, np.nan).reshape(view.range_m.shape)
    known = np.isfinite(expected) & np.isfinite(view.range_m)
    assert known.mean() > 0.5
    np.testing.assert_allclose(view.range_m[known], expected[known], rtol=2e-5)
    assert (np.isfinite(expected) == np.isfinite(view.range_m)).mean() > 0.995  # but for rays along an edge


def test_what_stands_in_the_sun_throws_a_shadow() -> None:
    floor = quads([[-50, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]], (0.4, 0.4, 0.4), Material.PAINT)
    roof = box([4.0, -1.0, 3.0], [9.0, 1.0, 3.2], (0.4, 0.4, 0.4), Material.PAINT)
    bright = render_view(a_scene(floor), PINHOLE, looking_ahead(1.5)).bgr
    shaded = render_view(a_scene(join([floor, roof])), PINHOLE, looking_ahead(1.5)).bgr
    under = (20 + round(40 * 1.5 / 6.0), 30)  # the floor 6 m ahead
    neighbour = (20 + round(40 * 1.5 / 6.0), 30 + round(40 * 3.0 / 6.0))
    assert shaded[under].mean() < 0.7 * bright[under].mean()
    assert np.abs(shaded[neighbour].astype(int) - bright[neighbour]).max() <= 2


def test_the_sky_has_no_range_and_beyond_the_lens_is_black() -> None:
    floor = quads([[-50, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]], (0.4, 0.4, 0.4), Material.PAINT)
    view = render_view(a_scene(floor), FISHEYE, looking_ahead(1.5), half_view_rad=np.deg2rad(92.5))
    assert np.isnan(view.range_m[:40]).all()
    assert view.bgr[0, 0].tolist() == [0, 0, 0]
    assert view.bgr[20, 48].min() > 50


def test_a_smoothed_picture_differs_only_at_edges() -> None:
    scene = Town(1, 50.0).scene(20.0)
    pose = looking_ahead(0.0)
    pose[:3, 3] = scene.road.points(20.0, -1.5, 1.7)
    smooth = render_view(scene, FISHEYE, pose)
    plain = render_view(scene, FISHEYE, pose, smooth_edges=False)
    np.testing.assert_array_equal(smooth.range_m, plain.range_m)
    changed = (smooth.bgr != plain.bgr).any(axis=2)
    assert 0.01 < changed.mean() < 0.6
