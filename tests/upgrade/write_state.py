"""Writes a state directory as the version of coec that it belongs to writes it, and beside it what stands in it.

    PYTHONPATH=service:tests python tests/upgrade/write_state.py FOLDER

Everything is made by the version's own functions, with two pairs: `front` was corrected by a window, is healthy and
held by a person; of `rear` the monitor suspects a move, and an alarm goes on.
"""

from __future__ import annotations

import json
import sys
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from coec.calibration import state as lifecycle
from coec.calibration.baseline import learned_hash
from coec.calibration.monitor.change_detector import Observation
from coec.calibration.state import ExtrinsicHold, PairRules, PairState
from coec.calibration.state_machine import AlarmRecord
from coec.calibration.types import Rig
from coec.config import CalibrationConfig, Config, MonitorConfig, PairConfig, PolicyConfig, TrackerConfig
from coec.io.baseline_file import BASELINES, baseline_hash, save_baseline
from coec.io.rig_files import rig_to_json
from coec.io.serialise import check_of, result_of, transform_of
from coec.io.storage import StateFile
from coec.schemas.replies import EvidenceEvent, HistoryEntry, Reason
from coec.service.discovery import DiscoveredPair, DiscoveryStore
from coec.service.records.history import CheckLog, PairHistory
from coec.service.records.incidents import Incidents
from coec.service.records.rig_store import RIG_FILE, RigStore
from coec.service.records.state_store import StateStore
from coec.service.records.stored_pair import Clocks
from support.estimates import ESTIMATE_RIG, a_baseline, estimate

S = 1_000_000_000
VEHICLE = "shuttle-7"
FRONT, REAR = ESTIMATE_RIG, replace(ESTIMATE_RIG, pair="rear")
SENDER, WHY = "workshop", "the mirror is being changed"
CHECKS = 8


def rules() -> PairRules:
    return PairRules(policy=PolicyConfig(apply="always"), tracker=TrackerConfig(), monitor=MonitorConfig())


def checked(state: PairState, number: int, yaw_rad: float) -> tuple[PairState, Observation]:
    """The state after a check of four new pairs that puts the mount `yaw_rad` beside the served extrinsic."""
    scatter = np.random.default_rng(number).normal(size=6) * 1e-4
    one = Observation(
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
    return lifecycle.after_observation(state, one, rules()), one


def front_state() -> tuple[PairState, list[Observation]]:
    state = lifecycle.after_estimate(lifecycle.initial_state(FRONT), estimate(1), 0, rules())
    made = []
    for number in range(CHECKS):
        state, one = checked(state, number, 0.0)
        made.append(one)
    state = lifecycle.held(state, ExtrinsicHold(7 * S, SENDER, WHY))
    return replace(state, record=AlarmRecord(3600 * S, 1, 2, False)), made


def rear_state() -> tuple[PairState, list[Observation]]:
    state = lifecycle.after_estimate(lifecycle.initial_state(REAR), estimate(2), 0, rules())
    made = []
    for number in range(2 * CHECKS):
        state, one = checked(state, number, 0.0 if number < CHECKS else 0.03)
        made.append(one)
    return replace(state, record=AlarmRecord(1800 * S, 0, 0, True)), made


def write_history(folder: Path, rig: Rig, state: PairState) -> tuple[PairHistory, list[str]]:
    """Entries of all books; returns the books, and the texts of the entries."""
    books = PairHistory(folder, rig.pair, 1000, {})
    assert state.accepted is not None

    def append(kind: str, code: str, text: str, result: Any = None, **more: Any) -> None:
        place = {"sequence": 0, "previous_sha256": 64 * "0", "wall_ns": 5 * S}
        books.append(HistoryEntry.model_validate({"kind": kind, "code": code, "text": text, **place, **more}), result)

    window_id, served = state.accepted.window_id, transform_of(state.T_camera_lidar)
    result = result_of(state.accepted, rig, VEHICLE)
    append("estimate", "accepted", "A window of 3 pairs was accepted.", result, window_id=window_id)
    append("extrinsic", "estimated", "An accepted estimate is served.", camera_from_lidar=served, window_id=window_id)
    append("state", state.health.value, "The state of health.")
    append("command", "done", "hold: held", sender=SENDER, reason=WHY)
    append("commissioned", "commissioned", "From 2 windows.")
    books.flush()
    return books, [kept.entry.text for kept in books.entries()]


def write_evidence(folder: Path, rig: Rig, state: PairState) -> str:
    event = EvidenceEvent(
        event_id=f"{rig.pair}-{9 * S}",
        vehicle=VEHICLE,
        pair=rig.pair,
        stamp_ns=9 * S,
        wall_ns=9 * S,
        reasons=(Reason(code="bent_mount", text="It moved."),),
        camera_from_lidar=transform_of(state.T_camera_lidar),
        window_before=f"{rig.pair}-1",
        metrics=(),
    )
    evidence = Incidents(folder / "evidence", rig.pair, 4)
    evidence.begin(event)
    evidence.flush()
    return event.event_id


def write_checks(folder: Path, rig: Rig, state: PairState, made: list[Observation]) -> int:
    log = CheckLog(folder / f"checks-{rig.pair}.jsonl", 100)
    for one in made[-2:]:
        log.append(check_of(one, state))
    log.flush()
    return len(log.checks())


def write_rig_file(folder: Path) -> list[str]:
    """Where the pairs of the vehicle are, as the rig keeps it; checked by the version itself."""
    nominal = ESTIMATE_RIG.T_camera_lidar_nominal.tolist()
    edge = {"nominal": nominal, "T_camera_lidar": estimate(1).optimum.T_camera_lidar.tolist(), "sigma": [1e-3] * 6}
    event = {"sensors": ["front"], "since_ns": 9 * S, "stepped_ns": 0, "named": ["front"]}
    StateFile(folder / RIG_FILE).save({"edges": {"front": edge, "rear": edge}, "event": event})
    assert not RigStore(folder).damage
    return ["front", "rear"]


def write_nominal(folder: Path) -> dict[str, Any]:
    """A calibration that was found on the bus for a pair that leaves it out; returns the configuration of it."""
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
    store = DiscoveryStore(folder)
    discovered = DiscoveredPair(PairConfig.model_validate(document), {"T_camera_lidar": "/tf_static"})
    store.update(discovered, config.awaited[0], config, S)
    store.flush()
    return configured


def write(folder: Path) -> dict[str, Any]:
    """Writes the state directory. Returns what stands in it."""
    folder.mkdir(parents=True, exist_ok=True)
    store = StateStore(folder, VEHICLE)
    told: dict[str, Any] = {"nominal": write_nominal(folder), "edges": write_rig_file(folder), "pairs": {}}
    for rig, (state, made) in ((FRONT, front_state()), (REAR, rear_state())):
        books, texts = write_history(folder, rig, state)
        commissioned_from = (f"{rig.pair}-1",)
        store.update(
            rig, state, Clocks(6 * S, 8 * S, 4 * S), partial(getattr, books, "durable_heads"), commissioned_from
        )
        told["pairs"][rig.pair] = {
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
            "hold": [SENDER, WHY] if rig is FRONT else None,
            "record": {one.name: getattr(state.record, one.name) for one in fields(state.record)},
            "commissioned_from": list(commissioned_from),
            "history": texts,
            "checks": write_checks(folder, rig, state, made),
            "event": write_evidence(folder, rig, state),
        }
    store.flush()
    baseline = replace(a_baseline(), config_hash=learned_hash(CalibrationConfig()))
    save_baseline(folder / BASELINES, baseline)
    return told | {"baseline": baseline_hash(baseline), "learned": baseline.config_hash}


if __name__ == "__main__":
    target = Path(sys.argv[1])
    expected = write(target / "state")
    (target / "expected.json").write_text(json.dumps(expected, indent=1, sort_keys=True) + "\n", encoding="utf-8")
