"""A router with the rules as they are shipped, on ports and with certificates of a test."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import zenoh

from certificates import TestAuthority
from coec.adapters.zenoh.client import Way
from conftest import REPOSITORY
from ports import free_port

RULES = REPOSITORY / "deploy" / "router.json5"


@dataclass(frozen=True)
class Door:
    """Its two: for programs on its computer, and by certificate."""

    authority: TestAuthority
    loopback: str
    certified: str

    def file(self, name: str) -> Path:
        """A Zenoh configuration for the session of somebody on another computer."""
        return self.authority.session(name, self.certified)

    def way(self, name: str) -> Way:
        """His way in."""
        return Way((self.certified,), self.file(name))


@contextmanager
def opened(authority: TestAuthority, folder: Path) -> Iterator[Door]:
    """Until the end of the block."""
    ports = free_port(), free_port()
    rules = RULES.read_text()
    for shipped, here in (
        ("/etc/zenoh/tls", str(authority.folder)),
        ("tls/[::]:7448", f"tls/127.0.0.1:{ports[1]}"),
        ("tcp/127.0.0.1:7447", f"tcp/127.0.0.1:{ports[0]}"),
    ):
        assert shipped in rules
        rules = rules.replace(shipped, here)
    file = folder / "router.json5"
    file.write_text(rules)
    with zenoh.open(zenoh.Config.from_file(file)):
        yield Door(authority, f"tcp/127.0.0.1:{ports[0]}", f"tls/localhost:{ports[1]}")
