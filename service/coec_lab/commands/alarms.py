"""`coec alarms`: how often the monitor accuses a right mount, and how soon it notices a wrong one."""

from __future__ import annotations

from pydantic import ValidationError

from coec.adapters.files import output
from coec.cli.commands.alarms import Options
from coec.config import MonitorConfig, describe
from coec.errors import UsageError
from coec.evaluation.alarms import measured
from coec.reports import alarm_reports, console
from coec.schemas.base import to_json


def run(options: Options) -> int:
    """Draws streams of checks, and prints what the change detector makes of them.

    Raises:
        UsageError: a value is not allowed in a configuration.
        OutputError: the folder cannot be written.
    """
    try:
        config = MonitorConfig(period_s=options.period_s, hours_between_false_alarms=options.between_h)
    except ValidationError as error:
        raise UsageError(describe(error)) from error
    with console.progress() as bars:
        task = bars.add_task("streams of checks", total=None, note="")
        alarms = measured(
            config, options.hours, options.steps, lambda done, total: bars.update(task, completed=done, total=total)
        )
    report = alarm_reports.document_of(alarms)
    if options.output is not None:
        output.write(options.output / "alarms.json", to_json(report))
        output.write(options.output / "delay.png", alarm_reports.delay_curve(report))
    if options.as_json:
        console.print_json(report.model_dump(mode="json"))
    else:
        alarm_reports.show(report)
    return 0
