"""Nominal calibrations that were found, in the state directory: a restart has the same, whoever publishes by then."""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

from pydantic import Field, ValidationError

from coec.adapters.files.rig import rig_of
from coec.adapters.files.state_file import StateFile
from coec.config import Config, OpenPairConfig, PairConfig, RosConfig, config_hash
from coec.errors import ConfigError
from coec.runtime.nominal.findings import Found
from coec.schemas.base import Part

_log = logging.getLogger(__name__)

NOMINAL_FILE = "nominal.json"


class KeptPair(Part):
    """`Found` on the disk. `asked` is the hash of what was left out and where it was looked for; `found_ns` (wall
    clock) when it was found."""

    asked: str
    found_ns: Annotated[int, Field(ge=0, lt=2**63)]
    pair: PairConfig
    origins: dict[str, str]


class KeptNominals:
    """Those of a vehicle: a book that the scribe writes. Safe to use from several threads."""

    def __init__(self, folder: Path) -> None:
        self._lock = threading.Lock()
        self._file = StateFile(folder / NOMINAL_FILE)
        loaded = self._file.load()
        for damage in loaded.damage:
            _log.warning(f"nominal calibrations that were kept cannot be used: {damage}")
        self._pairs: dict[str, KeptPair] = {}
        for name, document in (loaded.body or {}).get("pairs", {}).items():
            try:
                self._pairs[name] = KeptPair.model_validate(document)
            except ValidationError:
                self._file.distrust()
                _log.warning("a nominal calibration that was kept has another form", extra={"fields": {"pair": name}})

    def found(self, config: Config) -> dict[str, Found]:
        """What was found earlier of pairs that this configuration awaits, and asks the same for, by their names."""
        found = {pair.name: self._found(pair, config) for pair in config.awaited}
        return {name: one for name, one in found.items() if one is not None}

    def _found(self, pair: OpenPairConfig, config: Config) -> Found | None:
        with self._lock:
            kept = self._pairs.get(pair.name)
        if kept is None or kept.asked != _asked(pair, config):
            return None
        settings = pair.model_dump(exclude={"camera", "lidar", "ego", "T_camera_lidar"})
        complete = PairConfig.model_validate({**kept.pair.model_dump(), **settings})
        try:
            rig_of(complete)  # what it was read for may have changed on the disk: the mask
        except ConfigError as error:
            _log.warning(f"a nominal calibration that was kept cannot be used: {error}")
            return None
        since = datetime.fromtimestamp(kept.found_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
        return Found(complete, {place: f"{origin}; kept since {since}" for place, origin in kept.origins.items()})

    def keep(self, found: Found, asked: OpenPairConfig, config: Config, now_ns: int) -> None:
        """Put down what was found; on the disk with the next `flush`."""
        kept = KeptPair(asked=_asked(asked, config), found_ns=now_ns, pair=found.pair, origins=dict(found.origins))
        with self._lock:
            self._pairs = {**self._pairs, asked.name: kept}

    def flush(self) -> None:
        """Put on the disk what was put down.

        Raises:
            StateError: it cannot be written; the next call tries again.
        """
        with self._lock:
            pairs = self._pairs
        self._file.save({"pairs": {name: kept.model_dump(mode="json") for name, kept in pairs.items()}})


def _asked(pair: OpenPairConfig, config: Config) -> str:
    where: RosConfig = config.ros
    streams = [pair.camera, pair.lidar, *([] if pair.ego is None else [pair.ego])]
    matrix = "" if pair.T_camera_lidar is None else str(pair.T_camera_lidar)
    return config_hash(*streams, f"{matrix} {config.middleware} {where.domain} {where.namespace}")


def completed(config: Config, found: Mapping[str, PairConfig]) -> Config:
    """The configuration with these pairs, by their names, among those of which everything is known."""
    joined = tuple(found[pair.name] for pair in config.awaited if pair.name in found)
    still = tuple(pair for pair in config.awaited if pair.name not in found)
    return config.model_copy(update={"pairs": (*config.pairs, *joined), "awaited": still})
