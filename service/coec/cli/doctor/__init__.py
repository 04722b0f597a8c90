"""`coec doctor`: what prevents a calibration on this computer, for the engineer at the vehicle.

It examines, in the order in which they depend on each other: the configuration, this computer, the way to the router,
the streams, the service. It changes nothing that runs, and works with and without a running service.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coec.cli.options import Json
from coec.errors import ConfigError, ModelError
from coec.reports import console
from coec.reports.formatting import count

if TYPE_CHECKING:
    import zenoh

    from coec.config import Config, OpenPairConfig
    from coec.io.zenoh.ros_node import RosTopicList
    from coec.schemas.documents import Finding

USUAL_FILE = Path("/etc/coec/coec.yaml")
"""Configuration that the systemd unit names."""

STYLES = {"ok": "green", "warn": "bold yellow", "fail": "bold red"}


def doctor(
    config: Annotated[
        Path | None,
        typer.Option(help="Configuration of the daemon (YAML).", metavar="FILE", show_default="/etc/coec/coec.yaml"),
    ] = None,
    seconds: Annotated[float, typer.Option(help="How long to listen to the streams.", min=0.5, max=600)] = 5.0,
    as_json: Json = False,
) -> int:
    """Find what prevents a calibration on this computer: exit 1 if something must be corrected first.

    Checks the configuration, disk, clock, certificates, router and its rules, streams, and the running service if
    there is one; changes and disturbs nothing.
    """
    from coec.schemas.documents import DoctorReport

    findings: list[Finding] = []
    for finding in examine(config or USUAL_FILE, seconds):
        findings.append(finding)
        if not as_json:
            _show(finding)
    report = DoctorReport(healthy=all(one.level != "fail" for one in findings), findings=tuple(findings))
    if as_json:
        console.print_json(report)
    else:
        counts = {level: sum(one.level == level for one in findings) for level in STYLES}
        console.show(", ".join(f"{count} {level}" for level, count in counts.items()), "bold")
    return 0 if report.healthy else 1


def examine(path: Path, seconds: float) -> Iterator[Finding]:
    """Everything, one finding after the other; listens to the streams for so many seconds.

    What cannot be examined because the configuration is broken is left out.
    """
    from coec.cli.doctor import environment
    from coec.io.zenoh.bus import closed

    config, finding = _configuration(path)
    yield finding
    yield environment.clock_finding()
    yield environment.kernels_finding()
    if config is None:
        return
    yield from _networks(config)
    yield from environment.state_findings(config.state)
    yield from environment.certificate_findings(config)
    reached = list(environment.router_findings(config))
    yield from reached
    if not any(one.check == "router" and one.level == "ok" for one in reached):
        return
    client = environment.session_of_client(config)
    yield environment.session_finding(config, client)
    if client is None:
        return
    with ExitStack() as sessions:
        sessions.callback(closed, client, environment.CLOSE_S)
        yield environment.mode_finding(config)
        session = environment.session_as_of_service(config)
        if session is None:
            yield environment.warn(
                "rules", config.vehicle, "the router accepts one session, not two", "raise its `max_sessions`"
            )
            return
        sessions.callback(closed, session, environment.CLOSE_S)
        yield environment.rules_finding(config, session, client)
        yield from _received(config, session, client, seconds)
        yield from environment.service_findings(client, config)


def _received(config: Config, session: zenoh.Session, client: zenoh.Session, seconds: float) -> Iterator[Finding]:
    """Findings on what a session as that of the service receives, compared with a client of the same router."""
    from coec.cli.doctor import streams
    from coec.io.zenoh.ros_node import RosSide

    ros, known = RosSide(session, config), RosSide(client, config)
    with console.progress(counted=False) as progress:
        task = progress.add_task("listening", total=seconds, note=count(len(config.every_pair), "pair"))
        samples = streams.listen(
            session, client, ros, config, seconds, lambda passed_s: progress.update(task, completed=passed_s)
        )
    here, there = ros.topics(), known.topics()
    ros.close()
    known.close()
    if config.middleware != "native":
        yield from streams.topic_findings(here, there, config)
    for pair, of_pair in zip(config.pairs, samples.pairs, strict=True):
        yield from streams.stream_findings(pair, of_pair, config, seconds, there)
    yield from (_undiscovered(pair, there) for pair in config.awaited)
    yield from streams.undiscovered_findings(samples.undiscovered, config, seconds, there)


def _configuration(path: Path) -> tuple[Config | None, Finding]:
    """The configuration, if a service could start with it, and the finding on it."""
    from coec.cli.doctor.environment import fail, ok
    from coec.config import load_config
    from coec.io.rig_files import check_given, rig_of
    from coec.io.zenoh.session import Endpoint, connected_of, listened_of, settings_of
    from coec.service.discovery import with_discovered

    advice = "correct it, or name another with --config; `coec check-config FILE` prints what a file comes to"
    try:
        config = load_config(path.resolve())  # absolute, as paths are in a service
        config = with_discovered(config)
        for pair in config.pairs:
            rig_of(pair)
        for undiscovered in config.awaited:
            check_given(undiscovered)
        settings = settings_of(config.zenoh, config.limits)
        for endpoint in (*connected_of(settings), *listened_of(settings)):
            Endpoint.parse(endpoint)
    except ConfigError as error:
        return None, fail("configuration", str(path), str(error), advice)
    names = ", ".join(pair.name for pair in config.every_pair)
    return config, ok("configuration", str(path), f"valid; vehicle {config.vehicle}, pairs {names}")


def _undiscovered(pair: OpenPairConfig, there: RosTopicList) -> Finding:
    """The finding on a pair whose nominal calibration no service has discovered yet."""
    from coec.cli.doctor.environment import warn

    absent = (there.absent(stream.topic, stream.types) for stream in pair.streams.values() if stream.topic)
    missing = [sentence for sentence in absent if sentence is not None]
    text = "; ".join(["what its configuration leaves out has not been found yet", *missing])
    return warn("nominal", pair.name, text, "start the service: its health says what is missing, and why")


def _networks(config: Config) -> Iterator[Finding]:
    """Findings on the depth networks, each once."""
    from coec.cli.doctor.environment import fail, ok
    from coec.io.depth.depth_maps import open_depth

    for depth in dict.fromkeys(pair.calibration.depth for pair in config.every_pair):
        try:
            opened = open_depth(depth, config.limits)
        except ModelError as error:
            yield fail("network", depth.model, str(error), "copy the file there, or name another (`coec models`)")
        else:
            yield ok("network", depth.model, f"loads; identity {opened.identity[:16]}")


def _show(finding: Finding) -> None:
    from rich.text import Text

    line = Text(f"{finding.level:<5}", STYLES[finding.level])
    line.append(f"{finding.check:<14}", "")
    line.append(finding.text if not finding.where else f"{finding.where}: {finding.text}", "")
    console.out.print(line, soft_wrap=True)
    if finding.advice is not None:
        console.show(f"     → {finding.advice}", "dim")
