"""What a recording holds and what it is good for, before anyone waits for a calibration.

The stamps of all frames are known without loading them; only a few frames, evenly chosen, are loaded.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from types import MappingProxyType
from typing import Literal

import numpy as np

from coec.calibration import types
from coec.calibration.frames.pairing import Pairer
from coec.calibration.monitor.check_verdict import MIN_PAIRS
from coec.config import PairingConfig, WindowConfig
from coec.geometry.cameras import Camera, domain_angle_rad, project_point, unproject_point
from coec.geometry.points import lengths
from coec.geometry.projection import share_in_image
from coec.io.images import is_order_swapped
from coec.io.recordings.clocks import clock_separation_text, clocks_text
from coec.io.recordings.recording_source import (
    HasGroundTruth,
    RecordingSource,
    damaged_of,
    evenly_spread,
    recognitions_of,
)
from coec.io.recordings.window_cutting import readable

NS_PER_S = 1e9

SAMPLED_FRAMES = 12
"""Camera frames that are loaded."""

LITTLE_IN_VIEW = 0.03
"""Share of a sweep's points in view below which there is a remark. A 60° camera sees a tenth of a turning LiDAR's."""

SOME_NOT_FINITE = 0.01
"""Share of points without a finite position from which on there is a remark."""

SMEARING_MPS = 1.0
"""Above this speed an uncompensated sweep of 0.1 s smears near objects by more than the spacing of its beams."""

MOSTLY = 0.5
"""Below this share of pairs with ego-motion there is a remark."""

OFF_MIDDLE = 0.3
"""Distance of a principal point from the middle of the image, as a share of half the image, from which on it is of
another image. Those of lenses lie within 0.1; cropped images differ by more."""

NARROWEST_CIRCLE_RAD = math.radians(80.0)
"""A lens whose image circle ends within the image sees at least so far from its axis. A model that ends before is a
polynomial that turns back."""

MANY_GAPS = 3.0
"""A gap between frames is long from this many median intervals on."""

FEW_PASSES = range(2, 9)
"""How often the times run through in a cloud joined from several LiDARs; in a cloud stored row by row, more often."""

Level = Literal["ok", "warn", "fail"]


@dataclass(frozen=True, slots=True)
class Cadence:
    """Timing of one stream: frames, Hz (from the median interval), and its longest gap, seconds."""

    frames: int
    rate_hz: float
    longest_gap_s: float


@dataclass(frozen=True, slots=True)
class Notice:
    """Something that a person should know: a machine-readable code, and a sentence that says what to do."""

    level: Level
    code: str
    text: str


@dataclass(frozen=True, slots=True)
class Fitness:
    """A recording, as far as it was looked at.

    Attributes:
        seconds: from its first camera frame to its last.
        camera, lidar, motion: cadence of the streams; motion None where there is none.
        width, height: of the images, pixels.
        points, rings: of a sweep, medians; 0 rings where there are none.
        range_m: (near, far) within which nine of ten points lie.
        passes: how often the times run from the begin of a sweep to its end, in the order in which points are stored,
            median; 0 without times.
        point_time: whether points carry their own time, or the rig knows the sweep's.
        timed_by: how the times of points were read, in a line; empty where there is no doubt.
        speed_mps, turn_degps: (median, most) of the vehicle; None where the ego-motion does not tell.
        with_motion: share of the pairs whose ego-motion is known; 0 without pairs.
        standing: share of the pairs that were taken while the vehicle stood; None where the speed is unknown.
        paired: share of the frames looked at that found a sweep.
        sync_ms: (median, most) of camera stamp minus sweep stamp, milliseconds.
        in_view: share of a sweep's points that the nominal extrinsic puts into the image, median.
        not_finite: share of a sweep's points that have no finite position or time, and are left out, median.
        clocks: how far the stamps of the streams are apart, in a line; empty where frames find a sweep, unless the two
            streams begin and end at different times.
        remarks: the most important first.
    """

    seconds: float
    camera: Cadence
    lidar: Cadence
    motion: Cadence | None
    width: int
    height: int
    points: int
    rings: int
    range_m: tuple[float, float]
    passes: int
    point_time: bool
    timed_by: str
    speed_mps: tuple[float, float] | None
    turn_degps: tuple[float, float] | None
    with_motion: float
    standing: float | None
    paired: float
    sync_ms: tuple[float, float] | None
    in_view: float
    not_finite: float
    clocks: str
    remarks: tuple[Notice, ...]


MOST_EXAMINED = 400
"""Camera frames that are read with their sweeps to find damaged ones, evenly selected."""


def find_damaged(recording: RecordingSource, on_progress: Callable[[int, int], None]) -> None:
    """Reads a recording through, so that it knows of its damaged frames; `on_progress(done, total)` counts images.

    Raises:
        SourceError: no frame of a kind can be read.
    """
    if isinstance(recording, HasGroundTruth):
        return  # it is simulated while it is read
    examined = evenly_spread(len(recording.camera_stamps_ns), MOST_EXAMINED)
    seen = 0
    for frame in readable(recording.messages(examined), damaged_of(recording)):
        seen += isinstance(frame, types.CameraFrame)
        on_progress(seen, len(examined))


def fitness_of(recording: RecordingSource) -> Fitness:
    """What a recording holds, and remarks on it.

    Raises:
        SourceError: a file cannot be read, or a cloud contradicts its origin; names the file.
    """
    stamps_ns = recording.camera_stamps_ns
    sampled = evenly_spread(len(stamps_ns), min(SAMPLED_FRAMES, len(stamps_ns)))
    pairer = Pairer(PairingConfig(max_stamp_jump_s=1e9), expects_motion=bool(recording.motion_stamps_ns))
    pairs: list[types.FramePair] = []
    sweeps: list[types.LidarFrame] = []
    motions: list[types.EgoMotion] = []
    image: types.CameraFrame | None = None
    for message in readable(recording.messages(sampled), damaged_of(recording)):
        match message:
            case types.CameraFrame():
                image = message
            case types.LidarFrame():
                sweeps.append(message)
            case types.EgoMotion():
                motions.append(message)
        pairs += pairer.push(message)
    pairs += pairer.flush()
    rig = recording.rig
    moving = _known(pair.motion.speed_mps for pair in pairs if pair.motion is not None)
    standing = None if not moving else float(np.mean(np.array(moving) < WindowConfig().min_speed_mps))
    sync_ms = np.array([(pair.camera.stamp_ns - pair.lidar.stamp_ns) / 1e6 for pair in pairs])
    ranges_m = np.concatenate([lengths(sweep.xyz_m) for sweep in sweeps] or [np.zeros(1, np.float32)])
    near, far = np.percentile(ranges_m[ranges_m > 0.0] if ranges_m.any() else ranges_m, [5, 95]).tolist()
    in_view = [share_in_image(rig.camera, rig.T_camera_lidar_nominal, sweep.xyz_m) for sweep in sweeps]
    seen = Fitness(
        seconds=(stamps_ns[-1] - stamps_ns[0]) / NS_PER_S if stamps_ns else 0.0,
        camera=cadence(stamps_ns),
        lidar=cadence(recording.sweep_stamps_ns),
        motion=cadence(recording.motion_stamps_ns) if recording.motion_stamps_ns else None,
        width=rig.camera.width if image is None else image.image.width,
        height=rig.camera.height if image is None else image.image.height,
        points=_median([len(sweep.xyz_m) for sweep in sweeps]),
        rings=_median([0 if sweep.ring is None else len(np.unique(sweep.ring)) for sweep in sweeps]),
        range_m=(near, far),
        passes=_median([passes(sweep) for sweep in sweeps]),
        point_time=rig.sweep is not None or any(sweep.time_offset_s is not None for sweep in sweeps),
        timed_by=next((sweep.timed_by for sweep in sweeps), ""),
        speed_mps=_spread(_known(motion.speed_mps for motion in motions)),
        turn_degps=_spread([float(np.degrees(np.linalg.norm(motion.angular_radps))) for motion in motions]),
        with_motion=float(np.mean([pair.motion is not None for pair in pairs])) if pairs else 0.0,
        standing=standing,
        paired=len(pairs) / len(sampled) if sampled else 0.0,
        sync_ms=(float(np.median(sync_ms)), float(np.abs(sync_ms).max())) if len(sync_ms) else None,
        in_view=float(np.median(in_view)) if in_view else 0.0,
        not_finite=float(np.median([_not_finite(sweep) for sweep in sweeps])) if sweeps else 0.0,
        clocks=(clock_separation_text if pairs else clocks_text)(stamps_ns, recording.sweep_stamps_ns),
        remarks=(),
    )
    recognised = [Notice(one.level, one.code, one.text) for one in recognitions_of(recording, sweeps)]
    recognised += [*lens_notices(rig.camera), *([] if image is None else image_notices(image.image))]
    remarks = [notice for notice in (*recognised, *_remarks(seen)) if notice is not None]
    return replace(seen, remarks=tuple(sorted(remarks, key=lambda notice: _ORDER[notice.level])))


def pairs_of_calibration(seen: Fitness) -> int:
    """How many pairs `coec calibrate` finds in a recording, about."""
    return round(seen.paired * min(seen.camera.frames, WindowConfig().pairs))


_GAIN: Mapping[str, float] = MappingProxyType(
    {
        "range_edges": 1.0,
        "edge_contrast": 0.5,
        "edges_once": 0.5,
        "range_significance": 0.5,
        "mi_over_unrelated": 0.5,
        "runner_up": -0.5,
        "sigma_deg": -1.0,
        "sigma_m": -1.0,
        types.INTRINSICS_OFF: -0.5,
        types.MOVED: -0.5,
    }
)
"""The power of the number of pairs with which a figure changes at best: if every pair is independent, no error is
common to all, and what contradicts the rig does so by chance. σ falls faster than by the root, because few pairs hardly
show how far they scatter. Figures that are not listed stay as they are."""


CLOSE = 1.1
"""A figure within this factor of its limit may be on the other side of it from another start."""


def reasons_that_stay(trial: types.Estimate, pairs: int) -> tuple[types.Reason, ...]:
    """The reasons for which a trial was refused that would refuse a calibration of so many `pairs` of the same
    recording, too, from any start and even if each pair more were as good as any."""
    times = max(pairs / trial.pairs, 1.0)
    metrics = {metric.name: metric for metric in trial.verdict.metrics}

    def stays(code: str) -> bool:
        metric = metrics.get(code)
        if metric is None or not isfinite(metric.value):
            return times == 1.0
        at_best = metric.value * times ** _GAIN.get(code, 0.0)
        return not replace(metric, value=at_best * CLOSE if metric.at_least else at_best / CLOSE).passed

    # That a window needs motion is said of the others.
    staying = tuple(reason for reason in trial.verdict.reasons if reason.code != "motion" and stays(reason.code))
    advice = tuple(reason for reason in trial.verdict.reasons if reason.code == "motion")
    return (*staying, *advice) if staying else ()


def cadence(stamps_ns: Sequence[int]) -> Cadence:
    """Timing of a stream from its ascending stamps, nanoseconds. With fewer than two, rate and gap are 0."""
    if len(stamps_ns) < 2:
        return Cadence(len(stamps_ns), 0.0, 0.0)
    gaps_s = np.diff(np.array(stamps_ns, dtype=np.int64)) / NS_PER_S
    median_s = float(np.median(gaps_s))
    return Cadence(len(stamps_ns), 1.0 / median_s if median_s > 0.0 else 0.0, float(gaps_s.max()))


def passes(sweep: types.LidarFrame) -> int:
    """How often the times of a sweep's points run through, in the order in which the points are stored: one more than
    they begin anew; 0 without times."""
    times_s = sweep.time_offset_s
    if times_s is None or len(times_s) == 0:
        return 0
    span_s = float(times_s.max() - times_s.min())
    return 1 + int((np.diff(times_s) < -0.5 * span_s).sum())


_ORDER: dict[Level, int] = {"fail": 0, "warn": 1, "ok": 2}


def _remarks(seen: Fitness) -> Iterator[Notice | None]:
    if seen.camera.frames < MIN_PAIRS:
        yield Notice("fail", "too_few_frames", f"{seen.camera.frames} camera frames; a calibration needs {MIN_PAIRS}.")
    yield _unpaired(seen)
    if seen.in_view < LITTLE_IN_VIEW:
        text = (
            f"{seen.in_view:.1%} of the points lie in the image at the nominal extrinsic: is it from LiDAR to camera?"
        )
        yield Notice("fail" if seen.in_view == 0.0 else "warn", "little_in_view", text)
    if seen.not_finite >= SOME_NOT_FINITE:
        text = (
            f"{seen.not_finite:.0%} of the points have no finite position or time and are left out. This is so in "
            "organised clouds, where a beam without an echo gives NaN; if yours is none, see to its driver or filter."
        )
        yield Notice("ok", "not_finite", text)
    yield _motion(seen)
    if seen.standing is not None and seen.standing >= 0.5:
        text = f"The vehicle stood in {seen.standing:.0%} of the pairs: they count as few looks."
        yield Notice("warn", "standing", text)
    if seen.rings == 1:
        text = "The field `ring` holds one number and is ignored: beams are distinguished by their elevation."
        yield Notice("warn", "constant_ring", text)
    if seen.rings <= 0 and seen.passes in FEW_PASSES:
        text = (
            f"The points' times begin anew {seen.passes} times in a sweep, and no ring tells beams apart: if the cloud "
            "is of several LiDARs (concatenated), take the topic of one."
        )
        yield Notice("warn", "perhaps_concatenated", text)
    for name, stream in (("camera", seen.camera), ("LiDAR", seen.lidar)):
        if stream.rate_hz > 1.0 and stream.longest_gap_s * stream.rate_hz > MANY_GAPS:
            text = f"The {name} is silent for {stream.longest_gap_s:.1f} s, at {stream.rate_hz:.1f} Hz otherwise."
            yield Notice("ok", "gaps", text)
            break


def _unpaired(seen: Fitness) -> Notice | None:
    tolerance_ms = 1e3 * PairingConfig().tolerance_s
    if seen.paired == 0.0:
        return Notice("fail", "no_pairs", f"No camera frame has a sweep within {tolerance_ms:.0f} ms: {seen.clocks}.")
    if seen.clocks:
        return Notice("fail", "clocks_apart", f"Frames find the wrong sweeps: {seen.clocks}.")
    if seen.paired < 0.9:
        return Notice("warn", "few_pairs", f"{1 - seen.paired:.0%} of the camera frames have no sweep near them.")
    return None


def image_notices(image: types.EncodedImage) -> list[Notice]:
    """What is doubtful about an image by itself: bytes of YUV 4:2:2 in the other order."""
    if not is_order_swapped(image):
        return []
    text = (
        f"What counts as brightness in the {image.format.value} images hardly changes, and what counts as colour does: "
        "the bytes of YUV 4:2:2 are probably in the other order (uyvy for yuyv, or the reverse). Let the camera's "
        "driver state its encoding."
    )
    return [Notice("warn", "yuv_order", text)]


def lens_notices(camera: Camera) -> list[Notice]:
    """What is doubtful about a lens by itself: a principal point of an image of another size, and a distortion that
    ends before the corners."""
    width, height, cx, cy = camera.width, camera.height, camera.cx, camera.cy
    notices = []
    across, down = (2.0 * cx + 1.0) / width, (2.0 * cy + 1.0) / height
    if max(abs(across - 1.0), abs(down - 1.0)) > OFF_MIDDLE:
        of_other = abs(across - down) < 0.1 * across
        cause = (
            f"it is that of an image {across:.2g} times as large: scale fx, fy, cx and cy, or correct the binning"
            if of_other
            else "check cx and cy, and whether the images are cropped"
        )
        text = (
            f"The principal point ({cx:.0f}, {cy:.0f}) is far from the middle of the {width} x {height} image: {cause}."
        )
        notices.append(Notice("warn", "principal_point", text))
    corners = [(u, v) for u in (0.0, width - 1.0) for v in (0.0, height - 1.0)]
    limit_rad = domain_angle_rad(camera)
    if limit_rad < NARROWEST_CIRCLE_RAD and not all(unproject_point(camera, u, v)[3] for u, v in corners):
        inside_rad = limit_rad * (1.0 - 1e-6)
        end_px = project_point(camera, math.sin(inside_rad), 0.0, math.cos(inside_rad))[0] - cx
        corner_px = max(math.hypot(u - cx, v - cy) for u, v in corners)
        text = (
            f"The lens model ends {math.degrees(limit_rad):.1f} deg from the axis, {end_px:.0f} px from the principal "
            f"point; the corners are {corner_px:.0f} px away. It was fitted to the inner part of the image: calibrate "
            "the lens with points up to the corners."
        )
        notices.append(Notice("warn", "lens_ends", text))
    return notices


def _not_finite(sweep: types.LidarFrame) -> float:
    return sweep.not_finite / (sweep.not_finite + len(sweep.xyz_m))


def _motion(seen: Fitness) -> Notice | None:
    if seen.motion is None:
        text = (
            "No ego-motion is recorded. A calibration measures it where sweeps with times of points follow each other "
            "within 0.3 s (extra `lidars`); other sweeps taken while driving are not compensated."
        )
        return Notice("warn", "no_ego_motion", text)
    if seen.paired > 0.0 and seen.with_motion < MOSTLY:
        text = (
            f"{1 - seen.with_motion:.0%} of the pairs have no ego-motion within "
            f"{1e3 * PairingConfig().motion_tolerance_s:.0f} ms, so that they cannot be compensated: the stamps of the "
            "motion must be of the clock of the images, and go on without gaps."
        )
        return Notice("warn", "motion_apart", text)
    if seen.speed_mps is None and seen.turn_degps is not None:
        text = "Ego-motion is rotation only: sweeps are turned back, not shifted; drive slowly, or add an odometry."
        return Notice("warn", "rotation_only", text)
    if not seen.point_time and seen.speed_mps is not None and seen.speed_mps[1] > SMEARING_MPS:
        text = "Points have no time and the rig no sweep timing: sweeps taken while driving cannot be compensated."
        return Notice("warn", "no_point_time", text)
    return None


def _median(counts: Sequence[int]) -> int:
    return int(np.median(counts)) if counts else 0


def _known(values: Iterable[float | None]) -> list[float]:
    """The values that are not None."""
    return [value for value in values if value is not None]


def _spread(values: Sequence[float]) -> tuple[float, float] | None:
    return (float(np.median(values)), float(np.max(values))) if values else None
