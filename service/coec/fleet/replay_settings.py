"""The terms on which windows are judged again: each as it was recorded, or all by another configuration or rig."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from coec import __version__
from coec.calibration.types import Window
from coec.config import CalibrationConfig, DepthConfig
from coec.config.root import load_config
from coec.errors import ConfigError, UsageError, WindowError
from coec.io.rig_files import rig_from_json, rig_to_json

MAX_RIG_BYTES = 2**20
"""Largest file that describes a rig, bytes: a thousand times what intrinsics and a pose take."""


class ReplaySettings(BaseModel):
    """The settings by which windows are judged. They are sent to the processes that judge.

    Attributes:
        calibrations: settings of another configuration, by pair; empty: each window is judged by its own.
        any_pair: settings of that configuration for pairs that it does not name; None: such windows are refused.
        rig: another rig (`rig_to_json`) for the windows of its pair; None: each window's own.
        depth: another depth network for all windows, if the vehicles' network lies elsewhere or a new one is tried. It
            does not enter the configuration in a result, which has the hash of the network.
    """

    model_config = ConfigDict(frozen=True)

    calibrations: dict[str, CalibrationConfig] = {}
    any_pair: CalibrationConfig | None = None
    rig: dict[str, Any] | None = None
    depth: str | None = None

    @property
    def fingerprint(self) -> str:
        """Hash of the terms and of coec's version: equal fingerprints give equal decisions."""
        document = json.dumps([__version__, self.model_dump(mode="json")], sort_keys=True)
        return hashlib.sha256(document.encode()).hexdigest()

    def apply(self, window: Window, recorded: CalibrationConfig) -> tuple[Window, CalibrationConfig]:
        """A window and its own configuration, replaced by what these terms say.

        Raises:
            ConfigError: the configuration does not name the pair of the window.
        """
        calibration = self._calibration(window.rig.pair, recorded)
        if self.rig is None or (rig := rig_from_json(self.rig, None)).pair != window.rig.pair:
            return window, calibration
        old, new = window.rig.camera, rig.camera
        mask = window.rig.mask if (old.width, old.height) == (new.width, new.height) else None
        return replace(window, rig=replace(rig, mask=mask)), calibration

    def network(self, configured: DepthConfig) -> DepthConfig:
        """The network by which a window is judged, given the one that is configured for it."""
        return configured if self.depth is None else configured.model_copy(update={"model": self.depth})

    def _calibration(self, pair: str, recorded: CalibrationConfig) -> CalibrationConfig:
        if not self.calibrations:
            return recorded
        calibration = self.calibrations.get(pair, self.any_pair)
        if calibration is None:
            known = ", ".join(sorted(self.calibrations))
            raise ConfigError(f"the configuration knows no pair {pair}; it has {known}")
        return calibration


def load_settings(config: Path | None, rig: Path | None, depth: str | None) -> ReplaySettings:
    """The terms from what a user gives. Each argument may be None: the windows' own is used.

    Args:
        config: configuration of a daemon (YAML).
        rig: JSON file of a rig, as it is attached to windows.
        depth: an ONNX file, or the name of a network that comes with coec.

    Raises:
        ConfigError: the configuration cannot be used.
        UsageError: the rig cannot be read.
    """
    calibrations, any_pair = {}, None
    if config is not None:
        pairs = load_config(config).every_pair
        calibrations = {pair.name: pair.calibration for pair in pairs}
        # If there is only one pair, its settings are for all windows, whatever the vehicles call their pairs.
        any_pair = pairs[0].calibration if len(pairs) == 1 else None
    return ReplaySettings(
        calibrations=calibrations, any_pair=any_pair, rig=None if rig is None else _rig(rig), depth=depth
    )


def _rig(path: Path) -> dict[str, Any]:
    """The rig in a file that was attached to a window, either the whole attachment or only its `rig`.

    Raises:
        UsageError: the file holds no rig.
    """
    try:
        if path.stat().st_size > MAX_RIG_BYTES:
            raise UsageError(f"{path} is larger than {MAX_RIG_BYTES} bytes: no description of a rig")
        document = json.loads(path.read_bytes())
        document = document.get("rig", document) if isinstance(document, dict) else document
        return rig_to_json(rig_from_json(document, None))
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{path} is not JSON") from error
    except WindowError as error:
        raise UsageError(f"{path}: {error}") from error
