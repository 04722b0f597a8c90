"""Frames to learn from, rendered: random cameras, mounts, light and dirt in streets, traffic jams and halls.

Streets alone teach that low things are near and high things are far. That is false beside a lorry, under a bridge and
indoors.

Everything in a frame that may differ on a real vehicle is drawn anew, so that the network learns what all have in
common (domain randomisation: Tobin et al., IROS 2017).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Matrix4
from coec.geometry.cameras import Camera, build
from coec.geometry.se3 import rotation_exp
from coec_lab.simulation.mesh import Floats, Material, Mesh, box, join, quads
from coec_lab.simulation.props import car
from coec_lab.simulation.render import LensProperties, dirt_cover, expose, pixel_rays, render_radiance
from coec_lab.simulation.road import Road, build_road
from coec_lab.simulation.scene import Scene, Solid, Town
from coec_lab.simulation.vehicle_motion import P_EGO_CAMERA_M, body
from coec_lab.simulation.weather import sample_sky
from coec_lab.training.training_frames import KINDS, NEAREST_M, SHAPES, SKY, UNKNOWN, TrainingFrame

Doubles = NDArray[np.float64]


PLACES = 3
"""Places of each seed."""
CROWDED = 1_000_000
"""From this seed on, jams and halls alternate; smaller seeds give streets."""
TOWN_M = 1000.0
LANE_M = 3.2
WALLS = (Material.PAINT, Material.BRICK, Material.PLASTER, Material.CONCRETE, Material.TILES)


class TrainingScene(Protocol):
    """Somewhere to take pictures. Its methods must be called in this order, because they draw random numbers."""

    def sample_spot(self, rng: np.random.Generator) -> float:
        """A random spot along the place, metres."""

    def stand(self, spot_m: float, rng: np.random.Generator) -> Matrix4:
        """T_world_ego (4, 4) of a vehicle there."""

    def sample_scene(self, rng: np.random.Generator) -> Scene:
        """The surroundings."""


def training_scenes(seed: int) -> Iterator[tuple[TrainingScene, np.random.Generator]]:
    """The places of a seed, each with the generator of its frames."""
    town = Town(seed, TOWN_M)
    for number in range(PLACES):
        rng = np.random.default_rng([seed, 140, number])
        if seed < CROWDED:
            yield StreetScene(town, rng.uniform(0.0, TOWN_M)), rng
        elif number % 2 == seed % 2:
            yield HallScene(rng), rng
        else:
            yield JamScene(town, rng.uniform(0.0, TOWN_M), rng), rng


class StreetScene:
    """A street of a town."""

    def __init__(self, town: Town, at_m: float) -> None:
        self._town = town
        self._at_m = at_m

    def sample_spot(self, rng: np.random.Generator) -> float:
        """See `Place`."""
        return self._at_m + rng.uniform(-20, 20)

    def stand(self, spot_m: float, rng: np.random.Generator) -> Matrix4:
        """See `Place`: mostly in the own lane."""
        left_m = self._town.lane_left_m() * (1 if rng.random() < 0.8 else -1) + rng.normal(0, 0.5)
        if rng.random() < 0.1:
            left_m = rng.uniform(-6, 6)
        return _ego(self._town.road, spot_m, left_m, rng)

    def sample_scene(self, rng: np.random.Generator) -> Scene:
        """See `Place`: with the traffic of some time."""
        return self._town.scene(self._at_m, float(rng.uniform(0, 60)))


class JamScene:
    """A street full of cars and lorries, at times under a bridge."""

    def __init__(self, town: Town, at_m: float, rng: np.random.Generator) -> None:
        self._road, self._at_m, self._left_m = town.road, at_m, town.lane_left_m()
        street = town.scene(at_m)
        parts = [street.street]
        for lane in (-1, 0, 1, 2):
            ahead_m = rng.uniform(-14, -7) if lane else rng.uniform(5.0, 12.0)
            while ahead_m < 55:
                one = _lorry(rng) if rng.random() < 0.3 else car(rng)
                length_m = float(np.ptp(one.corners_m[:, :, 0]))
                ahead_m += length_m / 2
                parts.append(self._on_road(one, ahead_m, self._left_m + lane * LANE_M, street.origin_m))
                ahead_m += length_m / 2 + rng.uniform(1.0, 9.0)
        if rng.random() < 0.6:
            parts.append(self._on_road(_bridge(rng), rng.uniform(-6, 30), 0.0, street.origin_m))
        self._scene = Scene(town.road, street.sky, street.origin_m, join(parts), [])

    def sample_spot(self, rng: np.random.Generator) -> float:
        """See `Place`."""
        return self._at_m + rng.uniform(-2, 2)

    def stand(self, spot_m: float, rng: np.random.Generator) -> Matrix4:
        """See `Place`."""
        return _ego(self._road, spot_m, self._left_m + rng.normal(0, 0.25), rng)

    def sample_scene(self, rng: np.random.Generator) -> Scene:  # noqa: ARG002 - as Place's
        """See `Place`."""
        return self._scene

    def _on_road(self, mesh: Mesh, ahead_m: float, left_m: float, origin_m: Doubles) -> Mesh:
        s = self._at_m + ahead_m
        x, y, z = self._road.points(s, left_m, 0.0) - origin_m
        return mesh.placed(x, y, z, float(self._road.at(s)[3]))


class HallScene:
    """A closed hall with pillars, cars, doors and boxes."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._length_m, self._width_m = rng.uniform(8, 50), rng.uniform(7, 30)
        height_m = rng.uniform(2.4, 7.0)
        half = np.array([self._length_m / 2, self._width_m / 2])
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
        floor, ceiling = (np.column_stack([corners, np.full(4, z)]) for z in (0.0, height_m))
        parts = [
            quads(floor[None], _grey(rng), Material.CONCRETE),
            quads(ceiling[None], _grey(rng), WALLS[rng.integers(len(WALLS))]),
        ]
        for k in range(4):
            a, b = corners[k], corners[(k + 1) % 4]
            wall = [[*a, 0.0], [*b, 0.0], [*b, height_m], [*a, height_m]]
            parts.append(quads([wall], _grey(rng), WALLS[rng.integers(len(WALLS))]))
            parts += _doors(a, b, height_m, rng)
        for _ in range(int(rng.integers(2, 16))):
            x, y = rng.uniform(-half, half)
            if rng.random() < 0.3:
                parts.append(_block(x, y, rng.uniform(0.15, 0.4, 2), 0.0, height_m, rng))
            elif rng.random() < 0.4:
                parts.append(car(rng).placed(x, y, 0.0, rng.uniform(-np.pi, np.pi)))
            else:
                parts.append(_block(x, y, rng.uniform(0.1, 0.8, 2), 0.0, rng.uniform(0.2, 2.0), rng))
        for _ in range(int(rng.integers(2, 12))):  # beams, ducts, lamps
            x, y = rng.uniform(-half, half)
            low_m = height_m - rng.uniform(0.1, 0.6)
            parts.append(
                _block(x, y, rng.uniform(0.1, 3.0, 2), low_m, height_m - 0.01, rng, 3.0 * (rng.random() < 0.5))
            )
        road = build_road(0, -60.0, 60.0)
        self._scene = Scene(road, sample_sky(int(rng.integers(2**31))), np.zeros(3), join(parts), [])

    def sample_spot(self, rng: np.random.Generator) -> float:
        """See `Place`."""
        return rng.uniform(-0.4, 0.4) * self._length_m

    def stand(self, spot_m: float, rng: np.random.Generator) -> Matrix4:
        """See `Place`."""
        return _upright([spot_m, rng.uniform(-0.35, 0.35) * self._width_m, 0.0], rng.uniform(-np.pi, np.pi))

    def sample_scene(self, rng: np.random.Generator) -> Scene:  # noqa: ARG002 - as Place's
        """See `Place`."""
        return self._scene


def _ego(road: Road, at_m: float, left_m: float, rng: np.random.Generator) -> Matrix4:
    heading = float(road.at(at_m)[3]) + rng.normal(0, 0.05)
    return _upright(road.points(at_m, left_m, 0.0), heading)


def _upright(position_m: Doubles | list[float], heading_rad: float) -> Matrix4:
    pose = np.eye(4)
    pose[:3, :3] = rotation_exp(np.array([0.0, 0.0, heading_rad]))
    pose[:3, 3] = position_m
    return pose


def _lorry(rng: np.random.Generator) -> Mesh:
    """A load of any colour on wheels, box or tank, 6 to 14 m long."""
    length_m, top_m = rng.uniform(6, 14), rng.uniform(2.6, 4.0)
    load = box(
        [-length_m / 2, -1.25, 1.0], [length_m / 2 - 2.2, 1.25, top_m], rng.uniform(0.05, 0.9, 3), Material.PAINT
    )
    cab = box(
        [length_m / 2 - 2.0, -1.2, 0.5], [length_m / 2, 1.2, 0.8 * top_m], rng.uniform(0.05, 0.8, 3), Material.LACQUER
    )
    frame = box([-length_m / 2 + 0.3, -0.9, 0.4], [length_m / 2 - 1, 0.9, 1.0], (0.04, 0.04, 0.04), Material.RUBBER)
    return join([load, cab, frame])


def _bridge(rng: np.random.Generator) -> Mesh:
    """A deck across the road, 4.2 to 6.5 m above it, with an underside."""
    low_m, half_m = rng.uniform(4.2, 6.5), rng.uniform(3.0, 20.0)
    colour = _grey(rng)
    under = [[-half_m, -40, low_m], [half_m, -40, low_m], [half_m, 40, low_m], [-half_m, 40, low_m]]
    deck = box([-half_m, -40, low_m], [half_m, 40, low_m + rng.uniform(0.8, 1.8)], colour, Material.CONCRETE)
    pillars = [
        box([x - 0.5, y - 0.5, 0.0], [x + 0.5, y + 0.5, low_m], colour, Material.CONCRETE)
        for x in (-half_m + 1, half_m - 1)
        for y in (-rng.uniform(7, 10), rng.uniform(9, 13))
    ]
    return join([deck, quads([under], colour, Material.CONCRETE), *pillars])


def _doors(a: Doubles, b: Doubles, height_m: float, rng: np.random.Generator) -> list[Mesh]:
    """Gates and doors, some ribbed, 5 cm in front of a wall from a to b (2,)."""
    inward = -(a + b) / 2
    inward /= np.linalg.norm(inward)
    long_m = float(np.linalg.norm(b - a))
    doors = []
    for _ in range(int(rng.integers(0, 4))):
        wide_m = rng.uniform(0.8, min(5.0, 0.6 * long_m))
        begin = rng.uniform(0, long_m - wide_m)
        first, last = (a + (b - a) * place / long_m + 0.05 * inward for place in (begin, begin + wide_m))
        top_m = rng.uniform(0.6, 0.95) * height_m
        rows = np.linspace(0.0, top_m, int(rng.choice([1, 1, 12, 30])) + 1)
        colours = _grey(rng) * (1 + 0.4 * (np.arange(len(rows) - 1) % 2))[:, None]
        strips = [[[*first, low], [*last, low], [*last, up], [*first, up]] for low, up in pairwise(rows)]
        doors.append(quads(strips, colours, Material.PAINT))
    return doors


def _block(
    x_m: float,
    y_m: float,
    half_m: Doubles,
    low_m: float,
    high_m: float,
    rng: np.random.Generator,
    glow: float = 0.0,
) -> Mesh:
    """A box with an underside; `glow` is added to its reflectance: a lamp."""
    colour = rng.uniform(0.03, 0.9, 3) + glow
    low, high = [x_m - half_m[0], y_m - half_m[1], low_m], [x_m + half_m[0], y_m + half_m[1], high_m]
    under = [[low[0], low[1], low_m], [high[0], low[1], low_m], [high[0], high[1], low_m], [low[0], high[1], low_m]]
    return join([box(low, high, colour, Material.PAINT), quads([under], colour, Material.PAINT)])


def _grey(rng: np.random.Generator) -> NDArray[np.float64]:
    """A colour of walls: grey with a hint of a tint."""
    return np.clip(rng.uniform(0.06, 0.8) * np.exp(rng.normal(0, 0.08, 3)), 0, 1)


FRAMES_PER_PLACE = 4
"""More than one, because laying out a place takes longer than rendering a frame."""
TOO_NEAR_M, TOO_NEAR_SHARE = 1.8, 0.3
"""A frame with more than this share of its pixels nearer than `TOO_NEAR_M` looks into a wall and is drawn again."""
HEIGHT_M = (0.8, 2.2)
TILT_RAD = np.deg2rad(8.0)
"""Greatest pitch and roll of a mount."""
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation from camera axes (right, down, forward) to a vehicle's (forward, left, up)."""


@dataclass(frozen=True, slots=True)
class Eye:
    """A camera and the half angle of its circle, radians (π: no circle)."""

    camera: Camera
    half_view_rad: float


def frames(seed: int) -> Iterator[TrainingFrame]:
    """The frames of the places of a seed, `FRAMES_PER_PLACE` of each."""
    own = Solid(body())
    for place, rng in training_scenes(seed):
        for _ in range(FRAMES_PER_PLACE):
            yield _frame(place, own, rng)


def sample_camera(kind: str, rng: np.random.Generator) -> Eye:
    """A random camera of a kind."""
    height, width = SHAPES[kind]
    cx, cy = (width - 1) / 2 + rng.normal(0, 0.015) * width, (height - 1) / 2 + rng.normal(0, 0.03) * height
    size = {"width": width, "height": height, "cx": cx, "cy": cy}
    if kind == "round" or (kind == "wide" and rng.random() < 0.35):
        half = np.deg2rad(rng.uniform(70, 95) if kind == "round" else rng.uniform(45, 75))
        xi, alpha = rng.uniform(-0.3, 0.2), rng.uniform(0.52, 0.68)
        z = xi + np.cos(half)
        # Usenko, Demmel, Cremers 2018, equations (40) to (42), at the rim.
        rim = np.sin(half) / (alpha * np.hypot(np.sin(half), z) + (1 - alpha) * z)
        focal = (width - 1) / 2 / rim * (rng.uniform(0.95, 1.35) if kind == "round" else 1.0)
        circle = float(half) if kind == "round" and rng.random() < 0.7 else np.pi
        return Eye(build("double_sphere", fx=focal, fy=focal, xi=xi, alpha=alpha, **size), circle)
    half = np.deg2rad(rng.uniform(38, 56) if kind == "panorama" else rng.uniform(24, 50))
    focal = width / 2 / np.tan(half)
    return Eye(build("pinhole", fx=focal, fy=focal, **size), np.pi)


def sample_lens(rng: np.random.Generator) -> LensProperties:
    """Random properties of a lens, from a clean picture to a poor one."""
    return LensProperties(
        blur_px=float(rng.uniform(0.25, 1.1)),
        vignetting=float(rng.uniform(0.0, 0.45)),
        full_well=float(10 ** rng.uniform(2.7, 4.2)),
        read_noise=float(10 ** rng.uniform(-3, -1.8)),
        target=float(np.clip(rng.normal(0.25, 0.1), 0.08, 0.6)),
        jpeg_quality=int(rng.integers(40, 96)),
    )


def _frame(place: TrainingScene, own: Solid, rng: np.random.Generator) -> TrainingFrame:
    while True:
        kind = str(rng.choice([name for name, _ in KINDS], p=[share for _, share in KINDS]))
        eye = sample_camera(kind, rng)
        with_body = rng.random() < 0.3
        spot_m = place.sample_spot(rng)
        T_ego_camera = _mount(with_body, rng)
        pose = np.einsum("ij,jk->ik", place.stand(spot_m, rng), T_ego_camera)
        scene = place.sample_scene(rng)
        _repaint(scene, rng)
        radiance = render_radiance(scene, eye.camera, pose, half_view_rad=eye.half_view_rad, smooth_edges=False)
        near = float(np.mean(radiance.range_m < TOO_NEAR_M))
        pixel_rays.cache_clear()
        if near > TOO_NEAR_SHARE:
            continue
        seen, hidden = _seen(eye, own if with_body else None, T_ego_camera)
        paint = np.array(scene.sky.horizon, np.float32) * np.exp(rng.uniform(-4, -0.5, 3)).astype(np.float32)
        radiance.linear[hidden] = paint
        return TrainingFrame(kind, _photograph(radiance.linear, seen, rng), _code(radiance.range_m, seen & ~hidden))


def _mount(with_body: bool, rng: np.random.Generator) -> Matrix4:
    """Random T_ego_camera: on the roof behind the bonnet, or anywhere from which no body is seen."""
    if with_body:
        yaw = rng.normal(0, 0.08)
        place = P_EGO_CAMERA_M + np.array([rng.uniform(-0.2, 0.3), rng.uniform(-0.3, 0.3), rng.uniform(-0.1, 0.3)])
    else:
        yaw = rng.normal(0, 0.12) if rng.random() < 0.55 else rng.uniform(-np.pi, np.pi)
        place = np.array([0.0, 0.0, rng.uniform(*HEIGHT_M)])
    tilt = np.clip(rng.normal(0, TILT_RAD / 2, 2), -TILT_RAD, TILT_RAD)
    mount = np.eye(4)
    turned = np.einsum("ij,jk->ik", rotation_exp(np.array([0.0, 0.0, yaw])), AHEAD)
    mount[:3, :3] = np.einsum("ij,jk->ik", turned, rotation_exp(np.array([tilt[0], 0.0, tilt[1]])))
    mount[:3, 3] = place
    return mount


def _repaint(scene: Scene, rng: np.random.Generator) -> None:
    """Gives a scene new weather and colours; colours change from those of the frame before if the scene is the same."""
    scene.sky = sample_sky(int(rng.integers(2**31)))
    colour = scene.colour
    if rng.random() < 0.5:  # all surfaces alike: lighter, darker, another tint
        colour = colour ** np.float32(rng.uniform(0.5, 1.6)) * np.exp(rng.normal(0, 0.2, 3)).astype(np.float32)
    if rng.random() < 0.2:  # patches
        patches = np.exp(rng.normal(0, rng.uniform(0.1, 0.6), (len(colour), 1)))
        colour = colour * patches.astype(np.float32)
    scene.colour = np.clip(colour, 0, 1).astype(np.float32)


def _seen(eye: Eye, own: Solid | None, T_ego_camera: Matrix4) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(h, w) each: what the lens lets through, and what shows the vehicle's own body."""
    rays = pixel_rays(eye.camera, eye.half_view_rad)
    shape = (eye.camera.height, eye.camera.width)
    seen, hidden = np.zeros((2, shape[0] * shape[1]), bool)
    seen[rays.pixel] = True
    if own is not None:
        directions = np.einsum("ij,nj->ni", T_ego_camera[:3, :3], rays.directions).astype(np.float32)
        origins = np.empty_like(directions)
        origins[:] = T_ego_camera[:3, 3]
        hidden[rays.pixel] = own.blocked(origins, directions)
    return seen.reshape(shape), hidden.reshape(shape)


def _photograph(linear: Floats, seen: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.uint8]:
    lens = sample_lens(rng)
    dirt = None
    if rng.random() < 0.1:
        dirt = dirt_cover((seen.shape[0], seen.shape[1]), float(rng.uniform(0.02, 0.15)), int(rng.integers(2**31)))
    light = float(10 ** rng.uniform(-1.0, 0.5))
    bgr = expose(linear, seen, lens, rng, light=light, dirt=dirt)
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, lens.jpeg_quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def _code(range_m: Floats, known: NDArray[np.bool_]) -> NDArray[np.uint16]:
    code = np.clip(65535 * NEAREST_M / range_m, SKY + 1, 65535)
    code[np.isnan(range_m)] = SKY
    code[~known] = UNKNOWN
    return np.asarray(code, np.uint16)
