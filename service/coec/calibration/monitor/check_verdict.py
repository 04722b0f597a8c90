"""Judges a check: compares its figures with the limits of the rig, and finds what is wrong with its data.

The figures are the paper's three, equation (2), and one that tells more: how many standard deviations lie between the
pose and the local optimum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from math import degrees, inf

import numpy as np
from numpy.typing import NDArray

from coec.calibration.commissioning.baseline import (
    Accuracy,
    Baseline,
    BaselineDrift,
    MonitorLimits,
    street_sigma,
    uncommissioned,
)
from coec.calibration.commissioning.quantiles import chi2_quantile
from coec.calibration.estimators import prepare_window_data
from coec.calibration.frames.sampling import drives
from coec.calibration.frames.timing import ZOOMS, explained_by_nuisance
from coec.calibration.monitor.change_detector import Observation
from coec.calibration.monitor.check import AT_POSE, Check, CheckInput, Expected, check_at, gather
from coec.calibration.monitor.depth_witness import DepthCue, depth_cue
from coec.calibration.monitor.dispersion import dispersion
from coec.calibration.monitor.neighbourhood import MIN_CONTRAST, NEAR_SHARE, POSE_DOF, ROTATION_DOF
from coec.calibration.monitor.sensor_faults import data_causes, dirty_blocks
from coec.calibration.monitor.support import CERTAIN, Support
from coec.calibration.ports import DepthModel, ImageReader, Silence
from coec.calibration.types import FramePair, Matrix4, Metric, Window
from coec.config import CalibrationConfig
from coec.errors import CalibrationError
from coec.geometry import se3
from coec.geometry.cameras import Camera
from coec.geometry.compiler import on_one_thread

FALSE_ALARM_RATE = 0.01
"""Share of checks at a right pose that may be flagged: the limits of an uncommissioned rig follow from it, and it is
the default aim of commissioning."""

MIN_PAIRS = 4
"""With fewer pairs, a single lamp post decides."""

TELLING_CONTRAST = 9.0
"""A check accuses only if its optimum stands out from other poses by this many standard deviations. Below that, checks
scatter more than three times as far as those of a street (see `dispersion`): where a street is good to 0.08°, half a
degree is then only two standard deviations. Of 419 checks with clear edges, of right mounts on 168 simulated drives,
five were below, four of them on highways; three of these five insisted on an optimum that was too far off, and two of
the 414 others."""

LOST_SHARE = 0.5
"""Share of the significance at the optimum: if the expected pose has less, scatter explains that in no scene."""

MIN_EDGES_IN_VIEW = 150.0
"""With fewer range edges in view per pair a check's edges count as faint, however well they fit: a guard rail and a
lane marking then decide, the same in every pair. On simulated drives, all checks of right mounts that ended more than
0.6° off and were clear by the other figures had 5 to 130; those that ended right had 150 and more, except some on
highways."""

MIN_INDEPENDENT_SAMPLES = 2.0
"""If the pairs of a moving vehicle are worth fewer independent looks, the edges of a check count as faint. Frames that
say the same although the vehicle has moved on, as between the guard rails of a highway, are all wrong if one is, and so
is the next check. Checks of simulated highways with 64 beams are at 1.2 to 1.9 of 6 and put right mounts 3 to 10 cm
beside; 95 % of others are above 2.2, and within 2 cm."""


MOST_SCATTER = 5.0
"""Pairs of a check that scatter by more than this many times what they should, on an axis of rotation, do not show one
pose, as while the mount swings. Of 120 checks of right mounts on 24 rendered drives one does, and of 239 of a rig of
0.2° a pixel that stops and goes 12; of 20 checks of mounts that swing by 0.8 to 1.5°, 13 do (docs/measured.md)."""


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
"""Limits of an uncommissioned rig. `min_edges_per_pair`: at the right pose edges are at 10 to 24 on every recording
tried."""


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
    """The same with both witnesses, whatever the edges say: for a single question rather than a stream of checks.

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
    causes = data_causes(evidence.scenes, None if baseline is None else baseline.scene)
    dirty, textured = ((), 0) if baseline is None or causes else dirty_blocks(evidence.scenes, baseline.scene)
    if not causes and not faint & {Faint.EDGES_IN_VIEW, Faint.INDEPENDENT_SAMPLES}:
        # Few edges fit another clock as well as they fit another mount.
        explained = explained_by_nuisance(
            evidence.edges.measured,
            evidence.rig,
            evidence.edges.whole.frames,
            se3.perturb(pose, rotation.expected),
            seen.T_rotation,
            seen.T_pose,
            limits.min_edges_per_pair * float(np.sqrt(seen.pairs)),
            # Edges that stand out nowhere fit some other focal length by chance.
            () if Faint.CONTRAST in faint else ZOOMS,
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
