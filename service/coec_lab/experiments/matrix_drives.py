"""`coec sim matrix`: simulated drives of many scenes, lenses, LiDARs, lights and faults, and one of them run: it is
rendered, its windows are solved from wrong starts, and its monitor is tried at right and wrong poses. The seeds are
beyond those of training, demonstration and tests. What the first round showed (`docs/measured.md`) is tried on the
next round, which has the same kinds of drives with other seeds.

Their seeds are beyond those of training, demonstration and tests. What the first round taught (`docs/measured.md`) is
tried on the next round, which has the same kinds of drives with other seeds.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from math import degrees, inf, radians
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.pairing import Pairer
from coec.calibration.frames.window import stands
from coec.calibration.monitor.change_detector import MonitorOutcome, MonitorState, after_observation, alarm_levels
from coec.calibration.monitor.check import check_at, gather
from coec.calibration.monitor.check_verdict import MIN_PAIRS, judge_check
from coec.calibration.pipeline import calibrate
from coec.calibration.solver import prepare_window_data
from coec.calibration.types import Decision, DepthModel, FramePair, ImageReader, Matrix4, Silence, Window
from coec.config import CalibrationConfig, LimitsConfig, MonitorConfig, PairingConfig, WindowConfig
from coec.errors import CoecError, SourceError
from coec.geometry import se3
from coec.geometry.points import random_direction
from coec.io.depth.depth_maps import STEREO, CachedDepth, open_depth
from coec.io.images import CachedGreys, GreyImages
from coec.io.recordings.recording_source import parse_spec
from coec.schemas.replies import Maybe6
from coec_lab.experiments.matrix_statistics import is_hit
from coec_lab.experiments.simulation_schemas import MatrixRow, SolvedWindow, Watched
from coec_lab.simulation.source import open_sim

if TYPE_CHECKING:
    from coec_lab.simulation.drive import SimulatedDrive


FIRST_SEED = 500_001
"""Beyond all seeds that are used for learning or for showing."""
SEEDS, SEEDS_EACH = 3, 2
"""Seeds of a round, and how many of them each kind of drive takes, in turn."""

LENSES = {
    "fisheye": "camera=fisheye700",
    "wide": "camera=pinhole640x400",
    "60deg": "camera=pinhole640x400@60",
    "45deg": "camera=pinhole640x400@45",
    "30deg": "camera=pinhole640x400@30",
}
SCENES = {
    "street": "",
    "street-standing": "speed_mps=0",
    "street-parked": "speed_mps=0&traffic=no",
    "highway": "scene=highway",
    "garage": "scene=garage",
    "garage-standing": "scene=garage&speed_mps=0",
    "room": "scene=room",
    "room-standing": "scene=room&speed_mps=0",
    "room-empty": "scene=room&speed_mps=0&traffic=no",
    "tunnel": "faults=tunnel:0",
    "open-road": "faults=open_road:0",
}
LIGHTS = {"day": "", "night": "faults=night:0", "rain": "faults=rain:0:mmph=25", "low-sun": "faults=low_sun:0"}
FAULTS = {
    "none": "",
    "focal": "intrinsics_off=2",
    "centre": "intrinsics_off=0,0.5,-0.5",
    "rolling": "rolling_shutter_s=0.03",
    "clock": "faults=offset_drift:0-40:seconds=0.04",
    "late": "faults=offset:0:seconds=0.03",
    "no-ego": "faults=no-ego:0",
    "beams": "faults=beams:0:share=0.5",
    "dirt": "faults=dirt:0:share=0.25",
    "step": "faults=step:12:rx=1,ry=-1",
}
"""By name, the words of a `sim:` SOURCE. A step of 1.4° lies in the first of two windows."""

MOVING_MOUNT = ("step",)
"""Faults that change the truth, so that no pose is right all along."""


@dataclass(frozen=True, slots=True)
class MatrixDrive:
    """A kind of drive and its seed. The words are keys of `SCENES`, `LENSES`, `LIGHTS` and `FAULTS`."""

    scene: str
    lens: str
    lidar: str
    light: str
    fault: str
    seed: int

    @property
    def name(self) -> str:
        """Its name: all its words, and the number of its seed."""
        parts = (self.scene, self.lens, self.lidar, self.light, self.fault, f"s{self.seed - FIRST_SEED + 1}")
        return "_".join(parts)

    @property
    def moving_mount(self) -> bool:
        """Whether the truth changes on the way."""
        return self.fault in MOVING_MOUNT

    def source(self, seconds: float, hertz: float, *, depth: bool) -> str:
        """The SOURCE that draws it, with pictures and sweeps at `hertz`, and with exact depth maps if `depth`."""
        parameters = [f"seed={self.seed}", f"seconds={seconds:g}", f"camera_hz={hertz:g}", f"lidar_hz={hertz:g}"]
        parameters += ["ego_hz=20", f"lidar={self.lidar}", *(["depth=yes"] if depth else [])]
        faults = []
        for part in (SCENES[self.scene], LENSES[self.lens], LIGHTS[self.light], FAULTS[self.fault]):
            for word in filter(None, part.split("&")):
                faults.append(word.removeprefix("faults=")) if word.startswith("faults=") else parameters.append(word)
        return "sim:" + "&".join([*parameters, *([f"faults={';'.join(faults)}"] if faults else [])])


KINDS: tuple[tuple[str, str, str, str, str], ...] = (
    # LiDARs, in a street.
    ("street", "fisheye", "64", "day", "none"),
    ("street", "fisheye", "32", "day", "none"),
    ("street", "fisheye", "16", "day", "none"),
    ("street", "wide", "128", "day", "none"),
    ("street", "wide", "raster", "day", "none"),
    ("street", "wide", "rosette", "day", "none"),
    # Lenses.
    ("street", "wide", "64", "day", "none"),
    ("street", "60deg", "64", "day", "none"),
    ("street", "45deg", "128", "day", "none"),
    ("street", "30deg", "128", "day", "none"),
    ("street", "60deg", "raster", "day", "none"),
    # Light and weather.
    ("street", "fisheye", "64", "night", "none"),
    ("street", "wide", "32", "night", "none"),
    ("street", "fisheye", "64", "rain", "none"),
    ("street", "wide", "raster", "rain", "none"),
    ("street", "wide", "64", "low-sun", "none"),
    ("street", "fisheye", "32", "low-sun", "none"),
    # Standing.
    ("street-standing", "fisheye", "64", "day", "none"),
    ("street-parked", "wide", "32", "day", "none"),
    ("room-standing", "wide", "16", "day", "none"),
    ("room-empty", "fisheye", "16", "day", "none"),
    ("garage-standing", "fisheye", "64", "day", "none"),
    # Indoors, on the move.
    ("garage", "fisheye", "64", "day", "none"),
    ("garage", "wide", "32", "day", "none"),
    ("garage", "wide", "rosette", "day", "none"),
    ("room", "fisheye", "32", "day", "none"),
    ("room", "wide", "16", "day", "none"),
    # Little to see.
    ("highway", "wide", "64", "day", "none"),
    ("highway", "60deg", "128", "rain", "none"),
    ("highway", "fisheye", "64", "night", "none"),
    ("tunnel", "fisheye", "64", "day", "none"),
    ("open-road", "wide", "64", "day", "none"),
    # Faults.
    ("street", "wide", "64", "day", "focal"),
    ("street", "fisheye", "64", "day", "centre"),
    ("street", "wide", "64", "day", "rolling"),
    ("street", "fisheye", "64", "day", "clock"),
    ("street", "wide", "32", "day", "late"),
    ("street", "fisheye", "64", "day", "no-ego"),
    ("street", "wide", "64", "day", "beams"),
    ("street", "fisheye", "64", "day", "dirt"),
    ("street", "fisheye", "64", "day", "step"),
    ("street", "wide", "64", "day", "step"),
)
"""Scene, lens, LiDAR, light, fault."""


def drives(number: int) -> tuple[MatrixDrive, ...]:
    """The drives of a round, counted from 1. Every kind with its first seed comes before any kind with its second, so
    that half a run covers all kinds."""
    first = FIRST_SEED + (number - 1) * SEEDS
    return tuple(
        MatrixDrive(*kind, first + (place + turn) % SEEDS)
        for turn in range(SEEDS_EACH)
        for place, kind in enumerate(KINDS)
    )


def selected_drives(number: int, pattern: str | None) -> tuple[MatrixDrive, ...]:
    """The drives of a round whose name matches a shell pattern (`*`, `?`); all for None."""
    return tuple(drive for drive in drives(number) if pattern is None or fnmatchcase(drive.name, pattern))


WINDOWS = 2
"""Windows of a drive, one after the other."""
PAIR_S = 2.0
"""Time between two pairs: at 8 m/s each is at another place."""
START_DEG, START_M = (2.0, 10.0), (0.0, 0.1)
"""Least and greatest error of a start, in a random direction; `START_M` applies where the translation is searched."""
CHECK_PAIRS = MIN_PAIRS
"""Pairs of a check, none shared with another check: the fewest a check takes, so that a short drive has several."""
MOVES_DEG = (("right", 0.0), ("0.5 deg", 0.5), ("1 deg", 1.0))
"""By name: by how much the served pose is turned from the truth, about a random axis."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What decides the rows apart from the drives: degrees of freedom, pairs of a window, the depth model."""

    dofs: tuple[int, ...]
    frames: int
    depth: str

    @property
    def fingerprint(self) -> str:
        """Rows with the same fingerprint are comparable."""
        return f"dof {self.dofs}, {WINDOWS} windows of {self.frames}, depth {self.depth}"


@dataclass(frozen=True, slots=True, eq=False)
class _PreparedMatrixDrive:
    """A drawn drive, ready to be solved: all its pairs, and readers that decode each of them only once."""

    drive: SimulatedDrive
    pairs: tuple[FramePair, ...]
    depth: DepthModel
    images: ImageReader

    def window(self, pairs: Sequence[FramePair], start: Matrix4) -> Window:
        """A window of some pairs. Its nominal calibration is the start as well, so nothing in it tells the truth."""
        rig = replace(self.drive.rig, T_camera_lidar_nominal=start)
        return Window(f"{rig.pair}-{pairs[0].stamp_ns}", rig, start, tuple(pairs))


def run(drive: MatrixDrive, settings: Settings) -> MatrixRow:
    """The row of a drive; an error becomes its `failure`."""
    began_s = time.process_time()
    seconds = WINDOWS * settings.frames * PAIR_S
    source = drive.source(seconds, 1.0 / PAIR_S, depth=settings.depth == STEREO)
    row = MatrixRow(
        name=drive.name, scene=drive.scene, lens=drive.lens, lidar=drive.lidar, light=drive.light, fault=drive.fault,
        seed=drive.seed, source=source, windows={}, watched=(), settings=settings.fingerprint, cpu_s=0.0,
    )  # fmt: skip
    update: dict[str, object] = {}
    try:
        stage = _simulate(source, settings)
        configuration = _configuration(settings)
        update["windows"] = {str(dof): _solved(stage, drive, settings, dof, configuration) for dof in settings.dofs}
        update["watched"] = () if drive.moving_mount else _watched(stage, drive, configuration)
    except CoecError as error:
        update["failure"] = f"{type(error).__name__}: {error}"
    return row.model_copy(update={**update, "cpu_s": time.process_time() - began_s})


def _configuration(settings: Settings) -> CalibrationConfig:
    values = CalibrationConfig().model_dump()
    # Each process draws and solves one drive, so one thread is enough.
    values["depth"] |= {"model": settings.depth, "threads": 1}
    return CalibrationConfig.model_validate(values)


def _simulate(source: str, settings: Settings) -> _PreparedMatrixDrive:
    made = open_sim(parse_spec(source).query)
    pairer = Pairer(PairingConfig(), expects_motion=True)
    pairs = [pair for message in made.messages() for pair in pairer.push(message)] + pairer.flush()
    if len(pairs) < 2:
        raise SourceError(f"{made.name}: {len(pairs)} pairs of a picture and a sweep; lost: {dict(pairer.losses)}")
    depth = CachedDepth(open_depth(_configuration(settings).depth, LimitsConfig()), len(pairs))
    return _PreparedMatrixDrive(made, tuple(pairs), depth, CachedGreys(GreyImages(LimitsConfig()), len(pairs)))


def _solved(
    stage: _PreparedMatrixDrive, drive: MatrixDrive, settings: Settings, dof: int, base: CalibrationConfig
) -> tuple[SolvedWindow, ...]:
    configuration = base.model_copy(update={"search": base.search.model_copy(update={"dof": dof})})
    rows = []
    for place in range(WINDOWS):
        pairs = stage.pairs[place * settings.frames : (place + 1) * settings.frames]
        if not pairs:
            continue
        truth = stage.drive.truth(pairs[-1].stamp_ns)
        xi = sampled_start(drive.name, place, dof, configuration.verdict.held_translation_sigma_m)
        rows.append(_solve(stage, pairs, truth, xi, dof, configuration))
    return tuple(rows)


def sampled_start(name: str, place: int, dof: int, held_m: float) -> NDArray[np.float64]:
    """(6,) ξ from the truth to the start of the `place`-th window of the drive of this name. A held translation is
    wrong by what the budget of σ assumes, `held_m` along each axis, because an exact one would flatter the estimate."""
    rng = np.random.default_rng([_number_of(name), place, dof])
    turn = radians(float(rng.uniform(*START_DEG))) * random_direction(rng)
    shift = float(rng.uniform(*START_M)) * random_direction(rng) if dof == 6 else rng.normal(0.0, held_m, 3)
    return np.concatenate([turn, shift])


def _solve(
    stage: _PreparedMatrixDrive,
    pairs: Sequence[FramePair],
    truth: Matrix4,
    xi: NDArray[np.float64],
    dof: int,
    configuration: CalibrationConfig,
) -> SolvedWindow:
    start = se3.perturb(truth, xi)
    row = SolvedWindow(
        pairs=len(pairs), start_deg=degrees(float(np.linalg.norm(xi[:3]))), start_m=float(np.linalg.norm(xi[3:])),
        accepted=False, hit=False, rotation_deg=None, translation_m=None, error=_maybe(np.full(6, np.nan)),
        sigma=_maybe(np.full(6, np.nan)), reasons=(), evaluations=0, failure=None,
    )  # fmt: skip
    try:
        estimate = calibrate(stage.window(pairs, start), stage.depth, stage.images, configuration, Silence())
    except CoecError as refused:
        return row.model_copy(update={"failure": f"{type(refused).__name__}: {refused}"})
    error = se3.difference(estimate.optimum.T_camera_lidar, truth)
    rotation_deg, translation_m = degrees(float(np.linalg.norm(error[:3]))), float(np.linalg.norm(error[3:]))
    return row.model_copy(
        update={
            "accepted": estimate.verdict.decision is Decision.ACCEPTED,
            "hit": is_hit(rotation_deg, translation_m, dof),
            "rotation_deg": rotation_deg,
            "translation_m": translation_m,
            "error": _maybe(np.where(estimate.solved, error, np.nan)),
            "sigma": _maybe(np.where(estimate.solved, estimate.sigma, np.nan)),
            "reasons": tuple(reason.code for reason in estimate.verdict.reasons),
            "evaluations": estimate.optimum.evaluations,
        }
    )


def _watched(stage: _PreparedMatrixDrive, drive: MatrixDrive, configuration: CalibrationConfig) -> tuple[Watched, ...]:
    """The checks of an uncommissioned rig that serves the truth, and of one that serves a pose turned from it."""
    if len(stage.pairs) < CHECK_PAIRS:
        return ()
    truth = stage.drive.truth(stage.pairs[0].stamp_ns)
    window = stage.window(stage.pairs, truth)
    most_rad = radians(max(turn_deg for _, turn_deg in MOVES_DEG))
    evidence = gather(prepare_window_data(window, stage.depth, stage.images, configuration, Silence()), most_rad)
    levels, rows = alarm_levels(MonitorConfig()), []
    for number, (name, turn_deg) in enumerate(MOVES_DEG):
        rng = np.random.default_rng([_number_of(drive.name), 1000 + number])
        pose = se3.perturb(truth, np.concatenate([radians(turn_deg) * random_direction(rng), np.zeros(3)]))
        state, delay = MonitorState(), None
        checks = flagged = blind = alarms = 0
        for first in range(0, len(stage.pairs) - CHECK_PAIRS + 1, CHECK_PAIRS):
            part = evidence.of(range(first, first + CHECK_PAIRS))
            seen = judge_check(part, check_at(part, pose), pose, None)
            stood = tuple(pair.stamp_ns for pair in part.pairs if stands(pair, WindowConfig()))
            before, state = state, after_observation(state, replace(seen, standing_stamps_ns=stood), levels)
            checks += 1
            flagged += seen.flagged and not seen.causes
            blind += bool(seen.causes)
            if state.outcome is MonitorOutcome.CONFIRMED and before.outcome is not MonitorOutcome.CONFIRMED:
                alarms += 1
                delay = checks if delay is None else delay
        rows.append(
            Watched(
                moved=name, checks=checks, flagged=flagged, blind=blind, alarms=alarms,
                seconds=(stage.pairs[-1].stamp_ns - stage.pairs[0].stamp_ns) * 1e-9, delay_checks=delay,
            )
        )  # fmt: skip
    return tuple(rows)


def _number_of(name: str) -> int:
    """A seed that depends on the name alone, so that a drive draws the same whichever others are run."""
    return zlib.crc32(name.encode())


def _maybe(values: NDArray[np.float64]) -> Maybe6:
    """Radians to degrees, and what is not finite to None."""
    scaled = [*np.degrees(values[:3]), *values[3:]]
    rx, ry, rz, tx, ty, tz = (float(value) if abs(value) < inf else None for value in scaled)
    return rx, ry, rz, tx, ty, tz
