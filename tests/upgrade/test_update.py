"""Directories that earlier versions wrote, opened by this one: nothing that a vehicle knew is dropped, and nothing
becomes green."""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coec.calibration.baseline import learned_hash
from coec.calibration.monitor.change_detector import MonitorOutcome
from coec.calibration.state import ExtrinsicHold, PairState, after_observation, restored
from coec.calibration.state_machine import HealthState
from coec.calibration.types import Rig
from coec.config import CalibrationConfig, Config, StateConfig
from coec.io.logs import LossCounter
from coec.io.rig_files import BASELINES, baseline_hash, load_baseline, rig_from_json
from coec.service.discovery import DiscoveryStore
from coec.service.recording.window_store import WindowStore
from coec.service.records.history import PairHistory
from coec.service.records.incidents import Incidents
from coec.service.records.pair_store import PairStore
from coec.service.records.rig_store import RigStore
from coec.service.records.state_store import RestoredPair, StateStore, read_pairs
from coec.service.timing import Clock
from support.vehicles import InstantDiskWriter
from upgrade.write_state import VEHICLE, checked, rules

FIXTURES = Path(__file__).with_name("fixtures")

LOST = {
    # Before likelihoods: checks were votes, and an estimate had no covariance.
    "f08669ca": {"accepted estimate", "latest estimate", "track", "monitor"},
    # Hypotheses without the place of a right mount.
    "7a90385b": {"monitor"},
    "fb619c3b": {"monitor"},
    "29ce6659": {"monitor"},
    "c56bd4c8": {"monitor"},
    "17dc249c": {"monitor"},
    "b9fd6dd1": set(),
}
"""The parts of the state that this version cannot read, by the commit that wrote the state; oldest first."""

OTHER_FIGURES = {"f08669ca", "7a90385b", "fb619c3b"}
"""Commits whose checks gave other figures, so that their baselines are kept but do not fit."""


class Vehicle:
    """A copy of what a version wrote, and what it says of it."""

    def __init__(self, commit: str, folder: Path) -> None:
        self.commit = commit
        self.folder = folder
        shutil.copytree(FIXTURES / commit / "state", folder)
        self.reported: dict[str, Any] = json.loads((FIXTURES / commit / "expected.json").read_text(encoding="utf-8"))

    def rig(self, pair: str) -> Rig:
        return rig_from_json(self.reported["pairs"][pair]["rig"], None)

    def recalled(self, pair: str) -> RestoredPair:
        remembered = StateStore(self.folder, VEHICLE).load(self.rig(pair))
        assert remembered is not None
        return remembered

    def store(self, pair: str) -> tuple[PairStore, LossCounter]:
        """The books as the service opens them."""
        config = StateConfig(directory=self.folder)
        losses = LossCounter(logging.getLogger("test"), pair)
        store = PairStore(
            self.rig(pair),
            VEHICLE,
            config,
            StateStore(self.folder, VEHICLE),
            InstantDiskWriter(self.folder),
            WindowStore(self.folder / "windows", config),
            losses,
            Clock(),
        )
        return store, losses


@pytest.fixture(params=list(LOST))
def vehicle(request: pytest.FixtureRequest, tmp_path: Path) -> Vehicle:
    return Vehicle(request.param, tmp_path / "state")


def test_there_is_a_directory_of_every_commit_and_no_other() -> None:
    assert {path.name for path in FIXTURES.iterdir() if path.is_dir()} == set(LOST)


@pytest.mark.fault(
    "an update of the software",
    "the calibration, who holds it, the alarm record and the protected windows are kept, whatever earlier version "
    "wrote them",
)
def test_an_update_keeps_the_calibration_and_the_hold(vehicle: Vehicle) -> None:
    for pair, reported in vehicle.reported["pairs"].items():
        remembered = vehicle.recalled(pair)
        state = remembered.state
        assert {lost.part for lost in remembered.lost} == LOST[vehicle.commit], pair
        assert {lost.written_by for lost in remembered.lost} <= {"older"}
        np.testing.assert_array_equal(state.T_camera_lidar, reported["T_camera_lidar"])
        assert (state.provenance, state.status, state.valid_from_ns) == (
            reported["provenance"],
            reported["status"],
            reported["valid_from_ns"],
        )
        if "accepted estimate" not in LOST[vehicle.commit]:
            assert state.accepted is not None
            assert state.accepted.window_id == reported["window_id"]
        assert (state.hold is not None) == reported["is_held"]
        if reported["hold"] is not None:
            assert state.hold == ExtrinsicHold(7_000_000_000, *reported["hold"])
        if reported["record"] is not None:
            assert {name: getattr(state.record, name) for name in reported["record"]} == reported["record"]
        assert list(remembered.commissioned_from) == reported["commissioned_from"]
        assert remembered.clocks.completed_stamp_ns == 8_000_000_000


@pytest.mark.fault("an update of the software", "nothing is green that was not, and a miscalibrated pair stays so")
def test_an_update_makes_nothing_green(vehicle: Vehicle) -> None:
    front, rear = (restored(vehicle.recalled(pair).state) for pair in ("front", "rear"))
    assert vehicle.reported["pairs"]["front"]["health"] == "healthy"
    assert front.health is HealthState.UNKNOWN
    assert vehicle.reported["pairs"]["rear"]["outcome"] == "confirmed"
    assert rear.health is HealthState.MISCALIBRATED
    assert rear.monitor.outcome is MonitorOutcome.CONFIRMED


@pytest.mark.fault(
    "an update that costs the monitor its evidence for an alarm", "only a window that agrees ends the suspicion"
)
def test_a_monitor_without_its_evidence_does_not_acquit(vehicle: Vehicle) -> None:
    state: PairState = restored(vehicle.recalled("rear").state)
    for number in range(100, 130):
        state, _ = checked(state, number, 0.0)
        if LOST[vehicle.commit]:
            assert state.health in (HealthState.MISCALIBRATED, HealthState.SUSPECT)
    assert (state.health is HealthState.HEALTHY) == (not LOST[vehicle.commit])
    front = restored(vehicle.recalled("front").state)
    _, one = checked(front, 100, 0.0)
    assert after_observation(front, one, rules()).health is HealthState.HEALTHY, "nothing was held against it"


@pytest.mark.fault("an update of the software", "the history is kept and verified, and goes on")
def test_an_update_keeps_the_history(vehicle: Vehicle) -> None:
    for pair, reported in vehicle.reported["pairs"].items():
        books = PairHistory(vehicle.folder, pair, 1000, vehicle.recalled(pair).history_heads)
        assert books.damage is None
        assert [retained.entry.text for retained in books.entries()] == reported["history"]
        assert Incidents(vehicle.folder / "evidence", pair, 4).window_ids == {f"{pair}-1"}


@pytest.mark.fault("a history that was cut off before an update of the software", "it is noticed")
def test_a_history_that_was_cut_off_is_noticed_by_the_head_of_an_earlier_version(vehicle: Vehicle) -> None:
    path = vehicle.folder / "history-front.jsonl"
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:1]))
    books = PairHistory(vehicle.folder, "front", 1000, vehicle.recalled("front").history_heads)
    assert "cut off" in str(books.damage)


@pytest.mark.fault("an update of the software", "baselines, the rig and calibrations found on the bus are kept")
def test_an_update_keeps_what_stands_next_to_the_state(vehicle: Vehicle) -> None:
    baseline = load_baseline(vehicle.folder / BASELINES, "front")
    assert baseline is not None
    if vehicle.commit not in OTHER_FIGURES:
        assert baseline_hash(baseline) == vehicle.reported["baseline"]
        assert baseline.config_hash == learned_hash(CalibrationConfig()), (
            "a setting of the objective or of the search that is added changes the hash, and drops every baseline"
        )
    rig = RigStore(vehicle.folder)
    assert rig.damage == ()
    assert sorted(rig._edges) == vehicle.reported["edges"]
    if vehicle.reported["nominal"]:
        result = DiscoveryStore(vehicle.folder).load(Config.model_validate(vehicle.reported["nominal"]))
        assert result["side"].pair.T_camera_lidar[2][3] == -0.7


@pytest.mark.fault(
    "a state in which a part has the form of another version",
    "health, log, loss count and history name the part, and the file is kept aside",
)
def test_what_is_dropped_is_reported_counted_and_quarantined(vehicle: Vehicle) -> None:
    written = (vehicle.folder / "state.json").read_bytes()
    store, losses = vehicle.store("front")
    np.testing.assert_array_equal(store.served.T_camera_lidar, vehicle.reported["pairs"]["front"]["T_camera_lidar"])
    lost = LOST[vehicle.commit]
    assert losses.snapshot() == ({("storage", "state_older"): len(lost)} if lost else {})
    noted = [retained.entry for retained in store.history.entries() if retained.entry.kind == "chain"]
    offset = vehicle.folder / "state.json.older"
    if not lost:
        assert store.damage is None
        assert not noted
        assert not offset.exists()
        return
    assert store.damage is not None
    assert store.damage.code == "state_other_version"
    assert all(f"{part} (written by an older version" in store.damage.text for part in lost)
    assert "disk" not in store.damage.text.replace("state on the disk", "")
    assert [(entry.code, entry.text) for entry in noted] == [(store.damage.code, store.damage.text)]
    assert offset.read_bytes() == written
    again, losses = vehicle.store("front")
    assert again.damage is None, "the next start finds a state of this version"
    assert losses.snapshot() == {}
    np.testing.assert_array_equal(again.served.T_camera_lidar, store.served.T_camera_lidar)
    assert again.state.hold == store.state.hold


def test_programs_next_to_the_service_read_what_it_would_serve(vehicle: Vehicle) -> None:
    pairs = read_pairs(vehicle.folder)
    assert set(pairs) == {"front", "rear"}
    for pair, (_, state) in pairs.items():
        np.testing.assert_array_equal(state.T_camera_lidar, vehicle.reported["pairs"][pair]["T_camera_lidar"])
