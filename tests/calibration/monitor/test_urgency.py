"""A window in a hurry: what becomes of the open slice, by sensor time alone."""

from dataclasses import replace

from coec.calibration.frames.window import TRIES, PairSelected, SliceClosed, UrgentWindow, WindowCutter
from coec.calibration.types import CameraFrame, EgoMotion, FramePair, ImageQuality, Window
from coec.config import MonitorConfig, WindowConfig

S = 1_000_000_000
WINDOW = WindowConfig(pairs=10, min_pairs=4, slice_s=100.0)
MONITOR = MonitorConfig(urgent_slice_s=20.0)


class Inspector:
    """Every picture is good, and another one."""

    def inspect(self, frame: CameraFrame) -> ImageQuality:
        return ImageQuality(sharpness=0.3, mean_level=110.0, clipped=0.01, digest=frame.stamp_ns)


class AsTheyAre:
    """Nothing of an exposure is too large."""

    def reduced(self, frame: CameraFrame) -> CameraFrame:
        return frame


class Drive:
    """A stream of pairs, two in a second, through urgency and cutter."""

    def __init__(self, street: Window, rate_hz: float = 2.0) -> None:
        self.street = street
        self.rate_hz = rate_hz
        self.cutter = WindowCutter(WINDOW, street.rig, Inspector(), AsTheyAre())
        self.urgency = UrgentWindow(MONITOR)
        self.selected: list[float] = []

    def until(self, begin_s: float, end_s: float) -> list[tuple[float, SliceClosed]]:
        ends = []
        for i in range(round((end_s - begin_s) * self.rate_hz)):
            second = begin_s + i / self.rate_hz
            pair = self.at(round(second * S))
            self.urgency.observe(pair.stamp_ns)
            ends += [(second, e) for e in self.urgency.apply(self.cutter)]
            for event in self.cutter.offer(pair, self.street.T_camera_lidar_start):
                if isinstance(event, PairSelected):
                    self.selected.append(second)
                elif isinstance(event, SliceClosed):
                    ends.append((second, event))
                    self.urgency.on_slice_closed(event, self.cutter)
        return ends

    def at(self, stamp_ns: int) -> FramePair:
        pair = self.street.pairs[0]
        motion = EgoMotion(stamp_ns, "ego", (5.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        return FramePair(replace(pair.camera, stamp_ns=stamp_ns), replace(pair.lidar, stamp_ns=stamp_ns), motion)


def test_without_an_alarm_nothing_changes(street: Window) -> None:
    assert [second for second, _ in Drive(street).until(1000, 1201)] == [1100.0, 1200.0]


def test_a_slice_that_mixes_two_mounts_is_closed_and_a_dense_one_follows(street: Window) -> None:
    drive = Drive(street)
    assert drive.until(1000, 1070) == []
    drive.urgency.alarm(since_ns=1055 * S)
    ends = drive.until(1070, 1200)
    assert [(second, end.pairs) for second, end in ends] == [(1070.0, 7), (1090.0, 10), (1190.0, 10)]
    assert [second for second in drive.selected if 1070 <= second < 1090] == [1070.0 + 2 * i for i in range(10)]


def test_a_clean_slice_with_enough_pairs_is_closed_at_once_and_no_dense_one_follows(street: Window) -> None:
    drive = Drive(street)
    drive.until(1000, 1045)
    drive.urgency.alarm(since_ns=1000 * S)
    assert [(second, end.pairs) for second, end in drive.until(1045, 1145.5)] == [(1045.0, 5), (1145.0, 10)]


def test_a_clean_slice_that_is_nearly_full_enough_is_pending(street: Window) -> None:
    drive = Drive(street)
    drive.until(1000, 1025)
    drive.urgency.alarm(since_ns=1000 * S)
    (first, *_) = drive.until(1025, 1100)
    assert (first[0], first[1].pairs) == (1030.5, 4)


def test_a_clean_slice_that_has_just_started_is_given_up_for_a_dense_one(street: Window) -> None:
    drive = Drive(street)
    drive.until(1000, 1005)
    drive.urgency.alarm(since_ns=1000 * S)
    ends = drive.until(1005, 1040)
    assert [(second, end.pairs, end.complete) for second, end in ends] == [(1005.0, 1, False), (1025.0, 10, True)]


def test_where_pairs_come_slowly_the_dense_slice_is_longer(street: Window) -> None:
    drive = Drive(street, rate_hz=0.2)
    drive.until(1000, 1005)
    drive.urgency.alarm(since_ns=1003 * S)
    ends = drive.until(1005, 1200)
    assert [(second, end.complete) for second, end in ends] == [(1005.0, False), (1065.0, True), (1165.0, True)]


def test_the_alarms_of_one_suspicion_are_counted(street: Window) -> None:
    drive = Drive(street)
    drive.until(1000, 1005)
    lengths, second = [], 1005.0
    for _ in range(TRIES + 1):
        drive.urgency.alarm(since_ns=round(second * S))
        end = drive.until(second, second + 101)[-1][0]
        lengths.append(end - second)
        second += 101
    assert lengths[:TRIES] == [20.0] * TRIES
    assert lengths[TRIES] == 19.0, "the ordinary slice that was open ends by itself"
    drive.urgency.calm()
    drive.urgency.alarm(since_ns=round(second * S))
    assert drive.until(second, second + 50)[-1][0] - second == 20.0


def test_what_the_rig_waits_for_outlasts_the_calm_of_the_pair(street: Window) -> None:
    drive = Drive(street)
    drive.until(1000, 1070)
    drive.urgency.request(since_ns=1055 * S, longer_s=15.0)
    drive.urgency.calm()
    assert drive.urgency.is_waiting
    ends = drive.until(1070, 1220)
    assert [(second, end.complete) for second, end in ends] == [(1070.0, True), (1105.0, True), (1205.0, True)]
    assert not drive.urgency.is_waiting, "one window, and then ordinary ones"


def test_a_suspicion_does_not_wait_for_the_turn_that_the_rig_gave(street: Window) -> None:
    drive = Drive(street)
    drive.until(1000, 1070)
    drive.urgency.request(since_ns=1055 * S, longer_s=60.0)
    assert [second for second, _ in drive.until(1070, 1075)] == [1070.0]
    drive.urgency.alarm(since_ns=1072 * S)
    assert [(second, end.complete) for second, end in drive.until(1075, 1100)] == [(1075.0, False), (1095.0, True)]


def test_what_the_rig_wants_is_no_second_window_while_one_is_on_its_way(street: Window) -> None:
    drive = Drive(street)
    drive.until(1000, 1070)
    drive.urgency.alarm(since_ns=1055 * S)
    drive.urgency.request(since_ns=1055 * S, longer_s=60.0)
    assert [second for second, _ in drive.until(1070, 1200)] == [1070.0, 1090.0, 1190.0]


def test_nothing_is_requested_of_a_time_that_is_no_more(street: Window) -> None:
    drive = Drive(street)
    drive.until(1000, 1070)
    drive.urgency.request(since_ns=1055 * S, longer_s=0.0)
    drive.urgency.forget()
    assert [second for second, _ in drive.until(1070, 1110)] == [1100.0]
