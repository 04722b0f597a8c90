"""What many windows say of a fleet: the drifting vehicles first, the right numbers, and what another batch decided."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

import duckdb
import numpy as np
import pytest

from coec.errors import UsageError
from coec.fleet.report import EXAMPLE_QUERIES, columns, connect, report, view_statement, write_tables
from coec.io.mcap.windows import read_result
from coec.reports import fleet_page
from coec.reports.page import VerdictBanner, render
from coec.reports.page_parts import Provenance
from coec.schemas.documents import FleetNow, FleetReport, PairNow, WindowRow
from coec.schemas.replies import Alarms, CalibrationResult
from support.fleet import FAILED_SHARE, REFUSED_SHARE, WINDOW_SIGMA, fleet_rows
from support.messages import heartbeat

VEHICLES, WINDOWS = 12, 40
DRIFTS = {3: (1, 1.2), 7: (3, 0.15)}
"""Yaw by 1.2°, and to the right by 15 cm."""


@pytest.fixture(scope="module")
def pattern(recorded: Path) -> CalibrationResult:
    result = read_result(recorded / "one" / "one-1.mcap")
    assert result is not None
    return result


@pytest.fixture(scope="module")
def rows(pattern: CalibrationResult) -> list[WindowRow]:
    return list(fleet_rows(pattern, VEHICLES, WINDOWS, DRIFTS, 1))


@pytest.fixture(scope="module")
def results(rows: list[WindowRow], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results")
    write_tables(folder, rows, "part-1")
    return folder


@pytest.fixture(scope="module")
def reported(results: Path) -> FleetReport:
    return report(results, None)


def test_vehicles_that_drift_come_first_with_their_axis(reported: FleetReport) -> None:
    by_urgency = [(pair.vehicle, pair.worst) for pair in reported.pairs[:2]]
    assert by_urgency == [("v003", "ry_deg"), ("v007", "tx_m")]
    yaw = reported.pairs[0]
    assert yaw.drift[1] == pytest.approx(1.2, rel=0.15)
    assert yaw.urgency == pytest.approx(abs(yaw.drift[1] or 0.0) / 0.5)
    days = WINDOWS * 2.4 / 24.0
    assert yaw.slope[1] == pytest.approx(1.2 / days * 30.0, rel=0.15)
    for pair in reported.pairs[2:]:
        assert pair.urgency < 0.5


def test_counts_are_those_of_the_rows(reported: FleetReport, rows: list[WindowRow]) -> None:
    results = [row.result for row in rows if row.result is not None]
    accepted = [result for result in results if result.verdict.decision == "accepted"]
    assert (reported.windows, reported.accepted) == (len(rows), len(accepted))
    assert reported.refusals == {"sigma_deg": len(results) - len(accepted)}
    assert reported.errors == {"bad_window": len(rows) - len(results)}
    assert len(results) < len(rows) * (1.0 - FAILED_SHARE / 4.0)
    assert len(results) - len(accepted) > len(rows) * REFUSED_SHARE / 4.0
    # Windows that could not be read have no vehicle; they are no vehicle's drift either.
    assert {pair.vehicle for pair in reported.pairs} == {*(f"v{index:03}" for index in range(VEHICLES)), "unknown"}
    (first_ns, last_ns) = min(r.data_stamp_ns for r in results), max(r.data_stamp_ns for r in results)
    assert (reported.first_ns, reported.last_ns) == (first_ns, last_ns)


def test_days_are_medians_and_bands_as_numpy_has_them(reported: FleetReport, rows: list[WindowRow]) -> None:
    pair = next(pair for pair in reported.pairs if pair.vehicle == "v005")
    by_day: dict[str, list[float]] = {}
    for row in rows:
        result = row.result
        if result is not None and result.vehicle == "v005" and result.verdict.decision == "accepted":
            date = str(np.datetime64(result.data_stamp_ns, "ns").astype("datetime64[D]"))
            by_day.setdefault(date, []).append(result.correction[2])
    assert [day.date for day in pair.days] == sorted(by_day)
    for day in pair.days:
        low, middle, high = np.quantile(by_day[day.date], [0.16, 0.5, 0.84])
        assert (day.low[2], day.middle[2], day.high[2]) == pytest.approx((low, middle, high))
    assert len(pair.days) > 3


def test_an_axis_that_no_window_determines_has_no_drift(rows: list[WindowRow], tmp_path: Path) -> None:
    blind = [
        row.model_copy(update={"result": row.result.model_copy(update={"unobservable": (False,) * 5 + (True,)})})
        for row in rows[:WINDOWS]
        if row.result is not None
    ]
    write_tables(tmp_path, blind, "part-1")
    (pair,) = report(tmp_path, None).pairs
    assert pair.drift[5] is None
    assert pair.latest[5] is None
    assert pair.latest[4] == pytest.approx(0.0, abs=40.0 * WINDOW_SIGMA[4])
    assert all(day.middle[5] is None for day in pair.days)


def test_what_another_batch_decided_otherwise(results: Path, rows: list[WindowRow], tmp_path: Path) -> None:
    turned, failing = 5, 9
    before = list(rows)
    for index in (turned, failing):
        assert rows[index].result is not None
    result = rows[turned].result
    assert result is not None
    refused = result.verdict.model_copy(update={"decision": "failed", "reasons": ()})
    moved = (result.correction[0] + 0.7, *result.correction[1:])
    before[turned] = rows[turned].model_copy(
        update={"decided": "other", "result": result.model_copy(update={"verdict": refused, "correction": moved})}
    )
    now = list(rows)
    now[failing] = rows[failing].model_copy(
        update={"result": None, "decided": None, "error_code": "deadline", "error": "late"}
    )
    for name, batch in (("before", before), ("now", now)):
        write_tables(tmp_path / name, [*batch, batch[0].model_copy(update={"url": "a copy of it"})], "part-1")
    changes = report(tmp_path / "now", tmp_path / "before").changes
    assert changes is not None
    assert (changes.both, changes.identical) == (len(rows), len(rows) - 2)
    assert (changes.newly_accepted, changes.newly_refused, changes.newly_failing) == (1, 1, 1)
    first, second = changes.windows
    assert first.now == "accepted"
    assert first.rotation_deg == pytest.approx(0.7)
    assert (second.before, second.now, second.rotation_deg) == ("accepted", "deadline", None)
    same = report(results, results).changes
    assert same is not None
    assert (same.identical, same.windows, same.rotation_deg) == (len(rows), (), 0.0)


def test_every_example_of_a_query_answers(results: Path) -> None:
    connection = connect(results)
    for question, query in EXAMPLE_QUERIES.items():
        rows = connection.execute(query).fetchall()
        assert rows or "otherwise" in question, question
    assert dict(columns(results))["correlation"] == "DOUBLE[]"


def test_the_view_that_is_printed_is_the_one_that_is_requested(rows: list[WindowRow], tmp_path: Path) -> None:
    """A vehicle whose name is a number keeps its zeros."""
    write_tables(tmp_path, [row.model_copy(update={"vehicle": "007"}) for row in rows[:2]], "part-1")
    connection = duckdb.connect()
    connection.execute(view_statement("mine", tmp_path))
    assert connection.execute("SELECT DISTINCT vehicle FROM mine").fetchall() == [("007",)]


def test_false_alarms_of_vehicles_stand_on_the_page(results: Path) -> None:
    word = heartbeat("<v>", alarms=Alarms(watched_s=180_000.0, confirmed=2, withdrawn=1, open=False))
    pair = PairNow(word=word, standing="live", said_s=1.0, looked_s=1.0, worst=None, urgency=0.0)
    now = FleetNow(vehicles=1, known=1, states={}, matching=1, pairs=(pair,), refused={})
    text = render(fleet_page.page(report(results, None, now), "fleet", MADE))
    assert "1 pair watched for 50.0 h of driving: alarms confirmed by another extrinsic 2, false 1" in text
    assert "2.00 in 100 h (95 %: at most 9.4" in text
    assert "&lt;v&gt;/front" in text


def test_a_drift_that_one_window_cannot_decide_is_not_denied(rows: list[WindowRow], tmp_path: Path) -> None:
    write_tables(
        tmp_path, [next(row for row in rows if row.result and row.result.verdict.decision == "accepted")], "part-1"
    )
    reported = report(tmp_path, None)
    (verdict,) = fleet_page.page(reported, "fleet", MADE).opening
    assert isinstance(verdict, VerdictBanner)
    assert (verdict.tone, verdict.word) == ("none", "Drift not known.")
    assert fleet_page.sentence(reported).startswith("1 vehicle, 1 window on 20")
    assert fleet_page.sentence(reported).endswith("too few accepted windows to tell a drift: 1.")


def test_a_folder_without_tables_is_reported(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="coec batch"):
        report(tmp_path, None)


MADE = Provenance("coec fleet report tables", 0, {"coec": "0"}, "Linux")


class Page(HTMLParser):
    """What of a page would be loaded or run, and its tags that are not closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loads += [f"{tag} {name}" for name, _ in attrs if name in ("src", "href", "onload", "onerror")]
        if tag in ("table", "tbody", "thead", "svg", "div", "script"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag in self.open:
            assert self.open.pop() == tag


@pytest.mark.fault("a vehicle that calls itself markup", "text in the page of the fleet")
def test_the_page_loads_nothing_and_names_are_text_in_it(reported: FleetReport) -> None:
    name = "<script src=x onerror=alert(1)>'\"&"
    pairs = (reported.pairs[0].model_copy(update={"vehicle": name, "pair": name}), *reported.pairs[1:])
    text = render(fleet_page.page(reported.model_copy(update={"pairs": pairs}), name, MADE))
    page = Page(text)
    assert [load for load in page.loads if load != "a href"] == []
    assert page.open == []
    assert text.count("<script") == 1, "that of the page itself"
    assert text.count("<svg") == sum(pair.worst is not None for pair in reported.pairs)
    assert "2 of" in fleet_page.sentence(reported)
