"""Many real windows out of a few recordings whose calibration is known: subsets of frames, parts of the image, images
of half the size, fewer rings, and wrong lenses on request. Each is solved from several starts.

A recording's own calibration has errors of its own, a vendor's offset for example. So results are compared with the
median accepted result of the whole recording, from starts next to its calibration (`consensus`).
"""

import zlib
from dataclasses import dataclass, replace
from functools import lru_cache
from math import log, pi, radians
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from coec.calibration import types
from coec.calibration.pipeline import calibrate
from coec.calibration_options import SolverOptions
from coec.config import CalibrationConfig, LimitsConfig, WindowConfig
from coec.errors import CalibrationError
from coec.geometry import cameras, se3
from coec.geometry.points import random_direction
from coec.geometry.sweep_kernels import bearings
from coec.io.depth.depth_maps import CachedDepth, open_depth
from coec.io.frame_validation import raw_image
from coec.io.images import GreyImages, decode_bgr, decode_depth, encode_depth_png
from coec.io.recordings.window_cutting import load_window
from coec_lab.experiments.evaluation_run import Plan, configuration_of
from coec_lab.experiments.solve_experiments import start_poses
from coec_lab.experiments.solve_statistics import HIT_M, HIT_RAD

LEAST_FRAMES = 3
"""Frames of the smallest windows."""

LEAST_PART = (0.65, 0.8)
"""Least share of the image's width and height that a part of it has."""

LEAST_HALVED_PX = 150
"""Images are halved only if they then have at least so many rows."""

RING_STEPS = (1, 1, 2, 4)
"""Every so-manieth ring is retained: all in half of the windows."""

RING_RAD = radians(0.45)
"""Height of the bands of elevation that stand for rings if the clouds have none: the mean spacing of 64 beams."""

CONSENSUS_STARTS, CONSENSUS_RAD, CONSENSUS_M = 8, radians(1.0), 0.05
"""Starts of the solves whose median is the reference, and how far they are from the recording's calibration."""

FARTHEST_RAD, FARTHEST_M = radians(2.0), 0.5
"""Results farther than this from the recording's calibration do not count for the reference."""

WRONG_SIGMAS, WRONG_RAD, WRONG_M = 4.0, radians(0.3), 0.1
"""An axis is wrong if it is off by more than these standard deviations, and by more than the angle or distance."""

LENS_SHIFT_PX, LENS_FOCAL = (4.0, 50.0), (0.02, 0.45)
"""Least and largest error of a lens: of its principal point, and of its focal length as a share."""


@dataclass(frozen=True, slots=True)
class Resampling:
    """What is solved.

    Attributes:
        source: SOURCE of the recording.
        dof: degrees of freedom, 3 or 6.
        starts: number of starts per window.
        rotation_deg, translation_m: how far the starts are from the reference; with 3 dof the translation stays.
        lens_errors: whether every window has a wrong lens.
        seed: of all draws.
        depth: as for `coec calibrate`; None: the network that comes with coec.
    """

    source: str
    dof: int
    starts: int
    rotation_deg: float
    translation_m: float
    lens_errors: bool
    seed: int
    depth: str | None = None

    def configuration(self) -> CalibrationConfig:
        """As for `coec evaluate`: the search reaches a little farther than the starts."""
        translation_m = self.translation_m if self.dof == 6 else 0.0
        options = SolverOptions(dof=self.dof, depth=self.depth)
        return configuration_of(Plan(self.rotation_deg, translation_m), options, None)


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """With what results are compared.

    Attributes:
        T_camera_lidar: (4, 4), the median of the accepted results of the whole recording; of all results near its
            calibration if none was accepted; that calibration if there is none.
        accepted, solved: number of results.
        offset: (6,) from the recording's calibration, rad and m.
    """

    T_camera_lidar: types.Matrix4
    accepted: int
    solved: int
    offset: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LensError:
    """One wrong number of a camera: of `cx` or `cy` so many pixels, of `f` a share of the focal lengths."""

    kind: Literal["cx", "cy", "f"]
    size: float

    def applied(self, camera: cameras.Camera) -> cameras.Camera:
        """The camera with the error."""
        known = cameras.intrinsics_of(camera)
        wrong = (
            {name: known[name] * (1.0 + self.size) for name in ("fx", "fy")}
            if self.kind == "f"
            else {self.kind: known[self.kind] + self.size}
        )
        return cameras.build(cameras.name_of(camera), **known | wrong)


@dataclass(frozen=True, slots=True)
class Sample:
    """One window of a recording.

    Attributes:
        frames: indices of the camera frames.
        part: column and row of the first pixel, width and height of the part of the image.
        halved: whether the part then has half the size.
        ring_step, first_ring: every `ring_step`-th ring is retained, from `first_ring` on.
        lens: error of the lens; None: the recording's own.
    """

    frames: tuple[int, ...]
    part: tuple[int, int, int, int]
    halved: bool
    ring_step: int
    first_ring: int
    lens: LensError | None


@dataclass(frozen=True, slots=True, eq=False)
class ResampledSolve:
    """One solve of a window.

    Attributes:
        number: of the window.
        error, sigma: (6,) from the reference, and as claimed; rad and m, NaN on axes that were not solved. Without an
            estimate all NaN.
        accepted: by the verdict.
        reasons: codes of a refusal, in the order of the verdict.
    """

    number: int
    sample: Sample
    error: NDArray[np.float64]
    sigma: NDArray[np.float64]
    accepted: bool
    reasons: tuple[str, ...]

    @property
    def hit(self) -> bool:
        """Within the limits of a hit of the reference."""
        rotation, translation = np.linalg.norm(self.error[:3]), np.linalg.norm(np.nan_to_num(self.error[3:]))
        return bool(rotation < HIT_RAD and translation < HIT_M)

    @property
    def wrong(self) -> bool:
        """Whether an axis is farther off than its standard deviation allows."""
        least = np.repeat([WRONG_RAD, WRONG_M], 3)
        return bool((np.abs(self.error) > np.fmax(least, WRONG_SIGMAS * self.sigma)).any())


@lru_cache(maxsize=2)
def _loaded(source: str) -> types.Window:
    """All frames of a recording, with pixels that need no decoding."""
    window = load_window(source, None, WindowConfig().pairs, lambda *_: None).window
    limits = LimitsConfig()

    def decoded(pair: types.FramePair) -> types.FramePair:
        return replace(pair, camera=replace(pair.camera, image=_raw(decode_bgr(pair.camera.image, limits))))

    return replace(window, pairs=tuple(map(decoded, window.pairs)))


def _raw(bgr: NDArray[np.uint8]) -> types.EncodedImage:
    height, width = bgr.shape[:2]
    return raw_image(types.ImageFormat.BGR8, width, height, np.ascontiguousarray(bgr).tobytes(), LimitsConfig())


def sampled(window: types.Window, lens_errors: bool, rng: np.random.Generator) -> Sample:
    """A window out of another one."""
    available, camera = len(window.pairs), window.rig.camera
    count = int(rng.integers(min(LEAST_FRAMES, available), available + 1))
    frames = tuple(sorted(rng.choice(available, size=count, replace=False).tolist()))
    part = (0, 0, camera.width, camera.height)
    if rng.random() < 0.5:
        width, height = (
            int(size * rng.uniform(least, 1.0))
            for size, least in zip((camera.width, camera.height), LEAST_PART, strict=True)
        )
        part = (
            int(rng.integers(camera.width - width + 1)),
            int(rng.integers(camera.height - height + 1)),
            width,
            height,
        )
    halved = bool(rng.random() < 0.25) and part[3] >= 2 * LEAST_HALVED_PX
    step = int(rng.choice(RING_STEPS))
    first = int(rng.integers(step))
    return Sample(frames, part, halved, step, first, _sampled_lens(rng) if lens_errors else None)


def _sampled_lens(rng: np.random.Generator) -> LensError:
    kinds: tuple[Literal["cx", "cy", "f"], ...] = ("cx", "cy", "f")
    kind = kinds[int(rng.integers(3))]
    least, most = LENS_FOCAL if kind == "f" else LENS_SHIFT_PX
    return LensError(kind, float(np.exp(rng.uniform(log(least), log(most))) * rng.choice([-1.0, 1.0])))


def resampled(window: types.Window, sample: Sample) -> types.Window:
    """The window that was drawn out of a window of raw images."""
    rig, (left, top, width, height) = window.rig, sample.part
    camera = cameras.cropped(rig.camera, left, top, width, height)
    mask = None if rig.mask is None else rig.mask[top : top + height, left : left + width]
    if sample.halved:
        camera = cameras.scaled(camera, 0.5, 0.5)
        mask = None if mask is None else mask[::2, ::2][: camera.height, : camera.width]
    if sample.lens is not None:
        camera = sample.lens.applied(camera)
    pairs = tuple(
        replace(
            window.pairs[index],
            camera=_part(window.pairs[index].camera, sample, camera.width, camera.height, rig),
            lidar=_with_fewer_rings(window.pairs[index].lidar, sample),
        )
        for index in sample.frames
    )
    return replace(window, rig=replace(rig, camera=camera, mask=mask), pairs=pairs, between=())


def _part(frame: types.CameraFrame, sample: Sample, width: int, height: int, rig: types.Rig) -> types.CameraFrame:
    left, top, columns, rows = sample.part
    bgr = decode_bgr(frame.image, LimitsConfig())[top : top + rows, left : left + columns]
    if sample.halved:
        bgr = cv2.resize(bgr, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)
    depth = frame.depth
    if depth is not None:
        across, down = depth.width / rig.camera.width, depth.height / rig.camera.height
        codes = np.nan_to_num(decode_depth(depth, LimitsConfig())).astype(np.uint16)
        codes = codes[
            round(top * down) : round((top + rows) * down), round(left * across) : round((left + columns) * across)
        ]
        depth = types.EncodedImage(
            types.ImageFormat.PNG, codes.shape[1], codes.shape[0], encode_depth_png(np.ascontiguousarray(codes))
        )
    return replace(frame, image=_raw(bgr), depth=depth)


def _with_fewer_rings(sweep: types.LidarFrame, sample: Sample) -> types.LidarFrame:
    if sample.ring_step == 1:
        return sweep
    ring = np.floor(bearings(sweep.xyz_m).elevation / RING_RAD) if sweep.ring is None else sweep.ring
    selected = np.flatnonzero(ring % sample.ring_step == sample.first_ring)
    return replace(
        sweep,
        xyz_m=sweep.xyz_m[selected],
        intensity=None if sweep.intensity is None else sweep.intensity[selected],
        ring=None if sweep.ring is None else sweep.ring[selected],
        time_offset_s=None if sweep.time_offset_s is None else sweep.time_offset_s[selected],
    )


def consensus(of: Resampling) -> Reference:
    """The reference of a recording for a number of degrees of freedom."""
    window, configuration = _loaded(of.source), of.configuration()
    nominal = window.rig.T_camera_lidar_nominal
    depth = CachedDepth(open_depth(configuration.depth, LimitsConfig()), len(window.pairs))
    shift_m = CONSENSUS_M if of.dof == 6 else 0.0
    solved, accepted = [], []
    for start in start_poses(nominal, CONSENSUS_STARTS, CONSENSUS_RAD, shift_m):
        estimate = _solved(window, start, depth, configuration)
        if estimate is None:
            continue
        offset = se3.difference(estimate.optimum.T_camera_lidar, nominal)
        if np.linalg.norm(offset[:3]) < FARTHEST_RAD and np.linalg.norm(offset[3:]) < FARTHEST_M:
            solved.append(offset)
            if estimate.verdict.decision is types.Decision.ACCEPTED:
                accepted.append(offset)
    offset = np.median(accepted or solved or [np.zeros(6)], axis=0)
    return Reference(se3.perturb(nominal, offset), len(accepted), len(solved), offset)


def solve_resampled(task: tuple[int, Resampling, Reference]) -> list[ResampledSolve]:
    """The solves of the window with a number from all its starts."""
    number, of, reference = task
    rng = np.random.default_rng([of.seed, zlib.crc32(of.source.encode()), number])
    whole = _loaded(of.source)
    sample = sampled(whole, of.lens_errors, rng)
    window, configuration = resampled(whole, sample), of.configuration()
    depth = CachedDepth(open_depth(configuration.depth, LimitsConfig()), len(window.pairs))
    shift_m = of.translation_m if of.dof == 6 else 0.0
    solves = []
    for _ in range(of.starts):
        moved = np.concatenate([radians(of.rotation_deg) * random_direction(rng), shift_m * random_direction(rng)])
        estimate = _solved(window, se3.perturb(reference.T_camera_lidar, moved), depth, configuration)
        solves.append(_scored(number, sample, estimate, reference.T_camera_lidar))
    return solves


def _solved(
    window: types.Window, start: types.Matrix4, depth: CachedDepth, configuration: CalibrationConfig
) -> types.Estimate | None:
    guess = replace(window, T_camera_lidar_start=start, start_known_to_rad=pi)
    try:
        return calibrate(guess, depth, GreyImages(LimitsConfig()), configuration, types.Silence())
    except CalibrationError:
        return None


def _scored(number: int, sample: Sample, estimate: types.Estimate | None, reference: types.Matrix4) -> ResampledSolve:
    if estimate is None:
        unknown = np.full(6, np.nan)
        return ResampledSolve(number, sample, unknown, unknown, accepted=False, reasons=("not_solved",))
    error = se3.difference(estimate.optimum.T_camera_lidar, reference)
    # Axes that stayed at the start are no result.
    error[~estimate.solved] = np.nan
    accepted = estimate.verdict.decision is types.Decision.ACCEPTED
    reasons = tuple(reason.code for reason in estimate.verdict.reasons)
    return ResampledSolve(number, sample, error, estimate.sigma, accepted, reasons)


def described(sample: Sample) -> str:
    """A sample for people."""
    left, top, width, height = sample.part
    lens = "" if sample.lens is None else f", {sample.lens.kind} {sample.lens.size:+.3g}"
    return (
        f"frames {' '.join(map(str, sample.frames))}, {width}x{height} at {left},{top}"
        f"{' halved' if sample.halved else ''}, rings {sample.first_ring}::{sample.ring_step}{lens}"
    )
