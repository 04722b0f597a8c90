"""A street of boxes, and drives along it as folders that `coec.open` reads: made in milliseconds with NumPy alone, the
same on every run. Nothing here imports coec."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np
from numpy.typing import NDArray

from support.oracles import CAMERA_PIXELS

Array = NDArray[np.float64]

WIDTH, HEIGHT = 240, 160
START_NS = 1_700_000_000_000_000_000
NS_PER_S = 1_000_000_000
SPACING_S = 2.0
"""From one pair to the next."""

SPEED_MPS = 6.0
REVOLUTION_S = 0.1
HEIGHT_M = 1.8
"""Of the LiDAR above the ground."""

SKY_M = 300.0
FAR_M = 45.0
"""Boxes farther away are not there."""

STREET_M = 200.0

T_CAMERA_LIDAR = ((0.0, -1.0, 0.0, 0.05), (0.0, 0.0, -1.0, -0.25), (1.0, 0.0, 0.0, -0.2), (0.0, 0.0, 0.0, 1.0))


def lens(focal_px: float, **parameters: float) -> Mapping[str, float]:
    """The intrinsics of a lens."""
    return MappingProxyType({"fx": focal_px, "fy": focal_px, "cx": 119.3, "cy": 79.8, **parameters})


LENSES: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        "pinhole": lens(120.0),
        "radtan": lens(123.0, k1=-0.08, k2=0.012, k3=0.001, p1=0.001, p2=-0.0005),
        "rational": lens(121.0, k1=0.1, k2=0.02, k3=0.001, k4=0.16, k5=0.03, k6=0.002, p1=0.0005, p2=0.0008),
        "kannala_brandt": lens(111.0, k1=-0.02, k2=0.004, k3=-0.001, k4=0.0002),
        "mei": lens(190.0, xi=0.7, k1=-0.02, k2=0.005, p1=0.0005, p2=-0.0004),
        "eucm": lens(117.0, alpha=0.56, beta=1.08),
        "double_sphere": lens(98.0, xi=-0.2, alpha=0.58),
    }
)


@dataclass(frozen=True)
class Drive:
    """What is recorded: `lens` names the camera's, `seed` the street. Beside that, what went wrong.

    Attributes:
        turned_deg: by how much the camera turns about its vertical axis, in the middle of the drive.
        brightness: of the pictures.
        beams, columns: of the LiDAR, in front of the vehicle, as far as `half_view_deg` to either side.
        depth_step: how many pixels of the picture lie between two of its depth map.
    """

    lens: str = "pinhole"
    seed: int = 1
    pairs: int = 8
    turned_deg: float = 0.0
    brightness: float = 1.0
    beams: int = 64
    columns: int = 600
    half_view_deg: float = 75.0
    depth_step: int = 1
    speed_mps: float = SPEED_MPS


@dataclass(frozen=True)
class Street:
    """Boxes that stand on the ground, or hang above it: least and greatest corner (N, 3), albedo (N,)."""

    least: Array
    greatest: Array
    albedo: Array

    def seen(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """What rays from `origin` (N, 3) along unit vectors (N, 3) meet: range in metres (N,), albedo (N,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            best = np.where(direction[:, 2] < 0.0, -origin[:, 2] / direction[:, 2], np.inf)
        best = np.where(best < SKY_M, best, SKY_M)
        hit = np.where(best < SKY_M, -1, -2)
        from_x, to_x = origin[:, 0].min() - 1.0, origin[:, 0].max() + FAR_M
        starts = np.ascontiguousarray(origin.T)
        slopes = 1.0 / np.where(np.abs(direction) < 1e-12, 1e-12, direction).T.copy()
        for box in np.flatnonzero((self.greatest[:, 0] > from_x) & (self.least[:, 0] < to_x)):
            enters, leaves = np.full(len(best), 0.5), best.copy()
            for start, slope, least, greatest in zip(starts, slopes, self.least[box], self.greatest[box], strict=True):
                low, high = (least - start) * slope, (greatest - start) * slope
                np.maximum(enters, np.minimum(low, high), out=enters)
                np.minimum(leaves, np.maximum(low, high), out=leaves)
            met = (enters < leaves) & (enters > 0.5)
            best[met] = enters[met]
            hit[met] = box
        return best, self._albedo(hit, origin + best[:, None] * direction)

    def _albedo(self, hit: NDArray[np.int64], point: Array) -> Array:
        x, y, z = point.T
        # Slabs of the ground, and a kerb; walls have windows, and their faces are lit from one side.
        slab = np.floor(x / 3.0) + 7.0 * np.floor(y / 3.0)
        ground = 0.3 + 0.01 * (slab % 3.0) + np.where(np.abs(np.abs(y) - 5.0) < 0.3, 0.05, 0.0)
        box = np.maximum(hit, 0)
        face = np.argmin(np.minimum(np.abs(point - self.least[box]), np.abs(point - self.greatest[box])), axis=1)
        along = np.where(face == 0, y, x)
        window = (np.mod(along, 3.2) < 1.5) & (np.mod(z, 3.0) > 1.1) & (np.mod(z, 3.0) < 2.4)
        wall = self.albedo[box] * np.array([0.65, 1.0, 0.9])[face] * np.where(window, 0.85, 1.0)
        return np.where(hit >= 0, wall, np.where(hit == -1, ground, 0.95))


def street(seed: int) -> Street:
    """A wall of houses on either side, and in front of it boxes of all sizes that stand or hang: no two stretches are
    alike, and edges of range are edges of brightness."""
    rng = np.random.default_rng(seed)
    boxes: list[tuple[float, ...]] = []
    for side in (-1.0, 1.0):
        x = -20.0
        while x < STREET_M:
            wide, at, tall = rng.uniform(6.0, 16.0), rng.uniform(12.0, 16.0), rng.uniform(3.0, 8.0)
            boxes.append(_box((x, side * at, 0.0), (x + wide, side * (at + 9.0), tall), rng.uniform(0.45, 0.75)))
            x += wide + rng.choice([0.0, 3.0])
        for x in np.arange(-5.0, STREET_M, 2.0):
            y, z = side * rng.uniform(3.5, 11.0), rng.choice([0.0, rng.uniform(0.5, 4.5)])
            size = rng.uniform(0.3, 2.2, 3)
            albedo = rng.choice([rng.uniform(0.02, 0.15), rng.uniform(0.85, 1.0)])
            boxes.append(_box((x, y, z), (x + size[0], y + side * size[1], z + size[2]), albedo))
    table = np.array(boxes)
    return Street(table[:, :3], table[:, 3:6], table[:, 6])


def _box(a: tuple[float, float, float], b: tuple[float, float, float], albedo: float) -> tuple[float, ...]:
    return (*(min(pair) for pair in zip(a, b, strict=True)), *(max(pair) for pair in zip(a, b, strict=True)), albedo)


def rays(model: str, intrinsics: Mapping[str, float], uv_px: Array) -> Array:
    """(N, 3) unit vectors in the camera frame that fall on pixels (N, 2): Newton's method on the plain formula."""
    pixels = CAMERA_PIXELS[model]
    middle, focal = np.array([intrinsics["cx"], intrinsics["cy"]]), intrinsics["fx"]
    slope = (uv_px - middle) / (focal / (1.0 + intrinsics.get("xi", 0.0)) if model == "mei" else focal)

    def project(m: Array) -> Array:
        return pixels(intrinsics, np.column_stack([m, np.ones(len(m))]))

    for _ in range(12):
        step = 1e-6
        at = project(slope)
        du, dv = ((project(slope + step * np.eye(2)[axis]) - at) / step for axis in (0, 1))
        off, det = uv_px - at, du[:, 0] * dv[:, 1] - dv[:, 0] * du[:, 1]
        slope = slope + np.column_stack(
            [(off[:, 0] * dv[:, 1] - off[:, 1] * dv[:, 0]) / det, (off[:, 1] * du[:, 0] - off[:, 0] * du[:, 1]) / det]
        )
    assert np.abs(project(slope) - uv_px).max() < 1e-6, model
    direction = np.column_stack([slope, np.ones(len(slope))])
    return np.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True))


@dataclass(frozen=True)
class Camera:
    """Its rays, in its own frame (H·W, 3)."""

    model: str
    direction: Array = field(repr=False)

    @classmethod
    def of(cls, model: str) -> Camera:
        v, u = np.meshgrid(np.arange(float(HEIGHT)), np.arange(float(WIDTH)), indexing="ij")
        return cls(model, rays(model, LENSES[model], np.column_stack([u.ravel(), v.ravel()])))

    def picture(self, place: Street, x_m: float, turned_rad: float) -> tuple[Array, NDArray[np.float32]]:
        """Brightness 0 to 1 (H, W), and range in metres (H, W)."""
        T = np.array(T_CAMERA_LIDAR)
        direction = self.direction @ _turn(turned_rad)  # of the camera as it is mounted now, in its nominal frame
        centre = np.array([x_m, 0.0, HEIGHT_M]) - T[:3, :3].T @ T[:3, 3]
        metres, albedo = place.seen(np.broadcast_to(centre, direction.shape), direction @ T[:3, :3])
        metres = np.where(metres < SKY_M, metres, 0.0).reshape(HEIGHT, WIDTH)
        return _blurred(albedo.reshape(HEIGHT, WIDTH)), metres.astype(np.float32)


def _blurred(values: Array) -> Array:
    """Every pixel with its neighbours, (1 2 1) / 4 across and down."""
    for axis in (0, 1):
        padded = np.pad(values, [(1, 1) if one == axis else (0, 0) for one in (0, 1)], mode="edge")
        before, here, after = (np.take(padded, np.arange(k, k + values.shape[axis]), axis) for k in range(3))
        values = 0.25 * before + 0.5 * here + 0.25 * after
    return values


def _turn(yaw_rad: float) -> Array:
    """Rotation about the vertical axis of a camera (3, 3)."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def sweep(drive: Drive, place: Street, x_m: float) -> dict[str, NDArray[np.generic]]:
    """A sweep while the vehicle drives: its points are where they were when each was measured."""
    azimuth = np.radians(np.linspace(drive.half_view_deg, -drive.half_view_deg, drive.columns, endpoint=False))
    elevation = np.radians(np.linspace(14.0, -25.0, drive.beams))
    a, e = (grid.ravel() for grid in np.meshgrid(azimuth, elevation, indexing="ij"))
    ring = np.tile(np.arange(drive.beams, dtype=np.uint16), drive.columns)
    after_s = -a / (2.0 * np.pi) * REVOLUTION_S
    direction = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    origin = np.column_stack([x_m + drive.speed_mps * after_s, np.zeros(len(a)), np.full(len(a), HEIGHT_M)])
    metres, albedo = place.seen(origin, direction)
    back = metres < SKY_M
    return {
        "xyz": (direction * metres[:, None])[back].astype(np.float32),
        "intensity": (100.0 * albedo[back]).astype(np.float32),
        "ring": ring[back],
        "time_offset_s": after_s[back].astype(np.float32),
    }


def write(drive: Drive, folder: Path) -> Path:
    """The drive as a folder with a `dataset.yaml`; returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    place, camera = street(drive.seed), Camera.of(drive.lens)
    frames = []
    for index in range(drive.pairs):
        x_m = index * SPACING_S * drive.speed_mps
        late = index >= drive.pairs / 2
        bright, metres = camera.picture(place, x_m, np.radians(drive.turned_deg) if late else 0.0)
        grey = np.rint(np.clip(bright * drive.brightness, 0.0, 1.0) * 255.0).astype(np.uint8)
        names = {"image": f"{index}.png", "depth": f"{index}.npy", "cloud": f"{index}.npz"}
        assert cv2.imwrite(str(folder / names["image"]), grey)
        first, step = drive.depth_step // 2, drive.depth_step
        np.save(folder / names["depth"], metres[first::step, first::step])
        np.savez(folder / names["cloud"], **sweep(drive, place, x_m))  # type: ignore[arg-type]
        twist = {"linear_mps": [drive.speed_mps, 0.0, 0.0], "angular_radps": [0.0, 0.0, 0.0]}
        frames.append({**names, "stamp_ns": START_NS + round(index * SPACING_S * NS_PER_S), "twist": twist})
    document = {
        "pair": "front",
        "camera": {"model": drive.lens, "width": WIDTH, "height": HEIGHT, **LENSES[drive.lens]},
        "T_camera_lidar": T_CAMERA_LIDAR,
        "frames": frames,
    }
    (folder / "dataset.yaml").write_text(json.dumps(document), encoding="utf-8")  # JSON is YAML
    return folder
