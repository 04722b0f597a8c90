"""The pages over HTTP: right requests are answered whatever the others do."""

from __future__ import annotations

import contextlib
import http.client
import socket
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from coec.errors import UnavailableError
from coec.service.api import metrics_server as served
from coec.service.api.metrics_server import MAX_CONNECTIONS, MAX_REQUEST_BYTES, HttpRequest, HttpResponse, HttpServer
from support.fake_worker import wait_until
from support.router import free_port

BODY = b"x" * 3_000_000
"""Larger than what the system takes at once."""

ENDLESS = b"x" * 32_000_000
"""Larger than what it takes at all, while nobody reads."""

PATIENCE_S = 20.0


def find(request: HttpRequest) -> HttpResponse | None:
    if request.path == "/broken":
        raise RuntimeError("of the test")
    body = {"/page": BODY, "/endless": ENDLESS, "/accept": request.accept.encode()}.get(request.path)
    return None if body is None else HttpResponse(200, body, "text/plain")


@pytest.fixture
def server() -> Iterator[HttpServer]:
    made = HttpServer("127.0.0.1", free_port(), find)
    made.thread.start()
    yield made
    assert made.close(PATIENCE_S)
    assert made.thread.failure is None


def port_of(server: HttpServer) -> int:
    return int(server._listener.getsockname()[1])


def get(server: HttpServer, path: str, method: str = "GET") -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port_of(server), timeout=PATIENCE_S)
    connection.request(method, path)
    answer = connection.getresponse()
    reported = answer.status, answer.read()
    connection.close()
    return reported


def opened(server: HttpServer, sent: bytes = b"") -> socket.socket:
    made = socket.create_connection(("127.0.0.1", port_of(server)), PATIENCE_S)
    made.sendall(sent)
    return made


def test_a_page_is_answered_and_everything_else_is_not_discovered(server: HttpServer) -> None:
    assert get(server, "/page") == (200, BODY)
    assert get(server, "/page?from=a-scraper") == (200, BODY)
    assert get(server, "/")[0] == get(server, "/page/")[0] == get(server, "/../page")[0] == 404
    assert get(server, "/broken")[0] == 500, "and the server goes on"
    assert get(server, "/page")[0] == 200


def head_of(answer: bytes) -> list[bytes]:
    return answer.partition(b"\r\n\r\n")[0].split(b"\r\n")


@pytest.mark.parametrize("path", ["/page", "/missing", "/broken"])
def test_the_head_alone_is_that_of_the_whole_answer(server: HttpServer, path: str) -> None:
    answers = {}
    for method in ("GET", "HEAD"):
        with opened(server, f"{method} {path} HTTP/1.1\r\n\r\n".encode()) as client:
            answers[method] = b"".join(iter(lambda client=client: client.recv(2**16), b""))  # type: ignore[misc]
    assert head_of(answers["HEAD"]) == head_of(answers["GET"])
    assert answers["HEAD"].endswith(b"\r\n\r\n")
    assert len(answers["GET"]) > len(answers["HEAD"])


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "TRACE", "get", "FROBNICATE"])
@pytest.mark.parametrize("path", ["/page", "/missing"])
def test_another_method_is_refused_with_those_that_are_answered(server: HttpServer, method: str, path: str) -> None:
    with opened(server, f"{method} {path} HTTP/1.1\r\nContent-Length: 0\r\n\r\n".encode()) as client:
        first, *headers = head_of(client.recv(1000))
    assert first == b"HTTP/1.1 405 Method Not Allowed"
    assert b"Allow: GET, HEAD" in headers


@pytest.mark.parametrize(
    ("headers", "accept"),
    [
        (b"", b""),
        (b"Accept: text/plain\r\n", b"text/plain"),
        (b"aCCept:text/plain ;q=0.5\r\nX: y\r\nACCEPT:  */*\r\n", b"text/plain ;q=0.5,*/*"),
        (b"Acceptance: text/html\r\nno header\r\n\xff: \xff\r\n", b""),
    ],
)
def test_what_the_reader_accepts_reaches_the_page(server: HttpServer, headers: bytes, accept: bytes) -> None:
    with opened(server, b"GET /accept HTTP/1.0\r\n" + headers + b"\r\n") as client:
        answer = b"".join(iter(lambda: client.recv(2**16), b""))
    assert answer.partition(b"\r\n\r\n")[2] == accept


@pytest.mark.parametrize(
    "request_",
    [
        b"\r\n\r\n",
        b"GET /page\r\n\r\n",
        b"GET /page SMTP/1.0\r\n\r\n",
        bytes(range(256)) + b"\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\r\n\r\n",
    ],
)
def test_an_invalid_request_is_reported(server: HttpServer, request_: bytes) -> None:
    with opened(server, request_) as client:
        assert client.recv(100).startswith(b"HTTP/1.1 400 ")


def test_a_request_that_has_no_end_is_cut_short(server: HttpServer) -> None:
    with opened(server, b"GET /page HTTP/1.1\r\nX: " + b"a" * MAX_REQUEST_BYTES) as client:
        assert client.recv(100).startswith(b"HTTP/1.1 400 ")


@pytest.mark.fault(
    "clients of the HTTP page that send a byte now and then, and more of them than it takes",
    "a scraper is answered all the same, and they are dropped",
)
def test_slow_clients_keep_nobody_waiting(
    server: HttpServer, monkeypatch: pytest.MonkeyPatch, record_property: Callable[[str, object], None]
) -> None:
    monkeypatch.setattr(served, "DEADLINE_S", 0.5)
    slow = [opened(server, b"GET /page HT") for _ in range(3 * MAX_CONNECTIONS)]
    started_s = time.monotonic()
    assert get(server, "/page") == (200, BODY)
    record_property("figure", f"{1e3 * (time.monotonic() - started_s):.0f} ms")
    assert len(server._connections) <= MAX_CONNECTIONS
    for client in slow:
        assert _ends(client)
        client.close()
    # The client of /page has its answer before the server's thread drops its connection.
    wait_until(lambda: server._connections == {}, "the end of the last connection", PATIENCE_S)
    assert server._connections == {}


@pytest.mark.fault("a client of the HTTP page that reads nothing", "it is dropped, and nothing is kept for it")
def test_who_reads_nothing_is_dropped(server: HttpServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(served, "DEADLINE_S", 0.3)
    with opened(server, b"GET /endless HTTP/1.1\r\n\r\n") as client:
        assert client.recv(15) == b"HTTP/1.1 200 OK"
        wait_until(lambda: server._connections == {}, "the end of a connection that is not read", PATIENCE_S)
        assert _received(client) < len(ENDLESS)


def test_many_at_once_are_all_answered(server: HttpServer) -> None:
    with ThreadPoolExecutor(8) as pool:
        reported = list(pool.map(lambda _: get(server, "/page")[0], range(40)))
    assert reported == [200] * 40


def test_a_port_that_is_taken_is_reported() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other, pytest.raises(UnavailableError, match="cannot listen"):
        HttpServer("127.0.0.1", other.getsockname()[1], find)


def _ends(client: socket.socket) -> bool:
    try:
        return client.recv(1) == b""
    except ConnectionError:
        return True


def _received(client: socket.socket) -> int:
    """Bytes until the connection ends, in whatever way."""
    received = 0
    with contextlib.suppress(ConnectionError):
        while part := client.recv(2**16):
            received += len(part)
    return received
