"""The times of points: recognised from their values, said in a line, refused where they may mean two things."""

import math
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coec.calibration.types import LidarFrame
from coec.config import LimitsConfig, PointTimeConfig, TimeUnit
from coec.errors import DecodeError
from coec.io.ros import message_decoding, messages
from support.ros import STAMP_NS, STAMP_REST_NS, STAMP_S, Columns, packed_cloud

LIMITS = LimitsConfig()
POINTS = 5
SWEEP_S = np.linspace(0.0, 0.0999, POINTS)
TICKS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}


def cloud_timed(name: str, form: str, values: list[float], *, stamp_ns: int = STAMP_NS, big: bool = False) -> bytes:
    xyz: Columns = [(axis, "<f4", [float(k + 1) for k in range(len(values))]) for axis in "xyz"]
    sec, nsec = divmod(stamp_ns, 10**9)
    return packed_cloud([*xyz, (name, form, values)], big=big, sec=sec, nsec=nsec)


def sweep(payload: bytes, reported: PointTimeConfig | None = None) -> LidarFrame:
    frame = message_decoding.decode(messages.POINT_CLOUD, payload, LIMITS, point_time=reported)
    assert isinstance(frame, LidarFrame)
    return frame


def offsets_s(frame: LidarFrame) -> list[float]:
    assert frame.time_offset_s is not None
    assert frame.time_offset_s.dtype == np.float32
    return [float(v) for v in frame.time_offset_s]


def refused(payload: bytes) -> DecodeError:
    with pytest.raises(DecodeError) as error:
        sweep(payload)
    return error.value


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
@pytest.mark.parametrize("form", ["<f4", "<f8"])
@pytest.mark.parametrize("begin_s", [0.0, -0.0999, -0.04995, 0.03])
def test_a_sweep_is_recognised_in_every_unit_wherever_its_stamp_lies(
    form: str, unit: str, begin_s: float, big: bool
) -> None:
    values = ((SWEEP_S + begin_s) * TICKS[unit]).tolist()

    frame = sweep(cloud_timed("time", form, values, big=big))

    assert offsets_s(frame) == pytest.approx(SWEEP_S + begin_s, abs=1e-6)


@pytest.mark.parametrize("unit", ["us", "ns"])
@pytest.mark.parametrize(("form", "begin_s"), [("<u4", 0.0), ("<i4", -0.0999)])
def test_whole_numbers_are_micro_or_nanoseconds(form: str, unit: str, begin_s: float) -> None:
    values = np.rint((SWEEP_S + begin_s) * TICKS[unit]).tolist()

    assert offsets_s(sweep(cloud_timed("t", form, values))) == pytest.approx(SWEEP_S + begin_s, abs=1e-6)


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
@pytest.mark.parametrize("begin_s", [0.0, -0.0999, -0.15])
@pytest.mark.parametrize("stamp_ns", [STAMP_NS, 345 * 10**9 + 6_789_000])
def test_a_time_of_day_or_since_the_start_counts_from_the_stamp(unit: str, begin_s: float, stamp_ns: int) -> None:
    """`timestamp` is on the clock that the stamp is of, whatever that counts from."""
    values = ((SWEEP_S + begin_s + stamp_ns * 1e-9) * TICKS[unit]).tolist()

    frame = sweep(cloud_timed("timestamp", "<f8", values, stamp_ns=stamp_ns))

    assert offsets_s(frame) == pytest.approx(SWEEP_S + begin_s, abs=1e-6)
    assert "on the stamp's clock" in frame.timed_by


@pytest.mark.parametrize(
    ("name", "form", "values", "line"),
    [
        ("t", "<u4", [0, 99_900_000], "t: uint32, ns since the stamp; 0.0 to 99.9 ms, stamped at its begin"),
        ("time", "<f4", [-0.1, 0.0], "time: float32, s since the stamp; -100.0 to 0.0 ms, stamped at its end"),
        (
            "timestamp",
            "<f8",
            [STAMP_S + STAMP_REST_NS * 1e-9 - 0.05, STAMP_S + STAMP_REST_NS * 1e-9 + 0.05],
            "timestamp: float64, s on the stamp's clock; -50.0 to 50.0 ms from the stamp, stamped in its middle",
        ),
        ("time_stamp", "<u4", [150_000, 200_000], "time_stamp: uint32, µs since the stamp; 150.0 to 200.0 ms"),
        ("time", "<f4", [0.0, 0.0], "time: float32, s since the stamp; 0.0 to 0.0 ms"),
    ],
)
def test_what_was_recognised_is_reported(name: str, form: str, values: list[float], line: str) -> None:
    assert sweep(cloud_timed(name, form, values)).timed_by == line


@pytest.mark.parametrize(
    ("name", "form", "values", "stamp_ns", "candidates"),
    [
        # A simulation that began a moment ago: since the stamp, or since the begin?
        ("timestamp", "<f8", [0.5, 0.6], 500_000_000, ["s since the stamp", "s on the stamp's clock"]),
        # A slow scanner's seconds, or a fast one's milliseconds.
        ("time", "<f4", [0.0, 5.0], STAMP_NS, ["s since the stamp", "ms since the stamp"]),
        # Whole milliseconds, or a flash.
        ("t", "<u4", [0, 99], STAMP_NS, ["ms since the stamp", "ns since the stamp"]),
        ("t", "<u4", [50_000, 50_000], STAMP_NS, ["ns since the stamp", "µs since the stamp"]),
    ],
)
@pytest.mark.fault("point times that can be read in two ways", "the sweep is refused, and the candidates are named")
def test_what_may_mean_two_things_is_refused_with_the_candidates(
    name: str, form: str, values: list[float], stamp_ns: int, candidates: list[str]
) -> None:
    error = refused(cloud_timed(name, form, values, stamp_ns=stamp_ns))

    assert error.reason == "cloud_time_ambiguous"
    for candidate in [*candidates, f"lidar.time: {{field: {name}"]:
        assert candidate in str(error)


@pytest.mark.parametrize(("unit", "scale"), [("s", 1.0), ("ms", 1e-3)])
def test_what_the_configuration_reports_is_taken_as_reported(unit: TimeUnit, scale: float) -> None:
    payload = cloud_timed("time", "<f4", [0.0, 5.0])

    frame = sweep(payload, PointTimeConfig(field="time", unit=unit))

    assert offsets_s(frame) == pytest.approx([0.0, 5.0 * scale])


def test_the_configuration_names_a_field_that_nobody_knows() -> None:
    payload = cloud_timed("fired_at", "<f8", [STAMP_NS * 1e-3, STAMP_NS * 1e-3 + 1e5])

    assert sweep(payload).time_offset_s is None
    reported = PointTimeConfig(field="fired_at", unit="us", base="clock")
    assert offsets_s(sweep(payload, reported)) == pytest.approx([0.0, 0.1], abs=1e-6)


@pytest.mark.fault("points timed by another clock than their sweep", "the sweep is refused with its reason")
@pytest.mark.parametrize("ago_s", [3600.0, -3600.0, 2.0])
def test_a_time_of_another_clock_is_refused(ago_s: float) -> None:
    error = refused(cloud_timed("timestamp", "<f8", [STAMP_S - ago_s, STAMP_S - ago_s + 0.1]))

    assert error.reason == "cloud_time"


def test_a_name_that_speaks_of_the_time_since_the_stamp_is_believed() -> None:
    """In the first second of a clock the values alone would leave it open."""
    assert offsets_s(sweep(cloud_timed("time", "<f4", [0.0, 0.1], stamp_ns=10**8))) == pytest.approx([0.0, 0.1])


def test_points_that_are_none_do_not_count_whatever_their_time() -> None:
    nan = math.nan
    payload = packed_cloud(
        [
            ("x", "<f4", [nan, 1.0, 2.0, 3.0]),
            ("y", "<f4", [1.0] * 4),
            ("z", "<f4", [1.0] * 4),
            ("timestamp", "<f8", [0.0, STAMP_S + STAMP_REST_NS * 1e-9, nan, STAMP_S + STAMP_REST_NS * 1e-9 + 0.1]),
        ]
    )

    frame = sweep(payload)

    assert frame.xyz_m[:, 0].tolist() == [1.0, 3.0]
    assert offsets_s(frame) == pytest.approx([0.0, 0.1], abs=1e-6)


def test_a_cloud_without_a_time_has_none_and_says_nothing() -> None:
    frame = sweep(packed_cloud([(axis, "<f4", [1.0, 2.0]) for axis in "xyz"]))

    assert (frame.time_offset_s, frame.timed_by) == (None, "")


@given(
    begin_s=st.floats(-1.0, 0.9),
    lasts_s=st.floats(0.011, 0.99),
    unit=st.sampled_from(["s", "ms", "us", "ns"]),
    seconds=st.integers(100, 2**31 - 10),
    clock=st.booleans(),
)
def test_no_usual_sweep_is_read_in_another_way_than_it_was_written(
    begin_s: float, lasts_s: float, unit: str, seconds: int, clock: bool
) -> None:
    """Between 1 and 90 Hz, its stamp up to a second away: one reading, and the right one."""
    begin_s = max(begin_s, -1.0 - lasts_s)
    base_s = seconds if clock else 0
    values = [(base_s + begin_s) * TICKS[unit], (base_s + begin_s + lasts_s) * TICKS[unit]]

    frame = sweep(cloud_timed("timestamp", "<f8", values, stamp_ns=seconds * 10**9))

    assert offsets_s(frame) == pytest.approx([begin_s, begin_s + lasts_s], abs=2e-6)


BEGIN_S = STAMP_S + STAMP_REST_NS * 1e-9


@pytest.mark.fault(
    "a cloud without a stamp whose points carry the time of day",
    "the stamp is taken from the first point, and this is reported",
)
@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
@pytest.mark.parametrize("name", ["timestamp", "t"])
def test_without_a_stamp_the_first_point_reports_it(unit: str, name: str) -> None:
    frame = sweep(cloud_timed(name, "<f8", ((SWEEP_S + BEGIN_S) * TICKS[unit]).tolist(), stamp_ns=0))

    assert frame.stamp_ns == pytest.approx(STAMP_NS, abs=1000)  # neighbouring doubles are 0.2 us apart
    assert offsets_s(frame) == pytest.approx(SWEEP_S, abs=2e-6)
    assert frame.timed_by.endswith("stamped at its begin; without a stamp, that of the first point is taken")


def test_points_that_are_none_do_not_stamp_a_cloud() -> None:
    columns: Columns = [(axis, "<f4", [math.nan, 1.0, 2.0]) for axis in "xyz"]
    times: Columns = [("timestamp", "<f8", [0.0, BEGIN_S, BEGIN_S + 0.1])]
    assert sweep(packed_cloud([*columns, *times], sec=0, nsec=0)).stamp_ns == pytest.approx(STAMP_NS, abs=1000)


@pytest.mark.parametrize(
    ("name", "form", "values"),
    [
        ("t", "<u4", [0.0, 99_900_000.0]),
        ("time", "<f4", [-0.1, 0.0]),
        ("timestamp", "<f8", [0.0, 0.1]),
    ],
)
def test_without_a_stamp_a_time_since_the_stamp_leaves_it_open(name: str, form: str, values: list[float]) -> None:
    assert sweep(cloud_timed(name, form, values, stamp_ns=0)).stamp_ns == 0


@pytest.mark.fault("a cloud without a stamp whose points tell no time of day", "the sweep is refused with its reason")
@pytest.mark.parametrize(
    ("form", "values"),
    [
        ("<f4", [BEGIN_S, BEGIN_S]),  # two minutes between neighbouring values
        ("<u4", [float(STAMP_S), float(STAMP_S)]),  # whole seconds
        ("<f8", [345e9, 345.1e9]),  # since the sensor was switched on
        ("<f8", [2.0**31, 2.0**31 + 0.1]),
    ],
)
def test_without_a_stamp_nothing_is_guessed(form: str, values: list[float]) -> None:
    assert refused(cloud_timed("timestamp", form, values, stamp_ns=0)).reason == "cloud_time"


def test_without_a_stamp_a_clock_that_is_named_is_believed() -> None:
    reported = PointTimeConfig(field="timestamp", unit="s", base="clock")
    frame = sweep(cloud_timed("timestamp", "<f8", [345.0, 345.1], stamp_ns=0), reported)

    assert frame.stamp_ns == 345 * 10**9
    assert offsets_s(frame) == pytest.approx([0.0, 0.1])


COUNT = 400
RISING_S = np.linspace(0.0, 0.0999, COUNT)


def cloud_of_drivers(fields: dict[str, tuple[str, list[float]]], stamp_ns: int = STAMP_NS) -> bytes:
    columns: Columns = [(axis, "<f4", [float(k + 1) for k in range(COUNT)]) for axis in "xyz"]
    sec, nsec = divmod(stamp_ns, 10**9)
    return packed_cloud([*columns, *((name, *of_field) for name, of_field in fields.items())], sec=sec, nsec=nsec)


def codes(frame: LidarFrame) -> list[str]:
    return [one.code for one in frame.recognitions]


@pytest.mark.parametrize("name", ["point_time_offset", "pointTime", "t_us", "deltaT", "usec", "Stamp"])
@pytest.mark.parametrize(("form", "unit"), [("<u4", "ns"), ("<u4", "us"), ("<f4", "s"), ("<f4", "ms"), ("<f8", "us")])
def test_a_field_that_no_driver_is_known_for_is_a_time_by_its_values(name: str, form: str, unit: str) -> None:
    frame = sweep(cloud_of_drivers({name: (form, (RISING_S * TICKS[unit]).tolist())}))

    assert offsets_s(frame) == pytest.approx(RISING_S, abs=1e-6)
    assert codes(frame) == ["time_by_values"]


def test_a_time_on_the_stamps_clock_needs_no_name() -> None:
    absolute = ((RISING_S + STAMP_NS * 1e-9) * 1e6).tolist()
    frame = sweep(cloud_of_drivers({"field_7": ("<f8", absolute), "id": ("<u4", list(range(COUNT)))}))

    assert offsets_s(frame) == pytest.approx(RISING_S, abs=2e-6)


def test_rows_that_are_stored_one_after_the_other_rise_each() -> None:
    rows = np.tile(np.linspace(0.0, 0.0999, COUNT // 4), 4)
    frame = sweep(cloud_of_drivers({"point_time": ("<f4", rows.tolist())}))

    assert offsets_s(frame) == pytest.approx(rows, abs=1e-6)


@pytest.mark.parametrize("name", ["point_id", "ambient"])
def test_a_counter_is_named_and_not_read(name: str) -> None:
    (doubt,) = sweep(cloud_of_drivers({name: ("<u4", [300.0 * k for k in range(COUNT)])})).recognitions

    assert doubt.level == "warn"
    assert f"?time={name},us,stamp" in doubt.text


def test_a_fraction_of_a_second_is_no_time_since_the_stamp() -> None:
    fields = {
        "time_sec": ("<u4", [float(STAMP_S)] * COUNT),
        "time_nsec": ("<u4", (STAMP_REST_NS + RISING_S * 1e9).tolist()),
    }
    frame = sweep(cloud_of_drivers(fields))

    assert (frame.time_offset_s, codes(frame)) == (None, ["perhaps_a_time"])


def test_what_does_not_rise_is_no_time() -> None:
    values = np.random.default_rng(0).uniform(0.0, 0.1, COUNT).tolist()
    frame = sweep(cloud_of_drivers({"some_time": ("<f4", values), "range": ("<f4", values)}))

    assert (frame.time_offset_s, codes(frame)) == (None, [])


@pytest.mark.parametrize("form", ["<f4", "<f8"])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_values_that_are_not_finite_are_no_time(form: str, bad: float) -> None:
    values = [*RISING_S.tolist()[:-1], bad]
    assert sweep(cloud_of_drivers({"point_time": (form, values)})).time_offset_s is None


@pytest.mark.parametrize("value", [0.0, STAMP_NS * 1.0])
def test_one_time_for_all_points_is_reported(value: float) -> None:
    frame = sweep(cloud_of_drivers({"timestamp": ("<f8", [value] * COUNT)}))

    assert codes(frame) == ["one_point_time"]


@pytest.mark.parametrize(("base", "begin_s"), [("begin", 0.0), ("end", -0.0999)])
def test_times_on_another_clock_are_refused_with_what_to_type(base: Literal["begin", "end"], begin_s: float) -> None:
    values = ((RISING_S + 668.4) * 1e9).tolist()
    payload = cloud_of_drivers({"timestamp": ("<f8", values)})

    error = refused(payload)
    assert error.reason == "cloud_time"
    assert "in ns they last 99.9 ms" in str(error)
    assert f"?time=timestamp,ns,{base}" in str(error)

    frame = sweep(payload, PointTimeConfig(field="timestamp", unit="ns", base=base))
    assert offsets_s(frame) == pytest.approx(RISING_S + begin_s, abs=1e-6)


def two_times(first: tuple[str, str, list[float]], second: tuple[str, str, list[float]]) -> bytes:
    xyz: Columns = [(axis, "<f4", [float(k + 1) for k in range(POINTS)]) for axis in "xyz"]
    return packed_cloud([*xyz, first, second], sec=STAMP_S, nsec=STAMP_REST_NS)


@pytest.mark.parametrize("unused", [[0.0] * POINTS, [7.0] * POINTS])
@pytest.mark.parametrize("name", ["t", "timestamp"])
def test_of_two_fields_the_one_that_differs_from_point_to_point_counts(name: str, unused: list[float]) -> None:
    frame = sweep(two_times((name, "<u4", unused), ("time", "<f4", SWEEP_S.tolist())))
    assert offsets_s(frame) == pytest.approx(SWEEP_S, abs=1e-6)
    assert frame.timed_by.startswith("time: ")
    assert not frame.recognitions


def test_of_two_fields_one_that_cannot_be_a_time_does_not_count() -> None:
    frame = sweep(
        two_times(("t", "<f8", (SWEEP_S + 5e8).tolist()), ("timestamp", "<f8", (SWEEP_S + STAMP_NS * 1e-9).tolist()))
    )
    assert offsets_s(frame) == pytest.approx(SWEEP_S, abs=1e-5)


def test_two_fields_that_agree_are_one_time_and_others_are_refused() -> None:
    on_clock = SWEEP_S + STAMP_NS * 1e-9
    agreed = sweep(two_times(("time", "<f4", SWEEP_S.tolist()), ("timestamp", "<f8", on_clock.tolist())))
    assert offsets_s(agreed) == pytest.approx(SWEEP_S, abs=1e-6)
    payload = two_times(("time", "<f4", SWEEP_S.tolist()), ("timestamp", "<f8", (on_clock - 0.05).tolist()))
    error = refused(payload)
    assert error.reason == "cloud_time_ambiguous"
    assert "contradict each other, time: float32, s since the stamp" in str(error)
    assert "?time=FIELD,UNIT,BASE" in str(error)
    selected = sweep(payload, PointTimeConfig(field="timestamp", unit="s", base="clock"))
    assert offsets_s(selected) == pytest.approx(SWEEP_S - 0.05, abs=1e-6)


def test_a_time_of_day_in_a_number_that_is_too_coarse_is_named() -> None:
    error = refused(cloud_timed("timestamp", "<f4", (SWEEP_S + STAMP_S).tolist()))
    assert "come in steps of 128, too coarse for a clock" in str(error)
