"""What the service manager is told, and what the health check of a container reads."""

from __future__ import annotations

import os
import re
import socket
from pathlib import Path

import pytest

from coec.io.system import ServiceManagerNotifier


def test_the_manager_is_reported_by_datagrams(tmp_path: Path) -> None:
    address = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(address)
        notifier = ServiceManagerNotifier.from_environment({"NOTIFY_SOCKET": address})
        notifier.starting(20.0)
        notifier.ready()
        notifier.watchdog()
        notifier.stopping()
        reported = [manager.recv(100) for _ in range(4)]
        assert reported == [b"EXTEND_TIMEOUT_USEC=20000000", b"READY=1", b"WATCHDOG=1", b"STOPPING=1"]
        notifier.reloading()
        begins, stamp = manager.recv(100).split(b"\n")
        assert begins == b"RELOADING=1"
        assert re.fullmatch(rb"MONOTONIC_USEC=\d+", stamp)


@pytest.mark.fault("the service manager's socket vanishes", "no harm is done")
def test_no_manager_and_a_vanished_one_do_no_harm(tmp_path: Path) -> None:
    ServiceManagerNotifier.from_environment({}).ready()
    ServiceManagerNotifier(str(tmp_path / "gone")).ready()
    ServiceManagerNotifier("@coec-test-nobody-listens").ready()


@pytest.mark.parametrize(
    ("http", "line"),
    [
        (None, "-\n"),
        (("127.0.0.1", 9464), "127.0.0.1 9464\n"),
        (("0.0.0.0", 9464), "127.0.0.1 9464\n"),
        (("::", 1), "::1 1\n"),
        (("localhost", 9464), "localhost 9464\n"),
    ],
)
def test_the_heartbeat_says_where_pages_are_served(tmp_path: Path, http: tuple[str, int] | None, line: str) -> None:
    file = tmp_path / "heartbeat"
    ServiceManagerNotifier.from_environment({"COEC_HEARTBEAT_FILE": str(file)}).watchdog(http)
    assert file.read_text() == line


def test_the_heartbeat_is_renewed_follows_a_reload_and_goes_with_the_service(tmp_path: Path) -> None:
    file = tmp_path / "heartbeat"
    notifier = ServiceManagerNotifier(None, file)
    assert not file.exists(), "nothing has made progress"
    notifier.watchdog()
    os.utime(file, (0, 0))
    notifier.watchdog()
    assert file.stat().st_mtime > 0
    notifier.watchdog(("127.0.0.1", 1))
    assert file.read_text() == "127.0.0.1 1\n"
    file.unlink()
    notifier.watchdog(("127.0.0.1", 1))
    assert file.read_text() == "127.0.0.1 1\n", "somebody had removed it"
    notifier.stopping()
    assert not file.exists()


@pytest.mark.fault("a folder for the heartbeat that is absent or read-only", "no harm is done to the service")
def test_a_heartbeat_that_cannot_be_written_does_no_harm(tmp_path: Path) -> None:
    notifier = ServiceManagerNotifier(None, tmp_path / "absent" / "heartbeat")
    notifier.watchdog()
    notifier.stopping()


def test_a_link_in_the_place_of_the_heartbeat_is_not_followed(tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.write_text("untouched")
    (tmp_path / "heartbeat").symlink_to(other)
    ServiceManagerNotifier(None, tmp_path / "heartbeat").watchdog()
    assert other.read_text() == "untouched"
    assert (tmp_path / "heartbeat").read_text() == "-\n"
