"""The page of `coec commission`: how the estimator behaves on each pair of a vehicle, and the limits that follow."""

from collections.abc import Mapping, Sequence
from math import degrees, isfinite

from coec.calibration.baseline import Baseline
from coec.calibration.figures import FIGURES
from coec.config import VerdictConfig
from coec.io.rig_files import baseline_hash
from coec.reports.formatting import count, number, percent, significant
from coec.reports.page import Block, Cell, Facts, Page, Section, Table, Text, VerdictBanner
from coec.reports.page_parts import Provenance, axes_table, finite_degrees

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
