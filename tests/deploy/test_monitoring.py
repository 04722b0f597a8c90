"""The dashboard, the alert rules and the scrape configuration as they are shipped: every metric, label and value of a
state in them is one that the service has. PromQL is read as far as that takes; Prometheus itself cannot be had here.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any, Final, get_args

import pytest

from coec.config import MetricsConfig, parse_yaml
from coec.schemas.replies import HealthState
from coec.service.api.metrics import FAMILIES
from conftest import REPOSITORY

MONITORING = REPOSITORY / "deploy" / "monitoring"
SUFFIXES: Final = {"counter": ("_total",), "info": ("_info",), "histogram": ("_bucket", "_count", "_sum")}
OF_SCRAPE = frozenset({"vehicle", "job", "instance"})
"""Labels that Prometheus adds, as `prometheus.yml` says."""

FUNCTIONS = frozenset(
    {"abs", "histogram_quantile", "increase", "label_replace", "label_values", "rate", "sum", "max", "min"}
)
TEXT = frozenset({"and", "or", "by", "on", "unless", "without", "le"})
DURATION = re.compile(r"\d+(ms|[smhdwy])")
TOKEN = re.compile(
    r"""\s+|(?P<text>"(?:[^"\\]|\\.)*")|(?P<variable>\$\w+)|(?P<duration>\d+(?:ms|[smhdwy])\b)|(?P<number>\d+(?:\.\d+)?)"""
    r"""|(?P<name>[A-Za-z_:][A-Za-z0-9_:]*)|(?P<operator>=~|!~|!=|==|>=|<=|[-+*/><=(){}\[\],])"""
)


class Metric:
    """What one name of the service's metrics may be asked by."""

    def __init__(self, labels: tuple[str, ...], kind: str) -> None:
        self.labels = frozenset(labels) | ({"le"} if kind == "histogram" else set()) | OF_SCRAPE


METRICS = {
    f"{family.name}{suffix}": Metric(family.labels, family.kind)
    for family in FAMILIES
    for suffix in SUFFIXES.get(family.kind, ("",))
} | {"up": Metric((), "gauge")}


def tokens(expression: str) -> list[tuple[str, str]]:
    result, at = [], 0
    while at < len(expression):
        match = TOKEN.match(expression, at)
        assert match is not None, f"not PromQL at {expression[at : at + 20]!r}"
        if match.lastgroup is not None:
            result.append((match.lastgroup, match[0]))
        at = match.end()
    return result


def check(expression: str) -> set[str]:
    """The metrics in an expression, each with its labels, of which there are all; brackets are paired."""
    result, wording = set(), tokens(expression)
    depth = []
    pairs = {")": "(", "}": "{", "]": "["}
    metric: Metric | None = None
    for index, (kind, text) in enumerate(wording):
        after = wording[index + 1][1] if index + 1 < len(wording) else ""
        if text in pairs.values() and kind == "operator":
            depth.append(text)
        elif text in pairs and kind == "operator":
            assert depth, expression
            assert depth.pop() == pairs[text], expression
        elif kind == "name" and depth[-1:] == ["{"]:
            assert metric is not None, f"{text} belongs to nothing in {expression}"
            assert text in metric.labels, f"{text} is no label there: {expression}"
            if text == "coec_health":
                requested = json.loads(wording[index + 2][1]).split("|")
                assert set(requested) <= set(get_args(HealthState)), expression
        elif kind == "name" and after in ("(", "by"):
            assert text in FUNCTIONS | {"by", "and", "or"}, f"{text} is no function of PromQL: {expression}"
        elif kind == "name" and text not in TEXT and not _is_grouping(wording, index):
            metric = METRICS.get(text)
            assert metric is not None, f"{text} is no metric of the service: {expression}"
            result.add(text)
        elif kind == "name" and _is_grouping(wording, index):
            assert any(text in one.labels for one in METRICS.values()), f"{text} is no label: {expression}"
    assert not depth, expression
    return result


def _is_grouping(wording: list[tuple[str, str]], index: int) -> bool:
    """Whether a name stands in the brackets behind `by`, or as the name behind a metric in `label_values`."""
    opened = 0
    for back in range(index - 1, -1, -1):
        opened += {")": 1, "(": -1}.get(wording[back][1], 0)
        if opened < 0:
            before = wording[back - 1][1] if back else ""
            return before == "by" or (before == "label_values" and wording[index - 1][1] == ",")
    return False


def dashboard() -> Any:
    return json.loads((MONITORING / "grafana-dashboard.json").read_text())


def alerts() -> list[dict[str, Any]]:
    groups = parse_yaml((MONITORING / "alerts.yml").read_text())["groups"]
    return [rule for group in groups for rule in group["rules"]]


def expressions_of_dashboard() -> Iterator[tuple[str, str]]:
    for panel in dashboard()["panels"]:
        for target in panel["targets"]:
            yield panel["title"], target["expr"]
    for variable in dashboard()["templating"]["list"]:
        if variable["type"] == "query":
            yield variable["name"], variable["query"]
    for annotation in dashboard()["annotations"]["list"]:
        yield annotation["name"], annotation["expr"]


def test_every_expression_of_the_dashboard_requests_what_there_is() -> None:
    requested = {name for _, expression in expressions_of_dashboard() for name in check(expression)}
    assert {"coec_health", "coec_drift", "coec_losses_total", "coec_query_seconds_bucket"} <= requested


def test_every_legend_names_labels_that_the_answer_has() -> None:
    for panel in dashboard()["panels"]:
        for target in panel["targets"]:
            metrics = check(target["expr"])
            known = frozenset.union(*(METRICS[name].labels for name in metrics))
            named = set(re.findall(r"\{\{(\w+)\}\}", target["legendFormat"]))
            assert named <= known, (panel["title"], named - known)


def test_panels_do_not_lie_on_each_other_and_choose_their_source() -> None:
    panels = dashboard()["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    cells = [
        (x, y)
        for panel in panels
        for x in range(panel["gridPos"]["x"], panel["gridPos"]["x"] + panel["gridPos"]["w"])
        for y in range(panel["gridPos"]["y"], panel["gridPos"]["y"] + panel["gridPos"]["h"])
    ]
    assert len(set(cells)) == len(cells)
    assert max(x for x, _ in cells) < 24, "a dashboard of Grafana has 24 columns"
    assert all(panel["datasource"]["uid"] == "${datasource}" for panel in panels)


def test_every_alert_requests_what_there_is_and_reports_what_to_do() -> None:
    names = [alert["alert"] for alert in alerts()]
    assert len(set(names)) == len(names) >= 10
    for alert in alerts():
        metrics = check(alert["expr"])
        assert metrics, alert["alert"]
        assert alert["labels"]["severity"] in ("page", "ticket")
        assert DURATION.fullmatch(alert.get("for", "1s"))
        known = frozenset.union(*(METRICS[name].labels for name in metrics)) | {"place"}
        reported = " ".join(alert["annotations"].values())
        assert set(re.findall(r"\$labels\.(\w+)", reported)) <= known, alert["alert"]
        assert set(alert["annotations"]) == {"summary", "description"}


def test_every_state_that_is_not_healthy_raises_an_alert() -> None:
    text = " ".join(alert["expr"] for alert in alerts())
    assert [state for state in get_args(HealthState) if state != "healthy" and state not in text] == []


def test_prometheus_scrapes_what_the_service_serves() -> None:
    document = parse_yaml((MONITORING / "prometheus.yml").read_text())
    assert document["rule_files"] == ["alerts.yml"]
    (job,) = document["scrape_configs"]
    (static,) = job["static_configs"]
    (target,) = static["targets"]
    assert MetricsConfig(http=target).address == ("127.0.0.1", 9464)
    assert job["metrics_path"] == "/metrics"
    assert static["labels"].keys() <= OF_SCRAPE
    assert {'job="coec"'} >= set(re.findall(r'job="\w+"', " ".join(alert["expr"] for alert in alerts())))


@pytest.mark.parametrize(
    "wrong",
    [
        "coec_helth == 1",
        'coec_health{coec_health="splendid"} == 1',
        'coec_health{axis="rx"} == 1',
        "sum by (nothing) (coec_pairs_total)",
        "rate(coec_pairs[5m])",
        "frobnicate(coec_uptime_seconds)",
        "(coec_uptime_seconds",
        "coec_uptime_seconds § 3",
    ],
)
def test_what_there_is_not_would_be_seen(wrong: str) -> None:
    with pytest.raises(AssertionError):
        check(wrong)
