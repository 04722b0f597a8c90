"""`coec sim rig-drives`: rendered drives of a rig on which sensors are displaced, the checks of all pairs as the
monitor makes them, and the urgent windows that pairs request. Every sweep and every picture is prepared once, however
many pairs use it, and each check becomes evidence for its edge. From the checks and windows follows which sensor moved:
attribution and alarms of the pairs.

All faults of one drive number share a street, so the frames of a sensor that did not move are the same in all of them.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from math import degrees, isfinite, radians

import numpy as np
from numpy.typing import NDArray

from coec import config
from coec.calibration import types
from coec.calibration.frames.window import TRIES
from coec.calibration.monitor.change_detector import MonitorOutcome, MonitorState, Observation
from coec.calibration.monitor.check import check_at, join, seen_part
from coec.calibration.monitor.check_edges import OUTLINE_RAD, REACH_RAD, PreparedSweep, prepare_images, prepare_sweep
from coec.calibration.monitor.check_verdict import judge_check
from coec.calibration.monitor.sensor_faults import CAUSES
from coec.calibration.pipeline import calibrate
from coec.calibration.rig.attribution import RigState, after_edge_observation, after_window, initial, sensors, served
from coec.calibration.rig.edge_observations import EdgeObservation, observation_of_check, observation_of_window
from coec.calibration.rig.graph import Edge, RigGraph, Sensor, SensorKind
from coec.calibration.solver import prepare_window_data
from coec.calibration.state import (
    CalibrationStatus,
    PairRules,
    PairState,
    Provenance,
    after_observation,
    urgent_window_since,
)
from coec.calibration.tracker import Measurement
from coec.errors import CoecError
from coec.geometry import se3
from coec.geometry.points import random_direction
from coec.io.depth.depth_maps import open_depth
from coec.io.images import CachedGreys, GreyImages
from coec.reports.close_ups import evenly
from coec_lab.experiments import simulation_schemas
from coec_lab.experiments.check_drives import CHECK_PAIRS, vector6_of
from coec_lab.experiments.rig_evidence import SLICE_S, WINDOW
from coec_lab.experiments.rig_moves import ALLOWED_S, MOVED
from coec_lab.experiments.simulation_schemas import Mounts, RigDriveRow, RigLook, RigWindow
from coec_lab.simulation.faults import SensorFault, StepFault
from coec_lab.simulation.journey import START_NS
from coec_lab.simulation.rig_drive import Instant, RigDrive, RigDriveConfig, instants, pair_of
from coec_lab.simulation.simulated_sensors import product

PERIOD_S = 5.0
"""Time between two looks at one pair, as in the monitor; pairs take turns."""

TURN_S = PERIOD_S / CHECK_PAIRS
"""Time between two instants that are drawn."""

ROWS = (0.34, 0.70)
"""The rows of the pictures that are drawn, as shares of their height: on a street, what the LiDAR sees lies between
0.40 and 0.64, and a local mean reaches 40 pixels further."""

TURNS = (0, 1, 3, 4)
"""By how many instants the looks at each pair follow those at the first pair: 0.8 to 1.7 s apart."""


def due(instants: int, pairs: Sequence[str]) -> tuple[str, ...]:
    """Whose turn it is, of up to four pairs, after so many instants; a look takes the latest `CHECK_PAIRS` instants."""
    return tuple(
        pair
        for turn, pair in zip(TURNS, pairs, strict=False)
        if instants >= CHECK_PAIRS + turn and (instants - turn) % CHECK_PAIRS == 0
    )


@dataclass(frozen=True, slots=True, eq=False)
class SeenPair:
    """A pair of frames with its prepared sweep."""

    frames: types.FramePair
    sweep: PreparedSweep


def observe(rig: types.Rig, pose: types.Matrix4, seen: Sequence[SeenPair]) -> Observation:
    """A look at an uncommissioned pair that serves `pose` (4, 4); edges alone decide, so no depth is inferred.

    Raises:
        CalibrationError: an image cannot be decoded.
    """
    pairs, sweeps = tuple(one.frames for one in seen), [one.sweep for one in seen]
    window = types.Window(f"{rig.pair}-{pairs[-1].stamp_ns}", rig, pose, pairs)
    images = CachedGreys(GreyImages(config.LimitsConfig()), len(pairs))
    window_data = prepare_window_data(window, _no_depth(), images, config.CalibrationConfig(), types.Silence())
    part = seen_part(rig, sweeps, pose, OUTLINE_RAD)
    upright = rig.T_camera_lidar_nominal[:2, 2]
    pictures = prepare_images(window_data.greys(), len(pairs), rig.camera, rig.mask, upright, part, part)
    evidence = join(window_data, sweeps, pictures, REACH_RAD)
    return judge_check(evidence, check_at(evidence, pose), pose, None)


def graph_of(drive: RigDrive, lidar: str) -> RigGraph:
    """All cameras of a drive with one of its LiDARs, at their nominal mounts; each edge is named after its pair."""
    sensors = [Sensor(lidar, SensorKind.LIDAR), *(Sensor(camera, SensorKind.CAMERA) for camera in drive.cameras)]
    T_ego_lidar = se3.inverse(drive.T_sensor_ego_nominal(lidar))
    edges = [
        Edge(f"{camera}-{lidar}", camera, lidar, product(drive.T_sensor_ego_nominal(camera), T_ego_lidar))
        for camera in drive.cameras
    ]
    return RigGraph.of(sensors, edges)


@cache
def _no_depth() -> types.DepthModel:
    """A depth model that is never asked: edges alone decide."""
    return open_depth(config.DepthConfig(model="stereo"), config.LimitsConfig())


LIDAR = "roof"
"""Name of the rig's LiDAR; the rig has four fisheyes and one LiDAR of 64 beams."""

AT_S = (16.0, 22.0)
"""Sensors are knocked at a random time within these, seconds of the drive: after two or three looks at every pair."""

AFTER_S = 60.5
"""Driving after the knock: as long as an alarm may take, and long enough that the last pair is begun."""

STEP_RAD = radians(1.0)

FIRST_SEED = 1_760_001
"""Beyond all seeds from which anything was learned."""


@dataclass(frozen=True)
class DisplacedRigDrive:
    """A drive by its number.

    Attributes:
        camera: model of every camera, `fisheyeW`.
    """

    number: int
    camera: str

    @property
    def name(self) -> str:
        """What it is called."""
        return f"{self.camera}_{FIRST_SEED + self.number}"

    @cached_property
    def _sampled(self) -> tuple[float, tuple[str, str], dict[str, NDArray[np.float64]]]:
        rng = np.random.default_rng([FIRST_SEED, self.number])
        one, other = (str(name) for name in rng.permutation(RigDriveConfig().drive().cameras)[:2])
        at_s = float(rng.uniform(*AT_S))
        turns = {name: STEP_RAD * random_direction(rng) for name in (one, other, LIDAR)}
        return at_s, (one, other), turns

    @property
    def at_s(self) -> float:
        """When sensors are knocked."""
        return self._sampled[0]

    @property
    def cameras(self) -> tuple[str, str]:
        """The cameras that may be knocked: a fault takes the first alone, or both."""
        return self._sampled[1]

    @cached_property
    def right(self) -> RigDrive:
        """As the rig was built."""
        return self._config(()).drive()

    @cached_property
    def displaced(self) -> RigDrive:
        """Both cameras and the LiDAR turned, each about an axis of its own."""
        faults = []
        for name, turn in self._sampled[2].items():
            rx, ry, rz = (degrees(angle) for angle in turn)
            faults.append(SensorFault(name, StepFault(self.at_s, float("inf"), rx=rx, ry=ry, rz=rz)))
        return self._config(tuple(faults)).drive()

    @cached_property
    def graph(self) -> RigGraph:
        """As the rig was built."""
        return graph_of(self.right, LIDAR)

    @cached_property
    def served(self) -> dict[str, types.Matrix4]:
        """Served extrinsic (4, 4) of each pair: off the truth by as much as windows are (`WINDOW`)."""
        rng = np.random.default_rng([FIRST_SEED, self.number, 1])
        return {edge.name: se3.perturb(edge.T_a_b, WINDOW * rng.normal(size=6)) for edge in self.graph.edges}

    def _config(self, faults: tuple[SensorFault, ...]) -> RigDriveConfig:
        seconds = self.at_s + AFTER_S
        return RigDriveConfig(
            seed=FIRST_SEED + self.number, seconds=seconds, camera=self.camera, ego_hz=20.0, faults=faults, rows=ROWS
        )  # fmt: skip


NS_PER_S = 1_000_000_000
MONITOR = config.MonitorConfig(period_s=PERIOD_S, pairs=CHECK_PAIRS)
RULES = PairRules(config.PolicyConfig(), config.TrackerConfig(), MONITOR)

SOLVE_S = 4.5
"""The worker takes four seconds for a window of 25 frames."""

WAITING = {Mounts.AS_BUILT: 1, Mounts.CAMERA: 2, Mounts.LIDAR: 4}
"""How many windows the worker solves one after the other: those of both knocked cameras, or of all pairs of the LiDAR.
Each counts once all are solved."""

CONFIGURATION = config.CalibrationConfig()

FramesByMount = Mapping[tuple[str, Mounts], Sequence[types.FramePair]]
"""The pairs of a drive by camera, and by which of their sensors has moved since the knock, ascending."""


def pair_at(pose: types.Matrix4) -> PairState:
    """A pair that serves `pose` (4, 4), which a window has confirmed."""
    return PairState(
        pose, Provenance.ESTIMATED, CalibrationStatus.ACCEPTED, START_NS, monitor=MonitorState(vouched=True)
    )


def variant(checks: Sequence[RigLook], edge: str, mounts: Mounts) -> Iterator[RigLook]:
    """The looks at an edge, from the knock on with its sensors as `mounts` says."""
    by_stamp: dict[int, dict[Mounts, RigLook]] = {}
    for check in checks:
        if check.edge == edge:
            by_stamp.setdefault(check.pair_stamps_ns[-1], {})[check.mounts] = check
    for of in by_stamp.values():
        yield of.get(mounts, of[Mounts.AS_BUILT])


def urgent_windows(drive: DisplacedRigDrive, frames: FramesByMount, checks: Sequence[RigLook]) -> Iterator[RigWindow]:
    """The windows for which the pairs of a drive ask, as far as their answers come before its end.

    Raises:
        CalibrationError: an image cannot be decoded.
    """
    for (camera, mounts), pairs in frames.items():
        edge = f"{camera}-{LIDAR}"
        late_ns = answer_ns(mounts)
        for begin_ns in request_stamps_ns(drive.served[edge], variant(checks, edge, mounts), late_ns):
            of_slice = [pair for pair in pairs if begin_ns < pair.stamp_ns <= begin_ns + SLICE_S * NS_PER_S]
            if pairs[-1].stamp_ns >= begin_ns + late_ns:
                selected = tuple(of_slice[index] for index in evenly(len(of_slice), config.WindowConfig().pairs))
                yield _solved(drive, camera, mounts, selected, begin_ns + late_ns)


def answer_ns(mounts: Mounts) -> int:
    """From the look after which a pair suspects a move to the answer of its window."""
    return round((SLICE_S + WAITING[mounts] * SOLVE_S) * NS_PER_S)


def request_stamps_ns(pose: types.Matrix4, checks: Iterator[RigLook], late_ns: int) -> Iterator[int]:
    """When a pair that serves `pose` (4, 4) asks for a window: at most `TRIES` times per suspicion, and not again
    before the answer, which comes `late_ns` after it."""
    pair, tries, known_ns = pair_at(pose), 0, START_NS
    for check in checks:
        observation = observation_of(check)
        pair = after_observation(pair, observation, RULES)
        if urgent_window_since(pair) is None:
            tries = 0
        elif tries < TRIES and observation.stamp_ns >= known_ns:
            tries += 1
            known_ns = observation.stamp_ns + late_ns
            yield observation.stamp_ns


def _solved(
    drive: DisplacedRigDrive, camera: str, mounts: Mounts, pairs: tuple[types.FramePair, ...], known_ns: int
) -> RigWindow:
    rig = drive.right.pair(camera, LIDAR).rig
    pose = drive.served[rig.pair]
    window = types.Window(f"{rig.pair}-{pairs[0].stamp_ns}", rig, pose, pairs, types.MOUNT_RAD)
    images = CachedGreys(GreyImages(config.LimitsConfig()), len(pairs))
    estimate = calibrate(
        window, open_depth(CONFIGURATION.depth, config.LimitsConfig()), images, CONFIGURATION, types.Silence()
    )
    uncertainty = Measurement.from_estimate(estimate).uncertainty
    document = {
        "edge": rig.pair,
        "mounts": mounts,
        "first_ns": pairs[0].stamp_ns,
        "last_ns": pairs[-1].stamp_ns,
        "known_ns": known_ns,
        "accepted": estimate.verdict.decision is types.Decision.ACCEPTED,
        "reasons": [one.code for one in estimate.verdict.reasons],
        "offset": se3.difference(estimate.optimum.T_camera_lidar, pose).tolist(),
        "noise": [[value if isfinite(value) else None for value in row] for row in uncertainty.noise.tolist()],
        "systematic": {name: shift.tolist() for name, shift in uncertainty.systematic.items()},
    }
    return RigWindow.model_validate(document)


def window_evidence(window: RigWindow, pose: types.Matrix4) -> EdgeObservation | None:
    """An accepted window of a pair that served `pose` (4, 4) as attribution takes it; None if it determines no axis.
    All of its frames lie after a step only if the first one does."""
    noise = np.array([[np.nan if value is None else value for value in row] for row in window.noise])
    systematic = {name: np.array(shift) for name, shift in window.systematic.items()}
    measured = Measurement(
        se3.perturb(pose, np.array(window.offset)), types.Uncertainty(noise, systematic, np.nan), window.last_ns
    )
    evidence = observation_of_window(window.edge, measured)
    return None if evidence is None else replace(evidence, stamp_ns=window.first_ns)


def observation_of(check: RigLook) -> Observation:
    """The look as the change detector takes it, without the figures that decide nothing."""
    offset, sigma, noise, place = (np.array(six) for six in (check.offset, check.sigma, check.noise, check.place))
    return Observation(
        stamp_ns=check.pair_stamps_ns[-1], pair_stamps_ns=check.pair_stamps_ns, metrics=(), offset=offset, sigma=sigma,
        noise=noise, place=place, dispersion=check.dispersion, distance2=check.distance2, flagged=check.flagged,
        weak=check.weak, flagged_by_paper=None, causes=tuple(CAUSES[code] for code in check.causes),
    )  # fmt: skip


Seen = Mapping[tuple[str, Mounts], SeenPair]
"""The pairs of an instant by camera, and by which of their sensors has moved."""


def driven(drive: DisplacedRigDrive) -> RigDriveRow:
    """All looks and urgent windows of a drive; an error becomes the row's `failure`.

    Raises:
        UsageError: there is no such camera.
    """
    stops = instants(drive.right, LIDAR, TURN_S)
    row = RigDriveRow(name=drive.name, seed=FIRST_SEED + drive.number, camera=drive.camera)
    try:
        seen = [_seen(drive, instant) for instant in stops]
        checks = tuple(_checks(drive, seen))
        frames = {key: [of.frames for of in _of(seen, *key)] for key in _variants(drive)}
        windows = tuple(urgent_windows(drive, frames, checks))
    except CoecError as error:
        return row.model_copy(update={"failure": f"{type(error).__name__}: {error}"})
    return row.model_copy(update={"looks": checks, "windows": windows})


def _variants(drive: DisplacedRigDrive) -> Iterator[tuple[str, Mounts]]:
    """Each camera as built, with the LiDAR moved, and moved itself if it is one of those that may be knocked."""
    for camera in drive.right.cameras:
        yield from ((camera, mounts) for mounts in Mounts if mounts is not Mounts.CAMERA or camera in drive.cameras)


def _of(seen: Sequence[Seen], camera: str, mounts: Mounts) -> list[SeenPair]:
    """The pairs of a camera, from the knock on with its sensors as `mounts` says."""
    pairs = (one.get((camera, mounts)) or one.get((camera, Mounts.AS_BUILT)) for one in seen)
    return [pair for pair in pairs if pair is not None]


def _checks(drive: DisplacedRigDrive, seen: Sequence[Seen]) -> Iterator[RigLook]:
    """In the order of their stamps."""
    for number in range(1, len(seen) + 1):
        for camera in due(number, drive.right.cameras):
            yield from _checks_of(drive, camera, seen[max(number - CHECK_PAIRS, 0) : number])


def _checks_of(drive: DisplacedRigDrive, camera: str, latest: Sequence[Seen]) -> Iterator[RigLook]:
    """Looks at one pair: with all sensors as built, and with each sensor moved that has moved in its latest frames."""
    rig = drive.right.pair(camera, LIDAR).rig
    for mounts in Mounts:
        if (camera, mounts) not in latest[-1] and mounts is not Mounts.AS_BUILT:
            continue
        observation = observe(rig, drive.served[rig.pair], _of(latest, camera, mounts))
        yield RigLook(
            edge=rig.pair, mounts=mounts, pair_stamps_ns=observation.pair_stamps_ns,
            offset=vector6_of(observation.offset), sigma=vector6_of(observation.sigma),
            noise=vector6_of(observation.noise), place=vector6_of(observation.place),
            dispersion=observation.dispersion, distance2=observation.distance2, flagged=observation.flagged,
            weak=observation.weak, causes=tuple(cause.code for cause in observation.causes),
        )  # fmt: skip


def _seen(drive: DisplacedRigDrive, instant: Instant) -> dict[tuple[str, Mounts], SeenPair]:
    """The pairs of an instant: one of every camera with all sensors as built, and after the knock also one for each
    knocked sensor in it."""
    right, displaced = drive.right, drive.displaced
    motions = tuple(right.message(entry) for entry in instant.motions)
    seen_pairs: dict[tuple[str, Mounts], SeenPair] = {}
    sweep = right.message(instant.sweep)
    assert isinstance(sweep, types.LidarFrame)
    of_sweep = prepare_sweep(sweep)
    moved = displaced.message(instant.sweep) if _is_after(drive, instant.sweep.stamp_ns) else None
    of_moved = prepare_sweep(moved) if isinstance(moved, types.LidarFrame) else None
    for camera, entry in instant.pictures.items():
        picture = right.message(entry)
        seen_pairs |= _joined((camera, Mounts.AS_BUILT), pair_of(picture, sweep, motions), of_sweep)
        if moved is not None and of_moved is not None:
            seen_pairs |= _joined((camera, Mounts.LIDAR), pair_of(picture, moved, motions), of_moved)
        if camera in drive.cameras and _is_after(drive, entry.stamp_ns):
            seen_pairs |= _joined((camera, Mounts.CAMERA), pair_of(displaced.message(entry), sweep, motions), of_sweep)
    return seen_pairs


def _joined(
    key: tuple[str, Mounts], frames: types.FramePair | None, sweep: PreparedSweep
) -> dict[tuple[str, Mounts], SeenPair]:
    return {} if frames is None else {key: SeenPair(frames, sweep)}


def _is_after(drive: DisplacedRigDrive, stamp_ns: int) -> bool:
    return stamp_ns - START_NS >= drive.at_s * 1e9


@dataclass(frozen=True, slots=True)
class SensorDisplacement:
    """A fault: how many of a drive's two cameras are knocked, and whether its LiDAR is."""

    name: str
    cameras: int = 0
    lidar: bool = False

    def sensors(self, drive: DisplacedRigDrive) -> frozenset[str]:
        """Names of the sensors that it knocks on a drive."""
        return frozenset((*drive.cameras[: self.cameras], *((LIDAR,) if self.lidar else ())))


DISPLACEMENTS = (
    SensorDisplacement("nobody"),
    SensorDisplacement("one camera 1°", cameras=1),
    SensorDisplacement("the LiDAR 1°", lidar=True),
    SensorDisplacement("two cameras 1°", cameras=2),
)


def report(rows: Sequence[simulation_schemas.RigDriveRow], camera: str) -> simulation_schemas.RigDrivesReport:
    """All figures of the rows."""
    good = [row for row in rows if row.failure is None]
    checks = [check for row in good for check in row.looks]
    windows = [window for row in good for window in row.windows]
    return simulation_schemas.RigDrivesReport(
        allowed_s=ALLOWED_S,
        camera=camera,
        drives=len(good),
        failed=len(rows) - len(good),
        looks=len(checks),
        faint=sum(check.weak for check in checks),
        blind=sum(bool(check.causes) for check in checks),
        windows=len(windows),
        accepted=sum(window.accepted for window in windows),
        moves=tuple(_row(knock, good) for knock in DISPLACEMENTS),
    )


def _row(knock: SensorDisplacement, rows: Sequence[simulation_schemas.RigDriveRow]) -> simulation_schemas.RigDrivesRow:
    each = tuple(moves_of(row, knock) for row in rows)
    right = sorted(one.named_s for one in each if one.named_s is not None and not one.wrong)
    wrong = sum(bool(one.wrong) for one in each)
    return simulation_schemas.RigDrivesRow(
        rig="four fisheyes, one LiDAR, rendered", fault=knock.name, drives=len(each), right=len(right),
        undecided=len(each) - len(right) - wrong, wrong=wrong, delay_s=tuple(right),
        alarms_s=tuple(sorted(one.alarm_s for one in each if one.alarm_s is not None)), each=each,
    )  # fmt: skip


def moves_of(row: simulation_schemas.RigDriveRow, knock: SensorDisplacement) -> simulation_schemas.RigDriveMoves:
    """What was named on one drive with one fault. Where no sensor moved, the drive is right after 0 s if none is ever
    named."""
    drive = _drive(row)
    who = knock.sensors(drive)
    named_s: float | None = None if who else 0.0
    alarm_s: float | None = None
    wrong: set[str] = set()
    wrong_s: float | None = None
    for at_s, named, alarmed in _named_over_time(row, who):
        late_s = at_s - drive.at_s
        if late_s > ALLOWED_S:
            break
        falsely = named - (who if late_s >= 0.0 else frozenset[str]())
        wrong |= falsely
        if falsely and wrong_s is None:
            wrong_s = late_s
        if who and named_s is None and late_s >= 0.0 and named == who:
            named_s = late_s
        if alarm_s is None and late_s >= 0.0 and any(who & set(pair.split("-")) for pair in alarmed):
            alarm_s = late_s
    return simulation_schemas.RigDriveMoves(
        name=row.name, moved=tuple(sorted(who)), named_s=named_s, alarm_s=alarm_s, wrong=tuple(sorted(wrong)),
        wrong_s=wrong_s,
    )  # fmt: skip


def _named_over_time(
    row: simulation_schemas.RigDriveRow, who: frozenset[str]
) -> Iterator[tuple[float, frozenset[str], frozenset[str]]]:
    """After each look and each accepted window of a drive on which the sensors `who` moved: the second of the drive,
    the sensors named, and the pairs that have confirmed a move."""
    drive = _drive(row)
    graph = drive.graph
    state: RigState = initial(graph)
    for edge, pose in drive.served.items():
        state = served(state, edge, pose, WINDOW)
    pairs = {edge: pair_at(pose) for edge, pose in drive.served.items()}
    for known_ns, record in _records(row, drive, who):
        pose = drive.served[record.edge]
        if isinstance(record, simulation_schemas.RigWindow):
            if (evidence := window_evidence(record, pose)) is not None:
                state = after_window(state, graph, evidence)
        else:
            observation = observation_of(record)
            pairs[record.edge] = pair = after_observation(pairs[record.edge], observation, RULES)
            evidence = observation_of_check(record.edge, pose, observation, stepped_ns=pair.flagged_since_ns)
            if evidence is not None:
                state = after_edge_observation(state, graph, evidence)
        named = frozenset(one.name for one in sensors(state, graph) if one.health in MOVED)
        sure = frozenset(name for name, of in pairs.items() if of.monitor.outcome is MonitorOutcome.CONFIRMED)
        yield (known_ns - START_NS) / NS_PER_S, named, sure


def _records(
    row: simulation_schemas.RigDriveRow, drive: DisplacedRigDrive, who: frozenset[str]
) -> list[tuple[int, simulation_schemas.RigLook | simulation_schemas.RigWindow]]:
    """The looks and accepted windows at each pair with the sensors `who` moved, by the stamp at which they count."""
    records: list[tuple[int, simulation_schemas.RigLook | simulation_schemas.RigWindow]] = []
    for edge in drive.graph.edges:
        mounts = (
            simulation_schemas.Mounts.LIDAR
            if edge.b in who
            else simulation_schemas.Mounts.CAMERA
            if edge.a in who
            else simulation_schemas.Mounts.AS_BUILT
        )
        records += [(check.pair_stamps_ns[-1], check) for check in variant(row.looks, edge.name, mounts)]
        of_edge = (one for one in row.windows if (one.edge, one.mounts) == (edge.name, mounts))
        records += [(window.known_ns, window) for window in of_edge if window.accepted]
    return sorted(records, key=lambda one: (one[0], one[1].edge))


def _drive(row: simulation_schemas.RigDriveRow) -> DisplacedRigDrive:
    return DisplacedRigDrive(row.seed - FIRST_SEED, row.camera)
