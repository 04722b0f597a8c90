"""The router of a vehicle: what its file says is bounded, and opens no door to everybody."""

from __future__ import annotations

from pathlib import Path

import pytest
import zenoh

from coec.config import LimitsConfig, ZenohConfig
from coec.errors import ConfigError
from coec.io.zenoh.bus import open_session
from coec.io.zenoh.session import open_router
from support.router import free_port

SECRET = "c2VjcmV0"


def file_of(folder: Path, text: str) -> Path:
    path = folder / "router.json5"
    path.write_text(text)
    return path


def test_a_router_connects_those_who_come(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    file = file_of(tmp_path, f'{{ mode: "router", listen: {{ endpoints: ["{endpoint}"] }} }} // of a test')
    with open_router(file), open_session(ZenohConfig(connect=(endpoint,)), LimitsConfig()) as session:
        token = session.liveliness().declare_token("here")
        settings = zenoh.Config.from_json5(f'{{ mode: "client", connect: {{ endpoints: ["{endpoint}"] }} }}')
        with zenoh.open(settings) as other:
            (reply,) = list(other.liveliness().get("here", timeout=20.0))
            assert reply.ok is not None
        token.undeclare()


@pytest.mark.fault(
    "a router's file nested 100,000 deep or two megabytes long", "refused before Zenoh's reader, which it would end"
)
@pytest.mark.parametrize(
    "text",
    ["{x:" + "[" * 100_000 + "]" * 100_000 + "}", " " * 2**21, f'{{ mode: "{SECRET}" }}', "{", None],
    ids=["deep", "long", "no mode", "torn", "absent"],
)
def test_a_file_that_is_no_configuration_is_refused(tmp_path: Path, text: str | None) -> None:
    file = tmp_path / "router.json5" if text is None else file_of(tmp_path, text)
    with pytest.raises(ConfigError, match=r"router\.json5") as refused:
        open_router(file)
    assert SECRET not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ('{ mode: "peer" }', "its mode is peer"),
        ('{ mode: "router", listen: { endpoints: ["tcp/[::]:7447"] } }', "whoever reaches tcp"),
    ],
)
def test_a_file_that_is_no_routers_or_opens_a_door_is_refused(tmp_path: Path, text: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        open_router(file_of(tmp_path, text))
