"""Evaluates windows again: the settings by which (each window's own, or those of another configuration or rig), and the
evaluator, which works on one window at a time in a process of its own: a job in, a row out, whatever is wrong with the
window.
"""

import hashlib
import json
import logging
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from coec import __version__
from coec.calibration.pipeline import calibrate
from coec.calibration.types import DepthModel, Silence, Window
from coec.config import CalibrationConfig, DepthConfig, LimitsConfig
from coec.config.root import load_config
from coec.errors import CoecError, ConfigError, SourceError, UsageError, WindowError
from coec.fleet.jobs import Job, empty_row, failed_row, fetched_window, sha256_of
from coec.io.depth.depth_maps import open_depth
from coec.io.images import GreyImages
from coec.io.mcap.windows import read_result, read_vehicle, read_window
from coec.io.rig_files import rig_from_json, rig_to_json
from coec.io.serialise import comparable, result_of
from coec.reports.page_parts import versions
from coec.schemas.documents import WindowRow
from coec.schemas.message import to_json
from coec.schemas.replies import CalibrationResult

_log = logging.getLogger(__name__)

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


MAX_OPEN_NETWORKS = 4
"""How many networks are open at a time. A fleet has one or two, and each takes a hundred megabytes."""


class WindowEvaluator:
    """Judges windows on the same terms. `row` may be called on several threads, so that one fetches a window while
    another's is solved."""

    def __init__(self, settings: ReplaySettings) -> None:
        self._settings = settings
        self._solving = threading.Lock()
        self._limits = LimitsConfig()
        self._images = GreyImages(self._limits)
        self._networks: dict[DepthConfig, DepthModel] = {}
        self._versions = versions()

    def row(self, job: Job) -> WindowRow:
        """The row of a window. If anything is wrong with the window, the row says so."""
        row = empty_row(job, self._versions)
        try:
            with fetched_window(job.url) as path:
                sha256 = sha256_of(path)
                row = row.model_copy(update={"sha256": sha256, "bytes": path.stat().st_size})
                if job.sha256 not in (None, sha256):
                    raise SourceError(f"{job.url} has the sha256 {sha256}, but {job.sha256} is stated beside it")
                with self._solving:
                    started_s, started_cpu_s = time.monotonic(), time.process_time()
                    try:
                        update = self._evaluate(path)
                    finally:
                        took_s, cpu_s = time.monotonic() - started_s, time.process_time() - started_cpu_s
                        row = row.model_copy(update={"seconds": took_s, "cpu_s": cpu_s})
        except CoecError as error:
            return failed_row(row, error.reply_code, str(error))
        except Exception as error:  # a fault of coec; the other windows are judged all the same
            _log.exception("a window could not be evaluated", extra={"fields": {"url": job.url}})
            return failed_row(row, CoecError.reply_code, f"{type(error).__name__}: {error}")
        return row.model_copy(update=update)

    def _evaluate(self, path: Path) -> dict[str, object]:
        recorded = read_result(path)
        vehicle = read_vehicle(path) if recorded is None else recorded.vehicle
        window, configuration = self._settings.apply(*read_window(path))
        network = self._network(self._settings.network(configuration.depth))
        result = result_of(calibrate(window, network, self._images, configuration, Silence()), window.rig, vehicle)
        if recorded is not None:
            result = comparable(result, recorded)
        return {
            "vehicle": vehicle,
            "result": result,
            "decided": _digest(result),
            "recorded": None if recorded is None else _digest(recorded),
        }

    def _network(self, config: DepthConfig) -> DepthModel:
        # The process has one core, so more threads would only wait for each other. The depth does not depend on it.
        config = config.model_copy(update={"threads": 1})
        if config not in self._networks:
            while len(self._networks) >= MAX_OPEN_NETWORKS:
                self._networks.pop(next(iter(self._networks)))
            self._networks[config] = open_depth(config, self._limits)
        return self._networks[config]


def _digest(result: CalibrationResult) -> str:
    return hashlib.sha256(to_json(result)).hexdigest()
