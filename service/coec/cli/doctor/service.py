"""The service itself, if one runs: what it says about itself, and what it still needs."""

from __future__ import annotations

from collections.abc import Iterator

import zenoh

from coec import __version__
from coec.adapters.zenoh.client import ask, ask_one
from coec.cli.doctor.found import fail, ok, warn
from coec.config import Config
from coec.errors import CoecError, NotFoundError
from coec.runtime.api.configuration import shown
from coec.runtime.api.troubles import TROUBLES
from coec.runtime.reload import differing
from coec.schemas.base import from_json, json_value
from coec.schemas.doctor import Finding, Level
from coec.schemas.keys import Keys
from coec.schemas.replies import HealthReply, StatusReply

TIMEOUT_S = 3.0

OF_THE_COMMAND_LINE = frozenset({"zenoh.embedded_router", "state.directory"})
"""Configuration values that options of `coec run` override."""

PLACES_NAMED = 5

LEVELS: dict[int, Level] = {0: "ok", 1: "warn", 2: "fail", 3: "warn"}
"""Level of a finding by ROS level; STALE, when nothing was checked yet, is no failure."""


def service_findings(session: zenoh.Session, config: Config) -> Iterator[Finding]:
    """Findings from the answers of the vehicle's service; a single one if no service answers."""
    keys = Keys(config.prefix, config.vehicle)
    try:
        status = from_json(StatusReply, ask_one(session, f"{keys.status}?format=json", TIMEOUT_S).payload)
    except NotFoundError:
        yield ok("service", keys.root, "no service of the vehicle answers here; what it would say is not known")
        return
    except CoecError as error:
        yield fail("service", keys.root, f"answers wrongly: {error}", "see to its log")
        return
    yield from _status(status, keys)
    yield _compared(session, config, keys)
    try:
        replies = ask(session, f"{keys.health('*')}?format=json", TIMEOUT_S)
        healths = [from_json(HealthReply, reply.payload) for reply in replies]
    except CoecError as error:
        yield fail("health", keys.health("*"), f"answers wrongly: {error}", "see to its log")
        return
    for health in healths:
        yield from _health(health, keys)


def _compared(session: zenoh.Session, config: Config, keys: Keys) -> Finding:
    """Whether the service runs with this file."""
    try:
        served = json_value(ask_one(session, f"{keys.config}?format=json", TIMEOUT_S).payload)["config"]
        places = [place for place in differing(served, shown(config)) if place not in OF_THE_COMMAND_LINE]
    except (CoecError, ValueError, KeyError, TypeError) as error:
        text = f"the service does not tell with which configuration it runs: {error}"
        return warn("file", keys.config, text, "see to its version, and to the rules of the router")
    if not places:
        return ok("file", keys.config, "the service runs with this file")
    more = f" and {len(places) - PLACES_NAMED} more" if len(places) > PLACES_NAMED else ""
    text = f"this file is another than the service runs with, in {', '.join(places[:PLACES_NAMED])}{more}"
    return warn(
        "file", keys.config, text, "reload or restart the service, or name the file that it runs with (--config)"
    )


def _status(status: StatusReply, keys: Keys) -> Iterator[Finding]:
    runs = f"version {status.version}, {status.state} for {status.uptime_s:.0f} s"
    if status.state in ("failing", "stopping"):
        yield fail("service", keys.root, runs, "see to its log, and whether the service manager starts it again")
    elif status.version != __version__:
        advice = "restart the service with the version that is installed, or ask with its own"
        yield warn("service", keys.root, f"{runs}; this is version {__version__}", advice)
    else:
        yield ok("service", keys.root, runs)
    told = status.configuration
    if told is not None and told.refused is not None:
        advice = "correct the file (`coec check-config`) and reload"
        yield fail("reload", keys.root, f"the file on the disk was refused: {told.refused}", advice)
    elif told is not None and told.waiting:
        waits = ", ".join(told.waiting)
        yield warn("reload", keys.root, f"waits for a restart: {waits}", "restart the service when it suits")
    for reason in status.reasons:
        trouble = TROUBLES.get(reason.code)
        advice = f"reason {reason.code}: see to its log" if trouble is None else trouble.advice
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
