"""What a user can look at before the service has said anything: the first pair of the drive."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from coec.reports import page, pictures, provenance
from coec.reports.page import Page, Pictures, Section, Text, Verdict
from coec.reports.page_parts import file_picture
from coec.sources import windows
from coec_lab.demo import story

if TYPE_CHECKING:
    from coec.simulation.drive import SimulatedDrive

PICTURE = "first_picture"
"""Stem of the picture's file."""

ABOUT = (
    "A simulated vehicle drives, and the service of a real one listens to its camera and its LiDAR. Its mount will be "
    f"knocked by {story.KNOCK_DEG:g}° after {story.KNOCK_S:g} s. When the story is told, this page tells it: load it "
    "again then."
)


def write(output: Path, drive: SimulatedDrive) -> tuple[Path, Path]:
    """Writes the picture, and a page that stands in until there is a report. The pair that it shows is sent later.

    Raises:
        OutputError: a file cannot be written.
    """
    window = windows.chosen_from(drive, 1, lambda *_: None).window
    start = window.T_camera_lidar_start
    error_deg = windows.rotation_error_deg(start, drive.truth(window.pairs[0].stamp_ns))
    title = f"as the workshop calibrated it: {error_deg:.2f} deg from the truth"
    (drawn,) = pictures.overlays(window, (start,), compensated=True)
    picture = pictures.write_overlay(output, PICTURE, drawn, title)
    told = Page(
        "coec demo",
        story.TITLE,
        (Verdict("none", "Under way.", "The service has not said anything yet."), Text((ABOUT,))),
        (Section("What the vehicle sees", (Pictures((file_picture(picture),)),)), provenance.here().section()),
    )
    return picture, page.write(output / story.REPORT, told)
