"""How a finding is written down."""

from __future__ import annotations

from coec.schemas.doctor import Finding


def ok(check: str, where: str, text: str) -> Finding:
    """Nothing is to be done."""
    return Finding(check=check, level="ok", where=where, text=text)


def warn(check: str, where: str, text: str, advice: str) -> Finding:
    """The service can work; see to it."""
    return Finding(check=check, level="warn", where=where, text=text, advice=advice)


def fail(check: str, where: str, text: str, advice: str) -> Finding:
    """The service cannot do its work so."""
    return Finding(check=check, level="fail", where=where, text=text, advice=advice)
