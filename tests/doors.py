"""A router with the rules as they are shipped, on ports and with certificates of a test."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import zenoh

from certificates import TestAuthority
from coec.adapters.zenoh.client import RouterAddress
from conftest import REPOSITORY
from ports import free_port

ROUTER_RULES = REPOSITORY / "deploy" / "router.json5"


@dataclass(frozen=True)
class ShippedRouter:
    """Its two: for programs on its computer, and by certificate."""

    authority: TestAuthority
    loopback: str
    certified: str

    def file(self, name: str) -> Path:
        """A Zenoh configuration for the session of somebody on another computer."""
        return self.authority.session(name, self.certified)

    def connection(self, name: str) -> RouterAddress:
        """His way in."""
        return RouterAddress((self.certified,), self.file(name))


@contextmanager
def shipped_router(authority: TestAuthority, folder: Path) -> Iterator[ShippedRouter]:
    """Until the end of the block."""
    ports = free_port(), free_port()
    rules = ROUTER_RULES.read_text()
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
        yield ShippedRouter(authority, f"tcp/127.0.0.1:{ports[0]}", f"tls/localhost:{ports[1]}")
