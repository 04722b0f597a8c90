"""`coec demo --rig`: plays the acts one after the other, shows the rig from above, and reports which sensor was
identified when. The vehicle renders them; a client sends its frames and receives the state of the rig. The displaced
sensor is identified, and no other ever is."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import islice
from math import hypot
from pathlib import Path

from coec.calibration.types import Frame
from coec.geometry.se3 import inverse
from coec.io.user_files import write_output as write_file
from coec.io.zenoh.player import Player
from coec.reports import console
from coec.reports.page import Cell, Page, Picture, Pictures, Section, Table, Text, VerdictBanner
from coec.reports.page import write as write_page
from coec.reports.page_parts import TONES, Provenance, read
from coec.schemas.replies import CheckReply
from coec.schemas.rig_state import RigReply, SensorReply
from coec_lab.demo.demo_plots import MOVED, PlottedEdge, PlottedSensor, percent, rig_from_above, state_text
from coec_lab.demo.pair_client import NS_PER_S, RENDERERS
from coec_lab.demo.service import DemoError, RigService, serving
from coec_lab.experiments.rig_drives import ROWS, TURN_S
from coec_lab.simulation.drive import Arrival
from coec_lab.simulation.faults import SensorFault, StepFault
from coec_lab.simulation.journey import START_NS
from coec_lab.simulation.parallel import FrameRenderers, frame_renderers
from coec_lab.simulation.rig_drive import Instant, RigDrive, RigDriveConfig, instants

AHEAD = 6
"""Instants that are rendered, or wait to be, ahead of the one that is sent. Each costs four seconds of a core, which
are wasted when an act ends; so many keep the renderers busy while the service starts."""

AS_BUILT = 0
"""Number of the drive in which no sensor is displaced; the drives of the acts follow in their order."""

LISTEN_S = 30.0
"""Time limit for a running service to subscribe to all its sensors."""

MOST_HELD = 4
"""Frame pairs that may wait in the service when more are sent, so that it has work while these are rendered."""


TURN = (0.0, 1.0, 0.0)
"""Turn of a displaced sensor about its own axes, degrees: the LiDAR nods and the camera yaws."""


@dataclass(frozen=True, slots=True)
class Act:
    """One drive.

    Attributes:
        name: of its files.
        sensor: the displaced one.
        turn_deg: of the sensor about its own axes.
    """

    name: str
    sensor: str
    turn_deg: tuple[float, float, float] = TURN

    @property
    def knock_deg(self) -> float:
        """Angle of the displacement."""
        return hypot(*self.turn_deg)


@dataclass(frozen=True, slots=True)
class Scenario:
    """One street, driven once for each act.

    Attributes:
        lidar: whose view all four cameras share; the rig's short-range LiDARs are left out.
        camera_px: side of the pictures. Pictures of 1400 px take four times as long to render. With half as many
            pixels, one degree is within the uncertainty of the pixels, and a single camera that is off by it stays
            undecided.
        knock_s: time of the displacement: by then every pair has been checked twice.
        longest_s: length of the drive if no sensor is identified: an alarm has to occur within a minute.
        rest_s: driving after the sensor was identified, in which every pair is checked once more.
    """

    acts: tuple[Act, ...] = (Act("lidar", "roof"), Act("camera", "left"))
    lidar: str = "roof"
    seed: int = 2
    camera_px: int = 700
    knock_s: float = 16.0
    longest_s: float = 76.0
    rest_s: float = 6.0

    def drive_config(self, act: Act | None) -> RigDriveConfig:
        """Configuration of the drive of an act; None: no sensor is displaced."""
        faults: tuple[SensorFault, ...] = ()
        if act is not None:
            rx, ry, rz = act.turn_deg
            faults = (SensorFault(act.sensor, StepFault(self.knock_s, float("inf"), rx=rx, ry=ry, rz=rz)),)
        camera = f"fisheye{self.camera_px}"
        return RigDriveConfig(
            seed=self.seed, seconds=self.longest_s, camera=camera, ego_hz=20.0, faults=faults, rows=ROWS
        )


SCENARIO = Scenario()
"""What `coec demo --rig` plays."""


@dataclass(frozen=True, slots=True, eq=False)
class InstantFrames:
    """Frames of one instant: a sweep, a picture by camera, and the motion around them."""

    sweep: Frame
    pictures: Mapping[str, Frame]
    motions: tuple[Frame, ...]

    @property
    def second(self) -> float:
        """Second of the drive."""
        return (self.sweep.stamp_ns - START_NS) / NS_PER_S


class RigVehicle:
    """Drives the same street in every act. A frame of a sensor that did not move is the same in every act and is
    rendered once. Other processes render frames some instants ahead, while the service starts and while it checks."""

    def __init__(self, drawers: FrameRenderers, scenario: Scenario = SCENARIO) -> None:
        """Raises SourceError: the library that casts rays is not installed."""
        self.scenario = scenario
        self.as_built = RigDrive(scenario.drive_config(None))
        self._drawers = drawers
        self._started: dict[tuple[int, Arrival], Future[Frame]] = {}

    @cached_property
    def plan(self) -> list[Instant]:
        """The instants, which are the same in every act."""
        return instants(self.as_built, self.scenario.lidar, TURN_S)

    def frames(self, act: Act) -> Iterator[InstantFrames]:
        """All frames of an act, in order. The first are already being rendered when this returns."""
        if not self._started:
            self._render_first()
        started = ((instant, self._begin(act, instant)) for instant in self.plan)
        waiting = deque(islice(started, AHEAD))
        return self._in_order(waiting, started)

    def _in_order(
        self, waiting: deque[tuple[Instant, Sequence[Future[Frame]]]],
        started: Iterator[tuple[Instant, Sequence[Future[Frame]]]],
    ) -> Iterator[InstantFrames]:  # fmt: skip
        while waiting:
            instant, frames = waiting.popleft()
            sweep, *pictures = (frame.result() for frame in frames)
            waiting.extend(islice(started, 1))
            motions = tuple(self.as_built.message(entry) for entry in instant.motions)
            yield InstantFrames(sweep, dict(zip(instant.pictures, pictures, strict=True)), motions)

    def _render_first(self) -> None:
        """Render the first instant in this process. What this compiles, once per machine, is reported to the waiting
        user, and every renderer has it compiled."""
        for entry in (self.plan[0].sweep, *self.plan[0].pictures.values()):
            rendered: Future[Frame] = Future()
            rendered.set_result(self.as_built.message(entry))
            self._started[AS_BUILT, entry] = rendered

    def _begin(self, act: Act, instant: Instant) -> Sequence[Future[Frame]]:
        """Begin to render the sweep and the pictures of an instant, unless an earlier act has."""
        entries = (instant.sweep, *instant.pictures.values())
        numbered = [(self._drive_of(act, entry), entry) for entry in entries]
        for drive, entry in numbered:
            if (drive, entry) not in self._started:
                self._started[drive, entry] = self._drawers.render(drive, entry)
        return [self._started[one] for one in numbered]

    def _drive_of(self, act: Act, entry: Arrival) -> int:
        """Number of the drive that an entry is rendered from: the act's, for its displaced sensor after the
        displacement, else the drive as built."""
        moved = self.as_built.stream(act.sensor)
        is_displaced = entry.stream == moved and entry.stamp_ns - START_NS >= self.scenario.knock_s * NS_PER_S
        return 1 + self.scenario.acts.index(act) if is_displaced else AS_BUILT


@contextmanager
def driving(scenario: Scenario = SCENARIO) -> Iterator[RigVehicle]:
    """The vehicle, with processes that render what it sees.

    Raises:
        SourceError: the library that casts rays is not installed.
    """
    configs = [scenario.drive_config(act) for act in (None, *scenario.acts)]
    with frame_renderers(configs, RENDERERS) as drawers:
        yield RigVehicle(drawers, scenario)


@dataclass(frozen=True, slots=True)
class SensorCondition:
    """What the service reports about a sensor, see `SensorReply`; `moved_deg` is None if it did not move."""

    name: str
    kind: str
    state: str
    probability: float
    moved_deg: float | None
    reason: str


@dataclass(frozen=True, slots=True)
class RigSnapshot:
    """State of the rig after checks of some pairs.

    Attributes:
        second: of the drive, up to which everything is included.
        checked: the pairs.
        sensors: by name.
        edges: result of the latest check of each pair, by pair, without pairs that were never checked.
    """

    second: float
    checked: str
    sensors: Mapping[str, SensorCondition]
    edges: Mapping[str, PlottedEdge]

    @property
    def named(self) -> frozenset[str]:
        """Sensors that are reported as moved."""
        return frozenset(name for name, sensor in self.sensors.items() if sensor.state in MOVED)


class RigClient:
    """Sends frames to a service, and queries it."""

    def __init__(self, service: RigService) -> None:
        """Raises DemoError: the service does not subscribe to its sensors."""
        self._service = service
        self._player = Player(service.session, service.sensors, "msgpack")
        if without_listener := self._player.wait_for_listener(LISTEN_S):
            raise DemoError(f"the service does not subscribe to {', '.join(without_listener)}")
        self._instants = 0
        self._motion_ns = -1
        self._checks: Mapping[str, int] = {}

    def send(self, frames: InstantFrames) -> list[RigSnapshot]:
        """Sends the frames of one more instant; returns what is new since the last call.

        Raises:
            DemoError: the service ends, or does not check.
        """
        # Two instants may share motion.
        motions = [motion for motion in frames.motions if motion.stamp_ns > self._motion_ns]
        self._motion_ns = max((motion.stamp_ns for motion in motions), default=self._motion_ns)
        ordered = sorted((frames.sweep, *frames.pictures.values(), *motions), key=lambda frame: frame.stamp_ns)
        self._player.play(ordered, 0.0, threading.Event(), lambda *_: None)
        self._instants += 1
        self._service.until_taken(self._instants, MOST_HELD)
        return self._new()

    def finish(self) -> list[RigSnapshot]:
        """After the last frames, waits until all were checked; returns what is new.

        Raises:
            DemoError: the service ends, or does not check.
        """
        self._service.until_at_rest()
        return self._new()

    def _new(self) -> list[RigSnapshot]:
        reply = self._service.rig()
        checked = sorted(pair for pair, count in reply.looks.items() if count > self._checks.get(pair, 0))
        if not checked or reply.stamp_ns is None:
            return []
        self._checks = reply.looks
        health = self._service.health()
        checks = {pair: of.check for pair, of in health.items() if of.check is not None}
        return [snapshot_of(reply, reply.stamp_ns, checked, checks, self._service.sensors_of)]


def snapshot_of(
    reply: RigReply,
    stamp_ns: int,
    checked: Sequence[str],
    checks: Mapping[str, CheckReply],
    sensors_of: Mapping[str, tuple[str, str]],
) -> RigSnapshot:
    """What a reply about everything up to a stamp, and the latest checks, contain. `sensors_of` names camera and LiDAR
    of each pair."""
    return RigSnapshot(
        second=(stamp_ns - START_NS) / NS_PER_S,
        checked=", ".join(checked),
        sensors={one.name: _sensor(one) for one in reply.sensors},
        edges={pair: _edge(*sensors_of[pair], check) for pair, check in checks.items()},
    )


def _sensor(of: SensorReply) -> SensorCondition:
    moved_deg = None if of.moved is None else hypot(*of.moved.by[:3])
    return SensorCondition(of.name, of.kind, of.state, of.probability or 0.0, moved_deg, of.reasons[0].text)


def _edge(camera: str, lidar: str, check: CheckReply) -> PlottedEdge:
    """How much the pair is turned. Its σ is such that the turn is as many σ as all three axes together."""
    pairs = zip(check.offset[:3], check.sigma[:3], strict=True)
    axes = [(turn, sigma) for turn, sigma in pairs if turn is not None and sigma is not None and sigma > 0.0]
    turn_deg, sigmas = hypot(*(turn for turn, _ in axes)), hypot(*(turn / sigma for turn, sigma in axes))
    return PlottedEdge(camera, lidar, turn_deg, turn_deg / sigmas if sigmas > 0.0 else float("nan"))


@dataclass(frozen=True, slots=True)
class ActOutcome:
    """Outcome of one act.

    Attributes:
        named_s: second of the drive from which the displaced sensor alone was identified to the end; None: never.
        wrong: sensors that were identified at any time although they had not moved.
    """

    act: Act
    named_s: float | None
    wrong: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether the displaced sensor was identified, and no other."""
        return not self.failures()

    def failures(self) -> tuple[str, ...]:
        """What failed, one sentence each."""
        sentences = [f"{name} was reported as moved, and had not moved." for name in self.wrong]
        if self.named_s is None:
            sentences.append(f"{self.act.sensor} was displaced, and is not identified at the end.")
        return tuple(sentences)


def outcome_of(act: Act, snapshots: Sequence[RigSnapshot], knock_s: float) -> ActOutcome:
    """The outcome from all snapshots, in order."""
    wrong: set[str] = set()
    named_s: float | None = None
    for snapshot in snapshots:
        moved = {act.sensor} if snapshot.second >= knock_s else set()
        wrong |= snapshot.named - moved
        if snapshot.named != {act.sensor}:
            named_s = None
        elif named_s is None:
            named_s = snapshot.second
    return ActOutcome(act, named_s, tuple(sorted(wrong)))


def is_over(outcome: ActOutcome, snapshot: RigSnapshot, rest_s: float) -> bool:
    """Whether the act may end, because the correct sensor has been identified for `rest_s`."""
    return outcome.named_s is not None and snapshot.second >= outcome.named_s + rest_s


TITLE = "Which sensor moved? A displaced LiDAR and a displaced camera"
LIDAR_VIEW_DEG = 360.0

ABOUT = (
    "Four fisheyes see what one LiDAR measures, and each of the four pairs is checked every five seconds. A "
    "displaced camera affects its own pair; a displaced LiDAR affects all pairs alike. After each check, the service "
    "infers which sensor explains all checks with the fewest moves. Vehicle and street are simulated, "
    f"with pictures of {SCENARIO.camera_px} pixels a side, of which those rows are rendered that the LiDAR sees; what "
    "checks and infers is the service, a process of its own behind a router, as on a vehicle."
)

PICTURED = "From above. The redder a line, the more probable that its pair has moved."

EXPLAINED = (
    "A share is how probable it is that the sensor has moved. It is identified when that was the result twice in a "
    "row, and two of its pairs agree if it has several; until then it is undecided."
)

Performance = tuple[ActOutcome, Sequence[RigSnapshot]]
"""An act: its outcome, and every snapshot."""


def run(output: Path, *, as_json: bool, scenario: Scenario = SCENARIO) -> int:
    """Plays all acts; returns 1 if one failed.

    Raises:
        DemoError: the service does not start, answer or end.
        OutputError: a file cannot be written.
    """
    started_s = time.monotonic()
    console.say("demo: the street is built; on the first run of a machine kernels are compiled, for about a minute")
    acts: list[Performance] = []
    with driving(scenario) as vehicle, console.progress() as bars:
        task = bars.add_task("instants of the drives", total=len(scenario.acts) * len(vehicle.plan), note="")
        for act in scenario.acts:
            acts.append(_play(vehicle, act, lambda note: bars.update(task, advance=1, note=note)))
            bars.update(task, completed=len(acts) * len(vehicle.plan))
        as_built = vehicle.as_built
    files = write(output, as_built, acts, scenario)
    console.report(
        document(acts, files, time.monotonic() - started_s, scenario),
        lambda: show(acts, files, scenario),
        as_json=as_json,
    )
    return 0 if all(outcome.passed for outcome, _ in acts) else 1


def _play(vehicle: RigVehicle, act: Act, on_instant: Callable[[str], None]) -> tuple[ActOutcome, list[RigSnapshot]]:
    """Plays an act, with a service of its own that knows nothing of other acts, until the sensor is identified or the
    drive is over. `on_instant` is called for every instant.

    Raises:
        DemoError: the service does not start, answer or end, or checks nothing.
    """
    snapshots: list[RigSnapshot] = []
    scenario = vehicle.scenario
    with serving(vehicle.as_built, scenario.lidar) as service:
        rendered = vehicle.frames(act)
        service.until_ready()
        client = RigClient(service)
        for frames in rendered:
            on_instant(f"{act.name}: {frames.second:.0f} s of driving")
            _record(act, snapshots, client.send(frames))
            if snapshots and is_over(outcome_of(act, snapshots, scenario.knock_s), snapshots[-1], scenario.rest_s):
                break
        else:
            _record(act, snapshots, client.finish())
    if not snapshots:
        raise DemoError("the service has checked none of its pairs")
    return outcome_of(act, snapshots, scenario.knock_s), snapshots


def _record(act: Act, snapshots: list[RigSnapshot], new: list[RigSnapshot]) -> None:
    """Records what is new, and reports when the identified sensors change."""
    for snapshot in new:
        before = snapshots[-1].named if snapshots else None
        snapshots.append(snapshot)
        if before != snapshot.named:
            console.say(f"demo: {act.name}: {snapshot.second:5.1f} s of driving: {_moved_text(snapshot)}")


def _moved_text(snapshot: RigSnapshot) -> str:
    return f"{' and '.join(sorted(snapshot.named))} moved" if snapshot.named else "no sensor is reported as moved"


def write(output: Path, drive: RigDrive, acts: Sequence[Performance], scenario: Scenario) -> list[Path]:
    """Writes all files into the folder.

    Args:
        drive: as the vehicle was built.

    Raises:
        OutputError: a file cannot be written.
    """
    pictures = []
    for outcome, snapshots in acts:
        path = output / f"{outcome.act.name}_knocked.png"
        pictures.append(write_file(path, picture(drive, outcome.act, snapshots[-1], scenario)))
    return [*pictures, write_page(output / "report.html", page(pictures, acts, Provenance.here(), scenario))]


def picture(drive: RigDrive, act: Act, snapshot: RigSnapshot, scenario: Scenario) -> bytes:
    """PNG of the rig from above, in the state that the service reports."""
    half_deg = drive.config.layout.half_view_deg
    seen = [
        PlottedSensor(
            name=sensor.name, kind=sensor.kind, T_ego_sensor=inverse(drive.T_sensor_ego_nominal(sensor.name)),
            view_deg=LIDAR_VIEW_DEG if sensor.kind == "lidar" else 2.0 * half_deg, state=sensor.state,
            probability=sensor.probability, moved_deg=sensor.moved_deg,
        )
        for sensor in snapshot.sensors.values()
    ]  # fmt: skip
    ago_s = snapshot.second - scenario.knock_s
    title = f"{_the(act, scenario)} was turned by {act.knock_deg:.2g}°; {ago_s:.0f} s of driving later"
    return rig_from_above(seen, list(snapshot.edges.values()), title)


def changes(snapshots: Sequence[RigSnapshot]) -> list[RigSnapshot]:
    """The first snapshot, and each that differs from the one before."""
    selected: list[RigSnapshot] = []
    for snapshot in snapshots:
        if not selected or _states(snapshot) != _states(selected[-1]):
            selected.append(snapshot)
    return selected


def summary(outcome: ActOutcome, scenario: Scenario) -> str:
    """An act in a sentence."""
    act = outcome.act
    displaced = f"{_the(act, scenario)} was turned by {act.knock_deg:.2g}° at {scenario.knock_s:.0f} s of driving"
    if not outcome.passed:
        return f"{displaced}. " + " ".join(outcome.failures())
    assert outcome.named_s is not None  # else it is a failure
    return f"{displaced}, and identified {outcome.named_s - scenario.knock_s:.0f} s later, it alone."


def show(acts: Sequence[Performance], files: Sequence[Path], scenario: Scenario) -> None:
    """Prints the summary in the terminal."""
    for outcome, snapshots in acts:
        console.show_block(_changes_table(outcome.act, snapshots))
        console.show(summary(outcome, scenario), "bold green" if outcome.passed else "bold red")
        console.out.print()
    for path in files:
        console.show(f"{path}  {path.stat().st_size} bytes")


def document(
    acts: Sequence[Performance], files: Sequence[Path], elapsed_s: float, scenario: Scenario
) -> dict[str, object]:
    """What `--json` prints."""
    return {
        "acts": [
            {
                "knocked": outcome.act.sensor,
                "knock_s": scenario.knock_s,
                "knock_deg": outcome.act.knock_deg,
                "named_s": outcome.named_s,
                "wrong": list(outcome.wrong),
                "passed": outcome.passed,
                "objections": list(outcome.failures()),
                "told": [
                    {
                        "drive_s": snapshot.second,
                        "looked_at": snapshot.checked,
                        "sensors": [asdict(sensor) for sensor in snapshot.sensors.values()],
                    }
                    for snapshot in changes(snapshots)
                ],
            }
            for outcome, snapshots in acts
        ],
        "passed": all(outcome.passed for outcome, _ in acts),
        "elapsed_s": elapsed_s,
        "files": [str(path) for path in files],
    }


def page(pictures: Sequence[Path], acts: Sequence[Performance], made: Provenance, scenario: Scenario) -> Page:
    """The page of all acts.

    Raises:
        OutputError: a picture can no longer be read.
    """
    sections = [
        Section(
            _heading(outcome.act, scenario),
            (
                Text((summary(outcome, scenario),)),
                Pictures((Picture(read(path), _alt(outcome, snapshots[-1]), PICTURED),)),
                _changes_table(outcome.act, snapshots),
                Text((EXPLAINED,)),
                Text((snapshots[-1].sensors[outcome.act.sensor].reason,)),
            ),
        )
        for path, (outcome, snapshots) in zip(pictures, acts, strict=True)
    ]
    failures = [failure for outcome, _ in acts for failure in outcome.failures()]
    verdict = (
        VerdictBanner("bad", "Not identified.", " ".join(failures))
        if failures
        else VerdictBanner("good", "Identified.", "Each displaced sensor was detected and identified, and no other.")
    )
    return Page("coec demo --rig", TITLE, (verdict, Text((ABOUT,))), (*sections, made.section()))


def _alt(outcome: ActOutcome, snapshot: RigSnapshot) -> str:
    states = ", ".join(f"{name} {state_text(sensor.state)}" for name, sensor in snapshot.sensors.items())
    return f"The vehicle from above after {outcome.act.sensor} was turned: {states}"


def _heading(act: Act, scenario: Scenario) -> str:
    return f"{_the(act, scenario)} is displaced"


def _the(act: Act, scenario: Scenario) -> str:
    return f"The {'LiDAR' if act.sensor == scenario.lidar else 'camera'} {act.sensor}"


def _order(act: Act, snapshot: RigSnapshot) -> tuple[str, ...]:
    """Sensors, the displaced one first, so that it is visible on a narrow screen."""
    return (act.sensor, *(name for name in snapshot.sensors if name != act.sensor))


def _changes_table(act: Act, snapshots: Sequence[RigSnapshot]) -> Table:
    order = _order(act, snapshots[0])
    rows: list[Sequence[str | Cell]] = [
        (f"{snapshot.second:.1f} s", *(_state_cell(snapshot.sensors[name]) for name in order), snapshot.checked)
        for snapshot in changes(snapshots)
    ]
    heads = ("Drive", *order, "Checked")
    return Table("State of every sensor, whenever it changed", heads, rows, frozenset({0}))


def _state_cell(sensor: SensorCondition) -> Cell:
    share = "" if sensor.probability < 0.005 else f", {percent(sensor.probability)}"
    return Cell(state_text(sensor.state) + share, tone=TONES.get(sensor.state, "none"))


def _states(snapshot: RigSnapshot) -> list[str]:
    return [sensor.state for sensor in snapshot.sensors.values()]
