"""Makes findings of the doctor."""

from __future__ import annotations

from coec.schemas.doctor import Finding


def ok(check: str, where: str, text: str) -> Finding:
    """A finding that needs no action."""
    return Finding(check=check, level="ok", where=where, text=text)


def warn(check: str, where: str, text: str, advice: str) -> Finding:
    """A finding that should be seen to, although the service can work."""
    return Finding(check=check, level="warn", where=where, text=text, advice=advice)


def fail(check: str, where: str, text: str, advice: str) -> Finding:
    """A finding with which the service cannot do its work."""
    return Finding(check=check, level="fail", where=where, text=text, advice=advice)
