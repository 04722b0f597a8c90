"""What is said of a pair's health on `/diagnostics`: the levels as ROS's conventions have them, and every figure."""

from __future__ import annotations

from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coec.io.ros.message_encoding import (
    MAX_MESSAGE,
    SENSOR_LEVELS,
    DiagnosticLevel,
    ServicePhase,
    level_of,
    status_of_health,
    status_of_sensor,
)
from coec.schemas.replies import (
    SERVICE_STUCK,
    Axes,
    AxisReply,
    DataQuality,
    HealthReply,
    HealthState,
    MetricReply,
    Reason,
)
from coec.schemas.rig_state import SensorState
from support.messages import moved_lidar_sensor, sensor_reply

STATES = st.sampled_from(get_args(HealthState))
SERVICES: st.SearchStrategy[ServicePhase] = st.sampled_from(get_args(ServicePhase))
REASONS = st.lists(
    st.builds(Reason, code=st.sampled_from([SERVICE_STUCK, "thread_died", "mount_moved"]), text=st.text(max_size=600)),
    max_size=3,
).map(tuple)
AXIS = AxisReply(status="accepted", sigma=0.02, correction=-0.5, unit="deg")
SHIFT = AxisReply(status="not_solved", sigma=None, correction=0.0, unit="m")


def health(state: HealthState, reasons: tuple[Reason, ...] = ()) -> HealthReply:
    return HealthReply(
        vehicle="shuttle-7",
        pair="front",
        state=state,
        level=0,  # what it says of its level is not asked
        reasons=reasons,
        metrics={
            "overlap": MetricReply(value=0.97, limit=0.5, at_least=True, passed=True),
            "drift": MetricReply(value=None, limit=0.3, at_least=False, passed=False),
            "mi": MetricReply(value=1.5, limit=None, at_least=True, passed=True),
        },
        axes=Axes(rx=AXIS, ry=AXIS, rz=AXIS, tx=SHIFT, ty=SHIFT, tz=SHIFT),
        drift=(0.1, 0.2, None, 0.0, 0.0, None),
        needs=("3 more pairs",),
        data_quality=DataQuality(pair_rate_hz=10.0, drops={"camera": {"image_truncated": 2}}),
        since_ns=7,
        evaluated_ns=5,
        age_s=1.25,
    )


@pytest.mark.parametrize(
    ("state", "level"),
    [
        ("healthy", DiagnosticLevel.OK),
        ("suspect", DiagnosticLevel.WARN),
        ("degraded", DiagnosticLevel.WARN),
        ("miscalibrated", DiagnosticLevel.ERROR),
        ("unknown", DiagnosticLevel.STALE),
        ("stale", DiagnosticLevel.STALE),
    ],
)
def test_a_running_service_says_the_level_of_the_state(state: HealthState, level: DiagnosticLevel) -> None:
    assert level_of(health(state), "running") is level


@given(state=STATES, service=SERVICES, reasons=REASONS)
def test_ok_is_reported_only_of_what_was_checked(
    state: HealthState, service: ServicePhase, reasons: tuple[Reason, ...]
) -> None:
    reported = health(state, reasons)
    level = level_of(reported, service)
    renewed = all(reason.code != SERVICE_STUCK for reason in reasons)

    assert (level is DiagnosticLevel.OK) == (state == "healthy" and renewed and service in ("starting", "running"))
    if service == "stopping" or not renewed:
        assert level is DiagnosticLevel.STALE
    elif service == "failing":
        assert level >= DiagnosticLevel.ERROR


@given(state=STATES, service=SERVICES, reasons=REASONS)
def test_the_sentence_is_short_and_begins_with_the_state(
    state: HealthState, service: ServicePhase, reasons: tuple[Reason, ...]
) -> None:
    status = status_of_health(health(state, reasons), service, None, {})
    assert status.message.startswith(state)
    assert len(status.message) <= MAX_MESSAGE
    assert (service in status.message) or service in ("starting", "running")


def test_every_figure_is_reported_with_its_limit() -> None:
    moved = Reason(code="mount_moved", text="The mount has moved.")
    status = status_of_health(health("miscalibrated", (moved,)), "running", "SN-12", {"tf": "not published: nominal"})

    assert (status.name, status.hardware_id) == ("coec: front_calibration", "SN-12")
    assert status.message == "miscalibrated: The mount has moved."
    assert status.values == {
        "state": "miscalibrated",
        "since_ns": "7",
        "reason mount_moved": "The mount has moved.",
        "need 1": "3 more pairs",
        "age_s": "1.2",
        "evaluated_ns": "5",
        "overlap": "0.97 (at least 0.5, passed)",
        "drift": "unknown (at most 0.3, failed)",
        "drift from commissioned": "rx 0.1 deg, ry 0.2 deg, tx 0 m, ty 0 m",
        "mi": "1.5",
        **dict.fromkeys(("axis rx", "axis ry", "axis rz"), "accepted, correction -0.5 deg, sigma 0.02 deg"),
        **dict.fromkeys(("axis tx", "axis ty", "axis tz"), "not_solved, correction 0 m, sigma unknown"),
        "pair_rate_hz": "10",
        "frozen_image": "false",
        "lost camera image_truncated": "2",
        "service": "running",
        "tf": "not published: nominal",
    }


def test_without_a_serial_number_the_hardware_is_the_pair_of_the_vehicle() -> None:
    assert status_of_health(health("healthy"), "running", None, {}).hardware_id == "shuttle-7/front"


@pytest.mark.parametrize("state", get_args(SensorState))
def test_a_sensor_is_ok_only_where_it_was_checked_and_fits(state: SensorState) -> None:
    reported = status_of_sensor(sensor_reply("roof", "lidar", state), "shuttle-7", "running")
    assert (reported.level is DiagnosticLevel.OK) == (state == "calibrated")
    assert (reported.level is DiagnosticLevel.ERROR) == state.endswith("_moved")
    assert reported.level is SENSOR_LEVELS[state]
    assert (
        status_of_sensor(sensor_reply("roof", "lidar", state), "shuttle-7", "stopping").level is DiagnosticLevel.STALE
    )
    assert reported.hardware_id == "shuttle-7/roof"


def test_a_sensor_that_moved_says_by_how_much_and_in_which_pairs() -> None:
    reported = status_of_sensor(moved_lidar_sensor(), "shuttle-7", "running")
    assert reported.message == "lidar_moved: It moved by 1.00°: measured by front, left; all else fits (99.8 %)."
    assert reported.values["pairs"] == "front, left"
    assert reported.values["probability of a move"] == "0.998"
    assert reported.values["moved"].startswith("rx 0 ± 0.05 deg, ry 1 ± 0.05 deg")
    assert reported.values["moved"].endswith("tz 0 ± 0.01 m")


def test_of_a_sensor_that_nobody_checked_nothing_is_made_up() -> None:
    reported = status_of_sensor(
        sensor_reply("roof", "lidar", "unknown", probability=None, since_ns=None), "shuttle-7", "running"
    )
    assert {"probability of a move", "since_ns", "moved"}.isdisjoint(reported.values)


@given(text=st.text(max_size=4000))
def test_a_long_reason_of_a_sensor_stays_within_what_a_message_may_have(text: str) -> None:
    why = (Reason(code="moved", text=text),)
    assert (
        len(status_of_sensor(sensor_reply("roof", "lidar", "undecided", reasons=why), "v", "running").message)
        <= MAX_MESSAGE
    )
