"""What a window was told is believed until the window contradicts it; then it says what, and by how much."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from coec.calibration.uncertainty.nuisance_parameters import (
    CLOCKS,
    CLOCKS_FREE,
    HELD_FREE,
    LEAST_PX,
    LENS,
    LENS_FREE,
    SHIFTS,
    RelaxedAssumption,
    relax_assumptions,
    weight_beyond_turn,
)
from coec.config import VerdictConfig
from coec.geometry import se3
from support.scenes import (
    CORNER_CAMERA,
    CORNER_FRAMES,
    IDENTITY_POSE,
    corner_edge_levels,
    corner_motions,
    corner_pixels,
    corner_points,
    corner_window,
)

KNOWN_M = VerdictConfig().held_translation_sigma_m


def by_name(result: tuple[RelaxedAssumption, ...]) -> dict[str, RelaxedAssumption]:
    return {one.name: one for one in result}


@pytest.mark.parametrize("held", [(), (3, 4, 5)])
def test_what_is_right_is_not_contradicted(held: tuple[int, ...], rng: np.random.Generator) -> None:
    """The pose itself may be off by a little: that is no fault of what was told."""
    points, neighbour = corner_points(rng), se3.perturbation(np.array([1e-3, -1e-3, 1e-3, 0.0, 0.0, 0.0]))
    result = relax_assumptions(
        corner_edge_levels(corner_pixels(points), points), corner_window(corner_motions()), neighbour, held, KNOWN_M
    )
    assert [one.name for one in result] == [*([HELD_FREE] if held else []), CLOCKS_FREE, LENS_FREE]
    for one in result:
        assert not (one.contradicts and one.matters)
        assert np.linalg.norm(one.shift[:3]) < 2e-3
        assert np.linalg.norm(one.shift[3:]) < 0.03


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
    right, down, longer = deviation
    lens = CORNER_CAMERA._replace(
        fx=CORNER_CAMERA.fx * (1.0 + longer),
        fy=CORNER_CAMERA.fy * (1.0 + longer),
        cx=CORNER_CAMERA.cx + right * CORNER_CAMERA.fx,
        cy=CORNER_CAMERA.cy + down * CORNER_CAMERA.fy,
    )
    turned = se3.perturbation(np.array([-deviation[1], deviation[0], 0.0, 0.0, 0.0, 0.0]))
    seen = corner_pixels(points, lens)
    result = by_name(
        relax_assumptions(corner_edge_levels(seen, points), corner_window(corner_motions()), turned, (), KNOWN_M)
    )
    assert result[LENS_FREE].contradicts
    record_property(
        "figure", f"certainty {result[LENS_FREE].certainty:.1f}, limit {VerdictConfig().max_intrinsics_certainty}"
    )
    assert result[LENS_FREE].certainty > VerdictConfig().max_intrinsics_certainty
    np.testing.assert_allclose(result[LENS_FREE].deviation[LENS], deviation, atol=0.004)
    assert np.linalg.norm(result[CLOCKS_FREE].shift[:3]) < 2e-3
    turn = np.linalg.norm(result[LENS_FREE].shift[:3])
    assert turn == pytest.approx(np.hypot(*deviation[:2]), abs=0.008)


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
    result = by_name(
        relax_assumptions(
            corner_edge_levels(corner_pixels(passed), points), corner_window(driven), IDENTITY_POSE, (), KNOWN_M
        )
    )
    assert result[CLOCKS_FREE].contradicts
    np.testing.assert_allclose(result[CLOCKS_FREE].deviation[CLOCKS], expected_s, atol=0.006)
    assert not (result[LENS_FREE].contradicts and result[LENS_FREE].matters)


@pytest.mark.fault(
    "a camera whose centre is 6 cm from where it is held", "the window says so, with the rotation that this causes"
)
def test_a_centre_that_was_held_elsewhere_is_seen_and_its_turn_reported(rng: np.random.Generator) -> None:
    points, truth = corner_points(rng), np.array([0.0, 0.0, 0.0, 0.05, -0.03, 0.0])
    near = [at[at[:, 2] < 8.0] for at in points]
    seen = corner_pixels([at + truth[3:] for at in near])
    result = by_name(
        relax_assumptions(
            corner_edge_levels(seen, near), corner_window(corner_motions()), IDENTITY_POSE, (3, 4, 5), KNOWN_M
        )
    )
    assert result[HELD_FREE].contradicts
    np.testing.assert_allclose(result[HELD_FREE].deviation[list(SHIFTS)], truth[3:], atol=0.01)
    assert not by_name(
        relax_assumptions(
            corner_edge_levels(seen, near), corner_window(corner_motions()), se3.perturbation(truth), (3, 4, 5), KNOWN_M
        )
    )[HELD_FREE].contradicts


def test_a_standing_vehicle_is_uninformative_of_its_clocks(rng: np.random.Generator) -> None:
    points = corner_points(rng)
    result = relax_assumptions(
        corner_edge_levels(corner_pixels(points), points),
        corner_window(corner_motions(speed=0.0)),
        IDENTITY_POSE,
        (),
        KNOWN_M,
    )
    assert [one.name for one in result] == [LENS_FREE]


def test_where_nothing_is_in_view_nothing_is_requested(rng: np.random.Generator) -> None:
    behind = [-at for at in corner_points(rng)]
    assert (
        relax_assumptions(
            corner_edge_levels(corner_pixels(corner_points(rng)), behind),
            corner_window(corner_motions()),
            IDENTITY_POSE,
            (),
            KNOWN_M,
        )
        == ()
    )


def test_the_same_window_gives_the_same_bits(rng: np.random.Generator) -> None:
    points = corner_points(rng)
    edges, of = (
        corner_edge_levels(corner_pixels(points, CORNER_CAMERA._replace(cx=242.0)), points),
        corner_window(corner_motions()),
    )
    one, other = (relax_assumptions(edges, of, IDENTITY_POSE, (), KNOWN_M) for _ in range(2))
    for a, b in zip(one, other, strict=True):
        assert (a.certainty, a.moved_px) == (b.certainty, b.moved_px)
        np.testing.assert_array_equal(a.deviation, b.deviation)


@pytest.mark.parametrize(("moved_px", "share"), [(0.0, 0.0), (LEAST_PX, 0.5), (10.0 * LEAST_PX, 0.99)])
def test_a_lens_is_believed_by_what_it_moves_beyond_what_edges_leave(moved_px: float, share: float) -> None:
    """Beside the turn that answers it: hardly anything of a principal point that a turn makes up for."""
    assert weight_beyond_turn(moved_px) == pytest.approx(share, abs=1e-3)
