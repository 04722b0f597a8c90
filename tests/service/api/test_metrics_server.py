"""What is told over HTTP: a calibration that may be used is 200, one that is not known to be right is 503."""

from __future__ import annotations

import json
import logging
import socket
from collections.abc import Iterator
from itertools import count

import pytest
from pydantic import ValidationError

from coec.config import MetricsConfig
from coec.service.api.metrics import TextFormat
from coec.service.api.metrics_server import HttpRequest, HttpResponse, MetricsServer, accepted_format, pages
from coec.service.api.problems import RouterMonitor
from service.api.test_metrics import a_busy_status, a_health
from support.router import free_port


def health_page(state: str, **healths: tuple[str, int]) -> HttpResponse:
    known = {name: a_health(*health) for name, health in healths.items()}
    page = pages(lambda _: b"", lambda: (a_busy_status(state), known), lambda: True)(HttpRequest("/health"))
    assert page is not None
    return page


def test_health_is_good_when_every_pair_may_be_used() -> None:
    assert health_page("running", front=("healthy", 0), rear=("suspect", 1)).status == 200
    for state, level in (("miscalibrated", 2), ("stale", 3), ("unknown", 3)):
        page = health_page("running", front=("healthy", 0), rear=(state, level))
        assert page.status == 503
        assert json.loads(page.body)["pairs"]["rear"]["state"] == state
    assert health_page("starting", front=("healthy", 0)).status == 503


def test_there_are_three_pages() -> None:
    find = pages(lambda form: form.name.encode(), lambda: (a_busy_status(), {}), lambda: True)
    plain, requested = find(HttpRequest("/metrics")), find(HttpRequest("/metrics", "application/openmetrics-text"))
    assert plain is not None
    assert requested is not None
    assert (plain.body, plain.content_type) == (b"PROMETHEUS", "text/plain; version=0.0.4; charset=utf-8")
    assert requested.body == b"OPEN_METRICS"
    assert requested.content_type == "application/openmetrics-text; version=1.0.0; charset=utf-8"
    assert [find(HttpRequest(path)) for path in ("/", "/metrics/", "/config", "")] == [None] * 4


@pytest.mark.parametrize(("alive", "status"), [(True, 200), (False, 503)])
def test_a_service_that_is_stuck_is_not_alive_whatever_its_pairs_are(alive: bool, status: int) -> None:
    page = pages(lambda _: b"", lambda: (a_busy_status(), {}), lambda: alive)(HttpRequest("/live"))
    assert page is not None
    assert page.status == status


PROMETHEUS_2 = (
    "application/openmetrics-text;version=1.0.0,application/openmetrics-text;version=0.0.1;q=0.75,"
    "text/plain;version=0.0.4;q=0.5,*/*;q=0.1"
)
PROMETHEUS_3 = (
    "application/openmetrics-text;version=1.0.0;escaping=allow-utf-8;q=0.5,application/openmetrics-text;"
    "version=0.0.1;q=0.4,text/plain;version=1.0.0;escaping=allow-utf-8;q=0.3,text/plain;version=0.0.4;q=0.2,*/*;q=0.1"
)


@pytest.mark.parametrize(
    "accept",
    [PROMETHEUS_2, PROMETHEUS_3, "Application/OpenMetrics-Text", "a/b;q=x, application/openmetrics-text;q=0.001"],
)
def test_open_metrics_is_for_readers_that_prefer_it(accept: str) -> None:
    assert accepted_format(accept) is TextFormat.OPEN_METRICS


@pytest.mark.parametrize(
    "accept",
    [
        "",
        "*/*",
        "text/html,application/xhtml+xml,*/*;q=0.8",
        "text/plain",
        "image/png",
        "application/openmetrics-text;q=0",
        "application/openmetrics-text;q=0.2,text/plain;q=0.3",
        "application/openmetrics-text; q = often",
        "application/openmetrics-text;q=nan",
        ",;=,;;q",
    ],
)
def test_everybody_else_reads_plain_text(accept: str) -> None:
    assert accepted_format(accept) is TextFormat.PROMETHEUS


@pytest.mark.parametrize("http", ["127.0.0.1:9464", "localhost:9464", "[::1]:9464", "127.8.8.8:1"])
def test_loopback_is_nobody_elses(http: str) -> None:
    assert not MetricsConfig(http=http).is_open


@pytest.mark.parametrize("http", ["0.0.0.0:9464", "[::]:9464", "10.0.0.1:9464", "vehicle:9464"])
@pytest.mark.fault("metrics over HTTP that other computers reach", "refused unless `metrics.insecure` spells it out")
def test_an_open_door_is_refused_unless_spelled_out(http: str) -> None:
    with pytest.raises(ValidationError, match=r"metrics\.insecure"):
        MetricsConfig(http=http)
    assert MetricsConfig(http=http, insecure=True).is_open


@pytest.mark.parametrize("http", ["9464", "127.0.0.1", "127.0.0.1:0", "127.0.0.1:70000", "::1:9464", "a b:1", ":9464"])
def test_what_is_no_address_is_refused(http: str) -> None:
    with pytest.raises(ValidationError, match="HOST:PORT"):
        MetricsConfig(http=http, insecure=True)


@pytest.fixture
def door() -> Iterator[MetricsServer]:
    made = MetricsServer(lambda _: HttpResponse(200, b"", "text/plain"))
    yield made
    assert made.close(20.0)


def answers(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), 1.0).close()
    except OSError:
        return False
    return True


def test_the_door_follows_the_configuration(door: MetricsServer) -> None:
    first, second = free_port(), free_port()
    door.reconfigure(MetricsConfig(http=f"127.0.0.1:{first}"))
    assert answers(first)
    door.reconfigure(MetricsConfig(http=f"127.0.0.1:{second}"))
    assert (answers(first), answers(second)) == (False, True)
    door.reconfigure(MetricsConfig())
    assert not answers(second)
    assert (door.problem, door.insecure) == (None, None)
    door.reconfigure(MetricsConfig(http=f"0.0.0.0:{first}", insecure=True))
    assert door.insecure is not None
    assert door.insecure.code == "http_insecure"


@pytest.mark.fault(
    "the port of the metrics is taken",
    "status says so; the calibration goes on, and the port is tried again with the next reload",
)
def test_a_taken_port_is_a_problem_and_no_end(door: MetricsServer) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        door.reconfigure(MetricsConfig(http=f"127.0.0.1:{port}"))
        assert door.server is None
        assert door.problem is not None
        assert door.problem.code == "http_unavailable"
    door.reconfigure(MetricsConfig(http=f"127.0.0.1:{port}"))  # asked again, it is tried again
    assert door.problem is None
    assert answers(port)


def test_a_router_that_is_away_is_reported_once_each_time(caplog: pytest.LogCaptureFixture) -> None:
    there = iter([False, False, True, True, False, True])
    clock = count(100, 10)
    watch = RouterMonitor(("tcp/10.0.0.1:7447",), lambda: next(there), lambda: float(next(clock)))
    codes = []
    with caplog.at_level(logging.INFO):
        for _ in range(6):
            watch.check()
            codes.append(watch.problem and watch.problem.code)
    assert codes == ["no_router", "no_router", None, None, "no_router", None]
    assert caplog.messages == [
        "no router at tcp/10.0.0.1:7447, trying again",
        "the router at tcp/10.0.0.1:7447 is there again, after 20 s",
        "the router has gone: none at tcp/10.0.0.1:7447, trying again",
        "the router at tcp/10.0.0.1:7447 is there again, after 10 s",
    ]


@pytest.mark.fault("a night without a router", "health has the reason; the log repeats it at growing intervals")
def test_a_night_without_a_router_is_a_few_lines(caplog: pytest.LogCaptureFixture) -> None:
    clock = count(0)
    watch = RouterMonitor(("tcp/10.0.0.1:7447",), lambda: False, lambda: float(next(clock)))
    with caplog.at_level(logging.INFO):
        for _ in range(8 * 3600):
            watch.check()
    reported = [message for message in caplog.messages if "trying again" in message]
    assert reported == caplog.messages
    assert reported[1] == "no router at tcp/10.0.0.1:7447 for 60 s, trying again"
    assert reported[2] == "no router at tcp/10.0.0.1:7447 for 180 s, trying again"
    assert 8 <= len(reported) <= 20
    assert watch.problem is not None


def test_who_is_the_router_itself_misses_none() -> None:
    watch = RouterMonitor((), lambda: False)
    watch.check()
    assert watch.problem is None
