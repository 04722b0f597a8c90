"""One immutable value per hop of the pipeline, and what the pipeline asks of the outside world: adapters implement
those protocols, tests fake them.

bytes -> `CameraFrame | LidarFrame | EgoMotion` -> `FramePair` -> `Window` -> `DepthMap` -> `Optimum` -> `Verdict`
-> `Estimate`. The same values carry a live stream, an MCAP replay and a folder on disk.

Frames: `T_camera_lidar` maps LiDAR coordinates (x forward, y left, z up) to camera coordinates (x right, y down,
z forward). Stamps are sensor time in integer nanoseconds.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from math import pi, radians
from typing import Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from coec.geometry.cameras import Camera

Matrix4 = NDArray[np.float64]
T = TypeVar("T")

NS_PER_S = 1_000_000_000


class ImageFormat(StrEnum):
    """How the bytes of an image are laid out. Raw ones are named as in sensor_msgs/image_encodings.hpp."""

    JPEG = "jpeg"
    PNG = "png"
    MONO8 = "mono8"
    MONO16 = "mono16"
    RGB8 = "rgb8"
    BGR8 = "bgr8"
    RGBA8 = "rgba8"
    BGRA8 = "bgra8"
    BAYER_RGGB8 = "bayer_rggb8"
    BAYER_BGGR8 = "bayer_bggr8"
    BAYER_GBRG8 = "bayer_gbrg8"
    BAYER_GRBG8 = "bayer_grbg8"
    BAYER_RGGB16 = "bayer_rggb16"
    BAYER_BGGR16 = "bayer_bggr16"
    BAYER_GBRG16 = "bayer_gbrg16"
    BAYER_GRBG16 = "bayer_grbg16"
    YUV422 = "yuv422"
    YUV422_YUY2 = "yuv422_yuy2"


@dataclass(frozen=True, slots=True)
class EncodedImage:
    """An image as it came: compressed, or rows of raw pixels without padding, 16-bit values little-endian.

    `width` and `height` are in pixels; for a compressed image they come from its header. Both are checked against the
    limits before anything is decoded.
    """

    format: ImageFormat
    width: int
    height: int
    data: bytes


@dataclass(frozen=True, slots=True, weakref_slot=True)
class CameraFrame:
    """One exposure.

    `depth` is an optional precomputed depth map of the same view (16-bit grey PNG, any monotonic code of depth or
    inverse depth, 0 = no value), used instead of a network. `sequence` counts frames at the sender; gaps are loss.
    """

    stamp_ns: int
    frame_id: str
    image: EncodedImage
    sequence: int | None = None
    depth: EncodedImage | None = None


@dataclass(frozen=True, slots=True)
class ImageQuality:
    """Sharpness and exposure of one image, measured at half its size.

    Attributes:
        sharpness: mean squared gradient over twice the grey-value variance: 0 to about 1, falls with blur.
        mean_level: mean grey value, 0 to 255.
        clipped: share of pixels at 0-2 or 253-255.
        digest: 64-bit digest of the reduced image: equal digests in a row are a frozen camera.
    """

    sharpness: float
    mean_level: float
    clipped: float
    digest: int


@dataclass(frozen=True, slots=True)
class Recognition:
    """What the values of a recording show of how it was written, and its fields do not say.

    Attributes:
        code: machine-readable.
        text: how it was read, and what to type if that is wrong.
        level: `ok`: it is certain; `warn`: a person should look at it; `fail`: nothing can come of the recording as it
            is.
    """

    code: str
    text: str
    level: Literal["ok", "warn", "fail"] = "ok"


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class LidarFrame:
    """One sweep, in the LiDAR frame, not motion-compensated. Every array has the same length N, every point is finite.

    Attributes:
        xyz_m: (N, 3) float32.
        intensity: (N,) float32 or None.
        ring: (N,) uint16 or None.
        time_offset_s: (N,) float32 or None: when each point was measured, relative to `stamp_ns`.
        timed_by: a line for people: how point times were read if the message leaves that open; empty otherwise.
        not_finite: number of points that were left out because their position or time is not finite.
        recognitions: what its values showed.
    """

    stamp_ns: int
    frame_id: str
    xyz_m: NDArray[np.float32]
    intensity: NDArray[np.float32] | None = None
    ring: NDArray[np.uint16] | None = None
    time_offset_s: NDArray[np.float32] | None = None
    sequence: int | None = None
    timed_by: str = ""
    not_finite: int = 0
    recognitions: tuple[Recognition, ...] = ()


@dataclass(frozen=True, slots=True, weakref_slot=True)
class EgoMotion:
    """Velocity of the vehicle at `stamp_ns`, expressed in the ego frame `frame_id` (x forward, y left, z up).

    `linear_mps` is None if the sensor measures rotation only, as an IMU does; no other value replaces it.
    """

    stamp_ns: int
    frame_id: str
    linear_mps: tuple[float, float, float] | None
    angular_radps: tuple[float, float, float]
    sequence: int | None = None

    @property
    def speed_mps(self) -> float | None:
        """Magnitude of the linear velocity in metres per second; None where that is not known."""
        if self.linear_mps is None:
            return None
        x, y, z = self.linear_mps
        return float(np.sqrt(x * x + y * y + z * z))

    @property
    def turn_radps(self) -> float:
        """Magnitude of the angular velocity in radians per second."""
        x, y, z = self.angular_radps
        return float(np.sqrt(x * x + y * y + z * z))

    def in_axes(self, rotation: NDArray[np.float64], linear: float = 1.0, angular: float = 1.0) -> EgoMotion:
        """The motion whose vectors are those of this one, multiplied by a matrix (3, 3): -1 for the opposite motion;
        and by a factor each."""
        x, y, z = (angular * rotation @ np.array(self.angular_radps)).tolist()
        if self.linear_mps is None:
            return replace(self, angular_radps=(x, y, z))
        along_x, along_y, along_z = (linear * rotation @ np.array(self.linear_mps)).tolist()
        return replace(self, linear_mps=(along_x, along_y, along_z), angular_radps=(x, y, z))

    def reaches(self, speed_mps: float) -> bool:
        """Whether the vehicle is known to be at least so fast."""
        return self.speed_mps is not None and self.speed_mps >= speed_mps

    def stays_below(self, speed_mps: float) -> bool:
        """Whether the vehicle is known to be slower."""
        return self.speed_mps is not None and self.speed_mps < speed_mps


class Compensation(StrEnum):
    """What motion compensation did to a pair; if it did nothing, why."""

    DONE = "done"
    ROTATION_ONLY = "rotation_only"
    NO_EGO_MOTION = "no_ego_motion"
    NO_POINT_TIME = "no_point_time"
    DISABLED = "disabled"


Frame = CameraFrame | LidarFrame | EgoMotion
"""What one sensor sends."""


@dataclass(frozen=True, slots=True, eq=False)
class FramePair:
    """A camera frame and the LiDAR sweep nearest to it in sensor time; `motion` is the ego-motion at the camera stamp,
    or None when none is known there."""

    camera: CameraFrame
    lidar: LidarFrame
    motion: EgoMotion | None = None

    @property
    def stamp_ns(self) -> int:
        """The pair is dated by its camera frame."""
        return self.camera.stamp_ns


@dataclass(frozen=True, slots=True)
class SweepTiming:
    """How the time of a point follows from its azimuth, for spinning LiDARs without per-point time.

    A point at azimuth a = atan2(y, x) was measured `sign · wrap(a - stamp_azimuth_rad) / 2π` revolutions after the
    stamp of the sweep. KITTI's HDL-64 (clockwise, stamped when it looks forward): sign = -1, stamp_azimuth_rad = 0
    (METHOD, section 3).
    """

    period_s: float
    sign: int
    stamp_azimuth_rad: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class CloudFrame:
    """The frame in which a driver gives its points, where that is not the LiDAR's own.

    Attributes:
        frame_id: of the clouds as they come.
        T_cloud_lidar: (4, 4) pose of the LiDAR in that frame, metres.
    """

    frame_id: str
    T_cloud_lidar: Matrix4


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """What is known of one camera-LiDAR pair before the first frame.

    Attributes:
        pair: name of the pair, for example `front`.
        camera: intrinsics.
        T_camera_lidar_nominal: (4, 4) workshop calibration: corrections and drift are counted from it.
        T_lidar_ego: (4, 4) maps ego-frame coordinates to LiDAR coordinates; carries ego-motion to the sensor.
        mask: (height, width) bool or None; False = ignore this pixel (vehicle body, outside the lens).
        sweep: azimuth timing, or None when unknown or when the clouds carry per-point time.
        camera_residual_px: by how many pixels at most `camera` differs from the lens that it was fitted to.
        cloud: the frame in which the LiDAR's driver gives its points; None: the LiDAR's own.
    """

    pair: str
    camera: Camera
    camera_frame: str
    lidar_frame: str
    T_camera_lidar_nominal: Matrix4
    T_lidar_ego: Matrix4
    mask: NDArray[np.bool_] | None = None
    sweep: SweepTiming | None = None
    camera_residual_px: float = 0.0
    cloud: CloudFrame | None = None


MOUNT_RAD = radians(0.5)
"""Scale for a calibration in use: bolted brackets creep and breathe by some tenths of a degree between windows, and a
workshop leaves about as much error."""


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """The pairs of one slice of sensor time, in order of their stamps, and the extrinsic that was current then.

    `T_camera_lidar_start` (4, 4) is where the search starts. It is part of the window so that a replay starts there
    too. `start_known_to_rad` is how far it usually is from the truth: half a turn if it is a guess, infinite if there
    is no start.

    `between` are further pairs of the slice, thinned, also in order of their stamps. They enter no estimate; if the
    camera moved between two pairs of the window, they tell when.
    """

    window_id: str
    rig: Rig
    T_camera_lidar_start: Matrix4
    pairs: tuple[FramePair, ...]
    start_known_to_rad: float = pi
    between: tuple[FramePair, ...] = ()

    @property
    def stamp_ns(self) -> int:
        """Stamp of the last contributing pair."""
        return self.pairs[-1].stamp_ns


@dataclass(frozen=True, slots=True, eq=False)
class DepthMap:
    """Output of a depth network as it comes: any monotonic code of depth or inverse depth over the whole image.

    Attributes:
        values: (h, w) float32 at network resolution; NaN = no value. Covers the same field of view as the image.
    """

    values: NDArray[np.float32]


class StopReason(StrEnum):
    """Why a search ended."""

    TOLERANCE = "tolerance_reached"
    AT_BOUND = "optimum_at_bound"
    EVALUATIONS = "evaluations_exhausted"


@dataclass(frozen=True, slots=True, eq=False)
class Optimum:
    """Where a search ended, with its evidence.

    Attributes:
        T_camera_lidar: (4, 4).
        score, score_at_start: the objective at the end and at the start: nats, for `fused` standard deviations.
        mi: mutual information (nats), equation (1), without the overlap guard.
        overlap: share of the guarded points that lie in view, 0 to 1.
        points_in_view: number of points that entered the histograms, over all frames.
        evaluations: number of objective evaluations.
        first_derivative: (6,) dS/dξ per axis, per radian or metre; NaN for axes that were not searched.
        second_derivative: (6,) -d²S/dξ² per axis, per radian² or metre²; positive at a maximum; NaN likewise.
    """

    T_camera_lidar: Matrix4
    score: float
    score_at_start: float
    mi: float
    overlap: float
    points_in_view: int
    evaluations: int
    stop_reason: StopReason
    first_derivative: NDArray[np.float64]
    second_derivative: NDArray[np.float64]


class Decision(StrEnum):
    """The verdict on an optimum."""

    ACCEPTED = "accepted"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Reason:
    """A machine-readable code and one sentence for people."""

    code: str
    text: str


@dataclass(frozen=True, slots=True)
class Metric:
    """A figure of self-diagnosis with the limit it was judged by. `at_least` tells which side of the limit is good."""

    name: str
    value: float
    limit: float
    at_least: bool

    @property
    def passed(self) -> bool:
        """NaN never passes: a figure that could not be computed is not a good one."""
        return self.value >= self.limit if self.at_least else self.value <= self.limit


ELSEWHERE = frozenset({"newton_step_deg", "newton_step_m", *(stop.value for stop in StopReason)})
"""Codes of reasons that refuse a result although a pose stands out in its window: only its exact place is open. Every
other reason says that the window cannot tell."""


MOVED = "moved_within_window"
"""Code of the reason that refuses a window within which the camera moved."""

INTRINSICS_OFF = "intrinsics_off"
"""Code of the reason that refuses a window whose images were taken through another lens than the rig's."""

TWO_POSES = ELSEWHERE | {MOVED, "runner_up"}
"""Codes of the reasons that refuse a window in which the camera has two poses, both of which it shows well."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Equation (2): every metric beside its limit, and the reasons when it failed (empty when accepted)."""

    decision: Decision
    metrics: tuple[Metric, ...]
    reasons: tuple[Reason, ...]

    @property
    def shows_two_poses(self) -> bool:
        """Whether a refused window failed only because the camera moved within it."""
        codes = {reason.code for reason in self.reasons}
        return MOVED in codes and codes <= TWO_POSES

    @property
    def shows_another_lens(self) -> bool:
        """Whether a refused window shows a pose that would stand out more clearly through another lens."""
        codes = {reason.code for reason in self.reasons}
        return INTRINSICS_OFF in codes and not codes & {"edge_contrast", "range_edges", "overlap"}

    @property
    def is_inconclusive(self) -> bool:
        """Whether a refused window says nothing about where the camera is: it shows too little, or several answers."""
        codes = {reason.code for reason in self.reasons}
        return not codes or not codes <= ELSEWHERE


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """How far a pose may be off, about the camera axes, radians and metres.

    Attributes:
        noise: (6, 6) covariance of the errors that differ from window to window; NaN on axes that were not determined.
        systematic: by the name of each error that windows have in common, (6,) the shift of the pose by one standard
            deviation of it.
        independent_samples: how many independent frames those of the window count for; NaN if unknown.
    """

    noise: NDArray[np.float64]
    systematic: Mapping[str, NDArray[np.float64]]
    independent_samples: float

    @classmethod
    def unknown(cls) -> Uncertainty:
        """Unknown on every axis."""
        return cls(np.full((6, 6), np.nan), {}, np.nan)

    @classmethod
    def independent(cls, sigma: NDArray[np.float64]) -> Uncertainty:
        """Noise alone with uncorrelated axes, from standard deviations (6,); NaN on axes that were not determined."""
        determined = np.isfinite(sigma)
        noise = np.where(determined[:, None] & determined, np.diag(np.where(determined, sigma, 0.0) ** 2), np.nan)
        return cls(noise, {}, np.nan)

    @property
    def covariance(self) -> NDArray[np.float64]:
        """(6, 6) of noise and systematic errors together."""
        shared = np.zeros((6, 6))
        for name in sorted(self.systematic):  # sorted: the same to the bit, whatever order they are kept in
            shared += self.systematic[name][:, None] * self.systematic[name]
        return self.noise + shared

    @property
    def sigma(self) -> NDArray[np.float64]:
        """(6,) standard deviations of noise and systematic errors together; NaN on axes that were not determined."""
        return np.sqrt(self.covariance.diagonal())

    @property
    def pitch_height(self) -> float:
        """Correlation of the errors of rx and ty, -1 to 1; NaN if either was not determined. It is small only if near
        things were seen, because far ones cannot tell a turn from a shift."""
        return self._correlation(0, 4)

    @property
    def yaw_side(self) -> float:
        """Correlation of the errors of ry and tx, likewise."""
        return self._correlation(1, 3)

    def _correlation(self, one: int, other: int) -> float:
        covariance, sigma = self.covariance, self.sigma
        size = float(sigma[one] * sigma[other])
        return float(covariance[one, other]) / size if size > 0.0 else np.nan


@dataclass(frozen=True, slots=True, eq=False)
class MovedWithin:
    """The camera moved while a window was taken: two poses, one after the other, explain it, but no single pose does.

    Attributes:
        last_before_ns, first_after_ns: stamps of the two pairs between which it moved; either pair is of the window or
            was recorded between those of the window.
        pairs_after: how many pairs of the window come after the move.
        T_before, T_after: (4, 4) T_camera_lidar that fit the pairs before and after the move; they differ by a turn
            about the camera's centre.
    """

    last_before_ns: int
    first_after_ns: int
    pairs_after: int
    T_before: Matrix4
    T_after: Matrix4


@dataclass(frozen=True, slots=True, eq=False)
class LensEstimate:
    """What a window says of the lens, as differences from the intrinsics of its rig: principal point right and down,
    px; focal length, as a share of it; first radial term, px at a corner of the image.

    Attributes:
        difference, sigma: (4,) and standard deviations, by the window and by what is known of the intrinsics.
        free_difference, free_sigma: (4,) likewise by the window alone, whatever the intrinsics are.
        determined: (4,) bool, what the window alone determines.
        probability: that the images were taken through another lens than the intrinsics say.
    """

    difference: NDArray[np.float64]
    sigma: NDArray[np.float64]
    free_difference: NDArray[np.float64]
    free_sigma: NDArray[np.float64]
    determined: NDArray[np.bool_]
    probability: float

    def corrected(self, camera: Camera) -> Camera:
        """The camera of the rig with focal length and principal point as estimated. Its radial terms stay: no model has
        the first one as a parameter that is independent of the others."""
        right, down, longer, _ = self.difference.tolist()
        return camera._replace(
            fx=camera.fx * (1.0 + longer), fy=camera.fy * (1.0 + longer), cx=camera.cx + right, cy=camera.cy + down
        )


@dataclass(frozen=True, slots=True, eq=False)
class CueShare:
    """What one cue contributed to a result.

    Attributes:
        name: `range_edges`, `reflectance_edges` or `depth`.
        samples: edges of the window, or points in view.
        weight: of its samples, relative to those of the other kind of edges: 0 to 1; 1 for depth.
        significance: of this cue alone at the result, standard deviations; of depth, above other poses.
        share: (6,) of the curvature of the objective along each axis of ξ, 0 to 1; NaN on axes that were not searched.
    """

    name: str
    samples: int
    weight: float
    significance: float
    share: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The immutable result of calibrating one window.

    Attributes:
        correction: (6,) rotation vector (rad) and translation (m) from the nominal calibration, about the camera axes.
        uncertainty: of the pose; unknown on axes that were not solved.
        solved: (6,) bool, the axes that were searched and found.
        unobservable: (6,) bool, the translations that were searched but that the window cannot determine. Along these
            camera axes the camera's centre, -Rᵀ·t in LiDAR coordinates, stays that of the start.
        compensation: how many pairs ended with each `Compensation`, by name.
        depth_identity: sha256 of the network, or `precomputed`.
        config_hash: of everything that decides the result.
        moved: the move for which the window was refused; None if the camera did not move within it.
        lens: what the window says of the lens; None if its objective uses no edges, or they determine no pose.
        cues: what each cue contributed; empty if the objective has one cue only.
    """

    window_id: str
    data_stamp_ns: int
    pairs: int
    optimum: Optimum
    verdict: Verdict
    correction: NDArray[np.float64]
    uncertainty: Uncertainty
    solved: NDArray[np.bool_]
    unobservable: NDArray[np.bool_]
    compensation: dict[str, int]
    depth_identity: str
    config_hash: str
    moved: MovedWithin | None = None
    lens: LensEstimate | None = None
    cues: tuple[CueShare, ...] = ()

    @property
    def sigma(self) -> NDArray[np.float64]:
        """(6,) standard deviation per axis (rad, m); NaN where it was not estimated."""
        return self.uncertainty.sigma


@dataclass(frozen=True, slots=True, eq=False)
class Mistake:
    """A probable mistake in the inputs of a window.

    Attributes:
        code: machine-readable, see `search.mistakes`.
        text: what is probably wrong, and what to do.
        significance: of the edges without the mistake, in standard deviations of wrong poses; NaN if it was not tried.
        significance_as_given: the same of the inputs as they are.
        camera, T_camera_lidar: intrinsics and extrinsic (4, 4) without the mistake.
        correctable: whether these correct it, so that the images stay as they are.
    """

    code: str
    text: str
    significance: float
    significance_as_given: float
    camera: Camera
    T_camera_lidar: Matrix4
    correctable: bool


class DepthModel(Protocol):
    """A virtual depth sensor: one camera frame in, one depth map out (METHOD, section 1)."""

    @property
    def identity(self) -> str:
        """sha256 of the network file in hexadecimal, or `precomputed`: part of every decision's hash."""

    def infer(self, frame: CameraFrame) -> DepthMap:
        """Depth of the frame, at the resolution of the network.

        Raises:
            DecodeError: the image or the precomputed map cannot be decoded, or there is no map.
        """


class ImageReader(Protocol):
    """Pixels of an exposure, for the cues that use the image itself."""

    def grey(self, frame: CameraFrame) -> NDArray[np.uint8]:
        """(height, width) grey values.

        Raises:
            DecodeError: the image cannot be decoded within the limits.
        """


class ImageInspector(Protocol):
    """Judges an exposure without keeping its pixels."""

    def inspect(self, frame: CameraFrame) -> ImageQuality:
        """Sharpness and exposure of the frame.

        Raises:
            DecodeError: the image cannot be decoded within the limits.
        """


class ImageReducer(Protocol):
    """Makes exposures small enough to be recorded by the hundred."""

    def reduced(self, frame: CameraFrame) -> CameraFrame:
        """The frame without its depth map, its image compressed if it was not.

        Raises:
            DecodeError: the image cannot be decoded within the limits.
        """


class Progress(Protocol):
    """Receives how far a calibration has come; it cannot influence the result."""

    def step(self, stage: str, done: int, total: int) -> None:
        """`done` of `total` parts of the stage are complete."""


class Silence:
    """A `Progress` for callers that do not want to know."""

    def step(self, stage: str, done: int, total: int) -> None:
        """Nothing."""


@dataclass(frozen=True, slots=True)
class Step:
    """A part of a long computation that is complete: `done` of `total` parts of a stage."""

    stage: str
    done: int
    total: int


Steps = Generator[Step, None, T]
"""A long computation that can be suspended after each of its steps, and returns a T."""


def run_to_end(steps: Steps[T], progress: Progress) -> T:
    """The result of a computation, without a pause. `progress` receives each step."""
    while True:
        try:
            step = next(steps)
        except StopIteration as end:
            result: T = end.value
            return result
        progress.step(step.stage, step.done, step.total)
