"""The HTTP server of a service, by its present configuration, and its pages `/metrics`, `/health` and `/live`, for
programs on the same computer that scrape or probe: GET or HEAD, one answer, end of the connection.

One thread serves all connections and waits for none of them (asyncio). Slow clients have a deadline, and if there are
too many connections the oldest is dropped. Requests are not kept. Only their method, path and `Accept` are used. The
servers of `http.server` have a thread for each connection and bound neither its duration nor the size of a head.
"""

import asyncio
import contextlib
import json
import logging
import socket
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from http import HTTPStatus

from coec.calibration.types import Reason
from coec.config import MetricsConfig
from coec.errors import UnavailableError
from coec.io.system import ServiceThread
from coec.schemas.replies import HealthReply, StatusReply
from coec.service.api.metrics import ENCODING, TEXT, TextFormat

_log = logging.getLogger(__name__)

MAX_CONNECTIONS = 16
"""Most connections at once; a scraper has one, for milliseconds."""

MAX_REQUEST_BYTES = 4096
"""Most bytes of request line and headers; a scraper sends 200 to 400."""

DEADLINE_S = 3.0
"""Longest duration of a connection; on the same computer it takes milliseconds."""

POLL_S = 0.2
"""Time between two checks whether to stop."""

STOP_S = 1.0
"""Time for the thread to end, s: it looks five times a second."""

METHODS = (b"GET", b"HEAD")
"""The methods that are answered. `HEAD` gets the head of the answer to `GET`."""

END_OF_HEAD = b"\r\n\r\n"


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


class HttpServer:
    """Listens from construction until `close`; answers while `thread` runs."""

    def __init__(self, host: str, port: int, find: Callable[[HttpRequest], HttpResponse | None]) -> None:
        """`find(request)` is called on the thread; for None the answer is 404.

        Raises:
            UnavailableError: it is not possible to listen there.
        """
        self._find = find
        self._listener = _listening(host, port)
        self._connections: dict[asyncio.Task[None], socket.socket] = {}
        self.thread = ServiceThread("http", lambda thread: asyncio.run(self._serve(thread)))

    def close(self, deadline_s: float) -> bool:
        """Stop listening and drop all connections; False if the thread did not end within the deadline."""
        self.thread.request_stop()
        joined = self.thread.join(deadline_s)
        if joined:
            self._listener.close()
        return joined

    # --- on the thread ----------------------------------------------------------------------------------------------

    async def _serve(self, thread: ServiceThread) -> None:
        async with asyncio.TaskGroup() as tasks:
            accepting = tasks.create_task(self._accept(tasks))
            while not thread.stopping:
                thread.beat()
                await asyncio.sleep(POLL_S)
            for task in (accepting, *self._connections):
                task.cancel()

    async def _accept(self, tasks: asyncio.TaskGroup) -> None:
        while True:
            try:
                client, _ = await asyncio.get_running_loop().sock_accept(self._listener)
            except OSError:  # the client has gone, or the process has no descriptor left: go on with the others
                await asyncio.sleep(POLL_S)
                continue
            if len(self._connections) >= MAX_CONNECTIONS:
                oldest = next(iter(self._connections))
                oldest.cancel()
                self._drop(oldest)
            task = tasks.create_task(self._exchange(client))
            self._connections[task] = client
            task.add_done_callback(self._drop)
            await asyncio.sleep(0)  # many clients at once keep nobody else waiting

    def _drop(self, task: asyncio.Task[None]) -> None:
        client = self._connections.pop(task, None)
        if client is not None:
            client.close()

    async def _exchange(self, client: socket.socket) -> None:
        """Receives one request and sends its answer. A client that does not keep the deadline is dropped."""
        loop = asyncio.get_running_loop()
        received = bytearray()
        with contextlib.suppress(OSError):  # of which a `TimeoutError` is one
            async with asyncio.timeout(DEADLINE_S):
                while END_OF_HEAD not in received and len(received) < MAX_REQUEST_BYTES:
                    part = await loop.sock_recv(client, MAX_REQUEST_BYTES)
                    if not part:
                        return
                    received += part
                await loop.sock_sendall(client, self._answer(bytes(received)))
            client.shutdown(socket.SHUT_WR)

    def _answer(self, request: bytes) -> bytes:
        """The bytes of the answer to a request, as far as it was received."""
        head, complete, _ = request.partition(END_OF_HEAD)
        if not complete:
            return _response_bytes(_plain(400, "The request is too long.\n"))
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
            _log.exception("a page could not be rendered", extra={"fields": {"path": path[:64]}})
            page = _plain(500, "The service failed on this page; its log says why.\n")
        return _response_bytes(page or _plain(404, "There is no such page.\n"), with_body=method != b"HEAD")


def _listening(host: str, port: int) -> socket.socket:
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        made = socket.create_server((host, port), family=family, backlog=MAX_CONNECTIONS)
    except OSError as error:
        raise UnavailableError(f"cannot listen on {host}:{port}: {error.strerror or error}") from error
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
        f"HTTP/1.1 {page.status} {HTTPStatus(page.status).phrase}\r\n"
        f"Content-Type: {page.content_type}\r\n"
        f"Content-Length: {len(page.body)}\r\n{allow}"
        "Cache-Control: no-store\r\nVary: Accept\r\nX-Content-Type-Options: nosniff\r\nConnection: close\r\n\r\n"
    )
    return head.encode() + (page.body if with_body else b"")


class MetricsServer:
    """The HTTP server, which the main thread opens, moves and closes. Metrics are for people who look after the
    service. If they cannot be served, that is reported, but the service calibrates all the same.

    Attributes:
        server: the present server; None if there is none.
        problem: why there is no server although there should be one; else None. It does not affect calibrations.
        insecure: the reason to report if other computers can reach the server; else None.
    """

    def __init__(self, find: Callable[[HttpRequest], HttpResponse | None]) -> None:
        """`find(request)` makes a page; see `HttpServer`."""
        self._find = find
        self._config = MetricsConfig()
        self.server: HttpServer | None = None
        self.problem: Reason | None = None
        self.insecure: Reason | None = None

    def reconfigure(self, config: MetricsConfig) -> None:
        """Answers at the address of this configuration, and nowhere else."""
        if config == self._config and self.problem is None:
            return
        self.close(STOP_S)
        self._config, self.problem, self.insecure = config, None, None
        if config.address is None:
            return
        try:
            self.server = HttpServer(*config.address, self._find)
        except UnavailableError as error:
            self.problem = Reason("http_unavailable", f"Metrics are not served over HTTP: {error}.")
            _log.error(self.problem.text)
            return
        self.server.thread.start()
        _log.info(f"metrics at http://{config.http}/metrics, health at /health, liveness at /live")
        if config.is_open:
            text = f"Whoever reaches {config.http} can read the metrics: `metrics.insecure` is set. Listen on loopback."
            self.insecure = Reason("http_insecure", text)

    def close(self, deadline_s: float) -> bool:
        """Ends the server; False if that took longer than the deadline."""
        server, self.server = self.server, None
        return server is None or server.close(deadline_s)


USABLE_LEVELS = frozenset({0, 1})
"""ROS levels of health at which a calibration may be used: OK and WARN."""


def pages(
    metrics: Callable[[TextFormat], bytes],
    health: Callable[[], tuple[StatusReply, Mapping[str, HealthReply]]],
    is_alive: Callable[[], bool],
) -> Callable[[HttpRequest], HttpResponse | None]:
    """A function that makes the page of a request (None for an unknown path).

    `/health` is 200 if the service runs and every pair may be used, else 503: a pair that was not looked at is not
    healthy. `/live` is 200 while the service makes progress, whatever it thinks of its pairs, else 503: only then can a
    restart help.
    """

    def page(request: HttpRequest) -> HttpResponse | None:
        match request.path:
            case "/metrics":
                text_format = accepted_format(request.accept)
                return HttpResponse(200, metrics(text_format), text_format.value)
            case "/health":
                return _health(*health())
            case "/live":
                alive = is_alive()
                return HttpResponse(
                    200 if alive else 503, b"alive\n" if alive else b"stuck\n", "text/plain; charset=utf-8"
                )
            case _:
                return None

    return page


def accepted_format(accept: str) -> TextFormat:
    """The format of the metrics for a header `Accept` (RFC 9110, 12.5.1): OpenMetrics if the reader names it and does
    not prefer plain text, else the text format, which every reader knows."""
    qualities = {ENCODING: 0.0, TEXT: 0.0}
    for item in accept.split(","):
        media_type, *parameters = (part.strip().lower() for part in item.split(";"))
        if media_type in qualities:
            qualities[media_type] = max(qualities[media_type], _quality(parameters))
    preferred = 0.0 < qualities[ENCODING] >= qualities[TEXT]
    return TextFormat.OPEN_METRICS if preferred else TextFormat.PROMETHEUS


def _quality(parameters: list[str]) -> float:
    """The quality among the parameters of a media type, 0 to 1; 1 if there is none, 0 if it is no number."""
    for parameter in parameters:
        name, _, value = parameter.partition("=")
        if name.strip() == "q":
            try:
                quality = float(value)
            except ValueError:
                return 0.0
            return quality if 0.0 <= quality <= 1.0 else 0.0
    return 1.0


def _health(status: StatusReply, health: Mapping[str, HealthReply]) -> HttpResponse:
    good = status.state == "running" and all(reply.level in USABLE_LEVELS for reply in health.values())
    document = {
        "state": status.state,
        "pairs": {
            name: {
                "state": reply.state,
                "level": reply.level,
                "reasons": [{"code": reason.code, "text": reason.text} for reason in reply.reasons],
            }
            for name, reply in health.items()
        },
    }
    text = json.dumps(document, sort_keys=True, ensure_ascii=False) + "\n"
    return HttpResponse(200 if good else 503, text.encode(), "application/json")
