"""`coec sim checks`: drives on which checks are tried (rigs and places, with seeds from which nothing was learned),
and the checks of one drive at the right extrinsic and at a moved one, with and without a baseline.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from math import radians
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from coec.calibration.baseline import Baseline, learned_hash
from coec.calibration.commissioning import FAR_RAD, learn_accuracy, learn_limits
from coec.calibration.frames.pairing import Pairer
from coec.calibration.monitor import check_verdict
from coec.calibration.monitor.check import Check, CheckInput, check_at, gather
from coec.calibration.monitor.check_edges import ROTATION_DOF
from coec.calibration.monitor.sensor_faults import scene_baseline
from coec.calibration.solver import prepare_window_data
from coec.calibration.types import CameraFrame, DepthModel, FramePair, ImageReader, Matrix4, Rig, Silence, Window
from coec.config import CalibrationConfig, LimitsConfig, PairingConfig
from coec.errors import CoecError
from coec.geometry import se3
from coec.geometry.points import random_direction
from coec.io.depth.depth_maps import CachedDepth, open_depth
from coec.io.images import CachedGreys, GreyImages
from coec.io.recordings.recording_source import parse_spec
from coec.schemas.replies import Vector6
from coec_lab.experiments.detection import OBSERVABLE_M
from coec_lab.experiments.simulation_schemas import CheckedDrive, CheckedPose, Judged
from coec_lab.simulation.source import drive_config_of, open_sim

if TYPE_CHECKING:
    from coec_lab.simulation.drive import SimulatedDrive


CHECK_PAIRS, CHECKS, PERIOD_S = 6, 5, 5.0
"""Pairs of a check, checks of a drive, and seconds between two: as the monitor is configured unless told otherwise."""

HERTZ = CHECK_PAIRS / PERIOD_S

RIGS = {
    "64-60deg": "lidar=64&camera=pinhole400x240@60",
    "64-fisheye520": "lidar=64&camera=fisheye520&half_view_deg=70",
    "32-100deg": "lidar=32&camera=pinhole600x300@100",
    "32-70deg": "lidar=32&camera=pinhole420x260@70",
}
"""By name, the words of a `sim:` SOURCE. None of these lenses is in the matrix, and nothing was learned from them. Rigs
with the same LiDAR see the same drives, so a sweep is drawn once for all of them."""

PLACES = {
    "highway": "scene=highway",
    "street": "",
    "garage": "scene=garage",
    "street-low-sun": "faults=low_sun:0",
    "highway-rain": "scene=highway&faults=rain:0:mmph=10",
    "street-night": "faults=night:0",
    "room": "scene=room",
    "street-rain": "faults=rain:0:mmph=10",
    "open-road": "faults=open_road:0",
    "tunnel": "faults=tunnel:0",
}
"""Likewise."""

FIRST_SEED = 950_001
"""Beyond all seeds that are used for learning or for showing."""

COMMISSIONED_ON = (("street", 920_001), ("garage", 920_002))
"""Places and seeds of the drives that a rig is commissioned on."""

COMMISSIONED_CHECKS = 3
"""Length of each of these drives, in checks: together 36 pairs, as many as one or two windows of a rig."""


@dataclass(frozen=True, slots=True)
class CheckDrive:
    """A drive of `CHECKS` checks. `rig` and `place` are keys of `RIGS` and `PLACES`."""

    rig: str
    place: str
    seed: int

    @property
    def name(self) -> str:
        """What it is called."""
        return f"{self.rig}_{self.place}_{self.seed}"

    def source(self, checks: int) -> str:
        """The SOURCE that draws so many checks of it."""
        # A moment longer, so that the last pair is begun.
        seconds = checks * PERIOD_S + 0.5 / HERTZ
        parameters = [f"seed={self.seed}", f"seconds={seconds:g}", f"camera_hz={HERTZ:g}", f"lidar_hz={HERTZ:g}"]
        return "sim:" + "&".join([*parameters, "ego_hz=20", RIGS[self.rig], *filter(None, [PLACES[self.place]])])


def drives(rounds: int, first: int = 1) -> Iterator[tuple[CheckDrive, ...]]:
    """Every place with every rig, `rounds` times from round `first` on, each time with another seed, so that part of a
    run covers them all. Drives that differ only in their lens come together."""
    for turn in range(first - 1, first - 1 + rounds):
        for number, place in enumerate(PLACES):
            for _, rigs in groupby(RIGS, lambda rig: RIGS[rig].partition("&")[0]):
                yield tuple(CheckDrive(rig, place, FIRST_SEED + turn * len(PLACES) + number) for rig in rigs)


RIGHT = "right"
"""Name of the case without a move."""

MOVES = (("0.5 deg", 0.5, 0.0), ("1 deg", 1.0, 0.0), ("10 cm", 0.0, 0.10))
"""By name: by how much the served pose is turned from the truth about a random axis (degrees), and shifted from it
along an axis of the camera that checks can observe (m). Each drive is checked at the truth and with one of these."""


@dataclass(frozen=True, slots=True, eq=False)
class _PreparedDrive:
    """A drawn drive: its pairs, the truth (4, 4), and readers that decode each pair only once."""

    rig: Rig
    truth: Matrix4
    pairs: tuple[FramePair, ...]
    depth: DepthModel
    images: ImageReader

    def window(self, pairs: Sequence[FramePair]) -> Window:
        """A window of some pairs that starts at the truth."""
        rig = replace(self.rig, T_camera_lidar_nominal=self.truth)
        return Window(f"{rig.pair}-{pairs[0].stamp_ns}", rig, self.truth, tuple(pairs))


def commissioned(rig: str) -> Baseline:
    """The baseline of a rig, learned for checks on the drives `COMMISSIONED_ON`, without limits for full calibrations.

    Raises:
        CalibrationError: these drives show nothing.
    """
    stages = [_simulate([CheckDrive(rig, *where).source(COMMISSIONED_CHECKS)])[0] for where in COMMISSIONED_ON]
    pairs = [
        # All drives begin at the same time: later ones are shifted, as if they had come one after the other.
        _later(pair, number * 3_600_000_000_000)
        for number, stage in enumerate(stages)
        for pair in stage.pairs
    ]
    whole = stages[0].window(pairs)
    configuration = _configuration()
    depth = open_depth(configuration.depth, LimitsConfig())
    evidence = gather(prepare_window_data(whole, depth, GreyImages(LimitsConfig()), configuration, Silence()), FAR_RAD)
    rotation, pose = learn_accuracy(evidence, stages[0].truth)
    limits = learn_limits(evidence, stages[0].truth, configuration, (rotation, pose), check_verdict.FALSE_ALARM_RATE)
    return Baseline(
        pair=whole.rig.pair, T_camera_lidar=stages[0].truth, rotation=rotation, pose=pose, dof=ROTATION_DOF, limits={},
        monitor=limits, scene=scene_baseline(evidence.scenes),
        false_alarm_rate=check_verdict.FALSE_ALARM_RATE, windows=len(stages),
        pairs=len(pairs), detected={}, sensors={}, depth_identity=depth.identity,
        config_hash=learned_hash(configuration),
    )  # fmt: skip


def run(drives: Sequence[CheckDrive], baselines: Mapping[str, Baseline]) -> list[CheckedDrive]:
    """The rows of drives that differ only in their lens; an error becomes a row's `failure`. `baselines` holds those of
    the rigs that could be commissioned, by name."""
    rows = [
        CheckedDrive(name=drive.name, rig=drive.rig, place=drive.place, seed=drive.seed, source=source, poses=())
        for drive in drives
        for source in [drive.source(CHECKS)]
    ]
    try:
        stages = _simulate([row.source for row in rows])
    except CoecError as error:
        return [_failed(row, error) for row in rows]
    checked = []
    for row, drive, stage in zip(rows, drives, stages, strict=True):
        try:
            checked.append(row.model_copy(update={"poses": _checked(stage, drive, baselines.get(drive.rig))}))
        except CoecError as error:
            checked.append(_failed(row, error))
    return checked


def _failed(row: CheckedDrive, error: CoecError) -> CheckedDrive:
    return row.model_copy(update={"failure": f"{type(error).__name__}: {error}"})


def _checked(stage: _PreparedDrive, drive: CheckDrive, baseline: Baseline | None) -> tuple[CheckedPose, ...]:
    configuration = _configuration()
    expected = check_verdict.expected_of(baseline)
    starts = range(0, len(stage.pairs) - CHECK_PAIRS + 1, CHECK_PAIRS)
    windows = [stage.window(stage.pairs[first : first + CHECK_PAIRS]) for first in starts]
    windows_data = [
        prepare_window_data(window, stage.depth, stage.images, configuration, Silence()) for window in windows
    ]
    gathered = [gather(window_data, radians(max(turn_deg for _, turn_deg, _ in MOVES))) for window_data in windows_data]
    rows = []
    drive_hash = zlib.crc32(drive.name.encode())
    rng = np.random.default_rng(drive_hash)
    for name, turn_deg, shift_m in ((RIGHT, 0.0, 0.0), MOVES[drive_hash % len(MOVES)]):
        xi = _move(rng, turn_deg, shift_m, baseline)
        if xi is None:
            continue
        pose = se3.perturb(stage.truth, xi)
        seen = [(evidence, check_at(evidence, pose, expected)) for evidence in gathered]
        of_any = tuple(_judged(*one, pose, None) for one in seen)
        # The baseline's reference moves with the served pose, as for a commissioned rig whose mount has moved.
        of_rig = () if baseline is None else tuple(_judged(*one, pose, baseline) for one in seen)
        rows.append(CheckedPose(moved=name, uncommissioned=of_any, commissioned=of_rig))
    return tuple(rows)


def _move(
    rng: np.random.Generator, turn_deg: float, shift_m: float, baseline: Baseline | None
) -> NDArray[np.float64] | None:
    """(6,) ξ of a move; None for a shift where checks know no translation to `OBSERVABLE_M`."""
    xi = np.zeros(6)
    xi[:3] = radians(turn_deg) * random_direction(rng)
    if shift_m > 0.0:
        sigma = np.full(6, OBSERVABLE_M) if baseline is None else baseline.pose.sigma(CHECK_PAIRS)
        known = [axis for axis in range(3, 6) if sigma[axis] <= OBSERVABLE_M]
        if not known:
            return None
        xi[known[int(rng.integers(len(known)))]] = shift_m * float(rng.choice([-1.0, 1.0]))
    return xi


def _simulate(sources: Sequence[str]) -> list[_PreparedDrive]:
    """Draws drives that differ only in their lens."""
    first: SimulatedDrive = open_sim(parse_spec(sources[0]).query)
    configs = [drive_config_of(parse_spec(source).query) for source in sources[1:]]
    drives = [first, *(first.through(config.camera, config.half_view_deg) for config in configs)]
    pairers = [Pairer(PairingConfig(), expects_motion=True) for _ in drives]
    pairs: list[list[FramePair]] = [[] for _ in drives]
    for number, message in enumerate(first.messages()):
        # All messages but pictures are the same for all drives.
        own = isinstance(message, CameraFrame)
        seen = [message, *(drive.part(number, number + 1)[0] if own else message for drive in drives[1:])]
        for pairer, one, paired in zip(pairers, seen, pairs, strict=True):
            paired += pairer.push(one)
    return [
        _stage(drive, [*paired, *pairer.flush()]) for drive, pairer, paired in zip(drives, pairers, pairs, strict=True)
    ]


def _stage(drive: SimulatedDrive, pairs: Sequence[FramePair]) -> _PreparedDrive:
    depth = CachedDepth(open_depth(_configuration().depth, LimitsConfig()), len(pairs))
    images = CachedGreys(GreyImages(LimitsConfig()), len(pairs))
    return _PreparedDrive(drive.rig, drive.truth(pairs[0].stamp_ns), tuple(pairs), depth, images)


def _later(pair: FramePair, by_ns: int) -> FramePair:
    camera, lidar = pair.camera, pair.lidar
    return replace(
        pair,
        camera=replace(camera, stamp_ns=camera.stamp_ns + by_ns),
        lidar=replace(lidar, stamp_ns=lidar.stamp_ns + by_ns),
    )


def _configuration() -> CalibrationConfig:
    values = CalibrationConfig().model_dump()
    # Each process draws and checks one drive, so one thread is enough.
    values["depth"] |= {"threads": 1}
    return CalibrationConfig.model_validate(values)


def _judged(evidence: CheckInput, check: Check, pose: Matrix4, baseline: Baseline | None) -> Judged:
    seen = check_verdict.judge_check(evidence, check, pose, baseline)
    faint = check_verdict.faintness(
        evidence.pairs, check, check_verdict.UNCOMMISSIONED if baseline is None else baseline.monitor
    )
    return Judged(
        offset=vector6_of(seen.offset), sigma=vector6_of(seen.sigma), noise=vector6_of(seen.noise),
        place=vector6_of(seen.place), dispersion=seen.dispersion, distance2=seen.distance2,
        flagged=seen.flagged, undecided=seen.undecided, faint=tuple(sorted(faint)),
        causes=tuple(cause.code for cause in seen.causes),
    )  # fmt: skip


def vector6_of(values: NDArray[np.float64]) -> Vector6:
    """(6,) as a document holds it."""
    rx, ry, rz, tx, ty, tz = (float(value) for value in values)
    return rx, ry, rz, tx, ty, tz
