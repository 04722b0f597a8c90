"""What the change detector makes of checks of rendered drives: shares, delays, and false alarms in hours of driving.

No single check raises an alarm. What raises one is a place where all checks are off alike, far enough and for long
enough. So there are two questions. First, how far off are places? Rendered drives give the displacement of each drive
on its farthest axis, in standard deviations of `place`; beyond what was seen a tail is fitted (peaks over threshold:
Pickands 1975; Smith 1987), and all tails count by their likelihood. Second, what does the detector do at a place that
far off? It is run on sampled places of one displacement, where checks scatter as they did on one of the rendered
drives.

Checks at one place are not independent: on a highway, if one check is off, the next is off by as much. So hours are
resampled from whole drives, all of one place for as long as a vehicle stays there. Shuffled checks would be
independent, and alarms far too few. Resampling cannot show what was never met, so a tail is fitted to the displacements
of places (`bound`): once as if every drive were a place of its own, and once as if a vehicle stayed at each place
for ten minutes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, cycle, islice
from math import log
from statistics import median

import numpy as np
from numpy.typing import NDArray

from coec.calibration.baseline import poisson_most
from coec.calibration.monitor import change_detector
from coec.calibration.monitor.sensor_faults import CAUSES
from coec.config import MonitorConfig
from coec.reports import console
from coec_lab.experiments import simulation_schemas
from coec_lab.experiments.check_drives import CHECK_PAIRS, CHECKS, MOVES, PERIOD_S, RIGHT
from coec_lab.experiments.detection import CONFIDENCE, interval

SETTLED_BEFORE_PLACE = 24
"""Checks of a right mount before a place: two minutes at one every five seconds."""

DISPLACEMENTS = (2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 13.0, 16.0, 20.0, 25.0)
"""Displacements of drawn places, in standard deviations of `place`: from one that every second place has to one that
every check sees."""

DRAWS = 12
"""Places of each displacement."""

MIN_CHECKS = 3
"""Clear checks from which a place is known: fewer do not tell a place that is off from a bad check."""

MIN_PLACES = 20
"""With fewer places no tail is fitted, because only half of them lie beyond the threshold."""

TAIL_SHAPES = np.linspace(-0.5, 0.5, 41)
"""Shapes of the tails considered, all equally likely beforehand: from a tail that ends soon after what was seen to one
without a variance."""

TAIL_SCALES = np.geomspace(0.05, 20.0, 121)
"""Scales of the tails considered, over the mean excess; every factor is equally likely beforehand."""

BOUND_CONFIDENCE = 0.95
"""Confidence of the bound."""

PLACE_SEED = 20_230_617
"""Any number; the first day of CVPR 2023, where the method appeared."""

Alarms = Callable[[Sequence[simulation_schemas.Judged]], bool]
"""Whether a detector accuses the mount in a sequence of checks."""


@dataclass(frozen=True, slots=True, eq=False)
class PlaceChecks:
    """What clear checks of a right mount say about the places where they were made.

    Attributes:
        checks: of every place, the checks that can tell.
        displacement: (n,) of every place: the median of its checks on the axis that is farthest off, in standard
            deviations of `place` in such a scene. By the median, one outlying check displaces no place.
    """

    checks: tuple[tuple[simulation_schemas.Judged, ...], ...]
    displacement: NDArray[np.float64]

    @classmethod
    def from_drives(cls, drives: Sequence[Sequence[simulation_schemas.Judged]]) -> PlaceChecks:
        """Every drive is one place; drives with fewer than `MIN_CHECKS` clear checks are left out."""
        eligible = tuple(checks for checks in map(_clear, drives) if len(checks) >= MIN_CHECKS)
        far = [float(np.max(np.abs(_centre(checks)) / _place_sigma(checks))) for checks in eligible]
        return cls(eligible, np.array(far))


@dataclass(frozen=True, slots=True)
class Bound:
    """False alarms in 100 hours: the mean over all likely tails of displacements, and the upper bound at `CONFIDENCE`.
    `half` is the displacement from which half of the places accuse; None if not even the largest does."""

    mean: float
    at_most: float
    half: float | None


def _clear(drive: Sequence[simulation_schemas.Judged]) -> tuple[simulation_schemas.Judged, ...]:
    """The checks of a drive that may accuse."""
    clear: list[simulation_schemas.Judged] = []
    doubtful = 0.0
    for check in drive:
        if not check.causes and not check.faint and doubtful == 0.0:
            clear.append(check)
        doubtful = change_detector.doubtful_after(doubtful, bool(check.faint), 1.0)
    return tuple(clear)


def bound(places: PlaceChecks, stay_checks: int, places_per_h: float, alarms: Alarms) -> Bound | None:
    """The bound for a vehicle that stays `stay_checks` checks at each place and meets `places_per_h` places an hour;
    None with fewer than `MIN_PLACES` places."""
    if len(places.checks) < MIN_PLACES:
        return None
    accused = [_accused(places, far, stay_checks, alarms) for far in DISPLACEMENTS]
    # A farther place is never less likely to accuse: a smaller share is chance.
    share = np.maximum.accumulate(np.array(accused))
    weight, beyond = tail(places.displacement, np.array(DISPLACEMENTS))
    rates = 100.0 * places_per_h * np.sum(np.diff(share, prepend=0.0) * beyond, axis=1)
    order = np.argsort(rates, kind="stable")
    place = int(np.searchsorted(np.cumsum(weight[order]), BOUND_CONFIDENCE))
    half = next((far for far, part in zip(DISPLACEMENTS, share, strict=True) if part >= 0.5), None)
    return Bound(float(np.sum(weight * rates)), float(rates[order][min(place, len(rates) - 1)]), half)


def tail(seen: NDArray[np.float64], at: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Tails fitted to the displacements `seen` (n,), generalised Pareto beyond their median: the weight of each tail
    (k,), its likelihood scaled to a sum of 1, and the share of places (k, m) that it has beyond `at` (m,)."""
    threshold = float(np.median(seen))
    excess = seen[seen > threshold] - threshold
    mean = float(excess.mean())
    likelihood, shares = [], []
    for shape in TAIL_SHAPES.tolist():
        for scale in (TAIL_SCALES * mean).tolist():
            likelihood.append(float(np.sum(_log_density(excess, shape, scale))))
            shares.append(len(excess) / len(seen) * _survival(np.maximum(at - threshold, 0.0), shape, scale))
    weight = np.exp(np.array(likelihood) - max(likelihood))
    return weight / weight.sum(), np.array(shares)


def _log_density(excess: NDArray[np.float64], shape: float, scale: float) -> NDArray[np.float64]:
    if abs(shape) < 1e-9:
        return np.asarray(-log(scale) - excess / scale)
    inside = 1.0 + shape * excess / scale
    with np.errstate(divide="ignore", invalid="ignore"):
        density = -log(scale) - (1.0 + 1.0 / shape) * np.log(inside)
    return np.where(inside > 0.0, density, -np.inf)


def _survival(excess: NDArray[np.float64], shape: float, scale: float) -> NDArray[np.float64]:
    if abs(shape) < 1e-9:
        return np.asarray(np.exp(-excess / scale))
    return np.asarray(np.maximum(1.0 + shape * excess / scale, 0.0) ** (-1.0 / shape))


def _accused(places: PlaceChecks, displacement: float, stay_checks: int, alarms: Alarms) -> float:
    """The share of drawn places of one displacement at which the mount is accused."""
    rng = np.random.default_rng([PLACE_SEED, round(100.0 * displacement), stay_checks])
    return float(np.mean([alarms(_stay(places, displacement, stay_checks, rng)) for _ in range(DRAWS)]))


def _stay(
    places: PlaceChecks, displacement: float, stay_checks: int, rng: np.random.Generator
) -> list[simulation_schemas.Judged]:
    """Checks of a right mount, followed by checks of a place that is off about or along one axis."""
    checks = places.checks[int(rng.integers(len(places.checks)))]
    offsets = _offsets(checks)
    # A few checks scatter less about their own centre than about the true displacement of their place.
    about = (offsets - _centre(checks)) * np.sqrt(len(checks) / (len(checks) - 1.0))
    off = np.zeros(6)
    axis = int(rng.integers(6))
    off[axis] = displacement * _place_sigma(checks)[axis] * float(rng.choice([-1.0, 1.0]))
    sampled = rng.integers(len(checks), size=SETTLED_BEFORE_PLACE + stay_checks)
    return [
        checks[one].model_copy(update={"offset": tuple((about[one] + off * (number >= SETTLED_BEFORE_PLACE)).tolist())})
        for number, one in enumerate(sampled.tolist())
    ]


def _place_sigma(checks: Sequence[simulation_schemas.Judged]) -> NDArray[np.float64]:
    """(6,) the standard deviation of a place, given the dispersions of its checks."""
    return np.asarray(np.mean([np.array(check.place) * check.dispersion for check in checks], axis=0))


def _centre(checks: Sequence[simulation_schemas.Judged]) -> NDArray[np.float64]:
    """(6,) median offset of the checks of a place, so that an outlier does not count."""
    return np.asarray(np.median(_offsets(checks), axis=0))


def _offsets(checks: Sequence[simulation_schemas.Judged]) -> NDArray[np.float64]:
    return np.array([check.offset for check in checks])


PLACE_CHECKS = 120
"""Checks in one place of resampled driving, on average: ten minutes at one every five seconds."""

SETTLED_CHECKS = 24
"""Checks of a right mount before a move: two minutes, from other drives in the same place with the same rig."""

SEED = 20_230_617
"""Any number; the first day of CVPR 2023, where the method appeared."""

CONFIG = MonitorConfig(period_s=PERIOD_S, pairs=CHECK_PAIRS)

Where = tuple[str, simulation_schemas.Judged]
"""A check and the name of its place."""


def report(rows: Sequence[simulation_schemas.CheckedDrive], resampled_h: float) -> simulation_schemas.ChecksReport:
    """All figures of the rows."""
    return simulation_schemas.ChecksReport(
        drives=len(rows),
        failed={row.name: row.failure for row in rows if row.failure is not None},
        rigs=tuple(_of_rigs(rows, of_rig, resampled_h) for of_rig in (False, True)),
    )


def _of_rigs(
    rows: Sequence[simulation_schemas.CheckedDrive], commissioned: bool, resampled_h: float
) -> simulation_schemas.RigStatistics:
    right = {row.name: checks for row in rows if (checks := _checks(row, RIGHT, commissioned))}
    known = [row for row in rows if row.name in right]
    hours = [_hours("rendered", _in_turn(known, right))]
    if known and resampled_h > 0.0:
        most = round(resampled_h * change_detector.S_PER_H / PERIOD_S)
        hours.append(_hours("resampled", _at_most(_resampled(known, right), most)))
    settled = PlaceChecks.from_drives([right[row.name] for row in known])
    tails = [one for stay in (CHECKS, PLACE_CHECKS) if (one := _tail(settled, stay)) is not None]
    moved = [_moved(name, known, right, commissioned) for name in (RIGHT, *(name for name, _, _ in MOVES))]
    places = tuple(
        _place(place, [check for row in known if row.place == place for check in right[row.name]])
        for place in dict.fromkeys(row.place for row in known)
    )
    return simulation_schemas.RigStatistics(
        commissioned=commissioned, moved=tuple(moved), places=places, hours=tuple(hours), tails=tuple(tails)
    )


def _checks(
    row: simulation_schemas.CheckedDrive, moved: str, commissioned: bool
) -> tuple[simulation_schemas.Judged, ...]:
    for pose in row.poses:
        if pose.moved == moved:
            return pose.commissioned if commissioned else pose.uncommissioned
    return ()


def _in_turn(
    rows: Sequence[simulation_schemas.CheckedDrive], right: dict[str, tuple[simulation_schemas.Judged, ...]]
) -> Iterator[list[Where]]:
    """One vehicle per rig: all checks of its drives, one drive after the other."""
    for rig in dict.fromkeys(row.rig for row in rows):
        yield [(f"{rig} {row.place}", check) for row in rows if row.rig == rig for check in right[row.name]]


def _resampled(
    rows: Sequence[simulation_schemas.CheckedDrive], right: dict[str, tuple[simulation_schemas.Judged, ...]]
) -> Iterator[list[Where]]:
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


def _hours(how: str, vehicles: Iterable[list[Where]]) -> simulation_schemas.HoursStatistics:
    levels = change_detector.alarm_levels(CONFIG)
    checks = suspicions = 0
    alarmed: list[str] = []
    for driven in vehicles:
        before = change_detector.MonitorState()
        for (where, _), state in zip(driven, states([check for _, check in driven], levels), strict=True):
            checks += 1
            worse = state.outcome is not before.outcome
            suspicions += (
                worse
                and state.outcome is change_detector.MonitorOutcome.SUSPECT
                and before.outcome is not change_detector.MonitorOutcome.CONFIRMED
            )
            if worse and state.outcome is change_detector.MonitorOutcome.CONFIRMED:
                alarmed.append(where)
            before = state
    driven_h = checks * PERIOD_S / change_detector.S_PER_H
    return simulation_schemas.HoursStatistics(
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
    decided: tuple[simulation_schemas.Judged, ...]


def _tally(checks: Sequence[simulation_schemas.Judged]) -> _CheckTally:
    seeing = [check for check in checks if not check.causes]
    clear = [check for check in seeing if not check.faint]
    decided = tuple(check for check in clear if not check.undecided)
    return _CheckTally(len(checks) - len(seeing), len(seeing) - len(clear), len(clear) - len(decided), decided)


def _place(place: str, checks: Sequence[simulation_schemas.Judged]) -> simulation_schemas.PlaceStatistics:
    tally = _tally(checks)
    return simulation_schemas.PlaceStatistics(
        place=place, checks=len(checks), blind=tally.blind, weak=tally.weak, undecided=tally.undecided,
        flagged=sum(check.flagged for check in tally.decided),
    )  # fmt: skip


def _tail(places: PlaceChecks, stay_checks: int) -> simulation_schemas.TailStatistics | None:
    """The bound for a vehicle that comes to another place after every `stay_checks` checks."""
    levels = change_detector.alarm_levels(CONFIG)

    def alarms(checks: Sequence[simulation_schemas.Judged]) -> bool:
        return any(state.outcome is change_detector.MonitorOutcome.CONFIRMED for state in states(checks, levels))

    estimate = bound(places, stay_checks, change_detector.S_PER_H / PERIOD_S / stay_checks, alarms)
    if estimate is None:
        return None
    return simulation_schemas.TailStatistics(
        stay_checks=stay_checks, places=len(places.checks), farthest=float(places.displacement.max()),
        accused_at=estimate.half, alarms_per_100_h=estimate.mean, alarms_per_100_h_at_most=estimate.at_most,
    )  # fmt: skip


def _moved(
    name: str,
    rows: Sequence[simulation_schemas.CheckedDrive],
    right: dict[str, tuple[simulation_schemas.Judged, ...]],
    commissioned: bool,
) -> simulation_schemas.MovedStatistics:
    levels = change_detector.alarm_levels(CONFIG)
    everything: list[simulation_schemas.Judged] = []
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
    return simulation_schemas.MovedStatistics(
        moved=name, drives=drives, checks=len(everything), blind=tally.blind, weak=tally.weak,
        undecided=tally.undecided, clear=len(clear), flagged=flagged,
        flagged_low=low, flagged_high=high, suspected=suspected, confirmed=len(delays), delay_checks=tuple(delays),
    )  # fmt: skip


def states(
    checks: Iterable[simulation_schemas.Judged], levels: change_detector.AlarmLevels
) -> Iterator[change_detector.MonitorState]:
    """The state of the change detector after each check; no two checks share a pair."""
    state = change_detector.MonitorState()
    for number, check in enumerate(checks):
        state = change_detector.after_observation(state, _observation(check, number), levels)
        yield state


def _observation(check: simulation_schemas.Judged, number: int) -> change_detector.Observation:
    begin_ns = round(number * PERIOD_S * 1e9)
    return change_detector.Observation(
        stamp_ns=begin_ns + CHECK_PAIRS - 1, pair_stamps_ns=tuple(begin_ns + pair for pair in range(CHECK_PAIRS)),
        metrics=(), offset=np.array(check.offset), sigma=np.array(check.sigma), noise=np.array(check.noise),
        place=np.array(check.place), dispersion=check.dispersion, distance2=check.distance2, flagged=check.flagged,
        undecided=check.undecided,
        weak=bool(check.faint), flagged_by_paper=None, causes=tuple(CAUSES[code] for code in check.causes),
    )  # fmt: skip


def show(report: simulation_schemas.ChecksReport) -> None:
    """Prints shares of checks and drives by move, then false alarms in hours of driving."""
    for rigs in report.rigs:
        _show(rigs)
    for name, failure in report.failed.items():
        console.show(f"no result: {name}: {failure}", "red")


def _show(rigs: simulation_schemas.RigStatistics) -> None:
    console.show("commissioned rigs" if rigs.commissioned else "rigs of which nothing is known", "bold")
    table = console.table(
        "served pose", "checks", "blind", "faint", "undecided", "clear", "flagged", "of clear", "95 %", "drives",
        "suspected", "confirmed", "delay", right=range(1, 13),
    )  # fmt: skip
    for row in rigs.moved:
        share = f"{100.0 * row.flagged / row.clear:.1f} %" if row.clear else "-"
        between = (
            "-"
            if row.flagged_low is None or row.flagged_high is None
            else f"{100.0 * row.flagged_low:.1f} to {100.0 * row.flagged_high:.1f} %"
        )
        delay = f"{median(row.delay_checks):g} checks" if row.delay_checks else "-"
        counts = (row.checks, row.blind, row.weak, row.undecided, row.clear, row.flagged)
        drives = (row.drives, row.suspected, row.confirmed)
        table.add_row(row.moved, *map(str, counts), share, between, *map(str, drives), delay)
    console.out.print(table)
    places = console.table("right mount", "checks", "blind", "faint", "undecided", "flagged", right=range(1, 6))
    for place in rigs.places:
        places.add_row(place.place, *map(str, (place.checks, place.blind, place.weak, place.undecided, place.flagged)))
    console.out.print(places)
    hours = console.table("right mount", "hours", "suspicions", "alarms", "in 100 h at most (95 %)", right=range(1, 5))
    for driven in rigs.hours:
        hours.add_row(
            driven.how,
            console.figure(driven.hours, 1),
            *map(str, (driven.suspicions, driven.alarms)),
            console.figure(driven.alarms_per_100_h_at_most, 1),
        )
    console.out.print(hours)
    if rigs.tails:
        tails = console.table(
            "places of", "places", "farthest, σ", "accused at, σ", "in 100 h", "at most (95 %)", right=range(1, 6)
        )
        for tail in rigs.tails:
            tails.add_row(
                f"{tail.stay_checks} checks",
                str(tail.places),
                console.figure(tail.farthest, 1),
                "-" if tail.accused_at is None else console.figure(tail.accused_at, 0),
                console.figure(tail.alarms_per_100_h, 3),
                console.figure(tail.alarms_per_100_h_at_most, 3),
            )
        console.out.print(tails)
    for driven in rigs.hours:
        if driven.alarmed:
            console.show(f"false alarms, {driven.how}: {', '.join(driven.alarmed)}")
