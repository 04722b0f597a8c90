"""What stands between a vehicle and its clients: free ports, a relay whose way back can be stopped, certificates made
by the program that is shipped for it (and some that must be refused), a router with the rules as they are shipped,
and a storage. The storage stands for one of Zenoh's storage manager, whose plugins do not load into the sessions of
Python. It does what its documentation promises of a storage in memory: takes every put and delete below its key
expression that is newer than what it has, and answers queries with what it holds, under the keys and with the
timestamps it came with.

It does what its documentation promises of a storage in memory: takes every put and delete below its key expression that
is newer than what it has, and answers queries with what it kept, under the keys and with the timestamps it came with.
What it is told of a storage is what stands in the shipped configuration.
"""

from __future__ import annotations

import json
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import TracebackType
from typing import Self

import zenoh

from coec.config import AuthorityConfig, SenderConfig
from coec.io.zenoh.command_auth import Credentials
from coec.io.zenoh.query_client import RouterAddress
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


def free_port() -> int:
    """A TCP port that nobody listened on a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class Relay:
    """A port of loopback before another one: one connection, of which the way back can be stopped."""

    def __init__(self, port: int) -> None:
        """`port`: where the connection goes on to."""
        self._target = port
        self._sockets = ExitStack()
        self._both: tuple[socket.socket, ...] = ()
        self._reads = threading.Event()
        self._reads.set()
        self._listener = self._sockets.enter_context(socket.create_server(("127.0.0.1", 0)))
        self._threads = [threading.Thread(target=self._accept)]
        self.port: int = self._listener.getsockname()[1]

    def __enter__(self) -> Relay:
        self._threads[0].start()
        return self

    def __exit__(self, *raised: object) -> None:
        self._reads.set()
        for one in (*self._both, self._listener):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        self._sockets.close()

    def stop_reading(self) -> None:
        """Nothing of what the other side sends is taken any more."""
        self._reads.clear()

    def _accept(self) -> None:
        with suppress(OSError):  # nobody came
            near = self._sockets.enter_context(self._listener.accept()[0])
            far = self._sockets.enter_context(socket.create_connection(("127.0.0.1", self._target)))
            self._both = (near, far)
            back = threading.Thread(target=self._pump, args=(far, near, self._reads))
            self._threads.append(back)
            back.start()
            always = threading.Event()
            always.set()
            self._pump(near, far, always)

    @staticmethod
    def _pump(source: socket.socket, sink: socket.socket, allowed: threading.Event) -> None:
        with suppress(OSError):
            while allowed.wait() and (data := source.recv(2**16)):
                sink.sendall(data)


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


class MemoryStorage:
    """In a session, while the block lasts."""

    def __init__(self, session: zenoh.Session, key_expr: str, *, complete: bool = True) -> None:
        self._lock = threading.Lock()
        self.samples: dict[str, zenoh.Sample] = {}
        self._subscriber = session.declare_subscriber(key_expr, zenoh.handlers.Callback(self._store, indirect=False))
        handler = zenoh.handlers.Callback(self._answer, indirect=False)
        self._queryable = session.declare_queryable(key_expr, handler, complete=complete)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._subscriber.undeclare()
        self._queryable.undeclare()

    def _store(self, sample: zenoh.Sample) -> None:
        with self._lock:
            key = str(sample.key_expr)
            known = self.samples.get(key)
            before = None if known is None else known.timestamp
            if before is not None and sample.timestamp is not None and sample.timestamp <= before:
                return
            if sample.kind == zenoh.SampleKind.PUT:
                self.samples[key] = sample
            else:
                self.samples.pop(key, None)

    def _answer(self, query: zenoh.Query) -> None:
        with query, self._lock:
            for key, sample in self.samples.items():
                if query.key_expr.intersects(zenoh.KeyExpr(key)):
                    query.reply(key, sample.payload, encoding=sample.encoding, timestamp=sample.timestamp)
