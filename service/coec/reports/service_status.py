"""What a service says about itself, for people; even 24 pairs of eleven sensors fit on a screen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.text import Text

from coec.reports import console
from coec.schemas import replies
from coec.schemas.base import from_json

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
        "pair", "looked, s ago", "", "checks", "camera", "lidar", "ego", "pairs", "chosen", "windows", "solved",
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
            for cause, count in sorted(_causes(pair)[place].items()):
                by_cause.setdefault(cause, {})[pair.name] = count
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
