"""Certificates for one test: an authority, and what it signed."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

KEY = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")


def sign(folder: Path, names: Mapping[str, Sequence[str]]) -> None:
    """`ca.pem`, and for each common name `NAME.pem` and `NAME-key.pem`, valid for two days.

    Args:
        names: host names that each certificate holds.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _openssl(folder, "req", "-x509", *KEY, "-keyout", "ca-key.pem", "-out", "ca.pem", "-days", "2", "-subj", "/CN=ca")
    for name, hosts in names.items():
        hosts_held = ",".join(f"DNS:{host}" for host in (name, *hosts))
        (folder / "extensions").write_text(f"subjectAltName={hosts_held}\nextendedKeyUsage=serverAuth,clientAuth\n")
        _openssl(folder, "req", *KEY, "-keyout", f"{name}-key.pem", "-out", "request", "-subj", f"/CN={name}")
        signed = ("-CA", "ca.pem", "-CAkey", "ca-key.pem", "-CAcreateserial", "-days", "2", "-extfile", "extensions")
        _openssl(folder, "x509", "-req", "-in", "request", "-out", f"{name}.pem", *signed)


def _openssl(folder: Path, *arguments: str) -> None:
    subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)
