"""What a service tells its manager: the socket of sd_notify, read as fast as it is written."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def listening(path: Path) -> Iterator[list[str]]:
    """The messages that come to a NOTIFY_SOCKET, in order; any user may write to it."""
    reported: list[str] = []
    finished = threading.Event()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind(str(path))
        path.chmod(0o666)
        sock.settimeout(0.2)

        def read() -> None:
            while not finished.is_set():
                with suppress(TimeoutError):
                    reported.append(sock.recv(4096).decode())

        thread = threading.Thread(target=read)
        thread.start()
        try:
            yield reported
        finally:
            finished.set()
            thread.join()
            path.unlink()
