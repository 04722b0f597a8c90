"""SIGHUP: what of a changed configuration a running pair takes, when, and what waits."""

from __future__ import annotations

import fnmatch
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from coec.config import IDENTITY, Config, PairConfig, WindowConfig
from coec.errors import ConfigError
from coec.service.configuration import RELOADED, Reload, reload_of, settings_hash
from coec.service.discovery import completed
from coec.service.worker.worker_jobs import Kind, WorkerJob
from support.vehicles import BEGIN_S, OracleWorker, PairBench, pair_configuration

INTRINSICS = {"model": "pinhole", "width": 8, "height": 6, "fx": 4.0, "fy": 4.0, "cx": 4.0, "cy": 3.0}


@dataclass
class Attentive(OracleWorker):
    """Remembers by which settings it was to check."""

    requested: list[Any] = field(default_factory=list)

    def submit(self, job: WorkerJob) -> None:
        if job.kind is Kind.CHECK:
            self.requested.append(job.body["configuration"])
        super().submit(job)


def changed(config: Config, **places: Any) -> Config:
    """`config` with other values; places as `pairs__0__policy__apply`."""
    document = json.loads(config.model_dump_json())
    for place, value in places.items():
        *head, last = place.split("__")
        inside: Any = document
        for name in head:
            inside = inside[int(name)] if name.isdigit() else inside[name]
        inside[last] = value
    return Config.model_validate(document)


def reloaded(config: Config, **places: Any) -> Reload:
    return reload_of(config, changed(config, **places))


def use(bench: PairBench, fresh: Reload) -> None:
    (pair,) = fresh.config.pairs
    bench.pair.reconfigure(pair, fresh.config.stale_after_s, "The test.")
    bench.settle()


def test_nothing_that_differs_changes_nothing(tmp_path: Path) -> None:
    config = pair_configuration(tmp_path)
    assert reloaded(config) == Reload(config, (), ())


def test_a_pair_that_was_discovered_is_compared_as_it_was_discovered_and_one_that_is_pending_waits() -> None:
    rear = {"name": "rear", "camera": "/rear/image", "points": "/top/points"}
    read = Config.model_validate(
        {"middleware": "rmw_zenoh", "pairs": [{**rear, "name": "front", "camera": "/front/image"}, rear]}
    )
    camera = {"topic": "/front/image", "frame_id": "camera", "intrinsics": INTRINSICS}
    lidar = {"topic": "/top/points", "frame_id": "lidar"}
    front = PairConfig.model_validate({"name": "front", "camera": camera, "lidar": lidar, "T_camera_lidar": IDENTITY})
    result = {"front": front}
    running = completed(read, result)
    assert reload_of(running, completed(read, result)) == Reload(running, (), ())

    window = {"window": WindowConfig(pairs=12)}
    other = read.model_copy(update={"awaited": tuple(pair.model_copy(update=window) for pair in read.awaited)})
    result = {"front": front.model_copy(update=window)}
    fresh = reload_of(running, completed(other, result))
    assert fresh.taken == ("pairs.front.window.pairs",)
    assert fresh.waiting == ("awaited.rear.window.pairs",)
    assert fresh.config.pairs[0].window.pairs == 12
    assert fresh.config.awaited == running.awaited


def test_what_can_be_taken_is_and_the_rest_waits(tmp_path: Path) -> None:
    config = pair_configuration(tmp_path)
    fresh = reloaded(
        config,
        log__level="debug",
        stale_after_s=5.0,
        vehicle="other",
        worker__threads=1,
        authority__anonymous="never",
        authority__senders=[{"name": "fleet"}],
        authority__certificate="v.pem",
        authority__private_key="k.pem",
        authority__root_ca="ca.pem",
        pairs__0__policy__apply="never",
        pairs__0__window__min_pairs=7,
        pairs__0__calibration__verdict__min_overlap=0.25,
        pairs__0__calibration__depth__model="street",
        pairs__0__camera__key="in/other",
        pairs__0__monitor__period_s=7.0,
        pairs__0__monitor__hours_between_false_alarms=7.0,
    )
    assert set(fresh.taken) == {
        "log.level",
        "stale_after_s",
        *(f"authority.{name}" for name in ("anonymous", "senders", "certificate", "private_key", "root_ca")),
        "pairs.front.policy.apply",
        "pairs.front.window.min_pairs",
        "pairs.front.calibration.verdict.min_overlap",
        "pairs.front.monitor.hours_between_false_alarms",
    }
    assert set(fresh.waiting) == {
        "vehicle",
        "worker.threads",
        "pairs.front.calibration.depth.model",
        "pairs.front.camera.key",
        "pairs.front.monitor.period_s",
    }
    (pair,) = fresh.config.pairs
    assert (pair.policy.apply, pair.camera.key, fresh.config.vehicle) == ("never", "in/camera", "test")
    again = reload_of(fresh.config, fresh.config)
    assert (again.taken, again.waiting) == ((), ())


def test_pairs_that_come_and_go_wait(tmp_path: Path) -> None:
    config = pair_configuration(tmp_path)
    (front,) = config.pairs
    dotted = front.model_copy(update={"name": "a.policy.b"})
    two = config.model_copy(update={"pairs": (dotted, front)})
    assert reload_of(config, two) == Reload(config, (), ("pairs.a.policy.b",))
    assert reload_of(two, config) == Reload(two, (), ("pairs.a.policy.b",))
    camera = dotted.camera.model_copy(update={"key": "in/other"})
    moved = config.model_copy(update={"pairs": (dotted.model_copy(update={"camera": camera}), front)})
    assert reload_of(two, moved).taken == (), "the name of a pair is no place in it"


@pytest.mark.fault("SIGHUP with a configuration that could not be started with", "refused as a whole, nothing changes")
def test_what_could_not_be_started_with_is_refused_as_a_whole(tmp_path: Path) -> None:
    config = pair_configuration(tmp_path)
    for places in (
        {"zenoh__connect": ["tcp/nowhere"]},
        {"pairs__0__camera__mask": str(tmp_path / "none.png")},
        {"pairs__0__calibration__depth__model": str(tmp_path / "none.onnx")},
    ):
        with pytest.raises(ConfigError):
            reload_of(config, changed(config, log__level="debug", **places))


def test_every_declared_place_is_one(tmp_path: Path) -> None:
    def places(value: Any, names: tuple[str, ...]) -> list[tuple[str, ...]]:
        if not isinstance(value, dict):
            return [names]
        return [one for name, below in value.items() for one in places(below, (*names, name))]

    document = pair_configuration(tmp_path).model_dump()
    document["pairs"] = {"front": document["pairs"][0]}
    known = places(document, ())
    for pattern in RELOADED:
        chunks = pattern.split(".")
        fitting = [one for one in known if len(one) == len(chunks) and all(map(fnmatch.fnmatchcase, one, chunks))]
        assert fitting, pattern


def test_a_policy_holds_from_the_next_answer_on(tmp_path: Path) -> None:
    bench = PairBench(tmp_path / "state")
    use(bench, reloaded(bench.config, pairs__0__policy__apply="never"))
    bench.drive(BEGIN_S, BEGIN_S + 60)
    state = bench.store.state
    assert state.pending is not None, "an estimate came, and waits for a person"
    (entry,) = (one for one in bench.entries("command") if one.text.startswith("reload"))
    assert (entry.code, entry.sender) == ("reloaded", "SIGHUP")
    same = PairBench(tmp_path / "other")
    same.drive(BEGIN_S, BEGIN_S + 60)
    assert same.store.state.pending is None, "as it would have been applied otherwise"


def test_the_length_of_windows_holds_from_the_next_slice_on(tmp_path: Path) -> None:
    bench = PairBench(tmp_path / "state")
    bench.drive(BEGIN_S, BEGIN_S + 10)
    end_ns = bench.pair.engine.selector.slice_end_ns
    use(bench, reloaded(bench.config, pairs__0__window__slice_s=20.0, pairs__0__window__min_pairs=6))
    assert bench.pair.engine.selector.slice_end_ns == end_ns, "the open one ends as it began"
    bench.drive(BEGIN_S + 10, BEGIN_S + 45)
    assert bench.pair.engine.selector.slice_end_ns == (BEGIN_S + 60) * 10**9, "the next one has its own length"


def test_checks_and_windows_say_by_which_settings(tmp_path: Path) -> None:
    bench = PairBench(tmp_path / "state", worker=Attentive)
    before = bench.recorder.plan.metadata["settings_hash"]
    fresh = reloaded(bench.config, pairs__0__calibration__verdict__min_overlap=0.25)
    use(bench, fresh)
    (pair,) = fresh.config.pairs
    assert bench.recorder.configuration.verdict.min_overlap == 0.25
    assert bench.recorder.plan.metadata["settings_hash"] == settings_hash(pair) != before
    bench.drive(BEGIN_S, BEGIN_S + 20)
    assert isinstance(bench.worker, Attentive)
    assert {one["verdict"]["min_overlap"] for one in bench.worker.requested} == {0.25}
