"""How the manager of the process learns its state.

systemd: its readiness protocol (sd_notify), without a library: one datagram to the socket in NOTIFY_SOCKET. A container
engine runs a command now and then (HEALTHCHECK), which needs something to look at: the file in COEC_HEARTBEAT_FILE. The
time of the file is that of the last progress. Its line is the address of the HTTP pages, `HOST PORT`, or `-` if there
are none.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Mapping
from pathlib import Path

from coec.adapters.files import durable

LOOPBACK_OF_WILDCARD = {"0.0.0.0": "127.0.0.1", "::": "::1"}
"""Addresses on which a server listens everywhere, and those at which the same computer reaches it."""


class ServiceManagerNotifier:
    """Tells the service manager the state of the process; does nothing if there is no manager."""

    def __init__(self, address: str | None, heartbeat: Path | None = None) -> None:
        """`address` is the value of NOTIFY_SOCKET: a path, `@name` in the abstract namespace, or None. `heartbeat` is
        the file in memory for a health check; None: nobody looks at one."""
        self._address = "\0" + address[1:] if address and address.startswith("@") else address
        self._heartbeat = heartbeat
        self._written: bytes | None = None

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> ServiceManagerNotifier:
        """The notifier of the manager that started this process."""
        heartbeat = environment.get("COEC_HEARTBEAT_FILE")
        return cls(environment.get("NOTIFY_SOCKET"), Path(heartbeat) if heartbeat else None)

    def starting(self, within_s: float) -> None:
        """The start makes progress; the next message comes within `within_s`."""
        self._send(f"EXTEND_TIMEOUT_USEC={round(within_s * 1e6)}")

    def ready(self) -> None:
        """The service answers and can calibrate."""
        self._send("READY=1")

    def reloading(self) -> None:
        """The configuration is being read again; call `ready` when that is done."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def watchdog(self, http: tuple[str, int] | None = None) -> None:
        """Every thread has made progress since the last call. `http` is where the HTTP pages are served; None:
        nowhere."""
        self._send("WATCHDOG=1")
        self._beat(b"-\n" if http is None else f"{LOOPBACK_OF_WILDCARD.get(http[0], http[0])} {http[1]}\n".encode())

    def stopping(self) -> None:
        """The shutdown has begun."""
        self._send("STOPPING=1")
        if self._heartbeat is not None:
            with contextlib.suppress(OSError):
                self._heartbeat.unlink(missing_ok=True)

    def _beat(self, line: bytes) -> None:
        """Renews the time of the file, and writes it if its line has changed or the file has gone."""
        if self._heartbeat is None:
            return
        with contextlib.suppress(OSError):
            if line == self._written:
                with contextlib.suppress(FileNotFoundError):
                    os.utime(self._heartbeat, follow_symlinks=False)
                    return
            durable.replace(self._heartbeat, line)
            self._written = line

    def _send(self, message: str) -> None:
        if not self._address:
            return
        # Go on calibrating even if the manager has gone.
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
            sock.connect(self._address)
            sock.send(message.encode())
