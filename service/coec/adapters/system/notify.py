"""The readiness protocol of systemd (sd_notify), without a library: one datagram to the socket in NOTIFY_SOCKET."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Mapping


class Notifier:
    """Tells the service manager the state of the process; does nothing if there is no manager."""

    def __init__(self, address: str | None) -> None:
        """`address` is the value of NOTIFY_SOCKET: a path, `@name` in the abstract namespace, or None."""
        self._address = "\0" + address[1:] if address and address.startswith("@") else address

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> Notifier:
        """The notifier of the manager that started this process."""
        return cls(environment.get("NOTIFY_SOCKET"))

    def starting(self, within_s: float) -> None:
        """The start makes progress; the next message comes within `within_s`."""
        self._send(f"EXTEND_TIMEOUT_USEC={round(within_s * 1e6)}")

    def ready(self) -> None:
        """The service answers and can calibrate."""
        self._send("READY=1")

    def reloading(self) -> None:
        """The configuration is being read again; call `ready` when that is done."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def watchdog(self) -> None:
        """Every thread has made progress since the last call."""
        self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """The shutdown has begun."""
        self._send("STOPPING=1")

    def _send(self, message: str) -> None:
        if not self._address:
            return
        # Go on calibrating even if the manager has gone.
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
            sock.connect(self._address)
            sock.send(message.encode())
