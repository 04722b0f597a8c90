"""The significance of range edges on charts: against its plain form, against that through the lens, and its climb."""

from collections.abc import Iterator

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from coec.geometry import se3
from coec.geometry.cameras import Camera, build, in_image
from coec.geometry.edges.alignment import EdgeFrames
from coec.geometry.edges.alignment import significances as through_the_lens
from coec.geometry.edges.charts import (
    MAX_CHART_POINTS,
    MAX_FIELD_RAD,
    WEIGHT_STEPS,
    EdgeCharts,
    charted_significances,
    edge_charts,
    pattern_search,
    select_separated,
)
from coec.geometry.edges.image_edges import BLUR_SIGMA_PX, STRENGTH_STEPS, VOID
from coec.geometry.projection import project, unproject
from support.oracles import charted_sums, gaussian_blur, stereographic_ray

WIDTH, HEIGHT = 96, 64
SENSOR = {"width": WIDTH, "height": HEIGHT, "fx": 60.0, "fy": 61.0, "cx": 47.2, "cy": 30.9}
WIDE = SENSOR | {"fx": 30.0, "fy": 31.0}
CAMERAS: dict[str, Camera] = {
    "pinhole": build("pinhole", **SENSOR),
    "radtan": build("radtan", **SENSOR, k1=-0.1, k2=0.02, p1=0.001, p2=-0.001, k3=0.0),
    "kannala_brandt": build("kannala_brandt", **WIDE, k1=-0.02, k2=0.01, k3=0.0, k4=0.0),
    "mei": build("mei", **(SENSOR | {"fx": 90.0, "fy": 91.0}), xi=1.5, k1=0.01, k2=0.0, p1=0.0, p2=0.0),
    "eucm": build("eucm", **WIDE, alpha=0.6, beta=1.1),
    "double_sphere": build("double_sphere", **(SENSOR | {"fx": 20.0, "fy": 21.0}), xi=-0.2, alpha=0.6),
}
MODELS = [pytest.param(model, marks=pytest.mark.slow) if model == "radtan" else model for model in CAMERAS]
"""A kernel is compiled for each, before the tests but for this one, of which no other test has need."""
POSE = se3.perturbation(np.array([0.1, -0.2, 0.05, 0.3, -0.1, 0.2]))
ANYWHERE = np.array([np.pi, 1e6])


def blur_rad(camera: Camera) -> float:
    """Two pixels, as an angle about the optical axis."""
    (axis, offset), _ = project(camera, np.array([[0.0, 0.0, 1.0], [1e-3, 0.0, 1.0]]))
    return BLUR_SIGMA_PX * 1e-3 / float(offset[0] - axis[0])


def maps_of(frames: int, seed: int, blank: float) -> NDArray[np.int8]:
    """Noise as smooth as edge maps are; `blank` is the share of masked pixels."""
    rng = np.random.default_rng(seed)
    maps = np.stack([gaussian_blur(rng.normal(size=(HEIGHT, WIDTH)), BLUR_SIGMA_PX, 7) for _ in range(frames)])
    maps /= maps.std(axis=(1, 2), keepdims=True)
    steps = np.clip(np.rint(STRENGTH_STEPS * maps), -127, 127).astype(np.int8)
    steps[rng.random(maps.shape) < blank] = VOID
    return steps


def both(
    camera: Camera, counts: tuple[int, ...], seed: int = 0, blank: float = 0.1
) -> tuple[EdgeCharts, EdgeFrames, NDArray[np.int64]]:
    """Points all around, a part of them behind the camera: on charts, through the lens, and the frame of each."""
    rng = np.random.default_rng(seed)
    xyz_m = rng.normal(scale=10.0, size=(3, sum(counts))).astype(np.float32)
    weight = rng.uniform(0.7, np.sqrt(3.0), sum(counts)).astype(np.float32)
    frame, maps = np.repeat(np.arange(len(counts)), counts), maps_of(len(counts), seed, blank)
    first_point = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    charts = edge_charts(camera, maps, blur_rad(camera), xyz_m, weight, frame)
    return charts, EdgeFrames(camera, xyz_m, weight, first_point, maps), frame


def turned(pose: NDArray[np.float64], angle_rad: float, count: int, seed: int = 5) -> NDArray[np.float64]:
    axes = np.random.default_rng(seed).normal(size=(count, 3))
    axes *= angle_rad / np.linalg.norm(axes, axis=1, keepdims=True)
    return np.stack([se3.perturb(pose, np.array([*axis, 0.0, 0.0, 0.0])) for axis in axes])


def chart_of(charts: EdgeCharts, frame: int) -> NDArray[np.int8]:
    height, width = charts.size
    return charts.cells[1 + frame * height * width :][: height * width].reshape(height, width)


def plain_z(charts: EdgeCharts, pose: NDArray[np.float64]) -> float:
    """By the oracle, from sums that are whole numbers and therefore exact."""
    T, (x, y, z) = pose[:3].astype(np.float32), charts.xyz_m
    p_camera = np.stack([T[i, 0] * x + T[i, 1] * y + T[i, 2] * z + T[i, 3] for i in range(3)], axis=1)
    unit, strength, square = np.float32(charts.cells_per_unit), 0, 0
    for f in np.unique(charts.frame):
        of_frame = charts.frame == f
        sums = charted_sums(p_camera[of_frame], charts.weight[of_frame], chart_of(charts, f), unit, charts.centre)
        strength, square = strength + sums[0], square + sums[1]
    return float(strength / (STRENGTH_STEPS * np.sqrt(max(float(square), 1.0))))


# ------------------------------------------------------------------------------------------------------- the charts
@pytest.mark.parametrize("model", MODELS)
def test_a_cell_holds_the_strength_of_the_pixel_that_its_direction_falls_on(model: str) -> None:
    camera = CAMERAS[model]
    charts, frames, _ = both(camera, (10, 10))
    columns, rows = np.meshgrid(np.arange(charts.size[1]), np.arange(charts.size[0]))
    plane = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    selected = np.random.default_rng(1).permutation(len(plane))[:3000]
    rays = [stereographic_ray(*((plane[k] - charts.centre) / charts.cells_per_unit)) for k in selected]
    uv_px, valid = project(camera, np.array(rays))
    seen = valid & in_image(camera, uv_px)
    assert 0.2 < seen.mean() < 1.0
    for f in (0, 1):
        result = chart_of(charts, f).ravel()[selected]
        expected = np.full(len(selected), VOID)
        for k in np.flatnonzero(seen):
            expected[k] = frames.maps[f, int(np.floor(uv_px[k, 1] + 0.5)), int(np.floor(uv_px[k, 0] + 0.5))]
        assert (result == expected).all()


@pytest.mark.parametrize("model", MODELS)
def test_every_pixel_has_a_place_on_the_chart(model: str) -> None:
    camera = CAMERAS[model]
    charts, _, _ = both(camera, (10,))
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays, valid = unproject(camera, np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64))
    rays = rays[valid & (rays[:, 2] > np.cos(MAX_FIELD_RAD))]
    at = charts.centre + charts.cells_per_unit * rays[:, :2] / (1.0 + rays[:, 2:])
    # Where the field ends within the image, by less than a cell.
    assert at.min() > -1.0
    assert (at.max(axis=0) < [charts.size[1], charts.size[0]]).all()


def test_a_cell_holds_the_strongest_edges() -> None:
    maps = np.zeros((1, HEIGHT, WIDTH), np.int8)
    maps[0, :, : WIDTH // 2], maps[0, :, WIDTH // 2 :] = 127, -127
    camera, nowhere = CAMERAS["pinhole"], np.zeros((3, 0), np.float32)
    charts = edge_charts(camera, maps, blur_rad(camera), nowhere, np.zeros(0, np.float32), np.zeros(0, np.int64))
    assert set(np.unique(charts.cells)) == {127, VOID, -127}


def test_so_many_points_that_their_sums_might_not_fit_are_refused() -> None:
    camera, count = CAMERAS["pinhole"], MAX_CHART_POINTS + 1
    xyz_m, weight = np.ones((3, count), np.float32), np.ones(count, np.float32)
    with pytest.raises(ValueError, match="thin them"):
        edge_charts(camera, maps_of(1, 0, 0.0), blur_rad(camera), xyz_m, weight, np.zeros(count, np.int64))


def test_the_sums_of_as_many_points_as_are_allowed_fit() -> None:
    """All of them of the greatest weight, on the strongest edge."""
    camera, count = CAMERAS["pinhole"], MAX_CHART_POINTS
    xyz_m = np.tile(np.array([[0.0], [0.0], [9.0]], np.float32), (1, count))
    maps, weight = np.full((1, HEIGHT, WIDTH), 127, np.int8), np.full(count, np.sqrt(3.0), np.float32)
    charts = edge_charts(camera, maps, blur_rad(camera), xyz_m, weight, np.zeros(count, np.int64))
    z = charted_significances(charts, np.eye(4)[None])[0]
    assert z == pytest.approx(127 / STRENGTH_STEPS * np.sqrt(count), rel=1e-6)


def test_the_frames_of_the_points_are_known() -> None:
    charts, _, frame = both(CAMERAS["eucm"], (3, 0, 5, 2))
    assert charts.frame.tolist() == frame.tolist()
    assert charts.of_points(np.array([0, 4, 9])).frame.tolist() == [0, 2, 3]


# ------------------------------------------------------------------------------------------------- the significance
@pytest.mark.parametrize("model", MODELS)
def test_every_camera_model_agrees_with_the_plain_form_exactly(model: str) -> None:
    charts, _, _ = both(CAMERAS[model], (700, 0, 1, 500))
    poses = np.stack([POSE, np.eye(4), se3.inverse(POSE)])
    assert charted_significances(charts, poses).tolist() == [plain_z(charts, pose) for pose in poses]


@pytest.mark.parametrize("model", MODELS)
def test_every_camera_model_agrees_with_the_sum_through_the_lens(model: str) -> None:
    """A chart rounds to a cell and to a pixel, a fifth of the blur each: what that changes is small, even where every
    point is rounded on its own and the lens is sharper towards its rim than a chart."""
    charts, frames, _ = both(CAMERAS[model], (3000, 3000), blank=0.0)
    poses = np.concatenate([turned(POSE, angle, 40) for angle in (0.1, 0.5, 1.0)])
    on_chart, exact = charted_significances(charts, poses), through_the_lens(frames, poses)
    assert np.std(exact) > 0.7
    assert np.corrcoef(on_chart, exact)[0, 1] > 0.9
    assert np.std(on_chart - exact) < 0.45 * np.std(exact)


def test_points_behind_at_the_camera_and_without_a_number_count_for_nothing() -> None:
    camera = CAMERAS["double_sphere"]
    bad = np.array(
        [
            [0.0, 0.0, -5.0],  # the pole of the projection
            [1e-4, 0.0, -50.0],
            [-1e-3, 2e-3, -10.0],
            [0.0, 0.0, 0.0],
            [np.nan, 1.0, 1.0],
            [1.0, np.inf, 1.0],
        ],
        np.float32,
    )
    good = np.array([[0.1, 0.2, 4.0]], np.float32)
    maps = np.full((1, HEIGHT, WIDTH), STRENGTH_STEPS, np.int8)

    def z_of(points: NDArray[np.float32]) -> float:
        weight, frame = np.ones(len(points), np.float32), np.zeros(len(points), np.int64)
        charts = edge_charts(camera, maps, blur_rad(camera), np.ascontiguousarray(points.T), weight, frame)
        return float(charted_significances(charts, np.eye(4)[None])[0])

    assert z_of(good) == 1.0
    assert z_of(bad) == 0.0
    assert z_of(np.concatenate([bad, good, bad])) == 1.0


def test_masked_pixels_count_for_nothing() -> None:
    charts, _, _ = both(CAMERAS["pinhole"], (500,), blank=1.0)
    assert charted_significances(charts, np.stack([POSE, np.eye(4)])).tolist() == [0.0, 0.0]


def test_weights_are_retained_to_a_step() -> None:
    charts, frames, _ = both(CAMERAS["pinhole"], (500,))
    assert np.abs(charts.weight / WEIGHT_STEPS - frames.weight).max() <= 0.5 / WEIGHT_STEPS


def test_the_order_of_the_points_does_not_matter_to_the_bit() -> None:
    charts, _, _ = both(CAMERAS["kannala_brandt"], (2000, 1500))
    shuffled = charts.of_points(np.random.default_rng(0).permutation(3500))
    poses = turned(POSE, 0.3, 30)
    assert charted_significances(charts, poses).tobytes() == charted_significances(shuffled, poses).tobytes()


@pytest.fixture
def threads() -> Iterator[tuple[int, ...]]:
    """One thread, and as many as there are; afterwards it is as before."""
    before = numba.get_num_threads()
    yield (1, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    numba.set_num_threads(before)


def test_the_number_of_threads_does_not_matter_to_the_bit(threads: tuple[int, ...]) -> None:
    charts, _, _ = both(CAMERAS["mei"], (2000, 1500))
    poses, steps, result = turned(POSE, 0.1, 40), np.array([0.01] * 3 + [0.1] * 3), []
    for count in threads:
        numba.set_num_threads(count)
        ends, z = pattern_search(charts, poses, steps, 2, POSE, ANYWHERE)
        result.append((charted_significances(charts, poses).tobytes(), ends.tobytes(), z.tobytes()))
    assert result[0] == result[1]


# --------------------------------------------------------------------------------------------------------- the climb
def aimed(seed: int = 3) -> EdgeCharts:
    """Two frames whose maps are brightest where their points fall at `POSE`."""
    rng = np.random.default_rng(seed)
    camera, counts = CAMERAS["pinhole"], (60, 80)
    uv = rng.uniform([8, 8], [WIDTH - 8, HEIGHT - 8], (sum(counts), 2))
    depth = rng.uniform(4.0, 30.0, sum(counts))
    rays = np.column_stack([(uv[:, 0] - 47.2) / 60.0, (uv[:, 1] - 30.9) / 61.0, np.ones(len(uv))])
    back = se3.inverse(POSE)
    xyz_m = (rays * depth[:, None]) @ back[:3, :3].T + back[:3, 3]
    maps, frame = np.zeros((2, HEIGHT, WIDTH)), np.repeat([0, 1], counts)
    for index, (u, v) in zip(frame, np.rint(uv).astype(int), strict=True):
        maps[index, v, u] = 1.0
    blurred = np.stack([gaussian_blur(one, BLUR_SIGMA_PX, 7) for one in maps])
    blurred = (blurred - blurred.mean(axis=(1, 2), keepdims=True)) / blurred.std(axis=(1, 2), keepdims=True)
    return edge_charts(
        camera,
        np.clip(np.rint(STRENGTH_STEPS * blurred), -127, 127).astype(np.int8),
        blur_rad(camera),
        xyz_m.T.astype(np.float32),
        np.ones(sum(counts), np.float32),
        frame,
    )


TURNS = np.radians([0.5, 0.5, 0.5, 0.0, 0.0, 0.0])
ALL_AXES = np.array([0.01] * 3 + [0.1] * 3)


def test_a_ascent_returns_to_the_pose_that_the_maps_were_made_for() -> None:
    # Two degrees are two pixels of this camera, the width of the blur.
    ends, _ = pattern_search(aimed(), turned(POSE, np.radians(2.0), 12), TURNS, 4, np.eye(4), ANYWHERE)
    errors_deg = [np.degrees(se3.rotation_angle_rad(end @ se3.inverse(POSE))) for end in ends]
    # Half a pixel, to which the maps were rounded.
    assert max(errors_deg) < 0.5


def test_a_ascent_never_ends_below_its_start_and_reports_where_it_is() -> None:
    charts = aimed()
    starts = np.concatenate([turned(POSE, angle, 20) for angle in (0.0, 0.05, 0.2, 0.6)])
    before = starts.copy()
    ends, z = pattern_search(charts, starts, ALL_AXES, 4, np.eye(4), ANYWHERE)
    assert (starts == before).all()
    assert (z >= charted_significances(charts, starts)).all()
    assert z.tolist() == charted_significances(charts, ends).tolist()
    assert all(se3.is_rigid(end) for end in ends)


def stepped(pose: NDArray[np.float64], axis: int, amount: float) -> NDArray[np.float64]:
    return (
        se3.perturb(pose, amount * np.eye(6)[axis])
        if axis < 3
        else pose + amount * np.outer(np.eye(4)[axis - 3], [0, 0, 0, 1])
    )


def test_no_further_step_of_the_last_size_leads_up() -> None:
    charts, halvings = aimed(), 2
    ends, z = pattern_search(charts, turned(POSE, 0.03, 10), ALL_AXES, halvings, np.eye(4), ANYWHERE)
    for end, reached in zip(ends, z, strict=True):
        around = [
            stepped(end, axis, sign * ALL_AXES[axis] * 0.5**halvings) for axis in range(6) for sign in (-1.0, 1.0)
        ]
        assert charted_significances(charts, np.stack(around)).max() <= reached


def test_a_ascent_stays_within_reach() -> None:
    charts, reach = aimed(), np.array([np.radians(1.0), 0.05])
    away = se3.perturb(POSE, np.array([np.radians(2.0), 0.0, 0.0, 0.2, 0.0, 0.0]))
    ends, z = pattern_search(charts, away[None], ALL_AXES, 3, away, reach)
    moved = ends[0] @ se3.inverse(away)
    assert z[0] > charted_significances(charts, away[None])[0]
    assert 0.5 * reach[0] < se3.rotation_angle_rad(moved) <= reach[0] + 1e-9
    assert np.linalg.norm(moved[:3, 3]) <= reach[1] + 1e-5


def test_a_ascent_without_steps_of_translation_turns_about_the_camera_axes_only() -> None:
    starts = turned(POSE, np.radians(2.0), 12)
    ends, _ = pattern_search(aimed(), starts, TURNS, 4, np.eye(4), ANYWHERE)
    moved = np.array([end @ se3.inverse(start) for start, end in zip(starts, ends, strict=True)])
    assert np.abs(moved[:, :3, 3]).max() < 1e-12
    assert np.abs(moved[:, :3, :3] - np.eye(3)).max() > 1e-3


# -------------------------------------------------------------------------------------------------------- apart
@pytest.mark.parametrize("count", [1, 5, 200])
def test_what_is_retained_is_spread_and_what_is_left_out_does_not(count: int) -> None:
    poses = turned(np.eye(4), 0.3, 150, seed=2)
    order = np.random.default_rng(4).permutation(150)
    limit_rad = 0.1
    retained = select_separated(poses, order, count, 1.0 + 2.0 * np.cos(limit_rad)).tolist()
    expected: list[int] = []
    for index in order.tolist():
        gaps = [se3.rotation_angle_rad(poses[index] @ se3.inverse(poses[other])) for other in expected]
        if len(expected) < count and min(gaps, default=np.pi) >= limit_rad:
            expected.append(index)
    assert retained == expected
