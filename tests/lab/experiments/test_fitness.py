"""What a recording is good for: rates, partners, views, and what a person should know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, ImageFormat, LidarFrame, Rig
from coec.geometry.cameras import build
from coec.geometry.projection import share_in_image
from coec.io.recordings.recording_source import FramewiseRecording, RecordedFrame
from coec.reports.recording_fitness import cadence, fitness_of, lens_notices, passes

FORWARD = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
RIG = Rig(
    "front",
    build("pinhole", width=40, height=30, fx=20.0, fy=20.0, cx=19.5, cy=14.5),
    "camera",
    "lidar",
    FORWARD,
    np.eye(4),
)
MS = 1_000_000
POINTS = np.array([[5.0, 0.0, 0.0], [5.0, 1.0, 0.5], [-5.0, 0.0, 0.0], [5.0, 50.0, 0.0]], np.float32)
"""Two ahead, one behind, one far to the left."""


def a_recording(
    frames: int = 10, period_ms: int = 100, late_ms: int = 5, speed_mps: float = 8.0, rig: Rig = RIG, ring: bool = False
) -> FramewiseRecording:
    image = EncodedImage(ImageFormat.MONO8, 40, 30, bytes(1200))

    def frame(number: int) -> RecordedFrame:
        at = 1000 * MS + number * period_ms * MS
        sweep_ns = at - late_ms * MS
        numbers = np.full(len(POINTS), 7, np.uint16) if ring else None
        return RecordedFrame(
            at,
            lambda: CameraFrame(at, "camera", image),
            sweep_ns,
            lambda: LidarFrame(sweep_ns, "lidar", POINTS, ring=numbers),
        )

    motions = tuple(
        EgoMotion(1000 * MS + n * 50 * MS, "ego", (speed_mps, 0.0, 0.0), (0.0, 0.0, 0.1)) for n in range(2 * frames)
    )
    return FramewiseRecording("test", rig, FORWARD, tuple(map(frame, range(frames))), motions)


def codes(recording: FramewiseRecording) -> dict[str, str]:
    return {comment.code: comment.level for comment in fitness_of(recording).remarks}


def test_the_figures_of_a_recording() -> None:
    seen = fitness_of(a_recording())
    assert seen.seconds == pytest.approx(0.9)
    assert seen.camera.frames == 10
    np.testing.assert_allclose([seen.camera.rate_hz, seen.lidar.rate_hz], 10.0)
    np.testing.assert_allclose(np.array(seen.sync_ms), 5.0)
    assert (seen.paired, seen.in_view, seen.points) == (1.0, 0.5, 4)
    assert seen.speed_mps == (8.0, 8.0)
    np.testing.assert_allclose(np.array(seen.turn_degps), np.degrees(0.1))
    assert seen.standing == 0.0


def test_clocks_that_are_separate_are_named_with_the_way_out() -> None:
    (comment,) = (r for r in fitness_of(a_recording(late_ms=-3_600_000)).remarks if r.code == "no_pairs")
    assert "the clouds are 3600.000 s ahead of the images" in comment.text
    assert "PTP" in comment.text


def test_points_that_are_left_out_are_named() -> None:
    recording = a_recording()
    assert "not_finite" not in codes(recording)

    def with_some(frame: RecordedFrame) -> RecordedFrame:
        return replace(frame, load_lidar=lambda: replace(frame.load_lidar(), not_finite=1))

    frames = tuple(map(with_some, recording.frames))
    seen = fitness_of(replace(recording, frames=frames))
    assert seen.not_finite == pytest.approx(0.2)
    (comment,) = (r for r in seen.remarks if r.code == "not_finite")
    assert (comment.level, comment.text[:17]) == ("ok", "20% of the points")


def test_a_cadence_reports_its_longest_gap() -> None:
    reported = cadence([0, 100 * MS, 200 * MS, 1200 * MS])
    np.testing.assert_allclose([reported.rate_hz, reported.longest_gap_s], [10.0, 1.0])
    assert cadence([]).frames == 0
    assert cadence([5]).rate_hz == 0.0


@pytest.mark.parametrize(
    ("recording", "code", "level"),
    [
        (a_recording(frames=3), "too_few_frames", "fail"),
        (a_recording(period_ms=1000, late_ms=60), "no_pairs", "fail"),
        (replace(a_recording(), motions=()), "no_ego_motion", "warn"),
        (a_recording(), "no_point_time", "warn"),
        (a_recording(speed_mps=0.0), "standing", "warn"),
        (a_recording(ring=True), "constant_ring", "warn"),
    ],
)
def test_what_is_missing_is_reported(recording: FramewiseRecording, code: str, level: str) -> None:
    assert codes(recording)[code] == level


@pytest.mark.parametrize(
    ("times_s", "reported"),
    [
        (np.linspace(0.0, 0.1, 60), 1),
        (np.tile(np.linspace(0.0, 0.1, 30), 2), 2),
        (np.tile(np.linspace(-0.1, 0.0, 20), 3), 3),
        (np.tile(np.linspace(0.0, 0.1, 4), 16), 16),
        (np.random.default_rng(1).uniform(0.0, 0.01, 50) + np.linspace(0.0, 0.1, 50), 1),
        (np.zeros(9), 1),
        (None, 0),
    ],
    ids=range(7),
)
def test_passes_are_counted_in_the_order_in_which_points_lie(
    times_s: NDArray[np.float64] | None, reported: int
) -> None:
    count = 5 if times_s is None else len(times_s)
    times = None if times_s is None else times_s.astype(np.float32)
    assert passes(LidarFrame(0, "lidar", np.ones((count, 3), np.float32), time_offset_s=times)) == reported


@pytest.mark.parametrize(("rings", "reported"), [(False, True), (True, False)])
def test_a_cloud_that_may_be_of_several_lidars_is_reported(rings: bool, reported: bool) -> None:
    recording = a_recording(ring=rings)
    times_s = np.array([0.0, 0.1, 0.0, 0.1], np.float32)

    def timed(frame: RecordedFrame) -> RecordedFrame:
        return replace(frame, load_lidar=lambda: replace(frame.load_lidar(), time_offset_s=times_s))

    timed_recording = replace(recording, frames=tuple(map(timed, recording.frames)))
    assert ("perhaps_concatenated" in codes(timed_recording)) is reported


def test_an_extrinsic_the_wrong_way_round_is_reported() -> None:
    away = FORWARD.copy()
    away[2, 3] = -100.0
    assert codes(a_recording(rig=replace(RIG, T_camera_lidar_nominal=away)))["little_in_view"] == "fail"


def test_points_at_the_border_of_the_image_are_in_view() -> None:
    at = np.array([[20.0, 0.0, 0.0]]) + np.array([[0.0, 19.9, 0.0]])
    sweep = LidarFrame(0, "lidar", at.astype(np.float32))
    T = RIG.T_camera_lidar_nominal
    assert share_in_image(RIG.camera, T, sweep.xyz_m) == 1.0
    assert share_in_image(RIG.camera, T, at + np.array([[0.0, 0.2, 0.0]])) == 0.0


def test_motion_of_another_clock_is_reported() -> None:
    recording = a_recording()
    later = tuple(replace(motion, stamp_ns=motion.stamp_ns + 37_000 * MS) for motion in recording.motions)
    assert codes(replace(recording, motions=later))["motion_apart"] == "warn"
    assert "motion_apart" not in codes(recording)
    # Without pairs and without motion near an image nothing shows that it is rotation only.
    separate = a_recording(late_ms=-3_600_000)
    far = tuple(replace(motion, stamp_ns=motion.stamp_ns + 7_200_000 * MS) for motion in separate.motions)
    assert "rotation_only" not in codes(replace(separate, motions=far))


@pytest.mark.parametrize(
    ("intrinsics", "code", "text"),
    [
        ({}, None, ""),
        ({"cx": 339.5, "cy": 180.5}, None, ""),
        ({"cx": 639.0, "cy": 399.0}, "principal_point", "of an image 2 times as large"),
        ({"cx": 160.0, "cy": 100.0}, "principal_point", "of an image 0.5 times as large"),
        ({"cx": 319.5, "cy": 20.0}, "principal_point", "check cx and cy"),
    ],
)
def test_a_principal_point_of_another_image_is_named(intrinsics: dict[str, float], code: str | None, text: str) -> None:
    given = {"width": 640, "height": 400, "fx": 320.0, "fy": 320.0, "cx": 319.5, "cy": 199.5, **intrinsics}
    notices = lens_notices(build("pinhole", **given))
    assert [notice.code for notice in notices] == ([] if code is None else [code])
    assert all(text in notice.text for notice in notices)


def test_a_polynomial_that_turns_back_before_the_corners_is_named() -> None:
    given = {"width": 640, "height": 400, "fx": 320.0, "fy": 320.0, "cx": 319.5, "cy": 199.5}
    wild = build("kannala_brandt", **given, k1=-1.152516, k2=2.913204, k3=-2.482336, k4=0.178503)
    (notice,) = lens_notices(wild)
    assert notice.code == "lens_ends"
    assert "48.7 deg from the axis, 218 px" in notice.text
    # A fisheye whose image circle ends within the image is no such polynomial.
    circle = build("kannala_brandt", **{**given, "fx": 100.0, "fy": 100.0}, k1=0.0, k2=0.0, k3=0.0, k4=0.0)
    assert lens_notices(circle) == []
