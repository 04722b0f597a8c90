"""What the change detector makes of checks of rendered drives: shares, delays, and false alarms in hours of driving.

Checks at one place are not independent: on a highway, if one check is off, the next is off by as much. So hours are
resampled from whole drives, all of one place for as long as a vehicle stays there. Shuffled checks would be
independent, and alarms far too few. Resampling cannot show what was never met, so a tail is fitted to how far off
places are (`alarm_bound`): once as if every drive were a place of its own, and once as if a vehicle stayed at each
place for ten minutes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, cycle, islice

import numpy as np

from coec.calibration.commissioning.quantiles import poisson_most
from coec.calibration.monitor.change_detector import (
    S_PER_H,
    AlarmLevels,
    MonitorOutcome,
    MonitorState,
    Observation,
    after_observation,
    alarm_levels,
)
from coec.calibration.monitor.sensor_faults import CAUSES
from coec.config import MonitorConfig
from coec.evaluation.alarm_bound import PlaceChecks, bound
from coec.evaluation.check_drives import CHECK_PAIRS, CHECKS, PERIOD_S
from coec.evaluation.check_run import MOVES, RIGHT
from coec.evaluation.detection import CONFIDENCE, interval
from coec.schemas.checks import (
    CheckedDrive,
    ChecksReport,
    HoursStatistics,
    Judged,
    MovedStatistics,
    PlaceStatistics,
    RigStatistics,
    TailStatistics,
)

PLACE_CHECKS = 120
"""Checks in one place of resampled driving, on average: ten minutes at one every five seconds."""

SETTLED_CHECKS = 24
"""Checks of a right mount before a move: two minutes, from other drives in the same place with the same rig."""

SEED = 20_230_617
"""Any number; the first day of CVPR 2023, where the method appeared."""

CONFIG = MonitorConfig(period_s=PERIOD_S, pairs=CHECK_PAIRS)

Where = tuple[str, Judged]
"""A check and the name of its place."""


def report(rows: Sequence[CheckedDrive], resampled_h: float) -> ChecksReport:
    """All figures of the rows."""
    return ChecksReport(
        drives=len(rows),
        failed={row.name: row.failure for row in rows if row.failure is not None},
        rigs=tuple(_of_rigs(rows, of_rig, resampled_h) for of_rig in (False, True)),
    )


def _of_rigs(rows: Sequence[CheckedDrive], commissioned: bool, resampled_h: float) -> RigStatistics:
    right = {row.name: checks for row in rows if (checks := _checks(row, RIGHT, commissioned))}
    known = [row for row in rows if row.name in right]
    hours = [_hours("rendered", _in_turn(known, right))]
    if known and resampled_h > 0.0:
        most = round(resampled_h * S_PER_H / PERIOD_S)
        hours.append(_hours("resampled", _at_most(_resampled(known, right), most)))
    settled = PlaceChecks.from_drives([right[row.name] for row in known])
    tails = [one for stay in (CHECKS, PLACE_CHECKS) if (one := _tail(settled, stay)) is not None]
    moved = [_moved(name, known, right, commissioned) for name in (RIGHT, *(name for name, _, _ in MOVES))]
    places = tuple(
        _place(place, [check for row in known if row.place == place for check in right[row.name]])
        for place in dict.fromkeys(row.place for row in known)
    )
    return RigStatistics(
        commissioned=commissioned, moved=tuple(moved), places=places, hours=tuple(hours), tails=tuple(tails)
    )


def _checks(row: CheckedDrive, moved: str, commissioned: bool) -> tuple[Judged, ...]:
    for pose in row.poses:
        if pose.moved == moved:
            return pose.commissioned if commissioned else pose.uncommissioned
    return ()


def _in_turn(rows: Sequence[CheckedDrive], right: dict[str, tuple[Judged, ...]]) -> Iterator[list[Where]]:
    """One vehicle per rig: all checks of its drives, one drive after the other."""
    for rig in dict.fromkeys(row.rig for row in rows):
        yield [(f"{rig} {row.place}", check) for row in rows if row.rig == rig for check in right[row.name]]


def _resampled(rows: Sequence[CheckedDrive], right: dict[str, tuple[Judged, ...]]) -> Iterator[list[Where]]:
    """Vehicles without end, one of each rig in turn, each of which visits one place after the other."""
    rng = np.random.default_rng(SEED)
    rigs = list(dict.fromkeys(row.rig for row in rows))
    for rig in cycle(rigs):
        places = list(dict.fromkeys(row.place for row in rows if row.rig == rig))
        driven: list[Where] = []
        for place in rng.permutation(places).tolist():
            there = [row for row in rows if row.rig == rig and row.place == place]
            most, met = int(rng.geometric(1.0 / PLACE_CHECKS)), 0
            while met < most:
                checks = right[there[int(rng.integers(len(there)))].name]
                driven += [(f"{rig} {place}", check) for check in checks]
                met += len(checks)
        yield driven


def _at_most(vehicles: Iterable[list[Where]], checks: int) -> Iterator[list[Where]]:
    """Vehicles until they have `checks` checks together."""
    for driven in vehicles:
        yield driven[:checks]
        checks -= len(driven)
        if checks <= 0:
            return


def _hours(how: str, vehicles: Iterable[list[Where]]) -> HoursStatistics:
    levels = alarm_levels(CONFIG)
    checks = suspicions = 0
    alarmed: list[str] = []
    for driven in vehicles:
        before = MonitorState()
        for (where, _), state in zip(driven, states([check for _, check in driven], levels), strict=True):
            checks += 1
            worse = state.outcome is not before.outcome
            suspicions += (
                worse and state.outcome is MonitorOutcome.SUSPECT and before.outcome is not MonitorOutcome.CONFIRMED
            )
            if worse and state.outcome is MonitorOutcome.CONFIRMED:
                alarmed.append(where)
            before = state
    driven_h = checks * PERIOD_S / S_PER_H
    return HoursStatistics(
        how=how,
        hours=driven_h,
        suspicions=suspicions,
        alarms=len(alarmed),
        alarms_per_100_h_at_most=100.0 * poisson_most(CONFIDENCE, len(alarmed)) / driven_h if driven_h > 0.0 else 0.0,
        alarmed=tuple(dict.fromkeys(alarmed)),
    )


@dataclass(frozen=True, slots=True)
class _CheckTally:
    """How many of some checks cannot tell, and why, and the checks that can."""

    blind: int
    weak: int
    undecided: int
    decided: tuple[Judged, ...]


def _tally(checks: Sequence[Judged]) -> _CheckTally:
    seeing = [check for check in checks if not check.causes]
    clear = [check for check in seeing if not check.faint]
    decided = tuple(check for check in clear if not check.undecided)
    return _CheckTally(len(checks) - len(seeing), len(seeing) - len(clear), len(clear) - len(decided), decided)


def _place(place: str, checks: Sequence[Judged]) -> PlaceStatistics:
    tally = _tally(checks)
    return PlaceStatistics(
        place=place, checks=len(checks), blind=tally.blind, weak=tally.weak, undecided=tally.undecided,
        flagged=sum(check.flagged for check in tally.decided),
    )  # fmt: skip


def _tail(places: PlaceChecks, stay_checks: int) -> TailStatistics | None:
    """The bound for a vehicle that comes to another place after every `stay_checks` checks."""
    levels = alarm_levels(CONFIG)

    def alarms(checks: Sequence[Judged]) -> bool:
        return any(state.outcome is MonitorOutcome.CONFIRMED for state in states(checks, levels))

    estimate = bound(places, stay_checks, S_PER_H / PERIOD_S / stay_checks, alarms)
    if estimate is None:
        return None
    return TailStatistics(
        stay_checks=stay_checks, places=len(places.checks), farthest=float(places.displacement.max()),
        accused_at=estimate.half, alarms_per_100_h=estimate.mean, alarms_per_100_h_at_most=estimate.at_most,
    )  # fmt: skip


def _moved(
    name: str, rows: Sequence[CheckedDrive], right: dict[str, tuple[Judged, ...]], commissioned: bool
) -> MovedStatistics:
    levels = alarm_levels(CONFIG)
    everything: list[Judged] = []
    drives = suspected = 0
    delays: list[int] = []
    for place, row in enumerate(rows):
        checks = _checks(row, name, commissioned)
        if not checks:
            continue
        drives += 1
        everything += checks
        others = [one for one in (*rows[place + 1 :], *rows[:place]) if (one.rig, one.place) == (row.rig, row.place)]
        before = list(islice(cycle(chain.from_iterable(right[one.name] for one in others)), SETTLED_CHECKS))
        after = list(states([*before, *checks], levels))[len(before) :]
        suspected += any(state.evidence >= levels.suspect for state in after)
        confirmed = next((number for number, state in enumerate(after, 1) if state.evidence >= levels.confirmed), None)
        delays += [] if confirmed is None else [confirmed]
    tally = _tally(everything)
    clear = tally.decided
    flagged = sum(check.flagged for check in clear)
    low, high = interval(flagged, len(clear)) if clear else (None, None)
    return MovedStatistics(
        moved=name, drives=drives, checks=len(everything), blind=tally.blind, weak=tally.weak, undecided=tally.undecided,
        clear=len(clear), flagged=flagged,
        flagged_low=low, flagged_high=high, suspected=suspected, confirmed=len(delays), delay_checks=tuple(delays),
    )  # fmt: skip


def states(checks: Iterable[Judged], levels: AlarmLevels) -> Iterator[MonitorState]:
    """The state of the change detector after each check; no two checks share a pair."""
    state = MonitorState()
    for number, check in enumerate(checks):
        state = after_observation(state, _observation(check, number), levels)
        yield state


def _observation(check: Judged, number: int) -> Observation:
    begin_ns = round(number * PERIOD_S * 1e9)
    return Observation(
        stamp_ns=begin_ns + CHECK_PAIRS - 1, pair_stamps_ns=tuple(begin_ns + pair for pair in range(CHECK_PAIRS)),
        metrics=(), offset=np.array(check.offset), sigma=np.array(check.sigma), noise=np.array(check.noise),
        place=np.array(check.place), dispersion=check.dispersion, distance2=check.distance2, flagged=check.flagged,
        undecided=check.undecided,
        weak=bool(check.faint), flagged_by_paper=None, causes=tuple(CAUSES[code] for code in check.causes),
    )  # fmt: skip
