"""Keeps the nominal calibrations that were found in the state directory, so that a restart has the same ones, whatever
is published by then."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError

from coec.adapters.files.rig import rig_of
from coec.adapters.files.state_file import StateFile
from coec.config import CameraIntrinsics, Config, Matrix4x4, OpenPairConfig, PairConfig, config_hash
from coec.errors import ConfigError
from coec.runtime.nominal.findings import Found
from coec.schemas.base import Part

_log = logging.getLogger(__name__)

NOMINAL_FILE = "nominal.json"


class StoredCamera(Part):
    """What is found of a camera."""

    frame_id: str
    intrinsics: CameraIntrinsics


class StoredLidar(Part):
    """What is found of a LiDAR."""

    frame_id: str
    T_cloud_lidar: Matrix4x4
    cloud_frame_id: str | None


class StoredEgo(Part):
    """What is found of the ego-motion."""

    T_lidar_ego: Matrix4x4


class StoredNominal(Part):
    """What is found of a pair, out of its configuration. The file holds the whole `PairConfig`, which versions before
    this one require; its other keys may be those of another version."""

    T_camera_lidar: Matrix4x4
    camera: StoredCamera
    lidar: StoredLidar
    ego: StoredEgo | None = None


class KeptPair(Part):
    """`Found` on the disk. `asked` is the hash of what the configuration left out and where it was looked for.
    `found_ns` is the wall clock when it was found."""

    asked: str
    found_ns: Annotated[int, Field(ge=0, lt=2**63)]
    pair: StoredNominal
    origins: dict[str, str]


class KeptNominals:
    """The nominal calibrations of a vehicle, as a book that the scribe writes. Safe to use from several threads."""

    def __init__(self, folder: Path) -> None:
        self._lock = threading.Lock()
        self._file = StateFile(folder / NOMINAL_FILE)
        loaded = self._file.load()
        for damage in loaded.damage:
            _log.warning(f"nominal calibrations that were kept cannot be used: {damage}")
        self._pairs: dict[str, KeptPair] = {}
        self._documents: dict[str, dict[str, Any]] = {}
        pairs = (loaded.body or {}).get("pairs")
        for name, document in (pairs if isinstance(pairs, dict) else {}).items():
            try:
                self._pairs[name] = KeptPair.model_validate(document)
                self._documents[name] = document
            except ValidationError:
                self._file.distrust()
                _log.warning("a nominal calibration that was kept has another form", extra={"fields": {"pair": name}})

    def found(self, config: Config) -> dict[str, Found]:
        """What was found earlier, by pair, for the pairs that this configuration awaits and for which it still asks the
        same."""
        found = {pair.name: self._found(pair, config) for pair in config.awaited}
        return {name: one for name, one in found.items() if one is not None}

    def _found(self, pair: OpenPairConfig, config: Config) -> Found | None:
        with self._lock:
            kept = self._pairs.get(pair.name)
        if kept is None or kept.asked != _asked(pair, config):
            return None
        document, earlier = pair.model_dump(), kept.pair
        document["T_camera_lidar"] = earlier.T_camera_lidar
        document["camera"] |= earlier.camera.model_dump()
        document["lidar"] |= earlier.lidar.model_dump()
        if pair.ego is not None and earlier.ego is not None:
            document["ego"]["T_lidar_ego"] = earlier.ego.T_lidar_ego
        try:
            complete = PairConfig.model_validate(document)
            rig_of(complete)  # may fail, because the mask may have changed on the disk
        except (ConfigError, ValidationError) as error:
            _log.warning(f"a nominal calibration that was kept cannot be used: {error}")
            return None
        since = datetime.fromtimestamp(kept.found_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
        return Found(complete, {place: f"{origin}; kept since {since}" for place, origin in kept.origins.items()})

    def keep(self, found: Found, asked: OpenPairConfig, config: Config, now_ns: int) -> None:
        """Keeps what was found; the next `flush` writes it."""
        document = {
            "asked": _asked(asked, config),
            "found_ns": now_ns,
            "pair": found.pair.model_dump(mode="json"),
            "origins": dict(found.origins),
        }
        kept = KeptPair.model_validate(document)
        with self._lock:
            self._pairs = {**self._pairs, asked.name: kept}
            self._documents = {**self._documents, asked.name: document}

    def flush(self) -> None:
        """Writes to the disk what is kept.

        Raises:
            StateError: it cannot be written; the next call tries again.
        """
        with self._lock:
            documents = self._documents
        self._file.save({"pairs": documents})


def _asked(pair: OpenPairConfig, config: Config) -> str:
    """Hash of what the configuration gives and where the rest is looked for. Other settings may change."""
    question = pair.model_dump(
        mode="json",
        include={
            "camera": {"key", "topic", "info_topic", "frame_id", "intrinsics"},
            "lidar": {"key", "topic", "frame_id", "T_cloud_lidar", "cloud_frame_id"},
            "ego": {"key", "topic", "T_lidar_ego"},
            "T_camera_lidar": True,
        },
    )
    where = {"middleware": config.middleware, **config.ros.model_dump(include={"domain", "namespace"})}
    return config_hash(json.dumps([question, where], sort_keys=True))


def completed(config: Config, found: Mapping[str, PairConfig]) -> Config:
    """The configuration in which these pairs, by their names, are moved from the awaited ones to the complete ones."""
    joined = tuple(found[pair.name] for pair in config.awaited if pair.name in found)
    still = tuple(pair for pair in config.awaited if pair.name not in found)
    return config.model_copy(update={"pairs": (*config.pairs, *joined), "awaited": still})


def with_kept(config: Config) -> Config:
    """The configuration completed by what a service has found for its awaited pairs and keeps in its state
    directory."""
    if not config.awaited:
        return config
    kept = KeptNominals(config.state.directory).found(config)
    return completed(config, {name: found.pair for name, found in kept.items()})
