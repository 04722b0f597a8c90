"""Rendered drives of a rig: which looks are taken, and what is made of them."""

from __future__ import annotations

from itertools import pairwise
from math import radians

import numpy as np
import pytest

pytest.importorskip("embreex", reason="needs embreex")

from coec.calibration.types import Matrix4
from coec.geometry import se3
from coec.schemas.replies import Vector6
from coec_lab.experiments import rig_drives
from coec_lab.experiments.check_drives import CHECK_PAIRS
from coec_lab.experiments.rig_drives import (
    DISPLACEMENTS,
    FIRST_SEED,
    LIDAR,
    PERIOD_S,
    TURN_S,
    DisplacedRigDrive,
    SensorDisplacement,
    answer_ns,
    driven,
    due,
    moves_of,
    report,
    request_stamps_ns,
    variant,
)
from coec_lab.experiments.simulation_schemas import Mounts, RigDriveRow, RigLook, RigWindow
from coec_lab.simulation.journey import START_NS
from coec_lab.simulation.rig_drive import RigDrive

CAMERA = "fisheye1400"
NOISE = np.array([radians(0.05)] * 3 + [0.015] * 3)
SIGMA = np.array([radians(0.14)] * 3 + [0.033] * 3)
PLACE = np.array([radians(0.06)] * 3 + [0.01] * 3)
NOBODY, ONE_CAMERA, THE_LIDAR, TWO_CAMERAS = DISPLACEMENTS


def six(values: np.ndarray) -> Vector6:
    rx, ry, rz, tx, ty, tz = (float(value) for value in values)
    return rx, ry, rz, tx, ty, tz


def truth(drive: DisplacedRigDrive, camera: str, mounts: Mounts, stamp_ns: int) -> Matrix4:
    def pose(sensor: str, mount: Mounts) -> Matrix4:
        of: RigDrive = drive.displaced if mounts is mount else drive.right
        return of.T_sensor_ego(sensor, stamp_ns)

    return np.asarray(pose(camera, Mounts.CAMERA) @ se3.inverse(pose(LIDAR, Mounts.LIDAR)))


def rendered(number: int) -> RigDriveRow:
    """Looks as those of a drive that was rendered: at the truth, but for noise."""
    drive, rng, observations = DisplacedRigDrive(number, CAMERA), np.random.default_rng(number), []
    for turn in range(CHECK_PAIRS, round((drive.at_s + 22.0) / TURN_S)):
        stamps_ns = tuple(START_NS + round((turn - k) * TURN_S * 1e9) for k in range(CHECK_PAIRS, 0, -1))
        for camera in due(turn, drive.right.cameras):
            served, noise = drive.served[f"{camera}-{LIDAR}"], NOISE * rng.normal(size=6)
            for mounts in Mounts:
                if mounts is Mounts.CAMERA and camera not in drive.cameras:
                    continue
                offset = se3.difference(truth(drive, camera, mounts, stamps_ns[-1]), served) + noise
                observations.append(
                    RigLook(
                        edge=f"{camera}-{LIDAR}", mounts=mounts, pair_stamps_ns=stamps_ns, offset=six(offset),
                        sigma=six(SIGMA), noise=six(NOISE), place=six(PLACE), dispersion=1.0, distance2=0.5,
                        flagged=False, weak=False, causes=(),
                    )
                )  # fmt: skip
    return RigDriveRow(name=drive.name, seed=FIRST_SEED + number, camera=CAMERA, looks=tuple(observations))


def flagged(row: RigDriveRow, edge: str, *, weak: bool = False) -> RigDriveRow:
    """The looks of a pair whose camera was knocked accuse the mount, if it was."""

    def reported(observation: RigLook) -> RigLook:
        moved = observation.edge == edge and observation.mounts is Mounts.CAMERA
        late = observation.pair_stamps_ns[0] - START_NS > DisplacedRigDrive(1, CAMERA).at_s * 1e9
        return (
            observation.model_copy(update={"flagged": True, "weak": weak, "distance2": 40.0})
            if moved and late
            else observation
        )

    return row.model_copy(update={"looks": tuple(map(reported, row.looks))})


@pytest.fixture(scope="module")
def rows() -> list[RigDriveRow]:
    return [rendered(1)]


def test_pairs_take_turns_and_each_is_checked_once_in_a_period() -> None:
    turns = [(turn, pair) for turn in range(60) for pair in due(turn, ("a", "b", "c", "d"))]
    assert {pair for turn, pair in turns if turn < 2 * CHECK_PAIRS} == {"a", "b", "c", "d"}
    assert len({turn for turn, _ in turns}) == len(turns), "never two at once: who moved is asked of each"
    for name in "abcd":
        own = [turn for turn, pair in turns if pair == name]
        assert own[0] >= CHECK_PAIRS
        assert set(np.diff(own)) == {round(PERIOD_S / TURN_S)}


def test_those_that_were_displaced_are_named_fault_by_fault(rows: list[RigDriveRow]) -> None:
    reported = report([*rows, rows[0].model_copy(update={"looks": (), "failure": "CalibrationError: no"})], CAMERA)
    assert (reported.drives, reported.failed, reported.faint, reported.blind) == (1, 1, 0, 0)
    assert reported.looks == sum(len(row.looks) for row in rows)
    by_fault = {row.fault: row for row in reported.moves}
    for fault, row in by_fault.items():
        assert (row.drives, row.undecided) == (1, 0), fault
        assert (row.right, row.wrong) == ((0, 1) if row.each[0].wrong else (1, 0)), fault
        assert row.each[0].named_s is not None, "at some time exactly those that were knocked are named"
    assert by_fault[NOBODY.name].right == by_fault[ONE_CAMERA.name].right == 1
    for knock, moved in ((NOBODY, 0), (ONE_CAMERA, 1), (THE_LIDAR, 1), (TWO_CAMERAS, 2)):
        row = by_fault[knock.name]
        assert all(len(one.moved) == moved for one in row.each)
        assert all(0.0 <= one.named_s <= 30.0 for one in row.each if one.named_s is not None)
    assert by_fault[THE_LIDAR.name].each[0].moved == (LIDAR,)
    assert by_fault[NOBODY.name].alarms_s == ()
    assert len(by_fault[TWO_CAMERAS.name].alarms_s) == 1


def test_a_sensor_that_stood_still_and_is_named_counts_as_wrong(rows: list[RigDriveRow]) -> None:
    """The looks of a knocked camera, told as those of a drive on which nobody was."""
    drive = DisplacedRigDrive(1, CAMERA)
    edge = f"{drive.cameras[0]}-{LIDAR}"
    swapped = tuple(
        observation.model_copy(update={"mounts": Mounts.AS_BUILT})
        for observation in rows[0].looks
        if observation.mounts is (Mounts.CAMERA if observation.edge == edge else Mounts.AS_BUILT)
    )
    reported = moves_of(rows[0].model_copy(update={"looks": swapped}), NOBODY)
    assert reported.wrong == (drive.cameras[0],)
    assert reported.wrong_s is not None
    assert reported.wrong_s >= 0.0


def test_one_that_nothing_determines_of_is_not_named(rows: list[RigDriveRow]) -> None:
    drive = DisplacedRigDrive(1, CAMERA)
    blind = tuple(observation for observation in rows[0].looks if not observation.edge.startswith(drive.cameras[0]))
    reported = moves_of(rows[0].model_copy(update={"looks": blind}), SensorDisplacement("one camera", cameras=1))
    assert (reported.named_s, reported.wrong) == (None, ())


def test_a_pair_that_suspects_a_move_requests_windows_and_not_again_before_the_answer(rows: list[RigDriveRow]) -> None:
    drive = DisplacedRigDrive(1, CAMERA)
    knock_ns, period_ns = START_NS + drive.at_s * 1e9, PERIOD_S * 1e9
    edge = f"{drive.cameras[0]}-{LIDAR}"
    observations, late_ns = flagged(rows[0], edge).looks, answer_ns(Mounts.CAMERA)
    assert list(request_stamps_ns(drive.served[edge], variant(observations, edge, Mounts.AS_BUILT), late_ns)) == []
    first, *others = request_stamps_ns(drive.served[edge], variant(observations, edge, Mounts.CAMERA), late_ns)
    assert knock_ns < first < knock_ns + 4 * period_ns
    assert all(later - earlier >= late_ns for earlier, later in pairwise([first, *others]))


@pytest.mark.slow  # the attribution has a short form: calibration/rig/test_attribution.py
def test_where_observations_are_too_faint_an_accepted_window_names_the_camera(rows: list[RigDriveRow]) -> None:
    drive = DisplacedRigDrive(1, CAMERA)
    edge = f"{drive.cameras[0]}-{LIDAR}"
    faint = flagged(rows[0], edge, weak=True)
    begin_ns = START_NS + round((drive.at_s + 8.0) * 1e9)
    offset = se3.difference(truth(drive, drive.cameras[0], Mounts.CAMERA, begin_ns), drive.served[edge])
    noise = np.diag(np.array([radians(0.03)] * 3 + [0.01] * 3) ** 2)
    known_ns = begin_ns + 20_500_000_000
    window = RigWindow.model_validate(
        {
            "edge": edge, "mounts": Mounts.CAMERA, "first_ns": begin_ns, "last_ns": begin_ns + 20_000_000_000,
            "known_ns": known_ns, "accepted": True, "reasons": (), "offset": six(offset), "noise": noise.tolist(),
            "systematic": {},
        }
    )  # fmt: skip
    refused = window.model_copy(update={"accepted": False})
    assert moves_of(faint.model_copy(update={"windows": (refused,)}), ONE_CAMERA).named_s is None
    named = moves_of(faint.model_copy(update={"windows": (window,)}), ONE_CAMERA)
    assert named.named_s == pytest.approx((known_ns - START_NS) / 1e9 - drive.at_s)
    assert named.wrong == ()


@pytest.mark.slow
def test_a_drive_is_rendered_and_checked_pair_by_pair(monkeypatch: pytest.MonkeyPatch) -> None:
    """As small and short as it goes: what the looks say of so few pixels is of no interest."""
    monkeypatch.setattr(rig_drives, "AT_S", (6.5, 6.6))
    monkeypatch.setattr(rig_drives, "AFTER_S", 2.0)
    drive = DisplacedRigDrive(0, "fisheye64")
    row = driven(drive)
    assert row.failure is None
    assert (row.name, row.seed) == (f"fisheye64_{FIRST_SEED}", FIRST_SEED)
    as_built = [observation for observation in row.looks if observation.mounts is Mounts.AS_BUILT]
    assert sorted(observation.edge for observation in as_built) == [
        f"{camera}-{LIDAR}" for camera in sorted(drive.right.cameras)
    ]
    assert all(len(observation.pair_stamps_ns) == CHECK_PAIRS for observation in row.looks)
    last = [observation.pair_stamps_ns[-1] for observation in row.looks]
    assert last == sorted(last)
    for observation in row.looks:
        moved = observation.mounts is not Mounts.AS_BUILT
        assert not moved or observation.pair_stamps_ns[-1] + 50_000_000 >= START_NS + drive.at_s * 1e9
        assert observation.mounts is not Mounts.CAMERA or observation.edge.split("-")[0] in drive.cameras
    late = {
        observation.edge
        for observation in as_built
        if observation.pair_stamps_ns[-1] - START_NS > (drive.at_s + 0.1) * 1e9
    }
    assert late == {observation.edge for observation in row.looks if observation.mounts is Mounts.LIDAR}
