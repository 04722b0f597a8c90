"""`coec replay`: computes the recorded decision again, from the file alone."""

from pathlib import Path
from typing import Annotated, Any

import typer

from coec.cli.options import Json
from coec.errors import WindowError


def replay(
    window: Annotated[Path, typer.Argument(help="A recorded window with its result (.mcap).", show_default=False)],
    depth: Annotated[
        str | None, typer.Option(help="Depth network, if it has moved since the window was recorded.", metavar="MODEL")
    ] = None,
    as_json: Json = False,
) -> int:
    """Reproduce the recorded decision from the file alone: exit 1 if a byte of it differs."""
    from coec.calibration.pipeline import calibrate
    from coec.config import LimitsConfig
    from coec.io.depth.depth_maps import open_depth
    from coec.io.images import GreyImages
    from coec.io.mcap.window_reader import read_result, read_window
    from coec.io.serialise import comparable, result_of
    from coec.reports import console
    from coec.reports.console import StageTimes
    from coec.schemas.message import to_json

    recorded = read_result(window)
    if recorded is None:
        raise WindowError(f"{window} holds no result to compare with: `coec calibrate {window}` makes one")
    recorded_window, configuration = read_window(window)
    network = configuration.depth if depth is None else configuration.depth.model_copy(update={"model": depth})
    limits = LimitsConfig()
    with console.progress() as bars:
        estimate = calibrate(
            recorded_window, open_depth(network, limits), GreyImages(limits), configuration, StageTimes(bars)
        )
    reached = comparable(result_of(estimate, recorded_window.rig, recorded.vehicle), recorded)
    identical = to_json(reached) == to_json(recorded)
    differences = _differences(recorded.model_dump(mode="json"), reached.model_dump(mode="json"))
    if as_json:
        console.print_json(
            {
                "window_id": recorded_window.window_id,
                "identical": identical,
                "differences": [{"field": f, "recorded": a, "reached": b} for f, a, b in differences],
                "result": reached.model_dump(mode="json"),
            }
        )
    elif identical:
        console.out.print(f"{recorded_window.window_id}: identical, ", console.styled(reached.verdict.decision), sep="")
    else:
        console.show(f"{recorded_window.window_id}: differs", "bold red")
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
