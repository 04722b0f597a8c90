"""Faults that checks see, in any state of motion: `healthy` for three periods at most while the extrinsic is wrong, and
right mounts stay healthy. `tests/campaign` plays the same on rendered drives into a real service."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from calibration.test_lifecycle import HEALTHY, RULES, check
from coec.calibration import state as lifecycle
from coec.calibration.monitor.change_detector import Observation
from coec.calibration.state_machine import HealthState
from coec.calibration.types import Matrix4, Reason
from coec.geometry import se3
from support.vehicles import BEFORE, BEGIN_S, NS_PER_S, STEP_S, PairBench

WRONG_DEG, WRONG_M = 1.0, 0.1
PERIOD_S = 5
LIMIT_S = 3 * PERIOD_S
"""An acquitting check vouches for three periods of the monitor."""

TURNED = (3.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""A step, degrees and metres."""


def moved(xi: Sequence[float], share: Callable[[float], float] = lambda _: 1.0) -> Callable[[int], Matrix4]:
    """The truth of a mount that moves by a share of ξ, degrees and metres: a function of the seconds since `STEP_S`."""
    step = np.array([*np.radians(xi[:3]), *xi[3:]])

    def truth(stamp_ns: int) -> Matrix4:
        since_s = stamp_ns / NS_PER_S - STEP_S
        return BEFORE if since_s < 0.0 else se3.perturb(BEFORE, share(since_s) * step)

    return truth


STILL = moved((0.0,) * 6)


@dataclass(frozen=True)
class Moment:
    """Health and the error of the served extrinsic after a second of driving."""

    second: int
    health: str
    reasons: tuple[str, ...]
    off_deg: float
    off_m: float

    @property
    def is_blind(self) -> bool:
        """Whether it is healthy over a wrong extrinsic."""
        return self.health == "healthy" and (self.off_deg >= WRONG_DEG or self.off_m >= WRONG_M)


def driven(bench: PairBench, seconds: Iterable[int], speed_mps: float | Callable[[int], float] = 5.0) -> list[Moment]:
    """Drives for these seconds of sensor time, counted from `STEP_S`, and looks after each."""
    moments = []
    for second in seconds:
        speed = speed_mps(second) if callable(speed_mps) else speed_mps
        bench.drive(STEP_S + second, STEP_S + second + 1, speed)
        health = bench.answers.health_reply
        off = se3.difference(bench.pose, bench.truth((STEP_S + second) * NS_PER_S))
        reasons = tuple(reason.code for reason in health.reasons)
        angle_deg = float(np.degrees(se3.rotation_angle_rad(se3.perturbation(off))))
        moments.append(Moment(second, health.state, reasons, angle_deg, float(np.linalg.norm(off[3:]))))
    return moments


def blind_s(moments: Sequence[Moment]) -> int:
    """Seconds for which it is healthy while wrong, all together."""
    return sum(moment.is_blind for moment in moments)


def changes(moments: Sequence[Moment]) -> list[tuple[int, str, tuple[str, ...]]]:
    """Each change of health: when, to what, why."""
    return [
        (after.second, after.health, after.reasons)
        for before, after in pairwise(moments)
        if after.health != before.health
    ]


def most_per_minute(moments: Sequence[Moment]) -> int:
    """Changes from healthy in any minute."""
    begins = [second for second, health, _ in changes(moments) if health != "healthy"]
    return max((sum(begin <= other < begin + 60 for other in begins) for begin in begins), default=0)


def settled(folder: Path, truth: Callable[[int], Matrix4] = STILL) -> PairBench:
    """A pair that is healthy when the fault begins; the policy applies every accepted window."""
    bench = PairBench(folder / "state", "always", truth=truth)
    bench.drive(BEGIN_S, STEP_S)
    assert bench.answers.health_reply.state == "healthy"
    return bench


def stop_and_go(second: int) -> float:
    """Twenty seconds of driving, fifteen of standing."""
    return 5.0 if second % 35 < 20 else 0.0


STANDING = 0.0
SPEEDS = (STANDING, 5.0, stop_and_go)
IN_TRAFFIC = pytest.mark.parametrize(
    "speed_mps", [*(pytest.param(speed_mps, marks=pytest.mark.slow) for speed_mps in SPEEDS[:2]), stop_and_go]
)
AXES = ((3.0, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, -3.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.12, 0.0))


# --- steps ----------------------------------------------------------------------------------------------------------


@pytest.mark.fault(
    "the mount steps by 3° or 12 cm while the vehicle stands, drives, or stops and goes",
    "`healthy` for three periods at most while wrong",
)
@pytest.mark.parametrize(
    ("speed_mps", "xi"),
    [
        pytest.param(speed_mps, xi, marks=() if number == axis else pytest.mark.slow)
        for number, speed_mps in enumerate(SPEEDS)
        for axis, xi in enumerate(AXES)
    ],
)
def test_a_step(tmp_path: Path, xi: tuple[float, ...], speed_mps: float | Callable[[int], float]) -> None:
    bench = settled(tmp_path, moved(xi))
    if speed_mps == STANDING:
        bench.truth = bench.worker.truth = moved(xi, lambda since_s: float(since_s >= 30.0))
    moments = driven(bench, range(100), speed_mps)
    assert 0 < blind_s(moments) <= LIMIT_S, changes(moments)


@pytest.mark.fault(
    "the mount was turned by 3° while the service was off, and the vehicle stands, drives, or stops and goes",
    "it is never healthy over that extrinsic",
)
@IN_TRAFFIC
def test_a_step_while_the_service_is_off(tmp_path: Path, speed_mps: float | Callable[[int], float]) -> None:
    bench = settled(tmp_path, moved(TURNED))
    bench.restart()
    moments = driven(bench, range(120), speed_mps)
    assert blind_s(moments) == 0, changes(moments)


@pytest.mark.fault("`rollback` to a wrong extrinsic, standing or in traffic", "it is never healthy over that extrinsic")
@IN_TRAFFIC
def test_a_rollback_to_a_wrong_pose(tmp_path: Path, speed_mps: float | Callable[[int], float]) -> None:
    bench = settled(tmp_path, moved(TURNED))
    first = bench.answers.history(0, 2**63 - 1, 10).results[0].window_id
    moments = driven(bench, range(120))
    assert moments[-1].health == "healthy"
    assert moments[-1].off_deg < 0.1
    driven(bench, range(120, 150), speed_mps)
    assert bench.do("rollback", to=first) == "rolled_back"
    moments = driven(bench, range(150, 270), speed_mps)
    assert moments[0].off_deg > WRONG_DEG
    assert blind_s(moments) == 0, changes(moments)


@pytest.mark.fault(
    "a check that flags the extrinsic, after a restart, a rollback, or a time without checks",
    "it does not make healthy",
)
@pytest.mark.parametrize(
    ("speed_mps", "after"),
    [
        (5.0, "restart"),
        (STANDING, "rollback"),
        (5.0, "overdue"),
        pytest.param(STANDING, "restart", marks=pytest.mark.slow),
        pytest.param(5.0, "rollback", marks=pytest.mark.slow),
        pytest.param(STANDING, "overdue", marks=pytest.mark.slow),
    ],
)
def test_a_flagged_check_does_not_make_healthy(tmp_path: Path, after: str, speed_mps: float) -> None:
    bench = settled(tmp_path, moved(TURNED))
    driven(bench, range(1), speed_mps)  # the last check of pairs before the step
    first = bench.answers.history(0, 2**63 - 1, 10).results[0].window_id
    if after == "restart":
        bench.restart()
    elif after == "rollback":
        assert bench.do("rollback", to=first) == "rolled_back"
    else:
        bench.check_clocks(LIMIT_S + 1.0)
    assert bench.answers.health_reply.state != "healthy"
    assert bench.do("hold") == "held"  # so that no window repairs what is served
    moments = driven(bench, range(1, 120), speed_mps)
    assert "healthy" not in {moment.health for moment in moments}, changes(moments)


# --- moves that no single window shows ------------------------------------------------------------------------------


@pytest.mark.fault(
    "the mount shifts by 12 cm, and windows with `search.dof: 3` see nothing of it",
    "it does not become healthy while the checks see the translation, also after a window that dates the move",
)
@pytest.mark.parametrize("dates_the_move", [False, True])
def test_a_shift_that_windows_cannot_see(tmp_path: Path, *, dates_the_move: bool) -> None:
    bench = settled(tmp_path, moved((0.0, 0.0, 0.0, 0.12, 0.0, 0.0)))
    bench.recorder.sees_moves = dates_the_move
    moments = driven(bench, range(200))
    accepted = bench.answers.history(0, 2**63 - 1, 100).results
    assert len(accepted) > 3, "windows go on being accepted"
    assert blind_s(moments) <= LIMIT_S, changes(moments)


@pytest.mark.fault("a mount that drifts by 0.05° a minute", "no more than 0.3° off while healthy")
def test_a_drift(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    worst_deg = worst_of_drift(tmp_path, minutes=4)
    record_property("figure", f"{worst_deg:.2f}° off at most in 4 minutes")


@pytest.mark.slow
@pytest.mark.fault("a mount that drifts by 0.05° a minute, for half an hour", "no more than 0.3° off while healthy")
def test_a_long_drift(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    worst_deg = worst_of_drift(tmp_path, minutes=30)
    record_property("figure", f"{worst_deg:.2f}° off at most in 30 minutes")
    assert worst_deg <= 0.3


def worst_of_drift(folder: Path, minutes: int) -> float:
    """Error of the served extrinsic, degrees, at most while it is healthy."""
    bench = settled(folder, moved((0.05, 0.0, 0.0, 0.0, 0.0, 0.0), lambda since_s: since_s / 60.0))
    bench.worker.scatter = np.random.default_rng(6)
    moments = driven(bench, range(60 * minutes))
    return max(moment.off_deg for moment in moments if moment.health == "healthy")


def swinging(swing_deg: float) -> Callable[[int], Matrix4]:
    """The truth of a mount that swings to and fro in two seconds."""
    return moved((swing_deg, 0.0, 0.0, 0.0, 0.0, 0.0), lambda since_s: float(np.sin(np.pi * since_s + 0.9)))


@pytest.mark.fault("a loose mount that swings by 0.8° or 1.5°, which windows refuse", "not healthy after 60 s or 15 s")
@pytest.mark.parametrize(("swing_deg", "limit_s"), [(0.8, 60), (1.5, LIMIT_S)])
def test_a_loose_mount(tmp_path: Path, swing_deg: float, limit_s: int) -> None:
    bench = settled(tmp_path, swinging(swing_deg))
    bench.worker.window_fault = Reason("overlap", "The edges do not lie on each other.")
    moments = driven(bench, range(90))
    assert max(moment.second for moment in moments if moment.health == "healthy") <= limit_s, changes(moments)


@pytest.mark.parametrize(("swing_deg", "limit_s"), [pytest.param(0.8, 60, marks=pytest.mark.slow), (1.5, LIMIT_S)])
def test_a_loose_mount_whose_windows_are_accepted(tmp_path: Path, swing_deg: float, limit_s: int) -> None:
    bench = settled(tmp_path, swinging(swing_deg))
    moments = driven(bench, range(240))
    assert max(moment.second for moment in moments if moment.health == "healthy") <= limit_s, changes(moments)


# --- causes in the data ---------------------------------------------------------------------------------------------


@pytest.mark.fault(
    "720 checks with causes in the data that alternate strictly", "not healthy three periods after the first"
)
@pytest.mark.parametrize("codes", [("time_offset", "ego_motion_wrong"), ("open_field", "dark", "time_offset")])
def test_causes_that_alternate(codes: tuple[str, ...]) -> None:
    observations = [check(1005 + PERIOD_S * number, cause=codes[number % len(codes)]) for number in range(720)]
    assert healthy_until(observations) <= LIMIT_S - PERIOD_S


@pytest.mark.fault(
    "120 checks that accuse the mount, or show a cause in the data, by turns", "not healthy after three periods"
)
def test_a_wrong_mount_and_a_cause_that_alternate() -> None:
    observations = [
        check(1005 + PERIOD_S * number, flagged=number % 2 == 0, cause="time_offset" if number % 2 else None)
        for number in range(120)
    ]
    assert healthy_until(observations) <= LIMIT_S - PERIOD_S


def healthy_until(observations: Sequence[Observation]) -> float:
    """Seconds after the first of these checks at which a pair is healthy for the last time; 0 if it never is."""
    state = lifecycle.after_observation(HEALTHY, check(1000), RULES)
    last_s = 0.0
    for observation in observations:
        state = lifecycle.after_observation(state, observation, RULES)
        if state.health is HealthState.HEALTHY:
            last_s = (observation.stamp_ns - observations[0].stamp_ns) / NS_PER_S
    return last_s


# --- right mounts ---------------------------------------------------------------------------------------------------


@pytest.mark.fault("a right mount that is parked, or drives in stop-and-go traffic", "it stays healthy")
@pytest.mark.parametrize(
    ("speed_mps", "seconds"),
    [
        (STANDING, 300),
        (stop_and_go, 300),
        pytest.param(stop_and_go, 1200, marks=pytest.mark.slow),
    ],
)
def test_a_right_mount(tmp_path: Path, speed_mps: float | Callable[[int], float], seconds: int) -> None:
    bench = settled(tmp_path)
    bench.worker.scatter = np.random.default_rng(1)
    moments = driven(bench, range(seconds), speed_mps)
    assert changes(moments) == []


@pytest.mark.slow
@pytest.mark.fault("a right mount that is parked for an hour", "it stays healthy once the last window is done")
def test_a_right_mount_that_is_parked_for_an_hour(tmp_path: Path) -> None:
    bench = settled(tmp_path)
    bench.worker.scatter = np.random.default_rng(1)
    driven(bench, range(60), STANDING)
    assert changes(driven(bench, range(60, 3660), STANDING)) == []


@pytest.mark.fault(
    "poor stretches of 5 to 60 s with a right mount", "healthy or degraded with the true reason, at most once a minute"
)
def test_a_right_mount_through_poor_stretches(tmp_path: Path) -> None:
    bench = settled(tmp_path)
    bench.worker.scatter = rng = np.random.default_rng(3)
    moments, second = [], 0
    for number in range(4):
        poor, good = int(rng.integers(5, 60)), int(rng.integers(10, 90))
        bench.worker.cause = ("open_field", "dark")[number % 2]
        moments += driven(bench, range(second, second + poor))
        bench.worker.cause = None
        moments += driven(bench, range(second + poor, second + poor + good))
        second += poor + good
    reported = changes(moments)
    assert {health for _, health, _ in reported} <= {"healthy", "degraded"}, reported
    assert all(
        set(reasons) <= {"open_field", "dark", "settling"} for _, health, reasons in reported if health != "healthy"
    )
    assert most_per_minute(moments) <= 1, reported
