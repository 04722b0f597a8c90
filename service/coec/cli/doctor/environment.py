"""Findings of `coec doctor` on what a service stands on: this computer (its disk, its clock, whether kernels are
compiled), the way to the router (whether it answers, certificates, Zenoh, access rules), and what a running service
reports about itself; and what makes a finding.
"""

import errno
import json
import os
import socket
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import zenoh

from coec import __version__
from coec.config import Config, StateConfig
from coec.errors import CoecError, NotFoundError, UnavailableError
from coec.io.system import clock_state, lock_holder
from coec.io.zenoh import session as zenoh_session
from coec.io.zenoh.bus import closed, is_connected, open_session
from coec.io.zenoh.query_client import query_all, query_one
from coec.schemas.documents import Finding, Level
from coec.schemas.keys import Keys
from coec.schemas.message import from_json, json_value
from coec.schemas.replies import HealthReply, StatusReply
from coec.service.api.problems import PROBLEMS
from coec.service.configuration import differing, redacted_configuration

MIB = 2**20

PROBE_BYTES = 16 * MIB
"""Written to measure the disk, and removed: four camera-LiDAR pairs of full size."""

SLOW_MIB_PER_S = 10.0
"""Three times what an urgent window takes: a pair of 4 MB every 1.2 s."""

CLOCK_LIMIT_S = 1.0
"""Largest error of the clock that the kernel may estimate."""


def ok(check: str, where: str, text: str) -> Finding:
    """A finding that needs no action."""
    return Finding(check=check, level="ok", where=where, text=text)


def warn(check: str, where: str, text: str, advice: str) -> Finding:
    """A finding that should be seen to, although the service can work."""
    return Finding(check=check, level="warn", where=where, text=text, advice=advice)


def fail(check: str, where: str, text: str, advice: str) -> Finding:
    """A finding with which the service cannot do its work."""
    return Finding(check=check, level="fail", where=where, text=text, advice=advice)


def state_findings(state: StateConfig) -> Iterator[Finding]:
    """Whether the state directory exists, belongs to this user, is not in use, and is large and fast enough."""
    folder, where = state.directory, str(state.directory)
    try:
        there = folder.exists()
        above = next(parent for parent in folder.resolve().parents if parent.exists())
    except OSError as error:
        advice = "give the user of the service access to the path, or set another state.directory"
        yield fail("state", where, f"cannot be accessed: {error.strerror}", advice)
        return
    if not there:
        if os.access(above, os.W_OK | os.X_OK):
            yield ok("state", where, "does not exist yet; the service creates it")
        else:
            advice = f"create it and make the user of the service its owner; {above} is not writable for this user"
            yield fail("state", where, "does not exist, and this user cannot create it", advice)
        return
    yield _ownership(folder)
    holder = lock_holder(folder / "lock")
    if holder is not None:
        who = f"process {holder}" if holder else "a process"
        yield ok("lock", where, f"locked by {who}: a service runs here")
    else:
        yield ok("lock", where, "not locked: no service runs here")
    yield from _disk(folder, state.min_free_bytes)


def clock_finding() -> Finding:
    """Whether something synchronises the computer's clock."""
    clock = clock_state()
    if clock is None:
        return warn(
            "clock", "", "the system does not report whether its clock is synchronised", "query its NTP or PTP daemon"
        )
    if not clock.synchronised or clock.max_error_s > CLOCK_LIMIT_S:
        return warn(
            "clock",
            "",
            f"the clock of this computer is not synchronised; its error may be {clock.max_error_s:.1f} s or more",
            "set up PTP, chrony or systemd-timesyncd; stamps of sensors with other clocks are not comparable with it",
        )
    return ok("clock", "", f"synchronised within {1e3 * clock.max_error_s:.1f} ms")


def kernels_finding() -> Finding:
    """Whether the first start has to compile kernels."""
    from numba import config as numba_config

    import coec.geometry.compiler  # noqa: F401  says where the cache is

    folder = Path(numba_config.CACHE_DIR)  # type: ignore[attr-defined]
    compiled = sum(1 for _ in folder.rglob("*.nbi"))
    if compiled:
        return ok("kernels", str(folder), f"{compiled} kernels are compiled, for this user")
    return warn(
        "kernels",
        str(folder),
        "no kernel is compiled for this user: the first start takes a minute or two longer",
        "nothing, or start the service once before the vehicle needs it; its own user has its own cache "
        "($XDG_CACHE_HOME)",
    )


def _ownership(folder: Path) -> Finding:
    where = str(folder)
    try:
        status = folder.stat()
    except OSError as error:
        return fail("state", where, f"cannot be accessed: {error.strerror}", "check its owner and the disk")
    if not stat.S_ISDIR(status.st_mode):
        return fail("state", where, "is not a directory", "set another state.directory")
    if not os.access(folder, os.W_OK | os.X_OK):
        advice = f"make the user of the service its owner (the owner is {status.st_uid}, this is {os.geteuid()})"
        return fail("state", where, "not writable for this user", advice)
    if status.st_uid != os.geteuid():
        text = f"belongs to user {status.st_uid}; this is {os.geteuid()}"
        return warn("state", where, text, "run the doctor as the user of the service to be sure")
    if status.st_mode & stat.S_IWOTH:
        advice = f"chmod o-w {where}: what is read back from there is trusted"
        return warn("state", where, "writable for every user", advice)
    return ok("state", where, "exists and belongs to this user")


def _disk(folder: Path, min_free_bytes: int) -> Iterator[Finding]:
    where = str(folder)
    try:
        status = os.statvfs(folder)
    except OSError as error:
        yield fail("disk", where, f"cannot be queried: {error.strerror}", "check the disk")
        return
    free = status.f_bavail * status.f_frsize
    text = f"{free / MIB:.0f} MiB are free, {min_free_bytes / MIB:.0f} MiB must stay free (state.min_free_bytes)"
    if free < min_free_bytes:
        yield fail("disk", where, f"{text}: no window is recorded", "free space, or lower the limit")
    elif free < 2 * min_free_bytes:
        yield warn("disk", where, text, "free space soon: the oldest windows are deleted first")
    else:
        yield ok("disk", where, text)
    yield _speed(folder)


def _speed(folder: Path) -> Finding:
    where = str(folder)
    data = os.urandom(MIB)
    started_s = time.monotonic()
    try:
        descriptor, name = tempfile.mkstemp(prefix=".doctor-", dir=folder)
        try:
            for at in range(0, PROBE_BYTES, MIB):
                os.pwrite(descriptor, data, at)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
            Path(name).unlink(missing_ok=True)
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        advice = "free space: windows and history cannot be written" if full else "check the disk and its permissions"
        return fail("writing", where, f"cannot be written: {error.strerror}", advice)
    speed = PROBE_BYTES / MIB / max(time.monotonic() - started_s, 1e-6)
    text = f"{speed:.0f} MiB/s, with fsync"
    if speed < SLOW_MIB_PER_S:
        advice = "use a faster disk or smaller frames: pairs that arrive faster than they are written are lost"
        return warn("writing", where, f"slow: {text}", advice)
    return ok("writing", where, text)


CONNECT_S = 3.0
"""Timeout of each step; a router on the same network answers in milliseconds."""

CLOSE_S = 3.0

QUERY_PERIOD_S = 0.05
"""Time between two queries for a token that the router may not have forwarded yet; nothing announces a refusal."""

SEEN_S = 3.0
"""Timeout for our own liveliness token to come back from the router."""

EXPIRES_SOON_DAYS = 30.0

OVER_TCP = frozenset({"tcp", "tls", "ws"})

DAY_S = 86_400.0

TIMEOUT_S = 3.0

OF_THE_COMMAND_LINE = frozenset({"zenoh.embedded_router", "state.directory"})
"""Configuration values that options of `coec run` override."""

PLACES_NAMED = 5

LEVELS: dict[int, Level] = {0: "ok", 1: "warn", 2: "fail", 3: "warn"}
"""Level of a finding by ROS level; STALE, when nothing was checked yet, is no failure."""


def certificate_findings(config: Config) -> Iterator[Finding]:
    """Findings on the certificates that the service shows, read from the disk."""
    settings = zenoh_session.settings_of(config.zenoh, config.limits)
    seen: set[str] = set()
    roles: tuple[tuple[Literal["connect", "listen"], tuple[str, ...]], ...] = (
        ("connect", zenoh_session.connected_of(settings)),
        ("listen", zenoh_session.listened_of(settings)),
    )
    for role, endpoints in roles:
        for endpoint in (zenoh_session.Endpoint.parse(text) for text in endpoints):
            material = zenoh_session.tls_files(settings, endpoint, role)
            where = str(material.certificate)
            if endpoint.protocol not in zenoh_session.CERTIFIED or material.certificate is None or where in seen:
                continue
            seen.add(where)
            try:
                yield _dated("certificate", where, zenoh_session.read_certificate(material, role))
            except zenoh_session.CertificateError as error:
                advice = "have the authority that the router trusts issue a new one; see `deploy/`"
                yield fail("certificate", where, str(error), advice)


def router_findings(config: Config) -> Iterator[Finding]:
    """Findings on every endpoint of the router, each as far as it answers."""
    settings = zenoh_session.settings_of(config.zenoh, config.limits)
    for text in _endpoints(settings, config):
        endpoint = zenoh_session.Endpoint.parse(text)
        if endpoint.protocol in zenoh_session.WITH_PORT and endpoint.protocol in OVER_TCP:
            yield from _reached(settings, endpoint, zenoh_session.redacted(text))
        else:
            yield ok("router", zenoh_session.redacted(text), "only Zenoh can check whether this endpoint answers")


def session_of_client(config: Config) -> zenoh.Session | None:
    """A client session with the router that uses the certificate of the service; None when none comes about."""
    zenoh.init_log_from_env_or("off")
    settings = zenoh_session.settings_of(config.zenoh, config.limits)
    endpoints = _endpoints(settings, config)
    settings = zenoh_session.to_observer(settings)
    settings.insert_json5("connect/endpoints", json.dumps(endpoints))
    try:
        return zenoh_session.open_client(settings, CONNECT_S)
    except zenoh.ZError:
        return None


def session_as_of_service(config: Config) -> zenoh.Session | None:
    """A session as the service opens it, which therefore receives what the service receives; None when none comes
    about. Where the service is the router itself: a client of it."""
    if zenoh_session.mode_of(zenoh_session.settings_of(config.zenoh, config.limits)) == "router":
        return session_of_client(config)
    zenoh.init_log_from_env_or("off")
    try:
        session = open_session(config.zenoh, config.limits, again=True)
    except UnavailableError:
        return None
    deadline_s = time.monotonic() + CONNECT_S
    while not is_connected(session):
        if time.monotonic() > deadline_s:
            closed(session, CLOSE_S)
            return None
        time.sleep(QUERY_PERIOD_S)
    return session


def session_finding(config: Config, session: zenoh.Session | None) -> Finding:
    """Whether what answers is a Zenoh router that accepts this session."""
    where = ", ".join(
        zenoh_session.redacted(text)
        for text in _endpoints(zenoh_session.settings_of(config.zenoh, config.limits), config)
    )
    if session is None:
        return fail(
            "session",
            where,
            "no Zenoh session can be opened",
            "start the router; if something answers, it is another program (a wrong port?), or the "
            "router accepts no more sessions (`max_sessions`)",
        )
    routers = [str(one) for one in session.info.routers_zid()]
    return ok("session", where, f"a session with router {', '.join(routers) or 'none, but a peer'}")


def mode_finding(config: Config) -> Finding:
    """How the service takes part, and from whom it therefore receives."""
    settings = zenoh_session.settings_of(config.zenoh, config.limits)
    mode = zenoh_session.mode_of(settings)
    where = "zenoh" if config.zenoh.file is None else str(config.zenoh.file)
    if mode == "router":
        return ok("mode", where, "the service is the router itself: it receives from clients and from peers")
    if mode == "client":
        return ok("mode", where, "the service is a client: it receives from clients and peers of its router")
    if zenoh_session.finds_peers(settings):
        text = "the service is a peer: it receives from clients of its router, and from peers that gossip makes known"
        return ok("mode", where, text)
    cause, advice = cause_of_silence(config)
    return warn("mode", where, cause, advice)


def cause_of_silence(config: Config) -> tuple[str, str]:
    """Why the service does not receive what a client of the same router receives, and what to do about it."""
    settings = zenoh_session.settings_of(config.zenoh, config.limits)
    if zenoh_session.mode_of(settings) != "peer":
        advice = "check the router's rules for this certificate (docs/security.md)"
        return "the router forwards it to others", advice
    client = "leave `mode`, `listen` and `scouting` out of zenoh.file, so that the service is a client"
    if zenoh_session.finds_peers(settings):
        cause = (
            "the service is a peer: a router forwards nothing to it from other peers, and it is not connected to them"
        )
        advice = f"{client}; or enable gossip at the router, and have peers listen where others can reach them"
        return cause, advice
    cause = (
        "the service is a peer without gossip: a router forwards nothing between two peers, so that it exchanges "
        "nothing with nodes of rmw_zenoh, which are peers"
    )
    return cause, f'{client}; or enable gossip there, and listen at "tcp/localhost:0"'


def rules_finding(config: Config, session: zenoh.Session, other: zenoh.Session) -> Finding:
    """Whether the router lets a session with the service's certificate publish what the service must. To test that,
    a liveliness token that nobody else reads has to arrive at the other session."""
    keys = Keys(config.prefix, config.vehicle)
    token_key = f"{keys.root}/alive/doctor/{session.info.zid()}/{time.time_ns()}"
    token = session.liveliness().declare_token(token_key)
    deadline_s = time.monotonic() + SEEN_S
    try:
        while time.monotonic() < deadline_s:
            if any(reply.ok is not None for reply in other.liveliness().get(token_key, timeout=1.0)):
                return ok("rules", keys.root, "the router forwards what is published there")
            time.sleep(QUERY_PERIOD_S)
    finally:
        token.undeclare()
    return fail(
        "rules",
        keys.root,
        "the router accepts the session, but forwards nothing: its access control refuses",
        "compare prefix and vehicle with its rules, and the certificate's name with its subjects: the service needs "
        "`liveliness_token`, `liveliness_query` and `declare_queryable` below its keys, `declare_subscriber` on frames",
    )


def _endpoints(settings: zenoh.Config, config: Config) -> tuple[str, ...]:
    """Endpoints of the router that the service uses, or that it is itself."""
    if zenoh_session.mode_of(settings) != "router":
        return zenoh_session.connected_of(settings)
    return tuple(text.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:") for text in config.zenoh.router)


def _reached(settings: zenoh.Config, endpoint: zenoh_session.Endpoint, where: str) -> Iterator[Finding]:
    host, port = zenoh_session.host_and_port(endpoint)
    try:
        with closing(socket.create_connection((host, port), CONNECT_S)):
            pass
    except socket.gaierror as error:
        yield fail("router", where, f"unknown host {host}: {error.strerror}", "check its name, and DNS")
        return
    except TimeoutError:
        text = f"no answer within {CONNECT_S:g} s: the computer is off, or a firewall drops the connection"
        yield fail("router", where, text, "check the network in between")
        return
    except ConnectionRefusedError:
        advice = "start the router (or `coec run --embedded-router`), or correct the port in zenoh.connect"
        yield fail("router", where, "connection refused: nothing listens at this port", advice)
        return
    except OSError as error:
        yield fail("router", where, f"cannot be reached: {error.strerror or error}", "check the network")
        return
    yield ok("router", where, "accepts connections")
    if endpoint.protocol in zenoh_session.CERTIFIED:
        yield _handshake(settings, endpoint, where)


def _handshake(settings: zenoh.Config, endpoint: zenoh_session.Endpoint, where: str) -> Finding:
    try:
        seen = zenoh_session.shake_hands(endpoint, zenoh_session.tls_files(settings, endpoint, "connect"), CONNECT_S)
    except zenoh_session.CertificateError as error:
        advice = (
            "compare the authority here (root_ca_certificate) with who signed the router's certificate, the host with "
            "its names, and the other way round"
        )
        return fail("tls", where, str(error), advice)
    except OSError as error:
        return fail("tls", where, f"the link broke: {error.strerror or error}", "check the files of transport/link/tls")
    return _dated("tls", where, seen)


def _dated(check: str, where: str, seen: zenoh_session.Certificate) -> Finding:
    """Whether a certificate is valid today, and for how long."""
    now_s = time.time()
    text = f"{seen.name!r}, valid until {_day(seen.not_after_s)}"
    if seen.names:
        text += f", for {', '.join(seen.names)}"
    renew = "have the authority make a new one"
    if seen.not_after_s < now_s:
        return fail(check, where, f"{seen.name!r} has expired on {_day(seen.not_after_s)}", renew)
    if seen.not_before_s > now_s:
        advice = "check the clock of this computer"
        return fail(check, where, f"{seen.name!r} is not valid before {_day(seen.not_before_s)}", advice)
    if seen.not_after_s < now_s + EXPIRES_SOON_DAYS * DAY_S:
        return warn(check, where, text, f"{renew}, soon")
    return ok(check, where, text)


def _day(seconds: float) -> str:
    return "for ever" if seconds == float("inf") else datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d")


def service_findings(session: zenoh.Session, config: Config) -> Iterator[Finding]:
    """Findings from the answers of the vehicle's service; a single one if no service answers."""
    keys = Keys(config.prefix, config.vehicle)
    try:
        status = from_json(StatusReply, query_one(session, f"{keys.status}?format=json", TIMEOUT_S).payload)
    except NotFoundError:
        yield ok("service", keys.root, "no service of the vehicle answers here; its status is not known")
        return
    except CoecError as error:
        yield fail("service", keys.root, f"invalid reply: {error}", "check its log")
        return
    yield from _status(status, keys)
    yield _compared(session, config, keys)
    try:
        replies = query_all(session, f"{keys.health('*')}?format=json", TIMEOUT_S)
        healths = [from_json(HealthReply, reply.payload) for reply in replies]
    except CoecError as error:
        yield fail("health", keys.health("*"), f"invalid reply: {error}", "check its log")
        return
    for health in healths:
        yield from _health(health, keys)


def _compared(session: zenoh.Session, config: Config, keys: Keys) -> Finding:
    """Whether the service runs with this file."""
    try:
        served = json_value(query_one(session, f"{keys.config}?format=json", TIMEOUT_S).payload)["config"]
        places = [
            place for place in differing(served, redacted_configuration(config)) if place not in OF_THE_COMMAND_LINE
        ]
    except (CoecError, ValueError, KeyError, TypeError) as error:
        text = f"the service does not report its configuration: {error}"
        return warn("file", keys.config, text, "check its version and the rules of the router")
    if not places:
        return ok("file", keys.config, "the service runs with this file")
    more = f" and {len(places) - PLACES_NAMED} more" if len(places) > PLACES_NAMED else ""
    text = f"this file differs from the configuration of the service in {', '.join(places[:PLACES_NAMED])}{more}"
    return warn(
        "file", keys.config, text, "reload or restart the service, or name the file that it runs with (--config)"
    )


def _status(status: StatusReply, keys: Keys) -> Iterator[Finding]:
    runs = f"version {status.version}, {status.state} for {status.uptime_s:.0f} s"
    if status.state in ("failing", "stopping"):
        yield fail("service", keys.root, runs, "check its log, and whether the service manager starts it again")
    elif status.version != __version__:
        advice = "restart the service with the version that is installed, or query it with its own version"
        yield warn("service", keys.root, f"{runs}; this is version {__version__}", advice)
    else:
        yield ok("service", keys.root, runs)
    loaded = status.configuration
    if loaded is not None and loaded.refused is not None:
        advice = "correct the file (`coec check-config`) and reload"
        yield fail("reload", keys.root, f"the file on the disk was refused: {loaded.refused}", advice)
    elif loaded is not None and loaded.waiting:
        waits = ", ".join(loaded.waiting)
        yield warn("reload", keys.root, f"waits for a restart: {waits}", "restart the service at a suitable time")
    for reason in status.reasons:
        problem = PROBLEMS.get(reason.code)
        advice = f"reason {reason.code}: check its log" if problem is None else problem.advice
        yield warn("service", keys.root, reason.text, advice)


def _health(health: HealthReply, keys: Keys) -> Iterator[Finding]:
    where = keys.health(health.pair)
    why = " ".join(reason.text for reason in health.reasons)
    level = LEVELS[health.level]
    text = f"{health.state}{f': {why}' if why else ''}"
    advice = None if level == "ok" else "see `coec query health`, and docs/health.md for what it means"
    yield Finding(check="health", level=level, where=where, text=text, advice=advice)
    if health.needs:
        yield ok("next_window", where, f"still needed for the next window: {'; '.join(health.needs)}")
    else:
        yield ok("next_window", where, "nothing is missing")
