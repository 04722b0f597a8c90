"""What a scraper reads: families that the documentation names, in a form that a strict reader takes."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import pytest

from coec.schemas.replies import (
    Axes,
    AxisReply,
    CheckReply,
    DataQuality,
    HealthReply,
    MetricReply,
    PairStatus,
    Reason,
    StatusReply,
    StorageStatus,
    StreamStatus,
    WorkerStatus,
)
from coec.schemas.rig_state import RigReply, SensorState
from coec.service.api import metrics
from coec.service.api.metrics import FAMILIES, LabelledHistogram, MetricsInput, TextFormat
from coec.service.timing import LONG_S, QUICK_S, Histogram
from support.messages import moved_lidar_reply, reply_before_checks, status_reply
from support.readers import Family, MalformedError, parse_open_metrics


def a_health(state: str = "healthy", level: int = 0) -> HealthReply:
    """Looked at once; commissioned."""
    axis = AxisReply(status="accepted", sigma=None, correction=0.0, unit="deg")
    none = (None,) * 6
    figures = {
        "mi": MetricReply(value=0.5, limit=0.25, at_least=True, passed=True),
        "overlap": MetricReply(value=None, limit=0.5, at_least=True, passed=False),
    }
    check = CheckReply(
        stamp_ns=1,
        pair_stamps_ns=(1,),
        flagged=False,
        weak=False,
        flagged_by_paper=False,
        causes=(),
        metrics=figures,
        first_derivative=(1.0, -2.0, 3.0, None, None, None),
        second_derivative=(9.0, 8.0, 7.0, None, None, None),
        offset=none,
        sigma=none,
        drift=(0.5, None, None, None, None, None),
        drift_sigma=none,
        outcome="clear",
        evidence=0.0,
        state="healthy",
    )
    document = {
        "vehicle": "test",
        "pair": "front",
        "state": state,
        "level": level,
        "reasons": (Reason(code="no_router", text='There is "none".'),),
        "metrics": figures,
        "axes": Axes(rx=axis, ry=axis, rz=axis, tx=axis, ty=axis, tz=axis),
        "drift": (0.0, 0.0, None, 0.125, None, None),
        "check": check,
        "needs": (),
        "data_quality": DataQuality(),
        "since_ns": 0,
        "evaluated_ns": 1,
        "age_s": 2.5,
    }
    return HealthReply.model_validate(document)


def a_busy_status(state: str = "running") -> StatusReply:
    camera = StreamStatus(received=3, waiting=2, age_s=0.25, losses={"frame_id": 2})
    return status_reply(
        version='1 "a\\b\n',
        vehicle="test",
        state=state,
        uptime_s=1.5,
        pairs=(PairStatus(name="front", camera=camera, windows=4, unwritten=1, transitions={"healthy": 1}),),
        worker=WorkerStatus(state="busy", restarts=1, job="solve", job_age_s=1.0, outcomes={"result": 7}),
        storage=StorageStatus(bytes_used=10, bytes_free=2**60 + 1),
        queries_waiting={"slow": 3, "drawing": 0},
    )


def a_view() -> MetricsInput:
    query, decode, job = Histogram(QUICK_S), Histogram(QUICK_S), Histogram(LONG_S)
    for seconds in (0.00005, 0.0001, 0.002, 99.0):
        query.add(seconds, "health")
    decode.add(0.002, "camera")
    job.add(2.0, "check")
    took = {
        metrics.QUERY: [LabelledHistogram((), query)],
        metrics.DECODE: [LabelledHistogram(("front",), decode)],
        metrics.JOB: [LabelledHistogram((), job)],
    }
    return MetricsInput(a_busy_status(), {"front": a_health()}, 5, 6, took)


def read(rig: RigReply | None = None) -> dict[str, Family]:
    return parse_open_metrics(metrics.render(replace(a_view(), rig=rig)).decode())


def test_the_text_is_open_metrics_and_holds_every_family_with_its_help() -> None:
    families = read()
    assert list(families) == [family.name for family in FAMILIES]
    assert all(family.help for family in families.values())
    assert families["coec_uptime_seconds"].unit == "seconds"
    assert families["coec_storage_free_bytes"].unit == "bytes"


def test_the_older_text_format_has_the_same_samples_below_families_that_it_knows() -> None:
    view = replace(a_view(), rig=moved_lidar_reply())
    texts = {form: metrics.render(view, form).decode() for form in TextFormat}
    older = texts[TextFormat.PROMETHEUS].splitlines()
    samples = [line for line in older if not line.startswith("#")]
    assert samples == [line for line in texts[TextFormat.OPEN_METRICS].splitlines() if not line.startswith("#")]
    kinds: dict[str, str] = {}
    for line in older:
        name, _, kind = line.removeprefix("# TYPE ").partition(" ")
        if line.startswith("# TYPE "):
            assert f"# HELP {name} " in texts[TextFormat.PROMETHEUS]
            assert kind in ("counter", "gauge", "histogram")
            kinds[name] = kind
        elif not line.startswith("# HELP "):
            family = line.partition(" ")[0].partition("{")[0]
            of_histogram = family.rpartition("_")[0]
            assert kinds.get(family) in ("counter", "gauge") or kinds.get(of_histogram) == "histogram", line
            assert (kinds.get(family) == "counter") == family.endswith("_total"), line
    assert len(kinds) == len(FAMILIES)
    assert "# EOF" not in older
    assert not [line for line in older if line.startswith("# UNIT")]


def test_what_a_service_knows_is_reported() -> None:
    families = read()
    for name, suffix, labels, value in [
        ("coec_health", "", {"pair": "front", "coec_health": "healthy"}, 1),
        ("coec_health", "", {"pair": "front", "coec_health": "stale"}, 0),
        ("coec_reason", "", {"pair": "front", "code": "no_router"}, 1),
        ("coec_samples_received", "_total", {"pair": "front", "stream": "camera"}, 3),
        ("coec_samples_waiting", "", {"pair": "front", "stream": "camera"}, 2),
        ("coec_sample_age_seconds", "", {"pair": "front", "stream": "camera"}, 0.25),
        ("coec_losses", "_total", {"pair": "front", "place": "camera", "cause": "frame_id"}, 2),
        ("coec_windows_recorded", "_total", {"pair": "front"}, 4),
        ("coec_pairs_unwritten", "", {"pair": "front"}, 1),
        ("coec_worker_restarts", "_total", {}, 1),
        ("coec_worker_jobs", "_total", {"fate": "result"}, 7),
        ("coec_worker_memory_bytes", "", {}, 6),
        ("coec_queries_waiting", "", {"queue": "slow"}, 3),
        ("coec_storage_free_bytes", "", {}, 2**60),
        ("coec_uptime_seconds", "", {}, 1.5),
        ("coec_check_age_seconds", "", {"pair": "front"}, 2.5),
        ("coec_diagnosis", "", {"pair": "front", "metric": "mi"}, 0.5),
        ("coec_diagnosis_limit", "", {"pair": "front", "metric": "mi"}, 0.25),
        ("coec_mi_first_derivative", "", {"pair": "front", "axis": "ry"}, -2),
        ("coec_mi_second_derivative", "", {"pair": "front", "axis": "rx"}, 9),
        ("coec_drift", "", {"pair": "front", "axis": "tx", "unit": "m"}, 0.125),
        ("coec_check_drift", "", {"pair": "front", "axis": "rx", "unit": "deg"}, 0.5),
    ]:
        assert families[name].value(suffix, **labels) == value, name


def test_what_is_not_known_is_not_reported() -> None:
    families = read()
    reported = {labels for _, labels in families["coec_diagnosis"].samples}
    assert (("metric", "overlap"), ("pair", "front")) not in reported, "it could not be computed"
    assert not [one for _, one in families["coec_drift"].samples if dict(one)["axis"] == "rz"], "it was not estimated"
    assert {dict(labels)["stream"] for _, labels in families["coec_sample_age_seconds"].samples} == {"camera"}


def test_of_a_rig_its_sensors_are_reported_its_fit_and_what_was_lost() -> None:
    families = read(moved_lidar_reply())
    for name, suffix, labels, value in [
        ("coec_sensor", "", {"sensor": "roof", "coec_sensor": "lidar_moved"}, 1),
        ("coec_sensor", "", {"sensor": "roof", "coec_sensor": "calibrated"}, 0),
        ("coec_sensor", "", {"sensor": "left", "coec_sensor": "undecided"}, 1),
        ("coec_sensor_moved_probability", "", {"sensor": "roof"}, 0.998),
        ("coec_rig_p_value", "", {}, 1e-6),
        ("coec_rig_losses", "_total", {"cause": "late"}, 2),
    ]:
        assert families[name].value(suffix, **labels) == value, name
    states = [labels for _, labels in families["coec_sensor"].samples]
    assert len(states) == 3 * len(get_args(SensorState)), "each sensor in each state, 0 or 1"


def test_of_a_rig_of_which_nothing_is_known_no_figure_is_made_up() -> None:
    families = read(reply_before_checks())
    assert families["coec_sensor"].value("", sensor="roof", coec_sensor="unknown") == 1
    for name in ("coec_sensor_moved_probability", "coec_rig_p_value", "coec_rig_losses"):
        assert families[name].samples == {}, name
    assert read()["coec_sensor"].samples == {}, "a vehicle of one pair"


def test_durations_fall_into_buckets_that_hold_their_own_ends() -> None:
    took = read()[metrics.QUERY]
    assert took.value("_bucket", resource="health", le="0.0001") == 2
    assert took.value("_bucket", resource="health", le="0.001") == 2
    assert took.value("_bucket", resource="health", le="0.003") == 3
    assert took.value("_bucket", resource="health", le="+Inf") == took.value("_count", resource="health") == 4
    assert took.value("_sum", resource="health") == pytest.approx(99.00215)
    assert read()[metrics.DECODE].value("_count", sensor="front", stream="camera") == 1


def test_a_label_holds_whatever_text_there_is() -> None:
    ((_, labels),) = read()["coec_build"].samples
    assert dict(labels)["version"] == r"1 \"a\\b\n"


@pytest.mark.parametrize(
    ("change", "to"),
    [
        ("# EOF\n", ""),
        ("# TYPE coec_pairs counter", "# TYPE coec_pairs counted"),
        ("coec_windows_recorded_total", "coec_windows_recorded"),
        ('le="+Inf"', 'le="Inf"'),
        ('"camera"} 3', '"camera"} three'),
        ('{pair="front"} 4', '{pair="front",pair="rear"} 4'),
    ],
)
def test_the_reader_of_these_tests_is_strict(change: str, to: str) -> None:
    text = metrics.render(a_view()).decode()
    assert change in text
    with pytest.raises(MalformedError):
        parse_open_metrics(text.replace(change, to))
