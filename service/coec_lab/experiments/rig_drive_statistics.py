"""Which sensor moved on rendered drives of a rig: attribution and alarms of the pairs, run on looks and windows
taken before."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from coec.calibration.monitor.change_detector import MonitorOutcome
from coec.calibration.rig.attribution import RigState, after_edge_observation, after_window, initial, sensors, served
from coec.calibration.rig.edge_observations import observation_of_check
from coec.calibration.state import after_observation
from coec_lab.experiments import rig_drives, simulation_schemas
from coec_lab.experiments.rig_evidence import WINDOW
from coec_lab.experiments.rig_moves import ALLOWED_S, MOVED
from coec_lab.simulation.journey import START_NS


@dataclass(frozen=True, slots=True)
class SensorDisplacement:
    """A fault: how many of a drive's two cameras are knocked, and whether its LiDAR is."""

    name: str
    cameras: int = 0
    lidar: bool = False

    def sensors(self, drive: rig_drives.DisplacedRigDrive) -> frozenset[str]:
        """Names of the sensors that it knocks on a drive."""
        return frozenset((*drive.cameras[: self.cameras], *((rig_drives.LIDAR,) if self.lidar else ())))


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
    pairs = {edge: rig_drives.pair_at(pose) for edge, pose in drive.served.items()}
    for known_ns, record in _records(row, drive, who):
        pose = drive.served[record.edge]
        if isinstance(record, simulation_schemas.RigWindow):
            if (evidence := rig_drives.window_evidence(record, pose)) is not None:
                state = after_window(state, graph, evidence)
        else:
            observation = rig_drives.observation_of(record)
            pairs[record.edge] = pair = after_observation(pairs[record.edge], observation, rig_drives.RULES)
            evidence = observation_of_check(record.edge, pose, observation, stepped_ns=pair.flagged_since_ns)
            if evidence is not None:
                state = after_edge_observation(state, graph, evidence)
        named = frozenset(one.name for one in sensors(state, graph) if one.health in MOVED)
        sure = frozenset(name for name, of in pairs.items() if of.monitor.outcome is MonitorOutcome.CONFIRMED)
        yield (known_ns - START_NS) / rig_drives.NS_PER_S, named, sure


def _records(
    row: simulation_schemas.RigDriveRow, drive: rig_drives.DisplacedRigDrive, who: frozenset[str]
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
        records += [(check.pair_stamps_ns[-1], check) for check in rig_drives.variant(row.looks, edge.name, mounts)]
        of_edge = (one for one in row.windows if (one.edge, one.mounts) == (edge.name, mounts))
        records += [(window.known_ns, window) for window in of_edge if window.accepted]
    return sorted(records, key=lambda one: (one[0], one[1].edge))


def _drive(row: simulation_schemas.RigDriveRow) -> rig_drives.DisplacedRigDrive:
    return rig_drives.DisplacedRigDrive(row.seed - rig_drives.FIRST_SEED, row.camera)
