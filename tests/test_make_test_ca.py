"""`deploy/make-test-ca`: certificates that OpenSSL and Zenoh take, and no surprise for what is there already."""

from __future__ import annotations

import os
import re
import shutil
import stat
import subprocess
from pathlib import Path

import pytest

from coec.config import AuthorityConfig, load_yaml
from coec.io.zenoh.command_auth import CommandListener, CommandSender, credentials_of
from coec.io.zenoh.session import credentials_in, read_settings
from conftest import REPOSITORY
from deploy.written import stages
from support.router import CERTIFICATE_NAMES, MAKE_TEST_CA, TestAuthority

pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl")


def make(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [str(MAKE_TEST_CA), *(str(argument) for argument in arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ | environment)


def test_its_certificates_pass_the_strictest_observation(authority: TestAuthority) -> None:
    for name in CERTIFICATE_NAMES:
        purpose = "sslserver" if name in ("router", "vehicle") else "sslclient"
        command = ["openssl", "verify", "-x509_strict", "-purpose", purpose, "-CAfile", "ca.pem", f"{name}.pem"]
        subprocess.run(command, cwd=authority.folder, check=True, capture_output=True)


def test_keys_are_for_their_owner_and_group_alone(authority: TestAuthority) -> None:
    keys = list(authority.folder.glob("*-key.pem"))
    assert {f"{name}-key.pem" for name in (*CERTIFICATE_NAMES, "ca")} <= {key.name for key in keys}
    assert {stat.S_IMODE((authority.folder / f"{name}-key.pem").stat().st_mode) for name in CERTIFICATE_NAMES} == {
        0o640
    }
    assert stat.S_IMODE((authority.folder / "ca-key.pem").stat().st_mode) == 0o600, "who has it is everybody"
    assert {stat.S_IMODE((authority.folder / f"{name}.pem").stat().st_mode) for name in (*CERTIFICATE_NAMES, "ca")} == {
        0o644
    }


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files to a group that it is not in")
def test_the_group_of_the_image_may_read_the_keys(tmp_path: Path) -> None:
    _, group = stages()[-1].last("USER").text.split(":")
    for given, folder in ((int(group), tmp_path / "image"), (4711, tmp_path / "other")):
        assert make(folder, **({} if given == int(group) else {"GROUP": str(given)})).returncode == 0
        assert {key.stat().st_gid for key in folder.glob("*-key.pem") if key.name != "ca-key.pem"} == {given}
        assert (folder / "ca-key.pem").stat().st_gid == os.getegid()


def test_who_cannot_give_the_keys_to_the_image_is_shown_how(tmp_path: Path) -> None:
    tools = tmp_path / "tools"
    tools.mkdir()
    (tools / "chgrp").write_text("#!/bin/sh\nexit 1\n")
    (tools / "chgrp").chmod(0o755)
    reported = make(tmp_path / "a folder", PATH=f"{tools}:{os.environ['PATH']}")
    assert reported.returncode == 0, reported.stderr
    assert re.search(r"sudo chgrp 10001 .*a\\ folder/\{router,vehicle,viewer\}-key\.pem", reported.stdout)


def test_what_it_says_is_a_configuration_that_can_be_used(tmp_path: Path) -> None:
    folder = tmp_path / "a folder"
    reported = make(folder, "vehicle-7.example", "10.0.0.7", "fd00::7", VEHICLE="truck-7")
    assert reported.returncode == 0, reported.stderr
    (section,) = re.findall(r"^ +authority:\n(?: {17}.*\n)+", reported.stdout, re.MULTILINE)
    file = tmp_path / "said.yaml"
    file.write_text("\n".join(line[15:] for line in section.splitlines()))
    credentials = credentials_of(AuthorityConfig.model_validate(load_yaml(file)["authority"]))
    assert credentials is not None
    speaker = CommandSender(TestAuthority(folder).credentials("operator"), "truck-7")
    flight = CommandListener(credentials).receive("1", speaker.first_flight())
    assert isinstance(flight, bytes)
    speaker.send(flight, b"hold")
    for name in ("vehicle", "sensors", "ros", "operator", "viewer"):
        settings = read_settings(folder / f"{name}.json5")
        assert settings.get_json("connect/endpoints") == '["tls/vehicle-7.example:7448"]'
        assert settings.get_json("listen/endpoints") == "[]"
        own = credentials_in(settings)
        assert own is not None
        assert own.certificate == folder / f"{name}.pem"
    command = ["openssl", "x509", "-in", str(folder / "router.pem"), "-noout", "-ext", "subjectAltName"]
    names = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    for name in ("DNS:vehicle-7.example", "IP Address:10.0.0.7", "IP Address:FD00:0:0:0:0:0:0:7", "DNS:localhost"):
        assert name in names
    assert "/etc/zenoh/tls/router-key.pem" in (REPOSITORY / "deploy" / "router.json5").read_text()


def test_an_authority_that_is_there_stays(authority: TestAuthority) -> None:
    before = authority.root.read_bytes()
    refused = make(authority.folder)
    assert (refused.returncode, "holds an authority already" in refused.stderr) == (1, True)
    assert authority.root.read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "why"),
    [((), "usage"), (("--help",), "usage"), (("x", "a b"), "no name or address"), (("x", "a,DNS:b"), "no name or")],
)
def test_what_is_no_host_makes_nothing(tmp_path: Path, arguments: tuple[str, ...], why: str) -> None:
    typed = [tmp_path / word if word == "x" else word for word in arguments]
    refused = make(*typed)
    assert (refused.returncode, why in refused.stderr) == (1, True)
    assert not list(tmp_path.rglob("*.pem"))


def test_without_openssl_it_says_what_to_install(tmp_path: Path) -> None:
    tools = tmp_path / "tools"
    tools.mkdir()
    for name in ("bash", "env", "mkdir"):
        result = shutil.which(name)
        assert result is not None
        (tools / name).symlink_to(result)
    refused = make(tmp_path / "x", PATH=str(tools))
    assert (refused.returncode, "apt-get install openssl" in refused.stderr) == (1, True)
