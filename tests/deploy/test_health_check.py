"""The health check of the image, by the very command of the Dockerfile: it tells a service that makes progress from one
that does not, with HTTP and without.
"""

from __future__ import annotations

import os
import socket
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from coec.io.system import ServiceManagerNotifier
from coec.service.api.metrics_server import HttpResponse, HttpServer, pages
from deploy.written import DEPLOY, compose, stages
from service.api.test_metrics import a_busy_status, a_health
from support.router import free_port

Record = Callable[[str, object], None]
"""pytest's `record_property`."""

PATIENCE_S = 60.0


def checked(heartbeat: Path) -> tuple[int, str]:
    """Exit status and words of the health check, which finds its program where the image has it: in the PATH."""
    command = stages()[-1].health_check
    environment = {"PATH": f"{DEPLOY}:{os.defpath}", "COEC_HEARTBEAT_FILE": str(heartbeat)}
    finished = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE_S)
    assert finished.stderr == ""
    return finished.returncode, finished.stdout


@pytest.fixture
def heartbeat(tmp_path: Path) -> Path:
    return tmp_path / "heartbeat"


@contextmanager
def serving(host: str, *, alive: bool = True) -> Iterator[tuple[str, int]]:
    """The pages of a service whose only pair is miscalibrated, and whether it makes progress."""
    health = {"front": a_health("miscalibrated", 2)}
    address = host, free_port()
    server = HttpServer(*address, pages(lambda _: b"", lambda: (a_busy_status(), health), lambda: alive))
    server.thread.start()
    try:
        yield address
    finally:
        assert server.close(PATIENCE_S)


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0", "localhost", "::1", "::"])
def test_a_service_that_serves_pages_is_requested_one(heartbeat: Path, host: str) -> None:
    if ":" in host and not socket.has_ipv6:
        pytest.skip("needs IPv6")
    with serving(host) as address:
        ServiceManagerNotifier(None, heartbeat).watchdog(address)
        status, text = checked(heartbeat)
    assert (status, "answers" in text) == (0, True), text


@pytest.mark.fault(
    "a container whose camera has moved, or whose pairs nobody has looked at",
    "its health check holds: no restart would cure it",
)
def test_what_a_service_thinks_of_its_pairs_does_not_matter(heartbeat: Path, record_property: Record) -> None:
    with serving("127.0.0.1") as address:
        ServiceManagerNotifier(None, heartbeat).watchdog(address)
        before = os.times()
        assert checked(heartbeat)[0] == 0
        after = os.times()
    spent_s = after.children_user + after.children_system - before.children_user - before.children_system
    record_property("figure", f"{1e3 * spent_s:.0f} ms of a processor")


@pytest.mark.fault(
    "a service in a container that is stuck, with HTTP and without, or whose page nobody answers",
    "the health check of the image fails, and says why",
)
def test_a_service_that_is_stuck_is_not_alive(heartbeat: Path) -> None:
    notifier = ServiceManagerNotifier(None, heartbeat)
    with serving("127.0.0.1", alive=False) as address:
        notifier.watchdog(address)
        assert checked(heartbeat) == (1, f"stuck: 127.0.0.1:{address[1]} answers 503\n")
    assert checked(heartbeat) == (1, f"nothing listens on 127.0.0.1:{address[1]}\n")
    notifier.watchdog(None)
    os.utime(heartbeat, (0, 0))
    status, text = checked(heartbeat)
    assert (status, text.startswith("stuck: the last heartbeat is ")) == (1, True)


def test_without_http_the_heartbeat_is_checked(heartbeat: Path) -> None:
    ServiceManagerNotifier(None, heartbeat).watchdog(None)
    status, text = checked(heartbeat)
    assert (status, text.startswith("alive: the last heartbeat is ")) == (0, True)


@pytest.mark.parametrize("content", [None, "", "no address\n", "127.0.0.1\n", "$(touch /tmp/x) 1\n", "a b c\n"])
def test_no_heartbeat_or_a_damaged_one_is_no_life(heartbeat: Path, content: str | None) -> None:
    if content is not None:
        heartbeat.write_text(content)
    assert checked(heartbeat)[0] == 1


def test_a_service_that_ends_takes_its_heartbeat_along(heartbeat: Path) -> None:
    notifier = ServiceManagerNotifier(None, heartbeat)
    notifier.watchdog(None)
    notifier.stopping()
    status, text = checked(heartbeat)
    assert (status, text.startswith("no heartbeat")) == (1, True)


def test_no_health_check_that_runs_often_starts_an_interpreter() -> None:
    image = stages()[-1]
    assert image.environment["COEC_HEARTBEAT_FILE"].startswith("/dev/shm/"), "memory, of the container's own"
    assert any(step.text == "deploy/check-live /opt/coec/bin/check-live" for step in image.steps)
    commands = {"image": image.health_check, "router": compose()["router"]["healthcheck"]["test"]}
    for name, command in commands.items():
        assert not {"python", "coec"} & set(command), name


def test_the_page_of_another_program_is_no_life(heartbeat: Path) -> None:
    server = HttpServer("127.0.0.1", free_port(), lambda _: HttpResponse(404, b"", "text/plain"))
    server.thread.start()
    try:
        ServiceManagerNotifier(None, heartbeat).watchdog(("127.0.0.1", int(server._listener.getsockname()[1])))
        assert checked(heartbeat)[0] == 1
    finally:
        server.close(PATIENCE_S)
