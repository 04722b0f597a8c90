"""Files of the demonstration of a rig: the rig from above, act by act, and a page of what was named when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from coec.adapters.files.output import write as write_file
from coec.geometry.se3 import inverse
from coec.reports import console, provenance
from coec.reports.page import Cell, Page, Picture, Pictures, Section, Table, Text, Verdict
from coec.reports.page import write as write_page
from coec.reports.page_parts import TONES, read
from coec.reports.provenance import Made
from coec.reports.rig_plot import SensorSeen, percent, rig_from_above, state_words
from coec.simulation.rig_drive import RigDrive
from coec_lab.demo.rig import story
from coec_lab.demo.rig.outcome import Outcome
from coec_lab.demo.rig.story import Act
from coec_lab.demo.rig.told import Told

TITLE = "Who moved? A knocked LiDAR and a knocked camera"
LIDAR_VIEW_DEG = 360.0

ABOUT = (
    "Four fisheyes look at what one LiDAR measures, and each of the four pairs is looked at every five seconds. A "
    "camera that is knocked puts its own pair wrong; a LiDAR that is knocked puts all pairs wrong, and alike. Which "
    "sensor explains all looks with the fewest moves is asked after each of them. Vehicle and street are simulated, "
    f"with pictures of {story.CAMERA_PX} pixels a side, of which those rows are drawn that the LiDAR sees; what "
    "looks and tells is the service, a process of its own behind a router, as on a vehicle."
)

PICTURED = "From above. The redder a line, the surer its pair that something has moved."

BELIEVED = (
    "A share is how probable it is that the sensor has moved. It is named when that was the answer twice in a row, and "
    "two of its pairs say so if it has several; until then it is undecided."
)

Performance = tuple[Outcome, Sequence[Told]]
"""An act: its outcome, and everything that the service said."""


def write(output: Path, drive: RigDrive, acts: Sequence[Performance]) -> list[Path]:
    """Writes all files into the folder.

    Args:
        drive: as the vehicle was built.

    Raises:
        OutputError: a file cannot be written.
    """
    pictures = []
    for outcome, heard in acts:
        path = output / f"{outcome.act.name}_knocked.png"
        pictures.append(write_file(path, picture(drive, outcome.act, heard[-1])))
    return [*pictures, write_page(output / "report.html", page(pictures, acts, provenance.here()))]


def picture(drive: RigDrive, act: Act, told: Told) -> bytes:
    """PNG of the rig from above, in the state that the service believes."""
    half_deg = drive.config.layout.half_view_deg
    seen = [
        SensorSeen(
            name=sensor.name, kind=sensor.kind, T_ego_sensor=inverse(drive.T_sensor_ego_nominal(sensor.name)),
            view_deg=LIDAR_VIEW_DEG if sensor.kind == "lidar" else 2.0 * half_deg, state=sensor.state,
            probability=sensor.probability, moved_deg=sensor.moved_deg,
        )
        for sensor in told.sensors.values()
    ]  # fmt: skip
    ago_s = told.second - story.KNOCK_S
    title = f"{_the(act)} was turned by {act.knock_deg:.2g}°; {ago_s:.0f} s of driving later"
    return rig_from_above(seen, list(told.edges.values()), title)


def turns(heard: Sequence[Told]) -> list[Told]:
    """The first of what was said, and each that differs from the one before."""
    kept: list[Told] = []
    for told in heard:
        if not kept or _states(told) != _states(kept[-1]):
            kept.append(told)
    return kept


def summary(outcome: Outcome) -> str:
    """An act in a sentence."""
    act = outcome.act
    begun = f"{_the(act)} was turned by {act.knock_deg:.2g}° at {story.KNOCK_S:.0f} s of driving"
    if not outcome.passed:
        return f"{begun}. " + " ".join(outcome.objections())
    assert outcome.named_s is not None  # else it is an objection
    return f"{begun}, and named {outcome.named_s - story.KNOCK_S:.0f} s later, it alone."


def show(acts: Sequence[Performance], files: Sequence[Path]) -> None:
    """Prints the summary in the terminal."""
    for outcome, heard in acts:
        order = _order(outcome.act, heard[0])
        rows = console.table("drive", *order, "looked at", right=(0,))
        for told in turns(heard):
            rows.add_row(f"{told.second:.1f} s", *_cells(told, order), told.looked_at)
        console.out.print(rows)
        console.show(summary(outcome), "bold green" if outcome.passed else "bold red")
        console.out.print()
    for path in files:
        console.show(f"{path}  {path.stat().st_size} bytes")


def document(acts: Sequence[Performance], files: Sequence[Path], elapsed_s: float) -> dict[str, object]:
    """What `--json` prints."""
    return {
        "acts": [
            {
                "knocked": outcome.act.sensor,
                "knock_s": story.KNOCK_S,
                "knock_deg": outcome.act.knock_deg,
                "named_s": outcome.named_s,
                "wrong": list(outcome.wrong),
                "passed": outcome.passed,
                "objections": list(outcome.objections()),
                "told": [
                    {
                        "drive_s": told.second,
                        "looked_at": told.looked_at,
                        "sensors": [asdict(sensor) for sensor in told.sensors.values()],
                    }
                    for told in turns(heard)
                ],
            }
            for outcome, heard in acts
        ],
        "passed": all(outcome.passed for outcome, _ in acts),
        "elapsed_s": elapsed_s,
        "files": [str(path) for path in files],
    }


def page(pictures: Sequence[Path], acts: Sequence[Performance], made: Made) -> Page:
    """The page of all acts.

    Raises:
        OutputError: a picture can no longer be read.
    """
    sections = [
        Section(
            _heading(outcome.act),
            (
                Text((summary(outcome),)),
                Pictures((Picture(read(path), _alt(outcome, heard[-1]), PICTURED),)),
                _turns_told(outcome.act, heard),
                Text((BELIEVED,)),
                Text((heard[-1].sensors[outcome.act.sensor].reason,)),
            ),
        )
        for path, (outcome, heard) in zip(pictures, acts, strict=True)
    ]
    objections = [objection for outcome, _ in acts for objection in outcome.objections()]
    verdict = (
        Verdict("bad", "Not told.", " ".join(objections))
        if objections
        else Verdict("good", "Told apart.", "Both knocks were noticed, and whoever was knocked was named, nobody else.")
    )
    return Page("coec demo --rig", TITLE, (verdict, Text((ABOUT,))), (*sections, made.section()))


def _alt(outcome: Outcome, told: Told) -> str:
    states = ", ".join(f"{name} {state_words(sensor.state)}" for name, sensor in told.sensors.items())
    return f"The vehicle from above after {outcome.act.sensor} was turned: {states}"


def _heading(act: Act) -> str:
    return f"{_the(act)} is knocked"


def _the(act: Act) -> str:
    return f"The {'LiDAR' if act.sensor == story.LIDAR else 'camera'} {act.sensor}"


def _order(act: Act, told: Told) -> tuple[str, ...]:
    """Sensors, the knocked one first, so that it is visible on a narrow screen."""
    return (act.sensor, *(name for name in told.sensors if name != act.sensor))


def _turns_told(act: Act, heard: Sequence[Told]) -> Table:
    order = _order(act, heard[0])
    rows: list[Sequence[str | Cell]] = [
        (f"{told.second:.1f} s", *_toned(told, order), told.looked_at) for told in turns(heard)
    ]
    heads = ("Drive", *order, "Looked at")
    return Table("What was believed of every sensor, whenever that changed", heads, rows, frozenset({0}))


def _toned(told: Told, order: Sequence[str]) -> list[Cell]:
    states = [told.sensors[name].state for name in order]
    return [Cell(text, tone=TONES.get(state, "none")) for text, state in zip(_cells(told, order), states, strict=True)]


def _cells(told: Told, order: Sequence[str]) -> list[str]:
    seen = [told.sensors[name] for name in order]
    return [
        state_words(sensor.state) + ("" if sensor.probability < 0.005 else f", {percent(sensor.probability)}")
        for sensor in seen
    ]


def _states(told: Told) -> list[str]:
    return [sensor.state for sensor in told.sensors.values()]
