"""`coec demo --rig`: plays the acts one after the other, shows the rig from above, and reports which sensor was
identified when."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from coec.geometry.se3 import inverse
from coec.io.user_files import write_output as write_file
from coec.reports import console
from coec.reports.page import Cell, Page, Picture, Pictures, Section, Table, Text, VerdictBanner
from coec.reports.page import write as write_page
from coec.reports.page_parts import TONES, Provenance, read
from coec_lab.demo.demo_plots import PlottedSensor, percent, rig_from_above, state_text
from coec_lab.demo.rig_drive import (
    SCENARIO,
    Act,
    ActOutcome,
    RigClient,
    RigSnapshot,
    RigVehicle,
    Scenario,
    driving,
    is_over,
    outcome_of,
)
from coec_lab.demo.service import DemoError, serving
from coec_lab.simulation.rig_drive import RigDrive

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
    if as_json:
        console.print_json(document(acts, files, time.monotonic() - started_s, scenario))
    else:
        show(acts, files, scenario)
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
        order = _order(outcome.act, snapshots[0])
        rows = console.table("drive", *order, "checked", right=(0,))
        for snapshot in changes(snapshots):
            rows.add_row(f"{snapshot.second:.1f} s", *_cells(snapshot, order), snapshot.checked)
        console.out.print(rows)
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
        (f"{snapshot.second:.1f} s", *_toned(snapshot, order), snapshot.checked) for snapshot in changes(snapshots)
    ]
    heads = ("Drive", *order, "Checked")
    return Table("State of every sensor, whenever it changed", heads, rows, frozenset({0}))


def _toned(snapshot: RigSnapshot, order: Sequence[str]) -> list[Cell]:
    states = [snapshot.sensors[name].state for name in order]
    return [
        Cell(text, tone=TONES.get(state, "none")) for text, state in zip(_cells(snapshot, order), states, strict=True)
    ]


def _cells(snapshot: RigSnapshot, order: Sequence[str]) -> list[str]:
    seen = [snapshot.sensors[name] for name in order]
    return [
        state_text(sensor.state) + ("" if sensor.probability < 0.005 else f", {percent(sensor.probability)}")
        for sensor in seen
    ]


def _states(snapshot: RigSnapshot) -> list[str]:
    return [sensor.state for sensor in snapshot.sensors.values()]
