"""`coec fleet commission`: combines baselines of vehicles of one model into baselines of the model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from coec.adapters.files.baseline_file import load_baselines, save_baseline
from coec.calibration.commissioning.baseline import Baseline
from coec.calibration.commissioning.of_model import of_model
from coec.cli import commission
from coec.cli.commands.fleet_commission import Options
from coec.errors import UsageError
from coec.reports import console
from coec.reports.page.words import count


def run(options: Options) -> int:
    """Prints and writes a baseline for every pair that all vehicles have.

    Raises:
        UsageError: a file is named twice or has no baseline, or no pair is common to all.
        CalibrationError: too few vehicles, or baselines that do not belong together.
        StateError: a file is damaged, or cannot be written.
    """
    vehicles = [load_baselines(path) for path in _once(options.baselines)]
    for path, pairs in zip(options.baselines, vehicles, strict=True):
        if not pairs:
            raise UsageError(f"{path} holds no baseline: coec commission, or the command of that name, makes them")
    shared = sorted(set.intersection(*(set(pairs) for pairs in vehicles)))
    if not shared:
        raise UsageError("there is no pair that all of the vehicles have")
    models = [of_model([pairs[name] for pairs in vehicles]) for name in shared]
    for model in models:
        save_baseline(options.output, model)
    if options.as_json:
        console.print_json({"vehicles": len(vehicles), "pairs": [commission.document_of(model) for model in models]})
        return 0
    for model in models:
        _show(model, len(vehicles))
    console.show(f"written to {options.output}: name it as `state.model` on vehicles that are not commissioned")
    return 0


def _once(paths: Sequence[Path]) -> Sequence[Path]:
    twice = sorted({str(path) for path in paths if paths.count(path) > 1})
    if twice:
        raise UsageError(f"named twice: {', '.join(twice)}; each vehicle counts once")
    return paths


def _show(model: Baseline, vehicles: int) -> None:
    console.show(
        f"{model.pair}: {count(vehicles, 'vehicle')}, {count(model.pairs, 'pair')} of {count(model.windows, 'window')}"
    )
    commission.show_learned(model)
