"""`coec alarms`: false-alarm rate and detection delay of the monitor, on simulated checks."""

from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Json


def alarms(
    hours: Annotated[float, typer.Option(help="Hours of driving with a correct extrinsic.", min=0.1)] = 100.0,
    steps: Annotated[int, typer.Option(help="Number of simulated steps of each size.", min=1)] = 20,
    period_s: Annotated[float, typer.Option("--period", help="Seconds between checks.")] = 5.0,
    between_h: Annotated[float, typer.Option("--between", help="Configured hours between false alarms.")] = 100.0,
    output: Annotated[
        Path | None, typer.Option(help="Folder for alarms.json and delay.png.", metavar="DIR", show_default=False)
    ] = None,
    as_json: Json = False,
) -> int:
    """Estimate false-alarm rate and detection delay of the monitor from simulated checks."""
    from pydantic import ValidationError

    from coec.config import MonitorConfig, describe
    from coec.errors import UsageError
    from coec.io import user_files as files
    from coec.reports import console
    from coec.schemas.message import to_json
    from coec_lab.experiments import alarm_statistics
    from coec_lab.experiments.alarm_statistics import measured

    try:
        config = MonitorConfig(period_s=period_s, hours_between_false_alarms=between_h)
    except ValidationError as error:
        raise UsageError(describe(error)) from error
    with console.progress() as bars:
        task = bars.add_task("streams of checks", total=None, note="")
        figures = measured(config, hours, steps, lambda done, total: bars.update(task, completed=done, total=total))
    report = alarm_statistics.document_of(figures)
    if output is not None:
        files.write_output(output / "alarms.json", to_json(report))
        files.write_output(output / "delay.png", alarm_statistics.delay_curve(report))
    console.report(report, lambda: alarm_statistics.show(report), as_json=as_json)
    return 0
