"""One rule for green: `healthy` means that a check, or an accepted window, of the extrinsic that is served acquitted it
within three periods, or in the place where the vehicle stands, with nothing that contradicts it since.

The rule is tried on random sequences of checks, windows, commands, silence, restarts and steps of the clock, beside a
model that keeps nothing but who acquitted what, and when."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from calibration.test_lifecycle import RIG, RULES, check, estimate, moved_within
from coec.calibration import state as lifecycle
from coec.calibration.monitor.change_detector import ACQUITTAL_PERIODS, Observation, holds_at_rest
from coec.calibration.monitor.sensor_faults import CAUSES
from coec.calibration.state import ExtrinsicHold, PairState
from coec.calibration.state_machine import HealthState
from coec.calibration.types import Decision, Estimate
from coec.geometry import se3
from coec.service.engine.check_progress import CheckProgress
from coec.service.ingest.decoder import CAMERA, LIDAR, StreamCounts
from coec.service.ingest.pair_stream import SelectionStatistics, StreamStatistics

S = 1_000_000_000
PERIOD_S = RULES.monitor.period_s
LASTS_S = ACQUITTAL_PERIODS * PERIOD_S
CODES = ("time_offset", "ego_motion_wrong", "dark", "open_field", "lidar_beams_lost")
STEPS = 40
NEGLIGIBLE_STEP = np.array([*np.radians([0.05, 0.05, 0.05]), 0.01, 0.01, 0.01])
"""By how much an extrinsic may change without a new check."""


@dataclass
class World:
    """A pair, the two clocks, and what the rule remembers.

    Attributes:
        acquitted_s: when the served extrinsic was last acquitted; None: never.
        at_rest: whether that was where the vehicle stands, with nothing that contradicts it since.
    """

    rng: np.random.Generator
    state: PairState = field(default_factory=lambda: lifecycle.initial_state(RIG))
    now_s: int = 1000
    acquitted_s: int | None = None
    at_rest: bool = False
    stands: bool = False
    log: list[str] = field(default_factory=list)
    greens: int = 0

    def __post_init__(self) -> None:
        self.steady_s = self.completed_s = 0.0
        self.progress = CheckProgress(PERIOD_S, 0.0, self.report)

    @property
    def report(self) -> StreamStatistics:
        many = StreamCounts(10 * self.now_s, 10 * self.now_s)
        selected = SelectionStatistics(checks=self.now_s, last_ns=self.now_s * S)
        return StreamStatistics(streams={CAMERA: many, LIDAR: many}, pairs=self.now_s, selection=selected, pace=1.0)

    def step(self, what: str, after: PairState, completed_s: int | None = None) -> None:
        """Takes a step as the service does: progress, and then a look at the clocks. `completed_s`: sensor time of the
        last pair of a check, or accepted window, that was completed."""
        self.log.append(f"{self.now_s} {what}: {self.state.health.value} -> {after.health.value}")
        if (np.abs(se3.difference(after.T_camera_lidar, self.state.T_camera_lidar)) > NEGLIGIBLE_STEP).any():
            self.acquitted_s, self.at_rest = None, False
        self.state = after
        if completed_s is not None:
            acquits = after.monitor.acquitted_ns == completed_s * S
            self.progress.completed(completed_s * S, self.steady_s, self.report, acquits=acquits)
        self.inspection()

    def inspection(self) -> None:
        """What the service does once a second."""
        why = self.progress.overdue(self.report, self.steady_s, at_rest=holds_at_rest(self.state.monitor))
        if why is not None:
            self.state = lifecycle.overdue(self.state, why)

    def passes(self, seconds: int) -> None:
        self.now_s += seconds
        self.steady_s += seconds
        self.inspection()

    # --- what may happen --------------------------------------------------------------------------------------------

    def checked(self) -> None:
        self.passes(int(PERIOD_S))
        kind = str(self.rng.choice(["right", "right", "wrong", "elsewhere", "undecided", "powerless", "cause"]))
        if self.rng.random() < 0.2:
            self.stands = not self.stands
        wrong = kind in ("wrong", "elsewhere")
        observation: Observation = check(self.now_s, flagged=wrong)
        if kind == "elsewhere":
            observation = replace(observation, offset=self.rng.normal(0.0, 0.03, 6))
        if kind == "undecided":
            observation = replace(observation, undecided=True, distance2=1.5)
        if kind == "powerless":
            observation = replace(observation, weak=True, has_power=False, flagged=bool(self.rng.random() < 0.5))
        if kind == "cause":
            codes = self.rng.choice(CODES, size=int(self.rng.integers(1, 3)), replace=False)
            observation = replace(observation, causes=tuple(CAUSES[code] for code in codes))
        if self.stands:
            observation = replace(observation, standing_stamps_ns=observation.pair_stamps_ns)
        acquits = kind == "right"
        contradicts = observation.flagged and not observation.causes
        self.at_rest = self.stands and ((self.at_rest and not contradicts) or acquits)
        if acquits:
            self.acquitted_s, self.completed_s = self.now_s, self.steady_s
        self.step(
            f"check {kind}{' standing' if self.stands else ''}",
            lifecycle.after_observation(self.state, observation, RULES),
            self.now_s,
        )

    def solved(self) -> None:
        stamp_s = self.now_s - int(self.rng.choice([0, 5, 60]))
        value: Estimate = estimate(float(self.rng.choice([0.0, 0.1, 3.0])), stamp_s)
        if self.rng.random() < 0.3:
            value = moved_within(0.5, 3.0, stamp_s)
        if self.rng.random() < 0.2:
            value = estimate(0.1, stamp_s, Decision.FAILED)
        before = lifecycle.before_estimate(self.state, value, (stamp_s - 50) * S, RULES)
        after = lifecycle.after_estimate(before, value, (stamp_s - 50) * S, RULES, self.now_s * S)
        accepted = value.verdict.decision is not Decision.FAILED
        self.step("window", after, stamp_s if accepted else None)
        if accepted and self.state.latest is value:
            self.acquitted_s = max(stamp_s, self.acquitted_s or 0)
            self.completed_s = self.steady_s

    def commanded(self) -> None:
        name = str(self.rng.choice(["apply", "roll back", "reset", "hold", "release", "commission"]))
        state = self.state
        directions: dict[str, Callable[[], PairState]] = {
            "apply": lambda: lifecycle.apply_pending(state, RULES),
            "roll back": lambda: lifecycle.rolled_back(
                state, estimate(2.0).optimum.T_camera_lidar, estimate(2.0), RULES
            ),
            "reset": lambda: lifecycle.reset(state, RIG),
            "hold": lambda: lifecycle.held(state, ExtrinsicHold()),
            "release": lambda: lifecycle.released(state),
            "commission": lambda: lifecycle.after_commissioning(state, state.T_camera_lidar),
        }
        try:
            after = directions[name]()
        except lifecycle.CommandRefusedError:
            return
        if name in ("apply", "roll back", "reset"):
            self.acquitted_s, self.at_rest = None, False
        self.step(name, after)

    def restarted(self) -> None:
        self.progress = CheckProgress(PERIOD_S, self.steady_s, self.report)
        self.acquitted_s, self.at_rest = None, False
        self.step("restart", lifecycle.restored(self.state))

    def clock_stepped(self) -> None:
        self.now_s -= int(self.rng.integers(1, 500))
        self.progress.time_stepped_back()
        self.acquitted_s, self.at_rest = None, False
        self.step("clock", lifecycle.time_stepped_back(self.state, self.now_s * S))

    def silent(self) -> None:
        self.passes(int(self.rng.integers(1, 40)))

    def anything(self) -> None:
        directions = (self.checked, self.solved, self.commanded, self.restarted, self.clock_stepped, self.silent)
        directions[self.rng.choice(len(directions), p=[0.62, 0.14, 0.08, 0.03, 0.03, 0.10])]()

    def holds(self) -> bool:
        """Whether the rule for green holds."""
        if self.state.health is not HealthState.HEALTHY:
            return True
        self.greens += 1
        if self.acquitted_s is None:
            return False
        # Answers may be a period of sensor time late, so the steady clock is the stricter one.
        recent = self.steady_s - self.completed_s <= LASTS_S and self.now_s - self.acquitted_s <= LASTS_S + PERIOD_S
        return self.at_rest or recent


def tried(seeds: range) -> int:
    """Tries so many sequences; returns how often a pair was healthy."""
    greens = 0
    for seed in seeds:
        world = World(np.random.default_rng(seed))
        for _ in range(STEPS):
            world.anything()
            assert world.holds(), f"seed {seed}: healthy without an acquittal\n" + "\n".join(world.log)
        greens += world.greens
    return greens


@pytest.mark.fault(
    "any sequence of checks, windows, commands, silence, restarts and steps of the clock",
    "`healthy` implies a check that acquits what is served, within three periods or in the place where it stands",
)
def test_green_means_acquitted(record_property: Callable[[str, object], None]) -> None:
    greens = tried(range(120))
    record_property("figure", f"120 sequences of {STEPS} steps, healthy after {greens}")
    assert greens > 300, "the sequences are such that pairs do get healthy"


@pytest.mark.slow
@pytest.mark.fault(
    "20,000 such sequences",
    "`healthy` implies a check that acquits what is served, within three periods or in the place where it stands",
)
def test_green_means_acquitted_in_twenty_thousand_sequences(record_property: Callable[[str, object], None]) -> None:
    greens = tried(range(1000, 21_000))
    record_property("figure", f"healthy after {greens} of {20_000 * STEPS} steps")
