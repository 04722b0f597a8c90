"""Makes a window of a SOURCE, as the service would have cut it, and adds the thinned pairs between its own from a
recording that holds more than the window.
"""

import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames import evidence
from coec.calibration.frames.pairing import Pairer
from coec.calibration.frames.window import BetweenPairs
from coec.calibration.rig import nearest_neighbours
from coec.calibration.rig.lidar_odometry import MAX_SEPARATION_S, motions_of_sweeps
from coec.calibration.types import (
    MOUNT_RAD,
    NS_PER_S,
    CameraFrame,
    Frame,
    FramePair,
    LidarFrame,
    Matrix4,
    Recognition,
    Rig,
    Window,
)
from coec.config import CalibrationConfig, Config, LimitsConfig, PairingConfig, WindowConfig
from coec.errors import DecodeError, MisreadError, SourceError, UsageError
from coec.geometry import se3
from coec.geometry.cameras import Camera
from coec.geometry.projection import half_field_of_view_rad
from coec.io.frame_validation import Refusal
from coec.io.images import CompressingReducer, decode_grey_reduced
from coec.io.mcap.windows import is_window, read_result, read_window
from coec.io.recordings.bag_recognition import as_compensated, compensated
from coec.io.recordings.clocks import clock_separation_text, clocks_text
from coec.io.recordings.layouts import RecordingSource, open_source
from coec.io.recordings.recording_source import (
    IMAGE,
    RECORD,
    DamagedFrames,
    damaged_of,
    evenly_spread,
    parse_spec,
    recognitions_of,
)

WHOLE = (0.0, math.inf)
"""Begin and end of the whole recording, in seconds after the first camera frame."""

HALF_TURN_DEG = 180.0
FARTHEST_M = 50.0
"""Largest distance of two sensors on a road or rail vehicle. A larger number was given in other units."""

RECORDED_GAP_S = 1e9
"""Largest gap between frames that are chosen from a recording, s: practically any, because their order is certain."""


class NoPairsError(SourceError):
    """No pair can be made of the chosen camera frames, or there are none."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadedWindow:
    """A window and what came with it.

    Attributes:
        configuration: configuration of a recorded window; None for other recordings.
        vehicle: vehicle of a recorded window that holds its result; else the default name.
        unpaired: number of frames that found no partner, by cause.
        recognitions: what was recognised of the recording.
    """

    window: Window
    configuration: CalibrationConfig | None
    vehicle: str
    unpaired: dict[str, int]
    recognitions: tuple[Recognition, ...] = ()


def load_window(
    source: str,
    frames: int | None,
    default_frames: int,
    on_progress: Callable[[int, int], None],
    between_s: tuple[float, float] = WHOLE,
) -> LoadedWindow:
    """The window of a SOURCE. A recorded window's file gives its own window. From any other recording, at most `frames`
    (`default_frames` if None) camera frames are chosen evenly and paired. `on_progress(done, total)` counts camera
    frames. Only camera frames from `between_s` (begin, end) seconds after the first one are used.

    Raises:
        UsageError, SourceError, WindowError: see `open_source`. SourceError also if no camera frame has a sweep.
    """
    spec = parse_spec(source)
    if (
        spec.layout is None
        and not spec.query
        and spec.path.suffix == ".mcap"
        and spec.path.is_file()
        and is_window(spec.path)
    ):
        return _recorded(spec.path, frames, between_s)
    return window_of_recording(open_source(source), frames or default_frames, on_progress, between_s)


def window_of_recording(
    recording: RecordingSource,
    frames: int,
    on_progress: Callable[[int, int], None],
    between_s: tuple[float, float] = WHOLE,
) -> LoadedWindow:
    """The window of an open recording: at most `frames` of its camera frames, evenly chosen and paired. `on_progress`
    and `between_s` as in `load`. The recording's own extrinsic counts as one in use, not as a guess.

    Raises:
        SourceError: a file cannot be read, or no camera frame has a sweep.
    """
    left, damaged = _within(recording.camera_stamps_ns, between_s), damaged_of(recording)
    requested = min(len(left), frames)
    pairs: list[FramePair] = []
    losses: Counter[str] = Counter()
    while len(pairs) < requested and left:
        selected = [left[index] for index in evenly_spread(len(left), requested - len(pairs))]
        known = len(damaged)
        pairer = Pairer(PairingConfig(max_stamp_jump_s=RECORDED_GAP_S), expects_motion=True)
        for message in readable(recording.messages(selected), damaged):
            pairs += pairer.push(message)
            on_progress(len(pairs), requested)
        pairs = _of_size(recording.rig.camera, [*pairs, *pairer.flush()], damaged)
        losses.update(pairer.losses)
        left = sorted(set(left) - set(selected))
        if len(damaged) == known:
            break  # others would lack a partner, too
    on_progress(len(pairs), requested)
    pairs.sort(key=lambda pair: pair.stamp_ns)
    least = min(WindowConfig().min_pairs, (requested + 1) // 2)
    if len(pairs) < least and requested - len(pairs) <= len(damaged):
        raise NoPairsError(f"{recording.name}: only {len(pairs)} of {requested} pairs can be read: {damaged.text}")
    if not pairs:
        raise NoPairsError(
            f"{recording.name}: none of {requested} camera frames has a sweep within "
            f"{PairingConfig().tolerance_s} s: {clocks_text(recording.camera_stamps_ns, recording.sweep_stamps_ns)}"
        )
    rig, pairs, of_motion = _with_motion(recording, pairs)
    window_id = f"{rig.pair}-{pairs[0].stamp_ns}"
    window = Window(window_id, rig, recording.T_camera_lidar_start, tuple(pairs), MOUNT_RAD)
    recognised = (*recognitions_of(recording, (pair.lidar for pair in pairs)), *of_motion)
    separate = clock_separation_text(recording.camera_stamps_ns, recording.sweep_stamps_ns)
    if separate:
        recognised = (Recognition("clocks_apart", f"Frames find the wrong sweeps: {separate}.", "fail"), *recognised)
    unpaired = {cause: number for cause, number in losses.items() if number}
    return LoadedWindow(window, recording.configuration, _default_vehicle(), unpaired, recognised)


def _with_motion(
    recording: RecordingSource, pairs: list[FramePair]
) -> tuple[Rig, list[FramePair], tuple[Recognition, ...]]:
    """The rig and the pairs of a recording without ego-motion, with the motion of its LiDAR from sweep to sweep, and
    what to tell; unchanged where its sweeps were not taken one after the other on a moving vehicle, or have no times of
    points to compensate."""
    rig, stamps_ns = recording.rig, recording.sweep_stamps_ns
    timed = all(pair.lidar.time_offset_s is not None and np.ptp(pair.lidar.time_offset_s) > 0.0 for pair in pairs)
    neighbours = [_neighbour(stamps_ns, pair.lidar.stamp_ns) for pair in pairs]
    known = [stamp_ns for stamp_ns in neighbours if stamp_ns is not None]
    measurable = known and (timed or rig.sweep) and not recording.motion_stamps_ns
    if not measurable or evidence.stands([pair.lidar for pair in pairs]):
        return rig, pairs, ()
    if not nearest_neighbours.installed():
        text = (
            "No ego-motion: sweeps taken while driving are not compensated. With the optional extra `lidars` "
            "(pip install 'coec[lidars]') it is measured from sweep to sweep."
        )
        return rig, pairs, (Recognition("motion_unknown", text, "warn"),)
    sweeps: dict[int, LidarFrame] = {}
    try:
        sweeps.update((sweep.stamp_ns, sweep) for sweep in recording.sweeps(known))
    except MisreadError:
        raise
    except SourceError:
        pass  # every one is damaged, and counted as such
    consecutive = [
        (first, second) if first.stamp_ns < second.stamp_ns else (second, first)
        for pair, stamp_ns in zip(pairs, neighbours, strict=True)
        for first, second in ((pair.lidar, sweeps.get(stamp_ns or 0, pair.lidar)),)
    ]
    motions = list(motions_of_sweeps(consecutive, rig.sweep))
    measured = sum(motion is not None for motion in motions)
    if not measured:
        text = (
            "No ego-motion is recorded, and registering sweeps determines none: sweeps taken while driving are not "
            "compensated. Record the odometry."
        )
        return rig, pairs, (Recognition("motion_unknown", text, "warn"),)
    text = f"No ego-motion is recorded: it is measured by registering sweeps, for {measured} of {len(pairs)} pairs."
    moving = [replace(pair, motion=motion) for pair, motion in zip(pairs, motions, strict=True)]
    known_motions = [motion for motion in motions if motion is not None]
    instant, of_points = compensated([pair.lidar for pair in pairs], known_motions, np.eye(4), "?compensated=no")
    if instant is not None:
        moving = [replace(pair, lidar=as_compensated(pair.lidar, instant)) for pair in moving]
    recognised = (Recognition("motion_registered", text), *(() if of_points is None else (of_points,)))
    return replace(rig, T_lidar_ego=np.eye(4)), moving, recognised


def _neighbour(stamps_ns: Sequence[int], stamp_ns: int) -> int | None:
    """The stamp next to one of several, ascending, within `MAX_SEPARATION_S`; the later one if both are."""
    place = bisect_left(stamps_ns, stamp_ns)
    for other in (*stamps_ns[place + 1 : place + 2], *stamps_ns[max(place - 1, 0) : place]):
        if 0 < abs(other - stamp_ns) <= MAX_SEPARATION_S * NS_PER_S:
            return other
    return None


def _of_size(camera: Camera, pairs: Sequence[FramePair], damaged: DamagedFrames) -> list[FramePair]:
    """The pairs whose images have the size of the intrinsics, if any have; those of others are damaged."""
    size = camera.width, camera.height
    fitting = [pair for pair in pairs if (pair.camera.image.width, pair.camera.image.height) == size]
    for pair in pairs if fitting else ():
        image = pair.camera.image
        if (image.width, image.height) != size:
            text = f"the image at {pair.camera.stamp_ns} ns has {image.width} x {image.height} px"
            damaged.add(IMAGE, pair.camera.stamp_ns, DecodeError(Refusal.IMAGE_SIZE_MISMATCH, text))
    return fitting or list(pairs)


def readable(frames: Iterable[Frame], damaged: DamagedFrames) -> Iterator[Frame]:
    """The frames without images whose pixels cannot be decoded, which are added to `damaged`."""
    limits = LimitsConfig(max_image_pixels=2**30)
    for frame in frames:
        try:
            if isinstance(frame, CameraFrame):
                decode_grey_reduced(frame.image, limits)
        except DecodeError as error:
            damaged.add(IMAGE, frame.stamp_ns, error)
        else:
            yield frame


def parse_perturbation(option: str, text: str) -> NDArray[np.float64]:
    """ξ (6,) in radians and metres from the value of an option, `rx,ry,rz[,tx,ty,tz]` in degrees and metres.

    Raises:
        UsageError: these are not three or six finite numbers, or larger than any mount has; names the option.
    """
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError as error:
        raise UsageError(f"{option} {text}: give numbers with commas between, as 1,0,-0.5") from error
    return perturbation_vector(f"{option} {text}", values)


def perturbation_vector(what: str, values: Sequence[float]) -> NDArray[np.float64]:
    """ξ (6,) in radians and metres from `rx, ry, rz[, tx, ty, tz]` in degrees and metres.

    Raises:
        UsageError: these are not three or six finite numbers, or larger than any mount has; begins with `what`.
    """
    if len(values) not in (3, 6) or not np.isfinite(values).all():
        raise UsageError(f"{what}: give three finite numbers (degrees), or six (degrees, then metres)")
    xi = np.zeros(6)
    xi[: len(values)] = values
    if np.abs(xi[:3]).max() > HALF_TURN_DEG or np.abs(xi[3:]).max() > FARTHEST_M:
        raise UsageError(
            f"{what}: at most {HALF_TURN_DEG:g} degrees, then at most {FARTHEST_M:g} metres (not millimetres)"
        )
    xi[:3] = np.radians(xi[:3])
    return xi


def with_perturbed_start(window: Window, xi: NDArray[np.float64]) -> Window:
    """The window with its start moved by ξ (6,), applied on the left. The start then counts as a mere guess."""
    start = se3.perturb(window.T_camera_lidar_start, xi)
    return replace(window, T_camera_lidar_start=start, start_known_to_rad=math.pi)


def rotation_error_deg(T_a: Matrix4, T_b: Matrix4) -> float:
    """Geodesic angle between the rotations of two transforms (4, 4)."""
    return float(np.degrees(se3.rotation_angle_rad(T_a @ se3.inverse(T_b))))


def _within(stamps_ns: Sequence[int], between_s: tuple[float, float]) -> list[int]:
    """Indices of the stamps (ascending, nanoseconds) that lie `between_s` (begin, end) seconds after the first one."""
    first_s, last_s = between_s
    return [index for index, stamp in enumerate(stamps_ns) if first_s <= (stamp - stamps_ns[0]) * 1e-9 <= last_s]


def _recorded(path: Path, frames: int | None, between_s: tuple[float, float]) -> LoadedWindow:
    damaged = DamagedFrames()
    window, configuration = read_window(path, partial(damaged.add, RECORD))
    within = _within([pair.stamp_ns for pair in window.pairs], between_s)
    if not within:
        raise NoPairsError(f"{path}: no pair was recorded {between_s[0]:g} to {between_s[1]:g} s after the first")
    window = replace(window, pairs=tuple(window.pairs[index] for index in within))
    if frames is not None:
        window = replace(window, pairs=tuple(window.pairs[index] for index in evenly_spread(len(window.pairs), frames)))
    result = read_result(path)
    vehicle = result.vehicle if result else _default_vehicle()
    return LoadedWindow(window, configuration, vehicle, {}, damaged.recognitions)


def _default_vehicle() -> str:
    return str(Config.model_fields["vehicle"].default)


def with_thinned_pairs(window: Window, recording: RecordingSource, config: WindowConfig) -> Window:
    """The window with the pairs between its own that the daemon would have recorded, taken from a recording that holds
    them. The window's slice runs from its first to its last pair.

    Raises:
        SourceError: a file cannot be read.
    """
    stamps_ns = [pair.stamp_ns for pair in window.pairs]
    rig = window.rig
    lit = rig.mask if rig.mask is not None else np.ones((rig.camera.height, rig.camera.width), np.bool_)
    picked = BetweenPairs(CompressingReducer(LimitsConfig()), half_field_of_view_rad(rig.camera, lit))
    # From the first of n pairs to the last there are n - 1 intervals; a slice of n pairs has n.
    of_window = config.model_copy(update={"pairs": max(1, len(stamps_ns) - 1)})
    picked.begin(of_window, stamps_ns[0], stamps_ns[-1] - stamps_ns[0])
    own, between = set(stamps_ns), []
    for pair in _pairs(recording, window, config):
        if pair.stamp_ns in own:
            picked.on_selected(pair.stamp_ns)
        elif (thinned := picked.offer(pair, window.T_camera_lidar_start)) is not None:
            between.append(thinned)
    return replace(window, between=tuple(between))


def _pairs(recording: RecordingSource, window: Window, config: WindowConfig) -> list[FramePair]:
    """The pairs of the window, and those between them at the configured distance (`between_s`)."""
    own, selected, last_ns = {pair.stamp_ns for pair in window.pairs}, [], window.pairs[0].stamp_ns
    for index, stamp_ns in enumerate(recording.camera_stamps_ns):
        if not window.pairs[0].stamp_ns <= stamp_ns <= window.stamp_ns:
            continue
        if stamp_ns in own or stamp_ns - last_ns >= round(config.between_s * NS_PER_S):
            selected.append(index)
            last_ns = stamp_ns
    pairer = Pairer(PairingConfig(max_stamp_jump_s=RECORDED_GAP_S), expects_motion=True)
    pairs = [pair for message in recording.messages(selected) for pair in pairer.push(message)]
    return [*pairs, *pairer.flush()]
