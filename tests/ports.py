"""Ports of loopback for tests that start a router, and what lies between it and who has stopped reading."""

from __future__ import annotations

import socket
import threading
from contextlib import ExitStack, suppress


def free_port() -> int:
    """A TCP port that nobody listened on a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class Relay:
    """A port of loopback before another one: one connection, of which the way back can be stopped."""

    def __init__(self, port: int) -> None:
        """`port`: where the connection goes on to."""
        self._target = port
        self._sockets = ExitStack()
        self._both: tuple[socket.socket, ...] = ()
        self._reads = threading.Event()
        self._reads.set()
        self._listener = self._sockets.enter_context(socket.create_server(("127.0.0.1", 0)))
        self._threads = [threading.Thread(target=self._accept)]
        self.port: int = self._listener.getsockname()[1]

    def __enter__(self) -> Relay:
        self._threads[0].start()
        return self

    def __exit__(self, *raised: object) -> None:
        self._reads.set()
        for one in (*self._both, self._listener):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        self._sockets.close()

    def stop_reading(self) -> None:
        """Nothing of what the other side sends is taken any more."""
        self._reads.clear()

    def _accept(self) -> None:
        with suppress(OSError):  # nobody came
            near = self._sockets.enter_context(self._listener.accept()[0])
            far = self._sockets.enter_context(socket.create_connection(("127.0.0.1", self._target)))
            self._both = (near, far)
            back = threading.Thread(target=self._pump, args=(far, near, self._reads))
            self._threads.append(back)
            back.start()
            always = threading.Event()
            always.set()
            self._pump(near, far, always)

    @staticmethod
    def _pump(source: socket.socket, sink: socket.socket, allowed: threading.Event) -> None:
        with suppress(OSError):
            while allowed.wait() and (data := source.recv(2**16)):
                sink.sendall(data)
