"""The image by a container engine: built from the Dockerfile, then run as the compose file says. Docker or podman.

`COEC_ENGINE` names another command in their place. Where no registry can be reached, `COEC_BASE_IMAGE` names an image
that is there in place of the pinned one: a Debian with Python 3.11, `python` and `pip`.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from coec.cli.check_config import template
from coec.errors import ExitCode
from conftest import REPOSITORY
from deploy.written import DEPLOY, compose, stages
from support.fake_worker import wait_until

pytestmark = pytest.mark.slow

Record = Callable[[str, object], None]
"""pytest's `record_property`."""

PATIENCE_S = 1800.0
NAME = "coec-of-the-tests"
CONFINED = ("--read-only", "--cap-drop=ALL", "--security-opt=no-new-privileges", "--tmpfs=/tmp", "--network=none")
"""As the compose file has it, and without a network: what is asked is asked within."""

MOST_BYTES = 950_000_000


def engine() -> str:
    for name in filter(None, (os.environ.get("COEC_ENGINE"), "docker", "podman")):
        if shutil.which(name) and subprocess.run([name, "info"], capture_output=True).returncode == 0:
            return name
    pytest.skip("needs a container engine that runs: Docker, or podman (Debian: apt-get install podman)")


def done(*text: object, check: bool = True) -> str:
    """What the engine prints."""
    command = [engine(), *(str(word) for word in text)]
    finished = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, cwd=REPOSITORY)
    assert not check or finished.returncode == 0, f"{command}: {finished.stderr[-4000:]}"
    return finished.stdout + (finished.stderr if text[0] == "logs" else "")


@pytest.fixture(scope="module")
def image() -> Iterator[str]:
    """The image that the Dockerfile builds; gone afterwards."""
    base = os.environ.get("COEC_BASE_IMAGE")
    if base is None:
        pulled = subprocess.run([engine(), "pull", stages()[0].image], capture_output=True, text=True)
        if pulled.returncode != 0:
            pytest.skip(
                f"needs a registry that has {stages()[0].image}, or COEC_BASE_IMAGE, an image that is there: "
                f"{pulled.stderr.strip()[-300:]}"
            )
    of_podman = ["--format=docker"] if "podman" in done("--version") else []
    given = [] if base is None else [f"--build-arg=PYTHON={base}"]
    done("build", *of_podman, *given, "--tag", NAME, ".")
    yield NAME
    done("rmi", "--force", NAME, check=False)


@contextmanager
def running(image: str, options: Sequence[object], *arguments: object) -> Iterator[str]:
    """A container of the image that runs as the compose file says."""
    name = f"{NAME}-{time.monotonic_ns()}"
    done("run", "--detach", "--name", name, *CONFINED, *options, image, *arguments)
    try:
        yield name
    finally:
        done("rm", "--force", "--volumes", name, check=False)


def state_of(name: str) -> dict[str, Any]:
    (document,) = json.loads(done("inspect", name))
    return dict(document["State"])


def has_finished(name: str) -> bool:
    return state_of(name)["Status"] in ("exited", "stopped")


def alive(name: str) -> str | None:
    """What the health check of the image says; None: it fails."""
    (program,) = stages()[-1].health_check
    command = [engine(), "exec", name, program]
    finished = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    return finished.stdout.strip() if finished.returncode == 0 else None


def configured(folder: Path, **changes: Any) -> Path:
    document = YAML(typ="safe").load(template())
    document["zenoh"] |= {"embedded_router": True}
    document["state"] |= {"directory": "/var/lib/coec", "min_free_bytes": 0}
    document["pairs"][0]["calibration"]["depth"]["model"] = changes.pop("model", "street")
    path = folder / "coec.yaml"
    with path.open("w") as stream:
        YAML().dump(document | changes, stream)
    path.chmod(0o644)
    return path


def mounted(path: Path, target: str = "/etc/coec/coec.yaml") -> str:
    return f"--volume={path}:{target}:ro"


def test_it_has_a_numeric_user_a_health_check_and_no_installer(image: str, record_property: Record) -> None:
    (document,) = json.loads(done("inspect", image))
    config = document["Config"]
    assert config["User"] == "10001:10001"
    # podman has it beside the configuration.
    checks = [place[name] for place in (config, document) for name in ("Healthcheck", "HealthCheck") if name in place]
    assert checks[0]["Test"] == ["CMD", "check-live"]
    program = "import importlib.util as util; print([name for name in ('pip', 'hatchling') if util.find_spec(name)])"
    python = ("--network=none", "--entrypoint=/opt/coec/bin/python")
    assert "hatchling" not in done("run", "--rm", *python, image, "-I", "-c", program)
    record_property("figure", f"{document['Size'] / 1e6:.0f} MB")
    assert document["Size"] < MOST_BYTES


@pytest.mark.fault(
    "a read-only container without a capability, a network and an address for HTTP",
    "it serves as the user of the image, its health check holds, and it ends by its signal",
)
def test_it_serves_confined_is_alive_and_ends(image: str, tmp_path: Path, record_property: Record) -> None:
    with running(image, [mounted(configured(tmp_path))]) as name:
        wait_until(lambda: alive(name) is not None or has_finished(name), "a sign of life", PATIENCE_S)
        reported = alive(name)
        assert reported is not None, done("logs", name)
        assert reported.startswith("alive: the last heartbeat is ")
        assert done("exec", name, "id", "--user").strip() == "10001"
        started_s = time.monotonic()
        done("stop", "--time", compose()["coec"]["stop_grace_period"].removesuffix("s"), name)
        record_property("figure", f"stopped in {time.monotonic() - started_s:.1f} s")
        assert state_of(name)["ExitCode"] == ExitCode.SUCCESS, done("logs", name)


def test_where_it_serves_pages_its_health_check_reads_one(image: str, tmp_path: Path) -> None:
    path = configured(tmp_path, metrics={"http": "127.0.0.1:9464"}, model="stereo")
    with running(image, [mounted(path)]) as name:
        wait_until(lambda: alive(name) is not None or has_finished(name), "a sign of life", PATIENCE_S)
        assert alive(name) == "alive: 127.0.0.1:9464 answers", done("logs", name)


@pytest.mark.fault("a depth network that is absent, in a container", "exit code 78, and the log names it")
def test_a_network_that_is_absent_ends_it_with_78(image: str, tmp_path: Path) -> None:
    with running(image, [mounted(configured(tmp_path, model="/absent.onnx"))]) as name:
        wait_until(lambda: has_finished(name), "its end", PATIENCE_S)
        assert state_of(name)["ExitCode"] == ExitCode.CONFIGURATION
        assert "there is no depth network /absent.onnx" in done("logs", name)


def router_options(tls: Path) -> list[str]:
    """The volumes of the router in the compose file, with certificates from another folder."""
    result = []
    for volume in compose()["router"]["volumes"]:
        origin, target, *_ = volume.split(":")
        result.append(mounted(tls / Path(origin).name if "/tls/" in origin else DEPLOY / origin, target))
    return result


@pytest.mark.fault(
    "certificates of `make-test-ca` in a container, and a key that only root may read",
    "the router routes with the first; of the other it names the file, its mode and the user, and ends with 78",
)
@pytest.mark.skipif(os.geteuid() != 0, reason="needs root: the keys go to the group of the image")
def test_a_router_reads_the_certificates_that_are_made_for_it(image: str, tmp_path: Path) -> None:
    tls = tmp_path / "tls"
    subprocess.run([DEPLOY / "make-test-ca", tls, "router"], check=True, capture_output=True)
    command = compose()["router"]["command"]
    with running(image, router_options(tls), *command) as name:
        wait_until(lambda: "routing" in done("logs", name) or has_finished(name), "the router", PATIENCE_S)
        assert not has_finished(name), done("logs", name)
        _, *check = compose()["router"]["healthcheck"]["test"]
        done("exec", name, *check)
    (tls / "router-key.pem").chmod(0o600)
    with running(image, router_options(tls), *command) as name:
        wait_until(lambda: has_finished(name), "its end", PATIENCE_S)
        assert state_of(name)["ExitCode"] == ExitCode.CONFIGURATION
        reported = done("logs", name)
        assert "/etc/zenoh/tls/router-key.pem belongs to user 0" in reported.replace("\n", " "), reported
        assert "with mode 0600, and this process has user 10001" in reported.replace("\n", " "), reported
