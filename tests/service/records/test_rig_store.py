"""A move that goes on over a restart is put right as it would have been without."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from coec.calibration.rig import rig_estimator
from coec.calibration.rig.rig_estimator import VehicleRig
from coec.calibration.types import Matrix4
from coec.geometry import se3
from coec.service.records.rig_store import RIG_FILE, RigStore
from support.rigs import POSES, STAR, RigDrive, RigPoses, graph, moved_poses, pose_of

AFTER: RigPoses = moved_poses("roof")
BLIND = "rear-roof"


@cache
def _driven() -> tuple[VehicleRig, float]:
    drive = RigDrive(graph(STAR))
    drive.add_checks(POSES, 8)
    drive.add_checks(POSES, 13, blind=(BLIND,))
    drive.add_checks(AFTER, 4, blind=(BLIND,))
    assert drive.state.event is not None
    assert drive.state.before is not None
    return drive.state, drive.at_s


def displaced() -> RigDrive:
    """The LiDAR was knocked and named; one of its cameras has seen nothing for more than a minute."""
    drive = RigDrive(graph(STAR))
    drive.state, drive.at_s = _driven()
    return drive


def restarted(rig: VehicleRig, folder: Path) -> VehicleRig:
    file = RigStore(folder)
    file.update(rig)
    file.flush()
    result = RigStore(folder)
    assert result.damage == ()
    return result.restored(rig_estimator.initial_rig(rig.graph, rig.serves, rig.windows))


def put_right(drive: RigDrive) -> Matrix4:
    """What the blind pair is told once the others have a window of after the knock."""
    drive.add_checks(AFTER, 2, blind=(BLIND,))
    for name in ("front-roof", "left-roof"):
        drive.add_window(name, AFTER, drive.at_s - 12.0)
    assert drive.state.correction is not None
    return drive.state.correction.pairs[BLIND].T_a_b


@pytest.mark.fault("a kill between the knock of a LiDAR and its correction", "the correction is the same after it")
def test_what_was_known_before_a_move_outlives_a_restart(tmp_path: Path) -> None:
    without, with_restart = displaced(), displaced()
    with_restart.state = restarted(with_restart.state, tmp_path)
    reported = put_right(with_restart)
    assert reported.tobytes() == put_right(without).tobytes()
    away = se3.difference(reported, pose_of(without.state.graph.edge[BLIND], AFTER))
    assert np.degrees(np.abs(away[:3]).max()) < 0.2, "of 1°"


def test_what_was_known_is_the_same_to_the_bit(tmp_path: Path) -> None:
    rig = displaced().state
    again = restarted(rig, tmp_path)
    assert rig.before is not None
    assert again.before is not None
    assert again.before.sensors == rig.before.sensors
    assert set(again.before.edges) == set(rig.before.edges)
    for name, known in rig.before.edges.items():
        result = again.before.edges[name]
        assert result.T_camera_lidar.tobytes() == known.T_camera_lidar.tobytes()
        assert result.uncertainty.noise.tobytes() == known.uncertainty.noise.tobytes()
        assert {key: shift.tobytes() for key, shift in result.uncertainty.systematic.items()} == {
            key: shift.tobytes() for key, shift in known.uncertainty.systematic.items()
        }
        assert result.stamp_ns == known.stamp_ns


def test_pairs_that_join_one_after_the_other_find_what_was_known_of_them(tmp_path: Path) -> None:
    rig = displaced().state
    file = RigStore(tmp_path)
    file.update(rig)
    file.flush()
    result = RigStore(tmp_path)
    grown: VehicleRig | None = None
    for count in (2, 3):
        part = graph(STAR[:count])
        serves = {name: rig.serves[name] for name in part.edge}
        windows = {name: one for name, one in rig.windows.items() if name in part.edge}
        fresh = result.restored(rig_estimator.initial_rig(part, serves, windows))
        grown = fresh if grown is None else rig_estimator.grown(grown, fresh)
    assert grown is not None
    assert grown.before is not None
    assert set(grown.before.edges) == {edge.name for edge in graph(STAR).edges}


@pytest.mark.parametrize("changed", [True, False], ids=["written in this run", "read at the start"])
def test_a_file_that_somebody_removed_is_written_again(tmp_path: Path, changed: bool) -> None:
    file = RigStore(tmp_path)
    file.flush()
    assert not (tmp_path / RIG_FILE).exists(), "there is nothing to remember"
    file.update(displaced().state)
    file.flush()
    before = (tmp_path / RIG_FILE).read_bytes()
    if not changed:
        file = RigStore(tmp_path)
    (tmp_path / RIG_FILE).unlink()
    file.flush()
    assert (tmp_path / RIG_FILE).read_bytes() == before
