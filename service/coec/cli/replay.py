"""`coec replay`: reaches the recorded decision again, from the file alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from coec.adapters.depth.maps import open_depth
from coec.adapters.files.conversions import comparable, result_of
from coec.adapters.images.codec import GreyImages
from coec.adapters.mcap.windows import read_result, read_window
from coec.calibration.calibrator import calibrate
from coec.config import LimitsConfig
from coec.errors import WindowError
from coec.reports import console
from coec.reports.stage_times import StageTimes
from coec.schemas.base import to_json


def run(path: Path, *, depth: str | None, as_json: bool) -> int:
    """Prints whether the result is the recorded one; returns 1 if not.

    Raises:
        WindowError: the file is damaged or holds no result.
        ModelError, CalibrationError: no decision can be reached.
    """
    recorded = read_result(path)
    if recorded is None:
        raise WindowError(f"{path} holds no result to compare with: `coec calibrate {path}` makes one")
    window, configuration = read_window(path)
    network = configuration.depth if depth is None else configuration.depth.model_copy(update={"model": depth})
    limits = LimitsConfig()
    with console.progress() as bars:
        estimate = calibrate(window, open_depth(network, limits), GreyImages(limits), configuration, StageTimes(bars))
    reached = comparable(result_of(estimate, window.rig, recorded.vehicle), recorded)
    identical = to_json(reached) == to_json(recorded)
    differences = _differences(recorded.model_dump(mode="json"), reached.model_dump(mode="json"))
    if as_json:
        console.print_json(
            {
                "window_id": window.window_id,
                "identical": identical,
                "differences": [{"field": f, "recorded": a, "reached": b} for f, a, b in differences],
                "result": reached.model_dump(mode="json"),
            }
        )
    elif identical:
        console.out.print(f"{window.window_id}: identical, ", console.styled(reached.verdict.decision), sep="")
    else:
        console.show(f"{window.window_id}: differs", "bold red")
        table = console.table("field", "recorded", "reached")
        for field, before, after in differences:
            table.add_row(field, str(before), str(after))
        console.out.print(table)
    return 0 if identical else 1


def _differences(recorded: Any, reached: Any, at: str = "") -> list[tuple[str, Any, Any]]:
    """(place, recorded, reached) of every value that differs."""
    if isinstance(recorded, dict) and isinstance(reached, dict):
        keys = sorted(recorded.keys() | reached.keys())
        return [
            difference
            for key in keys
            for difference in _differences(recorded.get(key), reached.get(key), f"{at}.{key}" if at else key)
        ]
    if isinstance(recorded, list) and isinstance(reached, list) and len(recorded) == len(reached):
        return [
            difference
            for index, (before, after) in enumerate(zip(recorded, reached, strict=True))
            for difference in _differences(before, after, f"{at}[{index}]")
        ]
    return [] if recorded == reached else [(at, recorded, reached)]
