"""Is the served extrinsic still right? A sequential decision over short checks, one every few seconds.

Evidence is the log-likelihood ratio of "the mount has moved" against "it has not" (`hypotheses`), over checks of pairs
that were not counted yet. The thresholds follow from how often a right mount may be accused (`alarm_levels`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import fsum, isfinite, log, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.baseline import BaselineDrift, chi2_quantile
from coec.calibration.monitor import sensor_faults, sequential_tests
from coec.calibration.types import NS_PER_S, Metric
from coec.config import MonitorConfig

ROTATIONS = sequential_tests.TestedAxes(
    sequential_tests.three([radians(2.5)] * 3),
    (sequential_tests.three([radians(0.3)] * 3), sequential_tests.three([radians(2.0)] * 3)),
)
TRANSLATIONS = sequential_tests.TestedAxes((0.1, 0.1, 0.1), ((0.03, 0.03, 0.03), (0.1, 0.1, 0.1)))
"""For rotations (rad) and translations (m): the reach of bad checks, and the moves that are looked for, the creep of a
mount and a step. See docs/measured.md."""

TESTS_PER_CHECK = len(ROTATIONS.moves) + len(TRANSLATIONS.moves)
"""Number of hypotheses that begin at every check; each of them may accuse."""

CLEARS_AT = 0.4
"""A suspect mount clears again below this share of the evidence that makes it suspect."""

ABOVE = 4.0
"""Evidence is capped this many nats above the level that confirms, so that a repaired mount clears within three
checks."""

DOUBTFUL_CHECKS = 2.0
"""This many clear checks after a faint one count as faint too, because what made it faint, such as a guard rail along a
highway, did not end with it. See docs/measured.md."""

WEAK_SHARE = 0.5
"""A flagged check with faint edges counts half as much as another towards checks being at odds with each other."""

AT_ODDS_AT, MOST_AT_ODDS = 1.5, 3.0
"""Number of flagged checks in a row from which checks that do not add up to a move are at odds (reached with two), and
the most that are counted."""

ASTRAY2 = chi2_quantile(0.95, sequential_tests.AXES)
"""Squared distance between the rotations that the checks have found and those served. Above it, no move but the served
pose itself is doubted, until a window has vouched for that pose. Of right rigs about which nothing is known one in
twenty lies above."""

BLIND_AT, MOST_BLIND = 1.2, 3.5
"""Independent checks that show causes in the data before one is believed (more than one), and the most that are
counted, so that a cause that went away is forgotten after three."""

ACQUITTAL_PERIODS = 3
"""Periods of the monitor after which an acquitting check no longer vouches for the served extrinsic (ARCHITECTURE)."""

LEARNED2 = chi2_quantile(0.97, sequential_tests.AXES)
"""Squared distance, in standard deviations, from where the mount has been so far, beyond which a check does not acquit,
even if its optimum is no farther off than on rigs about which nothing is known. See docs/measured.md."""

CONTRADICTION2 = chi2_quantile(1.0 - 1e-4, sequential_tests.AXES)
"""Squared distance, in standard deviations of their difference, beyond which two checks of one place contradict each
other. The scene of a standing vehicle stays, so that only what is new at every check separates them."""

S_PER_H = 3600.0
ROTATION_AXES, TRANSLATION_AXES = slice(0, 3), slice(3, 6)


def _unknown() -> NDArray[np.float64]:
    return np.full(6, np.nan)


class MonitorOutcome(StrEnum):
    """What the checks so far say. `unknown`: no check could tell yet. `at_odds`: the checks accuse the mount but do not
    add up to a move, because they put it elsewhere every time, or already did at the first check."""

    UNKNOWN = "unknown"
    CLEAR = "clear"
    AT_ODDS = "at_odds"
    SUSPECT = "suspect"
    CONFIRMED = "confirmed"


ACCUSING = frozenset({MonitorOutcome.SUSPECT, MonitorOutcome.CONFIRMED, MonitorOutcome.AT_ODDS})
"""Outcomes after which a window is requested soon: a window that finds another pose is independent evidence. A mount
that moved beyond the reach of a check leads to `at_odds`, too."""


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """One check of the current extrinsic, judged.

    Attributes:
        stamp_ns: of the last pair.
        pair_stamps_ns: of all pairs, ascending.
        metrics: every figure with its limit.
        offset: (6,) from the current pose to where the check puts the mount, less the estimator's bias where known
            (rad, m). Rotations come from the optimum over rotations, translations from the optimum over all axes. To
            first order the errors of the two are independent.
        sigma: (6,) standard deviation of `offset` on a street.
        noise: (6,) the part of `sigma` that is new at every check.
        place: (6,) the part of `sigma` that all checks of a street share; the rest belongs to the rig.
        dispersion: factor by which checks of this scene scatter more than `noise` and `place`, at least 1; see
            `dispersion`.
        distance2: squared distance in standard deviations over its limit.
        flagged: the pose is wrong, or the data are.
        weak: the edges at the local optimum are fainter than they should be.
        flagged_by_paper: equation (2) with learned limits; None until the rig is commissioned.
        causes: what is wrong with the data, those that hide others first; a check with a cause says nothing of the
            pose.
        first_derivative, second_derivative: (6,) ∂MI/∂ξ and -∂²MI/∂ξ² at the pose: the paper's f' and f'' on each axis
            (nats per rad or m, and per rad² or m²).
        drift: of the local optimum from the commissioned calibration; None until the rig is commissioned.
        dirty: blocks of the image, by number, that have no contrast in any pair; for commissioned rigs in daylight.
        textured: number of blocks that could be dirty; 0 if unknown.
        standing_stamps_ns: of the pairs that were taken while the vehicle stood.
        undecided: the optimum lies too far off for a right pose, but the edges do not insist on it.
        has_power: the edges at the local optimum are significant and stand out from other poses, and the pairs agree on
            it, so that the check would hardly miss a displacement of a degree.
    """

    stamp_ns: int
    pair_stamps_ns: tuple[int, ...]
    metrics: tuple[Metric, ...]
    offset: NDArray[np.float64]
    sigma: NDArray[np.float64]
    noise: NDArray[np.float64]
    place: NDArray[np.float64]
    dispersion: float
    distance2: float
    flagged: bool
    weak: bool
    flagged_by_paper: bool | None
    causes: tuple[sensor_faults.Cause, ...]
    first_derivative: NDArray[np.float64] = field(default_factory=_unknown)
    second_derivative: NDArray[np.float64] = field(default_factory=_unknown)
    drift: BaselineDrift | None = None
    dirty: tuple[int, ...] = ()
    textured: int = 0
    standing_stamps_ns: tuple[int, ...] = ()
    undecided: bool = False
    has_power: bool = True

    @property
    def stands(self) -> bool:
        """Whether all pairs were taken while the vehicle stood."""
        return set(self.standing_stamps_ns).issuperset(self.pair_stamps_ns)

    @property
    def acquits(self) -> bool:
        """Whether the check by itself vouches for the pose: it would have noticed a wrong one, its edges lie where they
        should, and nothing is wrong with its data."""
        return self.has_power and not (self.flagged or self.undecided or self.causes)


@dataclass(frozen=True, slots=True)
class AlarmLevels:
    """Evidence, nats, at which a mount is suspect, and at which its move is confirmed."""

    suspect: float
    confirmed: float

    @property
    def clear(self) -> float:
        """Evidence, nats, below which a suspicion is over."""
        return CLEARS_AT * self.suspect

    @property
    def most(self) -> float:
        """The most evidence that is counted, nats."""
        return self.confirmed + ABOVE


def alarm_level(config: MonitorConfig, hours: float) -> float:
    """Evidence, nats, that a right mount reaches once in so many hours on average, or more rarely, with one check per
    period. It is the logarithm of the number of hypotheses that begin in that time."""
    return log(max(TESTS_PER_CHECK * hours * S_PER_H / config.period_s, 1.0))


def alarm_levels(config: MonitorConfig) -> AlarmLevels:
    """The levels for the configured hours. No single check reaches any of them."""
    suspect = max(alarm_level(config, config.hours_between_false_suspicions), sequential_tests.MOST_STEP + 1.0)
    return AlarmLevels(suspect, max(alarm_level(config, config.hours_between_false_alarms), suspect + 1.0))


@dataclass(frozen=True, slots=True)
class OffsetEstimate:
    """Where a check puts the mount from the served extrinsic on three axes (rad or m), and per axis the variance of
    what separates it from other checks of the same place."""

    mean: sequential_tests.Three
    variance: sequential_tests.Three


@dataclass(frozen=True, slots=True)
class Standstill:
    """The check that counts for the place where the vehicle stands.

    Attributes:
        acquits: whether it vouches for the served extrinsic.
        rotation, translation: where it puts the mount; None if undetermined.
        contradicted: whether a later check of the place contradicts it. Then all further ones count.
    """

    acquits: bool
    rotation: OffsetEstimate | None
    translation: OffsetEstimate | None
    contradicted: bool = False

    @classmethod
    def of(cls, observation: Observation, *, acquits: bool) -> Standstill:
        """The record of a check."""
        return cls(acquits, _offset(observation, ROTATION_AXES), _offset(observation, TRANSLATION_AXES))

    def contradicts(self, observation: Observation, *, acquits: bool) -> bool:
        """Whether a later check of the same place says something else of the mount."""
        other = Standstill.of(observation, acquits=acquits)
        if other.acquits != self.acquits and (observation.flagged or other.acquits):
            return True
        return _differ(self.rotation, other.rotation) or _differ(self.translation, other.translation)


def _offset(observation: Observation, axes: slice) -> OffsetEstimate | None:
    measured = measurement_on_axes(observation, axes, None)
    if measured is None:
        return None
    # Pairs that were taken before the vehicle stood have the error of another place.
    return OffsetEstimate(
        measured.offset, measured.noise if observation.stands else sequential_tests.plus(measured.noise, measured.place)
    )


def _differ(one: OffsetEstimate | None, other: OffsetEstimate | None) -> bool:
    if one is None or other is None:
        return False
    rows = zip(one.mean, other.mean, one.variance, other.variance, strict=True)
    return fsum((a - b) ** 2 / (v + w) for a, b, v, w in rows) > CONTRADICTION2


@dataclass(frozen=True, slots=True)
class MonitorState:
    """What the checks so far add up to: plain values that go through JSON as they are.

    Attributes:
        outcome: what the checks so far say.
        turned, shifted: the hypotheses about the rotations and about the translations.
        blind: number of recent independent checks that each cause explains, by code; `bent_mount` explains those that
            accuse the mount. Causes compete: together they explain at most `MOST_BLIND` checks.
        dirt: by number, every block of the image that was dirty in the last checks, and in how many in a row.
        at_odds: number of flagged checks in a row.
        last_stamps_ns: stamps of the pairs of the last check.
        stood: whether the vehicle stood at the end of the last check.
        astray2: squared distance of the rotations that all checks have found, see `learnt_distance2`.
        counted: number of checks that counted, partial ones by their part; at most `AT_ODDS_AT`.
        vouched: whether a window has found the served pose to be right.
        doubtful: number of checks to come that count as faint, however clear they are.
        acquitted_ns: sensor time of the last check, or accepted window, that acquits the served extrinsic; None if none
            does.
        unacquitted: number of completed checks since then.
        standstill: the check that counts for the place where the vehicle stands; None while it drives, or if no check
            there could judge.
        scatter: how far the mount moves from one check to the next.
    """

    outcome: MonitorOutcome = MonitorOutcome.UNKNOWN
    turned: sequential_tests.Hypotheses = field(default_factory=sequential_tests.Hypotheses)
    shifted: sequential_tests.Hypotheses = field(default_factory=sequential_tests.Hypotheses)
    blind: Mapping[str, float] = field(default_factory=dict)
    dirt: Mapping[str, float] = field(default_factory=dict)
    at_odds: float = 0.0
    last_stamps_ns: tuple[int, ...] = ()
    stood: bool = False
    astray2: float = 0.0
    counted: float = 0.0
    vouched: bool = False
    doubtful: float = 0.0
    acquitted_ns: int | None = None
    unacquitted: int = 0
    standstill: Standstill | None = None
    scatter: sequential_tests.MountScatter = field(default_factory=sequential_tests.MountScatter)

    @property
    def evidence(self) -> float:
        """Log-likelihood ratio of the move with the most evidence, nats; 0 if nothing speaks for a move."""
        leading = (hypotheses.leading for hypotheses in (self.turned, self.shifted))
        return max((0.0, *(test.evidence for test in leading if test is not None)))


def after_observation(state: MonitorState, observation: Observation, levels: AlarmLevels) -> MonitorState:
    """The state after one more check. The check counts by the share of its pairs that the last check did not hold. At a
    standstill only the first check of the place says something new of the mount, until another contradicts it."""
    fresh, repeated = _novelty(state, observation)
    stands = observation.pair_stamps_ns[-1] in set(observation.standing_stamps_ns)
    dirt = _dirt_after(state.dirt, observation, fresh)
    codes = {cause.code for cause in observation.causes}
    if sum(run >= sensor_faults.DIRTY_CHECKS for run in dirt.values()) > sensor_faults.DIRTY_SHARE * max(
        observation.textured, 1
    ):
        codes.add(sensor_faults.LENS_DIRTY.code)
    judges = not codes
    scatter = state.scatter
    if judges and fresh > 0.0:
        scatter = scatter.after(measurement_on_axes(observation, ROTATION_AXES, None), ROTATIONS.reach, fresh)
        if scatter.evidence >= sequential_tests.LOOSE_AT:
            codes.add(sensor_faults.MOUNT_LOOSE.code)
    after = replace(
        state,
        blind=_explained(state.blind, codes or ({sensor_faults.BENT_MOUNT.code} if observation.flagged else ()), fresh),
        dirt=dirt,
        last_stamps_ns=observation.pair_stamps_ns,
        stood=stands,
        doubtful=doubtful_after(state.doubtful, observation.weak, fresh),
        scatter=scatter,
    )
    # Data that cannot tell, or were counted before, are neither for nor against the mount.
    if judges and not repeated and fresh > 0.0:
        after = _weighed(after, replace(observation, weak=observation.weak or state.doubtful > 0.0), fresh, levels)
        after = replace(after, outcome=_outcome(state.outcome, after, levels))
    # One check at a right place does not outweigh those that put the mount elsewhere.
    acquits = not codes and _vouches(state, observation) and after.evidence < levels.clear
    place = _standstill_after(state, observation, acquits=acquits, judges=judges) if stands else None
    if place is not None and place.contradicted and acquits and after.outcome is MonitorOutcome.CLEAR:
        place = Standstill.of(observation, acquits=True)
    return replace(
        after,
        acquitted_ns=observation.stamp_ns if acquits else state.acquitted_ns,
        unacquitted=0 if acquits else state.unacquitted + 1,
        standstill=place,
    )


def after_window(
    state: MonitorState, stamp_ns: int, levels: AlarmLevels, *, solved_translation: bool, agrees: bool
) -> MonitorState:
    """The state after a window with data up to the sensor time `stamp_ns` vouches for the served extrinsic. Causes in
    the data stay. So does what is known of the translation, if the window searched none: it cannot clear what it cannot
    see. What is known of the bias of the rig stays if the window `agrees` with what was served before, as an earlier
    one did: small steps that lag behind a drift show as an offset from it. A window, which averages over a swing, does
    not show that a mount is tight."""
    learned = agrees and state.vouched
    shifted = (
        sequential_tests.Hypotheses(state.shifted.right if learned else None) if solved_translation else state.shifted
    )
    after = MonitorState(
        turned=sequential_tests.Hypotheses(state.turned.right if learned else None),
        shifted=shifted,
        blind={code: weight for code, weight in state.blind.items() if code != sensor_faults.BENT_MOUNT.code},
        dirt=state.dirt,
        scatter=replace(state.scatter, before=None, variance=None),
        vouched=True,
        acquitted_ns=max(stamp_ns, stamp_ns if state.acquitted_ns is None else state.acquitted_ns),
        standstill=state.standstill,
        stood=state.stood,
        last_stamps_ns=state.last_stamps_ns,
    )
    outcome = _outcome(state.outcome, after, levels)
    return replace(after, outcome=outcome if outcome is not MonitorOutcome.CLEAR else MonitorOutcome.UNKNOWN)


def is_acquitted(state: MonitorState, now_ns: int, config: MonitorConfig) -> bool:
    """Whether a check still vouches for the served extrinsic at a sensor time: an acquitting one of the last
    `ACQUITTAL_PERIODS` periods with fewer checks since that did not acquit; or that of the place where the vehicle
    stands, if nothing has contradicted it."""
    if state.acquitted_ns is None:
        return False
    lasts_ns = round(ACQUITTAL_PERIODS * config.period_s * NS_PER_S)
    recent = now_ns - state.acquitted_ns <= lasts_ns and state.unacquitted < ACQUITTAL_PERIODS
    return recent or holds_at_rest(state)


def holds_at_rest(state: MonitorState) -> bool:
    """Whether the vehicle stands where a check acquitted the served extrinsic, and nothing has contradicted that."""
    place = state.standstill
    return state.acquitted_ns is not None and place is not None and place.acquits and not place.contradicted


def doubtful_after(doubtful: float, weak: bool, fresh: float) -> float:
    """How many checks to come count as faint, after one more that counts by `fresh`, 0 to 1."""
    return DOUBTFUL_CHECKS if weak else max(doubtful - fresh, 0.0)


def new_share(state: MonitorState, observation: Observation) -> float:
    """The share of a check that is new compared with the checks before it, 0 to 1; see `after_observation`."""
    fresh, repeated = _novelty(state, observation)
    return 0.0 if repeated else fresh


def _novelty(state: MonitorState, observation: Observation) -> tuple[float, bool]:
    """The share of the pairs that the last check did not hold, and whether the check only repeats one that counted. One
    place gives one independent check, however long the vehicle stands there, until a check contradicts that one."""
    counted = set(state.last_stamps_ns)
    fresh = sum(stamp not in counted for stamp in observation.pair_stamps_ns) / len(observation.pair_stamps_ns)
    place = _same_place(state, observation)
    if place is None or place.contradicted:
        return fresh, False
    return fresh, not place.contradicts(observation, acquits=_vouches(state, observation))


def _same_place(state: MonitorState, observation: Observation) -> Standstill | None:
    """The check that counts for the place where all pairs of another were taken; None if that is a new place."""
    return state.standstill if state.stood and observation.stands else None


def _standstill_after(
    state: MonitorState, observation: Observation, *, acquits: bool, judges: bool
) -> Standstill | None:
    """The check that counts for the place where the vehicle stands at the end of another; `judges`: whether that one
    says anything of the mount."""
    place = _same_place(state, observation)
    if not judges:
        return place
    if place is None:
        return Standstill.of(observation, acquits=acquits)
    return replace(place, contradicted=place.contradicted or place.contradicts(observation, acquits=acquits))


def _explained(weights: Mapping[str, float], codes: Collection[str], fresh: float) -> dict[str, float]:
    """How many recent checks each cause explains, after one more that counts by `fresh` and shows `codes`. Several
    causes share a check. A check that shows none lowers all alike."""
    after = {
        code: weights.get(code, 0.0) + (fresh / len(codes) if code in codes else 0.0) for code in {*weights, *codes}
    }
    total = fsum(after.values())
    most = MOST_BLIND if codes else total - fresh
    if total > most:
        after = {code: weight * max(most, 0.0) / total for code, weight in after.items()}
    return {code: after[code] for code in sorted(after) if after[code] > 0.0}


def _vouches(state: MonitorState, observation: Observation) -> bool:
    """Whether a check acquits the pose, and puts the mount where earlier checks and the one before it did, as far as
    streets differ."""
    for axes, tests in ((ROTATION_AXES, state.turned), (TRANSLATION_AXES, state.shifted)):
        measured = measurement_on_axes(observation, axes, None)
        if measured is None:
            continue
        if tests.right is not None and tests.right.wider(measured.place).distance2(measured) > LEARNED2:
            return False
        if axes is ROTATION_AXES and state.scatter.distance2(measured) > LEARNED2:
            return False
    return observation.acquits


def _weighed(state: MonitorState, observation: Observation, fresh: float, levels: AlarmLevels) -> MonitorState:
    """The state with its hypotheses after a check that counts by `fresh`. A check with faint edges, or of a place where
    the vehicle stands, may make the mount suspect but does not confirm a move: a lorry that parks in front of the
    camera stays, too."""
    most = levels.suspect if observation.weak or observation.stands else levels.most
    turned, shifted, astray2 = state.turned, state.shifted, state.astray2
    measurement = measurement_on_axes(observation, ROTATION_AXES, turned.before)
    if measurement is not None:
        turned = sequential_tests.after_check(turned, measurement, ROTATIONS, fresh, most)
        astray2 = sequential_tests.learnt_distance2(turned, measurement.rig)
    measurement = measurement_on_axes(observation, TRANSLATION_AXES, shifted.before)
    if measurement is not None:
        shifted = sequential_tests.after_check(shifted, measurement, TRANSLATIONS, fresh, most)
    step = fresh * (WEAK_SHARE if observation.weak else 1.0)
    # Checks that are all too far off with edges that insist on nothing come from images and sweeps of different times.
    if not observation.flagged and not (observation.undecided and observation.distance2 > 1.0):
        at_odds = state.at_odds if observation.weak or observation.undecided else 0.0
    else:
        at_odds = min(state.at_odds + step, MOST_AT_ODDS)
    counted = min(state.counted + step, AT_ODDS_AT)
    return replace(state, turned=turned, shifted=shifted, at_odds=at_odds, astray2=astray2, counted=counted)


def measurement_on_axes(
    observation: Observation, axes: slice, before: sequential_tests.Three | None
) -> sequential_tests.CheckMeasurement | None:
    """What a check says about three axes; None unless it determines all of them. `before` is the offset of the check
    before it."""
    columns = (observation.offset, observation.sigma, observation.noise, observation.place)
    offset, sigma, noise, place = ([float(value) for value in column[axes]] for column in columns)
    if not all(isfinite(value) for value in (*offset, *sigma, *noise, *place)) or min(noise) <= 0.0:
        return None
    scene = observation.dispersion
    times = max(sequential_tests.WEAK_TIMES, scene) if observation.weak else scene
    farther2 = sum((sequential_tests.FARTHER * value) ** 2 for value in offset)
    return sequential_tests.CheckMeasurement(
        offset=sequential_tests.three(offset),
        noise=sequential_tests.three([(times * n) ** 2 + farther2 for n in noise]),
        place=sequential_tests.three([(scene * p) ** 2 for p in place]),
        street=sequential_tests.three([p * p for p in place]),
        rig=sequential_tests.three([max(s * s - n * n, p * p) for s, n, p in zip(sigma, noise, place, strict=True)]),
        before=before,
        weak=observation.weak,
    )


def diagnose(state: MonitorState) -> sensor_faults.Cause | None:
    """What is wrong, if anything is certain enough: first a cause in the data; a bent mount only once confirmed."""
    of_data = {code: weight for code, weight in state.blind.items() if code != sensor_faults.BENT_MOUNT.code}
    total = fsum(of_data.values())
    # Against a mount that moved, causes in the data have to explain as many checks as it does.
    if total >= BLIND_AT and total >= state.blind.get(sensor_faults.BENT_MOUNT.code, 0.0):
        return leading_cause(of_data)
    return sensor_faults.BENT_MOUNT if state.outcome is MonitorOutcome.CONFIRMED else None


def leading_cause(weights: Mapping[str, float]) -> sensor_faults.Cause | None:
    """The cause that explains most checks; of equals the one that hides others. None if nothing needs one."""
    return max(
        (cause for code, cause in sensor_faults.CAUSES.items() if weights.get(code, 0.0) > 0.0),
        key=lambda cause: weights[cause.code],
        default=None,
    )


def _dirt_after(dirt: Mapping[str, float], observation: Observation, fresh: float) -> dict[str, float]:
    """The runs of dirty blocks after a check. A block that shows contrast once is not dirty; a check that cannot tell
    changes nothing."""
    if observation.textured == 0:
        return dict(dirt)
    dirty = {str(block) for block in observation.dirty}
    return {block: min(dirt.get(block, 0.0) + fresh, sensor_faults.DIRTY_CHECKS + 1.0) for block in sorted(dirty)}


def _outcome(before: MonitorOutcome, after: MonitorState, levels: AlarmLevels) -> MonitorOutcome:
    """The finding, with hysteresis: a suspicion or confirmation lasts until little evidence is left for it."""
    evidence = after.evidence
    if evidence >= levels.confirmed:
        return MonitorOutcome.CONFIRMED
    if before is MonitorOutcome.CONFIRMED and evidence >= levels.clear:
        return before
    if evidence >= levels.suspect or (before is MonitorOutcome.SUSPECT and evidence >= levels.clear):
        return MonitorOutcome.SUSPECT
    astray = after.astray2 > ASTRAY2 and after.counted >= AT_ODDS_AT and not after.vouched
    return MonitorOutcome.AT_ODDS if astray or after.at_odds >= AT_ODDS_AT else MonitorOutcome.CLEAR
