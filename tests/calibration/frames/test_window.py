"""A window's pairs: one per bin, each good enough, cut by sensor time."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from coec.calibration.frames.window import (
    CarriedOverDropped,
    CarriedOverPairs,
    PairSelected,
    SliceClosed,
    WindowCutter,
    WindowEvent,
)
from coec.calibration.types import CameraFrame, EgoMotion, FramePair, ImageQuality, Window
from coec.config import WindowConfig
from coec.errors import DecodeError

S = 1_000_000_000
SHARP = ImageQuality(sharpness=0.3, mean_level=110.0, clipped=0.01, digest=1)
CONFIG = WindowConfig(pairs=5, min_pairs=3, slice_s=50.0)


class Inspector:
    """Sees what the test wants it to see, and counts its looks. A digest of 0 stands for the stamp's own."""

    def __init__(self, see: Callable[[int], ImageQuality] = lambda _: replace(SHARP, digest=0)) -> None:
        self._see = see
        self.checks = 0

    def inspect(self, frame: CameraFrame) -> ImageQuality:
        self.checks += 1
        quality = self._see(frame.stamp_ns)
        return quality if quality.digest else replace(quality, digest=frame.stamp_ns)


class AsTheyAre:
    """Nothing of an exposure is too large."""

    def reduced(self, frame: CameraFrame) -> CameraFrame:
        return frame


def at(street: Window, seconds: float, speed: float | None = 5.0) -> FramePair:
    stamp = 1_000 * S + round(seconds * S)
    pair = street.pairs[0]
    motion = None if speed is None else EgoMotion(stamp, "ego", (speed, 0.0, 0.0), (0.0, 0.0, 0.0))
    return FramePair(replace(pair.camera, stamp_ns=stamp), replace(pair.lidar, stamp_ns=stamp), motion)


def drive(cutter: WindowCutter, street: Window, seconds: list[float], speed: float | None = 5.0) -> list[WindowEvent]:
    start = street.T_camera_lidar_start
    return [event for s in seconds for event in cutter.offer(at(street, s, speed), start)]


def selected_s(events: list[WindowEvent]) -> list[float]:
    return [(e.pair.stamp_ns - 1_000 * S) / S for e in events if isinstance(e, PairSelected)]


def test_one_pair_of_each_bin_and_the_rest_is_not_checked(street: Window) -> None:
    inspector = Inspector()
    events = drive(WindowCutter(CONFIG, street.rig, inspector, AsTheyAre()), street, [i * 0.5 for i in range(100)])
    assert selected_s(events) == [0.0, 10.0, 20.0, 30.0, 40.0]
    assert inspector.checks == 5


def test_the_slice_ends_by_sensor_time_and_the_next_begins(street: Window) -> None:
    cutter = WindowCutter(CONFIG, street.rig, Inspector(), AsTheyAre())
    events = drive(cutter, street, [float(i) for i in range(0, 60, 2)])
    ends = [e for e in events if isinstance(e, SliceClosed)]
    assert ends == [SliceClosed("street-1000000000000" if street.rig.pair == "street" else ends[0].window_id, 5, True)]
    firsts = [e for e in events if isinstance(e, PairSelected) and e.first]
    assert [e.pair.stamp_ns // S for e in firsts] == [1000, 1050]
    assert firsts[0].window_id == f"{street.rig.pair}-{1000 * S}"


def test_a_slice_with_too_few_pairs_is_no_window(street: Window) -> None:
    cutter = WindowCutter(CONFIG, street.rig, Inspector(), AsTheyAre())
    drive(cutter, street, [0.0, 20.0])
    assert [(e.pairs, e.complete) for e in cutter.finish()] == [(2, False)]


def test_a_short_slice_with_enough_pairs_is_one(street: Window) -> None:
    cutter = WindowCutter(CONFIG, street.rig, Inspector(), AsTheyAre())
    drive(cutter, street, [0.0, 12.0, 24.0])
    assert [(e.pairs, e.complete) for e in cutter.finish()] == [(3, True)]


def test_silence_ends_a_slice_when_its_time_has_passed(street: Window) -> None:
    cutter = WindowCutter(CONFIG, street.rig, Inspector(), AsTheyAre())
    drive(cutter, street, [0.0, 12.0, 24.0])
    assert cutter.advance(1_049 * S) == []
    assert [e.complete for e in cutter.advance(1_050 * S)] == [True]
    assert cutter.advance(2_000 * S) == []


def test_nothing_selected_is_nothing_closed(street: Window) -> None:
    assert WindowCutter(CONFIG, street.rig, Inspector(), AsTheyAre()).finish() == []


def test_a_bin_without_a_good_pair_stays_empty_and_the_next_good_one_counts(street: Window) -> None:
    blurred_until_4 = Inspector(lambda stamp: replace(SHARP, digest=0, sharpness=0.0 if stamp < 1004 * S else 0.3))
    cutter = WindowCutter(CONFIG, street.rig, blurred_until_4, AsTheyAre())
    assert selected_s(drive(cutter, street, [0.0, 1.0, 2.0, 5.0, 12.0])) == [5.0, 12.0]
    assert cutter.rejections == {"blurred": 3}


def test_pairs_of_neighbouring_bins_keep_their_distance(street: Window) -> None:
    cutter = WindowCutter(CONFIG, street.rig, Inspector(), AsTheyAre())
    drive(cutter, street, [0.0])
    assert selected_s(drive(cutter, street, [3.0, 10.0, 19.5, 20.5, 26.0])) == [10.0, 20.5]
    late = WindowCutter(
        CONFIG,
        street.rig,
        Inspector(lambda stamp: replace(SHARP, digest=0, sharpness=0.3 * (stamp >= 1008 * S))),
        AsTheyAre(),
    )
    assert selected_s(drive(late, street, [0.0, 9.0, 10.5, 14.5])) == [9.0, 14.5]


@pytest.mark.fault("pictures that are dark, blinded or blurred", "they are refused by their reason")
@pytest.mark.parametrize(
    ("quality", "reason"),
    [
        (replace(SHARP, sharpness=0.001), "blurred"),
        (replace(SHARP, mean_level=2.0), "too_dark"),
        (replace(SHARP, clipped=0.9), "clipped"),
    ],
)
def test_bad_exposures_are_refused_by_reason(street: Window, quality: ImageQuality, reason: str) -> None:
    cutter = WindowCutter(CONFIG, street.rig, Inspector(lambda _: quality), AsTheyAre())
    drive(cutter, street, [0.0])
    assert cutter.rejections == {reason: 1}


def test_a_standing_vehicle_gives_no_pairs_unless_configured_otherwise(street: Window) -> None:
    cutter = WindowCutter(CONFIG, street.rig, Inspector(), AsTheyAre())
    assert drive(cutter, street, [0.0, 10.0], speed=0.1) == []
    assert cutter.rejections == {"standing": 2}
    tolerant = WindowCutter(CONFIG.model_copy(update={"require_motion": False}), street.rig, Inspector(), AsTheyAre())
    assert selected_s(drive(tolerant, street, [0.0, 10.0], speed=0.1)) == [0.0, 10.0]


def test_unknown_motion_is_not_standing(street: Window) -> None:
    cutter = WindowCutter(CONFIG, street.rig, Inspector(), AsTheyAre())
    assert selected_s(drive(cutter, street, [0.0], speed=None)) == [0.0]


@pytest.mark.fault("a camera that repeats its picture while the vehicle moves", "the pairs are refused, with the cause")
def test_a_frozen_image_of_a_moving_vehicle_is_refused(street: Window) -> None:
    cutter = WindowCutter(CONFIG, street.rig, Inspector(lambda _: SHARP), AsTheyAre())
    assert selected_s(drive(cutter, street, [0.0, 10.0, 20.0])) == [0.0]
    assert cutter.rejections == {"frozen": 2}


def test_a_pair_out_of_view_is_refused_before_its_image_is_decoded(street: Window) -> None:
    inspector = Inspector()
    cutter = WindowCutter(CONFIG.model_copy(update={"min_points_in_view": 10**6}), street.rig, inspector, AsTheyAre())
    drive(cutter, street, [0.0])
    assert cutter.rejections == {"out_of_view": 1}
    assert inspector.checks == 0


def test_an_image_that_cannot_be_decoded_is_counted_by_its_reason(street: Window) -> None:
    def broken(_: int) -> ImageQuality:
        raise DecodeError("image_truncated", "ends early")

    cutter = WindowCutter(CONFIG, street.rig, Inspector(broken), AsTheyAre())
    drive(cutter, street, [0.0, 1.0])
    assert cutter.rejections == {"image_truncated": 2}


@pytest.mark.fault("sensor time that steps back in a window", "the slice ends there")
def test_sensor_time_that_steps_back_ends_the_slice(street: Window) -> None:
    cutter = WindowCutter(CONFIG, street.rig, Inspector(), AsTheyAre())
    events = drive(cutter, street, [0.0, 12.0, 24.0, -500.0])
    assert [(e.pairs, e.complete) for e in events if isinstance(e, SliceClosed)] == [(3, True)]
    assert selected_s(events)[-1] == -500.0


RETAINED = CarriedOverPairs("street-960000000000", 990 * S, 998 * S, 2)


def test_retained_pairs_count_for_the_window_and_end_it_when_it_is_as_large_as_any(street: Window) -> None:
    cutter = WindowCutter(CONFIG, street.rig, Inspector(), AsTheyAre())
    events = drive(cutter, street, [0.0, 2.0])
    assert cutter.selected == 1
    cutter.carry_over(RETAINED)
    assert cutter.selected == 3
    events += drive(cutter, street, [10.0 + 2.0 * i for i in range(10)])
    (finished,) = (e for e in events if isinstance(e, SliceClosed))
    assert (finished.pairs, finished.complete, finished.carried_over) == (CONFIG.pairs, True, RETAINED)
    assert selected_s(events)[:3] == [0.0, 10.0, 20.0]
    assert cutter.selected == 1, "the next one begins without them"


def test_retained_pairs_wait_for_a_slice_that_is_a_window(street: Window) -> None:
    cutter = WindowCutter(CONFIG, street.rig, Inspector(), AsTheyAre())
    drive(cutter, street, [0.0])
    cutter.carry_over(replace(RETAINED, pairs=1))
    ((short,), later) = cutter.finish(), drive(cutter, street, [2.0, 12.0])
    assert isinstance(short, SliceClosed)
    assert (short.complete, short.carried_over) == (False, None)
    assert len(selected_s(later)) == 2
    (finished,) = cutter.finish()
    assert (finished.pairs, finished.complete, finished.carried_over) == (3, True, replace(RETAINED, pairs=1))


@pytest.mark.parametrize("begins_s", [CONFIG.slice_s + 0.5, -10.0])
def test_retained_pairs_of_another_time_are_dropped_with_a_log_entry(street: Window, begins_s: float) -> None:
    cutter = WindowCutter(CONFIG, street.rig, Inspector(), AsTheyAre())
    cutter.carry_over(RETAINED)
    events = drive(cutter, street, [begins_s])
    assert [e for e in events if isinstance(e, CarriedOverDropped)] == [CarriedOverDropped(RETAINED)]
    assert cutter.selected == 1
