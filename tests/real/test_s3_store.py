"""`coec batch` on windows in S3: a server of moto that refuses requests without the right credentials."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import duckdb
import psutil
import pytest

from support.fleet import STORE_CREDENTIALS, batch_command, recorded_windows, two_nodes

pytestmark = pytest.mark.slow

COPIES = 6
REGION = "eu-central-1"
POLICY = {"Version": "2012-10-17", "Statement": [{"Effect": "Allow", "Action": "*", "Resource": "*"}]}


@dataclass(frozen=True)
class Store:
    """A store with windows in it.

    Attributes:
        endpoint: its URL.
        credentials: environment of a caller that may read it.
    """

    endpoint: str
    credentials: dict[str, str]

    @property
    def windows(self) -> str:
        return "s3://windows/**.mcap"

    @property
    def without(self) -> dict[str, str]:
        """Environment of a caller that knows only where the store is."""
        return {"AWS_ENDPOINT_URL": self.endpoint, "AWS_DEFAULT_REGION": REGION}


def server_command() -> list[str]:
    """The command of moto's server, from this environment or the path."""
    if importlib.util.find_spec("moto") is not None:
        return [sys.executable, "-m", "moto.server"]
    result = shutil.which("moto_server")
    if result is None:
        pytest.skip(
            "needs moto's server: pip install 'moto[server,s3]' in an environment of its own, and its bin in PATH"
        )
    return [result]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    pytest.importorskip("s3fs", reason="needs the optional extra `s3`: pip install 'coec[s3]'")
    import botocore.session

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    log = (tmp_path_factory.mktemp("moto") / "log").open("w")
    with subprocess.Popen([*server_command(), "-H", "127.0.0.1", "-p", str(port)], stdout=log, stderr=log) as server:
        try:
            endpoint = f"http://127.0.0.1:{port}"
            _await(port, server)

            def client(service: str, key: str = "setup", secret: str = "setup") -> Any:
                return botocore.session.get_session().create_client(
                    service, REGION, endpoint_url=endpoint, aws_access_key_id=key, aws_secret_access_key=secret
                )

            iam = client("iam")
            iam.create_user(UserName="fleet")
            iam.put_user_policy(UserName="fleet", PolicyName="all", PolicyDocument=json.dumps(POLICY))
            key = iam.create_access_key(UserName="fleet")["AccessKey"]
            s3 = client("s3")
            s3.create_bucket(Bucket="windows", CreateBucketConfiguration={"LocationConstraint": REGION})
            (one, *_) = sorted(recorded_windows(tmp_path_factory.mktemp("recorded")).rglob("*.mcap"))
            for index in range(COPIES):
                s3.put_object(Bucket="windows", Key=f"day/{index:02}.mcap", Body=one.read_bytes())
            # From now on every request needs valid credentials.
            request = urllib.request.Request(
                f"{endpoint}/moto-api/reset-auth", data=b"0", headers={"Content-Type": "text/plain"}
            )
            urllib.request.urlopen(request, timeout=10.0).close()
            credentials = {
                "AWS_ACCESS_KEY_ID": key["AccessKeyId"],
                "AWS_SECRET_ACCESS_KEY": key["SecretAccessKey"],
                "AWS_ENDPOINT_URL": endpoint,
                "AWS_DEFAULT_REGION": REGION,
            }
            yield Store(endpoint, credentials)
        finally:
            server.terminate()
            log.close()


def _await(port: int, server: subprocess.Popen[bytes]) -> None:
    deadline_s = time.monotonic() + 60.0
    while time.monotonic() < deadline_s:
        assert server.poll() is None, "moto's server has ended"
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.1)
    raise AssertionError("moto's server does not listen")


def batch(environment: dict[str, str], *arguments: object) -> subprocess.CompletedProcess[str]:
    """Runs `coec batch` with these credentials only."""
    base = {name: value for name, value in os.environ.items() if not name.startswith(STORE_CREDENTIALS)}
    base |= {"AWS_EC2_METADATA_DISABLED": "true", "HOME": "/nonexistent", "COLUMNS": "200"}
    return subprocess.run(
        batch_command(*arguments), env=base | environment, capture_output=True, text=True, timeout=300.0, check=False
    )


def judged(folder: Path) -> tuple[int, int]:
    """Number of rows, and of windows with a result."""
    table = f"read_parquet('{folder}/**/*.parquet')"
    ((rows, results),) = duckdb.sql(f"SELECT count(DISTINCT url), count(result) FROM {table}").fetchall()
    return rows, results


@pytest.mark.fault("a store refuses the caller", "the message says so at once, and no folder is left")
def test_on_this_machine(store: Store, tmp_path: Path) -> None:
    folder = tmp_path / "results"
    wrong = store.credentials | {"AWS_SECRET_ACCESS_KEY": "wrong-secret-wrong-secret"}
    for environment, reason in ((store.without, "NoCredentialsError"), (wrong, "PermissionError")):
        for windows in (store.windows, "s3://windows/day/00.mcap"):
            refused = batch(environment, windows, "--output", folder, "--jobs", 1)
            assert refused.returncode == 1
            assert reason in refused.stderr
            assert "wrong-secret" not in refused.stderr
    done = batch(store.credentials, store.windows, "--output", folder, "--jobs", 1)
    assert done.returncode == 0, done.stderr
    assert judged(folder) == (COPIES, COPIES)


@pytest.mark.fault(
    "Ray nodes have no credentials for the store", "they use the caller's, which appear in no log and no command line"
)
def test_on_ray_nodes_without_credentials_of_their_own(store: Store, tmp_path: Path) -> None:
    folder = tmp_path / "results"
    with two_nodes() as nodes:
        arguments = (store.windows, "--output", folder, "--engine", "ray", "--ray-address", nodes.address, "--json")
        alone = batch(store.credentials, *arguments, "--no-send-credentials")
        assert alone.returncode == 1
        assert "NoCredentialsError" in alone.stdout + alone.stderr
        assert "--resume" in alone.stdout + alone.stderr
        assert not list(folder.rglob("*.parquet"))

        command = batch_command(*arguments, "--resume")
        base = {name: value for name, value in os.environ.items() if not name.startswith(STORE_CREDENTIALS)}
        secret = store.credentials["AWS_SECRET_ACCESS_KEY"]
        with subprocess.Popen(command, env=base | store.credentials, stdout=subprocess.PIPE, text=True) as process:
            while process.poll() is None:
                lines = [" ".join(one.info["cmdline"] or ()) for one in psutil.process_iter(["cmdline"])]
                assert not [line for line in lines if secret in line]
                time.sleep(0.2)
            assert process.stdout is not None
            out = process.stdout.read()
        assert process.returncode == 0
        assert json.loads(out)["errors"] == {}
        assert judged(folder) == (COPIES, COPIES)
        for path in [*nodes.logs.rglob("*"), *folder.rglob("*")]:
            if path.is_file():
                assert secret.encode() not in path.read_bytes(), path
