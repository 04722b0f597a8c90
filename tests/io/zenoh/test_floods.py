"""Floods of a router's door: what the shipped limits bound, and what only the rules in front of it do."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from conftest import REPOSITORY
from support import flooding
from support.router import TestAuthority

RULES = REPOSITORY / "deploy" / "nftables.conf"
SECONDS = 18
"""Zenoh gives a connection that never speaks TLS up after 10 s; it falls behind from then on."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        os.geteuid() != 0 or not all(shutil.which(tool) for tool in ("nft", "unshare", "ip")),
        reason="needs root, nft, unshare and ip",
    ),
]


@pytest.fixture
def flooded(authority: TestAuthority, tmp_path: Path) -> Callable[[str], dict[str, list[float | None]]]:
    router = tmp_path / "router.json5"
    shipped = (REPOSITORY / "deploy" / "router.json5").read_text()
    router.write_text(shipped.replace("/etc/zenoh/tls", str(authority.folder)).replace("tls/[::]:", "tls/0.0.0.0:"))

    def flood(kind: str) -> dict[str, list[float | None]]:
        files = (router, authority.folder / "viewer.json5", authority.folder / "operator.json5")
        command = ["unshare", "--net", sys.executable, flooding.__file__, RULES, *files, kind, SECONDS]
        run = subprocess.run([str(word) for word in command], capture_output=True, text=True, timeout=120, check=True)
        reported: dict[str, list[float | None]] = json.loads(run.stdout.splitlines()[-1])
        return reported

    return flood


def waited(reported: dict[str, list[float | None]]) -> str:
    """The longest that the operator waited; fails if he was kept out once."""
    times = reported["operator_waited_s"]
    assert None not in times, reported
    assert len(times) > SECONDS / 2
    return f"operator in within {max(time for time in times if time is not None):.1f} s, of {len(times)} times"


@pytest.mark.fault("20 openings a second, for 18 s, without a certificate, from one address", "an operator gets in")
def test_openings_that_never_speak_keep_nobody_out(
    flooded: Callable[[str], dict[str, list[float | None]]], record_property: Callable[[str, object], None]
) -> None:
    record_property("figure", waited(flooded("silent")))


@pytest.mark.fault("as many sessions as can be had with one viewer's certificate", "an operator gets in")
def test_sessions_of_one_certificate_keep_nobody_out(
    flooded: Callable[[str], dict[str, list[float | None]]], record_property: Callable[[str, object], None]
) -> None:
    record_property("figure", waited(flooded("sessions")))
