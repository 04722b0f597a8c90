"""`coec alarms`: what the change detector does with simulated streams of checks whose truth is known. How often it
accuses a right mount, and how soon it notices a step, a creep, and a mount that was wrong before the first check;
the document, the tables and the curve of the result. The streams are sampled, not rendered, because 100 hours of
driving are 72 000 checks. They are worse than the detector assumes: bad checks come in bursts.

The streams are drawn, not rendered, because 100 hours of driving are 72 000 checks. They are worse than the detector
assumes: bad checks come in bursts.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import inf, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.baseline import PRIOR_SPREAD_POSE as SPREAD_POSE
from coec.calibration.baseline import PRIOR_SPREAD_ROTATION as SPREAD_ROTATION
from coec.calibration.baseline import STREET, UNCOMMISSIONED_BIAS, Accuracy
from coec.calibration.monitor import change_detector
from coec.calibration.monitor.check_verdict import UNCOMMISSIONED
from coec.calibration.monitor.sequential_tests import FREEDOM
from coec.config import MonitorConfig
from coec.geometry.points import random_direction
from coec.reports import console
from coec.reports.page_parts import finite_or_none
from coec_lab.experiments import evaluation_schema as wire

STREET_CHECKS = 24
"""Checks in one street, on average: two minutes at one every five seconds."""

BURST_EVERY, BURST_CHECKS = 100, 3
"""Checks between two poor stretches, and checks in one, on average."""

BAD = np.array([radians(2.5)] * 3 + [0.1] * 3)
"""Standard deviations of the offsets that checks report in poor stretches (rad, m)."""

SETTLED_CHECKS = 60
"""Checks of a right mount before a step."""

PATIENCE_CHECKS = 240
"""Checks after a step within which it must be noticed: twenty minutes at one every five seconds."""

STATED_H = (1.0, 3.0, 10.0, 30.0, 100.0)
"""Stated hours between false alarms; for each of them the alarms are counted."""

STEPS_DEG = (0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0, 2.0, 3.0, 4.5, 7.0)
"""Sizes of the steps."""

CREEP_DEG_PER_H, CREEP_H, CREEPS = 0.1, 12.0, 3
"""How fast a mount creeps, for how long at most, and how many creeps are drawn."""

WRONG_DEG, WRONG_CHECKS = (0.0, 0.3, 0.5, 0.7, 1.0, 2.0, 3.0), 12
"""How far a mount is from what is served from the first check on, and the number of checks within which this must be
noticed: a minute at one every five seconds."""

SEED = 20_230_617
"""Any number; the first day of CVPR 2023, where the method appeared."""

OnProgress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Delay:
    """Time from a step to the first check that suspects it and to the one that confirms it, per drawn step, s; infinite
    where this did not happen within `PATIENCE_CHECKS`."""

    step_deg: float
    suspect_s: tuple[float, ...]
    confirmed_s: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Creep:
    """Time until a steady creep was suspected and confirmed, per drawn creep, h; infinite where it was not within
    `CREEP_H`."""

    deg_per_h: float
    suspect_h: tuple[float, ...]
    confirmed_h: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class FromStart:
    """A mount is wrong by `off_deg` from the first check on: the time until a check wants a window soon, per drawn rig,
    s; infinite where none of `WRONG_CHECKS` did. Nothing was learned about the rig. So the mount may be right and
    the estimator off instead; the detector weighs that by the bias of estimators on other rigs."""

    off_deg: float
    requested_s: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class AlarmExperiments:
    """All experiments at one configuration."""

    config: MonitorConfig
    false: tuple[wire.FalseAlarmsRow, ...]
    delays: tuple[Delay, ...]
    creep: Creep
    from_start: tuple[FromStart, ...]


def measured(config: MonitorConfig, hours: float, steps: int, on_progress: OnProgress) -> AlarmExperiments:
    """Runs all experiments: `hours` of a right mount, and `steps` steps of every size (seeded)."""
    total = 2 + len(STEPS_DEG) + len(WRONG_DEG)
    false = false_alarms(config, hours)
    on_progress(1, total)
    delays = []
    for place, step_deg in enumerate(STEPS_DEG):
        delays.append(delay(config, step_deg, steps))
        on_progress(2 + place, total)
    crept = creep(config)
    started = []
    for place, off_deg in enumerate(WRONG_DEG):
        started.append(from_start(config, off_deg, steps))
        on_progress(3 + len(STEPS_DEG) + place, total)
    return AlarmExperiments(config, false, tuple(delays), crept, tuple(started))


def false_alarms(config: MonitorConfig, hours: float) -> tuple[wire.FalseAlarmsRow, ...]:
    """Counts how often the evidence of a right mount rises to the level of each stated time. A rise counts once; the
    next can count only after the suspicion is over."""
    levels = change_detector.alarm_levels(config)
    at = [change_detector.alarm_level(config, stated) for stated in STATED_H]
    above, alarms = [False] * len(at), [0] * len(at)
    checks = round(hours * change_detector.S_PER_H / config.period_s)
    for state in _states(_stream(np.random.default_rng(SEED), np.zeros((checks, 6)), config), levels):
        for place, level in enumerate(at):
            if state.evidence >= level and not above[place]:
                above[place], alarms[place] = True, alarms[place] + 1
            elif state.evidence < levels.clear:
                above[place] = False
    return tuple(
        wire.FalseAlarmsRow(stated_h=stated_h, driven_h=hours, alarms=count)
        for stated_h, count in zip(STATED_H, alarms, strict=True)
    )


def delay(config: MonitorConfig, step_deg: float, steps: int) -> Delay:
    """Steps about drawn axes, each after `SETTLED_CHECKS` checks of a right mount."""
    suspect, confirmed = [], []
    for index in range(steps):
        rng = np.random.default_rng([SEED, round(step_deg * 1000), index])
        truth = np.zeros((SETTLED_CHECKS + PATIENCE_CHECKS, 6))
        truth[SETTLED_CHECKS:, :3] = radians(step_deg) * random_direction(rng)
        first = _first(config, _stream(rng, truth, config), SETTLED_CHECKS)
        suspect.append(first[0] * config.period_s)
        confirmed.append(first[1] * config.period_s)
    return Delay(step_deg, tuple(suspect), tuple(confirmed))


def creep(config: MonitorConfig) -> Creep:
    """A mount that turns steadily about a drawn axis from the first check on."""
    checks = round(CREEP_H * change_detector.S_PER_H / config.period_s)
    hours = np.arange(checks) * config.period_s / change_detector.S_PER_H
    suspect, confirmed = [], []
    for index in range(CREEPS):
        rng = np.random.default_rng([SEED, index])
        truth = np.zeros((checks, 6))
        truth[:, :3] = np.radians(CREEP_DEG_PER_H * hours)[:, None] * random_direction(rng)
        first = _first(config, _stream(rng, truth, config), 0)
        suspect.append(first[0] * config.period_s / change_detector.S_PER_H)
        confirmed.append(first[1] * config.period_s / change_detector.S_PER_H)
    return Creep(CREEP_DEG_PER_H, tuple(suspect), tuple(confirmed))


def from_start(config: MonitorConfig, off_deg: float, rigs: int) -> FromStart:
    """Rigs that are wrong about drawn axes from the first check on."""
    requested_s, levels = [], change_detector.alarm_levels(config)
    for index in range(rigs):
        rng = np.random.default_rng([SEED, round(off_deg * 1000), index, WRONG_CHECKS])
        truth = np.zeros((WRONG_CHECKS, 6))
        truth[:, :3] = radians(off_deg) * random_direction(rng)
        states = enumerate(_states(_stream(rng, truth, config), levels), start=1)
        requested_s.append(
            next((check * config.period_s for check, state in states if state.outcome in change_detector.ACCUSING), inf)
        )
    return FromStart(off_deg, tuple(requested_s))


def _first(config: MonitorConfig, stream: Iterator[change_detector.Observation], after: int) -> tuple[float, float]:
    """Checks from index `after` on until the evidence reached the suspect level and the confirmed level."""
    levels = change_detector.alarm_levels(config)
    suspect = float("inf")
    for index, state in enumerate(_states(stream, levels)):
        if index < after:
            continue
        if state.evidence >= levels.suspect:
            suspect = min(suspect, float(index - after + 1))
        if state.evidence >= levels.confirmed:
            return suspect, float(index - after + 1)
    return suspect, float("inf")


def _states(
    stream: Iterator[change_detector.Observation], levels: change_detector.AlarmLevels
) -> Iterator[change_detector.MonitorState]:
    state = change_detector.MonitorState()
    for observation in stream:
        state = change_detector.after_observation(state, observation, levels)
        yield state


def _stream(
    rng: np.random.Generator, truth: NDArray[np.float64], config: MonitorConfig
) -> Iterator[change_detector.Observation]:
    """Checks of a mount that is off what is served by `truth` (n, 6), rad and m."""
    turns = Accuracy(np.zeros(6), UNCOMMISSIONED_BIAS, SPREAD_ROTATION)
    shifts = Accuracy(np.zeros(6), UNCOMMISSIONED_BIAS, SPREAD_POSE)
    noise, sigma = (
        np.concatenate([of_turns[:3], of_shifts[3:]])
        for of_turns, of_shifts in (
            (turns.noise(config.pairs), shifts.noise(config.pairs)),
            (turns.sigma(config.pairs), shifts.sigma(config.pairs)),
        )
    )
    checks = len(truth)
    rig = rng.normal(0.0, 0.5, 6) * UNCOMMISSIONED_BIAS
    streets = rng.normal(0.0, 1.0, (checks, 6)) * STREET
    street = np.cumsum(rng.random(checks) < 1.0 / STREET_CHECKS)
    offset = truth + rig + streets[street] + rng.standard_t(FREEDOM, (checks, 6)) * noise
    offset = np.where(np.array(_bad(rng, checks))[:, None], rng.standard_t(FREEDOM, (checks, 6)) * BAD, offset)
    squares = (offset / sigma) ** 2
    distance2 = np.maximum(
        squares[:, :3].sum(axis=1) / UNCOMMISSIONED.max_distance2_rotation,
        squares.max(axis=1) / UNCOMMISSIONED.max_farthest2_pose,
    )
    period_ns = round(config.period_s * 1e9)
    for index in range(checks):
        begin_ns = index * period_ns
        yield change_detector.Observation(
            stamp_ns=begin_ns + period_ns - 1,
            pair_stamps_ns=tuple(begin_ns + pair for pair in range(config.pairs)),
            metrics=(),
            offset=offset[index],
            sigma=sigma,
            noise=noise,
            place=STREET,
            dispersion=1.0,
            distance2=float(distance2[index]),
            flagged=bool(distance2[index] > 1.0),
            weak=False,
            flagged_by_paper=None,
            causes=(),
        )


def _bad(rng: np.random.Generator, checks: int) -> list[bool]:
    """(n,) which checks lie in poor stretches."""
    bad, within = [], False
    for sample in rng.random(checks):
        within = sample >= 1.0 / BURST_CHECKS if within else sample < 1.0 / BURST_EVERY
        bad.append(bool(within))
    return bad


def document_of(alarms: AlarmExperiments) -> wire.AlarmsReport:
    """What `coec alarms --json` prints."""
    config = alarms.config
    return wire.AlarmsReport(
        period_s=config.period_s,
        hours_between_false_alarms=config.hours_between_false_alarms,
        hours_between_false_suspicions=config.hours_between_false_suspicions,
        false=alarms.false,
        delays=tuple(
            wire.DelayRow(
                step_deg=row.step_deg,
                steps=len(row.confirmed_s),
                suspect_s=_spread(row.suspect_s),
                confirmed_s=_spread(row.confirmed_s),
            )
            for row in alarms.delays
        ),
        creep_deg_per_h=alarms.creep.deg_per_h,
        creep_suspect_h=_spread(alarms.creep.suspect_h),
        creep_confirmed_h=_spread(alarms.creep.confirmed_h),
        from_start=tuple(
            wire.FromStartRow(
                off_deg=row.off_deg,
                rigs=len(row.requested_s),
                wanted=float(np.mean(np.isfinite(row.requested_s))),
                wanted_s=_spread(row.requested_s),
            )
            for row in alarms.from_start
        ),
    )


def show(report: wire.AlarmsReport) -> None:
    """Prints the tables."""
    false = console.table("stated between false alarms", "driven", "false alarms", right=range(3))
    for row in report.false:
        false.add_row(f"{row.stated_h:g} h", f"{row.driven_h:g} h", str(row.alarms))
    console.out.print(false)
    columns = ("step", "steps", "suspect, median", "p95", "confirmed, median", "p95", "unit")
    delays = console.table(*columns, right=range(6))
    for step in report.delays:
        figures = (step.suspect_s.median, step.suspect_s.p95, step.confirmed_s.median, step.confirmed_s.p95)
        delays.add_row(f"{step.step_deg:g}°", str(step.steps), *(console.figure(value, 0) for value in figures), "s")
    console.out.print(delays)
    started = console.table("wrong from the first check", "rigs", "window wanted", "median", "unit", right=range(4))
    for rigs in report.from_start:
        median = console.figure(rigs.wanted_s.median, 0)
        started.add_row(f"{rigs.off_deg:g}°", str(rigs.rigs), f"{100 * rigs.wanted:.0f} %", median, "s")
    console.out.print(started)
    suspect, confirmed = report.creep_suspect_h, report.creep_confirmed_h
    console.show(
        f"a creep of {report.creep_deg_per_h:g}°/h is suspected after {console.figure(suspect.median, 1)} h and "
        f"confirmed after {console.figure(confirmed.median, 1)} h (median); - is not in time"
    )


def delay_curve(report: wire.AlarmsReport) -> bytes:
    """PNG: the delay against the size of the step; steps that are not noticed in time have no point."""
    # matplotlib takes a second to import.
    from matplotlib.figure import Figure

    from coec_lab.experiments.plots import png

    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    axes = figure.subplots()
    steps = [row.step_deg for row in report.delays]
    for name, spreads in (
        ("suspect", [row.suspect_s for row in report.delays]),
        ("confirmed", [row.confirmed_s for row in report.delays]),
    ):
        medians = [np.nan if spread.median is None else spread.median for spread in spreads]
        ninety_fifths = [np.nan if spread.p95 is None else spread.p95 for spread in spreads]
        (line,) = axes.plot(steps, medians, marker="o", label=f"{name}, median")
        axes.plot(steps, ninety_fifths, color=line.get_color(), linestyle=":", label=f"{name}, 95th percentile")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xticks(steps, [f"{step:g}" for step in steps])
    axes.set_xlabel("step of the mount, degrees")
    axes.set_ylabel("delay, s")
    axes.set_title(f"a check every {report.period_s:g} s, a false alarm in {report.hours_between_false_alarms:g} h")
    axes.grid(alpha=0.3)
    axes.legend()
    return png(figure)


def _spread(values: Sequence[float]) -> wire.Spread:
    """Spread of some delays; a figure is None if the delay there is infinite, that is, not noticed in time."""
    median, p95 = (float(np.percentile(values, share, method="higher")) for share in (50, 95))
    return wire.Spread(median=finite_or_none(median), p95=finite_or_none(p95), max=finite_or_none(max(values)))
