"""What the demonstration of a rig leaves behind: the rig from above, act by act, and a page of what was told when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from html import escape
from pathlib import Path

from coec.adapters.files.output import write as write_file
from coec.cli.demo import html
from coec.cli.demo.rig import story
from coec.cli.demo.rig.outcome import Outcome
from coec.cli.demo.rig.story import Act
from coec.cli.demo.rig.told import Told
from coec.geometry.se3 import inverse
from coec.reports import console
from coec.reports.rig_plot import SensorSeen, rig_from_above
from coec.simulation.rig_drive import RigDrive

TITLE = "Who moved? A knocked LiDAR and a knocked camera"
LIDAR_VIEW_DEG = 360.0

Performance = tuple[Outcome, Sequence[Told]]
"""An act: what became of it, and all that was told."""


def write(output: Path, drive: RigDrive, acts: Sequence[Performance]) -> list[Path]:
    """All of it into the folder.

    Args:
        drive: as the vehicle was built.

    Raises:
        OutputError: a file cannot be written.
    """
    pictures = []
    for outcome, heard in acts:
        path = output / f"{outcome.act.name}_knocked.png"
        pictures.append(write_file(path, picture(drive, outcome.act, heard[-1])))
    document = page(pictures, acts)
    return [*pictures, write_file(output / "report.html", document.encode())]


def picture(drive: RigDrive, act: Act, told: Told) -> bytes:
    """PNG of the rig from above, as it is believed to be."""
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
    title = f"{act.sensor} was turned by {act.knock_deg:.2g}°; {ago_s:.0f} s of driving later"
    return rig_from_above(seen, list(told.edges.values()), title)


def turns(heard: Sequence[Told]) -> list[Told]:
    """Those at which something was told that had not been told just before, the first among them."""
    kept: list[Told] = []
    for told in heard:
        if not kept or _states(told) != _states(kept[-1]):
            kept.append(told)
    return kept


def summary(outcome: Outcome) -> str:
    """An act in a sentence."""
    act = outcome.act
    begun = f"{act.sensor} was turned by {act.knock_deg:.2g}° at {story.KNOCK_S:.0f} s of driving"
    if not outcome.passed:
        return f"{begun}. " + " ".join(outcome.objections())
    assert outcome.named_s is not None  # else it is an objection
    return f"{begun}, and named {outcome.named_s - story.KNOCK_S:.0f} s later, it alone."


def show(acts: Sequence[Performance], files: Sequence[Path]) -> None:
    """The summary in the terminal."""
    for outcome, heard in acts:
        rows = console.table("drive", "looked at", *heard[0].sensors, right=(0,))
        for told in turns(heard):
            rows.add_row(f"{told.second:.1f} s", told.looked_at, *_cells(told))
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


def page(pictures: Sequence[Path], acts: Sequence[Performance]) -> str:
    """One HTML file that needs no other."""
    parts = [
        html.head(TITLE),
        "<p>Four fisheyes look at what one LiDAR measures, and each of the four pairs is looked at every five seconds. "
        "A camera that is knocked puts its own pair wrong; a LiDAR that is knocked puts all pairs wrong, and alike. "
        "Which sensor explains all looks with the fewest moves is asked after each of them. Vehicle and street are "
        f"simulated, with pictures of {story.CAMERA_PX} pixels a side, of which those rows are drawn that the LiDAR "
        "sees; what looks and tells is the service, a process of its own behind a router, as on a vehicle.",
    ]
    for path, (outcome, heard) in zip(pictures, acts, strict=True):
        parts += [
            f"<h2>{escape(_heading(outcome.act))}</h2><p><b>{escape(summary(outcome))}</b>",
            html.figure(path, "From above. The redder a line, the surer its pair that something has moved."),
            html.table(("drive", "looked at", *heard[0].sensors), _rows(heard), numbers=(0,)),
            f"<p>{escape(heard[-1].sensors[outcome.act.sensor].reason)}",
        ]
    return "\n".join(parts) + "\n"


def _heading(act: Act) -> str:
    return "The LiDAR is knocked" if act.sensor == story.LIDAR else f"The camera {act.sensor} is knocked"


def _rows(heard: Sequence[Told]) -> list[tuple[str, ...]]:
    return [
        (f"{told.second:.1f} s", escape(told.looked_at), *(escape(cell) for cell in _cells(told)))
        for told in turns(heard)
    ]


def _cells(told: Told) -> list[str]:
    return [
        sensor.state.replace("_", " ") + ("" if sensor.probability < 0.005 else f" {100.0 * sensor.probability:.0f} %")
        for sensor in told.sensors.values()
    ]


def _states(told: Told) -> list[str]:
    return [sensor.state for sensor in told.sensors.values()]
