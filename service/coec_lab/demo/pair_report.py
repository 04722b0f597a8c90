"""Files of the demonstration with one camera: a page from the first picture on, then pictures, the window that
corrected the mount, and a page of what was displaced and what the service reported."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.types import Matrix4, Window
from coec.config import LimitsConfig
from coec.geometry import cameras
from coec.io.exported_extrinsic import REFUSED
from coec.io.images import decode_bgr
from coec.io.mcap.windows import read_result, read_window
from coec.io.recordings import window_cutting
from coec.io.user_files import write_output as write_file
from coec.reports import console, page, pictures
from coec.reports.charts import Chart, Ground, Limit, Mark, Series
from coec.reports.drawing import render_points as draw_overlay
from coec.reports.formatting import count
from coec.reports.page import Block, Cell, Charts, Compare, Facts, Page, Pictures, Section, Table, Text, VerdictBanner
from coec.reports.page_parts import TONES, Provenance, copies_of, figures_block, file_picture
from coec.schemas import replies
from coec.schemas.message import to_json
from coec_lab.demo import pair_client
from coec_lab.demo.pair_client import ALARM, Moment, Observer, PairOutcome, Snapshot, is_repaired
from coec_lab.experiments.plots import charts

if TYPE_CHECKING:
    from coec_lab.simulation.drive import SimulatedDrive

PICTURE = "first_picture"
"""Stem of the picture's file."""

FIRST_ABOUT = (
    "A simulated vehicle drives, and the service of a real one receives its camera and its LiDAR. Its mount will be "
    f"displaced by {pair_client.KNOCK_DEG:g}° after {pair_client.KNOCK_S:g} s. When the demonstration "
    "ends, this page shows its result: load it again then."
)

ABOUT = (
    "The vehicle, its street and its sensors are simulated, so the truth is known; the service is the one that runs on "
    "a vehicle, in a process of its own, and has seen the frames alone. Its depth network is the one that comes with "
    "it, trained on other streets of the same simulation."
)

Sample = tuple[float, float, str]
"""Second of the drive, error in degrees, state of health."""


@dataclass(frozen=True, slots=True)
class WrittenFiles:
    """Files that were written, and the result of the window that corrected the mount (None: there is none)."""

    files: tuple[Path, ...]
    result: replies.CalibrationResult | None


def write_first(output: Path, drive: SimulatedDrive) -> tuple[Path, Path]:
    """Writes the picture, and a page that stands in until there is a report. The pair that it shows is sent later.

    Raises:
        OutputError: a file cannot be written.
    """
    window = window_cutting.window_of_recording(drive, 1, lambda *_: None).window
    start = window.T_camera_lidar_start
    error_deg = window_cutting.rotation_error_deg(start, drive.truth(window.pairs[0].stamp_ns))
    title = f"as the workshop calibrated it: {error_deg:.2f} deg from the truth"
    (overlay,) = pictures.overlays(window, (start,), compensated=True)
    picture = pictures.write_overlay(output, PICTURE, overlay, title)
    stand_in = Page(
        "coec demo",
        pair_client.TITLE,
        (VerdictBanner("none", "Under way.", "The service has not reported anything yet."), Text((FIRST_ABOUT,))),
        (Section("What the vehicle sees", (Pictures((file_picture(picture),)),)), Provenance.here().section()),
    )
    return picture, page.write(output / pair_client.REPORT, stand_in)


def write(
    output: Path,
    first: Path,
    window: Path | None,
    accused: Matrix4,
    observer: Observer,
    snapshot: Snapshot,
    outcome: PairOutcome,
) -> WrittenFiles:
    """Writes all files into the folder.

    Args:
        first: the picture from before the drive, which is there already.
        window: the recorded window, which is there already; None without one.
        accused: (4, 4) what was served when the alarm was raised.

    Raises:
        OutputError: a file cannot be written.
    """
    written = [first] if window is None else [first, window]
    curve = Charts((error_curve(observer.series, outcome),))
    written.append(write_file(output / "timeline.png", charts(curve, pair_client.TITLE, 1, (11.0, 4.6))))
    result, compared = None, None
    if window is not None:
        result = read_result(window)
        overlays, compared = _overlays(output, window, accused, observer, snapshot)
        written += overlays
    if result is not None:
        written.append(write_file(output / "result.json", to_json(result)))
    happened = list(zip(observer.timeline, _happenings(observer.timeline, outcome), strict=True))
    summary = _summary(outcome, observer.timeline)
    document = demo_page(
        pair_client.TITLE, observer.series, happened, summary, outcome, result, compared, window, Provenance.here()
    )
    written.append(page.write(output / pair_client.REPORT, document))
    return WrittenFiles(tuple(written), result)


def show(moments: Sequence[Moment], outcome: PairOutcome, left: WrittenFiles) -> None:
    """Prints the summary in the terminal."""
    console.show_block(_timeline_table(list(zip(moments, _happenings(moments, outcome), strict=True))))
    console.out.print()
    console.show_block(Facts(tuple(_summary(outcome, moments))))
    console.out.print()
    for path in left.files:
        console.show(f"{path}  {path.stat().st_size} bytes")
    for failure in outcome.failures():
        console.show(failure, "bold red")
    if outcome.passed:
        console.out.print(
            console.styled("accepted"), ": the displacement was detected and corrected by the service", sep=""
        )


def _overlays(
    output: Path, path: Path, accused: Matrix4, observer: Observer, snapshot: Snapshot
) -> tuple[list[Path], Compare]:
    """Writes overlays and close-ups; returns the files, and the close-ups for a slider."""
    window, configuration = read_window(path)
    truth = observer.truth(snapshot.moment.drive_s)
    before_deg = window_cutting.rotation_error_deg(accused, truth)
    poses = (accused, snapshot.T_camera_lidar)
    titles = (
        f"After the displacement: what was served is {before_deg:.2f}° from the truth",
        f"After the correction: what is served is {snapshot.moment.error_deg:.2f}° from the truth",
    )
    compensated = configuration.motion_compensation
    cloud = compensate(pictures.middle(window), window.rig, enabled=compensated)
    before, after = (_close_up(window, cloud, T_camera_lidar) for T_camera_lidar in poses)
    by_kind = {"overlay": pictures.overlays(window, poses, compensated), "closeup": [before, after]}
    written = [
        pictures.write_overlay(output, f"{kind}_{side}", picture, title)
        for kind, both in by_kind.items()
        for side, picture, title in zip(("before", "after"), both, titles, strict=True)
    ]
    return written, pictures.slid_pictures((before, after), (f"{titles[0]}.", f"{titles[1]}."))


def _close_up(window: Window, xyz_m: NDArray[np.floating], T_camera_lidar: Matrix4) -> NDArray[np.uint8]:
    """(height, width, 3) BGR: the part of the picture that shows the street, with the points (N, 3) of the sweep."""
    pair, rig = pictures.middle(window), window.rig
    left, top, width, height = pair_client.CLOSE_UP_PX
    part = slice(top, top + height), slice(left, left + width)
    intrinsics = cameras.intrinsics_of(rig.camera)
    moved = {"cx": intrinsics["cx"] - left, "cy": intrinsics["cy"] - top, "width": width, "height": height}
    camera = cameras.build(cameras.name_of(rig.camera), **{**intrinsics, **moved})
    image = np.ascontiguousarray(decode_bgr(pair.camera.image, LimitsConfig())[part])
    mask = None if rig.mask is None else np.ascontiguousarray(rig.mask[part])
    return draw_overlay(image, camera, T_camera_lidar, xyz_m, mask)


def _happenings(moments: Sequence[Moment], outcome: PairOutcome) -> list[str]:
    """A note for each moment, empty for some."""
    firsts: tuple[tuple[str, Callable[[Moment], bool]], ...] = (
        ("the service starts", lambda moment: moment.service == "starting"),
        ("the drive begins", lambda moment: moment.service == "running"),
        ("the first window", lambda moment: moment.provenance == "estimated"),
        ("displaced", lambda moment: moment.drive_s >= outcome.knock_s),
        ("alarm", lambda moment: moment.drive_s == outcome.alarm_s and moment.health == ALARM),
        (
            "corrected",
            lambda moment: moment.drive_s == outcome.repaired_s and is_repaired(moment, pair_client.MAX_ERROR_DEG),
        ),
    )
    notes = [""] * len(moments)
    for note, is_so in firsts:
        first = next((index for index, moment in enumerate(moments) if is_so(moment)), None)
        if first is not None:
            notes[first] = note
    return notes


def _summary(outcome: PairOutcome, moments: Sequence[Moment]) -> list[tuple[str, str]]:
    last = moments[-1]
    early = [moment for moment in moments if moment.drive_s < outcome.knock_s and moment.provenance == "estimated"]

    def after_knock(second: float | None) -> str:
        return "never" if second is None else f"{second - outcome.knock_s:.0f} s after it"

    axes = "  ".join(f"{value:+.3f}°" for value in last.error_by_axis_deg)
    return [
        ("error of the workshop's calibration", f"{moments[0].error_deg:.3f}°"),
        ("error after the first window", f"{early[0].error_deg:.3f}°" if early else "no window was accepted"),
        ("displacement", f"{pair_client.KNOCK_DEG:g}° in pitch at {outcome.knock_s:.0f} s of driving"),
        ("alarm", after_knock(outcome.alarm_s)),
        ("correction", after_knock(outcome.repaired_s)),
        ("error after the displacement", f"{outcome.error_before_deg:.3f}°"),
        ("error after the correction", f"{outcome.error_after_deg:.3f}°"),
        ("in pitch, yaw, roll", axes),
    ]


def demo_page(
    title: str,
    series: Sequence[Sample],
    happened: Sequence[tuple[Moment, str]],
    summary: Sequence[tuple[str, str]],
    outcome: PairOutcome,
    result: replies.CalibrationResult | None,
    compared: Compare | None,
    window: Path | None,
    made: Provenance,
) -> Page:
    """The page.

    Args:
        series: everything that was seen, in order of time.
        happened: the moments at which something changed, each with a note that may be empty.
        summary: names and values.
        result: of the window that corrected the mount; None: there is none.
        compared: points on the image before and after the correction; None: they were not rendered.
        window: the recorded window that corrected the mount; None: there is none.
    """
    sections = [Section("Error and health over the drive", (Charts((error_curve(series, outcome),)),))]
    if compared is not None:
        sections.append(Section("Points on the image", (compared,)))
    sections.append(Section("What the service reported", (_timeline_table(happened),)))
    if result is not None:
        sections.append(Section("The window that corrected it", _repair(result, window)))
    verdict = (
        VerdictBanner("good", "Corrected.", "The displacement was detected and corrected.")
        if outcome.passed
        else VerdictBanner("bad", "Not corrected.", " ".join(outcome.failures()))
    )
    opening = (verdict, Text((ABOUT,)), Facts(tuple(summary)))
    return Page("coec demo", title, opening, (*sections, made.section()))


def error_curve(series: Sequence[Sample], outcome: PairOutcome) -> Chart:
    """The error of what is served, over the states of health and between the displacement, alarm and correction."""
    ends = [second for second, *_ in series[1:]] + [series[-1][0]]
    spans_of = [(second, end, state) for (second, _, state), end in zip(series, ends, strict=True)]
    grounds = []
    for state, of_state in groupby(spans_of, key=lambda each: each[2]):
        spans = list(of_state)
        grounds.append(Ground(spans[0][0], spans[-1][1], TONES.get(state, "none"), state))
    marks = ((outcome.knock_s, "displacement"), (outcome.alarm_s, "alarm"), (outcome.repaired_s, "correction"))
    worst_deg = max(error_deg for _, error_deg, _ in series)
    return Chart(
        title="Error of the extrinsic that is served, which the service cannot know",
        x_label="drive, s",
        y_label="rotation error, °",
        series=(Series("error against the truth", list(_turns(series)), "steps"),),
        description=f"the error is {worst_deg:.2f}° at most and {series[-1][1]:.2f}° at the end",
        grounds=tuple(grounds),
        marks=tuple(Mark(second, f"{name}, {second:.0f} s") for second, name in marks if second is not None),
        limits=(Limit(pair_client.MAX_ERROR_DEG, f"{pair_client.MAX_ERROR_DEG:g}°: a good error"),),
        from_zero=True,
    )


def _turns(series: Sequence[Sample]) -> Iterator[tuple[float, float]]:
    """The points at which the error changes, and the last point."""
    before: float | None = None
    for second, error_deg, _ in series:
        if error_deg != before:
            yield second, error_deg
        before = error_deg
    yield series[-1][0], series[-1][1]


def _timeline_table(happened: Sequence[tuple[Moment, str]]) -> Table:
    rows = [
        (
            f"{moment.t_s:.0f} s",
            f"{moment.drive_s:.1f} s",
            Cell(moment.health, tone=TONES.get(moment.health, "none")),
            f"{moment.provenance}, {console.attempt(moment.status)}",
            f"{moment.error_deg:.3f}°",
            note,
        )
        for moment, note in happened
    ]
    heads = ("Elapsed", "Drive", "Health", "Extrinsic", "Error", "What happened")
    return Table("Every change that it reported", heads, rows, frozenset({0, 1, 4}))


def _repair(result: replies.CalibrationResult, window: Path | None) -> tuple[Block, ...]:
    text = (
        f"{count(result.pairs, 'pair')}, verdict {result.verdict.decision}, configuration {result.config_hash}. The "
        "figures are of its self-diagnosis, without the truth; a result is accepted if it is within all limits."
    )
    links = () if window is None else (_window(window),)
    warning = "" if result.verdict.decision == "accepted" else REFUSED
    copies = copies_of(result.camera_from_lidar, result.camera_frame, result.lidar_frame, warning=warning)
    return Text((text,)), figures_block("Figures of self-diagnosis", result.metrics), copies, *links


def _window(path: Path) -> Text:
    return Text(
        (
            f"`{path.name}` next to this page is a ROS 2 MCAP file for Foxglove, Lichtblick or Rerun; "
            f"`coec replay {path.name}` reaches the decision again from it alone.",
        )
    )
