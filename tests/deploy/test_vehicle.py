"""The deployment as its files say, in a network namespace that watches: whom it speaks to, what it listens on, and what
its commands come to. See `vehicle.py` for what is done.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from coec.io.depth.model_cards import CARDS, list_models
from conftest import REPOSITORY
from deploy.world import EVERYBODY
from deploy.written import compose, documented_sockets, shipped_configurations, unit

UNSHARE = ("unshare", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc")
PATIENCE_S = 1800.0
"""The packages of an image are fetched, and kernels that are not compiled yet are compiled, on the way."""

SETTLED_S = 45.0
"""Of a service that runs: left alone, onnxruntime 1.31 reports 11 s after the worker has started, and again."""

CHATTER = f"""
import socket
vendor = socket.create_connection(("vendor.example", 443))
assert vendor.getpeername()[0] == "{EVERYBODY}"
vendor.send(b"id")
"""
"""What must not go unseen: a program that asks for a name, and speaks to whom it is told of."""

REPORTING = f"""
import os, time
os.environ.pop("ORT_DISABLE_TELEMETRY", None)
import onnxruntime
session = onnxruntime.InferenceSession("{CARDS}/street.onnx")
time.sleep(30)
"""
"""The library as it is without coec, for longer than it takes to report."""

COMMANDS = (
    ("models",),
    ("sim", "view", "--output", "/tmp/view.jpg", "--camera", "fisheye160"),
    ("calibrate", "sim:seed=1&seconds=12&camera=pinhole240x120&lidar=16&camera_hz=0.5&lidar_hz=0.5&depth=yes"),
)
"""What uses the optional extra, too."""

Record = Callable[[str, object], None]
"""pytest's `record_property`."""


@cache
def refusal() -> str | None:
    """Why this machine cannot be made a vehicle of; None: it can."""
    if sys.platform != "linux" or os.geteuid() != 0:
        return "needs root on Linux: namespaces, mounts and another user"
    tried = (
        "mount -t tmpfs tmpfs /srv && mkdir /srv/changed /srv/work /srv/root && mount -t overlay overlay "
        "-o lowerdir=/,upperdir=/srv/changed,workdir=/srv/work /srv/root && ip link set lo up && which openssl setpriv"
    )
    finished = subprocess.run([*UNSHARE, "--net", "sh", "-c", tried], capture_output=True, text=True)
    return (
        None if finished.returncode == 0 else f"this machine lets nobody make namespaces or overlays: {finished.stderr}"
    )


def lived(**story: object) -> Mapping[str, Any]:
    """What a vehicle's life came to."""
    why = refusal()
    if why is not None:
        pytest.skip(why)
    pytest.importorskip("embreex", reason="needs embreex")
    path = os.pathsep.join(str(REPOSITORY / folder) for folder in ("service", "tests"))
    command = [*UNSHARE, sys.executable, "-m", "deploy.vehicle", json.dumps(story)]
    # For a group of its own there is nobody to be left behind: the namespace of processes ends with its first.
    finished = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert finished.returncode == 0, finished.stderr[-20_000:]
    report: Mapping[str, Any] = json.loads(finished.stdout.splitlines()[-1])
    return report


@pytest.fixture(scope="module")
def short() -> Mapping[str, Any]:
    """The router, the service with the network of the package, and the observer; this checkout in the image's place."""
    return lived(build=False, configurations=[], networks=["street"], commands=[], chatter=CHATTER, settle_s=0.0)


def silent(report: Mapping[str, Any]) -> str:
    """Checks that nobody but the router was spoken to, and that it would have been seen; the figure."""
    assert report["strangers"] == {}
    assert report["names asked"] == []
    assert report["unseen"] == 0
    seen, names, reported = report["control"]
    assert seen > 0, "the world does not see packets"
    assert names, "the world does not hear who asks for a name"
    assert reported > 0, "the world does not answer"
    return f"{sum(report['strangers'].values())} of {report['packets']} packets in {report['lived_s']:.0f} s"


@pytest.mark.fault(
    "a library in the image reports to its vendor",
    "the service, its worker, its router and its observer speak to nobody but the router, nor ask for a name",
)
def test_nobody_but_the_router_is_spoken_to(short: Mapping[str, Any], record_property: Record) -> None:
    record_property("figure", silent(short))
    assert set(short["solved"]) == {"street"}
    assert set(short["answers"].values()) == {"answered"}, short["answers"]


@pytest.mark.fault(
    "a port of the deployment that nobody knows of",
    "the router listens on loopback and on the port that asks for certificates; service, worker and observer nowhere",
)
def test_listening_sockets_are_those_documented(short: Mapping[str, Any], record_property: Record) -> None:
    seen = {
        "router": short["router: sockets"],
        "service": short["coec: sockets"],
        "observer": short["observer: sockets"],
    }
    documented = documented_sockets()
    assert seen == {program: documented[program] for program in seen}
    record_property("figure", ", ".join(f"{program} {len(sockets)}" for program, sockets in seen.items()))


def test_health_checks_report_well_from_unwell(short: Mapping[str, Any]) -> None:
    assert short["coec: unwell before it runs"] == 1
    assert [short[f"{name}: health"] for name in compose()] == [0, 0, 0]


@pytest.mark.fault(
    "a command with the certificate of the observer",
    "the router hands it to nobody, while the observer's questions are answered",
)
def test_the_observer_may_query_and_not_command(short: Mapping[str, Any]) -> None:
    assert short["viewer"] == {"health": "answered", "command": "nothing"}


def test_the_manager_is_reported_of_the_start_of_progress_and_of_the_end(short: Mapping[str, Any]) -> None:
    reported = short["manager: told"]
    # That the start takes longer is said where it does: not where the kernels are there.
    assert set(reported) - {"EXTEND_TIMEOUT_USEC=20000000"} == {"READY=1", "WATCHDOG=1", "STOPPING=1"}
    assert reported[-1] == "STOPPING=1"
    assert unit()["Type"] == ["notify"]


def test_every_service_ends_by_its_signal_within_its_grace(short: Mapping[str, Any]) -> None:
    assert [short[f"{name}: exit"] for name in compose()] == [0, 0, 0]


def test_programs_run_as_the_user_of_the_image_without_any_capability(short: Mapping[str, Any]) -> None:
    assert short["users"] == ["coec"]
    assert short["capabilities"] == ["CapPrm 0 CapEff 0 CapBnd 0 NoNewPrivs 1"]


def test_memory_is_well_within_its_limits(short: Mapping[str, Any]) -> None:
    """A drive this small says little of the service; of the others it says what they begin with."""
    for name, service in compose().items():
        number, unit_of = float(service["mem_limit"][:-1]), {"m": 2**20, "g": 2**30}[service["mem_limit"][-1]]
        assert 0 < short["memory"][name] < number * unit_of / 2, name


def test_the_observer_hears_of_health_and_of_the_end(short: Mapping[str, Any]) -> None:
    received = short["observer: heard"]
    assert received["alive"][0] == "True"
    assert received["alive"][-1] == "False"
    assert "unknown" in received["health"]
    assert received["extrinsic"]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Any]:
    """The same from what the Dockerfile builds, and for longer than it takes a library to report."""
    pip = (sys.executable, "-m", "pip", "download", "--no-deps", "--dest", str(tmp_path_factory.mktemp("fetched")))
    fetched = subprocess.run([*pip, "editables"], capture_output=True, text=True)
    if fetched.returncode != 0:
        pytest.skip(f"no package index can be reached: {fetched.stderr.splitlines()[-1]}")
    return lived(
        build=True,
        configurations=shipped_configurations(),
        networks=networks(),
        commands=COMMANDS,
        chatter=REPORTING,
        settle_s=SETTLED_S,
    )


def networks() -> list[str]:
    """All that this machine has: that of the package, the maps that come with frames, and those of the samples."""
    result = ["street", "stereo"]
    data = os.environ.get("COEC_SAMPLE_DATA")
    if data:
        result += [f"{data}/depth/{card.file}" for card in list_models() if card.file and card.sha256]
    return [name for name in result if not name.startswith("/") or Path(name).is_file()]


@pytest.mark.slow
@pytest.mark.fault(
    "an image built from the Dockerfile, with every depth network at hand",
    "it speaks to nobody but the router for three quarters of a minute, as an unprivileged user on a read-only root",
)
def test_what_the_dockerfile_builds_speaks_to_nobody_either(built: Mapping[str, Any], record_property: Record) -> None:
    record_property("figure", silent(built))
    assert set(built["answers"].values()) == {"answered"}, built["answers"]
    models, view, calibrate = built["commands"]
    assert (models, view) == (0, 0)
    assert calibrate in (0, 1), "1: the verdict refuses a drive this small"
    assert set(built["solved"]) == set(networks())
    assert built["installed"] == ["coec.cdx.json", "licences.md"]
    assert [built[f"{name}: health"] for name in compose()] == [0, 0, 0]
    assert [built[f"{name}: exit"] for name in compose()] == [0, 0, 0]
    assert built["users"] == ["coec"]
    given_up = built["unit: exit without a configuration"]
    assert str(given_up) in unit()["RestartPreventExitStatus"], "what stays wrong is not tried again"


@pytest.mark.slow
@pytest.mark.fault(
    "a shipped configuration opens a port",
    "with none of them does the service, or its worker, listen anywhere; with `--embedded-router` on loopback alone",
)
def test_no_shipped_configuration_opens_a_socket_but_that_of_an_embedded_router(built: Mapping[str, Any]) -> None:
    documented = documented_sockets()
    plain = dict.fromkeys(shipped_configurations(), documented["service"])
    routing = documented["service with --embedded-router"]
    assert built["sockets by configuration"] == plain | {f"{name} --embedded-router": routing for name in plain}
