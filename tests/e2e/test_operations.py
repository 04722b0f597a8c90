"""A service in the hands of those who look after it: without a router, reloaded, scraped."""

from __future__ import annotations

import http.client
import json
import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from coec.cli.check_config import template
from coec.cli.doctor import examine
from coec.config import LimitsConfig, SenderConfig, ZenohConfig, load_config
from coec.errors import NotProvenError, RemoteError
from coec.io.zenoh.bus import JSON, open_session
from coec.io.zenoh.command_auth import CommandSender
from coec.io.zenoh.query_client import query_one, send_authenticated
from e2e.processes import COMMAND, PATIENCE_S, Router, Service, environment
from support.fake_worker import wait_until
from support.readers import parse_open_metrics
from support.router import TestAuthority, free_port, make_authority

PAIR = "front"


def written(path: Path, endpoint: str, **changes: Any) -> None:
    """The template with other values, and this router."""
    document = YAML(typ="safe").load(template())
    document["zenoh"] |= {"connect": [endpoint], "listen": [endpoint]}
    document["state"] |= {"directory": "state", "min_free_bytes": 0}
    document["pairs"][0]["calibration"]["depth"]["model"] = "stereo"
    for place, value in changes.items():
        *head, last = place.split("__")
        inside = document
        for name in head:
            inside = inside[int(name)] if name.isdigit() else inside[name]
        inside[last] = value
    with path.open("w") as stream:
        YAML().dump(document, stream)


@contextmanager
def process(config: Path) -> Iterator[subprocess.Popen[bytes]]:
    with config.with_name("coec.log").open("wb") as log:
        command = [*COMMAND, "run", "--config", str(config)]
        running = subprocess.Popen(command, stdout=log, stderr=log, env=environment())
    try:
        yield running
    finally:
        running.kill()
        running.wait()


def page(port: int, path: str) -> tuple[int, str]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    connection.request("GET", path, headers={"Accept": "application/openmetrics-text"})
    answer = connection.getresponse()
    reported = answer.status, answer.read().decode()
    connection.close()
    return reported


@pytest.mark.fault(
    "no router when the service starts",
    "the log says where it is looked for; when a router comes the service answers, and the complaint is withdrawn",
)
def test_no_router_then_one_then_other_settings(tmp_path: Path) -> None:
    endpoint, port = f"tcp/127.0.0.1:{free_port()}", free_port()
    path = tmp_path / "coec.yaml"
    written(path, endpoint)
    log = tmp_path / "coec.log"
    with process(path) as started:

        def complains() -> bool:
            assert started.poll() is None, log.read_text()
            return f"no router at {endpoint}, trying again" in log.read_text()

        wait_until(complains, "the complaint", PATIENCE_S)
        with open_session(ZenohConfig(embedded_router=True, listen=(endpoint,)), LimitsConfig()) as session:
            running = Service(started, session, load_config(path), log)
            running.until(
                running.status,
                lambda status: "no_router" not in [reason["code"] for reason in status["reasons"]],
                "a router that is there",
            )
            assert f"the router at {endpoint} is there" in log.read_text()
            _reload(running, path, endpoint, port)
            assert running.terminate() == 0


@pytest.mark.fault(
    "certificates that expire on a vehicle that runs for months, and one that cannot be read",
    "they are renewed by SIGHUP; what cannot be read changes nothing, and status says why",
)
def test_who_may_give_commands_is_read_again(
    tmp_path: Path, router: Router, authority: TestAuthority, record_property: Any
) -> None:
    path, ours = tmp_path / "coec.yaml", tmp_path / "tls"
    others = make_authority(tmp_path / "others")
    shutil.copytree(authority.folder, ours)
    written(path, router.endpoint)
    with process(path) as started:
        running = Service(started, router.session, load_config(path), tmp_path / "coec.log")
        hold = f"{running.keys.command(PAIR, 'hold')}?format=json"

        def after(signals: int) -> dict[str, Any]:
            running.process.send_signal(signal.SIGHUP)
            reported = running.until(
                lambda: running.status()["configuration"],
                lambda reported: reported["reloads"] == signals or reported["refused"] is not None,
                "the reload",
            )
            return dict(reported)

        def may_hold(by: TestAuthority | None) -> bool:
            try:
                if by is None:
                    query_one(router.session, hold, PATIENCE_S)
                else:
                    speaker = CommandSender(by.credentials("operator"), "vehicle")
                    send_authenticated(router.session, hold, None, PATIENCE_S, speaker, JSON)
            except (NotProvenError, RemoteError):
                return False
            return True

        running.until(running.status, bool, "an answer")
        assert may_hold(None)
        own = TestAuthority(ours).of_service(SenderConfig(name="operator", commands=("hold",)))
        written(path, router.endpoint, authority=own.model_dump(mode="json"))
        assert set(after(1)["taken"]) == {f"authority.{name}" for name in type(own).model_fields}
        assert (may_hold(None), may_hold(authority), may_hold(others)) == (False, True, False)

        for file in ("vehicle.pem", "vehicle-key.pem", "ca.pem"):
            shutil.copy(others.folder / file, ours / file)
        assert after(2)["taken"] == ["authority.certificate"]
        assert (may_hold(None), may_hold(authority), may_hold(others)) == (False, False, True)

        (ours / "vehicle.pem").write_text("no certificate")
        refused = after(3)
        assert (refused["reloads"], "vehicle.pem" in refused["refused"]) == (2, True)
        assert (may_hold(None), may_hold(authority), may_hold(others)) == (False, False, True)
        record_property("figure", "3 reloads, 9 commands")


def _reload(running: Service, path: Path, endpoint: str, port: int) -> None:
    """What is taken, what waits, and what is refused: over the wire, in the log, at the port."""
    before = running.status()
    assert before["configuration"]["reloads"] == 0

    written(path, endpoint, metrics__http=f"127.0.0.1:{port}", pairs__0__policy__apply="never", worker__threads=1)
    running.process.send_signal(signal.SIGHUP)
    status = running.until(running.status, lambda status: status["configuration"]["reloads"] == 1, "the reload")
    assert status["configuration"]["taken"] == ["metrics.http", f"pairs.{PAIR}.policy.apply"]
    assert status["configuration"]["waiting"] == ["worker.threads"]
    assert status["config_hash"] != before["config_hash"]
    shown = running.query(running.keys.config)
    assert shown["config_hash"] == status["config_hash"]
    assert shown["config"]["pairs"][0]["policy"]["apply"] == "never"
    (entry,) = running.until(lambda: running.entries("command"), bool, "the entry of the history")
    assert (entry["code"], entry["sender"]) == ("reloaded", "SIGHUP")
    assert status["config_hash"] in entry["text"]

    reported, text = page(port, "/metrics")
    families = parse_open_metrics(text)
    assert reported == 200
    assert families["coec_query_seconds"].value("_count", resource="status") > 0
    assert page(port, "/live")[0] == 200
    assert page(port, "/health")[0] == 503, "nobody has looked yet"
    assert json.loads(page(port, "/health")[1])["pairs"][PAIR]["state"] == "unknown"
    assert page(port, "/config")[0] == 404

    _examined(path)

    path.write_text("pairs: []\n")
    running.process.send_signal(signal.SIGHUP)
    refused = running.until(running.status, lambda status: status["configuration"]["refused"], "the refusal")
    assert refused["config_hash"] == status["config_hash"]
    assert refused["configuration"]["taken"] == status["configuration"]["taken"]
    assert "is invalid, the previous one remains in force" in running.log.read_text()
    assert page(port, "/metrics")[0] == 200


def _examined(path: Path) -> None:
    """What the doctor finds beside the service."""
    result = list(examine(path, 0.5))
    first = {one.check: one for one in reversed(result)}
    assert first["service"].text.startswith("version ")
    assert (first["reload"].level, first["reload"].text) == ("warn", "waits for a restart: worker.threads")
    assert first["health"].level == "warn", "nobody has looked yet"
    assert "10 more pairs" in first["next_window"].text
    assert first["lock"].text.endswith("a service runs here")
    assert first["rules"].level == "ok"
    assert first["stream"].level == "fail", "no sensor sends"
