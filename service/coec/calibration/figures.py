"""What every figure of self-diagnosis measures, what it means beyond its limit, and what to do then.

Verdicts word their reasons from this one table, and reports explain the figures with it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from coec.calibration.types import INTRINSICS_OFF, MOVED, StopReason


@dataclass(frozen=True, slots=True)
class DiagnosticFigure:
    """A figure, explained for people.

    Attributes:
        unit: of value and limit; empty for a share, a ratio, or a count.
        measures: what it measures, a sentence.
        fails: what it means beyond its limit, without a full stop.
        advice: what to do then.
    """

    title: str
    unit: str
    measures: str
    fails: str
    advice: str


_MORE_SCENES = "Take a longer window, in motion, past objects at different distances."
_MORE_STRUCTURE = "Take a window where buildings, poles or parked cars are within range; check lens and mask."
_CALIBRATE = "Calibrate: `coec calibrate` on a window of this mount measures the extrinsic."
_COMPARE_ONLY = "Nothing: the paper's figures are reported for comparison only; the edges decide."

FIGURES: Mapping[str, DiagnosticFigure] = MappingProxyType(
    {
        # Of a calibration.
        "mi_over_unrelated": DiagnosticFigure(
            "Agreement with depth",
            "",
            "Mutual information of the LiDAR's ranges with the depth maps of their own frames, over that with the maps "
            "of other frames. 1 is chance.",
            "ranges and depth maps of the same frame agree no better than those of different frames",
            "Try a depth network that suits the scene (see `coec models assess`), or a window with more structure.",
        ),
        "range_edges": DiagnosticFigure(
            "Range edges",
            "",
            "Independent range edges in the sweeps of the window, which are compared with the edges of the images.",
            "the sweeps have too few independent range edges",
            _MORE_SCENES,
        ),
        "edge_contrast": DiagnosticFigure(
            "Edge contrast",
            "σ",
            "How far the edge score at the result stands above that at other poses, in standard deviations of those; "
            "of blurred and of sharp edges the smaller.",
            "the best pose does not score significantly higher than the others",
            _MORE_STRUCTURE,
        ),
        "runner_up": DiagnosticFigure(
            "Runner-up",
            "",
            "Edge contrast of the next best pose over that of the best one. 1 is a draw.",
            "ambiguous: another pose scores nearly as high",
            "Start nearer to the truth, or take a longer window with other scenes in it.",
        ),
        "edges_once": DiagnosticFigure(
            "Edges, counted once",
            "σ",
            "How significantly the LiDAR's edges lie on those of the images. What all frames have in common is counted "
            "once; fewer than ten frames count as ten such. With six degrees of freedom only.",
            "the matched edges are few, or the same in all frames, as lines along a road or a standing scene are",
            "Take a window in motion, past other objects: houses, cars, posts and trees within range of the LiDAR.",
        ),
        "range_significance": DiagnosticFigure(
            "Range edges alone",
            "σ",
            "How significantly the depth discontinuities of the LiDAR lie on edges of the images, without those of its "
            "reflectance. With six degrees of freedom only.",
            "only edges of reflectance fit, as markings on a road do at many positions of the camera",
            "Take a window past houses, cars, posts and trees within range of the LiDAR, or by daylight.",
        ),
        "newton_step_deg": DiagnosticFigure(
            "Slope left, rotation",
            "°",
            "Newton step from the result to the maximum on each rotation axis alone; the largest of them.",
            "the objective is not at a maximum on every rotation axis",
            "Calibrate again from this result, or take a window with more frames.",
        ),
        "newton_step_m": DiagnosticFigure(
            "Slope left, translation",
            "m",
            "Newton step from the result to the maximum on each translation axis alone; the largest of them.",
            "the objective is not at a maximum on every translation axis",
            "Calibrate again from this result, or search the rotation only.",
        ),
        "peakedness_per_deg2": DiagnosticFigure(
            "Peakedness",
            "1/°²",
            "How sharply the objective falls off beside the result, as a share of its height, on the flattest rotation "
            "axis.",
            "the objective has too little curvature on at least one rotation axis",
            _MORE_SCENES,
        ),
        "sigma_deg": DiagnosticFigure(
            "σ, rotation",
            "°",
            "Standard deviation of the least certain rotation axis.",
            "the standard deviation of at least one rotation axis is too large or unknown",
            _MORE_SCENES,
        ),
        "sigma_m": DiagnosticFigure(
            "σ, translation",
            "m",
            "Standard deviation of the least certain translation axis.",
            "the standard deviation of at least one translation axis is too large or unknown",
            "Take a longer window with objects near the camera, or search the rotation only.",
        ),
        "overlap": DiagnosticFigure(
            "Overlap",
            "",
            "LiDAR points in view, over the most that any pose within reach would have in view.",
            "too few LiDAR points are in view",
            "Check that the nominal extrinsic, the image size and the mask are those of this camera.",
        ),
        MOVED: DiagnosticFigure(
            "Moved within the window",
            "σ",
            "What two poses, one after the other, score more than one pose for all frames.",
            "the camera moved while the window was recorded",
            "Check that the mount is tight, and take another window: no single pose is correct for this one.",
        ),
        INTRINSICS_OFF: DiagnosticFigure(
            "Other intrinsics",
            "",
            "How certainly other intrinsics explain the window better than those of the rig.",
            "other intrinsics explain the window better than those of the rig",
            "Calibrate the intrinsics again: no extrinsic compensates wrong ones.",
        ),
        # Of a check.
        "mi": DiagnosticFigure(
            "Mutual information",
            "nats",
            "MI of the paper's equation (1), of LiDAR ranges and depth maps at the extrinsic that is checked.",
            "the mutual information of ranges and depth maps is lower than when the rig was commissioned",
            _COMPARE_ONLY,
        ),
        "f1": DiagnosticFigure(
            "Slope of MI",
            "nats/rad",
            "First derivative f' of the paper's equation (2); zero at a maximum.",
            "mutual information has no maximum at the extrinsic",
            _COMPARE_ONLY,
        ),
        "f2": DiagnosticFigure(
            "Curvature of MI",
            "nats/rad²",
            "Second derivative f'' of the paper's equation (2); high at a sharp maximum.",
            "mutual information has too little curvature at the extrinsic",
            _COMPARE_ONLY,
        ),
        "agreement_deg": DiagnosticFigure(
            "Agreement of edges and depth",
            "°",
            "Rotation between where the edges fit best and where depth does.",
            "edges and depth have their optima at different rotations",
            "Check whether the depth network suits the scene (`coec models assess`); the edges decide.",
        ),
        "distance_rotation": DiagnosticFigure(
            "Distance, rotation",
            "of its limit",
            "How far the rotation at which the edges fit best is from the extrinsic, squared and in the standard "
            "deviations of a check.",
            "the optimum over rotations is farther from the extrinsic than it is for a correct one",
            _CALIBRATE,
        ),
        "distance_pose": DiagnosticFigure(
            "Distance, pose",
            "of its limit",
            "Likewise of rotation and translation together, on the axis that is farthest off.",
            "the optimum over all axes is farther from the extrinsic than it is for a correct one",
            _CALIBRATE,
        ),
        "edge_score": DiagnosticFigure(
            "Edge score",
            "σ",
            "How strongly the image has edges where the LiDAR has them, at the extrinsic that is checked.",
            "the image has almost no edges at the range edges of the LiDAR",
            _MORE_STRUCTURE,
        ),
        "edges_per_pair": DiagnosticFigure(
            "Edges per pair",
            "σ",
            "The same where the edges fit best, for each pair of frames.",
            "the edges are faint, so the check counts less",
            _MORE_STRUCTURE,
        ),
        "edges_kept_rotation": DiagnosticFigure(
            "Edges kept, rotation",
            "",
            "Edge score at the extrinsic, over that at the rotation that fits best. 1: nothing is gained by turning.",
            "another rotation gains more edge score than chance does",
            _CALIBRATE,
        ),
        "edges_kept_pose": DiagnosticFigure(
            "Edges kept, pose",
            "",
            "Edge score at the extrinsic, over that at the pose that fits best. 1: nothing is gained by moving.",
            "another pose gains more edge score than chance does",
            _CALIBRATE,
        ),
        "certainty_rotation": DiagnosticFigure(
            "Certainty, rotation",
            "σ",
            "How certainly another rotation gains more than the frames differ from one another.",
            "the frames agree on another rotation",
            _CALIBRATE,
        ),
        "certainty_pose": DiagnosticFigure(
            "Certainty, pose",
            "σ",
            "How certainly another pose gains more than the frames differ from one another.",
            "the frames agree on another pose",
            _CALIBRATE,
        ),
    }
)
"""By the name of the metric."""

OTHER_ADVICE: Mapping[str, str] = MappingProxyType(
    {
        StopReason.AT_BOUND.value: "Start nearer to the truth, or widen the search (`search.rotation_deg`).",
        StopReason.EVALUATIONS.value: "Start nearer, or allow more evaluations (`search.max_evaluations`).",
        "motion": "Take the window while the vehicle drives past objects, not where it stands or sees its road alone.",
    }
)
"""What to do about those reasons of a verdict that are not figures, by their code."""
