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
from coec.runtime.nominal.findings import DiscoveredPair
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


class StoredDiscovery(Part):
    """`Found` on the disk. `asked` is the hash of what the configuration left out and where it was looked for.
    `found_ns` is the wall clock when it was found."""

    asked: str
    found_ns: Annotated[int, Field(ge=0, lt=2**63)]
    pair: StoredNominal
    origins: dict[str, str]


class DiscoveryStore:
    """The nominal calibrations of a vehicle, as a book that the scribe writes. Safe to use from several threads."""

    def __init__(self, folder: Path) -> None:
        self._lock = threading.Lock()
        self._file = StateFile(folder / NOMINAL_FILE)
        loaded = self._file.load()
        for damage in loaded.damage:
            _log.warning(f"nominal calibrations that were kept cannot be used: {damage}")
        self._pairs: dict[str, StoredDiscovery] = {}
        self._documents: dict[str, dict[str, Any]] = {}
        pairs = (loaded.body or {}).get("pairs")
        for name, document in (pairs if isinstance(pairs, dict) else {}).items():
            try:
                self._pairs[name] = StoredDiscovery.model_validate(document)
                self._documents[name] = document
            except ValidationError:
                self._file.reject()
                _log.warning("a nominal calibration that was kept has another form", extra={"fields": {"pair": name}})

    def load(self, config: Config) -> dict[str, DiscoveredPair]:
        """What was found earlier, by pair, for the pairs that this configuration awaits and for which it still asks the
        same."""
        pairs = {pair.name: self._restored(pair, config) for pair in config.awaited}
        return {name: one for name, one in pairs.items() if one is not None}

    def _restored(self, pair: OpenPairConfig, config: Config) -> DiscoveredPair | None:
        with self._lock:
            stored = self._pairs.get(pair.name)
        if stored is None or stored.asked != _request_hash(pair, config):
            return None
        document, earlier = pair.model_dump(), stored.pair
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
        since = datetime.fromtimestamp(stored.found_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
        return DiscoveredPair(
            complete, {place: f"{origin}; kept since {since}" for place, origin in stored.origins.items()}
        )

    def update(self, discovered: DiscoveredPair, requested: OpenPairConfig, config: Config, now_ns: int) -> None:
        """Keeps what was found; the next `flush` writes it."""
        document = {
            "asked": _request_hash(requested, config),
            "found_ns": now_ns,
            "pair": discovered.pair.model_dump(mode="json"),
            "origins": dict(discovered.origins),
        }
        stored = StoredDiscovery.model_validate(document)
        with self._lock:
            self._pairs = {**self._pairs, requested.name: stored}
            self._documents = {**self._documents, requested.name: document}

    def flush(self) -> None:
        """Writes to the disk what is kept.

        Raises:
            StateError: it cannot be written; the next call tries again.
        """
        with self._lock:
            documents = self._documents
        self._file.save({"pairs": documents})


def _request_hash(pair: OpenPairConfig, config: Config) -> str:
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


def completed(config: Config, discovered: Mapping[str, PairConfig]) -> Config:
    """The configuration in which these pairs, by their names, are moved from the awaited ones to the complete ones."""
    joined = tuple(discovered[pair.name] for pair in config.awaited if pair.name in discovered)
    still = tuple(pair for pair in config.awaited if pair.name not in discovered)
    return config.model_copy(update={"pairs": (*config.pairs, *joined), "awaited": still})


def with_discovered(config: Config) -> Config:
    """The configuration completed by what a service has found for its awaited pairs and keeps in its state
    directory."""
    if not config.awaited:
        return config
    stored = DiscoveryStore(config.state.directory).load(config)
    return completed(config, {name: discovered.pair for name, discovered in stored.items()})
