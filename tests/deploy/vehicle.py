"""The deployment on a vehicle's computer, as the files say: built, started, asked, stopped; in a world that watches.

A program for namespaces of its own, see `test_vehicle.py`: it becomes what the deployment expects of its machine, and
writes down what it saw. Everything that it changes is gone with it.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

from coec import geometry
from coec.cli.options import service_address
from coec.config import CalibrationConfig, DepthConfig, WindowConfig, load_config
from coec.errors import RemoteError
from coec.geometry.compiler import kernel_cache_directory
from coec.io.zenoh.query_client import connected, connected_by, query_all, query_one
from coec.reports.commented_yaml import commented_yaml
from conftest import REPOSITORY
from deploy.container import Container, enter_copy_of_root, forget, take_steps, use_interpreter_as_image_does
from deploy.manager import listening
from deploy.world import NAME_SERVER, leave_for_another, open_sockets, watched
from deploy.written import DEPLOY, compose, exec_start, stages
from e2e.drives import SHORT, SHORT_PAIRS, rendered
from e2e.processes import PATIENCE_S, Service, write_configuration
from support.fake_worker import wait_until

GATEWAY = "192.0.2.1"
"""The host, as a container on a network of its own knows it."""

ROUTER = (("127.0.0.1", 7447), (GATEWAY, 7448))
"""The router's doors, as `deploy/router.json5` has them."""

CONFIGURATION = Path("/etc/coec/coec.yaml")

NOTIFY_SOCKET = Path("/run/notify")
"""The manager's: nobody reads it but where that is looked at."""

QUERY_AGAIN = ("busy", "not_drawn")
"""Refusals that say so: the worker is at work."""


@dataclass
class Vehicle:
    """What is built and what was seen.

    Attributes:
        real: whether /opt/coec holds what the Dockerfile built; else this checkout's programs stand for it.
        reported: name of a step to what came of it.
    """

    real: bool
    reported: dict[str, Any] = field(default_factory=dict)

    def container(self, name: str) -> Container:
        """Of a service in the compose file."""
        service = dict(compose()[name])
        if not self.real:
            # The checkout may lie below a folder that is empty in the container.
            service.pop("read_only")
        return Container(stages()[-1], service)

    def command(self, name: str) -> list[str]:
        """Entry point and arguments of a service, as they are written."""
        image = stages()[-1]
        arguments = compose()[name].get("command") or image.last("CMD").labels()
        return [*image.last("ENTRYPOINT").labels(), *arguments]

    def check(self, name: str) -> list[str]:
        """The health check of a service: its own, or that of the image."""
        own = compose()[name].get("healthcheck")
        if own is None:
            return stages()[-1].health_check
        kind, *command = own["test"]
        assert kind == "CMD"
        return [str(word) for word in command]

    def health(self, name: str) -> int:
        """Exit status of a service's health check."""
        container = self.container(name)
        command = container.command(self.check(name))
        checked = subprocess.run(command, env=container.environment, capture_output=True, timeout=PATIENCE_S)
        if checked.returncode:
            print(f"--- unwell: {name}", checked.stderr.decode(errors="replace")[-2000:], sep="\n", file=sys.stderr)
        return checked.returncode

    @contextmanager
    def running(self, name: str, *more: str) -> Iterator[subprocess.Popen[bytes]]:
        """A service, with further arguments, until it has ended; what it says is in /var/log/NAME.log."""
        container = self.container(name)
        command = container.command([*self.command(name), *more])
        environment = {**container.environment, "NOTIFY_SOCKET": str(NOTIFY_SOCKET)}
        with Path(f"/var/log/{name}.log").open("wb") as log:
            process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
        try:
            yield process
        finally:
            process.kill()
            process.wait()

    def stop(self, name: str, process: subprocess.Popen[bytes]) -> None:
        """As the engine does: its signal, and so much time as the compose file gives."""
        grace_s = float(compose()[name]["stop_grace_period"].removesuffix("s"))
        process.send_signal(signal.SIGTERM)
        self.reported[f"{name}: exit"] = process.wait(grace_s)


@dataclass(frozen=True, slots=True)
class Story:
    """What is done.

    Attributes:
        build: take the Dockerfile's steps; else this checkout's programs stand for what they build.
        configurations: of the service, each of which it is started with to see its sockets; below the checkout.
        networks: depth networks, each for a pair of its own.
        commands: arguments of `coec` from this checkout.
        chatter: a Python program that the world must notice.
        settle_s: for so long the service runs at least.
    """

    build: bool
    configurations: Sequence[str]
    networks: Sequence[str]
    commands: Sequence[Sequence[str]]
    chatter: str
    settle_s: float


def main(story: Story) -> None:
    """Everything in its order; prints the report, as the last line."""
    enter_copy_of_root()
    forget("/build", "/etc/coec", "/etc/zenoh", "/opt/coec", "/var/cache/coec", "/var/lib/coec")
    use_interpreter_as_image_does()
    vehicle = Vehicle(story.build)
    if story.build:
        for stage in stages():
            take_steps(stage, built=stage is not stages()[0])
        vehicle.reported["installed"] = sorted(path.name for path in Path("/opt/coec/sbom").iterdir())
    else:
        stand_in()
        take_steps(stages()[-1], built=True)
    prepare(build=story.build)
    leave_for_another()
    with watched() as world:
        live(vehicle, story)
        if story.build:
            vehicle.reported["unit: exit without a configuration"] = started_without_configuration(vehicle)
        vehicle.reported["commands"] = [finished(["coec", *text]) for text in story.commands]
        vehicle.reported["strangers"] = world.strangers(ROUTER)
        vehicle.reported["packets"] = sum(world.packets.values())
        vehicle.reported["names asked"] = list(world.names_requested)
        before = sum(world.strangers(ROUTER).values())
        subprocess.run([sys.executable, "-c", story.chatter], check=True)
        wait_until(
            # The socket that sees packets is read by another thread than the listener's.
            lambda: bool(world.reported and world.names_requested) and sum(world.strangers(ROUTER).values()) > before,
            "what the control said, at the listener and among the packets",
            PATIENCE_S,
        )
        vehicle.reported["control"] = [
            sum(world.strangers(ROUTER).values()) - before,
            world.names_requested,
            len(world.reported),
        ]
    vehicle.reported["unseen"] = world.unseen
    print(json.dumps(vehicle.reported))


def stand_in() -> None:
    """/opt/coec, as far as commands are concerned: this checkout's, with its interpreter and its packages."""
    folder = Path("/opt/coec/bin")
    folder.mkdir(parents=True)
    for name, text in (("coec", "-m coec"), ("python", "")):
        script = folder / name
        script.write_text(f'#!/bin/sh\nPYTHONPATH={REPOSITORY / "service"} exec {sys.executable} {text} "$@"\n')
        script.chmod(0o755)


def prepare(*, build: bool) -> None:
    """What the deployment expects of its machine: names, certificates, and the files that its volumes bring."""
    Path("/etc/resolv.conf").unlink()
    Path("/etc/resolv.conf").write_text(f"nameserver {NAME_SERVER}\n")
    hosts = "\n".join(line.replace(":host-gateway", "") for line in compose()["observer"]["extra_hosts"])
    Path("/etc/hosts").write_text(f"127.0.0.1 localhost\n{GATEWAY} {hosts}\n")
    subprocess.run([DEPLOY / "make-test-ca", "/etc/made", "router"], check=True, stdout=sys.stderr)
    for service in compose().values():
        for volume in service["volumes"]:
            origin, target, *_ = volume.split(":")
            if origin.startswith("./"):
                source = Path("/etc/made") / Path(origin).name if "/tls/" in origin else DEPLOY / origin
                Path(target).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(source, target)
                # A mounted file keeps its owner: who may read the keys is for `make-test-ca` to see to.
                os.chown(target, source.stat().st_uid, source.stat().st_gid)
    kernels = kernel_cache_directory(Path(geometry.__file__).parent)
    if not build:
        # Compiling them is no part of what is looked at.
        folder = Path("/var/cache/coec") / kernels.name
        shutil.copytree(kernels, folder)
        for path in (folder, *folder.rglob("*")):
            os.chown(path, *owner_of_image())


def owner_of_image() -> tuple[int, int]:
    """User and group that the programs of the image run as."""
    user, group = stages()[-1].last("USER").text.split(":")
    return int(user), int(group)


def live(vehicle: Vehicle, story: Story) -> None:
    """The router, the service as it is shipped, then with a drive, and the observer; each asked whether it is well."""
    reported = vehicle.reported
    for configuration in story.configurations:
        note_sockets(vehicle, configuration, "--embedded-router")
    with vehicle.running("router") as router:
        wait_until(lambda: lives(router) and bool(sockets_of(router)), "the router", PATIENCE_S)
        reported["router: health"] = vehicle.health("router")
        reported["router: sockets"] = sockets_of(router)
        reported["coec: unwell before it runs"] = vehicle.health("coec")
        for configuration in story.configurations:
            note_sockets(vehicle, configuration)
        drive = rendered(SHORT)
        configure(drive.recording, story.networks)
        with (
            connected(["tcp/127.0.0.1:7447"], PATIENCE_S) as session,
            listening(NOTIFY_SOCKET) as report,
            vehicle.running("coec") as process,
        ):
            service = Service(process, session, load_config(CONFIGURATION), Path("/var/log/coec.log"))
            with vehicle.running("observer") as observer:
                service.until(service.status, lambda status: status["state"] == "running", "a warm worker")
                started_s = time.monotonic()
                service.send(drive.frames)
                reported["solved"] = calibrated(service)
                reported["answers"] = requests(service)
                reported["viewer"] = rights_of_viewer(service)
                reported["coec: health"] = vehicle.health("coec")
                reported["observer: health"] = vehicle.health("observer")
                reported["observer: sockets"] = sockets_of(observer)
                reported["coec: sockets"] = sockets_of(process)
                reported["users"] = sorted({psutil.Process(pid).username() for pid in family(process)})
                reported["capabilities"] = sorted({capabilities(pid) for pid in family(process)})
                programs = {"router": router, "coec": process, "observer": observer}
                reported["memory"] = {name: resident(program) for name, program in programs.items()}
                time.sleep(max(0.0, story.settle_s - (time.monotonic() - started_s)))
                reported["lived_s"] = time.monotonic() - started_s
                vehicle.stop("coec", process)
                wait_until(lambda: '"value":false' in Path("/var/log/observer.log").read_text(), "its word", PATIENCE_S)
                vehicle.stop("observer", observer)
            reported["manager: told"] = list(dict.fromkeys(report))
        reported["observer: heard"] = received(Path("/var/log/observer.log"))
        vehicle.stop("router", router)


def note_sockets(vehicle: Vehicle, configuration: str, *more: str) -> None:
    """Which sockets the service opens, with a configuration and further arguments, that it answers with."""
    shutil.copy(REPOSITORY / configuration, CONFIGURATION)
    with vehicle.running("coec", *more) as process:
        wait_until(
            lambda: lives(process) and vehicle.health("coec") == 0, f"the service of {configuration}", PATIENCE_S
        )
        table = vehicle.reported.setdefault("sockets by configuration", {})
        table[" ".join((configuration, *more))] = sockets_of(process)
        vehicle.stop("coec", process)


def started_without_configuration(vehicle: Vehicle) -> int:
    """Exit status of what the unit starts."""
    CONFIGURATION.unlink()
    container = vehicle.container("coec")
    return subprocess.run(container.command(exec_start()), env=container.environment, stdout=sys.stderr).returncode


def configure(recording: Any, networks: Sequence[str]) -> None:
    """A pair for each network, all of them of the same streams."""
    window = WindowConfig(pairs=SHORT_PAIRS, min_pairs=3, slice_s=12, min_points_in_view=100)
    path = write_configuration(CONFIGURATION.parent, recording, "tcp/127.0.0.1:7447", window=window)
    config = load_config(path)
    (pair,) = config.pairs
    pairs = [
        pair.model_copy(
            update={"name": f"p{number}", "calibration": CalibrationConfig(depth=DepthConfig(model=network))}
        )
        for number, network in enumerate(networks)
    ]
    state = config.state.model_copy(update={"directory": Path("/var/lib/coec")})
    path.write_text(commented_yaml(config.model_copy(update={"pairs": tuple(pairs), "state": state})))


def calibrated(service: Service) -> dict[str, str]:
    """Every pair's decision about its window, by its network."""
    return {pair.calibration.depth.model: decision_of(service, pair.name) for pair in service.config.pairs}


def decision_of(service: Service, pair: str) -> str:
    """About the window that is taken now."""

    def calibrate() -> Any:
        return service.query(service.keys.command(pair, "calibrate"))

    def history() -> Any:
        return service.query(service.keys.history(pair))

    service.until(calibrate, lambda report: bool(report["accepted"]), f"a window of {pair}")
    report = service.until(history, lambda report: report["total"] > 0, f"a solve of {pair}")
    return str(report["results"][0]["verdict"]["decision"])


def requests(service: Service) -> dict[str, str]:
    """Asks for everything that there is; what came of each."""
    keys, pair = service.keys, service.pair
    (window, *_) = service.windows()
    requested = [
        keys.status, keys.config, keys.metrics, keys.extrinsic(pair), keys.health(pair), keys.history(pair),
        keys.windows(pair), keys.window(pair, window["window_id"]), keys.overlay(pair), keys.evidence(pair),
    ]  # fmt: skip
    answers: dict[str, str] = {}
    for key in requested:

        def report(key: str = key) -> bool:
            answers[key] = answer_of(service, key)
            return answers[key] not in QUERY_AGAIN

        wait_until(report, f"an answer to {key}", PATIENCE_S)
    return answers


def rights_of_viewer(service: Service) -> dict[str, str]:
    """What comes of a question and of a command from whoever has the observer's certificate and key."""
    keys, pair = service.keys, service.pair
    (file,) = [Path(word) for word in compose()["observer"]["command"] if word.endswith(".json5")]
    result = {}
    with connected_by(service_address(None, None, None, None, file).way, PATIENCE_S) as viewer:
        for name, key in (("health", keys.health(pair)), ("command", keys.command(pair, "hold"))):
            replies = query_all(viewer, key, PATIENCE_S)
            result[name] = "answered" if replies else "nothing"
    return result


def answer_of(service: Service, key: str) -> str:
    """`answered`, or the code of the refusal."""
    try:
        query_one(service.session, key, PATIENCE_S)
    except RemoteError as error:
        return error.reply_code
    return "answered"


def lives(process: subprocess.Popen[bytes]) -> bool:
    """True; fails where what is waited for will never come."""
    assert process.poll() is None, f"it has ended, with {process.returncode}"
    return True


def family(process: subprocess.Popen[bytes]) -> list[int]:
    """A service and the processes that it has started."""
    return [process.pid, *(child.pid for child in psutil.Process(process.pid).children(recursive=True))]


def resident(process: subprocess.Popen[bytes]) -> int:
    """Bytes of memory that a service has in all its processes."""
    return sum(psutil.Process(pid).memory_info().rss for pid in family(process))


def sockets_of(process: subprocess.Popen[bytes]) -> list[str]:
    """What a service listens on, all its processes."""
    return sorted(open_sockets(family(process)))


def capabilities(pid: int) -> str:
    """What a process may do beyond its user's rights, or could come to: hexadecimal."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    fields = dict(line.split(":", 1) for line in lines)
    return " ".join(f"{name} {int(fields[name], 16):x}" for name in ("CapPrm", "CapEff", "CapBnd", "NoNewPrivs"))


def received(log: Path) -> dict[str, list[str]]:
    """What the observer has written, by kind: of health its state, of presence whether the pair is served."""
    result: dict[str, list[str]] = {}
    for line in log.read_text().splitlines():
        document = json.loads(line)
        kind, value = str(document["key"]).rpartition("/")[2], document["value"]
        essence = {"health": "state", "extrinsic": "status"}.get(kind)
        result.setdefault(kind, []).append(str(value if essence is None else value[essence]))
    return result


def finished(command: Sequence[str]) -> int:
    """Exit status of a command of this checkout, with its optional extras."""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY / "service")}
    whole = [sys.executable, "-m", *command]
    return subprocess.run(whole, env=environment, stdout=sys.stderr, cwd="/tmp").returncode


def reported_all() -> None:
    """What the programs have said, for whoever looks for a fault."""
    for log in Path("/var/log").glob("*.log"):
        if log.stem in compose():
            print(f"--- {log.stem}", log.read_text()[-4000:], sep="\n", file=sys.stderr)


if __name__ == "__main__":
    try:
        main(Story(**json.loads(sys.argv[1])))
    except BaseException:
        reported_all()
        raise
