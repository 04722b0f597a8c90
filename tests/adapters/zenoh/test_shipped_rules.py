"""The router's rules as they are shipped, with real certificates: daemons of one vehicle see each other through it."""

from __future__ import annotations

import json
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from coec.adapters.zenoh.bus import open_session
from coec.adapters.zenoh.presence import Presence
from coec.config import LimitsConfig, ZenohConfig
from coec.errors import UnavailableError
from coec.schemas.keys import Keys
from conftest import REPOSITORY
from ports import free_port

LIMITS = LimitsConfig()
KEYS = Keys("coec", "vehicle")
DEADLINE_S = 20.0
EXTENSIONS = "subjectAltName=DNS:localhost,IP:127.0.0.1\nextendedKeyUsage=serverAuth,clientAuth\n"


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an authority, and certificates of the router and the service that it signed."""
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl")
    folder = tmp_path_factory.mktemp("tls")
    (folder / "extensions").write_text(EXTENSIONS)

    def openssl(*arguments: str) -> None:
        subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)

    key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    openssl("req", "-x509", *key, "-keyout", "ca-key.pem", "-out", "ca.pem", "-days", "2", "-subj", "/CN=authority")
    for name in ("router", "vehicle"):
        openssl("req", *key, "-keyout", f"{name}-key.pem", "-out", f"{name}.csr", "-subj", f"/CN={name}")
        signed = ("-CA", "ca.pem", "-CAkey", "ca-key.pem", "-CAcreateserial", "-days", "2", "-extfile", "extensions")
        openssl("x509", "-req", "-in", f"{name}.csr", "-out", f"{name}.pem", *signed)
    return folder


@pytest.fixture
def service(certificates: Path) -> Iterator[ZenohConfig]:
    """How the service reaches a router with the shipped rules, from another computer."""
    port = free_port()
    rules = (REPOSITORY / "deploy" / "router.json5").read_text()
    for shipped, here in (
        ("/etc/zenoh/tls", str(certificates)),
        ("tls/[::]:7448", f"tls/127.0.0.1:{port}"),
        ("tcp/127.0.0.1:7447", f"tcp/127.0.0.1:{free_port()}"),
    ):
        assert shipped in rules
        rules = rules.replace(shipped, here)
    (certificates / "router.json5").write_text(rules)
    tls = {
        "root_ca_certificate": str(certificates / "ca.pem"),
        "enable_mtls": True,
        "connect_certificate": str(certificates / "vehicle.pem"),
        "connect_private_key": str(certificates / "vehicle-key.pem"),
    }
    session = {"connect": {"endpoints": [f"tls/localhost:{port}"]}, "transport": {"link": {"tls": tls}}}
    file = certificates / "service.json5"
    file.write_text(json.dumps(session))
    with zenoh.open(zenoh.Config.from_file(certificates / "router.json5")):
        yield ZenohConfig(file=file)


@pytest.mark.fault(
    "a second daemon on another computer, through the shipped router with certificates", "it sees the first"
)
def test_a_second_daemon_on_another_computer_sees_the_first(service: ZenohConfig) -> None:
    with open_session(service, LIMITS) as here, open_session(service, LIMITS) as there:
        first, second = (Presence(session, service, LIMITS, KEYS, 1) for session in (here, there))
        first.claim(threading.Event())
        with pytest.raises(UnavailableError, match="by another daemon"):
            second.claim(threading.Event())
        assert first.close(DEADLINE_S)
        assert second.close(DEADLINE_S)
