"""Recordings, their windows, and the results of calibrating them.

A `Recording` gives `Window`s; `solve` calibrates a window, and `Result` shows a program what came out. The command line
calls `solve` too.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import inf, isnan, nan
from os import PathLike, fspath
from pathlib import Path
from types import MappingProxyType
from typing import Literal, Unpack

import numpy as np
from numpy.typing import NDArray

from coec.calibration import pipeline
from coec.calibration import types as calibration
from coec.calibration.frames.time_offset import TimeOffset, estimate_time_offset
from coec.calibration.search.mistake_ranking import probable_mistake
from coec.calibration.search.mistakes import BACKWARDS, CLOCK_OFFSET, COMPENSATED, MOTION_AXES, MOTION_UNIT
from coec.calibration.search.without_start import Weighed, calibrate_without_start, without_start
from coec.calibration.solver import prepare_window_data
from coec.calibration.uncertainty.systematic import require_fit
from coec.calibration_options import CalibrationOptions, Progress, checked, configuration_of
from coec.config import CalibrationConfig, LimitsConfig, VerdictConfig, WindowConfig
from coec.errors import CalibrationError, DecodeError, UsageError
from coec.geometry.cameras import intrinsics_of, name_of
from coec.geometry.cameras.double_sphere_fit import fit_double_sphere
from coec.io import user_files
from coec.io.depth.depth_maps import open_depth
from coec.io.exported_extrinsic import (
    ExportFrames,
    extrinsic_of_result,
    require_accepted,
)
from coec.io.exports import export_text
from coec.io.images import GreyImages
from coec.io.recordings import window_cutting
from coec.io.recordings.bag import MOTION_LEFT_OUT
from coec.io.recordings.bag_recognition import TWIST_CONTRADICTED
from coec.io.recordings.clocks import STAMPS_IRREGULAR
from coec.io.recordings.layouts import RecordingSource as Source
from coec.io.recordings.recording_source import HasGroundTruth
from coec.io.recordings.window_cutting import LoadedWindow, NoPairsError
from coec.io.rig_files import intrinsics_config
from coec.io.serialise import matrix_of, mistake_of, result_of
from coec.reports.drawing import titled
from coec.reports.formatting import count
from coec.reports.recording_fitness import Cadence, cadence
from coec.schemas.message import to_json
from coec.schemas.replies import CalibrationResult, Lens, MetricReply, Reason, Verdict
from coec.untrusted import Untrusted, printable

NS_PER_S = 1e9

FITTABLE = "double_sphere"
"""The only model that can be fitted to another one."""


@dataclass(frozen=True, slots=True)
class CameraFit:
    """How far the fitted camera model `model` is off the original `of`, pixels. `coverage`: share of the original's
    pixels that the fit covers."""

    model: str
    of: str
    residual_rms_px: float
    residual_max_px: float
    coverage: float


def fit_camera(window: calibration.Window, model: str) -> tuple[calibration.Window, CameraFit]:
    """The window with another camera model, which is fitted to the window's own.

    Raises:
        UsageError: `model` cannot be fitted.
        LensError: the model does not fit the lens.
    """
    if model != FITTABLE:
        raise UsageError(f"camera model {model}: only {FITTABLE} can be fitted")
    rig: calibration.Rig = window.rig
    fit = fit_double_sphere(rig.camera)
    require_fit(rig.camera, fit, VerdictConfig().max_sigma_deg)
    quality = CameraFit(FITTABLE, name_of(rig.camera), fit.residual_rms_px, fit.residual_max_px, fit.coverage)
    fitted = replace(rig, camera=fit.camera, camera_residual_px=fit.residual_max_px)
    return replace(window, rig=fitted), quality


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The solution of a window, and what it rests on.

    Attributes:
        window: the window as it was solved: with its start moved and its camera fitted where an option requests it.
        estimate: see `calibration.types`.
        result: the estimate as a document of the wire contract.
        configuration: the settings that decided the result.
        fit: how well the fitted camera model fits; None where the recording's own model was used.
        offset: offset of the camera's clock; None where it was not requested.
        mistake: probable mistake in the inputs, if the result was refused; else None.
        recognitions: what was recognised of the recording.
        weighed: how many poses were weighed without a start; None if there was one.
    """

    window: calibration.Window
    estimate: calibration.Estimate
    result: CalibrationResult
    configuration: CalibrationConfig
    fit: CameraFit | None
    offset: TimeOffset | None
    mistake: calibration.Mistake | None = None
    recognitions: tuple[calibration.Recognition, ...] = ()
    weighed: Weighed | None = None


class MistakenInputError(CalibrationError):
    """A window without a result, because its inputs contain a mistake.

    Attributes:
        mistake: the mistake.
    """

    def __init__(self, error: CalibrationError, mistake: calibration.Mistake) -> None:
        super().__init__(f"{error}. {mistake.text}")
        self.mistake = mistake
        self.details = {"mistake": mistake_of(mistake).model_dump(mode="json")}


def solve(loaded: LoadedWindow, options: CalibrationOptions, progress: calibration.Progress) -> Solution:
    """Calibrates a loaded window.

    Args:
        loaded: the window, with the configuration that was recorded with it.
        options: see `calibration_options`.
        progress: is called for the stages `prepare`, those of the calibration, and `time offset`.

    Raises:
        UsageError: a value that does not exist.
        ModelError: the depth network cannot be opened.
        CalibrationError: there is no result; `MistakenInputError` if the inputs contain a mistake.
    """
    configuration = configuration_of(options, options.get("configuration") or loaded.configuration)
    window, perturb, model = loaded.window, options.get("perturb"), options.get("camera_model")
    if _has_no_start(options):
        window = without_start(window)
    elif perturb is not None:
        window = window_cutting.with_perturbed_start(window, perturbation_of(perturb))
    window, fit = (window, None) if model is None else fit_camera(window, model)
    depth = open_depth(configuration.depth, LimitsConfig())
    progress.step("prepare", 1, 1)
    images = GreyImages(LimitsConfig())
    mistake = weighed = None
    if _has_no_start(options):
        estimate, weighed = calibrate_without_start(window, depth, images, configuration, progress)
    else:
        estimate, mistake = calibrated(window, depth, images, configuration, progress)
    if estimate.verdict.decision is not calibration.Decision.ACCEPTED:
        mistake = mistake_of_recording(loaded, mistake)
    offset = None
    if options.get("time_offset"):
        offset = estimate_time_offset(window, images, estimate.optimum.T_camera_lidar, configuration)
        progress.step("time offset", 1, 1)
    result = result_of(estimate, window.rig, loaded.vehicle)
    return Solution(window, estimate, result, configuration, fit, offset, mistake, loaded.recognitions, weighed)


def _has_no_start(options: CalibrationOptions) -> bool:
    """Whether a search without a start is requested.

    Raises:
        UsageError: no such start, or one that is also to be moved.
    """
    start = options.get("start") or "recording"
    if start not in ("recording", "none"):
        raise UsageError(f"start {start}: known are recording, none")
    if start == "none" and options.get("perturb") is not None:
        raise UsageError("--start none has no start that --perturb could move: leave out one of the two")
    return start == "none"


def calibrated(
    window: calibration.Window,
    depth: calibration.DepthModel,
    images: calibration.ImageReader,
    configuration: CalibrationConfig,
    progress: calibration.Progress,
) -> tuple[calibration.Estimate, calibration.Mistake | None]:
    """The estimate of a window; if it is refused, also the mistake in the inputs that probably caused it.

    Raises:
        MistakenInputError: there is no result because of a mistake.
        CalibrationError: there is no result.
    """
    try:
        estimate = pipeline.calibrate(window, depth, images, configuration, progress)
    except CalibrationError as error:
        mistake = probable_mistake(prepare_window_data(window, depth, images, configuration, progress), None)
        if mistake is None:
            raise
        raise MistakenInputError(error, mistake) from error
    if estimate.verdict.decision is calibration.Decision.ACCEPTED:
        return estimate, None
    data = prepare_window_data(window, depth, images, configuration, progress)
    mistake = probable_mistake(data, estimate.optimum.T_camera_lidar)
    reasons = {reason.code for reason in estimate.verdict.reasons}
    # Another focal length looks like other stamps of a vehicle that drives ahead; where nothing fits, anything does.
    doubtful = calibration.INTRINSICS_OFF in reasons or reasons >= {"edge_contrast", "runner_up"}
    if mistake.code == CLOCK_OFFSET if mistake is not None else not doubtful:
        mistake = _measured_offset(window, images, estimate, configuration, mistake) or mistake
    progress.step("mistakes", 1, 1)
    return estimate, mistake


OF_TIMING = (CLOCK_OFFSET, COMPENSATED, BACKWARDS, MOTION_AXES, MOTION_UNIT)
"""Mistakes that irregular stamps or wrong velocities look like."""

OF_RECORDING: Mapping[str, tuple[str, tuple[str, ...] | None]] = MappingProxyType(
    {
        "clocks_apart": ("each image is compared with a sweep of another time.", None),
        "several_cameras": ("the images are those of several cameras.", None),
        "transform_changes": ("the pose at which the search starts may be one that no longer holds.", (CLOCK_OFFSET,)),
        "viewpoint": ("points that a tool has moved are not where the LiDAR measured them.", (CLOCK_OFFSET,)),
        "header_clock": ("messages of other times do not fit each other.", OF_TIMING),
        STAMPS_IRREGULAR: ("sweeps and images of other instants do not fit each other.", OF_TIMING),
        TWIST_CONTRADICTED: ("sweeps that are compensated for wrong motion are distorted.", OF_TIMING),
        MOTION_LEFT_OUT: ("sweeps without motion compensation are distorted; lens or mount seem other ones.", ()),
    }
)
"""What was recognised of a recording and may be why it is refused, with what follows from it, and the mistakes that it
looks like; None: any."""


def mistake_of_recording(loaded: LoadedWindow, named: calibration.Mistake | None) -> calibration.Mistake | None:
    """What was recognised of a recording as the probable cause of its refusal; else the one that was `named`."""
    rig = loaded.window.rig
    for code, (follows, resembled) in OF_RECORDING.items():
        recognised = next((one for one in loaded.recognitions if one.code == code), None)
        if recognised is not None and (named is None or resembled is None or named.code in resembled):
            text = f"{follows} {recognised.text}"
            return calibration.Mistake(code, text, nan, nan, rig.camera, rig.T_camera_lidar_nominal, correctable=False)
    return named


CERTAIN = 5.0
"""An offset of the clocks is named from so many standard deviations on, and from `LEAST_OFFSET_S`."""

LEAST_OFFSET_S = 0.01
"""A smaller offset refuses no window."""


def _measured_offset(
    window: calibration.Window,
    images: calibration.ImageReader,
    estimate: calibration.Estimate,
    configuration: CalibrationConfig,
    mistake: calibration.Mistake | None,
) -> calibration.Mistake | None:
    """The offset of the camera's clock, with its size, if it is certain, in the place of a `mistake` about clocks. That
    straight driving cannot tell it from a shifted mount is in its standard deviation."""
    try:
        offset = estimate_time_offset(window, images, estimate.optimum.T_camera_lidar, configuration)
    except (CalibrationError, DecodeError):
        return None
    certain = abs(offset.offset_s) >= max(CERTAIN * offset.sigma_s, LEAST_OFFSET_S)
    if not certain or isnan(offset.sigma_s):
        return None
    cause = stamped_text(window.pairs[0].lidar, offset.offset_s, offset.sigma_s)
    late = "later" if offset.offset_s < 0.0 else "earlier"
    text = (
        f"the stamps of the camera are {1e3 * abs(offset.offset_s):.0f} ± {1e3 * offset.sigma_s:.0f} ms {late} than "
        f"its exposures by the clock of the LiDAR, {cause}: correct the stamps in the driver and record again; "
        f"of a bag, ?camera_offset={offset.offset_s:.4f} is added to the stamps of the camera (in a dataset.yaml, "
        "add it to each stamp_ns)"
    )
    if not offset.observable:
        speeds_mps = [pair.motion.speed_mps or 0.0 for pair in window.pairs if pair.motion is not None]
        shift_m = abs(offset.offset_s) * float(np.median(speeds_mps))
        text += f". Straight driving looks the same if the camera is {shift_m:.2f} m off along the road"
    if mistake is not None:
        return replace(mistake, text=text)
    rig = window.rig
    return calibration.Mistake(CLOCK_OFFSET, text, nan, nan, rig.camera, rig.T_camera_lidar_nominal, correctable=False)


def stamped_text(sweep: calibration.LidarFrame, offset_s: float, sigma_s: float) -> str:
    """What probably causes an offset of the camera's clock. Half or all of a sweep is that of sweeps that are stamped
    at another point than that from which the times of their points count."""
    times_s = sweep.time_offset_s
    begin_s, end_s = (0.0, 0.0) if times_s is None else (float(times_s.min()), float(times_s.max()))
    lasts_s = end_s - begin_s
    counted = ("begin", "end", lasts_s) if abs(begin_s) < 0.1 * lasts_s else ("end", "begin", -lasts_s)
    for part, place, share in (("half of a", "middle", 0.5), ("a whole", counted[1], 1.0)):
        away_s = abs(offset_s - share * counted[2])
        if min(abs(begin_s), abs(end_s)) < 0.1 * lasts_s and away_s < min(3.0 * sigma_s, 0.2 * lasts_s):
            return (
                f"which is {part} sweep: the times of points count from its {counted[0]}, and its stamp is probably "
                f"that of its {place} (?lidar_offset={-share * counted[2]:.4f}; in a dataset.yaml, cloud_stamp_ns)"
            )
    return "as of images that are stamped when they are received, or sweeps that are stamped at another point"


def perturbation_of(perturb: str | Sequence[float]) -> NDArray[np.float64]:
    """ξ (6,), radians and metres, of the option `perturb`: the text of the command line, or numbers.

    Raises:
        UsageError: these are not three or six finite numbers, or too large.
    """
    if isinstance(perturb, str):
        return window_cutting.parse_perturbation("--perturb", perturb)
    return window_cutting.perturbation_vector(f"perturb={perturb!r}", perturb)


@dataclass(frozen=True, slots=True)
class CallbackProgress:
    """`calibration.types.Progress` that calls a function; None: no function."""

    callback: Progress | None

    def step(self, stage: str, done: int, total: int) -> None:
        """See `calibration.types.Progress`."""
        if self.callback is not None:
            self.callback(stage, done, total)


Pose = Literal["result", "start", "nominal"]
"""The poses at which the points of a window can be projected."""


class Result:
    """Where the camera is, according to one window. Arrays are copies, so changing one does not change the result."""

    def __init__(self, solution: Solution) -> None:
        self._solution = solution
        self._document = solution.result

    def __repr__(self) -> str:
        reasons = "".join(f", {reason.code}" for reason in self.reasons)
        return f"<coec.Result {self.document.window_id}: {self.verdict.decision}{reasons}>"

    @property
    def document(self) -> CalibrationResult:
        """The whole result as a pydantic model: what `coec calibrate --json` prints, except how long it took."""
        return self._document

    @property
    def T_camera_lidar(self) -> NDArray[np.float64]:
        """(4, 4) float64: maps LiDAR coordinates (x forward, y left, z up) to camera coordinates (x right, y down,
        z forward), metres. Use it only if `accepted`."""
        return matrix_of(self.document.camera_from_lidar)

    @property
    def quaternion_xyzw(self) -> NDArray[np.float64]:
        """(4,) rotation of `T_camera_lidar`: unit quaternion, w last and not negative."""
        return np.array(self.document.camera_from_lidar.quaternion_xyzw)

    @property
    def translation_m(self) -> NDArray[np.float64]:
        """(3,) last column of `T_camera_lidar`, metres."""
        return np.array(self.document.camera_from_lidar.translation_m)

    @property
    def correction(self) -> NDArray[np.float64]:
        """(6,) rx ry rz (degrees) and tx ty tz (metres), about and along the camera axes, by which the result differs
        from the recording's own calibration: T_camera_lidar = exp(correction)·T_nominal."""
        return np.array(self.document.correction)

    @property
    def sigma(self) -> NDArray[np.float64]:
        """(6,) standard deviations of `correction`, degrees and metres; NaN where an axis was not estimated."""
        return np.array([np.nan if value is None else value for value in self.document.sigma])

    @property
    def covariance(self) -> NDArray[np.float64]:
        """(6, 6) covariance of the error about and along the camera axes, radians and metres: the true transform is
        exp(error)·T_camera_lidar. NaN where an axis was not estimated."""
        return self._solution.estimate.uncertainty.covariance.copy()

    @property
    def accepted(self) -> bool:
        """Whether the self-diagnosis accepts the result."""
        return self.document.verdict.decision == "accepted"

    @property
    def verdict(self) -> Verdict:
        """The decision (`accepted` or `failed`) and its reasons."""
        return self.document.verdict

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Why the result is not accepted: machine-readable codes with a sentence each. Empty if it is accepted."""
        return self.document.verdict.reasons

    @property
    def figures(self) -> dict[str, MetricReply]:
        """The figures of the self-diagnosis by name, each with its limit and whether it is within it."""
        return dict(self.document.metrics)

    @property
    def configuration(self) -> CalibrationConfig:
        """The settings that decided the result. Pass it to another `calibrate` to repeat them."""
        return self._solution.configuration

    @property
    def camera_fit(self) -> CameraFit | None:
        """How well the chosen `camera_model` fits the recording's camera; None if none was chosen."""
        return self._solution.fit

    @property
    def lens(self) -> Lens | None:
        """Focal length, principal point and first radial term as the window has them, with standard deviations; None
        with an objective without edges, or if the edges determine no pose. Nothing applies it."""
        return self.document.lens

    @property
    def weighed(self) -> Weighed | None:
        """How many poses were weighed without a start; None unless `start="none"`."""
        return self._solution.weighed

    @property
    def time_offset(self) -> TimeOffset | None:
        """Offset of the camera's clock, s; None unless `time_offset=True`."""
        return self._solution.offset

    def to_json(self) -> str:
        """Canonical JSON of `document`: equal results give equal bytes. `coec export` reads it. Its schema is
        `schemas/v1/CalibrationResult.json`."""
        return to_json(self.document).decode()

    def export(
        self,
        path: str | PathLike[str],
        *,
        format: str,
        parent: str | None = None,
        child: str | None = None,
        T_parent_lidar: NDArray[np.float64] | None = None,
        force: bool = False,
    ) -> Path:
        """Writes the result into a file of another program's format, completely or not at all. If the file exists and
        holds other transforms (URDF, Autoware's YAML and the like), only this transform is changed.

        Args:
            path: the file; its folder is made if it does not exist.
            format: `urdf`, `tf`, `autoware` or another that `coec export --help` lists. The file states the direction
                of its transform.
            parent: name of the parent frame; None: the LiDAR's.
            child: name of the child frame; None: the camera's.
            T_parent_lidar: (4, 4) pose of the LiDAR in `parent`, metres; None: the LiDAR is the parent.
            force: also write a result that is not accepted; the file says that it is not.

        Returns:
            The path of the file.

        Raises:
            NotAcceptedError: the verdict is negative, and `force` was not given.
            UsageError: no such format, or `T_parent_lidar` is no (4, 4) array of finite numbers.
            OutputError: the file cannot be written, or its present content cannot be changed.
            SourceError: the existing file cannot be read.
        """
        pose = None if T_parent_lidar is None else np.array(T_parent_lidar, dtype=np.float64)
        if pose is not None and (pose.shape != (4, 4) or not np.isfinite(pose).all()):
            raise UsageError(f"T_parent_lidar: (4, 4) finite numbers are expected, not {pose.shape}")
        camera = intrinsics_config(self._solution.window.rig.camera)
        extrinsic = extrinsic_of_result(self.document, camera, ExportFrames(parent, child, pose))
        require_accepted(extrinsic, self.document.window_id, "force=True", force=force)
        file = Path(fspath(path))
        user_files.replace_output(file, export_text(extrinsic, format, file).encode())
        return file

    def overlay(self, at: Pose = "result") -> NDArray[np.uint8]:
        """Draws the points of the sweep, coloured by range, over the middle camera frame of the window.

        Args:
            at: the pose at which the points are drawn: `result`, `start` (where the search began), or `nominal` (the
                recording's own calibration).

        Returns:
            (height, width, 3) uint8, RGB, as matplotlib's `imshow` and Pillow take it. It is somewhat higher than the
            image, and a small image is enlarged by a whole factor.

        Raises:
            DecodeError: the image cannot be decoded.
        """
        # Few programs draw.
        from coec.reports import pictures

        window = self._solution.window
        poses = {
            "result": self.T_camera_lidar,
            "start": window.T_camera_lidar_start,
            "nominal": window.rig.T_camera_lidar_nominal,
        }
        if at not in poses:
            raise UsageError(f"at={at!r}: known are {', '.join(poses)}")
        title = f"{self.document.window_id}: {self.verdict.decision if at == 'result' else at}"
        compensated = self.configuration.motion_compensation
        (image,) = pictures.overlays(window, [poses[at]], compensated)
        return np.ascontiguousarray(titled(image, title)[:, :, ::-1])


class Window:
    """Pairs of a camera frame and a LiDAR sweep from one slice of a drive: the input of one calibration. Made by
    `Recording.window` and `Recording.windows`."""

    def __init__(self, source: str, frames: int | None, loaded: LoadedWindow) -> None:
        self._source = source
        self._frames = frames
        self._loaded = loaded

    def __repr__(self) -> str:
        return f"<coec.Window {self.window_id}, {count(self.pairs, 'pair')}>"

    @property
    def window_id(self) -> str:
        """`<pair>-<stamp of the first camera frame, ns>`, or the recorded id."""
        return self._loaded.window.window_id

    @property
    def pairs(self) -> int:
        """Number of pairs."""
        return len(self._loaded.window.pairs)

    @property
    def stamps_ns(self) -> tuple[int, ...]:
        """Stamps of the camera frames, ascending, nanoseconds."""
        return tuple(pair.stamp_ns for pair in self._loaded.window.pairs)

    @property
    def unpaired(self) -> dict[str, int]:
        """Number of frames without a partner, by cause."""
        return dict(self._loaded.unpaired)

    @property
    def source(self) -> str:
        """The recording, as it was given to `coec.open`."""
        return self._source

    @property
    def frames(self) -> int | None:
        """The requested largest number of camera frames; None: the usual number."""
        return self._frames

    @property
    def loaded(self) -> LoadedWindow:
        """The window as the package itself passes it on. Not part of the stable interface."""
        return self._loaded

    @property
    def T_camera_lidar_start(self) -> NDArray[np.float64]:
        """(4, 4) pose at which a search starts, metres."""
        return self._loaded.window.T_camera_lidar_start.copy()

    def calibrate(self, **options: Unpack[CalibrationOptions]) -> Result:
        """Calibrates the window. The same window, network and configuration give the same result, to the byte.

        Args:
            options: as `coec.calibrate`, except `frames`: the window has its frames already.

        Raises:
            CoecError: as `coec.calibrate`.
        """
        checked(options)
        if options.get("frames") is not None:
            raise UsageError("frames: a window has its frames already; give the number to `Recording.window`")
        return Result(solve(self._loaded, options, CallbackProgress(options.get("progress"))))


@dataclass(frozen=True, slots=True)
class Description:
    """What a recording holds, as far as it is known without loading its frames. `str()` makes lines to print of it.

    Attributes:
        name: layout, drive, camera.
        pair: name of the camera-LiDAR pair.
        seconds: from the first camera frame to the last.
        camera, lidar, motion: number of frames, rate (Hz, of the median interval) and longest gap (s) of each stream.
            `motion` is None where the recording has no ego-motion; its sweeps are then not compensated.
        camera_model: name of the lens model, as in `dataset.yaml`.
        intrinsics: its parameters by name, with `width` and `height`; pixels where they have a unit.
        camera_frame, lidar_frame: names of the coordinate frames.
    """

    name: str
    pair: str
    seconds: float
    camera: Cadence
    lidar: Cadence
    motion: Cadence | None
    camera_model: str
    intrinsics: dict[str, float]
    camera_frame: str
    lidar_frame: str

    def __str__(self) -> str:
        width, height = self.intrinsics["width"], self.intrinsics["height"]
        motion = (
            "none" if self.motion is None else f"{count(self.motion.frames, 'sample')}, {self.motion.rate_hz:.2f} Hz"
        )
        # Names and frames are as the recording has them, and whoever prints this has a terminal that would obey them.
        return "\n".join(
            printable(line, None)
            for line in (
                f"{self.name}: {self.seconds:.1f} s of the pair {self.pair}",
                f"  camera  {count(self.camera.frames, 'frame')}, {self.camera.rate_hz:.2f} Hz  {self.camera_model}, "
                f"{width:.0f} x {height:.0f} px, frame {self.camera_frame}",
                f"  LiDAR   {count(self.lidar.frames, 'sweep')}, {self.lidar.rate_hz:.2f} Hz  frame {self.lidar_frame}",
                f"  motion  {motion}",
            )
        )


class Recording:
    """A recorded drive of one camera-LiDAR pair, made by `coec.open`."""

    def __init__(self, source: str, opened: Source) -> None:
        self._source = source
        self._opened = opened

    def __repr__(self) -> str:
        return f"<coec.Recording {Untrusted(self._opened.name)}>"

    @property
    def source(self) -> str:
        """The recording, as it was given to `coec.open`."""
        return self._source

    @property
    def name(self) -> str:
        """Layout, drive and camera, for people to read."""
        return self._opened.name

    @property
    def T_camera_lidar(self) -> NDArray[np.float64]:
        """(4, 4) the calibration that came with the recording, metres: maps LiDAR coordinates (x forward, y left, z up)
        to camera coordinates (x right, y down, z forward). A `correction` is relative to it."""
        return self._opened.rig.T_camera_lidar_nominal.copy()

    @property
    def camera_stamps_ns(self) -> tuple[int, ...]:
        """Stamps of the camera frames, ascending, nanoseconds."""
        return self._opened.camera_stamps_ns

    @property
    def seconds(self) -> float:
        """From the first camera frame to the last."""
        stamps_ns = self.camera_stamps_ns
        return (stamps_ns[-1] - stamps_ns[0]) / NS_PER_S if stamps_ns else 0.0

    @property
    def configuration(self) -> CalibrationConfig | None:
        """Configuration that a recorded window carries; None for every other recording."""
        return self._opened.configuration

    def describe(self) -> Description:
        """Streams, rates, camera and frames. Print it."""
        opened, rig = self._opened, self._opened.rig
        return Description(
            name=opened.name,
            pair=rig.pair,
            seconds=self.seconds,
            camera=cadence(opened.camera_stamps_ns),
            lidar=cadence(opened.sweep_stamps_ns),
            motion=cadence(opened.motion_stamps_ns) if opened.motion_stamps_ns else None,
            camera_model=name_of(rig.camera),
            intrinsics=dict(intrinsics_of(rig.camera)),
            camera_frame=rig.camera_frame,
            lidar_frame=rig.lidar_frame,
        )

    def truth(self, stamp_ns: int) -> NDArray[np.float64] | None:
        """(4, 4) true T_camera_lidar at a time, if the drive was simulated; else None."""
        return self._opened.truth(stamp_ns) if isinstance(self._opened, HasGroundTruth) else None

    def window(
        self,
        *,
        frames: int | None = None,
        between_s: tuple[float, float] | None = None,
        progress: Progress | None = None,
    ) -> Window:
        """Cuts one window: evenly spaced camera frames, each with the sweep nearest to it in time.

        Args:
            frames: how many camera frames at most; None: 25, or all that a recorded window has.
            between_s: (begin, end), seconds after the first frame of the recording; only frames between them are used,
                both ends included. None: the whole recording.
            progress: is called for the stage `load`.

        Raises:
            UsageError: `frames` is below 1, or `between_s` is no interval.
            SourceError: a file cannot be read, or no camera frame has a sweep near enough.
            WindowError: a recorded window is damaged.
        """
        if frames is not None and frames < 1:
            raise UsageError(f"frames={frames}: a window has at least one")
        begin_s, end_s = window_cutting.WHOLE if between_s is None else between_s
        if not 0.0 <= begin_s <= end_s:
            raise UsageError(f"between_s=({begin_s:g}, {end_s:g}): give seconds after the first frame, begin and end")
        stages = CallbackProgress(progress)

        def report(done: int, total: int) -> None:
            stages.step("load", done, total)

        usual = WindowConfig().pairs
        if self.configuration is None:
            loaded = window_cutting.window_of_recording(self._opened, frames or usual, report, (begin_s, end_s))
        else:  # a recorded window keeps its pairs
            loaded = window_cutting.load_window(self._source, frames, usual, report, (begin_s, end_s))
        return Window(self._source, frames, loaded)

    def windows(self, *, seconds: float = 60.0, frames: int | None = None) -> Iterator[Window]:
        """Cuts the recording into consecutive windows of `seconds` each. The last one takes the rest, which is half to
        one and a half times as long. A window is loaded when the loop comes to it. A slice in which no camera frame has
        a sweep is left out.

        Raises:
            UsageError: `seconds` is not above 0, or `frames` is below 1.
            SourceError, WindowError: as `window`.
        """
        if not 0.0 < seconds < inf:
            raise UsageError(f"seconds={seconds:g}: give a finite length above 0")
        count = max(1, round(self.seconds / seconds))
        for index in range(count):
            # `window` includes both ends; a frame on the border belongs to the window that begins there.
            end_s = inf if index == count - 1 else float(np.nextafter((index + 1) * seconds, 0.0))
            with suppress(NoPairsError):
                yield self.window(frames=frames, between_s=(index * seconds, end_s))

    def calibrate(self, **options: Unpack[CalibrationOptions]) -> Result:
        """Calibrates the recording's window of at most `frames` camera frames (None: 25).

        Args:
            options: as `coec.calibrate`.

        Raises:
            CoecError: as `window` and `coec.calibrate`.
        """
        checked(options)
        frames = options.pop("frames", None)
        return self.window(frames=frames, progress=options.get("progress")).calibrate(**options)
