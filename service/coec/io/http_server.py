"""A small HTTP server for a scraper on the same computer: GET or HEAD, one answer, end of the connection.

One thread serves all connections and waits for none of them. Slow clients have a deadline, and if there are too many
connections the oldest is dropped. Requests are not kept. Only their method, path and `Accept` are used.
"""

from __future__ import annotations

import contextlib
import logging
import selectors
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from coec.errors import UnavailableError
from coec.io.system import ServiceThread

_log = logging.getLogger(__name__)

MAX_CONNECTIONS = 16
"""Most connections at once; a scraper has one, for milliseconds."""

MAX_REQUEST_BYTES = 4096
"""Most bytes of request line and headers; a scraper sends 200 to 400."""

DEADLINE_S = 3.0
"""Longest duration of a connection; on the same computer it takes milliseconds."""

POLL_S = 0.2

REASONS = {
    200: "OK",
    400: "Bad Request",
    404: "Not Found",
    405: "Method Not Allowed",
    500: "Internal Server Error",
    503: "Service Unavailable",
}

METHODS = (b"GET", b"HEAD")
"""The methods that are answered. `HEAD` gets the head of the answer to `GET`."""


@dataclass(frozen=True, slots=True)
class HttpRequest:
    """The parts of a request that an answer depends on.

    Attributes:
        path: path without the query.
        accept: value of the header `Accept`; several such headers are joined by commas. Empty: there is none.
    """

    path: str
    accept: str = ""


@dataclass(frozen=True, slots=True)
class HttpResponse:
    """An answer."""

    status: int
    body: bytes
    content_type: str


@dataclass(slots=True, eq=False)
class _Connection:
    socket: socket.socket
    since_s: float
    received: bytearray = field(default_factory=bytearray)
    unsent: memoryview | None = None


class HttpServer:
    """Listens from construction until `close`; answers while `thread` runs."""

    def __init__(self, host: str, port: int, find: Callable[[HttpRequest], HttpResponse | None]) -> None:
        """`find(request)` is called on the thread; for None the answer is 404.

        Raises:
            UnavailableError: it is not possible to listen there.
        """
        self._find = find
        self._listener = _listening(host, port)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._connections: list[_Connection] = []
        self.thread = ServiceThread("http", self._run)

    def close(self, deadline_s: float) -> bool:
        """Stop listening and drop all connections; False if the thread did not end within the deadline."""
        self.thread.request_stop()
        joined = self.thread.join(deadline_s)
        if joined:
            self._close_all()
        return joined

    # --- on the thread ----------------------------------------------------------------------------------------------

    def _run(self, thread: ServiceThread) -> None:
        while not thread.stopping:
            thread.beat()
            for key, _ in self._selector.select(POLL_S):
                if key.data is None:
                    self._accept()
                elif key.data.socket.fileno() >= 0:  # not dropped meanwhile, to make room
                    self._serve(key.data)
            now_s = time.monotonic()
            for late in [one for one in self._connections if now_s - one.since_s > DEADLINE_S]:
                self._drop(late)

    def _accept(self) -> None:
        try:
            accepted, _ = self._listener.accept()
        except OSError:  # the client has gone, or the process has no descriptor left: go on with the others
            return
        accepted.setblocking(False)
        if len(self._connections) >= MAX_CONNECTIONS:
            self._drop(self._connections[0])
        connection = _Connection(accepted, time.monotonic())
        self._connections.append(connection)
        self._selector.register(accepted, selectors.EVENT_READ, connection)

    def _serve(self, connection: _Connection) -> None:
        try:
            if connection.unsent is None:
                self._receive(connection)
            if connection.unsent is not None:
                self._send(connection)
        except BlockingIOError:
            pass
        except OSError:
            self._drop(connection)

    def _receive(self, connection: _Connection) -> None:
        received = connection.socket.recv(MAX_REQUEST_BYTES)
        if not received:
            self._drop(connection)
            return
        connection.received += received
        complete = b"\r\n\r\n" in connection.received
        if not complete and len(connection.received) < MAX_REQUEST_BYTES:
            return
        too_long = _plain(400, "The request is too long.\n")
        answer = self._answer(bytes(connection.received)) if complete else _response_bytes(too_long)
        connection.unsent = memoryview(answer)
        self._selector.modify(connection.socket, selectors.EVENT_WRITE, connection)

    def _answer(self, request: bytes) -> bytes:
        """The bytes of the answer to a request whose head is complete."""
        head = request.partition(b"\r\n\r\n")[0]
        first, *headers = head.split(b"\r\n")
        parts = first.split(b" ")
        if len(parts) != 3 or not parts[2].startswith(b"HTTP/1."):
            return _response_bytes(_plain(400, "This is no request.\n"))
        method = parts[0]
        if method not in METHODS:
            return _response_bytes(_plain(405, "Pages are read with GET or HEAD.\n"), allowed=METHODS)
        path = parts[1].partition(b"?")[0].decode("latin-1")
        try:
            page = self._find(HttpRequest(path, _values(headers, b"accept")))
        except Exception:
            _log.exception("a page could not be made", extra={"fields": {"path": path[:64]}})
            page = _plain(500, "The service failed on this page; its log says why.\n")
        return _response_bytes(page or _plain(404, "There is no such page.\n"), with_body=method != b"HEAD")

    def _send(self, connection: _Connection) -> None:
        assert connection.unsent is not None
        sent = connection.socket.send(connection.unsent)
        connection.unsent = connection.unsent[sent:]
        if not connection.unsent:
            with contextlib.suppress(OSError):
                connection.socket.shutdown(socket.SHUT_WR)
            self._drop(connection)

    def _drop(self, connection: _Connection) -> None:
        self._connections.remove(connection)
        self._selector.unregister(connection.socket)
        connection.socket.close()

    def _close_all(self) -> None:
        for connection in list(self._connections):
            self._drop(connection)
        self._selector.close()
        self._listener.close()


def _listening(host: str, port: int) -> socket.socket:
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        made = socket.create_server((host, port), family=family, backlog=MAX_CONNECTIONS)
    except OSError as error:
        raise UnavailableError(f"nobody can listen on {host}:{port}: {error.strerror or error}") from error
    made.setblocking(False)
    return made


def _plain(status: int, text: str) -> HttpResponse:
    return HttpResponse(status, text.encode(), "text/plain; charset=utf-8")


def _values(headers: Sequence[bytes], name: bytes) -> str:
    """All values of a header, joined by commas."""
    split = (line.partition(b":") for line in headers)
    return ",".join(value.strip().decode("latin-1") for key, _, value in split if key.strip().lower() == name)


def _response_bytes(page: HttpResponse, *, with_body: bool = True, allowed: Sequence[bytes] = ()) -> bytes:
    """The bytes of an answer. Without its body it has the head that it would have with it."""
    allow = f"Allow: {', '.join(method.decode() for method in allowed)}\r\n" if allowed else ""
    head = (
        f"HTTP/1.1 {page.status} {REASONS[page.status]}\r\n"
        f"Content-Type: {page.content_type}\r\n"
        f"Content-Length: {len(page.body)}\r\n{allow}"
        "Cache-Control: no-store\r\nVary: Accept\r\nX-Content-Type-Options: nosniff\r\nConnection: close\r\n\r\n"
    )
    return head.encode() + (page.body if with_body else b"")
