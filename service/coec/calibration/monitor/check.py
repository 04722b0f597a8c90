"""A short check of a few pairs: where the edges put the extrinsic near a pose, how strongly they prefer that place,
how good the pose itself is, and what the depth cue says where the edges contradict it or cannot decide.

There is always some optimum, and it never scores below the expected pose. Whether its gain is more than chance shows in
the look itself. If the mount moved, most frames and most sectors of the image show it, and much of the significance is
gone at the pose that the mount left. If spray, a lamp post or a guard rail drew the optimum aside, a few cells gain
what others lose, and the expected pose fits nearly as well.

A full calibration searches tens of degrees; a check searches only within `REACH_RAD` of the pose that it checks. It
always searches all six degrees of freedom, because a shifted mount must be seen even if only rotations are estimated.

The edges are far sharper, and a network costs more than all the rest of a check. So depth is not used if the edges are
clear and confirm the pose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from math import fsum

import numpy as np
from numpy.typing import NDArray

from coec.calibration.baseline import normal_quantile
from coec.calibration.monitor import check_edges
from coec.calibration.monitor.sensor_faults import SceneFacts
from coec.calibration.objective.landscape import Landscape, axis_derivatives, certainty
from coec.calibration.objective.mutual_information import Features, SearchBox, build_mutual_information
from coec.calibration.search.local_search import polish
from coec.calibration.solver import WindowData, depth_features
from coec.calibration.types import FramePair, Matrix4, Rig, Silence
from coec.calibration.uncertainty.covariance import measure_noise
from coec.config import CalibrationConfig
from coec.geometry import se3
from coec.geometry.edges.alignment import frame_alignment
from coec.geometry.edges.image_edges import Rectangle

CLEAR_CONTRAST = 15.0
"""Contrast from which range edges alone tell enough: a check then scatters as on a street, or half as far again."""

MIN_EDGES_IN_VIEW = 150.0
"""With fewer range edges in view per pair a check's edges count as faint, however well they fit: a guard rail and a
lane marking then decide, the same in every pair. See docs/measured.md."""

MIN_INDEPENDENT_SAMPLES = 2.0
"""If the pairs of a moving vehicle are worth fewer independent samples, the edges of a check count as faint. Frames
that say the same although the vehicle has moved on, as between the guard rails of a highway, are all wrong if one is,
and so is the next check. See docs/measured.md."""

CERTAIN = normal_quantile(0.95)
"""Standard deviations from which a gain is more than chance."""


@dataclass(frozen=True, slots=True)
class Support:
    """How strongly the edges prefer an optimum to the pose at which it was expected.

    Attributes:
        retained: significance at the expected pose over that at the optimum, on the sharpest edges.
        certainty: of the gain, in standard deviations of the scatter of frames and sectors; see `Landscape`.
    """

    retained: float
    certainty: float

    @property
    def gained(self) -> bool:
        """Whether the gain is more than chance."""
        return self.certainty > CERTAIN

    @property
    def insists(self) -> bool:
        """Whether the gain is also large enough for another place to be believed instead of the one next to a pose."""
        return self.gained and self.retained < check_edges.NEAR_SHARE


def support(there: NDArray[np.float64], expected: NDArray[np.float64]) -> Support:
    """The support, from the cells (F, B) at the optimum and at the expected pose."""
    best, left = (fsum(cells.ravel().tolist()) for cells in (there, expected))
    # An optimum without edges has gained nothing.
    return Support(left / best if best > 0.0 else 1.0, certainty(there - expected))


DEPTH_POINTS = 60_000
"""Points of the sweeps of a check, in view or not, that the depth cue uses: its hill is degrees wide."""


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """Where the optima over rotations and over all axes are expected, ξ (6,) from the pose that is checked."""

    rotation: NDArray[np.float64]
    pose: NDArray[np.float64]


AT_POSE = Expected(np.zeros(6), np.zeros(6))
"""What is expected of a rig that was not commissioned."""


@dataclass(frozen=True, slots=True, eq=False)
class CheckInput:
    """Some pairs with all that a check at any pose needs. Entries are per pair, in order. `edges` are those of range;
    calling `both` adds those of reflectance. `features` compare depth with ranges; calling it infers the depth, and
    raises CalibrationError if a frame has none."""

    rig: Rig
    pairs: tuple[FramePair, ...]
    edges: check_edges.ProjectedEdges
    both: Callable[[], check_edges.ProjectedEdges]
    scenes: tuple[SceneFacts, ...]
    features: Callable[[], tuple[Features, ...]]

    def of(self, indices: Sequence[int]) -> CheckInput:
        """The input for some of the pairs alone, by their indices."""
        return CheckInput(
            self.rig,
            tuple(self.pairs[i] for i in indices),
            self.edges.of(indices),
            cache(lambda: self.both().of(indices)),
            tuple(self.scenes[i] for i in indices),
            lambda: tuple(self.features()[i] for i in indices),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Check:
    """What a check at a pose finds.

    Attributes:
        T_rotation: (4, 4) local optimum over rotations, with the camera's centre of the pose.
        T_pose: (4, 4) local optimum over all six degrees of freedom.
        offset_rotation, offset_pose: (6,) ξ from the pose to these optima (rad, m).
        edges: significance of the edges at the pose.
        edges_at_best: their significance at the local optimum over rotations.
        edges_in_view: effective number of edges, of all pairs, that lie in the images at that optimum.
        independent_samples: how many independent frames the pairs are worth over rotations, see `Noise`; 1 if that is
            unknown.
        scatter_rad: (3,) standard deviation of the optimum over rotations from how its pairs and sectors differ, see
            `Noise`; 0 if that is unknown.
        of_rotation, of_pose: how far the edges insist on these optima.
        contrast: how far the edges at the local optimum over rotations stand above other poses, standard deviations.
        overlap: edges in view at the pose over those that come into view within reach.
        balance: (KINDS,) weights of the kinds of edges, see `ProjectedEdges`.
        by_range: the check by range edges alone, if this one is by both kinds.
    """

    pairs: int
    T_rotation: Matrix4
    T_pose: Matrix4
    offset_rotation: NDArray[np.float64]
    offset_pose: NDArray[np.float64]
    edges: float
    edges_at_best: float
    edges_in_view: float
    independent_samples: float
    scatter_rad: NDArray[np.float64]
    of_rotation: Support
    of_pose: Support
    contrast: float
    overlap: float
    balance: NDArray[np.float64] = field(default_factory=lambda: np.array([1.0, 0.0]))
    by_range: Check | None = None


def gather(data: WindowData, beyond_rad: float = 0.0) -> CheckInput:
    """Prepares the sensors of one pair, each by itself, and joins them.

    Args:
        data: a window, whose start is the pose that the checks are about.
        beyond_rad: how far from that pose further poses are to be checked.

    Raises:
        CalibrationError: an image cannot be decoded, or is not of the camera's size.
    """
    window = data.window
    rig, pose = window.rig, window.T_camera_lidar_start
    sweeps = [check_edges.prepare_sweep(pair.lidar) for pair in window.pairs]
    counted = seen_part(rig, sweeps, pose, check_edges.OUTLINE_RAD)
    required = seen_part(rig, sweeps, pose, check_edges.OUTLINE_RAD + beyond_rad) if beyond_rad > 0.0 else counted
    # The third column of a rotation is where it takes the third axis.
    upright = rig.T_camera_lidar_nominal[:2, 2]
    images = check_edges.prepare_images(
        data.greys(), len(window.pairs), rig.camera, rig.mask, upright, counted, required
    )
    return join(data, sweeps, images, check_edges.REACH_RAD + beyond_rad)


def seen_part(rig: Rig, sweeps: Sequence[check_edges.PreparedSweep], pose: Matrix4, reach_rad: float) -> Rectangle:
    """The part of the images in which the range edges of sweeps lie at poses within `reach_rad` of a pose (4, 4); the
    whole image if there are none."""
    part = check_edges.outline(rig.camera, [sweep.edges for sweep in sweeps], pose, reach_rad)
    return Rectangle(0, 0, rig.camera.width, rig.camera.height) if part is None else part


def join(
    data: WindowData, sweeps: Sequence[check_edges.PreparedSweep], images: check_edges.PreparedImages, reach_rad: float
) -> CheckInput:
    """Joins what was prepared for two sensors into the input of a check of their pair. Sweeps and images are those of
    the pairs of `data`, in order. Poses within `reach_rad` of the start of its window can be checked."""
    window = data.window
    pose = window.T_camera_lidar_start
    project = partial(
        check_edges.project_edges,
        window.rig, window.pairs, sweeps, images, pose, reach_rad, compensated=data.compensated,
    )  # fmt: skip
    scenes = tuple(
        SceneFacts(
            pair.stamp_ns,
            picture,
            sweep.facts,
            None if pair.motion is None else pair.motion.speed_mps,
            None if pair.motion is None else pair.motion.turn_radps,
        )
        for pair, picture, sweep in zip(window.pairs, images.facts, sweeps, strict=True)
    )
    features = cache(lambda: tuple(depth_features(data, pose, DEPTH_POINTS)))
    both = cache(lambda: project(with_reflectance=True))
    return CheckInput(window.rig, window.pairs, project(), both, scenes, features)


def check_at(evidence: CheckInput, pose: Matrix4, expected: Expected = AT_POSE) -> Check:
    """A check at `pose` (4, 4): by range edges, and by both kinds where these leave a doubt."""
    check = _check_by(evidence, check_edges.search_local_optima(evidence.edges, pose), pose, expected)
    clear = check.contrast >= CLEAR_CONTRAST and check.edges_in_view >= MIN_EDGES_IN_VIEW * check.pairs
    if clear and check.independent_samples >= MIN_INDEPENDENT_SAMPLES:
        return check
    optima = check_edges.search_with_reflectance(evidence.both(), pose, check.T_rotation)
    # What stands out less from other poses has nothing to add.
    if optima is None or optima.contrast <= check.contrast:
        return check
    return replace(_check_by(evidence, optima, pose, expected), by_range=check)


def _check_by(evidence: CheckInput, optima: check_edges.LocalOptima, pose: Matrix4, expected: Expected) -> Check:
    edges = optima.edges
    cells = edges.cells(optima.T_rotation)
    landscape = Landscape.about(cells, optima.T_rotation, tuple(range(check_edges.ROTATION_DOF)))
    noise = measure_noise(landscape)
    poses = (se3.perturb(pose, expected.rotation), optima.T_pose, se3.perturb(pose, expected.pose))
    at_expected_turn, at_pose, at_expected_pose = cells.at(np.stack(poses))
    whole = edges.whole.frames
    return Check(
        pairs=len(evidence.pairs),
        T_rotation=optima.T_rotation,
        T_pose=optima.T_pose,
        offset_rotation=se3.difference(optima.T_rotation, pose),
        offset_pose=se3.difference(optima.T_pose, pose),
        edges=frame_alignment(whole, pose).significance,
        edges_at_best=frame_alignment(whole, optima.T_rotation).significance,
        edges_in_view=edges.count(optima.T_rotation),
        independent_samples=1.0 if noise is None else noise.independent_samples,
        scatter_rad=np.zeros(3) if noise is None else np.sqrt(np.diag(noise.covariance)),
        of_rotation=support(landscape.centre, at_expected_turn),
        of_pose=support(at_pose, at_expected_pose),
        contrast=optima.contrast,
        overlap=edges.count(pose) / max(edges.count(), 1.0),
        balance=edges.balance,
    )


@dataclass(frozen=True, slots=True, eq=False)
class DepthCue:
    """What mutual information says of a pose (Borer et al. 2023). Derivatives are over rx ry rz tx ty tz; equation (2)
    uses those of the rotations.

    Attributes:
        mi: equation (1), nats.
        first_derivative: (6,) ∂MI/∂ξ, nats per radian or metre.
        second_derivative: (6,) -∂²MI/∂ξ², nats per radian² or metre²; positive at a maximum.
        agreement_rad: angle between the local optimum of depth and that of the edges.
    """

    mi: float
    first_derivative: NDArray[np.float64]
    second_derivative: NDArray[np.float64]
    agreement_rad: float

    @property
    def f1(self) -> float:
        """Largest slope of the rotations, nats per radian."""
        return float(np.max(np.abs(self.first_derivative[: check_edges.ROTATION_DOF])))

    @property
    def f2(self) -> float:
        """Least peakedness of the rotations, nats per radian²."""
        return float(np.min(self.second_derivative[: check_edges.ROTATION_DOF]))


def depth_cue(evidence: CheckInput, seen: Check, pose: Matrix4, config: CalibrationConfig) -> DepthCue:
    """What depth says of `pose` (4, 4), at which the edges say `seen`.

    Raises:
        CalibrationError: a frame has no usable depth, or no point can come into view.
    """
    depth = build_mutual_information(
        evidence.features(), evidence.rig, pose, SearchBox(check_edges.REACH_RAD, 0.0), config.objective
    )
    first_derivative, second_derivative = axis_derivatives(depth, pose)
    rotation = config.search.model_copy(update={"dof": check_edges.ROTATION_DOF})
    there = polish(depth, seen.T_rotation, rotation, Silence()).T_camera_lidar
    return DepthCue(
        mi=depth.evaluate(pose).mi,
        first_derivative=first_derivative,
        second_derivative=second_derivative,
        agreement_rad=se3.rotation_angle_rad(seen.T_rotation @ se3.inverse(there)),
    )
