"""`coec doctor`: what keeps this computer from a calibration, for the engineer at the vehicle.

It examines, in the order in which they depend on each other: the configuration, this computer, the way to the router,
the streams, the service. It changes nothing that runs, and works with and without a running service.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import zenoh
from rich.text import Text

from coec.adapters.depth.maps import open_depth
from coec.adapters.files.rig import check_given, rig_of
from coec.adapters.zenoh.bus import closed
from coec.adapters.zenoh.endpoints import Endpoint
from coec.adapters.zenoh.ros_side import RosSide
from coec.adapters.zenoh.ros_topics import Topics
from coec.adapters.zenoh.settings import connected_of, listened_of, settings_of
from coec.cli.commands.doctor import Options
from coec.cli.doctor import machine, router, service, streams, topics
from coec.cli.doctor.found import fail, ok, warn
from coec.cli.doctor.listening import listen
from coec.config import Config, OpenPairConfig, load_config
from coec.errors import ConfigError, ModelError
from coec.reports import console
from coec.reports.page.words import count
from coec.runtime.nominal.kept import with_kept
from coec.schemas.doctor import DoctorReport, Finding, Level

USUAL_FILE = Path("/etc/coec/coec.yaml")
"""Configuration that the systemd unit names."""

STYLES: dict[Level, str] = {"ok": "green", "warn": "bold yellow", "fail": "bold red"}


def run(options: Options) -> int:
    """Examines everything and prints the findings; returns 1 if something failed."""
    findings: list[Finding] = []
    for finding in examine(options.config or USUAL_FILE, options.seconds):
        findings.append(finding)
        if not options.as_json:
            _show(finding)
    report = DoctorReport(healthy=all(one.level != "fail" for one in findings), findings=tuple(findings))
    if options.as_json:
        console.print_json(report.model_dump(mode="json"))
    else:
        counts = {level: sum(one.level == level for one in findings) for level in STYLES}
        console.show(", ".join(f"{count} {level}" for level, count in counts.items()), "bold")
    return 0 if report.healthy else 1


def examine(path: Path, seconds: float) -> Iterator[Finding]:
    """Everything, one finding after the other; listens to the streams for so many seconds.

    What cannot be examined because the configuration is broken is left out.
    """
    config, complaint = _configuration(path)
    yield complaint
    yield machine.clock_finding()
    yield machine.kernels_finding()
    if config is None:
        return
    yield from _networks(config)
    yield from machine.state_findings(config.state)
    yield from router.certificate_findings(config)
    reached = list(router.router_findings(config))
    yield from reached
    if not any(one.check == "router" and one.level == "ok" for one in reached):
        return
    beside = router.session_beside(config)
    yield router.session_finding(config, beside)
    if beside is None:
        return
    with ExitStack() as sessions:
        sessions.callback(closed, beside, router.CLOSE_S)
        yield router.mode_finding(config)
        session = router.session_as_of_service(config)
        if session is None:
            yield warn("rules", config.vehicle, "the router takes one session, not two", "raise its `max_sessions`")
            return
        sessions.callback(closed, session, router.CLOSE_S)
        yield router.rules_finding(config, session, beside)
        yield from _received(config, session, beside, seconds)
        yield from service.service_findings(beside, config)


def _received(config: Config, session: zenoh.Session, beside: zenoh.Session, seconds: float) -> Iterator[Finding]:
    """Findings on what comes through a session as the service has it, compared with the client `beside` it."""
    ros, known = RosSide(session, config), RosSide(beside, config)
    with console.progress(counted=False) as progress:
        task = progress.add_task("listening", total=seconds, note=count(len(config.every_pair), "pair"))
        heard = listen(
            session, beside, ros, config, seconds, lambda passed_s: progress.update(task, completed=passed_s)
        )
    here, there = ros.topics(), known.topics()
    ros.close()
    known.close()
    if config.middleware != "native":
        yield from topics.topic_findings(here, there, config)
    for pair, streams_heard in zip(config.pairs, heard.pairs, strict=True):
        yield from streams.stream_findings(pair, streams_heard, config, seconds, there)
    yield from (_awaited(pair, there) for pair in config.awaited)
    yield from streams.awaited_findings(heard.awaited, config, seconds, there)


def _configuration(path: Path) -> tuple[Config | None, Finding]:
    """The configuration, if a service could start with it, and the finding on it."""
    advice = "correct it, or name another with --config; `coec check-config FILE` prints what a file comes to"
    try:
        config = load_config(path.resolve())  # absolute, as paths are in a service
        config = with_kept(config)
        for pair in config.pairs:
            rig_of(pair)
        for awaited in config.awaited:
            check_given(awaited)
        settings = settings_of(config.zenoh, config.limits)
        for endpoint in (*connected_of(settings), *listened_of(settings)):
            Endpoint.parse(endpoint)
    except ConfigError as error:
        return None, fail("configuration", str(path), str(error), advice)
    names = ", ".join(pair.name for pair in config.every_pair)
    return config, ok("configuration", str(path), f"valid; vehicle {config.vehicle}, pairs {names}")


def _awaited(pair: OpenPairConfig, there: Topics) -> Finding:
    """The finding on a pair whose nominal calibration no service has found yet."""
    absent = (there.absent(stream.topic, stream.types) for stream in pair.streams.values() if stream.topic)
    told = [sentence for sentence in absent if sentence is not None]
    text = "; ".join(["what its configuration leaves out has not been found yet", *told])
    return warn("nominal", pair.name, text, "start the service: its health says what is missing, and why")


def _networks(config: Config) -> Iterator[Finding]:
    """Findings on the depth networks, each once."""
    for depth in dict.fromkeys(pair.calibration.depth for pair in config.every_pair):
        try:
            opened = open_depth(depth, config.limits)
        except ModelError as error:
            yield fail("network", depth.model, str(error), "copy the file there, or name another (`coec models`)")
        else:
            yield ok("network", depth.model, f"loads; identity {opened.identity[:16]}")


def _show(finding: Finding) -> None:
    line = Text(f"{finding.level:<5}", STYLES[finding.level])
    line.append(f"{finding.check:<14}", "")
    line.append(finding.text if not finding.where else f"{finding.where}: {finding.text}", "")
    console.out.print(line, soft_wrap=True)
    if finding.advice is not None:
        console.show(f"     → {finding.advice}", "dim")
