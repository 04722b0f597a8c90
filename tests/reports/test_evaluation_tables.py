"""What `coec evaluate` says of searches that agree with each other and not with the reference."""

from __future__ import annotations

import pytest

from coec.reports.page import render
from coec_lab.experiments.evaluation_page import evaluation_page, show
from coec_lab.experiments.evaluation_tables import reference_doubt
from reports.pages import MADE, evaluation_report

OFF = (-0.8, 0.6, -0.5, 0.0, 0.0, 0.0)
"""As the workshop's calibration of the tutorial's drive is off, deg and m."""


def test_where_all_searches_meet_next_to_the_reference_it_is_doubted(capsys: pytest.CaptureFixture[str]) -> None:
    report = evaluation_report(accepted_misses=5).model_copy(update={"median": OFF, "from_reference": OFF})
    doubt = reference_doubt(report)
    assert doubt is not None
    assert "meet 1.12° and 0.00 m beside the source's calibration" in doubt
    show(report)
    assert "either that calibration is off" in " ".join(capsys.readouterr().out.split())
    page = render(evaluation_page(report, (), (), MADE))
    assert "Beside the reference, and accepted." in page
    assert "either that calibration is off" in page


def test_searches_that_end_at_the_reference_or_separate_doubt_nothing() -> None:
    home = (0.1, 0.0, 0.1, 0.0, 0.0, 0.0)
    for median, from_reference in ((home, home), (OFF, home), (home, OFF), ((3.0, 0.0, 0.0, 0.0, 0.0, 0.0), OFF)):
        report = evaluation_report(accepted_misses=5).model_copy(
            update={"median": median, "from_reference": from_reference}
        )
        assert reference_doubt(report) is None
        assert "Wrong and accepted." in render(evaluation_page(report, (), (), MADE))
