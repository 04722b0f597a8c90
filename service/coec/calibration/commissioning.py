"""Commissioning: learns the baseline of a rig from good windows. It holds the estimator's bias and spread on the rig,
the limits of checks, and the limits of equation (2) for full calibrations, from calibrations that reach the right
pose and calibrations that cannot.

Nothing is set by hand. The same windows are checked at the right pose and at poses moved by known amounts. Each limit
is set so that it flags at most the stated rate of right checks of other pairs, and as many moved checks as that allows.
(A spread learned from few pairs is itself uncertain, so the limit is that of a prediction.) Right checks are made on
blocks of time that were left out when the bias was learned: a limit from the same frames would hold only for places
where the rig has been. Moves are seeded, so the same windows give the same baseline.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import degrees, inf, radians, sqrt

import numpy as np
from numpy.typing import NDArray

from coec.calibration import baseline
from coec.calibration.monitor.check import Check, CheckInput, DepthCue, Expected, check_at, depth_cue, gather
from coec.calibration.monitor.check_edges import POSE_DOF, ROTATION_DOF
from coec.calibration.monitor.check_verdict import FALSE_ALARM_RATE, MIN_PAIRS, Opinion, edges_per_pair, opinion
from coec.calibration.monitor.sensor_faults import scene_baseline
from coec.calibration.pipeline import calibrate
from coec.calibration.solver import prepare_window_data
from coec.calibration.types import (
    DepthModel,
    Estimate,
    ImageReader,
    Matrix4,
    Progress,
    Silence,
    Step,
    Steps,
    Window,
    run_to_end,
)
from coec.config import CalibrationConfig, VerdictConfig
from coec.errors import CalibrationError, DecodeError
from coec.geometry import se3
from coec.geometry.points import random_direction

SOLVES = 6
"""Number of calibrations of each kind, each on a random half of the pairs. Limits lie between the worst right and the
best wrong one."""

MIN_HALF = 5
"""Least pairs of such a half: it takes more pairs than axes to have an uncertainty (three degrees of freedom)."""

NEAR_RAD, LOST_RAD, LOST_REACH_RAD = radians(5.0), radians(20.0), radians(8.0)
"""Distance of the start from the right pose, for calibrations that find it (well inside any search) and for lost ones,
and the reach of a lost one. The last is less than half the second, so that a lost one cannot find the right pose."""

RIGHT_RAD = radians(0.5)
"""A calibration is right if it ends nearer than this to where the estimator puts the rig."""

OF_NOISE = ("sigma", "newton_step")
"""Figures that show how precise a result is, not whether it is the right one. Their limits depend on the use of the
result, and stay as configured."""

VERDICT_SEED = 20_230_617
"""Any number; the first day of CVPR 2023, where the method appeared."""


def verdict_limits(
    window: Window,
    right: Matrix4,
    expected: Matrix4,
    depth: DepthModel,
    images: ImageReader,
    config: CalibrationConfig,
) -> Steps[dict[str, float]]:
    """Learned limits, by the names of `VerdictConfig`; those about which nothing was learned are absent. A step is one
    calibration.

    Args:
        window: all pairs.
        right: (4, 4) the right extrinsic, around which the starts lie.
        expected: (4, 4) where the estimator puts it.
    """
    rng = np.random.default_rng(VERDICT_SEED)
    near: list[Estimate] = []
    lost: list[Estimate] = []
    count = len(window.pairs)
    for number in range(1, 2 * SOLVES + 1):
        astray = number % 2 == 0
        indices = sorted(rng.permutation(count)[: max(count // 2, min(MIN_HALF, count))].tolist())
        xi = np.zeros(6)
        xi[:3] = (LOST_RAD if astray else NEAR_RAD) * random_direction(rng)
        tried = replace(
            window, T_camera_lidar_start=se3.perturb(right, xi), pairs=tuple(window.pairs[i] for i in indices)
        )
        try:
            estimate = calibrate(tried, depth, images, _astray(config) if astray else config, Silence())
        except CalibrationError:
            pass
        else:
            error_rad = se3.rotation_angle_rad(estimate.optimum.T_camera_lidar @ se3.inverse(expected))
            (near if error_rad < RIGHT_RAD else lost).append(estimate)
        yield Step("verdicts", number, 2 * SOLVES)
    return learned(near, lost) if near and lost else {}


def learned(near: Sequence[Estimate], lost: Sequence[Estimate]) -> dict[str, float]:
    """Limits half-way, in ratio, between the right and the wrong calibrations, for every figure that separates all of
    them."""
    limits = {}
    for metric in near[0].verdict.metrics:
        name = f"{'min' if metric.at_least else 'max'}_{metric.name}"
        if name not in VerdictConfig.model_fields or metric.name.startswith(OF_NOISE):
            continue
        sign = 1.0 if metric.at_least else -1.0
        # Logarithms, signed so that more is better.
        worst = float((sign * _log(near, metric.name)).min(initial=inf))
        best = float((sign * _log(lost, metric.name)).max(initial=-inf))
        if np.isfinite(worst) and np.isfinite(best) and worst > best:
            limits[name] = float(np.exp(sign * 0.5 * (worst + best)))
    return limits


def _astray(config: CalibrationConfig) -> CalibrationConfig:
    """The configuration of a search that cannot reach the right pose."""
    reach_deg = degrees(LOST_REACH_RAD)
    reach = {"reach_deg": reach_deg, "rotation_deg": min(reach_deg, config.search.rotation_deg)}
    return config.model_copy(update={"search": config.search.model_copy(update=reach)})


def _log(estimates: Sequence[Estimate], name: str) -> NDArray[np.float64]:
    """Logarithms of one metric over the estimates, where it is positive."""
    values = [m.value for estimate in estimates for m in estimate.verdict.metrics if m.name == name and m.value > 0.0]
    return np.log(np.array(values, dtype=np.float64))


MAX_PAIRS = 48
"""Most pairs that are checked, evenly chosen from all windows: two windows of the default size."""

BLOCKS = 10
"""Blocks of neighbouring pairs, half of which are left out at a time, because neighbours are not independent."""

HALVES = 10
"""Number of draws of the half that is kept."""

PRIOR_BLOCKS = 6
"""Number of blocks for which the spread known from other rigs counts."""

OUTLIER = 4.0
"""Deviations of a half are capped at this multiple of their median (2.7 standard deviations)."""

CHECK_PAIRS = 6
"""Pairs of each check from which limits are learned: about as many as the monitor uses."""

CHECKS, FAR_CHECKS = 12, 5
"""Number of checks at the right pose and after every move, and number far off."""

FOLDS = 4
"""Number of blocks of time; each is checked against the pose that the others find. With the 25 to 48 pairs of one or
two windows a block is as long as a check, and the others are three quarters of the data."""

SMALL_RAD, SMALL_M = radians(0.5), 0.10
"""The smallest moves that have to be detected."""

FAR_RAD = radians(12.0)
"""A move beyond the reach of a check: what a check finds there is no true optimum."""

MOVES = (
    ("0.5 deg", SMALL_RAD, 0.0),
    ("1 deg", radians(1.0), 0.0),
    ("3 deg", radians(3.0), 0.0),
    ("10 cm", 0.0, SMALL_M),
)
"""Moves by name: rotations about random axes (rad) and translations in random directions (m)."""

SEED = 20_230_617
"""Any number; the first day of CVPR 2023, where the method appeared."""

MAX_BIAS_RAD = radians(1.0)
"""A larger bias about an axis means a wrong reference. See docs/measured.md."""

LAYOUT_SHARE = 0.25
"""A lost pose counts as keeping at least this share of the edges of right checks: the layout of a street fits anywhere,
and five checks far off may all have missed that."""

INSISTED_SHARE = 0.25
"""Share of the limits of the squared distances beyond which an optimum is too far off if the edges insist on it: half
the distance. The standard deviations are those of all checks of a rig, while the edges show how sharply this scene
determines the pose. This does not hold if the estimator's bias is unknown, because edges insist on the bias as well."""

POOREST_SHARE = 0.8
"""A limit may require at most this share of the least that right checks showed, because a dozen checks do not include
the poorest stretch of a drive."""

NEAREST_SHARE = 0.25
"""A limit may be at most this share of the squared distance of the nearest moved check, which is half its distance."""

AGREEMENT_RAD = radians(0.5)
"""Least limit of the angle between the cues: a quarter of the hill of the depth cue."""


def commission(
    windows: Sequence[Window],
    depth: DepthModel,
    images: ImageReader,
    config: CalibrationConfig,
    *,
    sensors: dict[str, str],
    reference: Matrix4 | None = None,
    false_alarm_rate: float = FALSE_ALARM_RATE,
    progress: Progress | None = None,
) -> baseline.Baseline:
    """The baseline of the rig of `windows`.

    Args:
        windows: windows of one rig, taken while its extrinsic was right.
        sensors: what identifies the sensors, by stream; the frame ids are added.
        reference: (4, 4) the right extrinsic; None = the workshop calibration of the rig.
        false_alarm_rate: share of checks at a right pose that may be flagged.

    Raises:
        CalibrationError: too few pairs, or the windows contradict the reference: nothing is learned from a rig whose
            extrinsic is wrong.
    """
    listener = progress or Silence()
    steps = commission_in_steps(
        windows,
        depth,
        images,
        config,
        sensors=sensors,
        reference=reference,
        false_alarm_rate=false_alarm_rate,
        progress=listener,
    )
    return run_to_end(steps, listener)


def commission_in_steps(
    windows: Sequence[Window],
    depth: DepthModel,
    images: ImageReader,
    config: CalibrationConfig,
    *,
    sensors: dict[str, str],
    reference: Matrix4 | None = None,
    false_alarm_rate: float = FALSE_ALARM_RATE,
    progress: Progress | None = None,
) -> Steps[baseline.Baseline]:
    """The same, with a pause after every step, so that whoever commissions can do other work in between. The longest
    step is one calibration of half of the pairs, or the preparation of the edges of all of them. `depth` should keep
    `MAX_PAIRS` maps, because every pair is used many times. `progress` receives what happens within a step.

    Raises:
        CalibrationError: as `commission`.
    """
    whole, window_count = _merged(windows), len(windows)
    del windows  # most of their pairs are not needed, and a pause may be long
    rig = whole.rig
    right = rig.T_camera_lidar_nominal if reference is None else reference
    for number, pair in enumerate(whole.pairs, start=1):
        with suppress(DecodeError):  # whoever needs the depth reports that there is none
            depth.infer(pair.camera)
        yield Step("depth", number, len(whole.pairs))
    window_data = prepare_window_data(
        replace(whole, T_camera_lidar_start=right), depth, images, config, progress or Silence()
    )
    yield Step("edges", 1, 2)
    evidence = gather(window_data, FAR_RAD)
    yield Step("edges", 2, 2)
    rotation, pose = yield from _accuracies(evidence, right)
    _check(rotation)
    checks = _Checks(evidence, right, config, Expected(rotation.expected, pose.expected))
    clean = yield from checks.left_out(rotation, pose, "right", CHECKS)
    moved: dict[str, list[Check]] = {}
    for name, turn_rad, shift_m in MOVES:
        moved[name] = yield from checks.moved(turn_rad, shift_m, name, CHECKS)
    far = yield from checks.moved(FAR_RAD, 0.0, "far", FAR_CHECKS)
    known_by = _known_by(len(evidence.pairs))
    monitor = _monitor_limits(clean, moved, far, rotation, pose, false_alarm_rate, known_by)
    accuracy = rotation if config.search.dof == ROTATION_DOF else pose
    expected = se3.perturb(right, accuracy.expected)
    limits = yield from verdict_limits(whole, right, expected, depth, images, config)
    return baseline.Baseline(
        pair=rig.pair,
        T_camera_lidar=right,
        rotation=rotation,
        pose=pose,
        dof=config.search.dof,
        limits=limits,
        monitor=monitor,
        scene=scene_baseline(evidence.scenes),
        false_alarm_rate=false_alarm_rate,
        windows=window_count,
        pairs=len(evidence.pairs),
        detected={
            name: float(np.mean([opinion(seen, rotation, pose, monitor) is Opinion.FLAGGED for seen in seen_after]))
            for name, seen_after in moved.items()
        },
        sensors={**sensors, "camera_frame": rig.camera_frame, "lidar_frame": rig.lidar_frame},
        depth_identity=depth.identity,
        config_hash=baseline.learned_hash(config),
    )


def learn_accuracy(evidence: CheckInput, right: Matrix4) -> tuple[baseline.Accuracy, baseline.Accuracy]:
    """How checks over three and over six degrees of freedom lie about the right pose (4, 4)."""
    return run_to_end(_accuracies(evidence, right), Silence())


def learn_limits(
    evidence: CheckInput,
    right: Matrix4,
    config: CalibrationConfig,
    accuracies: tuple[baseline.Accuracy, baseline.Accuracy],
    rate: float,
) -> baseline.MonitorLimits:
    """The limits of checks for a false-alarm rate."""
    rotation, pose = accuracies
    checks = _Checks(evidence, right, config, Expected(rotation.expected, pose.expected))
    moved = {
        name: run_to_end(checks.moved(turn_rad, shift_m, name, CHECKS), Silence())
        for name, turn_rad, shift_m in MOVES[::3]
    }
    return _monitor_limits(
        run_to_end(checks.left_out(rotation, pose, "right", CHECKS), Silence()),
        moved,
        run_to_end(checks.moved(FAR_RAD, 0.0, "far", FAR_CHECKS), Silence()),
        rotation,
        pose,
        rate,
        _known_by(len(evidence.pairs)),
    )


def _merged(windows: Sequence[Window]) -> Window:
    pairs = sorted((pair for window in windows for pair in window.pairs), key=lambda pair: pair.stamp_ns)
    if len(pairs) <= MIN_PAIRS:
        raise CalibrationError(
            f"commissioning needs more than {MIN_PAIRS} pairs of a camera frame and a sweep, there are {len(pairs)}"
        )
    if any(window.rig.pair != windows[0].rig.pair for window in windows):
        raise CalibrationError("the windows are of several camera-LiDAR pairs: commission one at a time")
    if len(pairs) > MAX_PAIRS:
        pairs = [pairs[round(index)] for index in np.linspace(0, len(pairs) - 1, MAX_PAIRS)]
    return replace(windows[0], pairs=tuple(pairs))


def _accuracies(evidence: CheckInput, right: Matrix4) -> Steps[tuple[baseline.Accuracy, baseline.Accuracy]]:
    """The accuracies over three and six degrees of freedom: the bias from all pairs, the spread of one pair from checks
    of halves of them."""
    count = len(evidence.pairs)
    whole = check_at(evidence, right)
    halves = _halves(count)
    of_halves = []
    for number, half in enumerate(halves, start=1):
        of_halves.append(check_at(evidence.of(half), right))
        yield Step("spread", number, len(halves))
    at_rotation = np.array([seen.offset_rotation for seen in of_halves])
    at_pose = np.array([seen.offset_pose for seen in of_halves])
    # The mean of k of n pairs varies about the mean of all by 1/k - 1/n of the variance of one pair.
    share = np.array([1.0 / len(half) - 1.0 / count for half in halves])
    not_searched = np.array([0.0] * 3 + [np.nan] * 3)
    # Near edges determine translations, and a pixel matters little there: their floor is the same on every rig.
    pixels = np.where(np.arange(6) < ROTATION_DOF, baseline.pixel_floor(evidence.rig.camera), 0.0)
    return (
        _accuracy(
            whole.offset_rotation + not_searched, at_rotation, share, baseline.PRIOR_SPREAD_ROTATION, count, pixels
        ),
        _accuracy(whole.offset_pose, at_pose, share, baseline.PRIOR_SPREAD_POSE, count, pixels),
    )


def _halves(count: int) -> list[list[int]]:
    """Indices of the pairs that each draw keeps: half of the blocks, seeded.

    Half of the blocks are left out at a time instead of one (Shao and Wu 1989, the delete-d jackknife), because a local
    optimum jumps when a pair is left out, and the jackknife of single blocks takes every jump for a spread of the
    whole.
    """
    blocks = np.array_split(np.arange(count), min(count, BLOCKS))
    rng = np.random.default_rng([SEED, count])
    selections = (rng.permutation(len(blocks))[: (len(blocks) + 1) // 2] for _ in range(HALVES))
    return [[int(index) for block in sorted(half) for index in blocks[block]] for half in selections]


def _known_by(count: int) -> int:
    """Degrees of freedom of the spread that so many pairs determine: those known from other rigs, and those of their
    blocks."""
    return PRIOR_BLOCKS + min(count, BLOCKS) - 1


def _accuracy(
    whole: NDArray[np.float64],
    of_halves: NDArray[np.float64],
    share: NDArray[np.float64],
    prior: NDArray[np.float64],
    count: int,
    pixels: NDArray[np.float64],
) -> baseline.Accuracy:
    """The accuracy from a check of all pairs (6,), checks of halves of them (H, 6), and the spread on other rigs
    `prior`.

    The halves vary about the whole by `share` (H,) of the variance of one pair. That variance is itself uncertain with
    few blocks, so it is the posterior mean under an inverse gamma prior of `PRIOR_BLOCKS` degrees of freedom. The bias
    is that of the streets that were driven; on other streets it differs by a share of a pixel (`pixels`, (6,)).
    """
    known_by = _known_by(count)
    deviation = np.abs(of_halves - whole)
    # A single check that ended in another basin must not make the spread of the rig look huge.
    deviation = np.minimum(deviation, OUTLIER * np.median(deviation, axis=0) + baseline.FLOOR)
    variance = (deviation**2 / share[:, None]).mean(axis=0)
    spread = np.sqrt((PRIOR_BLOCKS * prior**2 + (known_by - PRIOR_BLOCKS) * variance) / known_by)
    return baseline.Accuracy(bias=whole, bias_sigma=np.sqrt(spread**2 / count + pixels**2), spread=spread)


def _check(rotation: baseline.Accuracy) -> None:
    if float(np.max(np.abs(rotation.bias[:3]))) > MAX_BIAS_RAD:
        turned = ", ".join(f"{value:+.2f}" for value in np.degrees(rotation.bias[:3]))
        raise CalibrationError(
            f"the windows put the camera ({turned}) deg about x, y, z away from the reference: "
            "calibrate first, or give the calibration that is right"
        )


@dataclass(frozen=True, slots=True, eq=False)
class _LeftOut:
    """A check at the right pose, what depth says there, and its distance from where pairs of other times put the rig:
    squared, over rotations and on the farthest axis of the pose, as in `Accuracy`."""

    seen: Check
    depth: DepthCue
    distance2_rotation: float
    farthest2_pose: float


class _Checks:
    """Makes checks of seeded subsets of the pairs, at the right pose or moved from it by a known amount in seeded
    directions."""

    def __init__(
        self,
        evidence: CheckInput,
        right: Matrix4,
        config: CalibrationConfig,
        expected: Expected,
    ) -> None:
        self._evidence = evidence
        self._right = right
        self._config = config
        self._expected = expected

    def moved(self, turn_rad: float, shift_m: float, name: str, count: int) -> Steps[list[Check]]:
        """`count` checks after a turn and a shift."""
        checks = yield from self._moved(turn_rad, shift_m, name, count)
        return [seen for _, seen in checks]

    def _moved(self, turn_rad: float, shift_m: float, name: str, count: int) -> Steps[list[tuple[CheckInput, Check]]]:
        rng = np.random.default_rng([SEED, round(turn_rad * 1e6), round(shift_m * 1e6)])
        pairs = len(self._evidence.pairs)
        size = min(CHECK_PAIRS, pairs - 1)
        seen = []
        for number in range(1, count + 1):
            # Neighbouring pairs, as the monitor uses them.
            first = int(rng.integers(0, pairs))
            indices = sorted((first + step) % pairs for step in range(size))
            xi = np.concatenate([turn_rad * random_direction(rng), shift_m * random_direction(rng)])
            moved = se3.perturb(self._right, xi)
            part = self._evidence.of(indices)
            seen.append((part, check_at(part, moved, self._expected)))
            yield Step(name, number, count)
        return seen

    def left_out(
        self, rotation: baseline.Accuracy, pose: baseline.Accuracy, name: str, count: int
    ) -> Steps[list[_LeftOut]]:
        """`count` checks at the right pose, equally many in every block of time, compared with the bias that the other
        blocks show. With too few pairs for that, the checks include pairs from which the bias was learned."""
        pairs = len(self._evidence.pairs)
        blocks = [block.tolist() for block in np.array_split(np.arange(pairs), FOLDS)]
        if min(len(block) for block in blocks) < MIN_PAIRS:
            checks = yield from self._moved(0.0, 0.0, name, count)
            return [self._against(part, seen, rotation, pose) for part, seen in checks]
        rng = np.random.default_rng([SEED, pairs])
        results: list[_LeftOut] = []
        for fold, block in enumerate(blocks):
            rest = [index for other in blocks if other is not block for index in other]
            of_rest = check_at(self._evidence.of(rest), self._right)
            of_rotation = replace(rotation, bias=of_rest.offset_rotation + 0.0 * rotation.bias)
            of_pose = replace(pose, bias=of_rest.offset_pose)
            size = min(CHECK_PAIRS, len(block))
            while len(results) * FOLDS < count * (fold + 1):
                first = int(rng.integers(0, len(block) - size + 1))
                part = self._evidence.of(block[first : first + size])
                seen = check_at(part, self._right, Expected(of_rotation.expected, of_pose.expected))
                results.append(self._against(part, seen, of_rotation, of_pose))
                yield Step(name, len(results), count)
        return results

    def _against(self, part: CheckInput, seen: Check, rotation: baseline.Accuracy, pose: baseline.Accuracy) -> _LeftOut:
        return _LeftOut(
            seen,
            depth_cue(part, seen, self._right, self._config),
            rotation.distance2(seen.offset_rotation, seen.pairs),
            pose.farthest2(seen.offset_pose, seen.pairs),
        )


def _monitor_limits(
    left_out: Sequence[_LeftOut],
    moved: dict[str, list[Check]],
    far: Sequence[Check],
    rotation: baseline.Accuracy,
    pose: baseline.Accuracy,
    rate: float,
    known_by: int,
) -> baseline.MonitorLimits:
    clean = [one.seen for one in left_out]
    right_rotation = baseline.distance2_quantile(1.0 - rate / 2.0, ROTATION_DOF, known_by) * _times(
        [one.distance2_rotation for one in left_out], baseline.chi2_quantile(0.5, ROTATION_DOF)
    )
    right_pose = baseline.distance2_quantile(1.0 - rate / 2.0 / POSE_DOF, 1, known_by) * _times(
        [one.farthest2_pose for one in left_out], baseline.chi2_quantile(0.5 ** (1.0 / POSE_DOF), 1)
    )
    turned = [rotation.distance2(seen.offset_rotation, seen.pairs) for seen in moved["0.5 deg"]]
    shifted = [pose.farthest2(seen.offset_pose, seen.pairs) for seen in moved["10 cm"]]
    edges = float(np.min([edges_per_pair(seen) for seen in clean]))
    lost = float(np.median([edges_per_pair(seen) for seen in far]))
    of_paper = baseline.PaperLimits.learned([one.depth for one in left_out], rate)
    agreement = baseline.beyond(
        [one.depth.agreement_rad for one in left_out], baseline.normal_quantile(1.0 - rate / 3.0)
    )
    return baseline.MonitorLimits(
        max_distance2_rotation=_between(right_rotation, min(turned)),
        max_farthest2_pose=_between(right_pose, min(shifted)),
        min_edges_per_pair=min(sqrt(edges * max(lost, LAYOUT_SHARE * edges)), POOREST_SHARE * edges),
        insisted_share=INSISTED_SHARE,
        max_agreement_rad=max(agreement, AGREEMENT_RAD),
        min_overlap=POOREST_SHARE * float(np.min([seen.overlap for seen in clean])),
        min_mi=of_paper.min_mi,
        max_f1=of_paper.max_f1,
        min_f2=of_paper.min_f2,
    )


def _times(distances2: Sequence[float], median: float) -> float:
    """Factor by which the squared distances of left-out checks exceed those that the spread of the rig implies, whose
    `median` is known; at least 1. It compares medians, because a check that ended in another basin is not part of the
    spread."""
    return max(1.0, float(np.median(distances2)) / median)


def _between(right: float, wrong: float) -> float:
    """A limit half-way, in ratio, between what right checks do not exceed and the least of the moved ones, and at most
    a quarter of the latter. If the two come close, the false-alarm rate decides: the limit is `right`."""
    return max(right, min(sqrt(right * wrong), NEAREST_SHARE * wrong))
