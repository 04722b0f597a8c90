"""Prometheus itself: its tool reads the rules, plays alerts through and lints a page of metrics in the
older text format; its server scrapes a running service, in OpenMetrics."""

from __future__ import annotations

import json
import shutil
import subprocess
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from ruamel.yaml import YAML

from coec.cli.check_config import template
from conftest import REPOSITORY
from e2e.processes import COMMAND, PATIENCE_S, environment
from support.fake_worker import wait_until
from support.router import free_port

pytestmark = pytest.mark.slow

MONITORING = REPOSITORY / "deploy" / "monitoring"

ALERTS: tuple[tuple[str, str, str, str, dict[str, str]], ...] = (
    ("CoecMiscalibrated", 'coec_health{coec_health="miscalibrated"}', "0x4 1x30 0x30", "20m", {"pair": "front"}),
    ("CoecDown", 'up{job="coec"}', "1x4 0x30 1x30", "20m", {}),
    ("CoecSuspect", 'coec_health{coec_health="suspect"}', "0x4 1x30 0x30", "20m", {"pair": "front"}),
    ("CoecSensorSilent", 'coec_sample_age_seconds{stream="camera"}', "0x4 99x30 0x30", "20m", {"pair": "front"}),
    ("CoecDiskFull", "coec_storage_free_bytes", "9e9x4 1x30 9e9x30", "20m", {}),
)
"""Alert, its series, values a minute apart (quiet, failing, quiet again), when it must fire, its further labels. When
the values are right again it must go."""


def needed(program: str) -> str:
    detected = shutil.which(program)
    if detected is None:
        pytest.skip(f"needs {program} (Debian: apt-get install --no-install-recommends prometheus)")
    return detected


def promtool(*tokens: object, **options: Any) -> subprocess.CompletedProcess[str]:
    command = [needed("promtool"), *(str(word) for word in tokens)]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, **options)


@contextmanager
def serving(folder: Path) -> Iterator[int]:
    """A service with its own router, and the port of its pages."""
    document = YAML(typ="safe").load(template())
    port, http = free_port(), free_port()
    document["zenoh"] |= {"embedded_router": True, "listen": [f"tcp/127.0.0.1:{port}"]}
    document["state"] |= {"directory": "state", "min_free_bytes": 0}
    document["metrics"] = {"http": f"127.0.0.1:{http}"}
    document["pairs"][0]["calibration"]["depth"]["model"] = "stereo"
    with (folder / "coec.yaml").open("w") as stream:
        YAML().dump(document, stream)
    with (folder / "coec.log").open("wb") as log:
        command = [*COMMAND, "run", "--config", str(folder / "coec.yaml")]
        process = subprocess.Popen(command, stdout=log, stderr=log, env=environment())
    try:
        wait_until(lambda: _answers(http) or process.poll() is not None, "the pages of the service", PATIENCE_S)
        assert process.poll() is None, (folder / "coec.log").read_text()
        yield http
    finally:
        process.terminate()
        assert process.wait(PATIENCE_S) == 0


def _answers(port: int) -> bool:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/live", timeout=PATIENCE_S) as answer:
            return bool(answer.status == 200)
    except OSError:
        return False


def test_rules_and_configuration_are_read_without_a_complaint() -> None:
    for tokens in (
        ("check", "rules", "--lint=all", "--lint-fatal", MONITORING / "alerts.yml"),
        ("check", "config", "--lint=all", "--lint-fatal", MONITORING / "prometheus.yml"),
    ):
        finished = promtool(*tokens)
        assert finished.returncode == 0, finished.stdout + finished.stderr


@pytest.mark.fault(
    "a wrong calibration, a silent sensor, a full disk, a service that is gone", "its alert fires, and goes"
)
@pytest.mark.parametrize(("alert", "series", "values", "fires_at", "labels"), ALERTS, ids=[one[0] for one in ALERTS])
def test_alerts_fire_and_go(
    tmp_path: Path, alert: str, series: str, values: str, fires_at: str, labels: dict[str, str]
) -> None:
    rules = json.loads(json.dumps(YAML(typ="safe").load((MONITORING / "alerts.yml").read_text())))
    (rule,) = [rule for group in rules["groups"] for rule in group["rules"] if rule["alert"] == alert]
    name, _, inside = series.removesuffix("}").partition("{")
    given = {"vehicle": "truck", **labels, **dict(item.split("=") for item in inside.split(",") if item)}
    text = ",".join(f'{key}="{value.strip(chr(34))}"' for key, value in given.items())
    quiet = {"alertname": alert, "exp_alerts": []}
    # promtool compares annotations, too: what it prints of a rule that fires is compared with none, and read.
    document = {
        "rule_files": [str(MONITORING / "alerts.yml")],
        "evaluation_interval": "1m",
        "tests": [
            {
                "interval": "1m",
                "input_series": [{"series": f"{name}{{{text}}}", "values": values}],
                "alert_rule_test": [{"eval_time": "3m", **quiet}, {"eval_time": "1h", **quiet}],
            }
        ],
    }
    (tmp_path / "quiet.json").write_text(json.dumps(document))
    finished = promtool("test", "rules", tmp_path / "quiet.json")
    assert finished.returncode == 0, finished.stdout + finished.stderr
    document["tests"][0]["alert_rule_test"] = [{"eval_time": fires_at, **quiet}]  # type: ignore[index]
    (tmp_path / "firing.json").write_text(json.dumps(document))
    finished = promtool("test", "rules", tmp_path / "firing.json")
    assert finished.returncode != 0, "it does not fire"
    assert alert in finished.stdout + finished.stderr
    assert rule["labels"]["severity"] in finished.stdout + finished.stderr
    assert "truck" in finished.stdout + finished.stderr


def test_a_scrape_passes_the_lint_and_a_server_reads_both_formats(tmp_path: Path) -> None:
    prometheus = needed("prometheus")
    with serving(tmp_path) as port:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=PATIENCE_S) as answer:
            assert answer.headers["Content-Type"].startswith("text/plain; version=0.0.4")
            page = answer.read().decode()
        linted = promtool("check", "metrics", input=page)
        assert (linted.returncode, linted.stderr) == (0, "")
        own, document = free_port(), YAML(typ="safe").load((MONITORING / "prometheus.yml").read_text())
        document["scrape_configs"][0]["static_configs"][0]["targets"] = [f"127.0.0.1:{port}"]
        document["global"]["scrape_interval"] = "1s"
        shutil.copy(MONITORING / "alerts.yml", tmp_path)
        with (tmp_path / "prometheus.yml").open("w") as stream:
            YAML().dump(document, stream)
        command = [
            prometheus, f"--config.file={tmp_path}/prometheus.yml", f"--storage.tsdb.path={tmp_path}/data",
            f"--web.listen-address=127.0.0.1:{own}",
        ]  # fmt: skip
        with (tmp_path / "prometheus.log").open("wb") as log:
            server = subprocess.Popen(command, stdout=log, stderr=log, cwd=tmp_path)
        try:

            def value(expression: str) -> str | None:
                try:
                    url = f"http://127.0.0.1:{own}/api/v1/query?query={quote(expression)}"
                    with urllib.request.urlopen(url, timeout=PATIENCE_S) as answer:
                        result = json.load(answer)["data"]["result"]
                except OSError:
                    return None
                return result[0]["value"][1] if result else None

            wait_until(lambda: value('up{job="coec"}') == "1", "a scrape", PATIENCE_S)
            wait_until(lambda: value("coec_uptime_seconds") is not None, "a figure", PATIENCE_S)
            assert value('coec_health{coec_health="unknown",pair="front",vehicle="vehicle"}') == "1"
            assert value('coec_build_info{vehicle="vehicle"}') == "1"
        finally:
            server.terminate()
            server.wait(PATIENCE_S)
