"""The state of the daemon as OpenMetrics text: base units, `_total` for counters, one help line each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

from coec.calibration.lifecycle import HealthState
from coec.runtime.api.extrinsic import AXES, UNITS
from coec.schemas.replies import HealthReply, Maybe6, PairStatus, StatusReply, WorkerStatus

ENCODING = "application/openmetrics-text"

Labels = Mapping[str, str]
Sample = tuple[Labels, float]


@dataclass(frozen=True, slots=True)
class _Family:
    name: str
    kind: Literal["counter", "gauge", "info", "stateset"]
    help: str
    samples: tuple[Sample, ...]

    def lines(self) -> Iterable[str]:
        suffix = {"counter": "_total", "info": "_info"}.get(self.kind, "")
        yield f"# TYPE {self.name} {self.kind}"
        yield f"# HELP {self.name} {self.help}"
        for labels, value in self.samples:
            text = ",".join(f'{name}="{_escaped(label)}"' for name, label in labels.items())
            yield f"{self.name}{suffix}{{{text}}} {value:.17g}" if text else f"{self.name}{suffix} {value:.17g}"


def render(status: StatusReply, health: Mapping[str, HealthReply], worker_rss_bytes: int) -> bytes:
    """OpenMetrics text, UTF-8. `health` maps each pair to its health; the worker's memory is in bytes."""
    pairs = status.pairs
    families = (
        _Family("coec_build", "info", "Version of the service.", (({"version": status.version}, 1.0),)),
        _Family("coec_uptime_seconds", "gauge", "Time since the start.", (({}, status.uptime_s),)),
        _Family(
            "coec_health",
            "stateset",
            "State of each pair.",
            tuple(
                ({"pair": pair, "coec_health": state.value}, float(state == current.state))
                for pair, current in health.items()
                for state in HealthState
            ),
        ),
        _Family("coec_check_age_seconds", "gauge", "Since data were last judged.", tuple(_ages(health))),
        *_diagnosis(health),
        _Family("coec_samples_received", "counter", "Samples that came.", tuple(_streams(pairs, "received"))),
        _Family("coec_frames_accepted", "counter", "Frames made of samples.", tuple(_streams(pairs, "accepted"))),
        _Family("coec_losses", "counter", "What was lost, by cause.", tuple(_losses(status))),
        _Family("coec_pairs", "counter", "Camera-LiDAR pairs formed.", _per_pair(pairs, "pairs")),
        _Family("coec_window_pairs", "gauge", "Pairs in the open window.", _per_pair(pairs, "selected")),
        _Family("coec_windows_recorded", "counter", "Windows recorded.", _per_pair(pairs, "windows")),
        _Family("coec_windows_evaluated", "counter", "Windows evaluated.", _per_pair(pairs, "solved")),
        _Family("coec_checks", "counter", "Checks of the monitor.", _per_pair(pairs, "checks")),
        _Family("coec_health_changes", "counter", "States entered.", tuple(_counts(pairs, "transitions", "to"))),
        _Family("coec_commands", "counter", "Commands, by outcome.", tuple(_counts(pairs, "commands", "command"))),
        _Family("coec_worker_restarts", "counter", "Workers replaced.", (({}, status.worker.restarts),)),
        *_worker(status.worker),
        _Family("coec_worker_memory_bytes", "gauge", "Resident memory.", (({}, float(worker_rss_bytes)),)),
        _Family("coec_storage_used_bytes", "gauge", "Bytes of all windows.", (({}, status.storage.bytes_used),)),
        _Family("coec_storage_free_bytes", "gauge", "Bytes free on the disk.", (({}, status.storage.bytes_free),)),
    )
    lines = [line for family in families for line in family.lines()]
    return "\n".join([*lines, "# EOF", ""]).encode()


def _worker(worker: WorkerStatus) -> Iterable[_Family]:
    """Every question to the worker ends, and is counted here."""

    def by(label: str, counts: Mapping[str, int]) -> tuple[Sample, ...]:
        return tuple(({label: name}, float(count)) for name, count in counts.items())

    age = () if worker.job_age_s is None else (({"kind": worker.job or ""}, worker.job_age_s),)
    return (
        _Family("coec_worker_jobs", "counter", "Jobs that have ended, by fate.", by("fate", worker.outcomes)),
        _Family("coec_worker_losses", "counter", "Jobs without a result, by cause.", by("cause", worker.losses)),
        _Family("coec_worker_faults", "counter", "Processes replaced, by cause.", by("cause", worker.faults)),
        _Family("coec_worker_waiting", "gauge", "Jobs that wait, by kind.", by("kind", worker.waiting)),
        _Family("coec_worker_job_age_seconds", "gauge", "Of what is with the worker.", age),
    )


def _diagnosis(health: Mapping[str, HealthReply]) -> Iterable[_Family]:
    """The figures of self-diagnosis: those with a limit by name, those of the six axes by axis and unit."""
    figures = [(pair, name, one) for pair, reply in health.items() for name, one in sorted(reply.metrics.items())]

    def told(values: Iterable[tuple[str, str, float | None]]) -> tuple[Sample, ...]:
        return tuple(({"pair": pair, "metric": name}, value) for pair, name, value in values if value is not None)

    def by_axis(choose: Callable[[HealthReply], Maybe6 | None]) -> tuple[Sample, ...]:
        return tuple(
            ({"pair": pair, "axis": axis, "unit": unit}, value)
            for pair, reply in health.items()
            for axis, unit, value in zip(AXES, UNITS, choose(reply) or (), strict=False)
            if value is not None
        )

    def of_check(name: str) -> Callable[[HealthReply], Maybe6 | None]:
        return lambda reply: getattr(reply.check, name, None)

    values = told((pair, name, one.value) for pair, name, one in figures)
    limits = told((pair, name, one.limit) for pair, name, one in figures)
    return (
        _Family("coec_diagnosis", "gauge", "Figures of self-diagnosis.", values),
        _Family("coec_diagnosis_limit", "gauge", "Their limits.", limits),
        _Family("coec_check_offset", "gauge", "From the pose to the local optimum.", by_axis(of_check("offset"))),
        _Family("coec_check_offset_sigma", "gauge", "Its standard deviation.", by_axis(of_check("sigma"))),
        _Family("coec_check_drift", "gauge", "Local optimum from commissioned.", by_axis(of_check("drift"))),
        _Family("coec_check_drift_sigma", "gauge", "Its standard deviation.", by_axis(of_check("drift_sigma"))),
        _Family("coec_drift", "gauge", "Served from commissioned.", by_axis(lambda reply: reply.drift)),
        _Family("coec_drift_sigma", "gauge", "Its standard deviation.", by_axis(lambda reply: reply.drift_sigma)),
        _Family("coec_result_drift", "gauge", "Last window from commissioned.", by_axis(lambda r: r.result_drift)),
        _Family("coec_result_drift_sigma", "gauge", "Its deviation.", by_axis(lambda r: r.result_drift_sigma)),
        _Family(
            "coec_mi_first_derivative",
            "gauge",
            "Nats per rad or m, at what is served.",
            _without_unit(by_axis(of_check("first_derivative"))),
        ),
        _Family(
            "coec_mi_second_derivative",
            "gauge",
            "Negative, nats per rad2 or m2, at what is served.",
            _without_unit(by_axis(of_check("second_derivative"))),
        ),
    )


def _without_unit(samples: tuple[Sample, ...]) -> tuple[Sample, ...]:
    """Derivatives: the help line names their units."""
    return tuple(({"pair": labels["pair"], "axis": labels["axis"]}, value) for labels, value in samples)


def _ages(health: Mapping[str, HealthReply]) -> Iterable[Sample]:
    for pair, reply in health.items():
        if reply.age_s is not None:
            yield {"pair": pair}, reply.age_s


def _per_pair(pairs: Iterable[PairStatus], name: str) -> tuple[Sample, ...]:
    return tuple(({"pair": pair.name}, float(getattr(pair, name))) for pair in pairs)


def _counts(pairs: Iterable[PairStatus], name: str, label: str) -> Iterable[Sample]:
    for pair in pairs:
        for key, count in getattr(pair, name).items():
            yield {"pair": pair.name, label: key}, float(count)


def _streams(pairs: Iterable[PairStatus], name: str) -> Iterable[Sample]:
    for pair in pairs:
        for stream, counts in (("camera", pair.camera), ("lidar", pair.lidar), ("ego", pair.ego)):
            if counts is not None:
                yield {"pair": pair.name, "stream": stream}, float(getattr(counts, name))


def _losses(status: StatusReply) -> Iterable[Sample]:
    for pair in status.pairs:
        places = {
            "camera": pair.camera.losses,
            "lidar": pair.lidar.losses,
            "ego": pair.ego.losses if pair.ego else {},
            "pairs": pair.rejections,
            "window": pair.losses,
        }
        for place, causes in places.items():
            for cause, count in causes.items():
                yield {"pair": pair.name, "place": place, "cause": cause}, float(count)


def _escaped(label: str) -> str:
    return label.replace("\\", r"\\").replace("\n", r"\n").replace('"', r"\"")
