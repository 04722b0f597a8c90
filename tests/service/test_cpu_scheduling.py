"""Whose turn it is: the pairs of a vehicle drive beside a worker, on a clock that only they have."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import mean

import pytest

from coec.config import BudgetConfig
from coec.service.cpu_budget import BUCKET_DEPTH_S, CHECKS_SHARE, CheckScheduler, CpuBucket, Debt

S = 1_000_000_000
FRAME_S = 0.5
PERIOD_S, SLICE_S, URGENT_S = 5.0, 180.0, 30.0
NAMES = ("front", "left", "rear", "right")
LONGEST_UNSEEN_S = 15.0
"""What issue 17 requires."""

Suspicion = Callable[[str, float], bool]


def nobody(_name: str, _now_s: float) -> bool:
    return False


@dataclass
class Drive:
    """Pairs that bring a frame twice a second, a check in every period and a window at the end of every slice, and
    a worker that does one thing after the other, a check before a window. A pair with a window in work asks for no
    check. `begun` and `ended` are the checks by pair, s; `spent_s` is what the worker took."""

    turns: CheckScheduler
    observation_s: Mapping[str, float]
    window_s: float
    suspected: Suspicion = nobody
    silent: Callable[[str, float], bool] = nobody
    frame_s: float = FRAME_S
    started: dict[str, list[float]] = field(default_factory=dict)
    finished: dict[str, list[float]] = field(default_factory=dict)
    windows: list[tuple[str, float]] = field(default_factory=list)
    spent_s: float = 0.0

    def run(self, seconds: float) -> Drive:
        waiting: list[tuple[int, float, str]] = []
        in_work: set[str] = set()
        ready: set[str] = set()
        busy_until_s, doing = 0.0, ""
        ends_s = {}
        for name in self.observation_s:
            phase = self.turns.join(name, PERIOD_S, SLICE_S)
            ends_s[name] = SLICE_S - phase * (SLICE_S - URGENT_S)
            self.started[name], self.finished[name] = [], []
        for step in range(round(seconds / self.frame_s)):
            now_s = step * self.frame_s
            if doing and now_s >= busy_until_s:
                kind, name = doing.split()
                self._end(kind, name, now_s)
                in_work -= {name} if kind == "window" else set()
                doing = ""
            for name in self.observation_s:
                if self.silent(name, now_s):
                    continue
                if now_s >= ends_s[name]:
                    ends_s[name] = now_s + SLICE_S * self.turns.stretch
                    in_work.add(name)
                    self.windows.append((name, now_s))
                    heapq.heappush(waiting, (1, now_s, f"window {name}"))
                if step % round(PERIOD_S / self.frame_s) == 0:
                    ready.add(name)
                if name not in ready or name in in_work:
                    continue
                if self.turns.try_acquire(name, round(now_s * S), suspected=self.suspected(name, now_s)):
                    ready.remove(name)
                    self.started[name].append(now_s)
                    heapq.heappush(waiting, (0, now_s, f"check {name}"))
            if not doing and waiting:
                doing = heapq.heappop(waiting)[2]
                kind, name = doing.split()
                busy_until_s = now_s + (self.observation_s[name] if kind == "check" else self.window_s)
        return self

    def _end(self, kind: str, name: str, now_s: float) -> None:
        if kind == "check":
            self.spent_s += self.observation_s[name]
            self.turns.record_check(name, self.observation_s[name])
            self.turns.release(name)
            self.finished[name].append(now_s)
        else:
            self.spent_s += self.window_s
            self.turns.record_solve(name, self.window_s)

    def longest_unseen_s(self, name: str) -> float:
        times = [0.0, *self.finished[name]]
        return max(later - earlier for earlier, later in pairwise(times))

    @property
    def late(self) -> float:
        """Share of the checks that are answered after the period within which their pair's frames need not wait."""
        took = [
            end - begin
            for name in self.started
            for begin, end in zip(self.started[name], self.finished[name], strict=False)
        ]  # fmt: skip
        return sum(one > PERIOD_S for one in took) / len(took)


def four(observation_s: float) -> dict[str, float]:
    return dict.fromkeys(NAMES, observation_s)


@pytest.mark.fault("four cameras on half a core", "no pair is unseen for more than 15 s while their checks fit")
@pytest.mark.parametrize(("observation_s", "window_s"), [(0.12, 1.5), (0.3, 6.0), (0.45, 5.0)])
def test_four_pairs_that_fit_are_seen_every_15_s(
    observation_s: float, window_s: float, record_property: Callable[[str, object], None]
) -> None:
    turns = CheckScheduler(0.5)
    drive = Drive(turns, four(observation_s), window_s).run(1080.0)
    unseen_s = max(drive.longest_unseen_s(name) for name in NAMES)
    record_property("figure", f"{unseen_s:.1f} s")
    assert turns.demand <= 0.5
    assert turns.stretch == 1.0
    assert unseen_s <= LONGEST_UNSEEN_S
    assert drive.spent_s / 1080.0 <= 0.5


def test_where_the_budget_suffices_every_check_is_made_with_the_frame_that_requests_it() -> None:
    """The windows are apart by more than they take, so a check waits for its pair's own window alone."""
    drive = Drive(CheckScheduler(0.5), four(0.12), 1.5).run(720.0)
    for name in NAMES:
        late = [at for at in drive.started[name] if at % PERIOD_S > 1e-6]
        ends = [at for each, at in drive.windows if each == name]
        assert len(drive.started[name]) == 144
        assert all(any(0.0 <= at - end <= PERIOD_S for end in ends) for at in late)


def test_where_it_does_not_all_periods_stretch_alike() -> None:
    turns = CheckScheduler(0.2)
    drive = Drive(turns, four(0.7), 6.0).run(3600.0)
    assert turns.demand == pytest.approx(4 * 0.7 / PERIOD_S + 4 * 6.0 / SLICE_S)
    counts = [len(drive.started[name]) for name in NAMES]
    assert max(counts) - min(counts) <= 0.05 * mean(counts)
    stretched = 3600.0 / mean(counts) / PERIOD_S
    assert stretched == pytest.approx(turns.stretch, rel=0.1)
    assert drive.spent_s / 3600.0 == pytest.approx(0.2, rel=0.1)
    windows = [sum(each == name for each, _ in drive.windows) for name in NAMES]
    assert mean(windows) == pytest.approx(3600.0 / SLICE_S / turns.stretch, rel=0.25)


@pytest.mark.fault(
    "eight cameras and three LiDARs on the default budget", "each pair gets its turn, and status says what they lack"
)
def test_sixteen_pairs_are_checked_in_turn_and_what_they_lack_is_reported(
    record_property: Callable[[str, object], None],
) -> None:
    """Those of `deploy/examples/rig.yaml`, at the prices of a slow core."""
    names = [str(number) for number in range(16)]
    turns = CheckScheduler(BudgetConfig().cores)
    drive = Drive(turns, dict.fromkeys(names, 0.3), 6.0, frame_s=0.1).run(720.0)
    counts = [len(drive.finished[name]) for name in names]
    unseen_s = max(drive.longest_unseen_s(name) for name in names)
    record_property("figure", f"{turns.demand:.2f} cores wanted, unseen {unseen_s:.0f} s, periods × {turns.stretch:g}")
    assert max(counts) - min(counts) <= 2, "in turn"
    assert turns.demand == pytest.approx(16 * (0.3 / PERIOD_S + 6.0 / SLICE_S))
    assert turns.stretch == pytest.approx(turns.demand / BudgetConfig().cores, abs=0.05)
    assert unseen_s <= 3.0 * turns.stretch * PERIOD_S
    assert drive.late <= 0.1, "the worker keeps up with what it is asked"


def test_a_budget_beyond_what_one_worker_does_makes_answers_late() -> None:
    """Which is why it is the budget that has to be set, not the checks that have to wait."""
    names = [str(number) for number in range(16)]
    drive = Drive(CheckScheduler(64.0), dict.fromkeys(names, 0.3), 6.0, frame_s=0.1).run(720.0)
    assert drive.spent_s / 720.0 > 0.9, "it does what it can"
    assert drive.late > 0.2


def test_a_dear_pair_takes_no_more_turns_than_a_cheap_one() -> None:
    drive = Drive(CheckScheduler(0.1), {"front": 1.0, "rear": 0.1}, 0.5).run(1800.0)
    front, rear = (len(drive.started[name]) for name in ("front", "rear"))
    assert front == pytest.approx(rear, rel=0.2)


def test_a_suspicion_comes_first_borrows_and_pays_back() -> None:
    begin_s, end_s = 1000.0, 1100.0

    def suspected(name: str, now_s: float) -> bool:
        return name == "left" and begin_s <= now_s < end_s

    turns = CheckScheduler(0.2)
    drive = Drive(turns, four(0.7), 2.0, suspected).run(2000.0)
    during = [at for at in drive.started["left"] if begin_s + PERIOD_S <= at < end_s]
    gaps = [later - earlier for earlier, later in pairwise(during)]
    assert max(gaps) == pytest.approx(PERIOD_S, abs=2.0), "as often as configured, while the others are stretched"
    others = [name for name in NAMES if name != "left"]
    assert all(drive.longest_unseen_s(name) < 60.0 for name in others), "nobody starves for it"
    assert drive.spent_s / 2000.0 == pytest.approx(0.2, rel=0.1), "what was borrowed is paid back"
    after = [sum(at > end_s + 100.0 for at in drive.started[name]) for name in NAMES]
    assert max(after) - min(after) <= 2, "and all are equal again"


def test_what_may_be_borrowed_is_bounded() -> None:
    turns = CheckScheduler(0.1)
    turns.join("front", PERIOD_S, SLICE_S)
    started = 0
    for _ in range(100):  # within one instant: nothing is earned
        if not turns.try_acquire("front", S, suspected=True):
            break
        turns.record_check("front", 0.5)
        turns.release("front")
        started += 1
    assert turns.in_store_s == pytest.approx(-BUCKET_DEPTH_S * 0.1, abs=0.5)
    assert started == 5, "what lies in store, as much again, and the one that goes below"
    assert not turns.try_acquire("front", 2 * S, suspected=False)


def test_all_that_are_suspected_share_like_the_others() -> None:
    """A LiDAR that is knocked makes every camera suspect."""
    drive = Drive(CheckScheduler(0.2), four(0.7), 2.0, lambda *_: True).run(1200.0)
    counts = [len(drive.started[name]) for name in NAMES]
    assert max(counts) - min(counts) <= 2
    assert drive.spent_s / 1200.0 == pytest.approx(0.2, rel=0.05), "beyond what lay in store and what is owed, nothing"


def test_windows_never_take_everything() -> None:
    """One window that costs as much as two minutes of the budget."""
    drive = Drive(CheckScheduler(0.1), four(0.1), 12.0).run(3600.0)
    assert all(drive.longest_unseen_s(name) <= 60.0 for name in NAMES)
    assert drive.spent_s / 3600.0 == pytest.approx(0.1, rel=0.25)


def test_a_camera_that_is_off_leaves_its_share_to_the_others() -> None:
    turns = CheckScheduler(0.1)
    drive = Drive(turns, four(0.4), 0.1, silent=lambda name, now_s: name == "left" and now_s > 600.0).run(1800.0)
    before = sum(at < 600.0 for at in drive.started["front"]) / 600.0
    after = sum(at > 900.0 for at in drive.started["front"]) / 900.0
    assert after == pytest.approx(before * 4 / 3, rel=0.1)
    shares = turns.shares()
    assert not shares["left"].active
    assert shares["front"].active


def test_the_same_drive_has_the_same_turns_at_any_rate() -> None:
    """Only stamps pass: how fast they come is nobody's business."""
    once, again = (Drive(CheckScheduler(0.2), four(0.7), 6.0).run(900.0).started for _ in range(2))
    assert once == again


@pytest.mark.fault("a clock that jumps by hours", "the budget neither stands still nor is lost")
@pytest.mark.parametrize("jump_s", [-7200.0, 7200.0])
def test_a_clock_that_jumps_earns_nothing_and_stops_nobody(jump_s: float) -> None:
    turns = CheckScheduler(0.1)
    for name in ("front", "rear"):
        turns.join(name, PERIOD_S, SLICE_S)
    started = {"front": [0, 0], "rear": [0, 0]}
    for step in range(4_800):
        now_s = step * FRAME_S
        for name in started:
            jumped_s = jump_s if name == "front" and now_s >= 1200.0 else 0.0
            if turns.try_acquire(name, round((100_000.0 + now_s + jumped_s) * S), suspected=False):
                turns.record_check(name, 1.0)
                turns.release(name)
                started[name][now_s >= 1200.0] += 1
    for before, after in started.values():
        assert after == pytest.approx(before, rel=0.1)


def test_a_freak_is_no_debt_for_an_hour() -> None:
    store = CpuBucket(0.5)
    store.pay(500.0, usual_s=0.1)
    assert store.level == pytest.approx(-2 * BUCKET_DEPTH_S * 0.5)
    store.pay(1.0, usual_s=0.1)
    assert store.level == pytest.approx(-2 * BUCKET_DEPTH_S * 0.5), "nor does the next one make it larger"
    dear = CpuBucket(0.1)
    dear.pay(30.0, usual_s=30.0)
    assert dear.level == pytest.approx(1.0 - 30.0), "what is usual is paid in full"


def test_windows_are_paid_in_instalments() -> None:
    store, debt = CpuBucket(0.5), Debt(over_s=100.0, owed_s=10.0)
    store.level = 0.0
    store.earn(1.0, [debt])
    assert store.level == pytest.approx(0.4, abs=0.01)
    assert debt.owed_s == pytest.approx(9.9, abs=0.01)
    debt.owed_s = 1000.0
    store.earn(2.0, [debt])
    assert store.level == pytest.approx(0.4 + 0.125, abs=0.01), "looks have a quarter, whatever windows cost"


def test_another_budget_holds_at_once() -> None:
    turns = CheckScheduler(10.0)
    turns.reconfigure(0.1)
    assert turns.cores == 0.1
    assert turns.in_store_s == pytest.approx(BUCKET_DEPTH_S * 0.1)


def test_first_windows_of_many_pairs_are_spread() -> None:
    turns = CheckScheduler(0.5)
    phases = [turns.join(str(index), PERIOD_S, SLICE_S) for index in range(8)]
    assert phases[:4] == [0.0, 0.5, 0.25, 0.75]
    assert sorted(phases) == [index / 8 for index in range(8)]


@pytest.mark.fault(
    "24 pairs begin at once, and nobody knows yet what they cost", "the budget holds from the first minutes on"
)
def test_windows_of_the_first_minutes_come_out_of_the_budget(record_property: Callable[[str, object], None]) -> None:
    """At the prices that were measured for eight cameras of 700×700 and three LiDARs."""
    names = [str(number) for number in range(24)]
    drive = Drive(CheckScheduler(0.5), dict.fromkeys(names, 0.1), 2.0, frame_s=0.1).run(SLICE_S)
    assert len(drive.windows) >= 20, "nearly each pair has had its first"
    placed_in_store = BUCKET_DEPTH_S * 0.5
    record_property("figure", f"{drive.spent_s / SLICE_S:.2f} cores")
    assert drive.spent_s <= 0.5 * SLICE_S + 2.0 * placed_in_store
    assert all(drive.longest_unseen_s(name) <= LONGEST_UNSEEN_S for name in names)


def test_what_one_window_costs_is_expected_of_the_others() -> None:
    turns = CheckScheduler(0.5)
    for name in NAMES:
        turns.join(name, PERIOD_S, SLICE_S)
        assert turns.try_acquire(name, S, suspected=False)
        turns.release(name)
    assert turns.demand == 0.0
    turns.record_solve("left", 9.0)
    turns.record_check("rear", 0.5)
    assert turns.demand == pytest.approx(4 * (0.5 / PERIOD_S + 9.0 / SLICE_S))
    assert turns.shares()["front"].window_s is None, "but nobody says that it was measured"
    turns.join_checks("roof to flank", 15.0)
    assert turns.try_acquire("roof to flank", S, suspected=False)
    assert turns.demand == pytest.approx(4 * (0.5 / PERIOD_S + 9.0 / SLICE_S)), "who has other looks, and no windows"


@pytest.mark.fault(
    "a LiDAR of eight pairs is named", "their windows end one after the other, as fast as the budget pays"
)
def test_windows_that_the_rig_wants_follow_each_other_as_the_budget_earns_them() -> None:
    names = [str(number) for number in range(8)]
    turns = CheckScheduler(0.5)
    for name in names:
        turns.join(name, PERIOD_S, SLICE_S)
        turns.record_solve(name, 3.0)
    later_s = [turns.window_turn_s(name, 100 * S) for name in names]
    separation_s = 3.0 / (0.5 * (1.0 - CHECKS_SHARE))
    assert later_s == pytest.approx([separation_s * place for place in range(8)])
    turns.try_acquire(names[0], 130 * S, suspected=False)
    assert turns.window_turn_s(names[0], 130 * S) == pytest.approx(8 * separation_s - 30.0)
    turns.try_acquire(names[0], 160 * S, suspected=False)
    turns.try_acquire(names[0], 180 * S, suspected=False)
    assert turns.window_turn_s(names[0], 200 * S) == 0.0, "what was long ago keeps nobody waiting"
