"""Files of the demonstration: pictures, the window that repaired the mount, and a page that shows them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coec.adapters.files.output import write as write_file
from coec.adapters.images.codec import decode_bgr
from coec.adapters.mcap.windows import read_result, read_window
from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.types import Matrix4, Window
from coec.config import LimitsConfig
from coec.geometry import cameras
from coec.reports import console, page, pictures, provenance
from coec.reports.overlay import draw
from coec.reports.page import Compare
from coec.reports.timeline_plot import timeline
from coec.schemas import replies
from coec.schemas.base import to_json
from coec.sources import windows
from coec_lab.demo import story
from coec_lab.demo.outcome import Ending, is_repaired
from coec_lab.demo.page import demo_page
from coec_lab.demo.watch import ALARM, Moment, Seen, Watch


@dataclass(frozen=True, slots=True)
class Left:
    """Files that were written, and the result of the window that repaired the mount (None: there is none)."""

    files: tuple[Path, ...]
    result: replies.CalibrationResult | None


def write(
    output: Path, first: Path, window: Path | None, blamed: Matrix4, watch: Watch, seen: Seen, outcome: Ending
) -> Left:
    """Writes all files into the folder.

    Args:
        first: the picture from before the drive, which is there already.
        window: the recorded window, which is there already; None without one.
        blamed: (4, 4) what was served when the alarm was raised.

    Raises:
        OutputError: a file cannot be written.
    """
    written = [first] if window is None else [first, window]
    plot = write_file(
        output / "timeline.png", timeline(watch.series, _marks(outcome), story.MAX_ERROR_DEG, story.TITLE)
    )
    written.append(plot)
    result, compared = None, None
    if window is not None:
        result = read_result(window)
        overlays, compared = _overlays(output, window, blamed, watch, seen)
        written += overlays
    if result is not None:
        written.append(write_file(output / "result.json", to_json(result)))
    happened = list(zip(watch.timeline, _happenings(watch.timeline, outcome), strict=True))
    summary = _summary(outcome, watch.timeline)
    told = demo_page(story.TITLE, watch.series, happened, summary, outcome, result, compared, window, provenance.here())
    written.append(page.write(output / story.REPORT, told))
    return Left(tuple(written), result)


def show(moments: Sequence[Moment], outcome: Ending, left: Left) -> None:
    """Prints the summary in the terminal."""
    steps = console.table("elapsed", "drive", "health", "extrinsic", "error", "", right=(0, 1, 4))
    for moment, what in zip(moments, _happenings(moments, outcome), strict=True):
        times = (f"{moment.t_s:.0f} s", f"{moment.drive_s:.1f} s")
        served = f"{moment.provenance}, {console.attempt(moment.status)}"
        steps.add_row(*times, console.styled(moment.health), served, f"{moment.error_deg:.3f}°", what)
    console.out.print(steps)
    console.out.print()
    summary = console.table("", "", right=(1,))
    for name, value in _summary(outcome, moments):
        summary.add_row(name, value)
    console.out.print(summary)
    console.out.print()
    for path in left.files:
        console.show(f"{path}  {path.stat().st_size} bytes")
    for objection in outcome.objections():
        console.show(objection, "bold red")
    if outcome.passed:
        console.out.print(console.styled("accepted"), ": the knock was noticed and repaired by the service", sep="")


def _overlays(output: Path, path: Path, blamed: Matrix4, watch: Watch, seen: Seen) -> tuple[list[Path], Compare]:
    """Writes overlays and close-ups; returns the files, and the close-ups for a slider."""
    window, configuration = read_window(path)
    truth = watch.truth(seen.moment.drive_s)
    before_deg = windows.rotation_error_deg(blamed, truth)
    poses = (blamed, seen.T_camera_lidar)
    titles = (
        f"After the knock: what was served is {before_deg:.2f}° from the truth",
        f"After the repair: what is served is {seen.moment.error_deg:.2f}° from the truth",
    )
    compensated = configuration.motion_compensation
    cloud = compensate(pictures.middle(window), window.rig, enabled=compensated)
    before, after = (_close_up(window, cloud, T_camera_lidar) for T_camera_lidar in poses)
    drawn = {"overlay": pictures.overlays(window, poses, compensated), "closeup": [before, after]}
    written = [
        pictures.write_overlay(output, f"{kind}_{side}", picture, title)
        for kind, both in drawn.items()
        for side, picture, title in zip(("before", "after"), both, titles, strict=True)
    ]
    return written, pictures.slid_pictures((before, after), (f"{titles[0]}.", f"{titles[1]}."))


def _close_up(window: Window, xyz_m: NDArray[np.floating], T_camera_lidar: Matrix4) -> NDArray[np.uint8]:
    """(height, width, 3) BGR: the part of the picture that shows the street, with the points (N, 3) of the sweep."""
    pair, rig = pictures.middle(window), window.rig
    left, top, width, height = story.CLOSE_UP_PX
    part = slice(top, top + height), slice(left, left + width)
    intrinsics = cameras.intrinsics_of(rig.camera)
    moved = {"cx": intrinsics["cx"] - left, "cy": intrinsics["cy"] - top, "width": width, "height": height}
    camera = cameras.build(cameras.name_of(rig.camera), **{**intrinsics, **moved})
    image = np.ascontiguousarray(decode_bgr(pair.camera.image, LimitsConfig())[part])
    mask = None if rig.mask is None else np.ascontiguousarray(rig.mask[part])
    return draw(image, camera, T_camera_lidar, xyz_m, mask)


def _marks(outcome: Ending) -> list[tuple[float, str]]:
    named = ((outcome.knock_s, "knock"), (outcome.alarm_s, "alarm"), (outcome.repaired_s, "repair"))
    return [(second, what) for second, what in named if second is not None]


def _happenings(moments: Sequence[Moment], outcome: Ending) -> list[str]:
    """A remark for each moment, empty for some."""
    firsts: tuple[tuple[str, Callable[[Moment], bool]], ...] = (
        ("the service starts", lambda moment: moment.service == "starting"),
        ("the drive begins", lambda moment: moment.service == "running"),
        ("the first window", lambda moment: moment.provenance == "estimated"),
        ("knocked", lambda moment: moment.drive_s >= outcome.knock_s),
        ("alarm", lambda moment: moment.drive_s == outcome.alarm_s and moment.health == ALARM),
        ("repaired", lambda moment: moment.drive_s == outcome.repaired_s and is_repaired(moment, story.MAX_ERROR_DEG)),
    )
    remarks = [""] * len(moments)
    for remark, is_so in firsts:
        first = next((index for index, moment in enumerate(moments) if is_so(moment)), None)
        if first is not None:
            remarks[first] = remark
    return remarks


def _summary(outcome: Ending, moments: Sequence[Moment]) -> list[tuple[str, str]]:
    last = moments[-1]
    early = [moment for moment in moments if moment.drive_s < outcome.knock_s and moment.provenance == "estimated"]

    def after_knock(second: float | None) -> str:
        return "never" if second is None else f"{second - outcome.knock_s:.0f} s after it"

    axes = "  ".join(f"{value:+.3f}°" for value in last.error_by_axis_deg)
    return [
        ("error of the workshop's calibration", f"{moments[0].error_deg:.3f}°"),
        ("error after the first window", f"{early[0].error_deg:.3f}°" if early else "no window was accepted"),
        ("knock", f"{story.KNOCK_DEG:g}° in pitch at {outcome.knock_s:.0f} s of driving"),
        ("alarm", after_knock(outcome.alarm_s)),
        ("repair", after_knock(outcome.repaired_s)),
        ("error after the knock", f"{outcome.error_before_deg:.3f}°"),
        ("error after the repair", f"{outcome.error_after_deg:.3f}°"),
        ("in pitch, yaw, roll", axes),
    ]
