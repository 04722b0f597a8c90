"""What a window says of its pose, lens, clocks and centre together; and that this depends on the window alone."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from coec.calibration.types import EgoMotion, Matrix4, Window
from coec.calibration.uncertainty.displaced_edges import CLOCKS, LENS, SHIFTS
from coec.calibration.uncertainty.posterior import (
    CENTRE_OFF,
    CLOCKS_OFF,
    CROPPED_DOWN,
    NAMES,
    NOMINAL,
    OF_LENS,
    Assumptions,
    Posterior,
    log_odds,
    measure_posterior,
    other_centre,
)
from coec.config import VerdictConfig
from coec.geometry import se3
from coec.geometry.cameras import Camera
from coec.geometry.edges.alignment import EdgeFrames
from support.scenes import (
    CORNER_CAMERA,
    CORNER_FRAMES,
    IDENTITY_POSE,
    Array,
    corner_edge_levels,
    corner_motions,
    corner_pixels,
    corner_points,
    corner_window,
)

KNOWN_M = VerdictConfig().held_translation_sigma_m
LENS_SIGMA = 1.0, VerdictConfig().focal_length_sigma
ALL_HELD = (3, 4, 5)


def posterior_at(assumed: Assumptions, pose: Matrix4) -> Posterior | None:
    return measure_posterior(assumed, assumed.levels_at(pose))


def measured(
    levels: list[EdgeFrames],
    motions: list[EgoMotion],
    pose: Matrix4 = IDENTITY_POSE,
    held: Sequence[int] = (),
    known_m: float = KNOWN_M,
) -> Posterior:
    result = posterior_at(Assumptions(levels, corner_window(motions), held, known_m, LENS_SIGMA), pose)
    assert result is not None
    return result


def other_lens(right: float, down: float, longer: float) -> Camera:
    camera = CORNER_CAMERA
    return camera._replace(
        fx=camera.fx * (1.0 + longer),
        fy=camera.fy * (1.0 + longer),
        cx=camera.cx + right * camera.fx,
        cy=camera.cy + down * camera.fy,
    )


MEASURED: dict[tuple[int, ...], Posterior] = {}
"""What is right, by what is held: several tests look at it."""


def of_what_is_right(held: tuple[int, ...], rng: np.random.Generator) -> Posterior:
    """Next to the pose that is."""
    if held not in MEASURED:
        points, neighbour = corner_points(rng), se3.perturbation(np.array([1e-3, -1e-3, 1e-3, 0.0, 0.0, 0.0]))
        levels = corner_edge_levels(corner_pixels(points), points)
        MEASURED[held] = measured(levels, corner_motions(), neighbour, held)
    return MEASURED[held]


@pytest.mark.parametrize("held", [(), ALL_HELD])
def test_what_is_right_is_not_contradicted(held: tuple[int, ...], rng: np.random.Generator) -> None:
    """The pose itself may be off by a little: that is no fault of what was assumed."""
    result = of_what_is_right(held, rng)
    assert result.probability(NOMINAL) > 0.8
    np.testing.assert_allclose(result.hypotheses[0].deviation[:3], [-1e-3, 1e-3, -1e-3], atol=1e-3)
    assert 0.0 < result.independent_share <= 1.0


@pytest.mark.fault("intrinsics that are off by 2 % or by four pixels", "the window says so, with the size")
@pytest.mark.parametrize(
    "deviation", [(0.0, 0.0, 0.02), (4 / 240, -3 / 240, 0.0)], ids=["focal length", "principal point"]
)
def test_another_lens_is_seen_and_reported(
    deviation: tuple[float, float, float],
    rng: np.random.Generator,
    record_property: Callable[[str, object], None],
) -> None:
    """The pose is the one that makes up for it best as far as a turn can."""
    points = corner_points(rng)
    turned = se3.perturbation(np.array([-deviation[1], deviation[0], 0.0, 0.0, 0.0, 0.0]))
    result = measured(
        corner_edge_levels(corner_pixels(points, other_lens(*deviation)), points), corner_motions(), turned
    )
    record_property("figure", f"probability of another lens {result.probability(*OF_LENS):.3f}")
    assert result.probability(*OF_LENS) > 0.99
    lens = result.of(*OF_LENS)
    assert lens is not None
    np.testing.assert_allclose(lens.lens[:3], deviation, atol=0.003)
    assert (np.abs(lens.lens[:3] - deviation) < 4.0 * lens.lens_sigma[:3]).all()
    sigma = np.linalg.norm([one[:3] for one in result.shifts(range(6)).values()])
    error = se3.difference(se3.perturb(turned, result.step(range(6))), IDENTITY_POSE)[:3]
    assert sigma > 0.8 * np.linalg.norm(error)


@pytest.mark.fault("intrinsics of another camera, a crop or a scale", "the window says so, with the size")
@pytest.mark.parametrize(
    "deviation",
    [
        (0.04, 0.06, 0.0),
        (0.0, 0.0, 0.25),
        pytest.param((-0.07, 0.0, 0.0), marks=pytest.mark.slow),
        pytest.param((0.0, 0.0, -0.2), marks=pytest.mark.slow),
    ],
)
def test_a_grossly_wrong_lens_is_reported_from_the_pose_that_it_led_to(
    deviation: tuple[float, float, float], rng: np.random.Generator
) -> None:
    points, (right, down, longer) = corner_points(rng), deviation
    astray = se3.perturbation(np.array([-down + 0.5 * longer * 0.02, right, 0.01 * longer, 0.0, 0.0, 0.0]))
    result = measured(
        corner_edge_levels(corner_pixels(points, other_lens(*deviation)), points), corner_motions(), astray
    )
    lens = result.of(*OF_LENS)
    assert lens is not None
    assert result.probability(*OF_LENS) > 0.99
    assert lens.lens[:3] == pytest.approx([right, down, longer], abs=0.004)


@pytest.mark.fault(
    "a crop of a low image with the principal point of the whole one", "the window says so, with the size"
)
def test_a_crop_of_a_low_image_is_no_turn(rng: np.random.Generator) -> None:
    """What a low image shows of it is little, so that only a hypothesis with one parameter more has the evidence."""
    points, down = [at[np.abs(at[:, 1]) < 0.2 * at[:, 2]] for at in corner_points(rng)], 0.08
    astray = se3.perturbation(np.array([-down, 0.0, 0.0, 0.0, 0.0, 0.0]))
    result = measured(
        corner_edge_levels(corner_pixels(points, other_lens(0.0, down, 0.0)), points), corner_motions(), astray
    )
    cropped = result.of(CROPPED_DOWN)
    assert cropped is not None
    assert cropped.probability > 0.9
    assert cropped.lens[1] == pytest.approx(down, abs=4.0 * cropped.lens_sigma[1])


@pytest.mark.fault(
    "clocks that are late or drift, or a shutter that rolls, by 30 to 60 ms", "the window says so, with the size"
)
@pytest.mark.parametrize("expected_s", [(0.03, 0.0, 0.0), (0.0, 0.06, 0.0), (0.0, 0.0, 0.04)])
def test_clocks_that_are_off_are_seen_and_reported(
    expected_s: tuple[float, float, float], rng: np.random.Generator
) -> None:
    """The camera is late, later and later, or takes its rows one after the other."""
    points, driven = corner_points(rng), corner_motions()
    passed = []
    for frame, (at, motion) in enumerate(zip(points, driven, strict=True)):
        elapsed, row = frame / (CORNER_FRAMES - 1) - 0.5, corner_pixels([at])[0][:, 1] / CORNER_CAMERA.height - 0.5
        late_s = expected_s[0] + expected_s[1] * elapsed + expected_s[2] * row
        speed = np.array(motion.linear_mps) + np.cross(motion.angular_radps, at)
        passed.append(at - speed * late_s[:, None])
    result = measured(corner_edge_levels(corner_pixels(passed), points), driven)
    clocks = result.of(CLOCKS_OFF)
    assert clocks is not None
    assert clocks.probability > 0.9
    np.testing.assert_allclose(clocks.deviation[list(CLOCKS)], expected_s, atol=0.006)


@pytest.mark.fault(
    "a camera whose centre is 9 cm from where it is held", "the window says so, with the rotation that this causes"
)
@pytest.mark.fault(
    "a camera's centre is 30 cm from where it is held, and the window determines it to 3 cm", "the window is believed"
)
@pytest.mark.parametrize("moved_m", [(0.08, -0.05, 0.0), (0.25, -0.15, 0.0)])
def test_a_centre_that_was_held_elsewhere_is_seen_and_its_turn_reported(
    moved_m: tuple[float, float, float],
    rng: np.random.Generator,
    record_property: Callable[[str, object], None],
) -> None:
    points = corner_points(rng)
    near = [at[at[:, 2] < 8.0] for at in points]
    levels = corner_edge_levels(corner_pixels([at + moved_m for at in near]), near)
    result = measured(levels, corner_motions(), held=ALL_HELD)
    centre = result.of(CENTRE_OFF)
    assert centre is not None
    record_property("figure", f"probability {centre.probability:.3f}")
    assert centre.probability > 0.8
    np.testing.assert_allclose(centre.deviation[list(SHIFTS)], moved_m, atol=0.02)
    truth = se3.perturbation(np.array([0.0, 0.0, 0.0, *moved_m]))
    assert measured(levels, corner_motions(), truth, ALL_HELD).probability(CENTRE_OFF) < 0.1


def test_a_standing_vehicle_is_uninformative_of_its_clocks(rng: np.random.Generator) -> None:
    points = corner_points(rng)
    result = measured(corner_edge_levels(corner_pixels(points), points), corner_motions(speed=0.0))
    assert result.of(CLOCKS_OFF) is None
    assert not {NAMES[place] for place in CLOCKS} & set(result.shifts(range(6)))


def test_where_nothing_is_in_view_nothing_is_known(rng: np.random.Generator) -> None:
    behind = [-at for at in corner_points(rng)]
    levels = corner_edge_levels(corner_pixels(corner_points(rng)), behind)
    assert (
        posterior_at(Assumptions(levels, corner_window(corner_motions()), (), KNOWN_M, LENS_SIGMA), IDENTITY_POSE)
        is None
    )


@pytest.mark.slow  # of kept windows the golden decisions tell the bytes of σ
def test_the_same_window_gives_the_same_bits(rng: np.random.Generator) -> None:
    points = corner_points(rng)
    levels = corner_edge_levels(corner_pixels(points, CORNER_CAMERA._replace(cx=242.0)), points)
    one, other = (measured(levels, corner_motions()) for _ in range(2))
    assert one.independent_share == other.independent_share
    for a, b in zip(one.hypotheses, other.hypotheses, strict=True):
        assert a.probability == b.probability
        np.testing.assert_array_equal(a.deviation, b.deviation)
        np.testing.assert_array_equal(a.covariance, b.covariance)


@pytest.mark.parametrize("count", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_another_end_of_the_search_gives_the_same_posterior(rng: np.random.Generator, count: int) -> None:
    """Where a search stops within its tolerance decides nothing."""
    points = corner_points(rng)
    levels = corner_edge_levels(corner_pixels(points, other_lens(0.0, 0.004, 0.0)), points)
    ends = [se3.perturbation(end) for end in rng.normal(0.0, [1e-4] * 3 + [1e-3] * 3, (count, 6))]
    results = [measured(levels, corner_motions(), end) for end in ends]
    sigmas = np.array([np.sqrt(one.hypotheses[0].covariance.diagonal()[:6]) for one in results])
    assert np.max(np.ptp(sigmas, axis=0) / sigmas.mean(axis=0)) < 0.05
    assert np.ptp([one.probability(NOMINAL) for one in results]) < 0.05
    poses = [se3.perturb(end, one.hypotheses[0].deviation[:6]) for end, one in zip(ends, results, strict=True)]
    assert max(np.linalg.norm(se3.difference(poses[0], pose)[:3]) for pose in poses[1:]) < 1e-4


def test_frames_in_another_order_give_the_same_posterior(rng: np.random.Generator) -> None:
    points, still = corner_points(rng), corner_motions(speed=0.0)
    order = rng.permutation(CORNER_FRAMES)
    one = measured(corner_edge_levels(corner_pixels(points), points), still)
    shuffled = [points[frame] for frame in order]
    other = measured(corner_edge_levels(corner_pixels(shuffled), shuffled), still)
    np.testing.assert_allclose(
        np.sqrt(other.hypotheses[0].covariance.diagonal()[:6]),
        np.sqrt(one.hypotheses[0].covariance.diagonal()[:6]),
        rtol=0.02,
    )


def test_frames_that_repeat_one_view_have_few_independent_edges(rng: np.random.Generator) -> None:
    """The share of independent edges falls as the view is repeated, so that σ does not."""
    (view, *_), still = corner_points(rng), corner_motions(speed=0.0)
    seen = corner_pixels([view])[0] + rng.normal(0.0, 1.0, (len(view), 2))
    once = corner_points(rng)
    noisy = [corner_pixels([at])[0] + rng.normal(0.0, 1.0, (len(at), 2)) for at in once]
    repeated = measured(corner_edge_levels([seen] * CORNER_FRAMES, [view] * CORNER_FRAMES), still)
    different = measured(corner_edge_levels(noisy, once), still)
    assert repeated.independent_share < 0.75 * different.independent_share


def test_an_uncertain_lens_makes_the_pose_uncertain(rng: np.random.Generator) -> None:
    """A principal point that is known to a pixel leaves a turn of a pixel, unless the window tells them apart."""
    points = [at[np.abs(at[:, 1]) < 0.15 * at[:, 2]] for at in corner_points(rng)]
    levels, window = corner_edge_levels(corner_pixels(points), points), corner_window(corner_motions())

    def sigma_pitch(pixels: float) -> float:
        result = posterior_at(Assumptions(levels, window, (), KNOWN_M, (pixels, 0.002)), IDENTITY_POSE)
        assert result is not None
        return float(np.linalg.norm([one[0] for one in result.shifts(range(6)).values()]))

    assert sigma_pitch(0.1) < 0.5 / 240
    assert 0.7 / 240 < sigma_pitch(1.0) < 1.6 / 240


def test_noise_and_shifts_are_the_covariance_of_the_nominal_hypothesis(rng: np.random.Generator) -> None:
    result = of_what_is_right((), rng)
    named = [result.shifts(range(6))[name] for place, name in NAMES.items() if place > 5]
    whole = result.noise(range(6)) + sum(np.outer(one, one) for one in named)
    np.testing.assert_allclose(whole, result.hypotheses[0].covariance[:6, :6], rtol=1e-6, atol=1e-15)


def test_probabilities_sum_to_one_and_their_odds_are_bounded(rng: np.random.Generator) -> None:
    result = of_what_is_right(ALL_HELD, rng)
    assert sum(one.probability for one in result.hypotheses) == pytest.approx(1.0)
    assert log_odds(0.5) == 0.0
    assert np.isfinite([log_odds(0.0), log_odds(1.0)]).all()


def test_one_frame_has_a_posterior(rng: np.random.Generator) -> None:
    """Its sectors are the samples."""
    (view, *_), window = corner_points(rng), corner_window(corner_motions(speed=0.0))
    alone: Window = replace(window, pairs=window.pairs[:1])
    levels = [replace(level, maps=level.maps[:1]) for level in corner_edge_levels(corner_pixels([view]), [view])]
    result = posterior_at(Assumptions(levels, alone, ALL_HELD, KNOWN_M, LENS_SIGMA), IDENTITY_POSE)
    assert result is not None
    sigma: Array = np.sqrt(result.hypotheses[0].covariance.diagonal()[:3])
    assert (sigma < 0.01).all()
    assert len(result.hypotheses[0].deviation[list(LENS)]) == 4


@pytest.mark.fault(
    "markings that repeat along the road fit at two places of the camera",
    "the other place is seen, and that translation is held",
)
@pytest.mark.parametrize(
    ("again", "held", "ambiguous"), [(True, (), True), (False, (), False), (True, ALL_HELD, False)]
)
def test_edges_that_fit_again_further_along_are_seen(
    again: bool, held: tuple[int, ...], ambiguous: bool, rng: np.random.Generator
) -> None:
    points = corner_points(rng)
    seen = corner_pixels(points)
    if again:
        shift_m = np.array([0.0, 0.0, 0.3])
        further = corner_pixels([some[: int(0.95 * len(some))] + shift_m for some in points])
        seen = [np.concatenate(both) for both in zip(seen, further, strict=True)]
    levels, window = corner_edge_levels(seen, points), corner_window(corner_motions())
    assumed = Assumptions(levels, window, held, KNOWN_M, LENS_SIGMA)
    result = posterior_at(assumed, IDENTITY_POSE)
    assert result is not None
    elsewhere = other_centre(assumed, assumed.levels_at(IDENTITY_POSE), result, VerdictConfig().max_sigma_m)
    if ambiguous:
        assert elsewhere is not None
        assert elsewhere.axis == SHIFTS[2]
        assert 0.9 < elsewhere.significance < 1.0
    else:
        assert elsewhere is None or elsewhere.significance < 0.5
