"""Replies of a service as text on the console: extrinsic, health, history, windows, evidence, rig, and the status of
the service itself.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from math import hypot
from typing import Final

from rich.table import Table
from rich.text import Text

from coec.reports import console, lens_report
from coec.reports.formatting import count, hold_text, second
from coec.schemas import replies, rig_state
from coec.schemas.commands import Acknowledgement
from coec.schemas.message import from_json

NAMED = 3
"""Pairs that are named in a line about several; of the rest only the number is given."""

PLACES = ("camera", "lidar", "ego", "pairs not chosen", "windows")
"""Where a pair can lose data, in the order of a frame's way."""


def status(payload: bytes) -> None:
    """Prints the status of the daemon."""
    reply = from_json(replies.StatusReply, payload)
    worker, storage = reply.worker, reply.storage
    console.show(
        f"coec {reply.version} for {reply.vehicle}: {reply.state}, up {duration(reply.uptime_s)}, "
        f"configuration {reply.config_hash}"
    )
    for reason in reply.reasons:
        console.show(f"  {reason.code}: {reason.text}", "yellow")
    if reply.configuration is not None and reply.configuration.refused is not None:
        console.show(f"  the configuration on the disk was refused: {reply.configuration.refused}", "yellow")
    elif reply.configuration is not None and reply.configuration.waiting:
        console.show(f"  waits for a restart: {', '.join(reply.configuration.waiting)}", "yellow")
    console.show(
        f"worker {worker.state}, process {worker.pid or '-'}, {worker.restarts} restarts, {worker.queued} waiting; "
        f"windows {storage.bytes_used / 1e6:.0f} MB, free {storage.bytes_free / 1e9:.1f} GB"
    )
    if worker.compiling is not None:
        done = f"{worker.compiling.done} of {worker.compiling.total}"
        console.show(f"  compiling kernels, once on this machine: {done}, for {duration(worker.compiling.elapsed_s)}")
    if reply.budget is not None:
        _budget(reply.budget)
    table = console.table(
        "pair", "checked, s ago", "", "checks", "camera", "lidar", "ego", "pairs", "chosen", "windows", "solved",
        right=(1, *range(3, 11)),
    )  # fmt: skip
    for pair in reply.pairs:
        last_check = _last_check(None if reply.budget is None else reply.budget.pairs.get(pair.name))
        streams = [f"{s.accepted}/{s.received}" if s else "-" for s in (pair.camera, pair.lidar, pair.ego)]
        counts = [str(count) for count in (pair.pairs, pair.selected, pair.windows, pair.solved)]
        table.add_row(pair.name, *last_check, str(pair.checks), *streams, *counts)
    console.out.print(table)
    for line in _lost(reply.pairs):
        console.show(line)
    losses({"worker": worker.losses, "storage": storage.losses})


def losses(by_place: Mapping[str, Mapping[str, int]]) -> None:
    """Prints a line for each place at which something was lost, with the causes."""
    for place, causes in by_place.items():
        if causes:
            text = ", ".join(f"{count} {cause}" for cause, count in sorted(causes.items()))
            console.show(f"  lost, {place}: {text}")


def _last_check(share: replies.BudgetShare | None) -> tuple[str, Text]:
    """How long ago the worker looked at a pair, and a remark on its turn."""
    if share is None:
        return "-", Text()
    ago = "-" if share.unseen_s is None else f"{share.unseen_s:.0f}"
    if share.suspected:
        return ago, Text("suspected", "bold yellow")
    if not share.active:
        return ago, Text("no frames", "dim")
    return ago, Text("waits" if share.waiting else "", "yellow")


def _budget(budget: replies.BudgetStatus) -> None:
    console.show(f"budget {budget.cores:g} of a core; {budget.spent:.2f} spent, {budget.wanted:.2f} wanted")
    if budget.stretched_by > 1.0:
        waiting = [name for name, share in budget.pairs.items() if share.waiting]
        console.show(
            f"  it does not suffice: checks and windows are {budget.stretched_by:g} times as far apart as configured; "
            f"waiting: {_named(waiting) or 'none'}",
            "yellow",
        )


def _lost(pairs: Sequence[replies.PairStatus]) -> list[str]:
    """A line for each place and cause, however many pairs it concerns. Pairs that share a stream all report its one
    count."""
    lines = []
    for place in PLACES:
        by_cause: dict[str, dict[str, int]] = {}
        for pair in pairs:
            for cause, lost in sorted(_causes(pair)[place].items()):
                by_cause.setdefault(cause, {})[pair.name] = lost
        for cause, counts in sorted(by_cause.items()):
            most = sorted(counts, key=lambda name: (-counts[name], name))
            whole = f"{counts[most[0]]}" if len(set(counts.values())) == 1 else f"up to {counts[most[0]]}"
            where = f" in {_named(most)}" if len(pairs) > 1 else ""
            lines.append(f"  lost, {place}: {whole} {cause}{where}")
    return lines


def _causes(pair: replies.PairStatus) -> Mapping[str, Mapping[str, int]]:
    ego = pair.ego.losses if pair.ego else {}
    return dict(zip(PLACES, (pair.camera.losses, pair.lidar.losses, ego, pair.rejections, pair.losses), strict=True))


def _named(names: Sequence[str]) -> str:
    """The first few by name, and the number of the rest."""
    beyond = len(names) - NAMED
    return ", ".join(names) if beyond <= 1 else f"{', '.join(names[:NAMED])} and {beyond} more"


def duration(seconds: float) -> str:
    """A duration in the unit that people would use."""
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def extrinsic(payload: bytes) -> None:
    """The current calibration of a pair."""
    reply = from_json(replies.ExtrinsicReply, payload)
    console.out.print(
        f"{reply.vehicle}/{reply.pair}  {reply.camera_frame} from {reply.lidar_frame}: {reply.provenance}, ",
        console.attempt(reply.status),
        f", open window {reply.percent_complete:.0f} %",
        sep="",
    )
    _axes(reply.axes)
    for row in reply.camera_from_lidar.matrix:
        console.show("  " + "  ".join(f"{value:+.6f}" for value in row))
    if reply.camera_from_cloud is not None:
        console.show(f"for points as the driver gives them, in {reply.cloud_frame}:")
        for row in reply.camera_from_cloud.matrix:
            console.show("  " + "  ".join(f"{value:+.6f}" for value in row))
    if reply.held:
        hold = reply.hold
        hold_summary = hold_text("", None, None) if hold is None else hold_text(hold.sender, hold.since_ns, hold.reason)
        console.show(f"nothing is applied: {hold_summary}", "bold yellow")
    if reply.pending is not None:
        waits = f": {reply.pending.waits.text}" if reply.pending.waits else ""
        named = f"{reply.pending.sha256[:16]} " if reply.pending.sha256 else ""
        of = f"a candidate {named}from window {reply.pending.window_id}"
        console.show(f"{of} waits for `command/apply`{waits}", "yellow")
        if reply.pending.step is not None:
            console.show(
                "  step "
                + "  ".join(f"{name} {v:+.3f}" for name, v in zip(console.AXES, reply.pending.step, strict=True))
            )
    if reply.intrinsics is not None:
        lens = reply.intrinsics
        parameters = "  ".join(f"{name} {value:.6g}" for name, value in lens.parameters.items())
        named = "" if lens.sha256 is None else f"  sha256 {lens.sha256[:16]}"
        console.show(f"holds with the intrinsics {lens.model} {lens.width} x {lens.height}  {parameters}{named}")
    if reply.data_stamp_ns is not None:
        console.show(f"from window {reply.window_id}, data until {second(reply.data_stamp_ns)}")


def health(payload: bytes) -> None:
    """The health of a pair."""
    reply = from_json(replies.HealthReply, payload)
    age = "" if reply.age_s is None else f", evaluated {duration(reply.age_s)} ago"
    console.out.print(
        f"{reply.vehicle}/{reply.pair}  ",
        console.styled(reply.state),
        f" since {second(reply.since_ns)}{age}",
        sep="",
    )
    for reason in reply.reasons:
        console.show(f"  {reason.code}: {reason.text}")
    for need in reply.needs:
        console.show(f"  needs: {need}")
    console.show_metrics(reply.metrics)
    if reply.drift is not None:
        drift = "  ".join(
            f"{name} {console.figure(value, sign=True)}" for name, value in zip(console.AXES, reply.drift, strict=True)
        )
        console.show(f"drift from commissioned (deg, m): {drift}")
    if reply.intrinsics is not None:
        console.show(f"lens from configured: {lens_report.drift_text(reply.intrinsics)}")
    quality = reply.data_quality
    known = {
        "pairs per second": quality.pair_rate_hz,
        "camera after LiDAR, s": quality.sync_error_s,
        "sharpness": quality.sharpness,
        "mean level": quality.mean_level,
        "clipped share": quality.clipped,
    }
    figures = "  ".join(f"{name} {console.figure(value)}" for name, value in known.items() if value is not None)
    if figures:
        console.show(figures)
    if quality.point_times:
        console.show(f"point times are {quality.point_times}")
    if quality.frozen_image:
        console.show("the camera repeats the same picture", "bold red")
    losses(quality.drops)


def history(payload: bytes) -> None:
    """Past results of a pair."""
    reply = from_json(replies.HistoryReply, payload)
    console.show(f"{reply.vehicle}/{reply.pair}  {len(reply.results)} of {count(reply.total, 'result')}")
    console.out.print(results_table(reply))
    table = console.table("#", "service time", "what", "outcome", "why", "sender", "sha256", right=(0,))
    for item in reply.entries:
        entry = item.entry
        row = (str(entry.sequence), second(entry.wall_ns), entry.kind, console.styled(entry.code), entry_text(entry))
        table.add_row(*row, entry.sender or "", item.sha256[:12])
    console.out.print(table)
    numbers = [item.entry.sequence for item in reply.entries]
    if any(after - before > 1 for before, after in pairwise(numbers)):
        console.show(
            "Missing numbers are entries that were not asked for, or older ones that made room (`state.history`)."
        )


def entry_text(entry: replies.HistoryEntry) -> str:
    """What happened, and for a command the reason that its sender gave."""
    return entry.text if entry.reason is None else f"{entry.text} Reason: {entry.reason}"


def results_table(reply: replies.HistoryReply) -> Table:
    """Past results, a row each."""
    table = console.table("data until", "verdict", "pairs", *console.AXES, "window", right=range(2, 9))
    for result in reply.results:
        moved = [console.figure(value, sign=True) for value in result.correction]
        verdict = console.styled(result.verdict.decision)
        table.add_row(second(result.data_stamp_ns), verdict, str(result.pairs), *moved, result.window_id)
    return table


def windows(payload: bytes) -> None:
    """Recorded windows of a pair, and its snippets."""
    reply = from_json(replies.WindowsReply, payload)
    snippets = f", {count(len(reply.snippets), 'snippet')}" if reply.snippets else ""
    console.show(f"{reply.vehicle}/{reply.pair}  {count(len(reply.windows), 'window')}{snippets}")
    retention_column = ("kept for",) if any(window.kept_for for window in reply.windows) else ()
    table = console.table("window", "pairs", "MB", "verdict", "sha256", *retention_column, right=(1, 2))
    for window in reply.windows:
        size = f"{window.size_bytes / 1e6:.1f}"
        verdict = console.styled(window.decision or ("not evaluated" if window.sha256 else "not read yet"))
        pairs = "?" if window.pairs is None else str(window.pairs)
        row = (window.window_id, pairs, size, verdict, (window.sha256 or "not read yet")[:16])
        retention = "incident" if window.kept_for == "red_event" else window.kept_for or ""
        table.add_row(*row, *([retention] if retention_column else []))
    console.out.print(table)
    if reply.snippets:
        table = console.table("snippet", "MB", "event", "sha256", right=(1,))
        for one in reply.snippets:
            table.add_row(one.snippet_id, f"{one.size_bytes / 1e6:.1f}", console.styled(one.event), one.sha256[:16])
        console.out.print(table)


def evidence(payload: bytes) -> None:
    """Red events of a pair."""
    reply = from_json(replies.EvidenceReply, payload)
    console.show(f"{reply.vehicle}/{reply.pair}  {count(len(reply.events), 'incident')}")
    table = console.table("event", "began", "why", "window before", "window after", "now")
    for event in reply.events:
        why = "; ".join(reason.code for reason in event.reasons)
        windows_of = (event.window_before or "-", event.window_after or "-")
        table.add_row(event.event_id, second(event.wall_ns), why, *windows_of, event.resolution or "still red")
    console.out.print(table)


def event(payload: bytes) -> None:
    """One incident."""
    reply = from_json(replies.EvidenceEvent, payload)
    console.show(f"{reply.event_id}  began {second(reply.wall_ns)}, {reply.resolution or 'still red'}")
    for reason in reply.reasons:
        console.show(f"  {reason.code}: {reason.text}")
    console.show(f"windows: before {reply.window_before or '-'}, after {reply.window_after or '-'}")
    names = sorted({name for point in reply.metrics for name in point.metrics})
    table = console.table("check", "state", *names, right=range(2, 2 + len(names)))
    for point in reply.metrics:
        figures = [console.figure(point.metrics.get(name)) for name in names]
        table.add_row(second(point.stamp_ns), console.styled(point.state), *figures)
    console.out.print(table)


def rig(payload: bytes) -> None:
    """All sensors of a vehicle."""
    reply = from_json(rig_state.RigReply, payload)
    until = (
        "nothing was looked at yet"
        if reply.stamp_ns is None
        else f"by all that was seen until {second(reply.stamp_ns)}"
    )
    console.show(f"{reply.vehicle}  {until}")
    for reason in reply.reasons:
        console.show(f"  {reason.code}: {reason.text}", "yellow")
    table = console.table("sensor", "kind", "state", "moved, %", "since", "why", right=(3,))
    for sensor in reply.sensors:
        share = "-" if sensor.probability is None else f"{100.0 * sensor.probability:.1f}"
        since = "-" if sensor.since_ns is None else second(sensor.since_ns)
        why = "; ".join(reason.text for reason in sensor.reasons)
        table.add_row(sensor.name, sensor.kind, console.styled(sensor.state), share, since, why)
    console.out.print(table)
    if reply.joint is not None:
        _joint(reply.joint)
    if reply.move is not None:
        move, far = reply.move, []
        for name in move.sensors:
            by = move.by.get(name)
            far.append(name if by is None else f"{name} by {hypot(*by.by[:3]):.2f}°")
        over = "goes on" if move.over_ns is None else f"over since {second(move.over_ns)}"
        console.show(f"last moved: {' and '.join(far)}, named at {second(move.since_ns)}, {over}")
    if reply.lidars:
        _lidars(reply)
    if reply.correction is not None:
        named, pairs = " and ".join(reply.correction.sensors), ", ".join(reply.correction.pairs)
        console.show(f"last put right: {named}, in {pairs}, since {second(reply.correction.from_ns)}")
    losses({"rig": reply.losses})


def _lidars(reply: rig_state.RigReply) -> None:
    """Prints where LiDARs sit relative to each other, and the age of that in sensor time."""
    table = console.table(
        "LiDARs", "state", "age, s", "registrations", *(f"{name} ± σ" for name in console.AXES), right=range(2, 10)
    )
    for lidars in reply.lidars:
        age = "-"
        if lidars.measured_ns is not None and reply.stamp_ns is not None:
            age = f"{max(reply.stamp_ns - lidars.measured_ns, 0) / 1e9:.0f}"
        steps = ["-"] * 6
        if lidars.correction is not None and lidars.sigma is not None:
            rows = zip(lidars.correction, lidars.sigma, strict=True)
            steps = [f"{step:+.3f} ± {sigma:.3f}" for step, sigma in rows]
        table.add_row(lidars.name, console.styled(lidars.state), age, str(lidars.looks), *steps)
    console.show("two LiDARs each, from how they were built (deg, m)")
    console.out.print(table)
    for lidars in reply.lidars:
        for reason in lidars.reasons:
            console.show(f"  {lidars.name}: {reason.text}", "yellow")
        losses({lidars.name: lidars.losses})


def _joint(joint: rig_state.JointReply) -> None:
    """Prints where all pairs are by the joint estimate, and how well they fit each other."""
    table = console.table("pair", *(f"{name} ± σ" for name in console.AXES), right=range(1, 7))
    for pair in joint.pairs:
        steps = [f"{step:+.3f} ± {sigma:.3f}" for step, sigma in zip(pair.step, pair.sigma, strict=True)]
        table.add_row(pair.pair if pair.measured else f"{pair.pair} (by the others)", *steps)
    console.show(f"all pairs together, from what each serves (deg, m), data until {second(joint.stamp_ns)}")
    console.out.print(table)
    if joint.freedom:
        fit = "fit each other" if joint.consistent else "do not fit each other"
        figures = f"χ² {joint.chi2:.1f} at {joint.freedom} degrees of freedom, p {joint.p_value:.2g}"
        console.show(f"the pairs {fit}: {figures}", "" if joint.consistent else "bold red")
    for loop in joint.open_loops:
        shift = "" if loop.translation_m is None else f", {100.0 * loop.translation_m:.1f} cm"
        console.show(f"  does not close: {', '.join(loop.names)}: {loop.rotation_deg:.2f}°{shift}", "bold red")


def command(payload: bytes) -> None:
    """The answer to a command."""
    reply = from_json(Acknowledgement, payload)
    outcome = Text("accepted", "bold green") if reply.accepted else Text("not accepted", "bold yellow")
    window = f" (window {reply.window_id})" if reply.window_id else ""
    console.out.print(f"{reply.vehicle}/{reply.pair} {reply.command}: ", outcome, sep="")
    console.show(f"  {reply.code}: {reply.text}{window}")


BY_KIND: Final[Mapping[str, Callable[[bytes], None]]] = {
    "extrinsic": extrinsic,
    "health": health,
    "history": history,
    "windows": windows,
    "evidence": evidence,
    "event": event,
    "status": status,
    "rig": rig,
    "command": command,
}
"""The function that prints a reply, by the name of its key. Other replies are printed as they come."""


def _axes(axes: replies.Axes) -> None:
    table = console.table("axis", "correction", "± σ", "unit", "status", right=(1, 2))
    for name, title in zip(console.AXES, console.AXIS_NAMES, strict=True):
        axis: replies.AxisReply = getattr(axes, name)
        table.add_row(
            title,
            console.figure(axis.correction, sign=True),
            console.figure(axis.sigma),
            axis.unit,
            "no attempt yet" if axis.status == "not_accepted" else axis.status,
        )
    console.out.print(table)
