"""How often a right mount would be accused, from how far off places are."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from math import exp

import numpy as np
import pytest

from coec_lab.experiments.check_statistics import MIN_PLACES, PlaceChecks, bound, tail
from coec_lab.experiments.simulation_schemas import Judged
from lab.experiments.test_check_statistics import judged

PLACE_RAD = 0.001
"""Of `judged`, and its displacement of one degree in these."""


def displaced(sigmas: float) -> tuple[Judged, ...]:
    """Three checks of a place, a little apart."""
    return tuple(judged(float(np.degrees(PLACE_RAD * (sigmas + separation)))) for separation in (-0.1, 0.0, 0.1))


def farther_than(sigmas: float, checks: Sequence[Judged]) -> bool:
    """A detector that looks at the mean of the last checks alone."""
    offsets = np.array([np.array(check.offset) / np.array(check.place) for check in checks[-4:]])
    return bool(np.abs(offsets.mean(axis=0)).max() > sigmas)


def test_places_are_where_clear_checks_put_them() -> None:
    places = PlaceChecks.from_drives(
        [displaced(3.0), (judged(9.0, faint=("looks",)),), (*displaced(-2.0), judged(9.0, causes=("dark",)))]
    )
    np.testing.assert_allclose(places.displacement, [3.0, 2.0])
    assert [len(checks) for checks in places.checks] == [3, 3]


def test_a_check_that_is_off_alone_displaces_no_place() -> None:
    places = PlaceChecks.from_drives([(*displaced(1.0), *displaced(1.0), judged(9.0))])
    np.testing.assert_allclose(places.displacement, [1.0])


def test_few_checks_do_not_report_a_place_that_is_off_from_a_bad_check() -> None:
    assert PlaceChecks.from_drives([displaced(1.0)[:2], (judged(9.0),)]).checks == ()


def test_a_check_just_after_a_faint_one_may_not_accuse_and_is_of_no_place() -> None:
    places = PlaceChecks.from_drives([(judged(9.0, faint=("looks",)), judged(9.0), judged(9.0), *displaced(1.0))])
    np.testing.assert_allclose(places.displacement, [1.0])


def test_places_count_in_what_their_scene_can_decide() -> None:
    dispersed = tuple(check.model_copy(update={"dispersion": 4.0}) for check in displaced(6.0))
    np.testing.assert_allclose(PlaceChecks.from_drives([dispersed]).displacement, [1.5])


def test_a_tail_goes_on_as_what_was_seen_falls_off() -> None:
    seen = np.random.default_rng(1).exponential(1.0, 2_000)
    weight, beyond = tail(seen, np.array([1.0, 3.0, 6.0]))
    assert weight.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(weight @ beyond, [exp(-1.0), exp(-3.0), exp(-6.0)], rtol=0.35)


def test_few_places_leave_more_to_the_tail_than_many() -> None:
    seen = np.random.default_rng(2).exponential(1.0, 1_000)
    few, many = (
        float(np.sum(weight * beyond[:, 0]))
        for weight, beyond in (tail(of, np.array([8.0])) for of in (seen[:20], seen))
    )
    assert few > 3.0 * many


def test_a_detector_that_bears_more_alarms_less() -> None:
    samples = np.random.default_rng(3).exponential(0.5, 60)
    places = PlaceChecks.from_drives([displaced(float(far)) for far in samples])
    strict, lenient = (bound(places, 4, 6.0, partial(farther_than, at)) for at in (4.0, 12.0))
    assert strict is not None
    assert lenient is not None
    assert (strict.half, lenient.half) == (5.0, 13.0)
    assert lenient.mean < strict.mean < strict.at_most
    assert lenient.at_most < strict.at_most


def test_a_detector_that_never_alarms_has_no_rate() -> None:
    places = PlaceChecks.from_drives([displaced(1.0 + 0.01 * n) for n in range(MIN_PLACES)])
    result = bound(places, 4, 6.0, lambda _: False)
    assert result is not None
    assert (result.mean, result.at_most, result.half) == (0.0, 0.0, None)


def test_too_few_places_have_no_tail() -> None:
    assert bound(PlaceChecks.from_drives([displaced(1.0)] * (MIN_PLACES - 1)), 4, 6.0, lambda _: False) is None
