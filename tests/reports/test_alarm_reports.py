"""Tables and pictures of the change detector, whatever was noticed."""

from __future__ import annotations

from math import inf

import pytest

from coec.config import MonitorConfig
from coec_lab.experiments import alarm_statistics
from coec_lab.experiments.alarm_statistics import AlarmExperiments, Creep, Delay, FromStart
from coec_lab.experiments.evaluation_schema import FalseAlarmsRow

ALARMS = AlarmExperiments(
    MonitorConfig(),
    (FalseAlarmsRow(stated_h=10.0, driven_h=5.0, alarms=1),),
    (Delay(0.1, (inf, 5.0), (inf, inf)), Delay(1.0, (5.0, 10.0, 10.0), (10.0, 15.0, 20.0))),
    Creep(0.1, (2.0, 3.0, 4.0), (3.0, 4.0, inf)),
    (FromStart(0.5, (10.0, 10.0, 15.0, inf)),),
)


def test_what_was_not_noticed_in_time_has_no_figure() -> None:
    report = alarm_statistics.document_of(ALARMS)
    assert report.delays[0].confirmed_s.median is None
    assert (report.delays[1].confirmed_s.median, report.delays[1].confirmed_s.p95) == (15.0, 20.0)
    assert (report.creep_confirmed_h.median, report.creep_confirmed_h.max) == (4.0, None)


def test_the_curve_is_rendered() -> None:
    assert alarm_statistics.delay_curve(alarm_statistics.document_of(ALARMS)).startswith(b"\x89PNG")


def test_the_tables_say_what_is_stated_and_what_was(capsys: pytest.CaptureFixture[str]) -> None:
    alarm_statistics.show(alarm_statistics.document_of(ALARMS))
    reported = capsys.readouterr().out
    assert "10 h" in reported
    assert "75 %" in reported
    assert "0.1°/h is suspected after 3.0 h and confirmed after 4.0 h" in " ".join(reported.split())
