"""The stages of a calibration: which frame pairs make a window, how a window is solved, how windows combine, when the
monitor checks a pair, and which estimates may be applied without a person.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from coec.config.model import ConfigModel


class PairingConfig(ConfigModel):
    """Which camera frame belongs to which sweep."""

    tolerance_s: float = Field(default=0.05, gt=0, le=1, description="largest stamp difference; half a 10 Hz period")
    motion_tolerance_s: float = Field(
        default=0.2, gt=0, le=5, description="largest time from a pair to the nearest ego-motion sample"
    )
    queue_frames: int = Field(
        default=16, ge=2, le=256, description="frames kept per stream while they wait for partners"
    )
    max_stamp_jump_s: float = Field(
        default=300.0, gt=0, description="a stamp further from the one before is refused, until five such stamps agree"
    )


MAX_SLICE_S = 3600.0
"""Longest slice, s: within an hour, light and weather are those of one drive."""


class WindowConfig(ConfigModel):
    """How a window is chosen from the stream (the paper: 25 pairs over three minutes)."""

    pairs: int = Field(default=25, ge=1, le=400, description="frame pairs of a full window")
    min_pairs: int = Field(default=10, ge=1, le=400, description="a slice that ends with fewer makes no window")
    slice_s: float = Field(
        default=180.0, gt=0, le=MAX_SLICE_S, description="sensor time over which the pairs are spread, s"
    )
    require_motion: bool = Field(default=True, description="skip pairs taken while the vehicle is known to stand")
    min_speed_mps: float = Field(default=0.5, ge=0, description="slower counts as standing")
    min_sharpness: float = Field(
        default=0.008,
        ge=0,
        description="gradient energy over contrast, 0 to 1; sharp images: 0.011 to 0.057, blurred by 4 px: below 0.006",
    )
    min_mean_level: float = Field(
        default=8.0, ge=0, le=255, description="least mean grey value; darker images tell nothing"
    )
    max_clipped: float = Field(
        default=0.6, gt=0, le=1, description="largest share of black or white pixels; more: covered or blinded lens"
    )
    min_points_in_view: int = Field(
        default=500, ge=1, description="least LiDAR points in the image at the current extrinsic"
    )
    between_s: float = Field(
        default=1.0,
        ge=0.1,
        le=MAX_SLICE_S,
        description="spacing of the thinned pairs recorded between the chosen ones, which tell when the camera moved",
    )
    between_mib: int = Field(
        default=48, ge=0, le=1024, description="most MiB of such pairs in a window, evenly over its slice; 0 = none"
    )

    @model_validator(mode="after")
    def _counts_agree(self) -> WindowConfig:
        if self.min_pairs > self.pairs:
            raise ValueError("min_pairs must not exceed pairs")
        return self


class DepthConfig(ConfigModel):
    """The depth network."""

    model: str = Field(
        default="street",
        description="an ONNX file, a built-in name, or `stereo` (depth maps that come with the frames)",
    )
    providers: tuple[Literal["cpu", "cuda", "tensorrt"], ...] = Field(
        default=("cpu",), min_length=1, description="tried in this order; cpu is always the last resort"
    )
    threads: int = Field(default=2, ge=1, le=64, description="threads of the inference")


class ObjectiveConfig(ConfigModel):
    """The objective: equation (1) of the paper, and the guard against poses that look away from the points."""

    kind: Literal["mi", "fused", "intensity"] = Field(
        default="fused",
        description="fused: edges and depth, from far away; mi: the paper's; intensity: reflectance against grey value",
    )
    depth_bins: int = Field(default=32, ge=2, le=4096, description="bins of the joint histogram, along depth")
    range_bins: int = Field(default=32, ge=2, le=4096, description="bins of the joint histogram, along range")
    min_range_m: float = Field(default=2.0, ge=0, description="nearer points are the vehicle itself")
    max_range_m: float = Field(default=80.0, gt=0, description="further points are too sparse to carry information")

    @model_validator(mode="after")
    def _range_is_not_empty(self) -> ObjectiveConfig:
        if self.min_range_m >= self.max_range_m:
            raise ValueError("min_range_m must be below max_range_m")
        return self


class SearchConfig(ConfigModel):
    """The box and the steps of the search (BOBYQA)."""

    dof: Literal[3, 6] = Field(default=3, description="3: rotation only, the translation is known; 6: both")
    rotation_deg: float = Field(
        default=10.0, gt=0, le=45, description="half-width of the box about the start, per axis"
    )
    translation_m: float = Field(default=0.3, gt=0, le=2, description="half-width of the box about the start, per axis")
    step_deg: float = Field(default=2.0, gt=0, description="first trust region, rotation")
    step_m: float = Field(default=0.05, gt=0, description="first trust region, translation")
    tolerance_deg: float = Field(default=0.002, gt=0, description="last trust region, rotation")
    max_evaluations: int = Field(
        default=600, ge=20, le=100_000, description="evaluations of the objective after which one climb stops"
    )
    reach_deg: float = Field(
        default=28.0, gt=0, le=60, description="radius of the global search about the start (fused)"
    )
    reach_m: float = Field(default=0.65, gt=0, le=2, description="radius of the global search about the start (fused)")


class VerdictConfig(ConfigModel):
    """Limits of equation (2) for a rig that is not commissioned yet. Each compares the window with itself, so that the
    limits do not depend on the scene, the bins or the network."""

    min_mi_over_unrelated: float = Field(
        default=1.2, gt=0, description="least ratio of the MI to the MI with other frames' depth maps"
    )
    max_newton_step_deg: float = Field(
        default=0.25, gt=0, description="largest |f'|/f'', the distance to the zero of f', degrees"
    )
    max_newton_step_m: float = Field(default=0.02, gt=0, description="largest |f'|/f'' of a translation, m (6 dof)")
    max_sigma_deg: float = Field(default=0.3, gt=0, description="largest standard deviation of a rotation, degrees")
    max_sigma_m: float = Field(default=0.1, gt=0, description="largest standard deviation of a translation, m (6 dof)")
    min_peakedness_per_deg2: float = Field(default=0.01, description="least f''/score of any rotation, per degree²")
    min_overlap: float = Field(
        default=0.5, ge=0, le=1, description="least ratio of points in view to the most that any pose of the box sees"
    )
    min_range_edges: int = Field(
        default=200,
        ge=1,
        description="least independent range jumps in the window's sweeps, twice as many with 6 dof; a hundred fit "
        "wrong poses by chance (fused)",
    )
    min_edge_contrast: float = Field(
        default=6.0,
        gt=0,
        description="least edge significance, in standard deviations of the significance of other poses (fused)",
    )
    max_runner_up: float = Field(
        default=0.85,
        gt=0,
        le=1,
        description="largest ratio of the second-best basin's edge contrast to the best one's; above: ambiguous",
    )
    min_edges_once: float = Field(
        default=12.5,
        gt=0,
        description="least edge significance where what frames have in common counts once, as of ten frames if there "
        "are fewer, if translation is searched; below: a shift may fit one near board, or lines along the road (fused)",
    )
    min_range_significance: float = Field(
        default=5.0,
        gt=0,
        description="least significance of the range edges alone, standard deviations, if translation is searched; "
        "below: a shift may fit the markings of a road (fused)",
    )
    max_change_gain: float = Field(
        default=3.5,
        gt=0,
        description="largest gain in score of two poses in succession over a single one, in standard deviations of a "
        "frame's score; above: the camera moved within the window (fused)",
    )
    max_intrinsics_certainty: float = Field(
        default=1.5,
        gt=0,
        description="largest certainty that another lens explains the window better: half its distance in standard "
        "deviations; at 1.5 that lens is as likely, and σ grows by what it moves; above this limit the intrinsics are "
        "off (fused)",
    )
    held_translation_sigma_m: float = Field(
        default=0.01,
        ge=0,
        description="how well the camera's centre is known along each axis if it is not searched: standard deviation "
        "of a mount that was measured with a rule or taken from a drawing, m",
    )
    principal_point_sigma: float = Field(
        default=0.0007,
        gt=0,
        description="how well the principal point of the camera is known along each axis of the image: standard "
        "deviation as a share of the image's width (1 px in 1,400)",
    )
    focal_length_sigma: float = Field(
        default=0.002,
        gt=0,
        description="how well the focal length of the camera is known: standard deviation as a share of it; half of "
        "that for the first radial term at a corner of the image",
    )
    min_change_deg: float = Field(
        default=0.25, ge=0, description="a smaller turn within a window does not refuse the window (fused)"
    )


class TimeOffsetConfig(ConfigModel):
    """When the offset between the clocks of camera and LiDAR counts as observed."""

    reach_s: float = Field(default=0.1, gt=0, le=0.5, description="largest offset that is searched, s")
    min_turn_spread_deg_per_s: float = Field(
        default=2.5, gt=0, description="least spread of the turn rate over the frames; less is a straight drive"
    )
    translation_sigma_m: float = Field(
        default=0.05,
        ge=0,
        description="how well the mount's position is known: driving straight on, 5 cm look like 5 ms",
    )
    floor_s: float = Field(
        default=0.001, ge=0, description="error that exposure, trigger and ego-motion times always have, s"
    )
    max_sigma_s: float = Field(
        default=0.008, gt=0, description="largest standard deviation of an offset that counts as observed, s"
    )


class CalibrationConfig(ConfigModel):
    """Everything that decides the result of a given window. Its hash is the `config_hash` of the result."""

    depth: DepthConfig = DepthConfig()
    objective: ObjectiveConfig = ObjectiveConfig()
    search: SearchConfig = SearchConfig()
    verdict: VerdictConfig = VerdictConfig()
    time_offset: TimeOffsetConfig = TimeOffsetConfig()
    motion_compensation: bool = Field(
        default=True,
        description="move each point, by ego-motion and the point's time, to where it was when the image was taken",
    )


class TrackerConfig(ConfigModel):
    """How accepted windows combine into the served extrinsic. Per axis, rotations in degrees, translations in
    metres."""

    prior_deg: float = Field(
        default=10.0, gt=0, le=180, description="how far the first extrinsic may be off, standard deviation"
    )
    prior_m: float = Field(
        default=0.3, gt=0, le=10, description="how far the first extrinsic may be off, standard deviation"
    )
    drift_deg_per_sqrt_h: float = Field(
        default=0.01, ge=0, description="creep of the mount, a random walk; 0 = every window counts for ever"
    )
    drift_m_per_sqrt_h: float = Field(default=0.001, ge=0, description="the same for translations")
    step_false_alarm: float = Field(
        default=1e-4,
        gt=0,
        lt=1,
        description="a window that is less probable than this without a step of the mount raises suspicion",
    )
    overwhelming_false_alarm: float = Field(
        default=0.0,
        ge=0,
        lt=1,
        description="a window less probable than this is taken as a step without a second window; 0 = never",
    )


class MonitorConfig(ConfigModel):
    """When the monitor checks the latest pairs at the current extrinsic, between two windows."""

    period_s: float = Field(default=5.0, gt=0, le=86_400, description="sensor time from one check to the next, s")
    pairs: int = Field(default=6, ge=4, le=10, description="frame pairs of one check, spread evenly over the period")
    min_pairs: int = Field(default=4, ge=4, le=10, description="with fewer, the check waits for the next period")
    urgent_slice_s: float = Field(
        default=30.0,
        gt=0,
        le=3600,
        description="length of the slice that starts as soon as the monitor suspects a move, s",
    )
    hours_between_false_alarms: float = Field(
        default=100.0,
        gt=0,
        description="least mean time between two false alarms of the checks on a mount that has not moved, h",
    )
    hours_between_false_suspicions: float = Field(
        default=2.0, gt=0, description="least mean time between two false suspicions on a mount that has not moved, h"
    )

    @model_validator(mode="after")
    def _counts_agree(self) -> MonitorConfig:
        if self.min_pairs > self.pairs:
            raise ValueError("min_pairs must not exceed pairs")
        if self.hours_between_false_suspicions > self.hours_between_false_alarms:
            raise ValueError("hours_between_false_suspicions must not exceed hours_between_false_alarms")
        return self


class PolicyConfig(ConfigModel):
    """Which accepted estimates become current without a person. An estimate that is not applied waits for
    `command/apply`. Limits are per axis; the limits of a day count every step of the last 24 h of sensor time."""

    apply: Literal["never", "within_limits", "always"] = Field(
        default="within_limits",
        description="when an accepted estimate that differs is applied: only by a person, if it is within the limits "
        "below, or at once",
    )
    max_step_deg: float = Field(default=10.0, gt=0, description="largest step of a rotation, degrees (within_limits)")
    max_step_m: float = Field(default=0.3, gt=0, description="largest step of a translation, m (within_limits)")
    max_per_day_deg: float = Field(
        default=20.0, gt=0, description="largest sum of the steps of a day, degrees (within_limits)"
    )
    max_per_day_m: float = Field(default=0.6, gt=0, description="largest sum of the steps of a day, m (within_limits)")
    agree_deg: float = Field(
        default=0.3, gt=0, description="an accepted estimate nearer than this confirms the served extrinsic, degrees"
    )
    agree_m: float = Field(default=0.1, gt=0, description="the same for translations, m")
