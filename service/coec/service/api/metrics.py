"""The state of the daemon as OpenMetrics text, or in the older text format of Prometheus: base units, `_total` for
counters, one help line each.

Every family is declared once, in `FAMILIES`. Both this text and the documentation page `docs/metrics.md` are made from
these declarations.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from itertools import accumulate
from typing import Literal, get_args

from coec.calibration.state_machine import HealthState
from coec.schemas.replies import BudgetStatus, CheckReply, HealthReply, Maybe6, PairStatus, StatusReply, StreamStatus
from coec.schemas.rig_state import RigReply, SensorState
from coec.service.api.reply_builders import AXES, UNITS
from coec.service.api.uplink import Uplink
from coec.service.timing import Histogram

ENCODING = "application/openmetrics-text"
TEXT = "text/plain"


class TextFormat(Enum):
    """Format of the text. The value is its content type in HTTP."""

    OPEN_METRICS = f"{ENCODING}; version=1.0.0; charset=utf-8"
    """OpenMetrics 1.0.0."""
    PROMETHEUS = f"{TEXT}; version=0.0.4; charset=utf-8"
    """Text format 0.0.4 of Prometheus, for readers that do not ask for OpenMetrics. It has neither units nor the types
    `info` and `stateset`, which become gauges, and its families carry the names of their samples."""


MetricSample = tuple[tuple[str, ...], float]
"""Values of a family's labels in their order, and the value of the sample."""


@dataclass(frozen=True, slots=True)
class LabelledHistogram:
    """Durations of one part of the service. `label` names the part, in front of the histogram's own labels; it may be
    empty."""

    label: tuple[str, ...]
    histogram: Histogram


@dataclass(frozen=True, slots=True)
class MetricsInput:
    """Everything that the metrics show at one moment.

    Attributes:
        status: status of the service.
        health: health of each pair.
        memory_bytes, worker_memory_bytes: resident memory of the service and of its worker.
        took: durations, by the name of their family.
        rig: what all pairs say together.
        uplink: counts of the evidence that went out.
    """

    status: StatusReply
    health: Mapping[str, HealthReply]
    memory_bytes: int = 0
    worker_memory_bytes: int = 0
    durations: Mapping[str, Sequence[LabelledHistogram]] = field(default_factory=dict)
    rig: RigReply | None = None
    uplink: Uplink | None = None


@dataclass(frozen=True, slots=True)
class Family:
    """One metric family. `samples` is empty for histograms, whose figures are in `View.took`."""

    name: str
    kind: Literal["counter", "gauge", "histogram", "info", "stateset"]
    help: str
    labels: tuple[str, ...] = ()
    samples: Callable[[MetricsInput], Iterable[MetricSample]] = lambda _: ()

    @property
    def unit(self) -> str:
        """Base unit; empty for a family without a unit, or with another unit for each sample."""
        return next((unit for unit in ("seconds", "bytes") if self.name.endswith(f"_{unit}")), "")

    @property
    def suffix(self) -> str:
        """Suffix of the names of its samples; those of a histogram have several."""
        return {"counter": "_total", "info": "_info"}.get(self.kind, "")

    def lines(self, view: MetricsInput, text_format: TextFormat) -> Iterable[str]:
        """The lines of the family."""
        if text_format is TextFormat.OPEN_METRICS:
            yield f"# TYPE {self.name} {self.kind}"
            if self.unit:
                yield f"# UNIT {self.name} {self.unit}"
            yield f"# HELP {self.name} {self.help}"
        else:
            kind = self.kind if self.kind in ("counter", "gauge", "histogram") else "gauge"
            yield f"# HELP {self.name}{self.suffix} {self.help}"
            yield f"# TYPE {self.name}{self.suffix} {kind}"
        if self.kind == "histogram":
            yield from self._buckets(view)
            return
        for values, value in self.samples(view):
            yield f"{self.name}{self.suffix}{_braces(self.labels, values)} {_number(value)}"

    def _buckets(self, view: MetricsInput) -> Iterable[str]:
        for labelled in view.durations.get(self.name, ()):
            bounds = (*labelled.histogram.bounds_s, math.inf)
            for values, counted in sorted(labelled.histogram.counted().items()):
                own = (*labelled.label, *values)
                sums = list(accumulate(counted.counts))
                for bound_s, count in zip(bounds, sums, strict=True):
                    labels = _braces((*self.labels, "le"), (*own, _number(bound_s)))
                    yield f"{self.name}_bucket{labels} {count}"
                yield f"{self.name}_count{_braces(self.labels, own)} {sums[-1]}"
                yield f"{self.name}_sum{_braces(self.labels, own)} {_number(counted.sum_s)}"


def render(view: MetricsInput, text_format: TextFormat = TextFormat.OPEN_METRICS) -> bytes:
    """The text in a format, UTF-8."""
    lines = [line for family in FAMILIES for line in family.lines(view, text_format)]
    end = ["# EOF"] if text_format is TextFormat.OPEN_METRICS else []
    return "\n".join([*lines, *end, ""]).encode()


# --- samples --------------------------------------------------------------------------------------------------------


def _one(value: Callable[[MetricsInput], float | None]) -> Callable[[MetricsInput], Iterable[MetricSample]]:
    def samples(view: MetricsInput) -> Iterable[MetricSample]:
        number = value(view)
        return () if number is None else (((), float(number)),)

    return samples


def _per_pair(value: Callable[[PairStatus], float]) -> Callable[[MetricsInput], Iterable[MetricSample]]:
    return lambda view: (((pair.name,), float(value(pair))) for pair in view.status.pairs)


def _counts(counts: Callable[[PairStatus], Mapping[str, int]]) -> Callable[[MetricsInput], Iterable[MetricSample]]:
    return lambda view: (
        ((pair.name, name), float(count)) for pair in view.status.pairs for name, count in counts(pair).items()
    )


def _of_worker(counts: Callable[[MetricsInput], Mapping[str, int]]) -> Callable[[MetricsInput], Iterable[MetricSample]]:
    return lambda view: (((name,), float(count)) for name, count in counts(view).items())


def _of_uplink(counts: Callable[[Uplink], Mapping[str, int]]) -> Callable[[MetricsInput], Iterable[MetricSample]]:
    return lambda view: (
        ()
        if view.uplink is None
        else tuple(((resource,), float(count)) for resource, count in sorted(counts(view.uplink).items()))
    )


def _of_budget(
    figures: Callable[[BudgetStatus], Mapping[tuple[str, ...], float | None]],
) -> Callable[[MetricsInput], Iterable[MetricSample]]:
    def samples(view: MetricsInput) -> Iterable[MetricSample]:
        if view.status.budget is not None:
            for labels, number in figures(view.status.budget).items():
                if number is not None:
                    yield labels, float(number)

    return samples


def _streams(value: Callable[[StreamStatus], float | None]) -> Callable[[MetricsInput], Iterable[MetricSample]]:
    def samples(view: MetricsInput) -> Iterable[MetricSample]:
        for pair in view.status.pairs:
            for name, stream in (("camera", pair.camera), ("lidar", pair.lidar), ("ego", pair.ego)):
                number = None if stream is None else value(stream)
                if number is not None:
                    yield (pair.name, name), float(number)

    return samples


def _version(view: MetricsInput) -> Iterable[MetricSample]:
    yield (view.status.version,), 1.0


def _states(view: MetricsInput) -> Iterable[MetricSample]:
    for pair, reply in view.health.items():
        for state in HealthState:
            yield (pair, state.value), float(state == reply.state)


def _sensor_states(view: MetricsInput) -> Iterable[MetricSample]:
    for sensor in () if view.rig is None else view.rig.sensors:
        for state in get_args(SensorState):
            yield (sensor.name, state), float(state == sensor.state)


def _of_rig(
    value: Callable[[RigReply], Mapping[tuple[str, ...], float | None]],
) -> Callable[[MetricsInput], Iterable[MetricSample]]:
    def samples(view: MetricsInput) -> Iterable[MetricSample]:
        numbers = {} if view.rig is None else value(view.rig)
        return tuple((labels, float(figure)) for labels, figure in numbers.items() if figure is not None)

    return samples


def _reasons(view: MetricsInput) -> Iterable[MetricSample]:
    for pair, reply in view.health.items():
        for code in sorted({reason.code for reason in reply.reasons}):
            yield (pair, code), 1.0


def _alarms(view: MetricsInput) -> Iterable[MetricSample]:
    for pair, reply in view.health.items():
        if reply.alarms is not None:
            yield (pair, "confirmed"), float(reply.alarms.confirmed)
            yield (pair, "withdrawn"), float(reply.alarms.withdrawn)


def _of_health(value: Callable[[HealthReply], float | None]) -> Callable[[MetricsInput], Iterable[MetricSample]]:
    def samples(view: MetricsInput) -> Iterable[MetricSample]:
        for pair, reply in view.health.items():
            number = value(reply)
            if number is not None:
                yield (pair,), number

    return samples


def _figures(which: Literal["value", "limit"]) -> Callable[[MetricsInput], Iterable[MetricSample]]:
    def samples(view: MetricsInput) -> Iterable[MetricSample]:
        for pair, reply in view.health.items():
            for name, metric in sorted(reply.metrics.items()):
                number = metric.value if which == "value" else metric.limit
                if number is not None:
                    yield (pair, name), number

    return samples


def _axes(choose: Callable[[HealthReply], Maybe6 | None]) -> Callable[[MetricsInput], Iterable[MetricSample]]:
    """Samples by pair, axis and unit, without unknown values."""

    def samples(view: MetricsInput) -> Iterable[MetricSample]:
        for pair, reply in view.health.items():
            for axis, unit, value in zip(AXES, UNITS, choose(reply) or (), strict=False):
                if value is not None:
                    yield (pair, axis, unit), value

    return samples


def _check_axes(choose: Callable[[CheckReply], Maybe6 | None]) -> Callable[[MetricsInput], Iterable[MetricSample]]:
    return _axes(lambda reply: None if reply.check is None else choose(reply.check))


def _derivatives(choose: Callable[[CheckReply], Maybe6]) -> Callable[[MetricsInput], Iterable[MetricSample]]:
    """Samples by pair and axis, without the unit, which the help line names."""
    by_unit = _check_axes(choose)
    return lambda view: (((pair, axis), value) for (pair, axis, _), value in by_unit(view))


def _losses(view: MetricsInput) -> Iterable[MetricSample]:
    for pair in view.status.pairs:
        places = {
            "camera": pair.camera.losses,
            "lidar": pair.lidar.losses,
            "ego": pair.ego.losses if pair.ego else {},
            "pairs": pair.rejections,
            "window": pair.losses,
        }
        for place, causes in places.items():
            for cause, count in causes.items():
                yield (pair.name, place, cause), float(count)


def _job_age(view: MetricsInput) -> Iterable[MetricSample]:
    worker = view.status.worker
    return () if worker.job_age_s is None else (((worker.job or "",), worker.job_age_s),)


# --- text -----------------------------------------------------------------------------------------------------------


def _braces(names: Sequence[str], values: Sequence[str]) -> str:
    text = ",".join(f'{name}="{_escaped(value)}"' for name, value in zip(names, values, strict=True))
    return f"{{{text}}}" if text else ""


def _number(value: float) -> str:
    """The shortest form that reads back; infinity as OpenMetrics writes it."""
    return "+Inf" if value == math.inf else f"{value:.17g}" if value.is_integer() else repr(float(value))


def _escaped(label: str) -> str:
    return label.replace("\\", r"\\").replace("\n", r"\n").replace('"', r"\"")


# --- what there is --------------------------------------------------------------------------------------------------

QUERY, DECODE, PAIR_WAIT = "coec_query_seconds", "coec_decode_seconds", "coec_pair_wait_seconds"
WRITE, JOB, WORK = "coec_write_seconds", "coec_worker_job_seconds", "coec_worker_work_seconds"
"""Names of the histograms; the keys of `View.took`."""

_PAIR, _STREAM, _AXIS = ("pair",), ("pair", "stream"), ("pair", "axis", "unit")

FAMILIES: tuple[Family, ...] = (
    Family(
        "coec_build", "info", "Version of the service.", ("version",), lambda view: (((view.status.version,), 1.0),)
    ),
    Family("coec_uptime_seconds", "gauge", "Time since the start.", (), _one(lambda view: view.status.uptime_s)),
    Family("coec_memory_bytes", "gauge", "Resident memory of the service.", (), _one(lambda view: view.memory_bytes)),
    Family("coec_health", "stateset", "State of each pair.", ("pair", "coec_health"), _states),
    Family("coec_sensor", "stateset", "State of each sensor.", ("sensor", "coec_sensor"), _sensor_states),
    Family(
        "coec_sensor_moved_probability",
        "gauge",
        "Probability that a sensor has moved.",
        ("sensor",),
        _of_rig(lambda rig: {(sensor.name,): sensor.probability for sensor in rig.sensors}),
    ),
    Family(
        "coec_rig_p_value",
        "gauge",
        "Chance that pairs which fit each other miss each other by so much.",
        (),
        _of_rig(lambda rig: {(): None if rig.joint is None else rig.joint.p_value}),
    ),
    Family(
        "coec_rig_losses",
        "counter",
        "What pairs said and was not put together in its order, by cause.",
        ("cause",),
        _of_rig(lambda rig: {(cause,): count for cause, count in rig.losses.items()}),
    ),
    Family("coec_reason", "gauge", "1 for each reason that health gives, by its code.", ("pair", "code"), _reasons),
    Family(
        "coec_check_age_seconds", "gauge", "Time since data were last judged.", _PAIR, _of_health(lambda one: one.age_s)
    ),
    Family("coec_diagnosis", "gauge", "Figures of self-diagnosis.", ("pair", "metric"), _figures("value")),
    Family("coec_diagnosis_limit", "gauge", "Their limits.", ("pair", "metric"), _figures("limit")),
    Family(
        "coec_check_offset",
        "gauge",
        "From the pose to the local optimum.",
        _AXIS,
        _check_axes(lambda check: check.offset),
    ),
    Family(
        "coec_check_offset_sigma",
        "gauge",
        "Its standard deviation.",
        _AXIS,
        _check_axes(lambda check: check.sigma),
    ),
    Family(
        "coec_check_drift",
        "gauge",
        "Local optimum from commissioned.",
        _AXIS,
        _check_axes(lambda check: check.drift),
    ),
    Family(
        "coec_check_drift_sigma",
        "gauge",
        "Its standard deviation.",
        _AXIS,
        _check_axes(lambda check: check.drift_sigma),
    ),
    Family("coec_drift", "gauge", "Served from commissioned.", _AXIS, _axes(lambda one: one.drift)),
    Family("coec_drift_sigma", "gauge", "Its standard deviation.", _AXIS, _axes(lambda one: one.drift_sigma)),
    Family("coec_result_drift", "gauge", "Last window from commissioned.", _AXIS, _axes(lambda one: one.result_drift)),
    Family("coec_result_drift_sigma", "gauge", "Its deviation.", _AXIS, _axes(lambda one: one.result_drift_sigma)),
    Family(
        "coec_mi_first_derivative",
        "gauge",
        "Nats per rad or m, at what is served.",
        ("pair", "axis"),
        _derivatives(lambda check: check.first_derivative),
    ),
    Family(
        "coec_mi_second_derivative",
        "gauge",
        "Negative, nats per rad2 or m2, at what is served.",
        ("pair", "axis"),
        _derivatives(lambda check: check.second_derivative),
    ),
    Family("coec_samples_received", "counter", "Samples that came.", _STREAM, _streams(lambda one: one.received)),
    Family("coec_samples_waiting", "gauge", "Samples not decoded yet.", _STREAM, _streams(lambda one: one.waiting)),
    Family(
        "coec_sample_age_seconds", "gauge", "Time since the last sample came.", _STREAM, _streams(lambda one: one.age_s)
    ),
    Family("coec_frames_accepted", "counter", "Frames made of samples.", _STREAM, _streams(lambda one: one.accepted)),
    Family("coec_losses", "counter", "What was lost, by cause.", ("pair", "place", "cause"), _losses),
    Family("coec_pairs", "counter", "Camera-LiDAR pairs formed.", _PAIR, _per_pair(lambda one: one.pairs)),
    Family("coec_pairs_held", "gauge", "Pairs that wait for an answer.", _PAIR, _per_pair(lambda one: one.held)),
    Family("coec_window_pairs", "gauge", "Pairs in the open window.", _PAIR, _per_pair(lambda one: one.selected)),
    Family(
        "coec_pairs_unwritten", "gauge", "Pairs that wait for the disk.", _PAIR, _per_pair(lambda one: one.unwritten)
    ),
    Family("coec_windows_recorded", "counter", "Windows recorded.", _PAIR, _per_pair(lambda one: one.windows)),
    Family("coec_windows_evaluated", "counter", "Windows evaluated.", _PAIR, _per_pair(lambda one: one.solved)),
    Family("coec_checks", "counter", "Checks of the monitor.", _PAIR, _per_pair(lambda one: one.checks)),
    Family("coec_health_changes", "counter", "States entered.", ("pair", "to"), _counts(lambda one: one.transitions)),
    Family(
        "coec_watched_seconds",
        "counter",
        "Sensor time between completed checks.",
        _PAIR,
        _of_health(lambda one: None if one.alarms is None else one.alarms.watched_s),
    ),
    Family("coec_alarms", "counter", "Alarms that ended; `withdrawn`: false ones.", ("pair", "outcome"), _alarms),
    Family("coec_commands", "counter", "Commands, by outcome.", ("pair", "command"), _counts(lambda one: one.commands)),
    Family(QUERY, "histogram", "From a query to its answer or refusal, by what was asked for.", ("resource",)),
    Family(
        "coec_queries_waiting",
        "gauge",
        "Queries that wait: `commands`, `files` for the disk, `drawing` for a picture.",
        ("queue",),
        _of_worker(lambda view: view.status.queries_waiting),
    ),
    Family(
        "coec_uplink_bytes",
        "counter",
        "Evidence that went out, by what was asked for.",
        ("resource",),
        _of_uplink(lambda uplink: uplink.sent),
    ),
    Family(
        "coec_uplink_refused",
        "counter",
        "Answers that had to wait for the uplink.",
        ("resource",),
        _of_uplink(lambda uplink: uplink.refused),
    ),
    Family(DECODE, "histogram", "Decoding of a sample, once for all pairs.", ("sensor", "stream")),
    Family(PAIR_WAIT, "histogram", "From a pair's last frame until it is looked at.", _PAIR),
    Family(WRITE, "histogram", "Writing of a pair into its window.", _PAIR),
    Family(JOB, "histogram", "From a question to the worker to its result, by kind: check, solve, ...", ("kind",)),
    Family(WORK, "histogram", "Time that the worker itself needed for a job, by kind.", ("kind",)),
    Family(
        "coec_worker_jobs",
        "counter",
        "Jobs that have ended, by fate.",
        ("fate",),
        _of_worker(lambda view: view.status.worker.outcomes),
    ),
    Family(
        "coec_worker_losses",
        "counter",
        "Jobs without a result, by cause.",
        ("cause",),
        _of_worker(lambda view: view.status.worker.losses),
    ),
    Family(
        "coec_worker_faults",
        "counter",
        "Processes replaced, by cause.",
        ("cause",),
        _of_worker(lambda view: view.status.worker.faults),
    ),
    Family(
        "coec_worker_waiting",
        "gauge",
        "Jobs that wait, by kind.",
        ("kind",),
        _of_worker(lambda view: view.status.worker.waiting),
    ),
    Family("coec_worker_job_age_seconds", "gauge", "Age of the job that the worker has.", ("kind",), _job_age),
    Family("coec_worker_restarts", "counter", "Workers replaced.", (), _one(lambda view: view.status.worker.restarts)),
    Family(
        "coec_worker_processor_seconds",
        "counter",
        "Processor time of the worker, by what for: check, solve, ...",
        ("kind",),
        _of_budget(lambda budget: {(kind,): cpu_s for kind, cpu_s in budget.spent_s.items()}),
    ),
    Family(
        "coec_budget_cores", "gauge", "What the worker may spend.", (), _of_budget(lambda budget: {(): budget.cores})
    ),
    Family(
        "coec_budget_spent_cores",
        "gauge",
        "What the worker took in the last three minutes.",
        (),
        _of_budget(lambda budget: {(): budget.spent}),
    ),
    Family(
        "coec_budget_wanted_cores",
        "gauge",
        "What every check and every window would take.",
        (),
        _of_budget(lambda budget: {(): budget.wanted}),
    ),
    Family(
        "coec_budget_stretch",
        "gauge",
        "Periods and slices are so many times as long as configured.",
        (),
        _of_budget(lambda budget: {(): budget.stretched_by}),
    ),
    Family(
        "coec_budget_store_seconds",
        "gauge",
        "Processor time in store; below 0: borrowed.",
        (),
        _of_budget(lambda budget: {(): budget.in_store_s}),
    ),
    Family(
        "coec_unseen_seconds",
        "gauge",
        "Time since the worker last looked at a pair.",
        _PAIR,
        _of_budget(lambda budget: {(name,): share.unseen_s for name, share in budget.pairs.items()}),
    ),
    Family(
        "coec_worker_memory_bytes",
        "gauge",
        "Resident memory of the worker.",
        (),
        _one(lambda view: view.worker_memory_bytes),
    ),
    Family("coec_storage_used_bytes", "gauge", "All windows.", (), _one(lambda view: view.status.storage.bytes_used)),
    Family(
        "coec_storage_free_bytes", "gauge", "Free on the disk.", (), _one(lambda view: view.status.storage.bytes_free)
    ),
    Family(
        "coec_storage_losses",
        "counter",
        "What the state directory had to give up, by cause.",
        ("cause",),
        _of_worker(lambda view: view.status.storage.losses),
    ),
)
"""All families, in the order of the text."""
