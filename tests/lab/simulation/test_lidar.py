"""The spinning LiDAR: range, timing, motion, dead beams, edges."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("embreex", reason="needs embreex")

from coec_lab.simulation.lidar_model import LIDARS, LidarModel, Raster, Rosette, Turn, even_deg, sweep
from coec_lab.simulation.mesh import Material, Mesh, join, quads
from coec_lab.simulation.road import build_road
from coec_lab.simulation.scene import Scene
from coec_lab.simulation.weather import Air, rainy_air, sample_sky

TURN = Turn(even_deg(-15.0, 15.0, 16), columns=720)
EXACT = LidarModel(TURN, reach_m=100.0, noise_m=1e-9, dropout=0.0)
Poses = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def a_room(size_m: float = 20.0) -> Mesh:
    """Four walls about the origin."""
    a = size_m / 2
    corners = np.array([[-a, -a], [a, -a], [a, a], [-a, a]])
    ends = np.roll(corners, -1, axis=0)
    walls = [
        [[*one, -20.0], [*other, -20.0], [*other, 20.0], [*one, 20.0]] for one, other in zip(corners, ends, strict=True)
    ]
    return quads(walls, (0.5, 0.5, 0.5), Material.PLASTER)


def a_scene(mesh: Mesh) -> Scene:
    return Scene(build_road(0, -10.0, 10.0), sample_sky(0), np.zeros(3), mesh, [])


def moving(speed_mps: float) -> Poses:
    def poses(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        result = np.tile(np.eye(4), (len(time_s), 1, 1))
        result[:, 0, 3] = speed_mps * time_s
        return result

    return poses


def test_points_lie_on_the_walls() -> None:
    detected = sweep(a_scene(a_room()), EXACT, moving(0.0), 0.0, np.random.default_rng(0))
    x, y = np.abs(detected.xyz_m[:, :2]).T
    np.testing.assert_allclose(np.maximum(x, y), 10.0, atol=0.06)  # a beam in a corner mixes both walls
    assert np.median(np.abs(np.maximum(x, y) - 10.0)) < 1e-4
    assert len(detected.xyz_m) == TURN.columns * 16
    assert detected.ring is not None
    assert set(detected.ring.tolist()) == set(range(16))
    elevation = np.arctan2(detected.xyz_m[:, 2], np.hypot(*detected.xyz_m[:, :2].T))
    np.testing.assert_allclose(elevation, np.asarray(TURN.elevations_rad)[detected.ring], atol=1e-5)


def test_it_turns_clockwise_from_the_rear_and_is_stamped_as_it_checks_forward() -> None:
    detected = sweep(a_scene(a_room()), EXACT, moving(0.0), 5.0, np.random.default_rng(0))
    azimuth = np.arctan2(detected.xyz_m[:, 1], detected.xyz_m[:, 0])
    np.testing.assert_allclose(detected.time_offset_s, -azimuth / (2 * np.pi) * EXACT.period_s, atol=1e-6)


def test_motion_skews_the_sweep_by_what_the_time_of_each_point_says() -> None:
    speed = 10.0
    detected = sweep(a_scene(a_room()), EXACT, moving(speed), 0.0, np.random.default_rng(0))
    raw = np.maximum(*np.abs(detected.xyz_m[:, :2]).T)
    still = detected.xyz_m.copy()
    still[:, 0] += speed * detected.time_offset_s
    straightened = np.maximum(*np.abs(still[:, :2]).T)
    assert np.quantile(np.abs(raw - 10.0), 0.9) > 0.2
    assert np.quantile(np.abs(straightened - 10.0), 0.99) < 0.06


def test_noise_and_dropouts_are_those_of_the_model() -> None:
    model = replace(EXACT, noise_m=0.05, dropout=0.3)
    detected = sweep(a_scene(a_room()), model, moving(0.0), 0.0, np.random.default_rng(1))
    assert len(detected.xyz_m) == pytest.approx(0.7 * TURN.columns * 16, rel=0.03)
    middle = np.abs(np.arctan2(detected.xyz_m[:, 1], detected.xyz_m[:, 0])) < 0.5
    range_m = np.linalg.norm(detected.xyz_m[middle], axis=1)
    along = range_m / (detected.xyz_m[middle, 0] / 10.0)
    assert np.std(range_m - along) == pytest.approx(0.05, rel=0.1)


def test_dead_beams_measure_nothing() -> None:
    dead = np.arange(16) % 4 == 0
    detected = sweep(a_scene(a_room()), EXACT, moving(0.0), 0.0, np.random.default_rng(0), dead)
    assert detected.ring is not None
    assert set(detected.ring.tolist()) == set(np.flatnonzero(~dead).tolist())


def test_echoes_within_a_pulse_mix_and_others_do_not() -> None:
    def plate(x_m: float) -> Mesh:
        return quads([[[x_m, -3, -5], [x_m, 0.011, -5], [x_m, 0.011, 5], [x_m, -3, 5]]], 0.5, Material.PLASTER)

    model = LidarModel(Turn((0.0,), columns=3600), noise_m=1e-9, dropout=0.0, divergence_rad=0.003)
    for plate_m, mixed in ((9.68, True), (5.0, False)):
        scene = a_scene(join([a_room(), plate(plate_m)]))
        detected = sweep(scene, model, moving(0.0), 0.0, np.random.default_rng(0))
        ahead = np.abs(np.arctan2(detected.xyz_m[:, 1], detected.xyz_m[:, 0])) < 0.1
        x = detected.xyz_m[ahead, 0]
        between = (x > plate_m + 0.02) & (x < 10.0 - 0.02)
        assert between.any() == mixed


def test_a_sign_answers_brighter_than_asphalt() -> None:
    def strength(material: Material) -> float:
        walls = a_room()
        painted = Mesh(walls.corners_m, walls.colour, np.full_like(walls.material, int(material)))
        detected = sweep(a_scene(painted), EXACT, moving(0.0), 0.0, np.random.default_rng(0))
        assert detected.intensity is not None
        return float(np.median(detected.intensity))

    assert strength(Material.SIGN) > 2 * strength(Material.ASPHALT)


@pytest.mark.parametrize("name", ["raster", "rosette"])
def test_a_sensor_that_does_not_turn_sees_a_part_of_the_room_and_numbers_no_rings(name: str) -> None:
    model = replace(LIDARS[name], noise_m=1e-9, dropout=0.0, divergence_rad=0.0)
    detected = sweep(a_scene(a_room()), model, moving(0.0), 0.0, np.random.default_rng(0))
    assert detected.ring is None
    x, y = np.abs(detected.xyz_m[:, :2]).T
    np.testing.assert_allclose(np.maximum(x, y), 10.0, atol=1e-3)
    away_deg = np.degrees(np.arctan2(np.abs(detected.xyz_m[:, 1]), detected.xyz_m[:, 0]))
    assert 30.0 < away_deg.max() < 61.0
    assert np.ptp(detected.time_offset_s) == pytest.approx(model.period_s, rel=0.01)


def test_only_the_rosette_points_elsewhere_in_the_next_sweep() -> None:
    for pattern, same in ((Rosette(), False), (Raster(2.0, (0.0, 0.1), 30), True), (TURN, True)):
        first, second = (pattern.fired(time_s, 0.1).rays for time_s in (0.0, 0.1))
        np.testing.assert_allclose(np.linalg.norm(second, axis=-1), 1.0, atol=1e-12)
        assert np.array_equal(first, second) == same


def test_rain_answers_some_rays_and_weakens_the_others() -> None:
    room, model = a_scene(a_room(300.0)), replace(EXACT, reach_m=300.0)

    def swept(air: Air) -> NDArray[np.float32]:
        xyz_m = sweep(room, model, moving(0.0), 0.0, np.random.default_rng(0), air=air).xyz_m
        return np.asarray(np.linalg.norm(xyz_m, axis=1))

    clear, wet = swept(Air()), swept(rainy_air(40.0))
    assert (clear > 60.0).all()
    assert np.sum(wet < 60.0) / (16 * TURN.columns) == pytest.approx(40.0 * 6e-4, rel=0.3)
    assert wet.max() < clear.max()
