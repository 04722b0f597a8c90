"""The unit under systemd itself, as the first process of a container (systemd-nspawn): what its exit codes, its
watchdog, a reload and a stop come to. Needs root; what it changes is in a copy of the root and goes with it."""

from __future__ import annotations

import json
import os
import shutil
import site
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from coec.cli.check_config import template
from conftest import REPOSITORY
from deploy.written import DEPLOY, unit
from support.router import make_authority

pytestmark = pytest.mark.slow

Record = Callable[[str, object], None]
"""pytest's `record_property`."""

PATIENCE_S = 1500.0
"""The first start compiles its kernels on the way."""

ROOT = "/srv/root"

COPY_OF_ROOT = f"""
set -e
mount --make-rprivate /
umount --lazy /sys/fs/cgroup 2>/dev/null || true
mount -t cgroup2 none /sys/fs/cgroup
mount -t tmpfs tmpfs /srv
mkdir /srv/changed /srv/work {ROOT}
mount -t overlay overlay -o lowerdir=/,upperdir=/srv/changed,workdir=/srv/work {ROOT}
"""
"""A copy of the root that forgets what is written to it. systemd wants the newer control groups, alone."""

STORY = """
set -u
show() { systemctl show coec --property=ActiveState,SubState,Result,ExecMainStatus,NRestarts,MainPID; }
# note NAME: what systemd says of the unit
note() { { echo "[$1]"; show; } >>/report/story; }
# until STATE SECONDS
until_state() { for _ in $(seq "$2"); do [ "$(systemctl is-active coec)" = "$1" ] && return; sleep 1; done; }
main_pid() { systemctl show coec --property=MainPID --value; }
configure() { install -D --mode=0644 "/given/$1.yaml" /etc/coec/coec.yaml; }

rm -rf /etc/coec
systemctl start coec; sleep 6; note "no configuration"
systemctl reset-failed coec
configure network; systemctl start --no-block coec; until_state failed 120; sleep 6; note "no network"
systemctl reset-failed coec
configure good; systemctl start coec; note "started"
ps -o user= -p "$(main_pid)" >/report/user
grep -E 'NoNewPrivs|CapEff|Seccomp:' "/proc/$(main_pid)/status" >/report/rights
systemctl reload coec; sleep 2; note "reloaded"
kill -KILL "$(main_pid)"; sleep 1; until_state active 600; note "killed"
kill -STOP "$(main_pid)"; sleep 45; until_state active 600; note "stuck"
begun="$(date +%s)"; systemctl stop coec; echo "$(($(date +%s) - begun))" >/report/stop_s; note "stopped"
LD_LIBRARY_PATH=/opt/python/lib /opt/python/bin/python -c 'import socket, time
taken = socket.create_server(("127.0.0.1", 7447))
time.sleep(1000)' & other=$!
sleep 1; systemctl start --no-block coec; sleep 15; note "port taken"
kill "$other"; until_state active 600; note "port free"
systemctl stop coec
# Keys that only root may read, as credentials of the unit.
install -D /given/credentials.conf /etc/systemd/system/coec.service.d/credentials.conf
systemctl daemon-reload
configure credentials; systemctl start coec; note "credentials"
systemctl stop coec
journalctl --unit=coec --output=cat >/report/journal
"""

PROBE = """
[Unit]
Description=What is done with the unit
[Service]
Type=oneshot
StandardOutput=file:/report/output
StandardError=file:/report/output
ExecStart=/bin/bash /given/story
ExecStopPost=/bin/systemctl --no-block poweroff
TimeoutStartSec=infinity
"""


def refusal() -> str | None:
    """Why this machine cannot boot systemd in a container; None: it can."""
    if sys.platform != "linux" or os.geteuid() != 0:
        return "needs root on Linux"
    for program in ("systemd-nspawn", "unshare"):
        if shutil.which(program) is None:
            return f"needs {program} (Debian: apt-get install systemd-container systemd util-linux)"
    tried = subprocess.run(["unshare", "--mount", "--cgroup", "sh", "-c", COPY_OF_ROOT], capture_output=True, text=True)
    return None if tried.returncode == 0 else f"this machine lets nobody mount a copy of its root: {tried.stderr}"


def configured(folder: Path, name: str, **changes: Any) -> None:
    document = YAML(typ="safe").load(template())
    document["zenoh"] |= {"embedded_router": True}
    document["state"] |= {"directory": "/var/lib/coec", "min_free_bytes": 0}
    document["pairs"][0]["calibration"]["depth"]["model"] = changes.pop("model", "stereo")
    with (folder / f"{name}.yaml").open("w") as stream:
        YAML().dump(document | changes, stream)


@pytest.fixture(scope="module")
def story(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Any]:
    """What systemd said of the unit at every step, and what the steps left behind."""
    why = refusal()
    if why is not None:
        pytest.skip(why)
    given, report = tmp_path_factory.mktemp("given"), tmp_path_factory.mktemp("report")
    (given / "story").write_text(STORY)
    configured(given, "good")
    configured(given, "network", model="absent.onnx")
    own = make_authority(given / "tls")
    files = {"certificate": "vehicle.pem", "private_key": "vehicle-key.pem", "root_ca": "ca.pem"}
    for file in files.values():
        (own.folder / file).chmod(0o600)
    loaded = "".join(f"LoadCredential={file}:/given/tls/{file}\n" for file in files.values())
    (given / "credentials.conf").write_text(f"[Service]\n{loaded}")
    places = {name: f"/run/credentials/coec.service/{file}" for name, file in files.items()}
    configured(given, "credentials", authority={"anonymous": "never", "senders": [{"name": "operator"}], **places})
    packages = site.getsitepackages()[0]
    # The interpreter finds its library where it was built for only outside of this sandbox.
    result = "LD_LIBRARY_PATH=/opt/python/lib PYTHONPATH=/opt/service:/opt/packages"
    program = f'#!/bin/sh\n{result} exec /opt/python/bin/python -m coec "$@"\n'
    prepare = f"""
    {COPY_OF_ROOT}
    rm -rf {ROOT}/etc/coec {ROOT}/opt/coec {ROOT}/var/lib/coec {ROOT}/var/cache/coec
    mkdir -p {ROOT}/opt/coec/bin {ROOT}/opt/python {ROOT}/opt/service {ROOT}/opt/packages {ROOT}/given {ROOT}/report
    printf '%s' "$PROGRAM" >{ROOT}/opt/coec/bin/coec
    chmod 0755 {ROOT}/opt/coec/bin/coec
    cp {DEPLOY}/coec.service {ROOT}/etc/systemd/system/coec.service
    printf '%s' "$PROBE" >{ROOT}/etc/systemd/system/probe.service
    printf '[Unit]\\nWants=probe.service\\nRequires=basic.target\\nAfter=basic.target\\n' \
        >{ROOT}/etc/systemd/system/probe.target
    ln -sf probe.target {ROOT}/etc/systemd/system/default.target
    exec systemd-nspawn --quiet --directory={ROOT} --register=no --keep-unit --private-network --console=pipe \
        --bind-ro={sys.base_prefix}:/opt/python --bind-ro={packages}:/opt/packages \
        --bind-ro={REPOSITORY / "service"}:/opt/service --bind-ro={given}:/given --bind={report}:/report \
        --machine=coec-test --boot
    """
    finished = subprocess.run(
        ["unshare", "--mount", "--cgroup", "bash", "-c", prepare],
        env={**os.environ, "PROGRAM": program, "PROBE": PROBE},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    text = (report / "story").read_text() if (report / "story").exists() else ""
    reported: dict[str, Any] = {"output": finished.stdout[-4000:] + finished.stderr[-4000:]}
    for part in text.split("[")[1:]:
        name, _, lines = part.partition("]\n")
        reported[name] = dict(line.split("=", 1) for line in lines.split())
    for path in report.iterdir():
        reported.setdefault(path.name, path.read_text())
    assert "journal" in reported, json.dumps(reported, indent=1)[-10_000:]
    return reported


@pytest.mark.fault(
    "no configuration, and one whose depth network is absent, under systemd",
    "exit code 78: the unit fails, and is not started again",
)
def test_what_no_restart_cures_is_not_started_again(story: Mapping[str, Any], record_property: Record) -> None:
    for name in ("no configuration", "no network"):
        assert (story[name]["ActiveState"], story[name]["ExecMainStatus"]) == ("failed", "78"), name
        assert story[name]["NRestarts"] == "0", name
    version = subprocess.run(["systemctl", "--version"], capture_output=True, text=True, check=True).stdout
    record_property("figure", " ".join(version.split()[:2]))


def test_it_starts_as_a_user_of_its_own_without_rights(story: Mapping[str, Any]) -> None:
    assert (story["started"]["ActiveState"], story["started"]["SubState"]) == ("active", "running"), story["journal"]
    assert story["user"].strip() == "coec"
    rights = dict(line.split(":\t") for line in story["rights"].splitlines())
    assert rights == {"CapEff": "0000000000000000", "NoNewPrivs": "1", "Seccomp": "2"}
    assert unit()["DynamicUser"] == ["yes"]


def test_a_reload_goes_on_with_the_same_process(story: Mapping[str, Any]) -> None:
    assert story["reloaded"]["ActiveState"] == "active"
    assert story["reloaded"]["MainPID"] == story["started"]["MainPID"]
    assert "the configuration on the disk is valid" in story["journal"]


@pytest.mark.fault("a service that is killed, or stopped by nobody and stuck, under systemd", "it is started again")
def test_a_service_that_is_killed_or_stuck_is_started_again(story: Mapping[str, Any]) -> None:
    assert (story["killed"]["ActiveState"], story["killed"]["NRestarts"]) == ("active", "1")
    assert (story["stuck"]["ActiveState"], story["stuck"]["NRestarts"]) == ("active", "2")
    assert story["stuck"]["MainPID"] != story["killed"]["MainPID"]


def test_a_stop_is_clean_and_within_its_time(story: Mapping[str, Any]) -> None:
    assert (story["stopped"]["ActiveState"], story["stopped"]["ExecMainStatus"]) == ("inactive", "0")
    assert int(story["stop_s"]) <= float(unit()["TimeoutStopSec"][0])


@pytest.mark.fault("the router's port is taken, under systemd", "exit code 75: tried again until it is free")
def test_a_port_that_is_taken_is_tried_until_it_is_free(story: Mapping[str, Any]) -> None:
    assert story["port taken"]["ExecMainStatus"] in ("75", "0"), "0: at this moment it tries again"
    assert int(story["port taken"]["NRestarts"]) >= 1
    assert story["port free"]["ActiveState"] == "active"


def test_keys_that_only_root_may_read_reach_it_as_credentials(story: Mapping[str, Any]) -> None:
    assert story["credentials"]["ActiveState"] == "active", story["journal"][-3000:]
