"""The state of the daemon as OpenMetrics text, or in the older text format of Prometheus: base units, `_total` for
counters, one help line each.

Every family is declared once, in `FAMILIES`. Both this text and the documentation page `docs/metrics.md` are made from
these declarations.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import accumulate
from typing import Literal, get_args

from coec.calibration.state_machine import HealthState
from coec.schemas import replies
from coec.schemas.rig_state import RigReply, SensorState
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


Kind = Literal["counter", "gauge", "histogram", "info", "stateset"]

MetricSample = tuple[tuple[str, ...], float | None]
"""Values of a family's labels in their order, and the value of the sample; None: there is no such sample."""


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
        durations: durations, by the name of their family.
        rig: what all pairs say together.
        uplink: counts of the evidence that went out.
    """

    status: replies.StatusReply
    health: Mapping[str, replies.HealthReply]
    memory_bytes: int = 0
    worker_memory_bytes: int = 0
    durations: Mapping[str, Sequence[LabelledHistogram]] = field(default_factory=dict)
    rig: RigReply | None = None
    uplink: Uplink | None = None


@dataclass(frozen=True, slots=True)
class Family:
    """One metric family. `samples` is empty for histograms, whose figures are in `MetricsInput.durations`."""

    name: str
    kind: Kind
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
            if value is not None:
                yield f"{self.name}{self.suffix}{_braces(self.labels, values)} {_number(float(value))}"

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


def _single(name: str, text: str, value: Callable[[MetricsInput], float | None], kind: Kind = "gauge") -> Family:
    return Family(name, kind, text, (), lambda view: (((), value(view)),))


def _labelled(
    name: str,
    text: str,
    label: str,
    values: Callable[[MetricsInput], Mapping[str, float] | Mapping[str, float | None]],
    kind: Kind = "counter",
) -> Family:
    return Family(name, kind, text, (label,), lambda view: (((key,), value) for key, value in values(view).items()))


def _of_uplink(name: str, text: str, counts: Callable[[Uplink], Mapping[str, int]]) -> Family:
    return _labelled(
        name, text, "resource", lambda view: {} if view.uplink is None else dict(sorted(counts(view.uplink).items()))
    )


def _of_budget(name: str, text: str, value: Callable[[replies.BudgetStatus], float]) -> Family:
    return _single(name, text, lambda view: None if view.status.budget is None else value(view.status.budget))


def _of_pair(name: str, text: str, value: Callable[[replies.PairStatus], float], kind: Kind = "counter") -> Family:
    return Family(name, kind, text, ("pair",), lambda view: (((one.name,), value(one)) for one in view.status.pairs))


def _counts_of_pair(
    name: str, text: str, label: str, counts: Callable[[replies.PairStatus], Mapping[str, int]]
) -> Family:
    return Family(
        name,
        "counter",
        text,
        ("pair", label),
        lambda view: (((one.name, key), count) for one in view.status.pairs for key, count in counts(one).items()),
    )


def _of_stream(
    name: str, text: str, value: Callable[[replies.StreamStatus], float | None], kind: Kind = "counter"
) -> Family:
    def samples(view: MetricsInput) -> Iterable[MetricSample]:
        for pair in view.status.pairs:
            for stream, status in (("camera", pair.camera), ("lidar", pair.lidar), ("ego", pair.ego)):
                yield (pair.name, stream), None if status is None else value(status)

    return Family(name, kind, text, ("pair", "stream"), samples)


def _of_health(
    name: str, text: str, value: Callable[[replies.HealthReply], float | None], kind: Kind = "gauge"
) -> Family:
    return Family(
        name, kind, text, ("pair",), lambda view: (((pair,), value(reply)) for pair, reply in view.health.items())
    )


def _axes(choose: Callable[[replies.HealthReply], replies.Maybe6 | None], view: MetricsInput) -> Iterable[MetricSample]:
    """Samples by pair, axis and unit."""
    for pair, reply in view.health.items():
        for axis, unit, value in zip(replies.AXES, replies.UNITS, choose(reply) or (), strict=False):
            yield (pair, axis, unit), value


def _of_axis(name: str, text: str, choose: Callable[[replies.HealthReply], replies.Maybe6 | None]) -> Family:
    return Family(name, "gauge", text, ("pair", "axis", "unit"), lambda view: _axes(choose, view))


def _of_check(name: str, text: str, choose: Callable[[replies.CheckReply], replies.Maybe6 | None]) -> Family:
    return _of_axis(name, text, lambda reply: None if reply.check is None else choose(reply.check))


def _derivative(name: str, text: str, choose: Callable[[replies.CheckReply], replies.Maybe6]) -> Family:
    """Samples by pair and axis, without the unit, which the help line names."""
    by_unit = _of_check(name, text, choose)
    return replace(
        by_unit, labels=("pair", "axis"), samples=lambda view: ((of[:2], value) for of, value in by_unit.samples(view))
    )


def _states(view: MetricsInput) -> Iterable[MetricSample]:
    for pair, reply in view.health.items():
        for state in HealthState:
            yield (pair, state.value), state == reply.state


def _sensor_states(view: MetricsInput) -> Iterable[MetricSample]:
    for sensor in () if view.rig is None else view.rig.sensors:
        for state in get_args(SensorState):
            yield (sensor.name, state), state == sensor.state


def _reasons(view: MetricsInput) -> Iterable[MetricSample]:
    for pair, reply in view.health.items():
        for code in sorted({reason.code for reason in reply.reasons}):
            yield (pair, code), 1.0


def _alarms(view: MetricsInput) -> Iterable[MetricSample]:
    for pair, reply in view.health.items():
        if reply.alarms is not None:
            yield (pair, "confirmed"), reply.alarms.confirmed
            yield (pair, "withdrawn"), reply.alarms.withdrawn


def _figures(name: str, text: str, value: Callable[[replies.MetricReply], float | None]) -> Family:
    def samples(view: MetricsInput) -> Iterable[MetricSample]:
        for pair, reply in view.health.items():
            for figure, metric in sorted(reply.metrics.items()):
                yield (pair, figure), value(metric)

    return Family(name, "gauge", text, ("pair", "metric"), samples)


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
                yield (pair.name, place, cause), count


def _sensor_probabilities(view: MetricsInput) -> Mapping[str, float | None]:
    return {} if view.rig is None else {sensor.name: sensor.probability for sensor in view.rig.sensors}


def _rig_p_value(view: MetricsInput) -> float | None:
    return None if view.rig is None or view.rig.joint is None else view.rig.joint.p_value


def _job_age(view: MetricsInput) -> Mapping[str, float | None]:
    return {view.status.worker.job or "": view.status.worker.job_age_s}


def _unseen(view: MetricsInput) -> Mapping[str, float | None]:
    budget = view.status.budget
    return {} if budget is None else {name: share.unseen_s for name, share in budget.pairs.items()}


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
"""Names of the histograms; the keys of `MetricsInput.durations`."""

FAMILIES: tuple[Family, ...] = (
    Family("coec_build", "info", "Version of the service.", ("version",), lambda view: (((view.status.version,), 1),)),
    _single("coec_uptime_seconds", "Time since the start.", lambda view: view.status.uptime_s),
    _single("coec_memory_bytes", "Resident memory of the service.", lambda view: view.memory_bytes),
    Family("coec_health", "stateset", "State of each pair.", ("pair", "coec_health"), _states),
    Family("coec_sensor", "stateset", "State of each sensor.", ("sensor", "coec_sensor"), _sensor_states),
    _labelled(
        "coec_sensor_moved_probability",
        "Probability that a sensor has moved.",
        "sensor",
        _sensor_probabilities,
        "gauge",
    ),
    _single("coec_rig_p_value", "Chance that pairs which fit each other miss each other by so much.", _rig_p_value),
    _labelled(
        "coec_rig_losses",
        "What pairs said and was not put together in its order, by cause.",
        "cause",
        lambda view: {} if view.rig is None else view.rig.losses,
    ),
    Family("coec_reason", "gauge", "1 for each reason that health gives, by its code.", ("pair", "code"), _reasons),
    _of_health("coec_check_age_seconds", "Time since data were last judged.", lambda one: one.age_s),
    _figures("coec_diagnosis", "Figures of self-diagnosis.", lambda metric: metric.value),
    _figures("coec_diagnosis_limit", "Their limits.", lambda metric: metric.limit),
    _of_check("coec_check_offset", "From the pose to the local optimum.", lambda check: check.offset),
    _of_check("coec_check_offset_sigma", "Its standard deviation.", lambda check: check.sigma),
    _of_check("coec_check_drift", "Local optimum from commissioned.", lambda check: check.drift),
    _of_check("coec_check_drift_sigma", "Its standard deviation.", lambda check: check.drift_sigma),
    _of_axis("coec_drift", "Served from commissioned.", lambda one: one.drift),
    _of_axis("coec_drift_sigma", "Its standard deviation.", lambda one: one.drift_sigma),
    _of_axis("coec_result_drift", "Last window from commissioned.", lambda one: one.result_drift),
    _of_axis("coec_result_drift_sigma", "Its deviation.", lambda one: one.result_drift_sigma),
    _derivative(
        "coec_mi_first_derivative", "Nats per rad or m, at what is served.", lambda check: check.first_derivative
    ),
    _derivative(
        "coec_mi_second_derivative",
        "Negative, nats per rad2 or m2, at what is served.",
        lambda check: check.second_derivative,
    ),
    _of_stream("coec_samples_received", "Samples that came.", lambda one: one.received),
    _of_stream("coec_samples_waiting", "Samples not decoded yet.", lambda one: one.waiting, "gauge"),
    _of_stream("coec_sample_age_seconds", "Time since the last sample came.", lambda one: one.age_s, "gauge"),
    _of_stream("coec_frames_accepted", "Frames made of samples.", lambda one: one.accepted),
    Family("coec_losses", "counter", "What was lost, by cause.", ("pair", "place", "cause"), _losses),
    _of_pair("coec_pairs", "Camera-LiDAR pairs formed.", lambda one: one.pairs),
    _of_pair("coec_pairs_held", "Pairs that wait for an answer.", lambda one: one.held, "gauge"),
    _of_pair("coec_window_pairs", "Pairs in the open window.", lambda one: one.selected, "gauge"),
    _of_pair("coec_pairs_unwritten", "Pairs that wait for the disk.", lambda one: one.unwritten, "gauge"),
    _of_pair("coec_windows_recorded", "Windows recorded.", lambda one: one.windows),
    _of_pair("coec_windows_evaluated", "Windows evaluated.", lambda one: one.solved),
    _of_pair("coec_checks", "Checks of the monitor.", lambda one: one.checks),
    _counts_of_pair("coec_health_changes", "States entered.", "to", lambda one: one.transitions),
    _of_health(
        "coec_watched_seconds",
        "Sensor time between completed checks.",
        lambda one: None if one.alarms is None else one.alarms.watched_s,
        "counter",
    ),
    Family("coec_alarms", "counter", "Alarms that ended; `withdrawn`: false ones.", ("pair", "outcome"), _alarms),
    _counts_of_pair("coec_commands", "Commands, by outcome.", "command", lambda one: one.commands),
    Family(QUERY, "histogram", "From a query to its answer or refusal, by what was asked for.", ("resource",)),
    _labelled(
        "coec_queries_waiting",
        "Queries that wait: `commands`, `files` for the disk, `drawing` for a picture.",
        "queue",
        lambda view: view.status.queries_waiting,
        "gauge",
    ),
    _of_uplink("coec_uplink_bytes", "Evidence that went out, by what was asked for.", lambda uplink: uplink.sent),
    _of_uplink("coec_uplink_refused", "Answers that had to wait for the uplink.", lambda uplink: uplink.refused),
    Family(DECODE, "histogram", "Decoding of a sample, once for all pairs.", ("sensor", "stream")),
    Family(PAIR_WAIT, "histogram", "From a pair's last frame until it is looked at.", ("pair",)),
    Family(WRITE, "histogram", "Writing of a pair into its window.", ("pair",)),
    Family(JOB, "histogram", "From a question to the worker to its result, by kind: check, solve, ...", ("kind",)),
    Family(WORK, "histogram", "Time that the worker itself needed for a job, by kind.", ("kind",)),
    _labelled("coec_worker_jobs", "Jobs that have ended, by fate.", "fate", lambda view: view.status.worker.outcomes),
    _labelled(
        "coec_worker_losses", "Jobs without a result, by cause.", "cause", lambda view: view.status.worker.losses
    ),
    _labelled("coec_worker_faults", "Processes replaced, by cause.", "cause", lambda view: view.status.worker.faults),
    _labelled(
        "coec_worker_waiting", "Jobs that wait, by kind.", "kind", lambda view: view.status.worker.waiting, "gauge"
    ),
    _labelled("coec_worker_job_age_seconds", "Age of the job that the worker has.", "kind", _job_age, "gauge"),
    _single("coec_worker_restarts", "Workers replaced.", lambda view: view.status.worker.restarts, "counter"),
    _labelled(
        "coec_worker_processor_seconds",
        "Processor time of the worker, by what for: check, solve, ...",
        "kind",
        lambda view: {} if view.status.budget is None else view.status.budget.spent_s,
    ),
    _of_budget("coec_budget_cores", "What the worker may spend.", lambda budget: budget.cores),
    _of_budget(
        "coec_budget_spent_cores", "What the worker took in the last three minutes.", lambda budget: budget.spent
    ),
    _of_budget(
        "coec_budget_wanted_cores", "What every check and every window would take.", lambda budget: budget.wanted
    ),
    _of_budget(
        "coec_budget_stretch",
        "Periods and slices are so many times as long as configured.",
        lambda budget: budget.stretched_by,
    ),
    _of_budget(
        "coec_budget_store_seconds", "Processor time in store; below 0: borrowed.", lambda budget: budget.in_store_s
    ),
    _labelled("coec_unseen_seconds", "Time since the worker last looked at a pair.", "pair", _unseen, "gauge"),
    _single("coec_worker_memory_bytes", "Resident memory of the worker.", lambda view: view.worker_memory_bytes),
    _single("coec_storage_used_bytes", "All windows.", lambda view: view.status.storage.bytes_used),
    _single("coec_storage_free_bytes", "Free on the disk.", lambda view: view.status.storage.bytes_free),
    _labelled(
        "coec_storage_losses",
        "What the state directory had to give up, by cause.",
        "cause",
        lambda view: view.status.storage.losses,
    ),
)
"""All families, in the order of the text."""
