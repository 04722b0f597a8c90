"""`coec router`: a router that routes, and the files that make none. With the shipped rules it runs in tests/deploy."""

from __future__ import annotations

import json
import os
import signal
import socket
import threading
from pathlib import Path

import pytest

from cli.conftest import Coec
from coec.errors import ConfigError, UnavailableError
from coec.io.zenoh.query_client import connected
from support.fake_worker import wait_until
from support.router import free_port


def written(folder: Path, **settings: object) -> Path:
    path = folder / "router.json5"
    path.write_text(json.dumps({"mode": "router", **settings}))
    return path


def listening(*endpoints: str) -> dict[str, object]:
    return {"endpoints": list(endpoints)}


def test_it_routes_until_it_is_stopped(coec: Coec, tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    received: list[str] = []

    def use() -> None:
        with connected([endpoint], 20.0) as one, connected([endpoint], 20.0) as other:
            subscriber = one.declare_subscriber("a/key", lambda sample: received.append(sample.payload.to_string()))

            def reported() -> bool:
                other.put("a/key", "word")  # until the route is laid
                return bool(received)

            wait_until(reported, "the word")
            subscriber.undeclare()
        os.kill(os.getpid(), signal.SIGTERM)

    client = threading.Thread(target=use)
    client.start()
    outcome = coec("router", "--config", written(tmp_path, listen=listening(endpoint)))
    client.join()
    assert outcome.status == 0
    assert received[0] == "word"
    reported = [json.loads(line)["message"] for line in outcome.out.splitlines()]
    assert reported == ["routing", "stopping"]


def test_a_file_that_is_no_routers_is_refused(coec: Coec, tmp_path: Path) -> None:
    absent = coec("router", "--config", tmp_path / "absent.json5")
    assert absent.status == ConfigError.exit_code
    client = coec("router", "--config", written(tmp_path, mode="client"))
    assert client.status == ConfigError.exit_code
    assert "client" in client.err


@pytest.mark.fault(
    "a router's file with a listener that is open to everybody",
    "`coec router` does not start, and names the listener",
)
def test_a_door_for_everybody_is_refused(coec: Coec, tmp_path: Path) -> None:
    outcome = coec("router", "--config", written(tmp_path, listen=listening("tcp/0.0.0.0:7447")))
    assert outcome.status == ConfigError.exit_code
    assert "tcp/0.0.0.0:7447" in outcome.err


def test_a_port_that_is_taken_may_be_free_later(coec: Coec, tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        outcome = coec("router", "--config", written(tmp_path, listen=listening(taken)))
    assert outcome.status == UnavailableError.exit_code
