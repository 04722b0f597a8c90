"""What a LiDAR writes for the strength of a return: materials, print, noise, kinds of sensors, bloom, water."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("embreex", reason="needs embreex")

from coec_lab.simulation.lidar_model import LidarModel, Sweep, Turn, even_deg, sweep
from coec_lab.simulation.mesh import Colour, Material, Mesh, join, quads
from coec_lab.simulation.reflectance import INTENSITIES, beam_gains, infrared
from coec_lab.simulation.road import build_road
from coec_lab.simulation.scene import Scene, Town
from coec_lab.simulation.surroundings import Highway
from coec_lab.simulation.weather import CLEAR, Air, rainy_air, sample_sky
from lab.simulation.test_drive import small, sweeps

MODEL = LidarModel(Turn(even_deg(-10.0, 10.0, 16), columns=1800), dropout=0.0)
KINDS = [name for name, kind in INTENSITIES.items() if kind is not None]
DARK, LIGHT = (0.04, 0.04, 0.04), (0.8, 0.8, 0.8)


def plate(x_m: float, half_m: float, colour: Colour, material: Material, left_m: float = 0.0) -> Mesh:
    """A square that faces the LiDAR."""
    low, high = left_m - half_m, left_m + half_m
    return quads([[[x_m, low, -2], [x_m, high, -2], [x_m, high, 2], [x_m, low, 2]]], colour, material)


def measured(
    mesh: Mesh, kind: str = "calibrated", air: Air = CLEAR, seed: int = 0, sky: int = 0, gains: object = None
) -> Sweep:
    def poses(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.tile(np.eye(4), (len(time_s), 1, 1))

    scene = Scene(build_road(0, -10.0, 10.0), sample_sky(sky), np.zeros(3), mesh, [])
    model = replace(MODEL, intensity=INTENSITIES[kind])
    return sweep(scene, model, poses, 0.0, np.random.default_rng(seed), air=air, gains=gains)  # type: ignore[arg-type]


def read(detected: Sweep) -> NDArray[np.float32]:
    assert detected.intensity is not None
    return detected.intensity


@pytest.mark.parametrize("kind", KINDS)
def test_print_on_a_flat_board_is_an_edge_of_reflectance_alone(kind: str) -> None:
    board = join([plate(10.0, 1.0, LIGHT, Material.PAINT, 1.0), plate(10.0, 1.0, DARK, Material.PAINT, -1.0)])
    detected = measured(board, kind)
    left = detected.xyz_m[:, 1]
    light, dark = (read(detected)[np.abs(left - middle) < 0.8] for middle in (1.0, -1.0))
    assert np.median(light) > np.median(dark) + 5 * np.std(dark)
    assert np.ptp(detected.xyz_m[:, 0]) < 0.3


@pytest.mark.parametrize("kind", KINDS)
def test_values_are_quantised_and_bounded(kind: str) -> None:
    model = INTENSITIES[kind]
    assert model is not None
    values = read(
        measured(join([plate(6.0, 1.0, LIGHT, Material.RETRO), plate(12.0, 6.0, DARK, Material.CLOTH)]), kind)
    )
    np.testing.assert_allclose(values / model.step, np.rint(values / model.step), atol=1e-3)
    assert values.min() >= 0
    assert values.max() <= model.full


def test_the_kind_of_intensity_changes_no_range() -> None:
    scene = join([plate(12.0, 5.0, LIGHT, Material.PLASTER), plate(9.0, 0.5, LIGHT, Material.RETRO)])
    swept = [measured(scene, kind) for kind in INTENSITIES]
    for other in swept[1:]:
        np.testing.assert_array_equal(other.xyz_m, swept[0].xyz_m)
    assert [one.intensity is None for one in swept] == [kind is None for kind in INTENSITIES.values()]


def test_raw_values_fall_with_range_and_calibrated_ones_do_not() -> None:
    def levels(kind: str) -> list[float]:
        return [
            float(np.median(read(measured(plate(x_m, 0.3 * x_m, LIGHT, Material.PLASTER), kind)))) for x_m in (8, 24)
        ]

    near, far = levels("raw")
    assert far == pytest.approx(near * (8**2 + 6**2) / (24**2 + 6**2), rel=0.3)  # stains
    near, far = levels("reflectivity")
    assert far == pytest.approx(near, rel=0.3)


@pytest.mark.parametrize("kind", ["calibrated", "raw"])
def test_scatter_grows_with_the_level(kind: str) -> None:
    scatter = []
    for colour in (DARK, (0.25, 0.25, 0.25), LIGHT):
        values = read(measured(plate(10.0, 2.0, colour, Material.PLASTER), kind))
        scatter.append((np.median(values), np.median(np.abs(np.diff(values)))))
    ordered = sorted(scatter)
    assert ordered[0][1] < ordered[-1][1]
    assert 0.02 < ordered[-1][1] / ordered[-1][0] < 0.2


def test_a_retro_reflector_saturates_and_widens() -> None:
    """By its light on what is as far away, and if it is of prisms, by its range, too."""

    def swept(material: Material) -> Sweep:
        sheet = plate(19.9, 0.5, LIGHT, material)
        return measured(join([sheet, plate(20.0, 4.0, (0.2, 0.2, 0.2), Material.PLASTER)]))

    sign, paint = swept(Material.SIGN), swept(Material.PAINT)
    ring = sign.ring == 8
    near_edge = ring & (np.abs(np.abs(sign.xyz_m[:, 1]) - 0.53) < 0.03)
    assert read(sign)[ring & (np.abs(sign.xyz_m[:, 1]) < 0.4)].min() > 200
    assert np.median(read(sign)[near_edge]) > np.median(read(paint)[near_edge]) + 20

    def width_m(material: Material) -> float:
        detected = measured(join([plate(20.0, 0.5, LIGHT, material), plate(40.0, 8.0, LIGHT, Material.PLASTER)]))
        return float(np.ptp(detected.xyz_m[detected.xyz_m[:, 0] < 21.0, 1]))

    assert width_m(Material.SIGN) == width_m(Material.PAINT)
    assert width_m(Material.RETRO) > width_m(Material.PAINT) + 0.1


def test_light_and_shadow_are_for_the_camera_alone() -> None:
    wall = plate(10.0, 3.0, LIGHT, Material.PLASTER)
    np.testing.assert_array_equal(read(measured(wall, sky=1)), read(measured(wall, sky=4)))


def test_a_wet_road_is_darker_and_has_gaps() -> None:
    road = quads([[[3, -8, -1.8], [40, -8, -1.8], [40, 8, -1.8], [3, 8, -1.8]]], (0.19, 0.19, 0.19), Material.ASPHALT)
    air = Air(wetness=rainy_air(10.0).wetness)
    dry, wet = measured(road, "reflectivity"), measured(road, "reflectivity", air)
    assert np.median(read(wet)) < 0.65 * np.median(read(dry))
    far_dry, far_wet = (int((one.xyz_m[:, 0] > 15.0).sum()) for one in (dry, wet))
    assert 0.5 * far_dry < far_wet < 0.9 * far_dry
    wall = plate(10.0, 3.0, LIGHT, Material.PLASTER)
    np.testing.assert_array_equal(read(measured(wall, air=air)), read(measured(wall)))


def test_infrared_is_not_what_the_camera_sees() -> None:
    """Leaves are brighter than asphalt of their grey, black lacquer and glass reflect nearly nothing; the hues of cars
    tell something, not all."""
    kinds = [Material.FOLIAGE, Material.ASPHALT, Material.GLASS]
    leaf, asphalt, glass = infrared(np.full((3, 3), 0.15, np.float32), np.array(kinds, np.int8))
    assert leaf > 2 * asphalt
    assert asphalt > 2 * glass
    rng = np.random.default_rng(0)
    grey = rng.uniform(0.02, 0.8, (500, 1)).astype(np.float32) * np.ones((1, 3), np.float32)
    lacquer = infrared(grey, np.full(500, Material.LACQUER, np.int8))
    assert 0.5 < np.corrcoef(grey[:, 0], lacquer)[0, 1] < 0.97
    assert np.median(lacquer[grey[:, 0] < 0.06]) < 0.06
    assert lacquer.max() <= 1.0


def test_beams_differ_by_the_same_factors_in_every_sweep() -> None:
    model = INTENSITIES["calibrated"]
    assert model is not None
    gains = beam_gains(model, 16, np.random.default_rng(3))
    wall = plate(8.0, 3.0, (0.3, 0.3, 0.3), Material.PLASTER)
    levels = []
    for seed in (0, 1):
        detected = measured(wall, seed=seed, gains=gains)
        levels.append([np.median(read(detected)[detected.ring == ring]) for ring in range(16)])
    assert np.std(levels[0]) > 2.0
    np.testing.assert_allclose(levels[0], levels[1], rtol=0.03)


@pytest.mark.usefixtures("streets")
def test_a_drive_writes_the_requested_kind() -> None:
    requested = {kind: sweeps(small(seconds=0.2, intensity=kind).messages())[0] for kind in ("raw", "none")}
    usual = sweeps(small(seconds=0.2).messages())[0]
    again = sweeps(small(seconds=0.2).messages())[0]
    assert requested["none"].intensity is None
    assert requested["raw"].intensity is not None
    assert requested["raw"].intensity.max() > 255
    assert usual.intensity is not None
    assert usual.intensity.max() <= 255
    np.testing.assert_array_equal(usual.intensity, again.intensity)
    np.testing.assert_array_equal(usual.xyz_m, requested["raw"].xyz_m)


def test_a_motorway_has_sheeting_beads_and_vehicles_that_overtake() -> None:
    town = Town(3, 600.0, surroundings=Highway(3))
    scene = town.scene(200.0, progress=lambda time_s: 200.0 + 25.0 * time_s)
    present = set(scene.material[: len(scene.street.material)].tolist())
    assert {Material.RETRO, Material.BEADED, Material.STEEL} <= present
    times = np.array([0.0, 1.0])
    overtaking = [mover for mover in scene.movers if not mover.oncoming and np.ptp(mover.progress(times)) > 30.0]
    assert overtaking
    assert all(mover.left_m > town.lane_left_m() for mover in overtaking)
