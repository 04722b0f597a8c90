"""Writes a state directory as the version of coec on PYTHONPATH writes it, and beside it what stands in it.

    PYTHONPATH=service:tests python tests/upgrade/write_state.py FOLDER

It runs with versions since 22 November 2026, with the tests of that version on the path: `given` leaves out arguments
that a version does not know yet, and what has another name than in earlier versions stands with both, today's first.
Everything is made by the version's own functions, with two pairs: `front` was
corrected by a window, is healthy and held by a person; of `rear` the monitor suspects a move, and an alarm goes on.
"""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from coec.calibration.monitor.change_detector import Observation
from coec.calibration.types import Rig
from coec.config import CalibrationConfig, Config, PolicyConfig, TrackerConfig
from coec.schemas.replies import EvidenceEvent, HistoryEntry, Reason

if TYPE_CHECKING:
    from coec.calibration.state import PairState

names = import_module(f"{__package__}.names" if __package__ else "names")
"""The file beside this one, which runs as a program, too."""

RIG = names.first_of("support.estimates:ESTIMATE_RIG", "estimates:RIG")
estimate = names.first_of("support.estimates:estimate", "estimates:estimate")
a_baseline = names.first_of("support.estimates:a_baseline", "baselines:a_baseline")
lifecycle = names.first_of("coec.calibration.state", "coec.calibration.lifecycle")
learned_hash = names.first_of(
    "coec.calibration.baseline:learned_hash", "coec.calibration.commissioning.baseline:learned_hash"
)
baseline_file = names.first_of("coec.io.baseline_file", "coec.adapters.files.baseline_file", "coec.io.rig_files")
conversions = names.first_of("coec.io.serialise", "coec.adapters.files.conversions")
rig_to_json = names.first_of("coec.io.rig_files:rig_to_json", "coec.adapters.files.rig:rig_to_json")
StateFile = names.first_of("coec.io.storage:StateFile", "coec.adapters.files.state_file:StateFile")
CheckLog = names.first_of("coec.service.records.history:CheckLog", "coec.runtime.decisions.check_log:CheckLog")
PairHistory = names.first_of("coec.service.records.history:PairHistory", "coec.runtime.decisions.history:History")
Incidents = names.first_of("coec.service.records.incidents:Incidents", "coec.runtime.decisions.incidents:Incidents")
StateStore = names.first_of(
    "coec.service.records.state_store:StateStore", "coec.runtime.decisions.state_store:StateStore"
)
Clocks = names.first_of(
    "coec.service.records.state_store:Clocks",
    "coec.service.records.stored_pair:Clocks",
    "coec.runtime.decisions.stored_pair:Clocks",
    "coec.runtime.decisions.state_store:Clocks",
)

S = 1_000_000_000
VEHICLE = "shuttle-7"
FRONT, REAR = RIG, replace(RIG, pair="rear")
SENDER, WHY = "workshop", "the mirror is being changed"
CHECKS = 8


def given(make: Callable[..., Any], *args: Any, **more: Any) -> Any:
    """Calls with those of the arguments by name that this version knows."""
    known = inspect.signature(make).parameters
    return make(*args, **{name: value for name, value in more.items() if name in known})


def method(owner: Any, *called: str) -> Any:
    """The method by the first of the names that this version has."""
    return next(getattr(owner, name) for name in called if hasattr(owner, name))


def rules() -> Any:
    monitor = names.maybe("coec.config:MonitorConfig")
    parts = {"policy": PolicyConfig(apply="always"), "tracker": TrackerConfig()}
    return given(
        getattr(lifecycle, "PairRules", None) or lifecycle.Rules,
        **parts,
        monitor=None if monitor is None else monitor(),
    )


def checked(state: PairState, number: int, yaw_rad: float) -> tuple[PairState, Observation]:
    """The state after a check of four new pairs that puts the mount `yaw_rad` beside the served extrinsic."""
    scatter = np.random.default_rng(number).normal(size=6) * 1e-4
    one = given(
        Observation,
        stamp_ns=(10 + 5 * number) * S,
        pair_stamps_ns=tuple((10 + 5 * number) * S - k * S // 2 for k in (3, 2, 1, 0)),
        metrics=(),
        offset=scatter + np.array([0.0, yaw_rad, 0.0, 0.0, 0.0, 0.0]),
        sigma=np.array([2e-3] * 3 + [0.04] * 3),
        noise=np.array([1e-3] * 3 + [0.02] * 3),
        place=np.array([1e-3] * 3 + [0.01] * 3),
        dispersion=1.0,
        distance2=(yaw_rad / 4e-3) ** 2,
        flagged=abs(yaw_rad) > 4e-3,
        weak=False,
        flagged_by_paper=None,
        causes=(),
    )
    return given(lifecycle.after_observation, state, one, rules=rules()), one


def front_state() -> tuple[PairState, list[Observation]]:
    state = given(lifecycle.after_estimate, lifecycle.initial_state(FRONT), estimate(1), 0, rules())
    made = []
    for number in range(CHECKS):
        state, one = checked(state, number, 0.0)
        made.append(one)
    hold = getattr(lifecycle, "ExtrinsicHold", None) or getattr(lifecycle, "Hold", None)
    state = lifecycle.held(state) if hold is None else lifecycle.held(state, hold(7 * S, SENDER, WHY))
    record = getattr(lifecycle, "AlarmRecord", None)
    return (state if record is None else replace(state, record=record(3600 * S, 1, 2, False))), made


def rear_state() -> tuple[PairState, list[Observation]]:
    state = given(lifecycle.after_estimate, lifecycle.initial_state(REAR), estimate(2), 0, rules())
    made = []
    for number in range(2 * CHECKS):
        state, one = checked(state, number, 0.0 if number < CHECKS else 0.03)
        made.append(one)
    record = getattr(lifecycle, "AlarmRecord", None)
    return (state if record is None else replace(state, record=record(1800 * S, 0, 0, True))), made


def write_history(folder: Path, rig: Rig, state: PairState) -> tuple[Any, list[str]]:
    """Entries of all books; returns the books, and the texts of the entries."""
    if "pair" in inspect.signature(PairHistory).parameters:
        books = PairHistory(folder, rig.pair, 1000, {})
    else:
        books = PairHistory(folder / f"history-{rig.pair}.jsonl", 1000)
    assert state.accepted is not None

    def append(kind: str, code: str, text: str, result: Any = None, **more: Any) -> None:
        known = {name: value for name, value in more.items() if name in HistoryEntry.model_fields}
        place = {"sequence": 0, "previous_sha256": 64 * "0", "wall_ns": 5 * S}
        books.append(HistoryEntry.model_validate({"kind": kind, "code": code, "text": text, **place, **known}), result)

    window_id, served = state.accepted.window_id, conversions.transform_of(state.T_camera_lidar)
    result = conversions.result_of(state.accepted, rig, VEHICLE)
    append("estimate", "accepted", "A window of 3 pairs was accepted.", result, window_id=window_id)
    append("extrinsic", "estimated", "An accepted estimate is served.", camera_from_lidar=served, window_id=window_id)
    append("state", state.health.value, "The state of health.")
    append("command", "done", "hold: held", sender=SENDER, reason=WHY)
    append("commissioned", "commissioned", "From 2 windows.")
    if hasattr(books, "flush"):
        books.flush()
    return books, [retained.entry.text for retained in books.entries()]


def write_evidence(folder: Path, rig: Rig, state: PairState) -> str:
    event = EvidenceEvent(
        event_id=f"{rig.pair}-{9 * S}",
        vehicle=VEHICLE,
        pair=rig.pair,
        stamp_ns=9 * S,
        wall_ns=9 * S,
        reasons=(Reason(code="bent_mount", text="It moved."),),
        camera_from_lidar=conversions.transform_of(state.T_camera_lidar),
        window_before=f"{rig.pair}-1",
        metrics=(),
    )
    evidence = Incidents(folder / "evidence", rig.pair, 4)
    evidence.begin(event)
    if hasattr(evidence, "flush"):
        evidence.flush()
    return event.event_id


def write_checks(folder: Path, rig: Rig, state: PairState, made: list[Observation]) -> int:
    log = CheckLog(folder / f"checks-{rig.pair}.jsonl", 100)
    for one in made[-2:]:
        log.append(conversions.check_of(one, state))
    if hasattr(log, "flush"):
        log.flush()
    return len(log.checks())


def write_rig_file(folder: Path) -> list[str]:
    """Where the pairs of the vehicle are, as the rig keeps it; checked by the version itself."""
    store = names.maybe("coec.service.records.rig_store:RigStore", "coec.runtime.rig.rig_file:RigFile")
    if store is None:
        return []
    nominal = RIG.T_camera_lidar_nominal.tolist()
    edge = {"nominal": nominal, "T_camera_lidar": estimate(1).optimum.T_camera_lidar.tolist(), "sigma": [1e-3] * 6}
    event = {"sensors": ["front"], "since_ns": 9 * S, "stepped_ns": 0, "named": ["front"]}
    StateFile(folder / "sensors.json").save({"edges": {"front": edge, "rear": edge}, "event": event})
    assert not store(folder).damage
    return ["front", "rear"]


def write_nominal(folder: Path) -> dict[str, Any]:
    """A calibration that was found on the bus for a pair that leaves it out; returns the configuration of it."""
    store = names.maybe("coec.service.discovery:DiscoveryStore", "coec.runtime.nominal.kept:KeptNominals")
    if store is None:
        return {}
    detected = names.first_of("coec.service.discovery:DiscoveredPair", "coec.runtime.nominal.findings:Found")
    pair_config = names.first_of("coec.config:PairConfig")
    configured = {"middleware": "rmw_zenoh", "pairs": [{"name": "side", "camera": "/side/image", "points": "/top"}]}
    config = Config.model_validate(configured)
    document = {
        "name": "side",
        "camera": {
            "topic": "/side/image",
            "frame_id": "cam",
            "intrinsics": {"model": "pinhole", "width": 8, "height": 6, "fx": 4.0, "fy": 4.0, "cx": 4.0, "cy": 3.0},
        },
        "lidar": {"topic": "/top", "frame_id": "top"},
        "T_camera_lidar": [[0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, 0.2], [1.0, 0.0, 0.0, -0.7], [0.0, 0.0, 0.0, 1.0]],
    }
    book = store(folder)
    discovered = detected(pair_config.model_validate(document), {"T_camera_lidar": "/tf_static"})
    method(book, "update", "keep")(discovered, config.awaited[0], config, S)
    book.flush()
    return configured


def write(folder: Path) -> dict[str, Any]:
    """Writes the state directory. Returns what stands in it."""
    folder.mkdir(parents=True, exist_ok=True)
    store = StateStore(folder, VEHICLE)
    update = method(store, "update", "remember")
    reported: dict[str, Any] = {"nominal": write_nominal(folder), "edges": write_rig_file(folder), "pairs": {}}
    for rig, (state, made) in ((FRONT, front_state()), (REAR, rear_state())):
        books, texts = write_history(folder, rig, state)
        heads = books.durable_heads if hasattr(books, "durable_heads") else books.durable_head
        heads = heads() if callable(heads) else heads
        by_call = "Callable" in str(inspect.signature(update).parameters.get("history_heads"))
        clocks = Clocks(6 * S, 8 * S, 4 * S)
        more = {"commissioned_from": (f"{rig.pair}-1",)}
        given(update, rig, state, clocks, (lambda retained=heads: retained) if by_call else heads, **more)
        reported["pairs"][rig.pair] = {
            "rig": rig_to_json(rig),
            "T_camera_lidar": state.T_camera_lidar.tolist(),
            "provenance": state.provenance.value,
            "status": state.status.value,
            "valid_from_ns": state.valid_from_ns,
            "window_id": state.accepted.window_id if state.accepted else None,
            "proven": state.proven,
            "health": state.health.value,
            "outcome": state.monitor.outcome.value,
            "evidence": state.monitor.evidence,
            "is_held": rig is FRONT,
            "hold": [SENDER, WHY] if rig is FRONT and hasattr(state, "hold") else None,
            "record": {one.name: getattr(state.record, one.name) for one in fields(state.record)}
            if hasattr(state, "record")
            else None,
            "commissioned_from": list(more["commissioned_from"])
            if "commissioned_from" in inspect.signature(update).parameters
            else [],
            "history": texts,
            "checks": write_checks(folder, rig, state, made),
            "event": write_evidence(folder, rig, state),
        }
    if hasattr(store, "flush"):
        store.flush()
    baseline = replace(a_baseline(), config_hash=learned_hash(CalibrationConfig()))
    baseline_file.save_baseline(folder / baseline_file.BASELINES, baseline)
    return reported | {"baseline": baseline_file.baseline_hash(baseline), "learned": baseline.config_hash}


if __name__ == "__main__":
    target = Path(sys.argv[1])
    expected = write(target / "state")
    (target / "expected.json").write_text(json.dumps(expected, indent=1, sort_keys=True) + "\n", encoding="utf-8")
