"""The verdict on a check: compares its figures with the limits of the rig, and finds what is wrong with its data.
Another clock, ego-motion or focal length may explain what appears to be a bent mount; checks of a poor scene
scatter more than those of a street.

Other things in the image displace an optimum, and the less, the higher it stands above them: the top of a hill on rough
ground is where hill and roughness together are highest. Every check measures how high its optimum stands (`contrast`).
So a highway, where everything runs to one point, or a night accuses a mount no more than it can tell, without a step
between scenes that tell and scenes that do not.

This factor says what checks are worth as evidence. Whether a check is flagged depends on the limits of its rig and on
its own edges, see `support`; in scenes that scatter too far no check is flagged.

A bent mount moves every point the same way in every frame. A clock that is off moves each sweep along the motion of the
vehicle at that instant, a wrong ego-motion tears each sweep apart in proportion to the motion, and another focal length
moves every edge outwards wherever the vehicle goes. So the edges are placed anew under each hypothesis, with the
extrinsic unchanged. A hypothesis that fits the images with a single number as well as a moved extrinsic does with six
is the simpler explanation.

The figures are the paper's three, equation (2), and one that tells more: how many standard deviations lie between the
pose and the local optimum.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from enum import StrEnum
from math import degrees, inf, radians

import numpy as np
from numpy.typing import NDArray

from coec.calibration.baseline import (
    Accuracy,
    Baseline,
    BaselineDrift,
    MonitorLimits,
    chi2_quantile,
    street_sigma,
    uncommissioned,
)
from coec.calibration.frames.motion_compensation import compensate, sensor_twist
from coec.calibration.frames.window import drives
from coec.calibration.monitor import sensor_faults
from coec.calibration.monitor.change_detector import Observation
from coec.calibration.monitor.check import (
    AT_POSE,
    CERTAIN,
    MIN_EDGES_IN_VIEW,
    MIN_INDEPENDENT_SAMPLES,
    Check,
    CheckInput,
    DepthCue,
    Expected,
    Support,
    check_at,
    depth_cue,
    gather,
)
from coec.calibration.monitor.check_edges import MIN_CONTRAST, NEAR_SHARE, POSE_DOF, ROTATION_DOF
from coec.calibration.solver import prepare_window_data
from coec.calibration.types import DepthModel, EgoMotion, FramePair, ImageReader, Matrix4, Metric, Rig, Silence, Window
from coec.config import CalibrationConfig
from coec.errors import CalibrationError
from coec.geometry import se3
from coec.geometry.cameras import Camera, pixel_rad
from coec.geometry.compiler import on_one_thread
from coec.geometry.edges.alignment import EdgeFrames, alignment_of_each, frame_alignment

REFERENCE_CONTRAST, POWER = 20.0, 1.5
"""Contrast from which checks scatter as those of a street do, and the power of its inverse by which others scatter
more. The error that checks of a drive share grows as their own errors do. See docs/measured.md."""


def dispersion(contrast: float) -> float:
    """Factor from the standard deviations of a street's checks to those of a check with this contrast; at least 1."""
    return float(max(REFERENCE_CONTRAST / max(contrast, 1.0), 1.0) ** POWER)


OFFSETS_S = (-0.2, -0.15, -0.1, -0.075, -0.05, -0.03, 0.03, 0.05, 0.075, 0.1, 0.15, 0.2)
"""Clock errors that are tried: up to two periods of a 10 Hz sensor."""

SCALES = (-1.0, 0.0, 0.33, 0.5, 2.0, 3.0)
"""Factors on the ego-motion that are tried: a wrong sign, a missing signal, wrong units and gains."""

ZOOMS = (0.9, 0.95, 0.98, 1.02, 1.05, 1.1)
"""Factors on the focal length that are tried."""

AS_GOOD, BETTER = 0.97, 1.08
"""For a flagged check: a hypothesis must reach this share of the significance of the moved extrinsic without moving the
extrinsic (a share, because its grid is coarser than the peak), and exceed the significance of the unmoved extrinsic by
this factor."""

GAIN, FRAMES_AGREE = 0.01, 0.6
"""For any check: the share that a hypothesis must gain at the local optimum, and the share of pairs that must gain. See
docs/measured.md."""

FINE_PIXEL_RAD = radians(0.15)
"""Size of pixel up to which these gains hold; with coarser pixels the edges vary more from one pose to the next."""

MIN_SPEED_MPS = 1.0
"""Below this speed neither a clock nor an ego-motion moves anything."""


def explained_by_nuisance(
    edges: Sequence[FramePair],
    rig: Rig,
    level: EdgeFrames,
    expected: Matrix4,
    rotation_optimum: Matrix4,
    pose_optimum: Matrix4,
    min_significance: float,
    zooms: Sequence[float] = ZOOMS,
) -> sensor_faults.Cause | None:
    """The clock, ego-motion or focal length that explains the images better than the extrinsic alone; None if none
    does. Clock and ego-motion are tried only if there is enough motion.

    Args:
        edges: the pairs of a check, their sweeps reduced to the range edges of `level`, as measured.
        level: the same range edges, placed, and the edge maps of one level.
        expected: (4, 4) where the local optimum should be.
        rotation_optimum: (4, 4) where it is, over rotations.
        pose_optimum: (4, 4) where it is over all six degrees of freedom: a shifted mount is an explanation, too.
        min_significance: below this nothing is explained.
        zooms: factors on the focal length to try.
    """
    null, at_optimum = frame_alignment(level, expected).significance, frame_alignment(level, rotation_optimum)
    turned, shifted = at_optimum.significance, frame_alignment(level, pose_optimum).significance
    least_gain = 1.0 + GAIN * max(1.0, pixel_rad(rig.camera) / FINE_PIXEL_RAD)
    best, explanation = 0.0, None
    for again, motions, cause in _hypotheses(edges, rig, level, zooms):
        unmoved = alignment_of_each(again, expected @ motions).significance
        moved = alignment_of_each(again, rotation_optimum @ motions)
        agree = float((moved.strength > at_optimum.strength).mean()) >= FRAMES_AGREE
        gains = agree and moved.significance >= least_gain * turned
        enough = unmoved >= max(AS_GOOD * max(turned, shifted), BETTER * null)
        reached = max(unmoved if enough else 0.0, moved.significance if gains else 0.0)
        if reached > max(best, min_significance):
            best, explanation = reached, cause
    return explanation


def _hypotheses(
    edges: Sequence[FramePair], rig: Rig, level: EdgeFrames, zooms: Sequence[float]
) -> Iterator[tuple[EdgeFrames, NDArray[np.float64], sensor_faults.Cause]]:
    """For each hypothesis the range edges as it places them, the motions (F, 4, 4) that then move the edges of each
    pair, and the cause that it stands for."""
    still = np.tile(np.eye(4), (len(edges), 1, 1))
    for zoom in zooms:
        camera = level.camera._replace(fx=zoom * level.camera.fx, fy=zoom * level.camera.fy)
        yield replace(level, camera=camera), still, sensor_faults.INTRINSICS_WRONG
    moving = [pair for pair in edges if pair.motion is not None and pair.motion.reaches(MIN_SPEED_MPS)]
    if 2 * len(moving) < len(edges):
        return
    xi = np.array([_twist(pair, rig) for pair in edges])
    placed = _placed(edges, rig, level)
    for seconds in OFFSETS_S:
        # Under a constant twist, a later time is one more motion, the same for all points of a sweep.
        yield placed, np.array([se3.exp(seconds * of_pair) for of_pair in xi]), sensor_faults.TIME_OFFSET
    for factor in SCALES:
        yield _placed([_scaled(pair, factor) for pair in edges], rig, level), still, sensor_faults.EGO_MOTION_WRONG


def _twist(pair: FramePair, rig: Rig) -> NDArray[np.float64]:
    """(6,) twist of the LiDAR by which `compensate` moves a sweep of the pair: rad/s and m/s."""
    return np.zeros(6) if pair.motion is None else np.concatenate(sensor_twist(pair.motion, rig.T_lidar_ego))


def _placed(edges: Sequence[FramePair], rig: Rig, level: EdgeFrames) -> EdgeFrames:
    xyz_m = np.concatenate([compensate(pair, rig, enabled=True) for pair in edges])
    return replace(level, xyz_m=np.ascontiguousarray(xyz_m.T))


def _scaled(pair: FramePair, factor: float) -> FramePair:
    """The pair as if the vehicle had moved so many times as fast."""
    motion = pair.motion
    if motion is None or motion.linear_mps is None:
        return pair
    vx, vy, vz = motion.linear_mps
    wx, wy, wz = motion.angular_radps
    twist = EgoMotion(
        motion.stamp_ns,
        motion.frame_id,
        (factor * vx, factor * vy, factor * vz),
        (factor * wx, factor * wy, factor * wz),
    )
    return replace(pair, motion=twist)


FALSE_ALARM_RATE = 0.01
"""Share of checks at a right pose that may be flagged: the limits of an uncommissioned rig follow from it, and it is
the default aim of commissioning."""

MIN_PAIRS = 4
"""With fewer pairs, a single lamp post decides."""

TELLING_CONTRAST = 9.0
"""A check accuses only if its optimum stands out from other poses by this many standard deviations. Below that, checks
scatter more than three times as far as those of a street (see `dispersion`): where a street is good to 0.08°, half a
degree is then only two standard deviations. See docs/measured.md."""

LOST_SHARE = 0.5
"""Share of the significance at the optimum: if the expected pose has less, scatter explains that in no scene."""

MOST_SCATTER = 5.0
"""Pairs of a check that scatter by more than this many times what they should, on an axis of rotation, do not show one
pose, as while the mount swings. See docs/measured.md."""


class Opinion(StrEnum):
    """What the edges of one check say of its pose. Undecided: the optimum lies too far off for a right pose, but the
    edges do not insist on it as they do near a wrong pose."""

    CLEAR = "clear"
    FLAGGED = "flagged"
    UNDECIDED = "undecided"


class Faint(StrEnum):
    """What a check with faint edges has too little of."""

    EDGES_IN_VIEW = "edges_in_view"
    INDEPENDENT_SAMPLES = "looks"
    SIGNIFICANCE = "significance"
    CONTRAST = "contrast"


UNCOMMISSIONED = MonitorLimits(
    max_distance2_rotation=chi2_quantile(1.0 - FALSE_ALARM_RATE / 2.0, ROTATION_DOF),
    max_farthest2_pose=chi2_quantile(1.0 - FALSE_ALARM_RATE / 2.0 / POSE_DOF, 1),
    min_edges_per_pair=4.0,
)
"""Limits of an uncommissioned rig. See docs/measured.md."""


@on_one_thread()
def observe(
    window: Window, depth: DepthModel, images: ImageReader, config: CalibrationConfig, baseline: Baseline | None
) -> Observation:
    """Checks the extrinsic at which `window` starts, with all its pairs: five to ten of the latest, in motion. Depth is
    used only if the edges accuse the pose, are undecided, or are too faint to tell.

    Raises:
        CalibrationError: fewer than `MIN_PAIRS` pairs, or an image or its depth cannot be decoded.
    """
    evidence, seen = _check(window, depth, images, config, baseline)
    pose = window.T_camera_lidar_start
    observation = judge_check(evidence, seen, pose, baseline)
    if observation.causes or not (observation.flagged or observation.undecided or observation.weak):
        return observation
    return with_depth(observation, depth_cue(evidence, seen, pose, config), baseline)


@on_one_thread()
def diagnose(
    window: Window, depth: DepthModel, images: ImageReader, config: CalibrationConfig, baseline: Baseline | None
) -> Observation:
    """The same with both cues, whatever the edges say: for a single question rather than a stream of checks.

    Raises:
        CalibrationError: as `observe`.
    """
    evidence, seen = _check(window, depth, images, config, baseline)
    pose = window.T_camera_lidar_start
    observation = judge_check(evidence, seen, pose, baseline)
    return with_depth(observation, depth_cue(evidence, seen, pose, config), baseline)


def _check(
    window: Window, depth: DepthModel, images: ImageReader, config: CalibrationConfig, baseline: Baseline | None
) -> tuple[CheckInput, Check]:
    if len(window.pairs) < MIN_PAIRS:
        raise CalibrationError(f"a check needs {MIN_PAIRS} pairs, there are {len(window.pairs)}")
    evidence = gather(prepare_window_data(window, depth, images, config, Silence()))
    return evidence, check_at(evidence, window.T_camera_lidar_start, expected_of(baseline))


def expected_of(baseline: Baseline | None) -> Expected:
    """Where the optima of checks are expected on a rig."""
    return AT_POSE if baseline is None else Expected(baseline.rotation.expected, baseline.pose.expected)


def with_depth(observation: Observation, depth: DepthCue, baseline: Baseline | None) -> Observation:
    """A check with what depth says of its pose added: figures for the reader, and the paper's verdict. The decision
    stays that of the edges."""
    limits = UNCOMMISSIONED if baseline is None else baseline.monitor
    return replace(
        observation,
        metrics=(
            Metric("mi", depth.mi, limits.min_mi, at_least=True),
            Metric("f1", depth.f1, limits.max_f1, at_least=False),
            Metric("f2", depth.f2, limits.min_f2, at_least=True),
            Metric("agreement_deg", degrees(depth.agreement_rad), degrees(limits.max_agreement_rad), at_least=False),
            *observation.metrics,
        ),
        flagged_by_paper=None if baseline is None else limits.of_paper.flags(depth),
        first_derivative=depth.first_derivative,
        second_derivative=depth.second_derivative,
    )


def judge_check(evidence: CheckInput, seen: Check, pose: Matrix4, baseline: Baseline | None) -> Observation:
    """A check at `pose` (4, 4) judged by the limits of the rig, with the causes of what is wrong with its data."""
    limits = UNCOMMISSIONED if baseline is None else baseline.monitor
    camera = evidence.rig.camera
    rotation, accuracy = uncommissioned(camera) if baseline is None else (baseline.rotation, baseline.pose)
    of_rotation, of_pose = over_limits(seen, rotation, accuracy, limits)
    metrics = _metrics(seen, of_rotation, of_pose, limits)
    judgement = opinion(seen, rotation, accuracy, limits)
    faint = faintness(evidence.pairs, seen, limits)
    causes = sensor_faults.data_causes(evidence.scenes, None if baseline is None else baseline.scene)
    dirty, textured = (
        ((), 0) if baseline is None or causes else sensor_faults.dirty_blocks(evidence.scenes, baseline.scene)
    )
    # Traffic alongside has reflectance edges, too, and fits a vehicle that stands: range edges alone explain.
    by_range = seen if seen.by_range is None else seen.by_range
    faint_range = faintness(evidence.pairs, by_range, limits)
    if not causes and not faint_range & {Faint.EDGES_IN_VIEW, Faint.INDEPENDENT_SAMPLES}:
        # Few edges fit another clock as well as they fit another mount.
        explained = explained_by_nuisance(
            evidence.edges.measured,
            evidence.rig,
            evidence.edges.whole.frames,
            se3.perturb(pose, rotation.expected),
            by_range.T_rotation,
            by_range.T_pose,
            limits.min_edges_per_pair * float(np.sqrt(seen.pairs)),
            # Edges that stand out nowhere fit some other focal length by chance.
            () if Faint.CONTRAST in faint_range else ZOOMS,
        )
        causes = () if explained is None else (explained,)
    stamps_ns = tuple(pair.stamp_ns for pair in evidence.pairs)
    return Observation(
        stamp_ns=stamps_ns[-1],
        pair_stamps_ns=stamps_ns,
        metrics=metrics,
        offset=_of_both(seen.offset_rotation - rotation.expected, seen.offset_pose - accuracy.bias),
        sigma=_of_both(rotation.sigma(seen.pairs), accuracy.sigma(seen.pairs)),
        noise=_of_both(rotation.noise(seen.pairs), accuracy.noise(seen.pairs)),
        place=street_sigma(camera),
        dispersion=dispersion(seen.contrast),
        distance2=max(of_rotation, of_pose),
        flagged=judgement is Opinion.FLAGGED,
        undecided=judgement is Opinion.UNDECIDED,
        weak=bool(faint),
        has_power=not faint & {Faint.SIGNIFICANCE, Faint.CONTRAST} and _pairs_agree(seen, camera),
        flagged_by_paper=None,
        causes=causes,
        drift=None if baseline is None else _drift(seen, baseline),
        dirty=dirty,
        textured=textured,
    )


def _pairs_agree(seen: Check, camera: Camera) -> bool:
    """Whether the pairs of a check show one pose, on all axes of rotation, as far as on any rig."""
    rotation, _ = uncommissioned(camera)
    return bool((seen.scatter_rad <= MOST_SCATTER * rotation.noise(seen.pairs)[:ROTATION_DOF]).all())


def faintness(pairs: Sequence[FramePair], seen: Check, limits: MonitorLimits) -> frozenset[Faint]:
    """Why the edges of a check of some pairs count as faint; empty if they do not."""
    short = {
        Faint.EDGES_IN_VIEW: seen.edges_in_view < MIN_EDGES_IN_VIEW * seen.pairs,
        # While a vehicle stands its checks count as one anyway.
        Faint.INDEPENDENT_SAMPLES: seen.independent_samples < MIN_INDEPENDENT_SAMPLES and drives(pairs),
        Faint.SIGNIFICANCE: edges_per_pair(seen) < limits.min_edges_per_pair,
        Faint.CONTRAST: seen.contrast < MIN_CONTRAST,
    }
    return frozenset(why for why, is_short in short.items() if is_short)


def over_limits(seen: Check, rotation: Accuracy, pose: Accuracy, limits: MonitorLimits) -> tuple[float, float]:
    """Squared distances of the local optima over three and over six degrees of freedom, each divided by its limit."""
    return (
        rotation.distance2(seen.offset_rotation, seen.pairs) / limits.max_distance2_rotation,
        pose.farthest2(seen.offset_pose, seen.pairs) / limits.max_farthest2_pose,
    )


def opinion(seen: Check, rotation: Accuracy, pose: Accuracy, limits: MonitorLimits) -> Opinion:
    """What a check says. It accuses if an optimum is off and its edges insist on that, in a scene that can tell. It
    acquits if neither optimum is farther off than it is at a right pose. Near a wrong pose a ripple may hold an optimum
    half-way; if the edges gain by going there, the check does not acquit."""
    undecided = False
    for over, preference in zip(
        over_limits(seen, rotation, pose, limits), (seen.of_rotation, seen.of_pose), strict=True
    ):
        conclusive = seen.contrast >= TELLING_CONTRAST or preference.retained < LOST_SHARE
        if preference.insists and over > limits.insisted_share and conclusive:
            return Opinion.FLAGGED
        undecided |= over > 1.0 or (preference.gained and over > limits.insisted_share)
    return Opinion.UNDECIDED if undecided else Opinion.CLEAR


def _of_both(of_rotation: NDArray[np.float64], of_pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """(6,) the rotations of `of_rotation` and the translations of `of_pose`."""
    return np.concatenate([of_rotation[:ROTATION_DOF], of_pose[ROTATION_DOF:]])


def edges_per_pair(seen: Check) -> float:
    """Significance of the edges at the local optimum over the root of the number of pairs."""
    return seen.edges_at_best / float(np.sqrt(max(seen.pairs, 1)))


def _drift(seen: Check, baseline: Baseline) -> BaselineDrift:
    """How far the local optimum of a check lies from the commissioned calibration, over six degrees of freedom."""
    value = se3.difference(seen.T_pose, baseline.T_camera_lidar) - baseline.pose.bias
    return BaselineDrift(value, baseline.pose.sigma(seen.pairs))


def _metrics(seen: Check, of_rotation: float, of_pose: float, limits: MonitorLimits) -> tuple[Metric, ...]:
    return (
        Metric("distance_rotation", of_rotation, 1.0, at_least=False),
        Metric("distance_pose", of_pose, 1.0, at_least=False),
        Metric("edge_score", seen.edges, -inf, at_least=True),
        Metric("edges_per_pair", edges_per_pair(seen), limits.min_edges_per_pair, at_least=True),
        *_support("rotation", seen.of_rotation),
        *_support("pose", seen.of_pose),
        Metric("overlap", seen.overlap, limits.min_overlap, at_least=True),
    )


def _support(name: str, preference: Support) -> tuple[Metric, ...]:
    return (
        Metric(f"edges_kept_{name}", preference.retained, NEAR_SHARE, at_least=True),
        Metric(f"certainty_{name}", preference.certainty, CERTAIN, at_least=False),
    )
