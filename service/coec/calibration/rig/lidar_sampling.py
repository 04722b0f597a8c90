"""Selects by sensor stamps alone the sweeps of two LiDARs that are registered to each other, and the input and the
result of such a registration: an edge of a rig without a camera.

A look uses sweeps a few seconds apart, once in each period of sensor time. Periods are counted from the zero of sensor
time, so that a restarted service and a replay at any rate take the same sweeps. A sweep of a is taken with the nearest
sweep of b, once later ones cannot be nearer. Sweeps are large, so only those are kept that may still be taken.
"""

from collections import Counter, deque
from dataclasses import dataclass
from math import radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.pairing import MOTION_LATE_NS, MOTION_SAMPLES, TimeLine, motion_at
from coec.calibration.types import NS_PER_S, EgoMotion, LidarFrame, Matrix4, Reason, SweepTiming

KNOWN_BEFORE = np.array([radians(10.0)] * 3 + [1.0] * 3)
"""(6,) standard deviation of a mount before any look (rad, m): at worst, mounts are built to that."""

LEAST_SHARE = 0.05
"""Least share of the points of b that must meet a surface of a: with fewer the fields of view hardly overlap."""


@dataclass(frozen=True, slots=True, eq=False)
class LidarRig:
    """Two LiDARs of one vehicle as they were mounted.

    Attributes:
        a, b: names; b is brought to a. The denser one should be a: its points make the surfaces.
        T_a_b_nominal: (4, 4) maps coordinates of b to those of a.
        T_a_ego: (4, 4) maps ego coordinates to those of a; carries ego-motion to both.
        sweep_a, sweep_b: how the time of points follows from azimuth if the sweep carries no times; None if unknown.
    """

    a: str
    b: str
    T_a_b_nominal: Matrix4
    T_a_ego: Matrix4
    sweep_a: SweepTiming | None = None
    sweep_b: SweepTiming | None = None


@dataclass(frozen=True, slots=True)
class SweepPair:
    """A sweep of each LiDAR, near each other in time, and the ego-motion then; None if unknown."""

    a: LidarFrame
    b: LidarFrame
    motion: EgoMotion | None


@dataclass(frozen=True, slots=True, eq=False)
class Met:
    """Points of b on surfaces of a, over all pairs.

    Attributes:
        residual: (N,) distance from the surface along its normal, metres.
        jacobian: (N, 8) its derivative by the unknowns.
        tilt: (N, 2, 6) the same for the error of the normal: its two standard deviations, as derivatives by ξ.
        pair: (N,) number of the pair of sweeps.
        place: (N, 3) the points in the frame of a.
        tried: number of points that were tried.
    """

    residual: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    tilt: NDArray[np.float64]
    pair: NDArray[np.int64]
    place: NDArray[np.float64]
    tried: int


@dataclass(frozen=True, slots=True, eq=False)
class RangeBias:
    """By how much b measures longer than a, metres, with its standard deviation."""

    longer_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class LidarEdge:
    """The pose of b in a.

    Attributes:
        rig: the two LiDARs.
        T_a_b: (4, 4) the pose found.
        correction: (6,) ξ with T_a_b = perturb(T_a_b_nominal, ξ): about the axes of a, rad and m.
        covariance: (6, 6) of ξ; as wide as the prior on axes that the surroundings do not determine.
        range_bias: a nuisance that is estimated along with the pose.
        rms_m: root mean square distance of the points of b from the surfaces of a that they met.
        points: number of points of b that met a surface of a, over all pairs.
        share: their share of the points of b that were tried.
        pairs: number of pairs of sweeps.
        reasons: why the result is not to be used; empty if it may be.
    """

    rig: LidarRig
    T_a_b: Matrix4
    correction: NDArray[np.float64]
    covariance: NDArray[np.float64]
    range_bias: RangeBias
    rms_m: float
    points: int
    share: float
    pairs: int
    reasons: tuple[Reason, ...]

    @property
    def sigma(self) -> NDArray[np.float64]:
        """(6,) standard deviations of the correction."""
        return np.sqrt(self.covariance.diagonal())

    @property
    def chi2(self) -> float:
        """Squared length of the correction in its standard deviations, 6 degrees of freedom: shows whether one of the
        two has moved. NaN if the covariance is singular."""
        try:
            return float(self.correction @ np.linalg.solve(self.covariance, self.correction))
        except np.linalg.LinAlgError:
            return float("nan")


PAIRS = 2
"""Pairs of sweeps of one registration. See docs/measured.md."""

SPACING_NS = 2 * NS_PER_S
"""Time between these pairs: some ten metres further on other surfaces are in view, and a mount is hardly ever hit in
between."""

MAX_STAMP_DIFFERENCE_NS = 60_000_000
"""Most difference between the stamps of a pair: half a turn at 10 Hz, and a little."""

LATEST_NS = 400_000_000
"""How long after an instant a sweep of a may come: two turns at 5 Hz."""

SWEEPS_HELD = 12
"""Most sweeps of b that wait for those of a: those of the times above at 20 Hz, and one more."""

CANDIDATES_HELD = 2
"""Most sweeps of a that wait for those of b."""


@dataclass(frozen=True, slots=True)
class SweepSet:
    """Pairs of sweeps, in the order of their stamps."""

    pairs: tuple[SweepPair, ...]

    @property
    def start_ns(self) -> int:
        """Stamp of its first sweep."""
        return min(self.pairs[0].a.stamp_ns, self.pairs[0].b.stamp_ns)

    @property
    def stamp_ns(self) -> int:
        """Stamp of the last sweep of a."""
        return self.pairs[-1].a.stamp_ns


@dataclass(frozen=True, slots=True)
class MissedSweep:
    """A sweep of a that was due but not taken, with the cause: no sweep of b is near (`no_sweep`), no ego-motion with a
    velocity is known (`no_ego_motion`), the vehicle stands (`standing`), or points have no time (`no_point_time`)."""

    stamp_ns: int
    cause: str


SampledSweeps = list[SweepSet | MissedSweep]


class SweepSampler:
    """Picks the sweeps of looks at two LiDARs a and b. It holds at most `CANDIDATES_HELD` + `PAIRS` sweeps of a, and
    `SWEEPS_HELD` + `PAIRS` of b.

    Attributes:
        losses: number of sweeps of a that were due but not taken, by cause; `incomplete`: taken, but their look was
            never complete.
    """

    def __init__(
        self,
        period_s: float,
        motion_tolerance_s: float,
        max_jump_s: float,
        min_speed_mps: float,
        *,
        timed_a: bool = False,
        timed_b: bool = False,
    ) -> None:
        """No look is taken while the vehicle is slower than `min_speed_mps`, because it sees nothing new. `timed_a`,
        `timed_b`: whether point times are known for sweeps that do not carry them."""
        self._period_ns = max(round(period_s * NS_PER_S), PAIRS * SPACING_NS)
        self._motion_tolerance_ns = round(motion_tolerance_s * NS_PER_S)
        self._min_speed_mps = min_speed_mps
        self._timed_a, self._timed_b = timed_a, timed_b
        jump_ns = round(max_jump_s * NS_PER_S)
        self._time_a, self._time_b, self._time_motion = TimeLine(jump_ns), TimeLine(jump_ns), TimeLine(jump_ns)
        self._candidates: deque[LidarFrame] = deque()
        self._sweeps: deque[LidarFrame] = deque()
        self._motions: deque[EgoMotion] = deque(maxlen=MOTION_SAMPLES)
        self._taken: list[SweepPair] = []
        self._instant: tuple[int, int] | None = None
        self.losses: Counter[str] = Counter()

    @property
    def latest_ns(self) -> int | None:
        """Stamp of the latest sweep of a; None before the first."""
        return self._time_a.latest_ns

    @property
    def held(self) -> int:
        """Number of sweeps that are kept."""
        return len(self._candidates) + len(self._sweeps) + 2 * len(self._taken)

    def push_a(self, sweep: LidarFrame) -> SampledSweeps:
        """Takes the next sweep of a; returns the looks and misses that became certain."""
        before_ns = self._time_a.latest_ns
        if self._time_a.refusal(sweep.stamp_ns) is not None:
            return []
        if before_ns is not None and sweep.stamp_ns < before_ns:
            self._begin_new_time()
        instant, late_ns = self._instant_before(sweep.stamp_ns)
        if late_ns <= LATEST_NS and instant != self._instant:
            self._instant = instant
            self._candidates.append(sweep)
            if len(self._candidates) > CANDIDATES_HELD:
                self._candidates.popleft()
                self.losses["overrun"] += 1
        return self._decided()

    def push_b(self, sweep: LidarFrame) -> SampledSweeps:
        """Takes the next sweep of b, likewise."""
        before_ns = self._time_b.latest_ns
        if self._time_b.refusal(sweep.stamp_ns) is not None:
            return []
        if before_ns is not None and sweep.stamp_ns < before_ns:
            self._sweeps.clear()
        _, after_ns = self._instant_before(sweep.stamp_ns + MAX_STAMP_DIFFERENCE_NS)
        if after_ns <= LATEST_NS + 2 * MAX_STAMP_DIFFERENCE_NS:
            self._sweeps.append(sweep)
            if len(self._sweeps) > SWEEPS_HELD:
                self._sweeps.popleft()
        return self._decided()

    def push_motion(self, motion: EgoMotion) -> SampledSweeps:
        """Takes the next ego-motion, likewise."""
        before_ns = self._time_motion.latest_ns
        if self._time_motion.refusal(motion.stamp_ns) is not None:
            return []
        if before_ns is not None and motion.stamp_ns < before_ns:
            self._motions.clear()
        self._motions.append(motion)
        return self._decided()

    def _begin_new_time(self) -> None:
        """Drops all that is kept, because sensor time stepped back."""
        self._candidates.clear()
        self._taken.clear()
        self._instant = None

    def _instant_before(self, stamp_ns: int) -> tuple[tuple[int, int], int]:
        """The last instant at or before a stamp, as its period and its number in the period, and how long before."""
        period, within_ns = divmod(stamp_ns, self._period_ns)
        number = min(within_ns // SPACING_NS, PAIRS - 1)
        return (period, number), within_ns - number * SPACING_NS

    def _decided(self) -> SampledSweeps:
        results: SampledSweeps = []
        while self._candidates and self._is_certain(self._candidates[0].stamp_ns):
            taken = self._take(self._candidates.popleft())
            if taken is not None:
                results.append(taken)
        self._forget()
        return results

    def _is_certain(self, stamp_ns: int) -> bool:
        """Whether later frames can no longer change what belongs to a sweep of a, or are overdue."""
        latest_ns = self._time_a.latest_ns
        if latest_ns is not None and latest_ns - stamp_ns > MOTION_LATE_NS:
            return True
        others = (self._time_b.latest_ns, self._time_motion.latest_ns)
        return all(other_ns is not None and other_ns >= stamp_ns for other_ns in others)

    def _take(self, a: LidarFrame) -> SweepSet | MissedSweep | None:
        """What becomes of a sweep of a; None if its look is not complete yet."""
        (period, number), _ = self._instant_before(a.stamp_ns)
        if self._taken and (number == 0 or self._taken[0].a.stamp_ns // self._period_ns != period):
            self.losses["incomplete"] += len(self._taken)
            self._taken.clear()
        pair = self._pair_of(a)
        if isinstance(pair, MissedSweep):
            self.losses[pair.cause] += 1
            return pair
        self._taken.append(pair)
        if len(self._taken) < PAIRS:
            return None
        sweep_set = SweepSet(tuple(self._taken))
        self._taken.clear()
        return sweep_set

    def _pair_of(self, a: LidarFrame) -> SweepPair | MissedSweep:
        b = min(self._sweeps, key=lambda sweep: abs(sweep.stamp_ns - a.stamp_ns), default=None)
        motion = motion_at(list(self._motions), a.stamp_ns, self._motion_tolerance_ns)
        if b is None or abs(b.stamp_ns - a.stamp_ns) > MAX_STAMP_DIFFERENCE_NS:
            return MissedSweep(a.stamp_ns, "no_sweep")
        if motion is None or motion.linear_mps is None:
            return MissedSweep(a.stamp_ns, "no_ego_motion")
        if motion.stays_below(self._min_speed_mps):
            return MissedSweep(a.stamp_ns, "standing")
        if any(sweep.time_offset_s is None and not timed for sweep, timed in ((a, self._timed_a), (b, self._timed_b))):
            return MissedSweep(a.stamp_ns, "no_point_time")
        return SweepPair(a, b, motion)

    def _forget(self) -> None:
        """Drops sweeps of b that can no longer be taken with any sweep of a."""
        latest_ns = self._time_a.latest_ns
        if latest_ns is None:
            return
        needed_ns = (self._candidates[0].stamp_ns if self._candidates else latest_ns) - MAX_STAMP_DIFFERENCE_NS
        while self._sweeps and self._sweeps[0].stamp_ns < needed_ns:
            self._sweeps.popleft()
