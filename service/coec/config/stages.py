"""The stages of a calibration: which pairs make a window, how it is solved, and how windows combine."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from coec.config.base import Stage


class PairingConfig(Stage):
    """Which camera frame belongs to which sweep."""

    tolerance_s: float = Field(default=0.05, gt=0, le=1, description="largest stamp difference; half a 10 Hz period")
    motion_tolerance_s: float = Field(
        default=0.2, gt=0, le=5, description="largest distance of a pair from the nearest ego-motion sample"
    )
    queue_frames: int = Field(
        default=16, ge=2, le=256, description="frames kept per stream while they wait for partners"
    )
    max_stamp_jump_s: float = Field(
        default=300.0, gt=0, description="a stamp further from its predecessor is refused, until five agree"
    )


MAX_SLICE_S = 3600.0
"""Longest slice, s: within an hour, light and weather are those of one drive."""


class WindowConfig(Stage):
    """How a window is chosen from the stream (the paper: 25 pairs over three minutes)."""

    pairs: int = Field(default=25, ge=1, le=400, description="of a full window")
    min_pairs: int = Field(default=10, ge=1, le=400, description="a slice that ends with fewer makes no window")
    slice_s: float = Field(
        default=180.0, gt=0, le=MAX_SLICE_S, description="of sensor time, over which the pairs are spread, s"
    )
    require_motion: bool = Field(default=True, description="skip pairs taken while the vehicle is known to stand")
    min_speed_mps: float = Field(default=0.5, ge=0, description="slower counts as standing")
    min_sharpness: float = Field(
        default=0.008,
        ge=0,
        description="gradient energy over contrast, 0 to 1; sharp: 0.011 to 0.057, blurred by 4 px: below 0.006",
    )
    min_mean_level: float = Field(default=8.0, ge=0, le=255, description="mean grey value; darker tells nothing")
    max_clipped: float = Field(
        default=0.6, gt=0, le=1, description="share of black or white pixels; a covered or blinded lens"
    )
    min_points_in_view: int = Field(default=500, ge=1, description="LiDAR points in the image at the current extrinsic")
    between_s: float = Field(
        default=1.0,
        ge=0.1,
        le=MAX_SLICE_S,
        description="pairs so far apart are recorded between the chosen ones, thinned: they tell when the camera moved",
    )
    between_mib: int = Field(
        default=48, ge=0, le=1024, description="MiB of them in a window at most, evenly over its slice; 0 = none"
    )

    @model_validator(mode="after")
    def _counts_agree(self) -> WindowConfig:
        if self.min_pairs > self.pairs:
            raise ValueError("min_pairs must not exceed pairs")
        return self


class DepthConfig(Stage):
    """The depth network."""

    model: str = Field(
        default="street", description="an ONNX file, a built-in name, or `stereo` (maps that come with the frames)"
    )
    providers: tuple[Literal["cpu", "cuda", "tensorrt"], ...] = Field(
        default=("cpu",), min_length=1, description="tried in this order; cpu is always the last resort"
    )
    threads: int = Field(default=2, ge=1, le=64, description="of the inference")


class ObjectiveConfig(Stage):
    """Equation (1) and the guard against looking away."""

    kind: Literal["mi", "fused", "intensity"] = Field(
        default="fused",
        description="fused: edges and depth, from far away; mi: the paper's; intensity: reflectance against grey value",
    )
    depth_bins: int = Field(default=32, ge=2, le=4096, description="of the joint histogram, along depth")
    range_bins: int = Field(default=32, ge=2, le=4096, description="of the joint histogram, along range")
    min_range_m: float = Field(default=2.0, ge=0, description="nearer points are the vehicle itself")
    max_range_m: float = Field(default=80.0, gt=0, description="further points are too sparse to carry information")

    @model_validator(mode="after")
    def _range_is_not_empty(self) -> ObjectiveConfig:
        if self.min_range_m >= self.max_range_m:
            raise ValueError("min_range_m must be below max_range_m")
        return self


class SearchConfig(Stage):
    """The box and the steps of BOBYQA."""

    dof: Literal[3, 6] = Field(default=3, description="3: rotation, the translation is known; 6: both")
    rotation_deg: float = Field(
        default=10.0, gt=0, le=45, description="half-width of the box about the start, per axis"
    )
    translation_m: float = Field(default=0.3, gt=0, le=2, description="half-width of the box about the start, per axis")
    step_deg: float = Field(default=2.0, gt=0, description="first trust region, rotation")
    step_m: float = Field(default=0.05, gt=0, description="first trust region, translation")
    tolerance_deg: float = Field(default=0.002, gt=0, description="last trust region, rotation")
    max_evaluations: int = Field(
        default=600, ge=20, le=100_000, description="of the objective in one climb; then it ends where it is"
    )
    reach_deg: float = Field(
        default=28.0, gt=0, le=60, description="radius of the global stage about the start (fused)"
    )
    reach_m: float = Field(default=0.65, gt=0, le=2, description="radius of the global stage about the start (fused)")


class VerdictConfig(Stage):
    """Limits of equation (2) for a rig that is not commissioned yet. All are ratios of the window to itself, so that
    they do not depend on the scene, the bins or the network."""

    min_mi_over_unrelated: float = Field(default=1.2, gt=0, description="MI over the MI with other frames' depth maps")
    max_newton_step_deg: float = Field(default=0.25, gt=0, description="|f'|/f'': distance to the zero of f', degrees")
    max_newton_step_m: float = Field(default=0.02, gt=0, description="|f'|/f'' of the translations, metres (6 dof)")
    max_sigma_deg: float = Field(default=0.3, gt=0, description="largest standard deviation of a rotation, degrees")
    max_sigma_m: float = Field(default=0.1, gt=0, description="largest standard deviation of a translation, m (6 dof)")
    min_peakedness_per_deg2: float = Field(default=0.01, description="f''/score, per degree²; least of the rotations")
    min_overlap: float = Field(
        default=0.5, ge=0, le=1, description="points in view over the most any pose of the box sees"
    )
    min_range_edges: int = Field(
        default=800,
        ge=1,
        description="independent range jumps of the window's sweeps, with 6 dof twice as many; a few hundred fit wrong "
        "poses by chance (fused)",
    )
    min_edge_contrast: float = Field(
        default=6.0, gt=0, description="edge significance, in standard deviations of that of other poses (fused)"
    )
    max_runner_up: float = Field(
        default=0.85,
        gt=0,
        le=1,
        description="edge contrast of the next best basin over the best one's; above: ambiguous",
    )
    min_edges_once: float = Field(
        default=15.0,
        gt=0,
        description="edge significance of a vehicle on the move, what its frames have in common counted once; below: "
        "guard rails fit lane markings as well (fused)",
    )
    max_change_gain: float = Field(
        default=3.5,
        gt=0,
        description="what two poses, one after the other, may score more than one, in standard deviations of a frame's "
        "score; above: the camera moved within the window (fused)",
    )
    max_intrinsics_certainty: float = Field(
        default=2.0,
        gt=0,
        description="certainty with which another lens may explain the window better, half a standard deviation each; "
        "at 1.5 it is as likely, and σ grows by what that lens moves, above this the intrinsics are off (fused)",
    )
    held_translation_sigma_m: float = Field(
        default=0.01,
        ge=0,
        description="how well the camera's centre is known along each axis where it is not searched: standard "
        "deviation of a mount that was measured with a rule or taken from a drawing, m",
    )
    min_change_deg: float = Field(
        default=0.25, ge=0, description="a smaller turn within a window does not refuse it (fused)"
    )


class TimeOffsetConfig(Stage):
    """When the offset between the clocks of camera and LiDAR counts as observed."""

    reach_s: float = Field(default=0.1, gt=0, le=0.5, description="largest offset looked for, s")
    min_turn_spread_deg_per_s: float = Field(
        default=2.5, gt=0, description="least spread of the turn rate over the frames; less is a straight drive"
    )
    translation_sigma_m: float = Field(
        default=0.05, ge=0, description="how well the mount's position is known: driving on, 5 cm look like 5 ms"
    )
    floor_s: float = Field(default=0.001, ge=0, description="time of exposure, trigger and ego-motion are off by, s")
    max_sigma_s: float = Field(default=0.008, gt=0, description="largest standard deviation of an offset observed, s")


class CalibrationConfig(Stage):
    """Everything that decides a result, given a window: its hash is the `config_hash` of the result."""

    depth: DepthConfig = DepthConfig()
    objective: ObjectiveConfig = ObjectiveConfig()
    search: SearchConfig = SearchConfig()
    verdict: VerdictConfig = VerdictConfig()
    time_offset: TimeOffsetConfig = TimeOffsetConfig()
    motion_compensation: bool = Field(
        default=True, description="move each point to where it was when the image was taken, by ego-motion and its time"
    )


class TrackerConfig(Stage):
    """How accepted windows combine into the extrinsic that is served. Rotations per axis in degrees, translations in
    metres."""

    prior_deg: float = Field(default=10.0, gt=0, le=180, description="how far the first extrinsic may be off")
    prior_m: float = Field(default=0.3, gt=0, le=10, description="how far the first extrinsic may be off")
    drift_deg_per_sqrt_h: float = Field(
        default=0.01, ge=0, description="creep of the mount, a random walk; 0 = every window counts for ever"
    )
    drift_m_per_sqrt_h: float = Field(default=0.001, ge=0, description="the same for translations")
    step_false_alarm: float = Field(
        default=1e-4, gt=0, lt=1, description="a window less probable than this without a step raises suspicion"
    )
    overwhelming_false_alarm: float = Field(
        default=0.0, ge=0, lt=1, description="one less probable than this is taken without a second; 0 = never"
    )
