"""Each part of the state of this version damaged in turn: only that part falls back, and never to something better."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coec.calibration.monitor.change_detector import MonitorOutcome, MonitorState
from coec.calibration.state import ExtrinsicHold, PairState, Provenance, after_estimate, initial_state, restored
from coec.calibration.state_machine import HealthState
from coec.calibration.types import Rig
from coec.config import MonitorConfig, PolicyConfig, TrackerConfig
from coec.errors import StateError
from coec.io.rig_files import identity_sha256, rig_identity
from coec.io.storage import StateFile
from coec.schemas.message import from_json, to_json
from coec.schemas.replies import CalibrationResult
from coec.service.records.state_store import (
    FIELDS,
    PARTS,
    STATE_FILE,
    Clocks,
    RestoredPair,
    StateStore,
    pair_from_json,
    pair_to_json,
    read_pairs,
)
from support.estimates import ESTIMATE_RIG, estimate
from upgrade.write_state import FRONT, REAR, front_state, rear_state, rules

CLOCKS = Clocks(6, 8, 4)
HEADS = {"results": f"3 {'a' * 64}"}
GONE = object()
"""Stands for a field that is removed."""


@dataclass(frozen=True)
class Seed:
    """A pair in some state, as it stands on the disk."""

    rig: Rig
    state: PairState

    @cached_property
    def text(self) -> str:
        return json.dumps(pair_to_json(self.rig, "test", self.state, CLOCKS, ("front-1",)) | {"history_heads": HEADS})

    @property
    def document(self) -> dict[str, Any]:
        return dict(json.loads(self.text))

    @cached_property
    def plain(self) -> dict[str, Any]:
        return plain(self.state)


def waiting_state() -> PairState:
    """A no candidate that contradicts what is served."""
    state = after_estimate(initial_state(ESTIMATE_RIG), estimate(1), 0, rules())
    never = type(rules())(PolicyConfig(apply="never"), TrackerConfig(), MonitorConfig())
    state = after_estimate(state, estimate(2), 0, never)
    return after_estimate(state, estimate(2), 0, never)


SEEDS = {
    "held and healthy": Seed(FRONT, front_state()[0]),
    "miscalibrated": Seed(REAR, rear_state()[0]),
    "candidate waits": Seed(FRONT, waiting_state()),
}
RED = (HealthState.SUSPECT, HealthState.MISCALIBRATED)


def read(seed: Seed, document: dict[str, Any]) -> RestoredPair:
    return pair_from_json(document, seed.rig, initial_state(seed.rig))


def damaged(seed: Seed, name: str, value: object) -> RestoredPair:
    document = seed.document
    if value is GONE:
        del document[name]
    else:
        document[name] = value
    return read(seed, document)


def part_of(name: str) -> str:
    (part,) = [part for part, form in PARTS.items() if name in form.fields]
    return part


def plain(state: PairState) -> dict[str, Any]:
    """The state as comparable values, by field."""
    document = pair_to_json(ESTIMATE_RIG, "test", state, CLOCKS, ())
    return {name: document[name] for name in FIELDS if name not in ("versions", "rig", "rig_sha256")}


FOLLOWS = {
    "rig": {"T_camera_lidar", "provenance", "valid_from_ns", "proven", "accepted", "track", "pending", "monitor"},
    "extrinsic": {"provenance", "valid_from_ns", "proven", "accepted", "monitor"},
    "provenance": {"provenance", "valid_from_ns", "proven"},
    "monitor": {"proven"},
}
"""What falls back with a part, because it has no meaning without it."""


def assert_only(seed: Seed, part: str, remembered: RestoredPair) -> None:
    """Only this part is lost, all else is as it was, and nothing is better than it was."""
    assert {lost.part for lost in remembered.lost} <= {part} | ({"extrinsic"} if part == "rig" else set())
    before, after = seed.plain, plain(remembered.state)
    may_differ = {*PARTS[part].fields, *FOLLOWS.get(part, set()), "health", "unseen_from"}
    assert {name for name in before if before[name] != after[name]} <= may_differ
    if part not in ("rig", "extrinsic"):
        assert np.array_equal(remembered.state.T_camera_lidar, seed.state.T_camera_lidar)
    if part != "heads of the history":
        assert remembered.history_heads == HEADS
    if part != "windows of the commissioning":
        assert remembered.commissioned_from == ("front-1",)
    if part != "clocks":
        assert remembered.clocks == CLOCKS
    assert remembered.state.hold is not None or seed.state.hold is None
    back = restored(remembered.state)
    assert back.health is not HealthState.HEALTHY
    assert back.health in RED or seed.state.health not in RED
    assert not (remembered.state.proven and not seed.state.proven)


WRONG = {"number": 10**30, "negative": -(2**70), "text": "x", "list": [None, "x"], "object": {"x": [1]}, "flag": True}
NAMES = sorted(FIELDS - {"versions"})


def test_every_field_on_the_disk_belongs_to_one_part() -> None:
    named = [name for part in PARTS.values() for name in part.fields]
    assert sorted([*named, "versions"]) == sorted(FIELDS)


def test_every_field_of_a_state_is_on_the_disk() -> None:
    assert {field.name for field in fields(PairState)} <= FIELDS


@pytest.mark.parametrize("seed", SEEDS.values(), ids=SEEDS)
def test_an_undamaged_state_comes_back_whole(seed: Seed) -> None:
    remembered = read(seed, seed.document)
    assert remembered.lost == ()
    assert plain(remembered.state) == seed.plain


@pytest.mark.fault("any field of the state retyped, the checksum right", "only the part of that field falls back")
@pytest.mark.parametrize("seed", SEEDS.values(), ids=SEEDS)
@pytest.mark.parametrize("name", NAMES)
def test_a_field_of_another_type_costs_its_part_alone(seed: Seed, name: str) -> None:
    for value in WRONG.values():
        remembered = damaged(seed, name, value)
        assert_only(seed, part_of(name), remembered)


@pytest.mark.fault("any field of the state removed, the checksum right", "only the part of that field falls back")
@pytest.mark.parametrize("seed", SEEDS.values(), ids=SEEDS)
@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("frozen", "health", "unseen_from")])
def test_a_field_that_is_missing_costs_its_part_alone(seed: Seed, name: str) -> None:
    remembered = damaged(seed, name, GONE)
    assert_only(seed, part_of(name), remembered)


@pytest.mark.fault("a part of the state in the form of a newer version", "it falls back alone, and the reason says so")
@pytest.mark.parametrize("seed", SEEDS.values(), ids=SEEDS)
@pytest.mark.parametrize("part", list(PARTS))
def test_a_part_of_a_newer_version_falls_back_alone(seed: Seed, part: str) -> None:
    document = seed.document
    document["versions"][part] = 99
    remembered = read(seed, document)
    assert_only(seed, part, remembered)
    (lost,) = [lost for lost in remembered.lost if lost.part == part]
    assert lost.written_by == "newer"
    assert "newer version, in form 99" in lost.text
    assert "damage" not in lost.text


@given(st.data())
@settings(max_examples=200, deadline=None, database=None, derandomize=True)
def test_whatever_stands_in_a_field_the_rest_is_read(data: st.DataObject) -> None:
    seed = data.draw(st.sampled_from(list(SEEDS.values())))
    name = data.draw(st.sampled_from(NAMES))
    document = seed.document
    document[name] = mutated(data, copy.deepcopy(document[name]))
    assert_safe(seed, name, read(seed, document))


LEAVES = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(allow_nan=False), st.text(max_size=3))


def mutated(data: st.DataObject, value: Any) -> Any:
    """The value with one thing in it, at any depth, replaced or removed."""
    inside = list(value) if isinstance(value, dict) else list(range(len(value))) if isinstance(value, list) else []
    if not inside or data.draw(st.integers(0, 3)) == 0:
        return data.draw(st.one_of(LEAVES, st.lists(LEAVES, max_size=3), st.dictionaries(st.text(max_size=3), LEAVES)))
    key = data.draw(st.sampled_from(inside))
    if isinstance(value, dict) and data.draw(st.booleans()):
        del value[key]
    else:
        value[key] = mutated(data, value[key])
    return value


def assert_safe(seed: Seed, name: str, remembered: RestoredPair) -> None:
    """A field with any content costs no other part; a state that can be written again is what is read."""
    part = part_of(name)
    assert {lost.part for lost in remembered.lost} <= {part, "extrinsic"}
    if part not in ("rig", "extrinsic"):
        assert np.array_equal(remembered.state.T_camera_lidar, seed.state.T_camera_lidar)
    if part != "hold" or name == "hold":
        assert (remembered.state.hold is None) == (seed.state.hold is None)
    if remembered.lost and part != "health":
        assert restored(remembered.state).health in RED or seed.state.health not in RED
    again = read(seed, pair_to_json(seed.rig, "test", remembered.state, remembered.clocks, ()))
    assert plain(again.state) == plain(remembered.state)


# --- what follows from what -----------------------------------------------------------------------------------------


@pytest.mark.fault("a state whose hold cannot be read", "the calibration stays held until a person releases it")
def test_a_hold_that_cannot_be_read_holds() -> None:
    seed = SEEDS["held and healthy"]
    assert damaged(seed, "frozen", "x").state.hold == seed.state.hold
    assert damaged(seed, "hold", "x").state.hold == ExtrinsicHold()
    assert damaged(SEEDS["miscalibrated"], "frozen", "x").state.hold == ExtrinsicHold()
    assert damaged(SEEDS["miscalibrated"], "hold", "x").state.hold is None


@pytest.mark.fault("a state whose extrinsic cannot be read", "nominal is served, and hold and history are kept")
def test_without_the_extrinsic_hold_and_history_are_retained() -> None:
    seed = SEEDS["held and healthy"]
    remembered = damaged(seed, "T_camera_lidar", "x")
    assert np.array_equal(remembered.state.T_camera_lidar, seed.rig.T_camera_lidar_nominal)
    assert (remembered.state.provenance, remembered.state.proven) == (Provenance.NOMINAL, False)
    assert remembered.state.hold == seed.state.hold
    assert remembered.history_heads == HEADS


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"health": "x"}, HealthState.MISCALIBRATED),
        ({"health": "x", "monitor": "x"}, HealthState.SUSPECT),
        ({"health": "x", "monitor": "x", "record": "x"}, HealthState.UNKNOWN),
        ({"monitor": "x"}, HealthState.MISCALIBRATED),
        ({"health": "stale", "unseen_from": "x"}, HealthState.MISCALIBRATED),
    ],
)
def test_health_is_no_better_than_the_rest_of_the_state_allows(
    change: dict[str, object], expected: HealthState
) -> None:
    seed = SEEDS["miscalibrated"]
    assert seed.state.health is HealthState.MISCALIBRATED
    assert read(seed, seed.document | change).state.health is expected


def test_of_a_monitor_that_cannot_be_read_what_accuses_is_retained() -> None:
    document = SEEDS["miscalibrated"].document
    document["monitor"] |= {"turned": "x", "blind": {"lens_dirty": 2.0}}
    monitor = read(SEEDS["miscalibrated"], document).state.monitor
    assert monitor == MonitorState(outcome=MonitorOutcome.CONFIRMED, blind={"lens_dirty": 2.0}, vouched=monitor.vouched)
    front = damaged(
        SEEDS["held and healthy"], "monitor", {**SEEDS["held and healthy"].document["monitor"], "turned": 3}
    )
    assert front.state.monitor.outcome is MonitorOutcome.UNKNOWN, (
        "that nothing was found is forgotten with the evidence"
    )


# --- the rig --------------------------------------------------------------------------------------------------------


def test_the_hash_of_a_rig_is_the_one_that_all_versions_know() -> None:
    assert (
        identity_sha256(rig_identity(ESTIMATE_RIG))
        == "2a962d0310f4c42053cb69cc809509435b11b11bfd04a06df067062d3be6fe40"
    )


@pytest.mark.fault("a version that knows more of a rig, or rounds differently", "it is the same rig")
@pytest.mark.parametrize(
    "change",
    [
        lambda rig: rig.update(shutter="rolling"),
        lambda rig: rig["camera"].update(fx=rig["camera"]["fx"] * (1 + 1e-15)),
        lambda rig: rig.update(sweep=None, cloud=None),
    ],
    ids=["knows more", "rounds", "writes null"],
)
def test_a_rig_is_known_by_what_identifies_it(change: Callable[[dict[str, Any]], object]) -> None:
    seed = SEEDS["held and healthy"]
    document = seed.document
    change(document["rig"])
    document["rig_sha256"] = "0" * 64
    assert read(seed, document).lost == ()


@pytest.mark.parametrize(
    "change",
    [
        lambda rig: rig["camera"].update(fx=2.001),
        lambda rig: rig["T_camera_lidar_nominal"][0].__setitem__(3, 0.0),
        lambda rig: rig.update(sweep={"period_s": 0.1, "sign": -1, "stamp_azimuth_rad": 0.0}),
        lambda rig: rig.update(lidar_frame="roof"),
        lambda rig: rig.pop("T_lidar_ego"),
    ],
)
def test_another_rig_is_another_one(change: Callable[[dict[str, Any]], object]) -> None:
    seed = SEEDS["held and healthy"]
    document = seed.document
    change(document["rig"])
    document["rig_sha256"] = "0" * 64
    with pytest.raises(StateError, match="another rig"):
        read(seed, document)


# --- files ----------------------------------------------------------------------------------------------------------


def written(folder: Path, documents: dict[str, object]) -> None:
    StateFile(folder / STATE_FILE).save({"pairs": documents})


def test_two_pairs_that_lose_parts_quarantine_one_file(tmp_path: Path) -> None:
    front, rear = SEEDS["held and healthy"].document, SEEDS["miscalibrated"].document
    front["versions"]["monitor"], rear["track"] = 99, "x"
    written(tmp_path, {"front": front, "rear": rear})
    before = (tmp_path / STATE_FILE).read_bytes()
    store = StateStore(tmp_path, "test")
    for rig in (FRONT, REAR):
        remembered = store.load(rig)
        assert remembered is not None
        store.update(rig, remembered.state, remembered.clocks, dict)
    store.flush()
    assert (tmp_path / f"{STATE_FILE}.broken").read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == [STATE_FILE, f"{STATE_FILE}.broken"]


@pytest.mark.fault(
    "a step back from a version that knows more of a pair", "all else is read, and its file is kept aside"
)
def test_a_file_with_fields_of_a_newer_version_is_quarantined(tmp_path: Path) -> None:
    seed = SEEDS["held and healthy"]
    written(tmp_path, {"front": seed.document | {"towed": {"by": "a lorry"}}})
    before = (tmp_path / STATE_FILE).read_bytes()
    store = StateStore(tmp_path, "test")
    remembered = store.load(FRONT)
    assert remembered is not None
    assert (remembered.lost, plain(remembered.state)) == ((), seed.plain)
    store.update(FRONT, remembered.state, remembered.clocks, dict)
    store.flush()
    assert (tmp_path / f"{STATE_FILE}.newer").read_bytes() == before


def test_programs_next_to_the_service_read_the_pairs_that_can_be_read(tmp_path: Path) -> None:
    front, rear = SEEDS["held and healthy"].document, SEEDS["miscalibrated"].document
    written(tmp_path, {"front": front | {"monitor": 3}, "rear": rear | {"T_camera_lidar": 3}, "": 3})
    ((pair, (_, state)),) = read_pairs(tmp_path).items()
    assert pair == "front"
    assert np.array_equal(state.T_camera_lidar, SEEDS["held and healthy"].state.T_camera_lidar)
    written(tmp_path, {"rear": rear | {"T_camera_lidar": 3}, "": 3})
    with pytest.raises(StateError, match="the extrinsic of pair rear is damaged"):
        read_pairs(tmp_path)


def test_an_accepted_estimate_reads_back_to_the_byte() -> None:
    document = SEEDS["miscalibrated"].document["accepted"]
    assert json.loads(to_json(from_json(CalibrationResult, json.dumps(document).encode()))) == document
