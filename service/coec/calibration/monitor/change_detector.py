"""Is the extrinsic that is served still right? A sequential decision over short checks, one every few seconds.

It adds up the evidence of checks of pairs that were not counted yet (Page 1954, "Continuous inspection schemes"): one
bad frame decides nothing. Each check was judged by itself (`check_verdict`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from coec.calibration.commissioning.baseline import Drift
from coec.calibration.monitor.sensor_faults import BENT_MOUNT, CAUSES, DIRTY_CHECKS, DIRTY_SHARE, LENS_DIRTY, Cause
from coec.calibration.types import Metric

SUSPECT_AT, CONFIRMED_AT, CLEAR_BELOW, MOST = 1.5, 2.5, 0.5, 3.5
"""Evidence in independent checks: to become suspect and confirmed, below which it clears again, and at most, so that a
repaired mount clears within three checks, too. A bad frame is in at most one check and its overlap with the next."""

WEAK_SHARE = 0.5
"""A flagged check whose edges are faint counts half, and confirms nothing: a full solve has to."""

AT_ODDS_AT = 1.0
"""Checks at odds with what the ones before them said of the mount: two that contradict each other tell nothing."""

SAME_SIGMA, SAME_SHARE = 3.5, 0.25
"""Two flagged checks speak of the same mount when their rotations differ by less than so many standard deviations of a
difference, and this share of the larger: far from the extrinsic the local optimum is found less exactly. A mount that
has moved says the same at every check; a tunnel or an open road says something else every time."""

BLIND_AT = 1.2
"""Evidence by which a cause in the data is believed: more than one check."""


def _unknown() -> NDArray[np.float64]:
    return np.full(6, np.nan)


class Finding(StrEnum):
    """What the checks so far say. `unknown`: nothing was seen that could tell. `at_odds`: each puts the mount
    elsewhere."""

    UNKNOWN = "unknown"
    CLEAR = "clear"
    AT_ODDS = "at_odds"
    SUSPECT = "suspect"
    CONFIRMED = "confirmed"


ACCUSING = frozenset({Finding.SUSPECT, Finding.CONFIRMED, Finding.AT_ODDS})
"""Findings that make a window wanted soon, and one that is elsewhere a second witness. A mount that moved beyond the
reach of a check is at odds with itself, too."""


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """One check of the current extrinsic, judged.

    Attributes:
        stamp_ns: of the last pair.
        pair_stamps_ns: of all of them, ascending.
        metrics: every figure with its limit.
        offset: (6,) from the current pose to the local optimum, the estimator's bias removed where known (rad, m).
        sigma: (6,) its standard deviation.
        distance2: squared distance in standard deviations over its limit: above 1 is flagged.
        flagged: the pose is wrong, or the data are.
        weak: the edges at the local optimum are fainter than they should be.
        flagged_by_paper: equation (2) with learned limits; None until the rig is commissioned.
        causes: what is wrong with the data, those that hide others first; such a check says nothing of the pose.
        first_derivative, second_derivative: (6,) ∂MI/∂ξ and -∂²MI/∂ξ² at the pose: the paper's f' and f'' on each axis
            (nats per rad or m, and per rad² or m²).
        drift: of the local optimum from the commissioned calibration; None until the rig is commissioned.
        dirty: blocks of the image, by number, that have no contrast in any pair; for commissioned rigs in daylight.
        textured: blocks that could be, 0 where it is not known.
        standing_stamps_ns: of the pairs that were taken while the vehicle stood.
    """

    stamp_ns: int
    pair_stamps_ns: tuple[int, ...]
    metrics: tuple[Metric, ...]
    offset: NDArray[np.float64]
    sigma: NDArray[np.float64]
    distance2: float
    flagged: bool
    weak: bool
    flagged_by_paper: bool | None
    causes: tuple[Cause, ...]
    first_derivative: NDArray[np.float64] = field(default_factory=_unknown)
    second_derivative: NDArray[np.float64] = field(default_factory=_unknown)
    drift: Drift | None = None
    dirty: tuple[int, ...] = ()
    textured: int = 0
    standing_stamps_ns: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class MonitorState:
    """What the checks so far add up to: plain values that go through JSON as they are.

    Attributes:
        evidence: in independent checks that say the mount is bent, floor 0.
        outcome: see there.
        blind: the same for every cause in the data, by code.
        dirt: the same for every block of the image that was dirty in all checks since, by its number.
        offset: running mean of the flagged offsets that agree (rad, m); empty without one.
        at_odds: flagged checks in a row that did not agree with it.
        last_stamps_ns: of the pairs of the last check.
        stood: whether the vehicle stood at the end of the last check.
    """

    evidence: float = 0.0
    outcome: Finding = Finding.UNKNOWN
    blind: Mapping[str, float] = field(default_factory=dict)
    dirt: Mapping[str, float] = field(default_factory=dict)
    offset: tuple[float, ...] = ()
    at_odds: float = 0.0
    last_stamps_ns: tuple[int, ...] = ()
    stood: bool = False


def after_observation(state: MonitorState, observation: Observation) -> MonitorState:
    """The state after one more check. It counts by the share of its pairs that the last one did not hold; while the
    vehicle stands, only the first says something new of the mount."""
    counted, standing = set(state.last_stamps_ns), set(observation.standing_stamps_ns)
    fresh = sum(stamp not in counted for stamp in observation.pair_stamps_ns) / len(observation.pair_stamps_ns)
    stands = observation.pair_stamps_ns[-1] in standing
    # Of one place there is one independent check, however long the vehicle stands there.
    told_before = state.stood and standing.issuperset(observation.pair_stamps_ns)
    dirt = _dirt_after(state.dirt, observation, fresh)
    codes = {cause.code for cause in observation.causes}
    if sum(run >= DIRTY_CHECKS for run in dirt.values()) > DIRTY_SHARE * max(observation.textured, 1):
        codes.add(LENS_DIRTY.code)
    blind = {
        code: min(max(state.blind.get(code, 0.0) + (fresh if code in codes else -fresh), 0.0), MOST)
        for code in {*state.blind, *codes}
    }
    blind = {code: blind[code] for code in sorted(blind) if blind[code] > 0.0}
    after = replace(state, blind=blind, dirt=dirt, last_stamps_ns=observation.pair_stamps_ns, stood=stands)
    if codes:
        # Neither for nor against: the data cannot tell.
        return after
    if told_before or fresh == 0.0 or (not observation.flagged and observation.weak):
        return after
    after = _weighed(after, observation, fresh * (WEAK_SHARE if observation.weak else 1.0))
    return replace(after, outcome=_outcome(state.outcome, after.evidence, after.at_odds))


def _weighed(state: MonitorState, observation: Observation, step: float) -> MonitorState:
    """The evidence after a check that counts `step`: for the mount that the flagged ones before it speak of, or, where
    they contradict each other, for the one that more speaks for."""
    if not observation.flagged:
        return replace(state, evidence=max(state.evidence - step, 0.0), at_odds=0.0)
    if state.evidence == 0.0 or _same_mount(state.offset, observation):
        most = max(state.evidence, SUSPECT_AT) if observation.weak else MOST
        evidence = min(state.evidence + step, most)
        offset = _mean(state.offset, observation.offset, step / max(evidence, step))
        return replace(state, evidence=evidence, offset=offset, at_odds=max(state.at_odds - step, 0.0))
    at_odds = min(state.at_odds + step, MOST)
    if state.evidence - step > step:
        return replace(state, evidence=state.evidence - step, at_odds=at_odds)
    return replace(state, evidence=step, offset=_mean((), observation.offset, 1.0), at_odds=at_odds)


def _same_mount(offset: tuple[float, ...], observation: Observation) -> bool:
    """Whether a check puts the mount, up to its own uncertainty, where those before it did."""
    told, now = np.array(offset[:3]), observation.offset[:3]
    sigma = float(np.sqrt(2.0 * np.nansum(observation.sigma[:3] ** 2)))
    apart, farther = float(np.linalg.norm(told - now)), max(float(np.linalg.norm(told)), float(np.linalg.norm(now)))
    return apart <= SAME_SIGMA * sigma + SAME_SHARE * farther


def diagnose(state: MonitorState) -> Cause | None:
    """What is wrong, if anything is certain enough: a cause in the data first; a bent mount only once confirmed."""
    for code, cause in CAUSES.items():
        if state.blind.get(code, 0.0) >= BLIND_AT:
            return cause
    return BENT_MOUNT if state.outcome is Finding.CONFIRMED else None


def _dirt_after(dirt: Mapping[str, float], observation: Observation, fresh: float) -> dict[str, float]:
    """Whatever shows contrast once is not dirty; a check that cannot tell changes nothing."""
    if observation.textured == 0:
        return dict(dirt)
    dirty = {str(block) for block in observation.dirty}
    return {block: min(dirt.get(block, 0.0) + fresh, DIRTY_CHECKS + 1.0) for block in sorted(dirty)}


def _outcome(before: Finding, evidence: float, at_odds: float) -> Finding:
    """With hysteresis: what was suspected stays so until little speaks for it."""
    if evidence >= CONFIRMED_AT:
        return Finding.CONFIRMED
    if before is Finding.CONFIRMED and evidence >= CLEAR_BELOW:
        return before
    if evidence >= SUSPECT_AT or (before is Finding.SUSPECT and evidence >= CLEAR_BELOW):
        return Finding.SUSPECT
    return Finding.AT_ODDS if at_odds >= AT_ODDS_AT else Finding.CLEAR


def _mean(before: tuple[float, ...], offset: NDArray[np.float64], share: float) -> tuple[float, ...]:
    if not before:
        return tuple(float(value) for value in offset)
    return tuple((1.0 - share) * old + share * float(new) for old, new in zip(before, offset, strict=True))
