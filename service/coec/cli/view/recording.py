"""Shows a recording to viewers, as fast as it was recorded, and a candidate: a calibration that is not served."""

import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from coec.calibration.frames.pairing import Pairer
from coec.calibration.types import FramePair, Matrix4, Rig
from coec.config import LimitsConfig, PairingConfig
from coec.errors import DecodeError, SourceError
from coec.geometry import se3
from coec.geometry.se3 import is_rigid
from coec.io import viewer_scene
from coec.io.foxglove import ViewerServer
from coec.io.recordings.layouts import RecordingSource
from coec.io.recordings.window_cutting import RECORDED_GAP_S
from coec.io.serialise import degrees_or_null, matrix_of
from coec.io.user_files import read_bytes
from coec.io.zenoh.player import repeated, shifted
from coec.schemas.message import from_json
from coec.schemas.replies import CalibrationResult, MetricReply

NS_PER_S = 1_000_000_000

AGAIN_S = 1.0
"""Time between two lines of the timeline, and between two redraws of the pair for viewers who connected since."""

POLL_S = 0.05
"""Time between two checks whether there is a viewer."""

DEFAULT_PERIOD_NS = 100_000_000
"""Time between two passes of a recording with a single frame: 10 Hz."""

MAX_BYTES = 2**20
"""Most bytes of a result, which has some 5 kB."""

STALE: Final = 3
"""ROS level of an unknown state."""

EXPLANATIONS = {
    viewer_scene.NOT_SERVED: "Nobody serves the pair: its service is down, or its router is.",
    viewer_scene.SILENT: "The service is there, and does not answer.",
    viewer_scene.RECORDED: "A recording: no service looks at it.",
}
"""Explanations of the states that are not states of health."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """The result in a file, and its T_camera_lidar (4, 4)."""

    result: CalibrationResult
    T_camera_lidar: Matrix4


def load_candidate(path: Path) -> Candidate:
    """The result in a file.

    Raises:
        SourceError: the file cannot be read, or holds no result, or one that is no rigid transform.
    """
    try:
        result = from_json(CalibrationResult, read_bytes(path, MAX_BYTES))
    except DecodeError as error:
        raise SourceError(f"{path} is not the result of `coec calibrate --json`: {error}") from error
    T_camera_lidar = matrix_of(result.camera_from_lidar)
    if not is_rigid(T_camera_lidar):
        raise SourceError(f"{path}: camera_from_lidar is not a rigid transform")
    return Candidate(result, T_camera_lidar)


@dataclass(frozen=True, slots=True)
class Playback:
    """What is played, and how. `rate`: multiple of the recorded speed, above zero. `candidate`: may be None."""

    recording: RecordingSource
    candidate: Candidate | None
    rate: float
    repeat: bool


class PairOnScreen:
    """The pair that is on the screen, and the state that is shown with it."""

    def __init__(self, playback: Playback, screen: ViewerServer) -> None:
        rig, served = playback.recording.rig, playback.recording.T_camera_lidar_start
        configuration = playback.recording.configuration
        self._rig = rig
        self._screen = screen
        self._extrinsics = extrinsics_of_recording(rig, served, playback.candidate)
        self._moment = moment_of_recording(rig, served, playback.candidate)
        self._compensated = configuration is None or configuration.motion_compensation
        self._pair: FramePair | None = None
        self._state_s = self._picture_s = -math.inf
        self.refused: Counter[str] = Counter()

    def put(self, pair: FramePair) -> None:
        """Show another pair."""
        self._pair = pair
        self._show_picture()

    def rest(self, until: Callable[[], bool], stop: threading.Event) -> None:
        """Wait until a condition holds, or until a signal; meanwhile show state and picture again now and then."""
        while not stop.is_set():
            now_s = time.monotonic()
            if now_s - self._state_s >= AGAIN_S:
                self._state_s = now_s
                self._screen.send_entry(self._moment)
            if now_s - self._picture_s >= AGAIN_S:
                self._show_picture()
            if until():
                break
            stop.wait(POLL_S)

    def rest_until(self, due_s: float, stop: threading.Event) -> None:
        """Wait until a time of the steady clock."""
        self.rest(lambda: time.monotonic() >= due_s - POLL_S, stop)
        stop.wait(min(max(due_s - time.monotonic(), 0.0), POLL_S))

    def _show_picture(self) -> None:
        self._picture_s = time.monotonic()
        requested = self._screen.requested_topics
        if self._pair is None or not requested & viewer_scene.PICTURE_TOPICS:
            return
        try:
            picture = viewer_scene.picture_of(
                self._pair, self._rig, self._extrinsics, requested, LimitsConfig(), compensated=self._compensated
            )
        except DecodeError as error:
            self.refused[error.reason] += 1
            self._pair = None
        else:
            self._screen.send_picture(picture)


def show_recording(playback: Playback, screen: ViewerServer, stop: threading.Event) -> Counter[str]:
    """Plays the recording from the arrival of the first viewer; its last pair stays on the screen until a signal.
    Returns the number of pairs that could not be shown, by cause.

    Raises:
        SourceError: a file cannot be read, or no camera frame has a sweep.
    """
    shown = PairOnScreen(playback, screen)
    shown.rest(lambda: bool(screen.requested_topics & viewer_scene.PICTURE_TOPICS), stop)
    due_s, before_ns = time.monotonic(), None
    for pair in _pairs(playback):
        # A recording that cannot be read as fast as it was recorded takes longer; nothing is left out.
        step_ns = 0 if before_ns is None else pair.stamp_ns - before_ns
        due_s, before_ns = max(due_s + step_ns / NS_PER_S / playback.rate, time.monotonic()), pair.stamp_ns
        shown.rest_until(due_s, stop)
        if stop.is_set():
            return shown.refused
        shown.put(pair)
    shown.rest(lambda: False, stop)
    return shown.refused


def _pairs(playback: Playback) -> Iterator[FramePair]:
    """All pairs in order, again and again if the recording is repeated; sensor time goes on."""
    recording = playback.recording
    expects_motion = len(recording.motion_stamps_ns) > 0
    pairer = Pairer(PairingConfig(max_stamp_jump_s=RECORDED_GAP_S), expects_motion=expects_motion)
    stamps_ns = recording.camera_stamps_ns
    period_ns = int(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else DEFAULT_PERIOD_NS
    end_ns = math.inf if not stamps_ns else 2 * stamps_ns[-1] - stamps_ns[0] + period_ns
    any_pair = False
    for message in repeated(recording.messages, shifted, 0, period_ns, playback.repeat):
        for pair in pairer.push(message):
            any_pair = True
            yield pair
        if not any_pair and message.stamp_ns > end_ns:
            break
    for pair in pairer.flush():
        any_pair = True
        yield pair
    if not any_pair:
        raise SourceError(
            f"{recording.name}: no camera frame has a sweep within {PairingConfig().tolerance_s} s: check the stamps "
            "of both"
        )


def moment_of_recording(rig: Rig, served: Matrix4, candidate: Candidate | None) -> viewer_scene.TimelineEntry:
    """The line for a recording and a candidate."""
    result = candidate.result if candidate else None
    return viewer_scene.TimelineEntry(
        pair=rig.pair,
        state=viewer_scene.RECORDED,
        level=STALE,
        why=" ".join(one.text for one in result.verdict.reasons) if result else EXPLANATIONS[viewer_scene.RECORDED],
        reasons=tuple(one.code for one in result.verdict.reasons) if result else (viewer_scene.RECORDED,),
        provenance="nominal" if np.array_equal(served, rig.T_camera_lidar_nominal) else "restored",
        status=result.status if result else None,
        candidate=candidate is not None,
        correction=axes_of(degrees_or_null(se3.difference(served, rig.T_camera_lidar_nominal))),
        sigma=axes_of(result.sigma if result else ()),
        step=axes_of(degrees_or_null(se3.difference(candidate.T_camera_lidar, served)) if candidate else ()),
        figures=figures_of(result.metrics if result else {}),
    )


def extrinsics_of_recording(
    rig: Rig, served: Matrix4, candidate: Candidate | None
) -> dict[viewer_scene.DisplayedPose, viewer_scene.TitledExtrinsic]:
    """The extrinsics that are drawn while a recording is played."""
    return {
        viewer_scene.DisplayedPose.SERVED: viewer_scene.TitledExtrinsic(served, "served: when this was recorded"),
        viewer_scene.DisplayedPose.NOMINAL: viewer_scene.TitledExtrinsic(
            rig.T_camera_lidar_nominal, "nominal: of the recording"
        ),
        viewer_scene.DisplayedPose.CANDIDATE: (
            viewer_scene.TitledExtrinsic(candidate.T_camera_lidar, f"candidate: {candidate.result.status}")
            if candidate
            else viewer_scene.TitledExtrinsic(None, "candidate: none")
        ),
    }


def axes_of(values: Sequence[float | None]) -> viewer_scene.PoseAxes:
    """Axes from six values, degrees and metres, or from none."""
    return viewer_scene.PoseAxes(**dict(zip(viewer_scene.PoseAxes.model_fields, values, strict=False)))


def figures_of(metrics: Mapping[str, MetricReply]) -> tuple[viewer_scene.TimelineFigure, ...]:
    return tuple(
        viewer_scene.TimelineFigure(name=name, value=one.value, limit=one.limit, passed=one.passed)
        for name, one in sorted(metrics.items())
    )
