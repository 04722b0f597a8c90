"""The vocabulary of pages: what is put in comes out as text, pictures fit, plots have round axes."""

from __future__ import annotations

import base64
import re
from html.parser import HTMLParser
from math import inf, isfinite, nan
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coec.calibration.figures import FIGURES
from coec.errors import DecodeError
from coec.reports import charts, fleet_page
from coec.reports.charts import Chart, Ground, Mark, Series
from coec.reports.formatting import NONE, number, percent, significant
from coec.reports.page import Page, Section, Text, embedded, render
from coec.reports.page_parts import CAPTIONS, figures_block
from coec.schemas.documents import DayOfPair, FleetReport, PairOfFleet
from coec.schemas.replies import MetricReply
from reports import pages
from reports.pages import EVIL, png


class Read(HTMLParser):
    """What a browser makes of a page: its tags with their attributes, its text, and the text of its scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self.scripts: list[str] = []
        self._inside = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._inside = tag

    def handle_endtag(self, tag: str) -> None:
        self._inside = "" if tag == self._inside else self._inside

    def handle_data(self, data: str) -> None:
        (self.scripts if self._inside == "script" else self.text).append(data)


@pytest.mark.parametrize("kind", [kind for kind in pages.KINDS if kind.startswith("hostile")])
@pytest.mark.fault("a vehicle whose name is a script", "every page shows it as text; its own script alone may run")
def test_a_hostile_name_is_text(tmp_path: Path, kind: str) -> None:
    read = Read(render(pages.KINDS[kind](tmp_path)))
    assert EVIL in "".join(read.text)
    assert len(read.scripts) == 1
    harmless = Read(render(pages.KINDS[kind.removeprefix("hostile_")](tmp_path)))
    assert read.scripts == harmless.scripts
    assert [tag for tag, _ in read.tags] == [tag for tag, _ in harmless.tags]
    assert not any(name.startswith("on") for _, attributes in read.tags for name in attributes)
    (policy,) = (attributes["content"] for tag, attributes in read.tags if "http-equiv" in attributes and tag == "meta")
    assert policy is not None
    assert policy.startswith("default-src 'none'")


@pytest.mark.parametrize("accepted", [True, False])
def test_what_is_copied_of_a_refused_result_says_so(tmp_path: Path, accepted: bool) -> None:
    read = Read(render(pages.calibration(tmp_path, accepted=accepted)))
    copied = [attributes["data-copy"] or "" for tag, attributes in read.tags if "data-copy" in attributes]
    shown = [text for text in read.text if "1.000000000" in text]
    assert len(copied) == 3
    assert len(shown) == 2
    for text in (*copied, *shown):
        assert text.startswith("# REFUSED - do not use\n") is not accepted


def test_titles_that_are_alike_or_empty_have_places_of_their_own() -> None:
    sections = tuple(Section(title, (Text(("a",)),)) for title in ("One", "one!", "", "†", "One"))
    text = render(Page("kind", "title", (), sections))
    anchors = re.findall(r'<h2 id="([^"]*)"', text)
    assert anchors == ["one", "one-2", "section", "section-2", "one-3"]
    assert re.findall(r'<li><a href="#([^"]*)"', text) == anchors


def test_code_in_sentences_stands_between_backticks() -> None:
    def shown(text: str) -> str:
        result = re.search(r'<p class="text">(.*)</p>', render(Page("kind", "title", (Text((text,)),), ())))
        assert result is not None
        return result[1]

    assert shown("run `coec <x>` now") == "run <code>coec &lt;x&gt;</code> now"
    assert shown("one ` alone <b>") == "one ` alone &lt;b&gt;"
    assert shown(f"{significant(57597.2)}, {percent(0.5)}") == f"{significant(57597.2)}, {percent(0.5)}"
    assert shown("reversed \u202e") == "reversed \\u202e"


def test_small_pictures_stay_as_they_are_and_large_ones_are_made_to_fit() -> None:
    small, large = png(160, 90), png(2400, 1600)
    noise = np.random.default_rng(1).integers(0, 255, (1200, 1600, 3), dtype=np.uint8)
    noisy = bytes(cv2.imencode(".png", noise)[1])
    first, second, third = embedded([small, large, noisy])
    assert base64.b64decode(first.uri.partition(",")[2]) == small
    assert (second.width, second.height) == (2400, 1600), "the room that it takes is that of the picture as it was"
    assert (third.width, third.height) == (1600, 1200)
    assert sum(len(one.uri) for one in (first, second, third)) < 2_700_000
    shown = cv2.imdecode(np.frombuffer(base64.b64decode(third.uri.partition(",")[2]), np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    assert shown.shape[1] * 1200 == pytest.approx(shown.shape[0] * 1600, rel=0.01)


@pytest.mark.fault("a picture that is invalid, or too many pictures", "the page is refused, and never half written")
def test_what_is_no_picture_is_refused() -> None:
    with pytest.raises(DecodeError):
        embedded([b"<svg onload=alert(1)>"])
    with pytest.raises(DecodeError, match="leave some out"):
        embedded([png()] * 3, budget_bytes=300)


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6), st.integers(3, 10))
def test_ticks_are_round_within_and_not_too_many(low: float, length: float, most: int) -> None:
    high = low + length
    result = charts.linear_ticks(low, high, most)
    assert 1 <= len(result) <= most
    assert all(low - 1e-6 * length <= tick <= high + 1e-6 * length for tick in result)
    assert result == sorted(set(result))


def test_logarithmic_ticks_are_of_one_two_three_and_five() -> None:
    assert charts.logarithmic_ticks(0.02, 20.0) == pytest.approx([0.1, 1.0, 10.0])
    assert charts.logarithmic_ticks(0.04, 1.0) == pytest.approx([0.1, 0.3, 1.0])
    assert charts.logarithmic_ticks(0.3, 0.9) == pytest.approx([0.5])


@pytest.mark.parametrize("log", [False, True])
@pytest.mark.parametrize("points", [[], [(0.0, 0.0)], [(1.0, 2.0), (1.0, 2.0)], [(0.0, nan), (1.0, 1.0), (2.0, -1.0)]])
def test_a_plot_of_whatever_lies_within_its_axes(points: list[tuple[float, float]], log: bool) -> None:
    chart = Chart("t", "x", "y", (Series("s", points),), "told", marks=(Mark(0.5, "a mark with a name"),), log_y=log)
    for size in (charts.WIDE, charts.NARROW, charts.SMALL):
        rendered = charts.layout(chart, size)
        assert 0 < rendered.left < rendered.right <= size.width
        assert 0 < rendered.top < rendered.bottom <= size.height
        for path in rendered.paths:
            for x, y in re.findall(r"[ML]([-\d.]+) ([-\d.]+)", path.d):
                assert rendered.left <= float(x) <= rendered.right
                assert rendered.top <= float(y) <= rendered.bottom
        assert all(isfinite(tick.at) for tick in (*rendered.x_ticks, *rendered.y_ticks))


def test_a_line_is_broken_where_there_is_no_value_and_steps_hold() -> None:
    points = [(0.0, 0.0), (1.0, 1.0), (2.0, nan), (3.0, 1.0), (4.0, 2.0)]
    (line,) = charts.layout(Chart("t", "x", "y", (Series("s", points),), ""), charts.WIDE).paths
    assert line.d.count("M") == 2
    (steps,) = charts.layout(Chart("t", "x", "y", (Series("s", points, "steps"),), ""), charts.WIDE).paths
    assert steps.d.count("H") == steps.d.count("V") == 2


def test_names_of_marks_do_not_run_into_each_other() -> None:
    marks = tuple(Mark(at, "a long name") for at in (40.0, 41.0, 60.0, 99.0))
    chart = Chart("t", "x", "y", (Series("s", [(0.0, 0.0), (100.0, 1.0)]),), "", marks=marks)
    for size in (charts.WIDE, charts.NARROW):
        rendered = charts.layout(chart, size)
        reach = charts.LETTER_PX * len("a long name")
        spans = [
            (line.row_y, line.at if line.anchor == "start" else line.at - reach)
            for line in sorted(rendered.marks, key=str)
        ]
        for row, begin in spans:
            others = [other for other_row, other in spans if other_row == row and other != begin]
            assert all(abs(begin - other) >= reach for other in others)
        assert all(line.row_y < rendered.top for line in rendered.marks)
        assert all(begin >= 0 and begin + reach <= size.width for _, begin in spans)


def test_a_legend_names_everything_once() -> None:
    ground = (Ground(0.0, 1.0, "good", "healthy"), Ground(1.0, 2.0, "bad", "miscalibrated"))
    one = Chart("t", "x", "y", (Series("a", [(0.0, 0.0), (2.0, 1.0)]),), "", grounds=ground)
    assert [name for _, name in charts.legend([one, one])] == ["healthy", "miscalibrated"]


@pytest.mark.parametrize(
    ("shown", "expected"),
    [
        (number(-0.0004), "0.000"),
        (number(-1.5, 1, sign=True), "−1.5"),
        (number(None), NONE),
        (number(inf), NONE),
        (significant(0.0312), "0.0312"),
        (significant(57597.2), "57\N{NARROW NO-BREAK SPACE}597"),
        (significant(-123.4), "−123"),
        (significant(0.0), "0"),
        (significant(nan), NONE),
        (percent(0.5), "50.0\N{NARROW NO-BREAK SPACE}%"),
    ],
)
def test_numbers_as_they_are_shown(shown: str, expected: str) -> None:
    assert shown == expected


def test_figures_that_fail_come_first_with_what_to_do() -> None:
    metrics = {
        "overlap": MetricReply(value=0.9, limit=0.5, at_least=True, passed=True),
        "runner_up": MetricReply(value=0.95, limit=0.85, at_least=False, passed=False),
        "edge_score": MetricReply(value=3.0, limit=None, at_least=True, passed=True),
        "of_a_newer_version": MetricReply(value=None, limit=1.0, at_least=True, passed=False),
    }
    lines = {line.code: line for line in figures_block("", metrics).lines}
    assert next(iter(lines)) in ("runner_up", "of_a_newer_version")
    assert lines["runner_up"].advice == FIGURES["runner_up"].advice
    assert FIGURES["runner_up"].fails in lines["runner_up"].meaning
    assert (lines["overlap"].advice, lines["overlap"].met) == ("", True)
    assert lines["edge_score"].met is None
    assert lines["of_a_newer_version"].title == "of_a_newer_version"
    over, under = lines["overlap"].margin, lines["runner_up"].margin
    assert over is not None
    assert under is not None
    assert under < 0.5 < over


def test_every_picture_has_text() -> None:
    assert all(alt and caption.endswith(".") for alt, caption in CAPTIONS.values())


def test_the_page_of_a_large_fleet_is_small_and_says_what_it_leaves_out() -> None:
    days = tuple(
        DayOfPair(date=f"2026-{number // 28 + 1:02}-{number % 28 + 1:02}", windows=3, low=(-0.1,) * 6,
                  middle=(number / 100,) * 6, high=(0.1,) * 6)
        for number in range(300)
    )  # fmt: skip
    one = PairOfFleet(
        vehicle="shuttle", pair="front_left_wide", windows=900, accepted=800, errors=0, last_ns=10**18,
        latest=(0.1,) * 6, drift=(0.1234,) * 6, slope=(0.3,) * 6, worst="rx_deg", urgency=1.0, days=days,
    )  # fmt: skip
    pairs = tuple(
        one.model_copy(update={"vehicle": f"shuttle-of-the-north-{number:05}", "urgency": 3.0 * (1 - number / 10_000)})
        for number in range(10_000)
    )
    report = FleetReport(
        vehicles=10_000, pairs=pairs, windows=9_000_000, accepted=8_000_000,
        refusals={f"reason_{number}": number + 1 for number in range(1000)}, errors={}, first_ns=1, last_ns=10**18,
        figures=(), changes=None, false_alarms=None,
    )  # fmt: skip
    text = render(fleet_page.page(report, "Fleet", pages.MADE))
    assert len(text) < 3_000_000
    assert text.count('class="trend"') == fleet_page.PLOTTED
    assert text.count("shuttle-of-the-north-") >= fleet_page.PLOTTED + fleet_page.LISTED
    assert "8900 pairs more are not listed one by one" in text
    assert "coec fleet report RESULTS --sql" in text
    counted = [int(row) for row in re.findall(r'(?:and more|to [\d.]+)</td><td class="n">(\d+)</td>', text)]
    assert sum(counted) == 8900
