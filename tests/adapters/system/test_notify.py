"""What the service manager is told."""

from __future__ import annotations

import re
import socket
from pathlib import Path

import pytest

from coec.adapters.system.notify import Notifier


def test_the_manager_is_told_by_datagrams(tmp_path: Path) -> None:
    address = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(address)
        notifier = Notifier.from_environment({"NOTIFY_SOCKET": address})
        notifier.starting(20.0)
        notifier.ready()
        notifier.watchdog()
        notifier.stopping()
        told = [manager.recv(100) for _ in range(4)]
        assert told == [b"EXTEND_TIMEOUT_USEC=20000000", b"READY=1", b"WATCHDOG=1", b"STOPPING=1"]
        notifier.reloading()
        begins, stamp = manager.recv(100).split(b"\n")
        assert begins == b"RELOADING=1"
        assert re.fullmatch(rb"MONOTONIC_USEC=\d+", stamp)


@pytest.mark.fault("the service manager's socket vanishes", "no harm is done")
def test_no_manager_and_a_vanished_one_do_no_harm(tmp_path: Path) -> None:
    Notifier.from_environment({}).ready()
    Notifier(str(tmp_path / "gone")).ready()
    Notifier("@coec-test-nobody-listens").ready()
