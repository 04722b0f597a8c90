"""What stands on a vehicle's disk: written by today's code into `data/state`, read and written again by any other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calibration.rig.test_inconsistent_edges import EDGE, RIG
from coec.calibration.rig.graph import RigGraph
from coec.config import Config
from coec.io.rig_files import BASELINES, baseline_hash, load_baselines, rig_from_json, save_baseline
from coec.service.discovery import DiscoveryStore
from coec.service.records.history import PairHistory
from coec.service.records.rig_store import RigStore
from coec.service.records.state_store import StateStore
from golden.reference import DATA, plain, read
from support.rigs import POSES, RigDrive, moved_poses
from upgrade import read_state, write_state

STATE, EXPECTED, VALUES = DATA / "state", DATA / "state_expected.json", DATA / "state_values.json"
RIG_FOLDER, RIG_AGAIN = "moved", "moved_again"
"""Of a rig while a sensor has moved; and of the same rig after a restart, which rounds its poses once more."""


def write_all(folder: Path) -> dict[str, Any]:
    """Every file of a vehicle. Returns what stands in them, as `read_state` wants to know it."""
    expected = write_state.write(folder)
    drive = RigDrive(RIG)
    drive.add_checks(POSES, 6)
    drive.add_lidar_check(EDGE, POSES)
    drive.add_checks(moved_poses("roof"), 6)
    assert drive.state.event is not None
    (folder / RIG_FOLDER).mkdir()
    book = RigStore(folder / RIG_FOLDER)
    book.update(drive.state)
    book.flush()
    _write_rig_again(folder, folder)
    return expected


def _rig_of(folder: Path) -> RigGraph:
    """The rig, built as it was when the file was written: with other last digits it would be another one."""
    stored = read(folder / RIG_FOLDER / "sensors.json")["body"]["edges"]
    edges = [replace(edge, T_a_b=np.array(stored[edge.name]["nominal"])) for edge in RIG.edges]
    return RigGraph.of(RIG.sensors, edges, RIG.links)


def _write_rig_again(folder: Path, to: Path) -> None:
    (to / RIG_AGAIN).mkdir()
    book = RigStore(to / RIG_AGAIN)
    book.update(RigStore(folder / RIG_FOLDER).restored(RigDrive(_rig_of(folder)).state))
    book.flush()


def files(folder: Path) -> dict[str, bytes]:
    """Bytes by path."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def values(folder: Path) -> dict[str, Any]:
    """What is read of a state directory, in readable form."""
    expected = read(EXPECTED)
    config = Config.model_validate(expected["nominal"])
    result = DiscoveryStore(folder).load(config)
    baselines = load_baselines(folder / BASELINES)
    rig = RigStore(folder / RIG_FOLDER)
    recalled = rig.restored(RigDrive(_rig_of(folder)).state)
    return {
        "state": read_state.read(folder, expected),
        "history": {pair: _history(folder, pair) for pair in expected["pairs"]},
        "nominal": {name: one.pair.model_dump(mode="json") for name, one in result.items()},
        "origins": {name: dict(one.origins) for name, one in result.items()},
        "baselines": {name: baseline_hash(one) for name, one in baselines.items()},
        "rig": {"damage": plain(rig.damage), "event": plain(recalled.event), "before": plain(recalled.before)},
        "poses": {name: plain(one.pose) for name, one in sorted(recalled.believed.histories.items())},
    }


def _history(folder: Path, pair: str) -> list[Any]:
    books = PairHistory(folder, pair, 1000, {})
    return [one.entry.model_dump(mode="json") for one in books.entries()]


def write_again(folder: Path, to: Path) -> None:
    """Reads the files of a folder and writes what was read into another one."""
    expected = read(EXPECTED)
    to.mkdir()
    read_store, store = StateStore(folder, write_state.VEHICLE), StateStore(to, write_state.VEHICLE)
    for document in expected["pairs"].values():
        rig = rig_from_json(document["rig"], None)
        remembered = read_store.load(rig)
        assert remembered is not None
        heads: Callable[[], dict[str, str]] = partial(dict, remembered.history_heads)
        store.update(rig, remembered.state, remembered.clocks, heads, remembered.commissioned_from)
    store.flush()
    for baseline in load_baselines(folder / BASELINES).values():
        save_baseline(to / BASELINES, baseline)
    (to / "nominal.json").write_bytes((folder / "nominal.json").read_bytes())
    DiscoveryStore(to).flush()
    _write_rig_again(folder, to)
