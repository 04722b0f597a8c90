"""Certificates for tests, made by the program that is shipped for it, and some that nobody should take."""

from __future__ import annotations

import json
import subprocess
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from coec.adapters.tls.conversation import Credentials
from coec.config import AuthorityConfig, SenderConfig
from conftest import REPOSITORY

MAKE_TEST_CA = REPOSITORY / "deploy" / "make-test-ca"
CERTIFICATE_NAMES = ("router", "vehicle", "sensors", "ros", "operator", "viewer")
CLIENT_EXTENSIONS = "basicConstraints=critical,CA:FALSE\nextendedKeyUsage=clientAuth\nsubjectAltName=DNS:{name}\n"


SHORT_LIVED_CA = """
[ca]
default_ca = here
[here]
database = {database}
new_certs_dir = {folder}
rand_serial = yes
default_md = sha256
policy = any
x509_extensions = uses
[any]
commonName = supplied
[uses]
extendedKeyUsage = clientAuth
"""
"""Of `openssl ca`, the only one that is told a second (openssl 3.0)."""


@dataclass(frozen=True)
class TestAuthority:
    """A folder of `deploy/make-test-ca`."""

    __test__ = False

    folder: Path

    @property
    def root(self) -> Path:
        """The authority's certificate."""
        return self.folder / "ca.pem"

    def credentials(self, name: str) -> Credentials:
        """Of somebody, who trusts this authority."""
        return Credentials(self.folder / f"{name}.pem", self.folder / f"{name}-key.pem", self.root)

    def sign(self, common_name: str, file: str, *, days: int = 1, uses: str = CLIENT_EXTENSIONS) -> str:
        """Have a certificate made that `make-test-ca` does not make; the name of its files. With days = -1 it has
        expired."""
        extensions, request = self.folder / f"{file}.ext", self.folder / f"{file}.csr"
        extensions.write_text(uses.format(name=common_name))
        key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
        _openssl(
            "req", *key, "-keyout", self.folder / f"{file}-key.pem", "-subj", f"/CN={common_name}", "-out", request
        )
        ours = ("-CA", self.root, "-CAkey", self.folder / "ca-key.pem", "-extfile", extensions)
        _openssl("x509", "-req", "-in", request, *ours, "-days", days, "-out", self.folder / f"{file}.pem")
        return file

    def sign_for(self, common_name: str, file: str, seconds: float) -> str:
        """A certificate of a client that expires so many seconds from now."""
        self.sign(common_name, file)
        database, settings = self.folder / f"{file}.index", self.folder / f"{file}.cnf"
        database.touch()
        settings.write_text(SHORT_LIVED_CA.format(database=database, folder=self.folder))
        end = (datetime.now(UTC) + timedelta(seconds=seconds)).strftime("%y%m%d%H%M%SZ")
        ours = ("-cert", self.root, "-keyfile", self.folder / "ca-key.pem", "-config", settings)
        files = ("-in", self.folder / f"{file}.csr", "-out", self.folder / f"{file}.pem")
        _openssl("ca", "-batch", "-notext", *ours, *files, "-enddate", end)
        return file

    def of_service(self, *senders: SenderConfig, anonymous: str = "never") -> AuthorityConfig:
        """A service with the certificate `vehicle` that takes commands of these."""
        own = self.credentials("vehicle")
        return AuthorityConfig.model_validate(
            {
                "anonymous": anonymous,
                "senders": [sender.model_dump() for sender in senders],
                "certificate": own.certificate,
                "private_key": own.private_key,
                "root_ca": own.root_ca,
            }
        )

    def session(self, name: str, endpoint: str, mode: str = "client", **more: object) -> Path:
        """A Zenoh configuration file for somebody's session."""
        own = self.credentials(name)
        tls = {
            "root_ca_certificate": str(own.root_ca),
            "enable_mtls": True,
            "connect_certificate": str(own.certificate),
            "connect_private_key": str(own.private_key),
        }
        settings = {
            "mode": mode,
            "listen": {"endpoints": []},
            "connect": {"endpoints": [endpoint], "timeout_ms": 2000, "exit_on_failure": mode == "client"},
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
            "transport": {"link": {"tls": tls}},
        }
        file = self.folder / f"{name}-{mode}-{endpoint.rpartition(':')[2]}.json5"
        file.write_text(json.dumps(settings | more))
        return file


def make_authority(folder: Path, *hosts: str) -> TestAuthority:
    """A new authority with the certificates of `NAMES`."""
    subprocess.run([MAKE_TEST_CA, folder, *hosts], check=True, capture_output=True)
    return TestAuthority(folder)


def _openssl(*arguments: object) -> None:
    subprocess.run(["openssl", *(str(argument) for argument in arguments)], check=True, capture_output=True)
