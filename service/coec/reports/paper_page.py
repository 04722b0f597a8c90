"""The page of `coec paper`: the published experiments on a recording, with the published figures beside ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from coec.evaluation import paper_published
from coec.reports.page import Block, Page, Section, Table, Text, VerdictBanner
from coec.reports.page.words import NONE, number, percent
from coec.reports.provenance import Provenance

PUBLISHED = (
    "Published: Borer, Tschirner, Ölsner and Milz, CVPR-W 2023, on KITTI-360 drive 0000, raw fisheye, with "
    "`dpt_beit_large_512`; run times on a 12-core Jetson Orin. Another recording, network or machine gives other "
    "figures."
)


@dataclass(frozen=True, slots=True)
class Plots:
    """Plots of the failure metrics, of the far starts, and of the drive."""

    metrics: Block
    bullseye: Block
    drive: Block


def paper_page(document: Mapping[str, Any], plots: Plots, made: Provenance) -> Page:
    """The page of a `document` as `coec paper --json` prints it."""
    far = document["bullseye"]
    sentence = (
        f"From {far['start_deg']:g}° away {far['hits']} of {far['runs']} runs come home (published: "
        f"{paper_published.FAR_HITS} of {paper_published.FAR_RUNS}), and {percent(far['classified_correctly'], 0)} "
        "of them are classified correctly (published: all)."
    )
    sections = (
        Section(
            "Wrong extrinsics flagged by equation (2)",
            (_moves(document["failure_metrics"]["moves"]), plots.metrics),
        ),
        Section("Solves", (_solves(document), plots.bullseye, plots.drive)),
        Section("Run times", (_times(document["run_times"]),)),
        made.section(
            (("Source", document["source"]), ("Objective", document["objective"]), ("Pairs", str(document["pairs"])))
        ),
    )
    opening = (VerdictBanner("none", "Repeated.", sentence), Text((PUBLISHED,), quiet=True))
    return Page("coec paper", "The published experiments, repeated", opening, sections)


def _moves(moves: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        (
            f"{row['moved_deg']:g}°",
            str(row["checks"]),
            percent(row["flagged"]),
            percent(paper_published.FLAGGED.get(row["moved_deg"])),
        )
        for row in moves
    ]
    heads = ("Extrinsic off by", "Checks", "Flagged", "Published")
    caption = "Limits are learned on every second pair and tried on the others; at 0° what is flagged are false alarms."
    return Table(caption, heads, rows, frozenset(range(4)))


def _solves(document: Mapping[str, Any]) -> Table:
    rows: list[tuple[str, ...]] = []
    for name, row in (("All pairs", document["bullseye"]), *(("Windows", row) for row in document["drive"])):
        ours = [_spread(*axis) for axis in zip(row["mean_deg"], row["std_deg"], strict=True)]
        right = percent(row["classified_correctly"], 0)
        rows.append((f"{name}, from {row['start_deg']:g}°", str(row["runs"]), str(row["hits"]), right, *ours))
        axes = paper_published.ERRORS_DEG.get(row["start_deg"])
        if axes is not None:
            rows.append(("published", "1400", NONE, NONE, *(_spread(*axis) for axis in axes)))
        else:
            far = (str(paper_published.FAR_RUNS), str(paper_published.FAR_HITS), percent(1.0, 0))
            rows.append(("published", *far, NONE, NONE, NONE))
    heads = ("Solves", "Runs", "Hits", "Classified correctly", "Pitch, °", "Yaw, °", "Roll, °")
    return Table("Mean and standard deviation of the error of all runs", heads, rows, frozenset(range(1, 7)))


def _times(times: Sequence[Mapping[str, Any]]) -> Table:
    rows = []
    for row in times:
        mi_ms, solve_ms = paper_published.RUN_TIMES_MS.get(row["frames"], (None, None))
        ours = number(row["mi_ms"], 2), number(row["solve_ms"], 0)
        rows.append((str(row["frames"]), ours[0], number(mi_ms, 1), ours[1], number(solve_ms, 0)))
    heads = ("Frames", "One MI, ms", "Published", "One solve, ms", "Published")
    return Table("Depth is computed before", heads, rows, frozenset(range(5)))


def _spread(mean_deg: float, std_deg: float) -> str:
    return f"{number(mean_deg, sign=True)} ± {number(std_deg)}"
