"""Which sensor moved on rendered drives of a rig: attribution and alarms of the pairs, run on looks taken before."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from coec.calibration.lifecycle import PairState, Provenance, Rules, Status, after_observation
from coec.calibration.monitor.change_detector import Finding, MonitorState, Observation
from coec.calibration.monitor.sensor_faults import CAUSES
from coec.calibration.rig.attribution import RigState, after_look, begun, sensors, served
from coec.calibration.rig.evidence import of_check
from coec.config import MonitorConfig, PolicyConfig, TrackerConfig
from coec.evaluation.check_drives import CHECK_PAIRS
from coec.evaluation.rig_drives import FIRST_SEED, LIDAR, KnockedDrive
from coec.evaluation.rig_evidence import WINDOW
from coec.evaluation.rig_looks import PERIOD_S
from coec.evaluation.rig_moves import ALLOWED_S, MOVED
from coec.schemas.rig import Mounts, RigDriveMoves, RigDriveRow, RigDrivesReport, RigDrivesRow, RigLook
from coec.simulation.journey import START_NS

NS_PER_S = 1_000_000_000
RULES = Rules(PolicyConfig(), TrackerConfig(), MonitorConfig(period_s=PERIOD_S, pairs=CHECK_PAIRS))


@dataclass(frozen=True, slots=True)
class Knock:
    """A fault: how many of a drive's two cameras are knocked, and whether its LiDAR is."""

    name: str
    cameras: int = 0
    lidar: bool = False

    def sensors(self, drive: KnockedDrive) -> frozenset[str]:
        """Names of the sensors that it knocks on a drive."""
        return frozenset((*drive.cameras[: self.cameras], *((LIDAR,) if self.lidar else ())))


KNOCKS = (
    Knock("nobody"),
    Knock("one camera 1°", cameras=1),
    Knock("the LiDAR 1°", lidar=True),
    Knock("two cameras 1°", cameras=2),
)


def report(rows: Sequence[RigDriveRow], camera: str) -> RigDrivesReport:
    """All figures of the rows."""
    good = [row for row in rows if row.failure is None]
    looks = [look for row in good for look in row.looks]
    return RigDrivesReport(
        allowed_s=ALLOWED_S,
        camera=camera,
        drives=len(good),
        failed=len(rows) - len(good),
        looks=len(looks),
        faint=sum(look.weak for look in looks),
        blind=sum(bool(look.causes) for look in looks),
        moves=tuple(_row(knock, good) for knock in KNOCKS),
    )


def _row(knock: Knock, rows: Sequence[RigDriveRow]) -> RigDrivesRow:
    each = tuple(moves_of(row, knock) for row in rows)
    right = sorted(one.named_s for one in each if one.named_s is not None and not one.wrong)
    wrong = sum(bool(one.wrong) for one in each)
    return RigDrivesRow(
        rig="four fisheyes, one LiDAR, rendered", fault=knock.name, drives=len(each), right=len(right),
        undecided=len(each) - len(right) - wrong, wrong=wrong, delay_s=tuple(right),
        alarms_s=tuple(sorted(one.alarm_s for one in each if one.alarm_s is not None)), each=each,
    )  # fmt: skip


def moves_of(row: RigDriveRow, knock: Knock) -> RigDriveMoves:
    """What was named on one drive with one fault. Where no sensor moved, the drive is right after 0 s if none is ever
    named."""
    drive = KnockedDrive(row.seed - FIRST_SEED, row.camera)
    who = knock.sensors(drive)
    named_s: float | None = None if who else 0.0
    alarm_s: float | None = None
    wrong: set[str] = set()
    wrong_s: float | None = None
    for at_s, named, alarmed in _told(drive, _looks_of(row, who)):
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
    return RigDriveMoves(
        name=row.name, moved=tuple(sorted(who)), named_s=named_s, alarm_s=alarm_s, wrong=tuple(sorted(wrong)),
        wrong_s=wrong_s,
    )  # fmt: skip


def _looks_of(row: RigDriveRow, who: frozenset[str]) -> Iterator[RigLook]:
    """The variant of each look in which the sensors `who` have moved."""
    taken: dict[tuple[str, int], dict[Mounts, RigLook]] = {}
    for look in row.looks:
        taken.setdefault((look.edge, look.pair_stamps_ns[-1]), {})[look.mounts] = look
    for (edge, _), by_mounts in taken.items():
        camera, _, lidar = edge.partition("-")
        moved = Mounts.LIDAR if lidar in who else Mounts.CAMERA if camera in who else Mounts.AS_BUILT
        yield by_mounts.get(moved, by_mounts[Mounts.AS_BUILT])


def _told(drive: KnockedDrive, looks: Iterator[RigLook]) -> Iterator[tuple[float, frozenset[str], frozenset[str]]]:
    """After each look: the second of the drive, the sensors named, and the pairs that have confirmed a move."""
    graph = drive.graph
    state: RigState = begun(graph)
    for edge, pose in drive.served.items():
        state = served(state, edge, pose, WINDOW)
    pairs = {
        edge: PairState(pose, Provenance.ESTIMATED, Status.ACCEPTED, START_NS, monitor=MonitorState(vouched=True))
        for edge, pose in drive.served.items()
    }
    for look in looks:
        observation = observation_of(look)
        pairs[look.edge] = pair = after_observation(pairs[look.edge], observation, RULES)
        pose = drive.served[look.edge]
        evidence = of_check(look.edge, pose, observation, stepped_ns=pair.flagged_since_ns)
        if evidence is not None:
            state = after_look(state, graph, evidence)
        named = frozenset(one.name for one in sensors(state, graph) if one.health in MOVED)
        sure = frozenset(name for name, of in pairs.items() if of.monitor.outcome is Finding.CONFIRMED)
        yield (observation.stamp_ns - START_NS) / NS_PER_S, named, sure


def observation_of(look: RigLook) -> Observation:
    """The look as the change detector takes it, without the figures that decide nothing."""
    offset, sigma, noise, place = (np.array(six) for six in (look.offset, look.sigma, look.noise, look.place))
    return Observation(
        stamp_ns=look.pair_stamps_ns[-1], pair_stamps_ns=look.pair_stamps_ns, metrics=(), offset=offset, sigma=sigma,
        noise=noise, place=place, dispersion=look.dispersion, distance2=look.distance2, flagged=look.flagged,
        weak=look.weak, flagged_by_paper=None, causes=tuple(CAUSES[code] for code in look.causes),
    )  # fmt: skip
