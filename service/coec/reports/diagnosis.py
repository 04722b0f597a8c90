"""What the commands on checks report, on the console and as a page: `coec diagnose` of one check, what is wrong, by how
much, what it cannot decide, and what to do; `coec commission` how the estimator behaves on each pair of a vehicle, and
the limits that follow.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import degrees, isfinite
from pathlib import Path

import numpy as np

from coec.calibration.baseline import Baseline
from coec.calibration.figures import FIGURES
from coec.calibration.monitor.change_detector import Observation
from coec.calibration.types import Reason as Found
from coec.calibration.types import Window
from coec.config import VerdictConfig
from coec.io.rig_files import baseline_hash
from coec.io.serialise import metric_of
from coec.reports import console, page_parts
from coec.reports.formatting import NONE, count, number, percent, second, significant
from coec.reports.page import Block, Cell, Facts, Page, Pictures, Section, Table, Text, VerdictBanner
from coec.reports.page_parts import Provenance, axes_table, finite_degrees
from coec.schemas.replies import Reason

TELLING = 2.0
"""Standard deviations from which an axis is named as off: chance alone reaches this on one axis in twenty."""

SEEN = 3.0
"""A check would not notice a move of the mount by fewer than so many of its standard deviations."""

EXACT_DEG = 0.1
"""A rotation whose standard deviation is smaller is shown to a hundredth of a degree."""

NAMES = ("pitch", "yaw", "roll", "right", "down", "forward")
"""Names of turns about, and shifts along, the axes of the camera."""


@dataclass(frozen=True, slots=True)
class SolvedOffset:
    """The result of a solve of all pairs, relative to the pose that was asked about.

    Attributes:
        offset, sigma: (6,) degrees and metres; σ is None on axes that were not solved.
        accepted: whether its own figures of self-diagnosis let it pass, however large its σ.
        reasons: why not, one sentence each.
        pairs: how many it used.
    """

    offset: tuple[float, ...]
    sigma: tuple[float | None, ...]
    accepted: bool
    reasons: tuple[str, ...]
    pairs: int


@dataclass(frozen=True, slots=True)
class ExtrinsicFinding:
    """`state`: right, moved, unclear, or bad_data. `sentence` says what was found; `remarks` say what it rests on, what
    it leaves open, and what to do."""

    state: str
    sentence: str
    remarks: tuple[str, ...]


STYLES = {"right": "bold green", "moved": "bold red", "unclear": "bold yellow", "bad_data": "bold red"}


def finding_of(
    seen: Observation, offset: Sequence[float], sigma: Sequence[float], measured: SolvedOffset | None = None
) -> ExtrinsicFinding:
    """The finding of one check. `offset` (6,) leads from the pose that was asked about to where the edges fit; `sigma`
    are its standard deviations, degrees and metres. A check knows how far a pose is off only if that is little, so for
    a flagged pose the result that a solve has `measured` comes first."""
    if seen.causes:
        texts = tuple(f"{cause.code}: {cause.text}" for cause in seen.causes)
        advice = tuple(dict.fromkeys(cause.advice for cause in seen.causes))
        then = "Then ask again: with such data no check tells whether the mount has moved."
        return ExtrinsicFinding("bad_data", "the data is wrong, not necessarily the mount", (*texts, *advice, then))
    least = max(SEEN * value for value in sigma[:3])
    faint = ("The edges are faint: in the service this check would count for little.",) if seen.weak else ()
    if seen.flagged:
        sentence, how = _how_far(offset, sigma, measured)
        return ExtrinsicFinding(
            "moved",
            sentence,
            (
                *faint,
                *how,
                "Of one pair it cannot be told whether the camera or the LiDAR moved: look at both mounts, then "
                "calibrate, and serve what is accepted.",
            ),
        )
    if seen.undecided:
        return ExtrinsicFinding(
            "unclear",
            f"cannot tell: the edges fit best at {moved_text(offset, sigma)}, but hardly worse where they are",
            (*faint, "Take a longer recording, in motion, with poles and corners in view, or run `coec calibrate`."),
        )
    return ExtrinsicFinding(
        "right",
        "the extrinsic is right, as far as one check tells",
        (*faint, f"A mount that moved by less than {least:.2f}° about any axis would not be seen in it."),
    )


def moved_text(offset: Sequence[float], sigma: Sequence[float], *, with_sigma: bool = True) -> str:
    """The axes that are off by more than chance, farthest first; if none is, the farthest alone. Axes without a σ are
    left out."""
    ratios = [
        (abs(value) / spread, axis)
        for axis, (value, spread) in enumerate(zip(offset, sigma, strict=True))
        if spread > 0.0
    ]
    far = sorted((distance, axis) for distance, axis in ratios if distance >= TELLING) or [max(ratios)]
    return ", ".join(_axis_text(axis, offset[axis], sigma[axis], with_sigma) for _, axis in reversed(far))


def _how_far(
    offset: Sequence[float], sigma: Sequence[float], measured: SolvedOffset | None
) -> tuple[str, tuple[str, ...]]:
    """For a mount that moved: the sentence, and what its figures rest on."""
    if measured is None:
        return f"mount moved: {moved_text(offset, sigma)}", (NEAREST,)
    if not measured.accepted:
        why = measured.reasons[0] if measured.reasons else "no reason was given"
        near = moved_text(offset, sigma, with_sigma=False)
        return f"mount moved, by how much is not sure: the nearest place at which the edges fit is {near}", (
            f"A solve of all {measured.pairs} pairs is refused: {why}.",
            "Take a longer recording, in motion, and run `coec calibrate`.",
        )
    solved = [axis for axis, spread in enumerate(measured.sigma) if spread is not None]
    spread = [value or 0.0 for value in measured.sigma]
    how = [f"Measured by a solve of all {measured.pairs} pairs; `coec calibrate` says whether it may be served."]
    if len(solved) < len(spread):
        how.append(
            "Only turns were searched: ± holds what a shift of the camera, too small for a check to see, would add."
        )
    how.append(
        "It is counted from the extrinsic that was asked about: what that was off before the mount moved is in it."
    )
    return f"mount moved: {moved_text(measured.offset, spread)}", tuple(how)


NEAREST = (
    "That is the nearest place at which the edges fit: `coec calibrate` measures it, from far away too, and says how "
    "sure it is."
)


def show(finding: ExtrinsicFinding) -> None:
    """Prints the sentence in the colour of its state, with the remarks below."""
    console.show(finding.sentence, STYLES[finding.state])
    for note in finding.remarks:
        console.show(f"  {note}")


def _axis_text(axis: int, value: float, spread: float, with_sigma: bool) -> str:
    digits, unit = (1 if spread >= EXACT_DEG else 2, "°") if axis < 3 else (2, " m")
    text = f"{NAMES[axis]} {_signed(value, digits)}{unit}"
    return f"{text} ± {spread:.2f}{unit}" if with_sigma else text


def _signed(value: float, digits: int) -> str:
    return f"{value:+.{digits}f}".replace("-", "−")


DISTANCES = frozenset({"distance_rotation", "distance_pose"})
INSISTING = frozenset({"edges_kept_rotation", "edges_kept_pose", "certainty_rotation", "certainty_pose"})
"""Figures of a check that decide: how far off its optima are; and for those that are off, whether the edges insist."""


def deciding(seen: Observation) -> frozenset[str]:
    """Names of the figures on which the finding of a check rests. A right extrinsic is near both optima; a wrong one is
    far from an optimum on which the edges insist; wrong data say nothing of it."""
    if seen.causes:
        return frozenset()
    faint = {"edges_per_pair"} if seen.weak else set()
    if not (seen.flagged or seen.undecided):
        return DISTANCES | faint
    return DISTANCES | faint | {m.name for m in seen.metrics if m.name in INSISTING and not m.passed}


def check_page(
    seen: Observation,
    measured: SolvedOffset | None,
    window: Window,
    depth_identity: str,
    config_hash: str,
    pictures: Sequence[Path],
    made: page_parts.Provenance,
) -> Page:
    """The page of one check.

    Args:
        measured: by a solve of all pairs; None: there was none.
        window: its `T_camera_lidar_start` was checked.
        pictures: files that show the check.

    Raises:
        OutputError: a picture can no longer be read.
    """
    offset, sigma = page_parts.finite_degrees(seen.offset), page_parts.finite_degrees(seen.sigma)
    slopes = {
        "f′": [number(float(value), sign=True) for value in seen.first_derivative],
        "f″": [number(float(value), sign=True) for value in seen.second_derivative],
    }
    table = page_parts.axes_table(
        "From the extrinsic to where this check puts the camera, about and along its axes (x right, y down, z "
        "forward). f′ and f″, the paper’s derivatives of mutual information per radian or metre, decide nothing.",
        "Offset",
        offset,
        sigma,
        more=slopes if measured is None else {"By a solve of all pairs": _by_axis(measured), **slopes},
    )
    table = replace(table, quiet=frozenset(slopes))
    shown = tuple(page_parts.file_picture(path) for path in pictures)
    sections = (
        *((Section("Pictures", (Pictures(shown),)),) if shown else ()),
        Section("Where the check puts the camera", (table,)),
        Section(
            "What it rests on",
            (
                Text(
                    ("One check is a look, not a verdict for good: the service adds many of them up before it raises "
                     "an alarm.",),
                    quiet=True,
                ),
                page_parts.figures_block(
                    "Figures of the check; grey ones did not enter the decision",
                    {m.name: metric_of(m) for m in seen.metrics},
                    deciding=deciding(seen),
                ),
            ),
        ),
        made.section(
            (
                ("Window", window.window_id),
                ("Sensor time", f"{second(seen.pair_stamps_ns[0])} to {second(seen.stamp_ns)}"),
                ("Window, sha256 of images, points and stamps", page_parts.content_hash(window)),
                *page_parts.depth_items(depth_identity),
                ("Configuration, hash", config_hash),
            )
        ),
    )  # fmt: skip
    return Page("coec diagnose", f"Check of {window.rig.pair}", (_verdict(seen, measured),), sections)


def _by_axis(measured: SolvedOffset) -> list[str]:
    return [
        NONE
        if sigma is None
        else f"{page_parts.axis_value(value, axis)} ± {page_parts.axis_value(sigma, axis, sign=False)}"
        for axis, (value, sigma) in enumerate(zip(measured.offset, measured.sigma, strict=True))
    ]


def _verdict(seen: Observation, measured: SolvedOffset | None) -> VerdictBanner:
    if seen.causes:
        reasons = [_reason(cause.as_reason()) for cause in seen.causes]
        sentence = " ".join(cause.text for cause in seen.causes) + " Such a check says nothing of the extrinsic."
        return VerdictBanner("poor", "Cannot tell:", sentence, page_parts.advice_of(reasons))
    if seen.flagged:
        todo = (
            "See that the mount is tight.",
            "Calibrate: `coec calibrate` on a window of this mount tells where the camera is.",
        )
        return VerdictBanner(
            "bad", "Wrong:", f"the camera is not where this extrinsic has it. {_where(seen, measured)}", todo
        )
    if seen.undecided:
        again = ("Take another window, in motion, past objects at different distances.",)
        return VerdictBanner("unsure", "Undecided:", "this window neither accuses the extrinsic nor acquits it.", again)
    return VerdictBanner("good", "Right.", "The edges fit this extrinsic as well as a right one.")


def _where(seen: Observation, measured: SolvedOffset | None) -> str:
    """How far the extrinsic is off, by the solve if it can tell, else by the check."""
    offset = page_parts.finite_degrees(np.nan_to_num(seen.offset))
    near = f"The nearest place at which the edges fit is {page_parts.turn_and_shift(offset)}"
    if measured is None:
        return f"{near}."
    if not measured.accepted:
        return f"{near}; a solve of all {measured.pairs} pairs is refused, so how far it is off is not sure."
    solved = [0.0 if s is None else value for value, s in zip(measured.offset, measured.sigma, strict=True)]
    return f"A solve of all {measured.pairs} pairs puts it {page_parts.turn_and_shift(solved)} from there."


def _reason(reason: Found) -> Reason:
    return Reason(code=reason.code, text=reason.text)


CHECK_PAIRS = 6
"""Number of pairs in the check whose spread is shown."""


def baselines_page(
    baselines: Mapping[str, Baseline], learned: str, sources: Sequence[str], name: str, made: Provenance
) -> Page:
    """The page of every pair in a file of baselines.

    Args:
        learned: the pair that was just commissioned, from these `sources`.
        name: of the file.
    """
    new = baselines[learned]
    limits = new.detected.items()
    caught = ", ".join(f"{percent(share, 0)} at {moved}" for moved, share in limits) or "nothing was tried"
    sentence = (
        f"{learned} is commissioned from {new.pairs} pairs of {count(new.windows, 'window')}. At "
        f"{percent(new.false_alarm_rate)} false alarms a look flags a moved extrinsic so often: {caught}."
    )
    todo = (
        f"Put `{name}` into the state directory of the service, where it is `rig.json`.",
        f"Look at the recording against it: `coec diagnose SOURCE --rig {name}`.",
    )
    others = [pair for pair in baselines if pair != learned]
    sections = [section for pair in (learned, *others) for section in _pair(baselines[pair])]
    origin = made.section(tuple(("Source", source) for source in sources))
    verdict = VerdictBanner("good", "Commissioned.", sentence, todo)
    return Page("coec commission", f"Baselines in {name}", (verdict,), (*sections, origin))


def _pair(baseline: Baseline) -> tuple[Section, ...]:
    pose = baseline.pose
    of_check = finite_degrees(pose.sigma(CHECK_PAIRS))
    bias = axes_table(
        "Bias: how far the estimator puts this rig from its calibration, which is given and right. σ is how well the "
        f"bias is known. A check of {CHECK_PAIRS} pairs scatters about it by the last column.",
        "Bias",
        finite_degrees(pose.bias),
        finite_degrees(pose.bias_sigma),
        more={"σ of a check": [number(value) for value in of_check]},
    )
    sensors = tuple((name.replace("_", " ").capitalize(), serial) for name, serial in baseline.sensors.items())
    facts = Facts(
        (
            ("Hash", baseline_hash(baseline)),
            ("Depth network, sha256", baseline.depth_identity),
            ("Configuration, hash", baseline.config_hash),
            ("Degrees of freedom", str(baseline.dof)),
            *sensors,
        ),
        frozenset({"Hash", "Depth network, sha256", "Configuration, hash"}),
    )
    return (
        Section(f"Pair {baseline.pair}", (bias,)),
        Section(f"Limits of {baseline.pair}", tuple(_limits(baseline)), level=3),
        Section(f"What {baseline.pair} was learned from", (facts,), level=3),
    )


def _limits(baseline: Baseline) -> list[Block]:
    monitor = baseline.monitor
    of_check = (
        ("mi", "≥", monitor.min_mi),
        ("f1", "≤", monitor.max_f1),
        ("f2", "≥", monitor.min_f2),
        ("agreement_deg", "≤", degrees(monitor.max_agreement_rad)),
        ("edges_per_pair", "≥", monitor.min_edges_per_pair),
        ("overlap", "≥", monitor.min_overlap),
    )
    rows = [_limit(name, sign, limit) for name, sign, limit in of_check if isfinite(limit)]
    distances = (
        f"A check is too far off where the squared distance over rotations is above "
        f"{significant(monitor.max_distance2_rotation)} σ², or that of the farthest axis of the pose above "
        f"{significant(monitor.max_farthest2_pose)} σ²."
    )
    blocks: list[Block] = [
        Table("A check", ("Figure", "Limit", "Unit", "What it tells"), rows, frozenset({1}), frozenset({3})),
        Text((distances,)),
    ]
    if baseline.limits:
        fields = VerdictConfig.model_fields
        learned = [
            (
                Cell(name, code=True),
                f"{'≥' if name.startswith('min') else '≤'} {significant(limit)}",
                str(fields[name].description),
            )
            for name, limit in sorted(baseline.limits.items())
        ]
        blocks.append(
            Table("A calibration", ("Limit", "Value", "What it tells"), learned, frozenset({1}), frozenset({2}))
        )
    return blocks


def _limit(name: str, sign: str, limit: float) -> tuple[str, ...]:
    figure = FIGURES[name]
    return figure.title, f"{sign} {significant(limit)}", figure.unit, figure.measures
