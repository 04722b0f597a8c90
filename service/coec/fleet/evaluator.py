"""Judges windows, one at a time, in a process of its own: a job in, a row out, whatever is wrong with the window."""

from __future__ import annotations

import hashlib
import logging
import threading
import time
from pathlib import Path

from coec.calibration.pipeline import calibrate
from coec.calibration.types import DepthModel, Silence
from coec.config import DepthConfig, LimitsConfig
from coec.errors import CoecError, SourceError
from coec.fleet.jobs import Job, empty_row, failed_row, fetched_window, sha256_of
from coec.fleet.replay_settings import ReplaySettings
from coec.io.depth.depth_maps import open_depth
from coec.io.images import GreyImages
from coec.io.mcap.window_reader import read_result, read_vehicle, read_window
from coec.io.serialise import comparable, result_of
from coec.reports import provenance
from coec.schemas.fleet import WindowRow
from coec.schemas.message import to_json
from coec.schemas.replies import CalibrationResult

_log = logging.getLogger(__name__)

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
        self._versions = provenance.versions()

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
            _log.exception("a window could not be judged", extra={"fields": {"url": job.url}})
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
