"""The sequential decision: what checks add up to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import TypeAdapter

from coec.calibration.monitor.change_detector import (
    TESTS_PER_CHECK,
    MonitorOutcome,
    MonitorState,
    Observation,
    after_observation,
    after_window,
    alarm_levels,
    diagnose,
    is_acquitted,
)
from coec.calibration.monitor.check_verdict import MIN_PAIRS, observe
from coec.calibration.monitor.sensor_faults import (
    BENT_MOUNT,
    DARK,
    EGO_MOTION_WRONG,
    LENS_DIRTY,
    MOUNT_LOOSE,
    TIME_OFFSET,
    Cause,
)
from coec.calibration.monitor.sequential_tests import LOOSE_AT
from coec.calibration.types import DepthModel, Window
from coec.config import CalibrationConfig, LimitsConfig, MonitorConfig
from coec.errors import CalibrationError
from coec.geometry import se3
from coec.io.images import GreyImages

LEVELS = alarm_levels(MonitorConfig())
RIGHT = np.zeros(6)
OFFSET = np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0])


def seen(
    stamps: Sequence[int],
    flagged: bool = True,
    weak: bool = False,
    causes: tuple[Cause, ...] = (),
    offset: NDArray[np.float64] | None = None,
    standing: bool = False,
    dispersion: float = 1.0,
) -> Observation:
    return Observation(
        stamp_ns=stamps[-1],
        pair_stamps_ns=tuple(stamps),
        metrics=(),
        offset=offset if offset is not None else OFFSET if flagged else RIGHT,
        sigma=np.full(6, 0.001),
        noise=np.full(6, 0.0008),
        place=np.full(6, 0.0005),
        dispersion=dispersion,
        distance2=9.0 if flagged else 0.1,
        flagged=flagged,
        weak=weak,
        flagged_by_paper=None,
        causes=causes,
        standing_stamps_ns=tuple(stamps) if standing else (),
    )


def turned(*degrees: float) -> NDArray[np.float64]:
    return np.radians([*degrees, 0.0, 0.0, 0.0])


def after(*observations: Observation) -> MonitorState:
    state = MonitorState()
    for observation in observations:
        state = after_observation(state, observation, LEVELS)
    return state


def fresh(number: int, **how: object) -> Observation:
    """A check whose pairs no other look holds."""
    return seen(range(10 * number, 10 * number + 5), **how)  # type: ignore[arg-type]


class TestEvidence:
    def test_nothing_seen_is_unknown(self) -> None:
        assert MonitorState().outcome is MonitorOutcome.UNKNOWN
        assert diagnose(MonitorState()) is None

    def test_one_check_decides_nothing(self) -> None:
        state = after(fresh(0))
        assert state.outcome is MonitorOutcome.CLEAR
        assert diagnose(state) is None

    def test_two_checks_are_a_suspicion_and_three_a_certainty(self) -> None:
        assert after(fresh(0), fresh(1)).outcome is MonitorOutcome.SUSPECT
        state = after(fresh(0), fresh(1), fresh(2))
        assert state.outcome is MonitorOutcome.CONFIRMED
        assert diagnose(state) == BENT_MOUNT

    def test_checks_that_put_the_mount_in_different_places_do_not_add_up(self) -> None:
        # As in a tunnel and on an open road of a simulated drive, where the mount is right.
        places = [turned(0.0, -0.4, -2.4), turned(0.9, -0.2, -0.1), turned(4.6, -0.3, -2.2), turned(-1.4, -5.2, 0.3)]
        states = [after(*(fresh(n, offset=place) for n, place in enumerate(places[:count]))) for count in (1, 2, 3, 4)]
        assert [state.outcome for state in states] == [MonitorOutcome.CLEAR, *[MonitorOutcome.AT_ODDS] * 3]
        assert after_observation(states[-1], fresh(9, flagged=False), LEVELS).outcome is MonitorOutcome.CLEAR
        open_still = replace(fresh(9, flagged=False), undecided=True)
        assert after_observation(states[-1], open_still, LEVELS).outcome is MonitorOutcome.AT_ODDS

    @pytest.mark.parametrize("knock", [turned(1.0, 0.0, 0.0), turned(2.0, -2.0, 1.0), turned(5.0, -4.0, 3.0)])
    def test_a_knock_of_any_size_is_the_same_at_every_check(self, knock: NDArray[np.float64]) -> None:
        rng = np.random.default_rng(0)
        # What checks of simulated drives differ by, 0.06° and a fiftieth of the knock.
        spread = np.radians(0.06) + 0.02 * np.abs(knock).max()
        checks = [fresh(n, offset=knock + np.r_[rng.normal(0.0, spread, 3), 0, 0, 0]) for n in range(4)]
        assert after(*checks).outcome is MonitorOutcome.CONFIRMED

    def test_a_shift_is_a_move_too(self) -> None:
        shift = np.array([0.0, 0.0, 0.0, 0.0, 0.05, 0.0])
        assert after(*(fresh(n, offset=shift) for n in range(3))).outcome is MonitorOutcome.CONFIRMED

    def test_one_check_elsewhere_says_nothing_against_a_suspicion_and_does_not_make_another(self) -> None:
        suspect = after(fresh(0), fresh(1))
        elsewhere = after_observation(suspect, fresh(2, offset=turned(-4.0, 3.0, 0.0)), LEVELS)
        assert elsewhere.outcome is MonitorOutcome.SUSPECT
        assert elsewhere.evidence < suspect.evidence + 1.0
        again = after_observation(elsewhere, fresh(3), LEVELS)
        assert after_observation(again, fresh(4), LEVELS).outcome is MonitorOutcome.CONFIRMED

    def test_of_one_place_there_is_one_check_however_long_the_vehicle_stands_there(self) -> None:
        """As long as no check contradicts it: here the vehicle stops where its mount has already moved."""
        state = after(fresh(0, flagged=False), *(fresh(n, standing=True) for n in range(1, 10)))
        assert state.outcome is MonitorOutcome.CLEAR
        assert state.evidence == after(fresh(0, flagged=False), fresh(1, standing=True)).evidence
        assert after_observation(state, fresh(10), LEVELS).outcome is MonitorOutcome.SUSPECT

    def test_checks_at_the_same_pairs_are_one_check(self) -> None:
        assert after(*[seen([1, 2, 3, 4])] * 10).outcome is MonitorOutcome.CLEAR

    def test_one_bad_pair_in_overlapping_checks_decides_nothing(self) -> None:
        # Six pairs to a check, three of them new; the bad pair is in two checks.
        checks = [seen(range(3 * k, 3 * k + 6), flagged=k in (4, 5)) for k in range(10)]
        states = [after(*checks[: k + 1]) for k in range(len(checks))]
        assert {state.outcome for state in states} == {MonitorOutcome.CLEAR}

    def test_clears_with_hysteresis(self) -> None:
        confirmed = [fresh(k) for k in range(10)]
        right = [fresh(10 + k, flagged=False) for k in range(3)]
        assert after(*confirmed, right[0]).outcome is MonitorOutcome.CONFIRMED
        assert after(*confirmed, *right).outcome is MonitorOutcome.CLEAR

    def test_what_confirms_is_no_more_after_an_hour_than_after_a_minute(self) -> None:
        assert after(*(fresh(k) for k in range(720))).evidence == LEVELS.most

    @pytest.mark.fault(
        "every check on a highway is off in the same way", "the mount is accused by no more than such checks can tell"
    )
    def test_what_a_scene_cannot_decide_accuses_nobody(self, record_property: Callable[[str, object], None]) -> None:
        off_alike = [turned(0.4, 0.0, 0.0)] * 60
        states = {
            scene: after(*(fresh(n, offset=offset, dispersion=scene) for n, offset in enumerate(off_alike)))
            for scene in (1.0, 5.0)
        }
        record_property("figure", f"{states[5.0].evidence:.1f} of {LEVELS.confirmed:.1f} nats")
        assert states[1.0].outcome is MonitorOutcome.CONFIRMED
        assert states[5.0].evidence < LEVELS.clear

    def test_clear_checks_just_after_a_faint_one_count_as_faint(self) -> None:
        """As on a highway, where now and then one is clear and as far off as the others."""
        now_and_then = [fresh(n, weak=n % 3 != 2) for n in range(60)]
        assert after(*now_and_then).outcome is MonitorOutcome.SUSPECT
        assert after(*now_and_then, *(fresh(60 + n) for n in range(5))).outcome is MonitorOutcome.CONFIRMED

    def test_a_large_move_is_confirmed_on_a_highway_too(self) -> None:
        assert (
            after(*(fresh(n, offset=turned(2.0, 0.0, 0.0), dispersion=5.0) for n in range(8))).outcome
            is MonitorOutcome.CONFIRMED
        )

    def test_faint_edges_suspect_and_never_confirm(self) -> None:
        state = after(*[fresh(k, weak=True) for k in range(40)])
        assert state.outcome is MonitorOutcome.SUSPECT

    def test_faint_checks_that_are_off_alike_teach_nothing_of_the_rig(self) -> None:
        """So that clear checks of a right mount are no move after a long stretch of them."""
        rain = [fresh(n, offset=turned(0.5, 0.1, 0.6), weak=True) for n in range(60)]
        states = [after(*rain, *(fresh(60 + n, flagged=False) for n in range(count))) for count in (0, 10)]
        assert states[0].turned.right == after(rain[0]).turned.right
        assert states[1].outcome is MonitorOutcome.CLEAR

    def test_a_night_in_which_two_faint_checks_agree_is_no_suspicion(self) -> None:
        # The last five checks of a simulated drive by night, where the mount is right.
        night = [
            fresh(0, offset=turned(-0.6, -2.5, 1.4)),
            fresh(1, offset=turned(1.0, -0.4, 0.3)),
            fresh(2, offset=turned(-2.3, 0.3, 2.1), weak=True),
            fresh(3, offset=turned(0.8, -0.1, 1.4), weak=True),
            fresh(4, offset=turned(-2.6, 0.3, 1.2), weak=True),
        ]
        states = [after(*night[:count]) for count in range(1, 6)]
        assert {state.outcome for state in states[1:]} == {MonitorOutcome.AT_ODDS}

    def test_a_faint_check_at_a_right_pose_says_little_for_it(self) -> None:
        suspect = after(fresh(0), fresh(1))
        faint = after_observation(suspect, fresh(2, flagged=False, weak=True), LEVELS)
        assert faint.outcome is MonitorOutcome.SUSPECT

    def test_a_check_that_does_not_determine_translations_determines_rotations(self) -> None:
        half = np.array([*OFFSET[:3], np.nan, np.nan, np.nan])
        assert after(*(fresh(n, offset=half) for n in range(3))).outcome is MonitorOutcome.CONFIRMED

    def test_goes_through_json(self) -> None:
        state = after(fresh(0), fresh(1), fresh(2, causes=(DARK,)))
        form = TypeAdapter(MonitorState)
        assert form.validate_json(form.dump_json(state)) == state


class TestStandstill:
    def standing(self, number: int, **how: object) -> Observation:
        return fresh(number, standing=True, **how)

    def test_the_acquitting_check_of_a_place_holds_until_another_contradicts_it(self) -> None:
        arrived = after(fresh(0, flagged=False), self.standing(1, flagged=False))
        parked = after(fresh(0, flagged=False), *(self.standing(n, flagged=False) for n in range(1, 700)))
        hour_ns = 3_600_000_000_000
        assert is_acquitted(parked, hour_ns, MonitorConfig())
        assert parked.evidence == arrived.evidence
        faint = replace(self.standing(700, flagged=False), has_power=False, weak=True)
        assert is_acquitted(after_observation(parked, faint, LEVELS), hour_ns, MonitorConfig())
        assert not is_acquitted(after_observation(parked, self.standing(700), LEVELS), hour_ns, MonitorConfig())
        assert not is_acquitted(after_observation(parked, fresh(700), LEVELS), hour_ns, MonitorConfig())

    def test_checks_that_contradict_it_count_but_confirm_nothing(self) -> None:
        moved = [fresh(0, flagged=False), *(self.standing(n, flagged=n > 3) for n in range(1, 60))]
        assert after(*moved[:6]).outcome is MonitorOutcome.SUSPECT
        assert after(*moved).evidence == LEVELS.suspect
        assert after(*moved, *(fresh(60 + n) for n in range(2))).outcome is MonitorOutcome.CONFIRMED

    def test_a_lorry_that_leaves_again_is_forgotten(self) -> None:
        lorry = [fresh(0, flagged=False), *(self.standing(n, flagged=3 < n < 8) for n in range(1, 14))]
        state = after(*lorry)
        assert state.outcome is MonitorOutcome.CLEAR
        assert is_acquitted(state, 10**15, MonitorConfig()), "the place has an acquitting check again"

    def test_another_offset_contradicts_though_neither_check_is_flagged(self) -> None:
        near = turned(0.5, 0.0, 0.0)
        state = after(fresh(0, flagged=False), self.standing(1, flagged=False))
        separation = replace(self.standing(2, flagged=False), offset=near, sigma=np.full(6, 0.01))
        assert after_observation(state, separation, LEVELS).evidence > state.evidence


class TestAcquittal:
    def test_a_check_that_could_not_have_noticed_acquits_nothing(self) -> None:
        assert fresh(0, flagged=False).acquits
        assert not replace(fresh(0, flagged=False), has_power=False).acquits
        assert not replace(fresh(0, flagged=False), undecided=True).acquits
        assert not fresh(0, flagged=False, causes=(DARK,)).acquits

    def test_lasts_for_three_periods_or_three_checks(self) -> None:
        config = MonitorConfig(period_s=5.0)
        state = after(fresh(0, flagged=False))
        assert state.acquitted_ns is not None
        assert is_acquitted(state, state.acquitted_ns + 15_000_000_000, config)
        assert not is_acquitted(state, state.acquitted_ns + 15_000_000_001, config)
        open_still = [replace(fresh(1 + n, flagged=False), undecided=True) for n in range(3)]
        states = [after(fresh(0, flagged=False), *open_still[:count]) for count in (1, 2, 3)]
        assert [is_acquitted(one, 0, config) for one in states] == [True, True, False]

    def test_a_check_next_to_where_the_mount_has_been_acquits_nothing_though_it_is_within_the_limits(self) -> None:
        """Ten centimetres are within what estimators are off on other rigs, but not within what this one was off."""
        rig, noise, place = 0.03, 0.012, 0.01
        displaced = np.array([0.0, 0.0, 0.0, 0.1, 0.0, 0.0])

        def at(number: int, offset: NDArray[np.float64]) -> Observation:
            sigma = np.full(6, float(np.hypot(rig, noise)))
            one = fresh(number, flagged=False, offset=offset)
            return replace(one, sigma=sigma, noise=np.full(6, noise), place=np.full(6, place))

        learned = after(*(at(n, RIGHT) for n in range(12)))
        assert learned.unacquitted == 0
        assert [after_observation(learned, at(12, offset), LEVELS).unacquitted for offset in (RIGHT, displaced)] == [
            0,
            1,
        ]
        retained = after_window(learned, 10**9, LEVELS, solved_translation=False, agrees=False)
        assert after_observation(retained, at(12, displaced), LEVELS).unacquitted == 1, (
            "a window without translation is blind"
        )
        reported = after_window(learned, 10**9, LEVELS, solved_translation=True, agrees=False)
        assert after_observation(reported, at(12, displaced), LEVELS).unacquitted == 0, "a window found it there"

    def test_a_place_where_the_mount_lies_next_to_where_it_has_been_is_not_acquitted_by_standing_there(self) -> None:
        rig, noise = 0.03, 0.012
        displaced = np.array([0.0, 0.0, 0.0, 0.1, 0.0, 0.0])

        def at(number: int, offset: NDArray[np.float64], *, standing: bool = False) -> Observation:
            one = fresh(number, flagged=False, offset=offset, standing=standing)
            sigma = np.full(6, float(np.hypot(rig, noise)))
            return replace(one, sigma=sigma, noise=np.full(6, noise), place=np.full(6, 0.01))

        parked = after(*(at(n, RIGHT) for n in range(12)), *(at(12 + n, displaced, standing=True) for n in range(4)))
        assert not is_acquitted(parked, 0, MonitorConfig())
        assert parked.evidence == after(*(at(n, RIGHT) for n in range(12)), at(12, displaced, standing=True)).evidence

    def test_a_window_without_translation_does_not_clear_a_translation(self) -> None:
        shifted = np.array([0.0, 0.0, 0.0, 0.1, 0.0, 0.0])
        state = after(*(fresh(n, flagged=False) for n in range(5)), *(fresh(5 + n, offset=shifted) for n in range(4)))
        assert state.outcome is MonitorOutcome.CONFIRMED
        retained = after_window(state, 10**9, LEVELS, solved_translation=False, agrees=True)
        assert retained.outcome is MonitorOutcome.CONFIRMED
        assert (
            after_window(state, 10**9, LEVELS, solved_translation=True, agrees=True).outcome is MonitorOutcome.UNKNOWN
        )


class TestMountScatter:
    def swinging(self, degrees: float, count: int) -> list[Observation]:
        rng = np.random.default_rng(2)
        return [fresh(n, flagged=False, offset=turned(rng.normal(0.0, degrees), 0.0, 0.0)) for n in range(count)]

    @pytest.mark.fault("a mount that swings", "`mount_loose`")
    def test_a_mount_that_is_elsewhere_at_every_check_is_loose(self) -> None:
        checks = self.swinging(0.3, 20)
        assert diagnose(after(*checks)) == MOUNT_LOOSE
        tight = [fresh(20 + n, flagged=False) for n in range(6)]
        assert diagnose(after(*checks, *tight)) is None

    def test_noise_streets_and_a_step_are_no_swing(self) -> None:
        rng = np.random.default_rng(0)
        noise = [fresh(n, flagged=False, offset=rng.normal(0.0, 0.0008, 6)) for n in range(600)]
        assert max(self.evidence(noise)) < LOOSE_AT / 2
        step = [fresh(n, flagged=n > 10, offset=turned(0.0 if n < 10 else 2.0, 0.0, 0.0)) for n in range(20)]
        assert max(self.evidence(step)) < LOOSE_AT / 2

    def evidence(self, checks: Sequence[Observation]) -> list[float]:
        state, result = MonitorState(), []
        for check in checks:
            state = after_observation(state, check, LEVELS)
            result.append(state.scatter.evidence)
        return result

    def test_faint_checks_say_nothing_of_scatter(self) -> None:
        faint = [replace(check, weak=True) for check in self.swinging(0.4, 40)]
        assert after(*faint).scatter.evidence == 0.0


class TestWrongFromTheFirstCheck:
    """Half a degree on a rig of which nothing is known: what the estimator may be off there, and a little more."""

    RIG = np.full(6, np.radians(0.12))
    NOISE = np.full(6, np.radians(0.06))

    def checks(self, offset: NDArray[np.float64], count: int) -> list[Observation]:
        sigma = np.hypot(self.RIG, self.NOISE)
        near = [fresh(number, flagged=False, offset=offset) for number in range(count)]
        return [replace(one, sigma=sigma, noise=self.NOISE, place=0.3 * self.RIG) for one in near]

    def test_all_checks_together_doubt_it_though_none_does_alone(self) -> None:
        checks = self.checks(turned(0.3, 0.3, 0.25), 2)
        assert not any(check.flagged for check in checks)
        assert after(checks[0]).outcome is MonitorOutcome.CLEAR
        assert after(*checks).outcome is MonitorOutcome.AT_ODDS

    def test_what_estimators_are_off_on_other_rigs_is_no_doubt(self) -> None:
        assert after(*self.checks(turned(0.12, -0.12, 0.12), 12)).outcome is MonitorOutcome.CLEAR

    def test_a_window_that_vouches_for_it_ends_the_doubt(self) -> None:
        state = MonitorState(vouched=True)
        for check in self.checks(turned(0.3, 0.3, 0.25), 12):
            state = after_observation(state, check, LEVELS)
        assert state.outcome is MonitorOutcome.CLEAR


class TestAlarmLevels:
    def test_are_the_logarithm_of_the_tests_that_begin_in_the_stated_time(self) -> None:
        levels = alarm_levels(MonitorConfig(hours_between_false_alarms=1000.0, period_s=10.0))
        assert levels.confirmed == pytest.approx(np.log(TESTS_PER_CHECK * 1000.0 * 360.0))

    def test_no_single_check_comes_to_any_however_rare_checks_are(self) -> None:
        levels = alarm_levels(MonitorConfig(period_s=86_400.0))
        state = after_observation(after(fresh(0, flagged=False)), fresh(1), levels)
        assert state.outcome is MonitorOutcome.CLEAR


class TestCauses:
    def test_bad_data_are_no_evidence_of_a_bent_mount(self) -> None:
        state = after(*[fresh(k, causes=(LENS_DIRTY,)) for k in range(10)])
        assert (state.outcome, state.evidence) == (MonitorOutcome.UNKNOWN, 0.0)
        assert diagnose(state) == LENS_DIRTY

    def test_one_check_with_a_cause_is_not_believed(self) -> None:
        assert diagnose(after(fresh(0, flagged=False), fresh(1, causes=(DARK,)))) is None

    def test_what_hides_others_comes_first(self) -> None:
        both = [fresh(k, causes=(TIME_OFFSET, DARK)) for k in range(3)]
        assert diagnose(after(*both)) == DARK

    @pytest.mark.fault(
        "causes in the data that alternate", "they compete for one distribution; the leading one is named"
    )
    def test_causes_that_alternate_do_not_cancel_each_other(self) -> None:
        alternating = [fresh(k, causes=(TIME_OFFSET if k % 2 else EGO_MOTION_WRONG,)) for k in range(720)]
        assert all(diagnose(after(*alternating[:count])) is not None for count in (2, 3, 10, 720))
        mostly = [fresh(k, causes=(TIME_OFFSET if k % 3 else EGO_MOTION_WRONG,)) for k in range(30)]
        assert diagnose(after(*mostly)) == TIME_OFFSET

    def test_causes_compete_with_a_mount_that_moved(self) -> None:
        mostly_moved = [fresh(k, causes=(TIME_OFFSET,) if k % 4 == 3 else ()) for k in range(40)]
        assert diagnose(after(*mostly_moved)) == BENT_MOUNT

    def test_a_cause_that_went_away_is_forgotten(self) -> None:
        dark = [fresh(k, causes=(DARK,)) for k in range(3)]
        light = [fresh(10 + k, flagged=False) for k in range(3)]
        assert diagnose(after(*dark, *light)) is None


class TestDirt:
    SPOT = tuple(range(40, 52))

    def checks(self, *dirty: tuple[int, ...], textured: int = 400) -> MonitorState:
        return after(*[replace(fresh(k, flagged=False), dirty=seen, textured=textured) for k, seen in enumerate(dirty)])

    def test_is_what_stays_where_it_is(self) -> None:
        assert diagnose(self.checks(*[self.SPOT] * 4)) is None
        assert diagnose(self.checks(*[self.SPOT] * 5)) == LENS_DIRTY

    def test_a_sky_that_changes_is_none(self) -> None:
        assert diagnose(self.checks(*[tuple(range(20 * k, 20 * k + 30)) for k in range(12)])) is None

    def test_one_exposure_with_contrast_clears_a_block(self) -> None:
        assert diagnose(self.checks(*[self.SPOT] * 3, (), *[self.SPOT] * 4)) is None

    def test_a_few_blocks_are_no_dirty_lens(self) -> None:
        assert diagnose(self.checks(*[self.SPOT[:4]] * 10)) is None

    def test_goes_away_when_it_was_cleaned(self) -> None:
        assert diagnose(self.checks(*[self.SPOT] * 8, *[()] * 3)) is None

    def test_a_night_is_no_cleaning(self) -> None:
        day = [replace(fresh(k, flagged=False), dirty=self.SPOT, textured=400) for k in range(5)]
        night = [fresh(10 + k, causes=(DARK,)) for k in range(3)]
        assert after(*day, *night).dirt.keys() == {str(block) for block in self.SPOT}


class TestCheck:
    def test_needs_some_pairs(self, street: Window, stereo: DepthModel) -> None:
        short = replace(street, pairs=street.pairs[: MIN_PAIRS - 1])
        with pytest.raises(CalibrationError, match="a check needs 4 pairs, there are 3"):
            observe(short, stereo, GreyImages(LimitsConfig()), CalibrationConfig(), None)

    def test_flags_a_turn_of_two_degrees_and_not_the_truth(self, sharp_street: Window, stereo: DepthModel) -> None:
        images, config = GreyImages(LimitsConfig()), CalibrationConfig()
        right = observe(sharp_street, stereo, images, config, None)
        assert not right.flagged
        assert right.causes == ()
        moved = se3.perturb(sharp_street.T_camera_lidar_start, np.radians([1.2, -1.2, 1.0, 0, 0, 0]))
        wrong = observe(replace(sharp_street, T_camera_lidar_start=moved), stereo, images, config, None)
        assert wrong.flagged
        assert not wrong.weak
        # The offset leads back to where the street puts the truth (it hardly tells pitch from height): minus the turn,
        # within the tolerance of an uncommissioned rig.
        back_deg = np.degrees((wrong.offset - right.offset)[:3])
        np.testing.assert_allclose(back_deg, [-1.2, 1.2, -1.0], atol=0.35)

    def test_same_pairs_same_check(self, street: Window, stereo: DepthModel) -> None:
        images, config = GreyImages(LimitsConfig()), CalibrationConfig()
        a, b = (observe(street, stereo, images, config, None) for _ in range(2))
        assert a.metrics == b.metrics
        assert a.offset.tobytes() == b.offset.tobytes()
