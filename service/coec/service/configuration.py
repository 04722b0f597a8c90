"""The configuration of a running service: as it is served, without secrets, and which changes of it are taken over at
once and which wait for the next start.

A changed value is taken over only if everything that depends on it can go on without a break: limits, rules, the length
of windows. Values with which streams, files, networks or sessions were opened stay until those are opened again.
"""

import fnmatch
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from coec.config import Config, OpenPairConfig, PairConfig, config_hash
from coec.errors import require_readable
from coec.io.rig_files import check_given, rig_of
from coec.io.zenoh.session import check_certificates, redacted, settings_of, settings_source

RELOADED: Mapping[str, str] = {
    "log.*": "at once in the service; in the worker after a restart",
    "authority.*": "with the next command; every reload reads the certificate files again",
    "metrics.*": "at once; if the new address is not available, metrics are not served, and status reports it",
    "uplink.*": "with the next heartbeat and the next answer",
    "budget.cores": "with the next check",
    "stale_after_s": "within a second",
    "state.max_bytes": "with the next window",
    "state.max_protected_bytes": "with the next window",
    "state.max_age_days": "with the next window",
    "state.min_free_bytes": "with the next window",
    "pairs.*.window.*": "with the next slice; the open one keeps its values",
    "pairs.*.calibration.objective.*": "with the next check and the next window",
    "pairs.*.calibration.search.*": "with the next check and the next window",
    "pairs.*.calibration.verdict.*": "with the next check and the next window",
    "pairs.*.calibration.time_offset.*": "with the next check and the next window",
    "pairs.*.calibration.motion_compensation": "with the next check and the next window",
    "pairs.*.monitor.hours_between_*": "with the next result",
    "pairs.*.policy.*": "with the next result",
    "pairs.*.tracker.*": "with the next result",
}
"""Patterns of the places whose values are taken over, and when. All others wait for a restart."""


@dataclass(frozen=True, slots=True)
class Reload:
    """The outcome of reading the configuration again.

    Attributes:
        config: the configuration that holds from now on.
        taken, waiting: places of the changed values, such as `pairs.front.policy.apply`: those that hold now, and those
            that wait for a restart.
    """

    config: Config
    taken: tuple[str, ...]
    waiting: tuple[str, ...]


def reload_of(running: Config, read: Config) -> Reload:
    """What a service with the configuration `running` takes over from `read`.

    Raises:
        ConfigError: a service could not start with `read`, so nothing of it may be taken over.
    """
    check_certificates(settings_of(read.zenoh, read.limits), settings_source(read.zenoh))
    for pair in read.pairs:
        rig_of(pair)
    for pending in read.awaited:
        check_given(pending)
    for each in read.every_pair:
        _network_of(each)
    old, new = _by_name(running.model_dump()), _by_name(read.model_dump())
    taken: list[str] = []
    waiting: list[str] = []
    for names in _differences(old, new):
        if _is_reloaded(names):
            taken.append(".".join(names))
            _put(old, new, names)
        else:
            waiting.append(".".join(names))
    lists = {name: list(old[name].values()) for name in ("pairs", "awaited")}
    return Reload(Config.model_validate({**old, **lists}), tuple(taken), tuple(waiting))


def _network_of(pair: OpenPairConfig) -> None:
    """Checks only that the file exists: the worker opens networks, this process never does."""
    model = pair.calibration.depth.model
    if model.endswith(".onnx"):
        require_readable(Path(model), f"pair {pair.name}, calibration.depth.model")


def settings_hash(pair: PairConfig) -> str:
    """Hash of all settings that decide about a pair. It stands in the pair's windows, and in its history when it
    changes."""
    return config_hash(pair.window, pair.calibration, pair.monitor, pair.policy, pair.tracker)


def differing(old: Mapping[str, Any], new: Mapping[str, Any]) -> tuple[str, ...]:
    """Places at which two configurations differ; both are given as JSON-like values."""
    return tuple(".".join(names) for names in _differences(_by_name(old), _by_name(new)))


def _by_name(document: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration with its lists of pairs as dictionaries by name."""
    lists = {name: {pair["name"]: pair for pair in document[name]} for name in ("pairs", "awaited")}
    return {**document, **lists}


def _differences(old: Any, new: Any, names: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Places at which two documents differ. A part that only one of them has is a single place."""
    if isinstance(old, dict) and isinstance(new, dict):
        for name in dict.fromkeys((*old, *new)):
            yield from _differences(old.get(name), new.get(name), (*names, name))
    elif old != new:
        yield names


def _is_reloaded(names: tuple[str, ...]) -> bool:
    """Whether a pattern of `RELOADED` matches, name by name, because the name of a pair may hold dots."""
    for pattern in RELOADED:
        chunks = pattern.split(".")
        if len(chunks) == len(names) and all(map(fnmatch.fnmatchcase, names, chunks)):
            return True
    return False


def _put(old: dict[str, Any], new: dict[str, Any], names: tuple[str, ...]) -> None:
    """Copies one value from `new` to `old`."""
    for name in names[:-1]:
        old, new = old[name], new[name]
    old[names[-1]] = new[names[-1]]


def redacted_configuration(config: Config) -> dict[str, Any]:
    """The configuration as JSON-like values. Keys and passwords in endpoints are hidden. The content of `zenoh.file` is
    not read."""
    document = config.model_dump(mode="json")
    for name in ("connect", "listen"):
        document["zenoh"][name] = [redacted(endpoint) for endpoint in document["zenoh"][name]]
    return document
