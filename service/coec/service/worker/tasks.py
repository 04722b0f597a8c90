"""The work of the worker, for example depth of an image or calibration of a window file, and how each request is
turned into work, and its end into an answer. A refusal is an answer, too: a window that cannot be solved, for
example. No process, no socket.
"""

import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from coec.calibration import types
from coec.calibration.baseline import Baseline, learned_hash, mismatch
from coec.calibration.commissioning import MAX_PAIRS, commission_in_steps
from coec.calibration.frames.motion_compensation import compensate
from coec.calibration.monitor.check_verdict import observe
from coec.calibration.pipeline import calibrate
from coec.calibration.rig import nearest_neighbours
from coec.calibration.rig.lidar_registration import register
from coec.calibration.rig.lidar_sampling import LidarRig, SweepPair
from coec.config import CalibrationConfig, Config, DepthConfig
from coec.errors import CoecError, DecodeError, RecordingError, StateError, WindowError
from coec.geometry.points import lengths
from coec.io.converter import structured
from coec.io.depth.depth_maps import CachedDepth, open_depth
from coec.io.images import CachedGreys, GreyImages, RangeScale, decode_bgr, encode_jpeg, scale_of, stable_scale
from coec.io.msgpack_frames import decode_camera
from coec.io.rig_files import BASELINES, baseline_of_rig, rig_of, save_baseline
from coec.reports.close_ups import Caption, close_ups
from coec.reports.drawing import render_points, titled
from coec.reports.formatting import instant
from coec.service.worker import worker_jobs
from coec.service.worker.warm_up import invented_window, warm_up_check, warm_up_solve

_log = logging.getLogger(__name__)

OVERLAY_JPEG_QUALITY = 88

SLICE_S = 0.5
"""A slice of a commissioning ends with the first step that ends after this time, s. A check waits for one slice at
most: this time and the longest step, which is as long as the solve of a window."""


@dataclass(frozen=True, slots=True)
class _Commissioning:
    """A commissioning that was begun: its number, its remaining steps, and when it was begun (steady clock, s)."""

    run: int
    steps: types.Steps[Baseline]
    started_s: float


class Solver:
    """Opens the networks of the configuration once and keeps the depth of recent images.

    The methods that read or write window files import what they need for that: the types of ROS messages and the
    schemas take 0.15 s, and the first work, a check, needs none of them.
    """

    def __init__(self, config: Config, depth_maps_cached: int) -> None:
        """Opens every depth model that a pair of `config` names.

        Raises:
            ModelError: a network is missing, corrupt or does not match its card.
            ConfigError: a rig cannot be built.
        """
        self._depth_maps_cached = depth_maps_cached
        self._images = GreyImages(config.limits)
        self._networks: dict[DepthConfig, CachedDepth] = {}
        self._scales: dict[str, RangeScale] = {}
        self._commissioning: _Commissioning | None = None
        self.reconfigure(config)

    def reconfigure(self, config: Config) -> None:
        """Goes on with another configuration that has the same limits. Networks of awaited pairs are opened, too, so
        that the start shows what is wrong with them.

        Raises:
            ModelError, ConfigError: as at the start.
        """
        self._config = config
        self._pairs = {pair.name: pair for pair in config.pairs}
        self._rigs = {pair.name: rig_of(pair) for pair in config.pairs}
        for pair in config.every_pair:
            self._network(pair.calibration.depth)

    @property
    def lenses(self) -> int:
        """Number of models of lenses, for each of which some kernels are compiled."""
        return len({type(rig.camera) for rig in self._rigs.values()})

    def warm_up(self) -> None:
        """Runs every kernel once on a few invented points. Kernels are compiled for types, so one is enough of pairs
        that differ only in numbers, as most pairs of a vehicle do."""
        self.warm_up_checks()
        for _ in self.warm_up_windows():
            pass

    def warm_up_checks(self) -> None:
        """Runs the kernels that checks use."""
        for rig, calibration in self._alike():
            warm_up_check(rig, calibration, self._images)

    def warm_up_windows(self) -> Iterator[None]:
        """Runs the other kernels, in steps of a few seconds where they have to be compiled."""
        for rig, calibration in self._alike():
            yield from warm_up_solve(rig, calibration, self._images)
        if self._config.lidar_edges.period_s > 0.0 and len({pair.lidar.place for pair in self._config.pairs}) > 1:
            self._warm_up_lidars()
            yield

    def _alike(self) -> list[tuple[types.Rig, CalibrationConfig]]:
        """One rig and its configuration of each kind that kernels can tell apart."""
        alike = {
            (type(rig.camera), rig.sweep is None, pair.calibration): (rig, pair.calibration)
            for pair in self._config.pairs
            for rig in (self._rigs[pair.name],)
        }
        return list(alike.values())

    def _warm_up_lidars(self) -> None:
        if not nearest_neighbours.installed():
            return
        window = invented_window(self._rigs[self._config.pairs[0].name])
        pairs = [SweepPair(pair.lidar, pair.lidar, pair.motion) for pair in window.pairs[:1]]
        register(LidarRig("a", "b", np.eye(4), np.eye(4)), pairs)

    def prefetch(self, pair: str, frame: bytes) -> None:
        """Infers the depth of a camera frame (native msgpack) that was chosen for an open window.

        Raises:
            DecodeError: the frame cannot be decoded.
        """
        self._network(self._pairs[pair].calibration.depth).infer(decode_camera(frame, self._config.limits))

    def solve(self, path: Path) -> worker_jobs.Solved:
        """Calibrates a finished window by the configuration in its file, and writes the result into the file.

        Raises:
            WindowError, CalibrationError, DecodeError, ModelError: there is no result.
        """
        from coec.io.mcap.windows import read_window, write_result
        from coec.io.serialise import result_of

        window, configuration = read_window(path)
        estimate = calibrate(window, self._network(configuration.depth), self._images, configuration, types.Silence())
        result = result_of(estimate, window.rig, self._config.vehicle)
        picture = self._picture_of_result(window, configuration, estimate)
        try:
            file = write_result(path, result, picture)
        except (RecordingError, WindowError, OSError) as error:
            _log.warning("the result could not be written into its window", extra={"fields": {"window": path.stem}})
            code = error.reply_code if isinstance(error, CoecError) else "recording_failed"
            return worker_jobs.Solved(result, types.Reason(code, f"The window file does not hold the result: {error}"))
        return worker_jobs.Solved(
            result, None, worker_jobs.WrittenFile(file.bytes, file.modified_ns, file.sha256, file.pairs)
        )

    def _picture_of_result(
        self, window: types.Window, configuration: CalibrationConfig, estimate: types.Estimate
    ) -> bytes | None:
        """JPEG of the window's last pair at its result; None if it cannot be drawn, because a result needs no
        picture."""
        title = f"{window.window_id}  {estimate.verdict.decision.value}"
        pose = estimate.optimum.T_camera_lidar.tolist()
        try:
            return self._render(window.rig, configuration, pose, window.pairs[-1], title).jpeg
        except DecodeError as error:
            _log.warning(f"the result cannot be drawn: {error}", extra={"fields": {"window": window.window_id}})
            return None

    def observe(
        self,
        pair: str,
        configuration: CalibrationConfig,
        pose: Sequence[Sequence[float]],
        frames: Sequence[Sequence[bytes | None]],
    ) -> worker_jobs.Checked:
        """Makes a check of the monitor at an extrinsic (rows of the (4, 4) matrix), with the pairs as `messages` packs
        them.

        Raises:
            CalibrationError, DecodeError, ModelError: there is no answer.
        """
        window = types.Window(
            f"{pair}-check",
            self._rigs[pair],
            np.array(pose, dtype=np.float64),
            worker_jobs.unpack_pairs(frames, self._config.limits),
        )
        network = self._network(configuration.depth)
        baseline, not_used = self._baseline(pair, configuration, network.identity)
        images = CachedGreys(self._images, len(window.pairs))
        return worker_jobs.Checked(observe(window, network, images, configuration, baseline), not_used)

    def overlay(self, path: Path, pose: Sequence[Sequence[float]], title: str) -> worker_jobs.RenderedImage:
        """JPEG of a window's last pair, with its points drawn on its image at an extrinsic (rows of the (4, 4) matrix).

        Raises:
            WindowError, DecodeError: the window or its image cannot be read.
        """
        from coec.io.mcap.windows import read_window

        window, configuration = read_window(path)
        return self._render(window.rig, configuration, pose, window.pairs[-1], title)

    def comparison(
        self, path: Path, poses: Sequence[Sequence[Sequence[float]]], names: Sequence[str]
    ) -> worker_jobs.RenderedImage:
        """JPEG of two extrinsics (rows of the (4, 4) matrices) side by side on a window, where they differ most.

        Raises:
            WindowError, DecodeError, CalibrationError: the window or an image of it cannot be used.
        """
        from coec.io.mcap.windows import read_window

        window, configuration = read_window(path)
        before, after = (np.array(pose, dtype=np.float64) for pose in poses)
        picture = close_ups(
            window,
            before,
            after,
            compensated=configuration.motion_compensation,
            caption=Caption(before=names[0], after=names[1]),
            limits=self._config.limits,
        )
        return worker_jobs.RenderedImage(encode_jpeg(picture, OVERLAY_JPEG_QUALITY))

    def picture(
        self,
        pair: str,
        configuration: CalibrationConfig,
        pose: Sequence[Sequence[float]],
        frames: Sequence[Sequence[bytes | None]],
        title: str,
    ) -> worker_jobs.RenderedImage:
        """JPEG of one pair of the stream at an extrinsic, like `overlay`; the pair is packed as `messages` does.

        Raises:
            DecodeError: a frame cannot be decoded.
        """
        (frame_pair,) = worker_jobs.unpack_pairs(frames, self._config.limits)
        return self._render(
            self._rigs[pair], configuration, pose, frame_pair, title, self._scale(pair, frame_pair.lidar)
        )

    def commission(
        self, run: int, configuration: CalibrationConfig, pose: Sequence[Sequence[float]], paths: Sequence[Path]
    ) -> worker_jobs.Commissioned | worker_jobs.Underway:
        """Does the next slice of a commissioning: learns the baseline of a rig at an extrinsic (rows of the (4, 4)
        matrix) from recorded windows, and writes it at the end. Begins anew if `run`, the number of the commissioning,
        is not that of the one that was begun; an earlier one is given up.

        Raises:
            WindowError, CalibrationError, DecodeError, ModelError, StateError: there is no baseline.
        """
        current, self._commissioning = self._commissioning, None  # stays None if a step raises
        end_s = time.monotonic() + SLICE_S
        if current is None or current.run != run:
            start = np.array(pose, dtype=np.float64)
            current = _Commissioning(run, self._commissioning_steps(configuration, start, paths), time.monotonic())
        try:
            step = next(current.steps)
            while time.monotonic() < end_s:
                step = next(current.steps)
        except StopIteration as end:
            baseline: Baseline = end.value
        else:
            self._commissioning = current
            return worker_jobs.Underway(step.stage, step.done, step.total)
        saved = save_baseline(self._config.state.directory / BASELINES, baseline)
        return worker_jobs.Commissioned(baseline.T_camera_lidar, saved, baseline.windows, baseline.pairs)

    def forget_abandoned(self) -> None:
        """Frees the memory of a commissioning that was begun so long ago that its job has been given up."""
        current = self._commissioning
        if (
            current is not None
            and time.monotonic() - current.started_s > worker_jobs.DEADLINE_S[worker_jobs.Kind.COMMISSION]
        ):
            self._commissioning = None

    def _commissioning_steps(
        self, configuration: CalibrationConfig, reference: types.Matrix4, paths: Sequence[Path]
    ) -> types.Steps[Baseline]:
        # A cache of its own, because checks in between would push the maps out of the common one.
        depth = CachedDepth(self._network(configuration.depth), MAX_PAIRS)
        windows = self._windows_of(paths, reference)
        return (
            yield from commission_in_steps(
                (yield from windows), depth, self._images, configuration, sensors={}, reference=reference
            )
        )

    @staticmethod
    def _windows_of(paths: Sequence[Path], T_camera_lidar_start: types.Matrix4) -> types.Steps[list[types.Window]]:
        from coec.io.mcap.windows import read_window

        windows = []
        for number, path in enumerate(paths, start=1):
            windows.append(replace(read_window(path)[0], T_camera_lidar_start=T_camera_lidar_start))
            yield types.Step("windows", number, len(paths))
        return windows

    def register(self, lidars: Mapping[str, Any], frames: Sequence[Sequence[bytes | None]]) -> worker_jobs.Registered:
        """Finds the pose of one LiDAR in another; both, and pairs of their sweeps, are packed as `messages` does.

        Raises:
            SourceError: the optional extra is not installed.
            DecodeError: a frame cannot be decoded.
        """
        rig = structured(worker_jobs.wire_form(), lidars, LidarRig)
        edge = register(rig, worker_jobs.unpack_sweeps(frames, self._config.limits))
        return worker_jobs.Registered(
            **{field.name: getattr(edge, field.name) for field in fields(worker_jobs.Registered)}
        )

    def _render(
        self,
        rig: types.Rig,
        configuration: CalibrationConfig,
        pose: Sequence[Sequence[float]],
        pair: types.FramePair,
        title: str,
        scale: RangeScale | None = None,
    ) -> worker_jobs.RenderedImage:
        xyz_m = compensate(pair, rig, enabled=configuration.motion_compensation)
        image = decode_bgr(pair.camera.image, self._config.limits)
        T_camera_lidar = np.array(pose, dtype=np.float64)
        caption = f"{title}\n{instant(pair.camera.stamp_ns)}"
        picture = render_points(image, rig.camera, T_camera_lidar, xyz_m, rig.mask, scale)
        return worker_jobs.RenderedImage(encode_jpeg(titled(picture, caption), OVERLAY_JPEG_QUALITY))

    def _scale(self, pair: str, sweep: types.LidarFrame) -> RangeScale:
        """The colour scale of a stream, which stays the same from picture to picture."""
        scale = stable_scale(self._scales.get(pair), scale_of(lengths(sweep.xyz_m)))
        self._scales[pair] = scale
        return scale

    def _baseline(
        self, pair: str, configuration: CalibrationConfig, depth_identity: str
    ) -> tuple[Baseline | None, str | None]:
        """The baseline of the rig if it holds for this configuration and network; else why it does not hold."""
        try:
            learned = baseline_of_rig(self._rigs[pair], self._config.state)
        except StateError as error:
            return None, str(error)
        if learned is None:
            return None, None
        configured = learned_hash(configuration)
        against = mismatch(learned, self._rigs[pair], depth_identity, configured)
        return (learned, None) if against is None else (None, against)

    def _network(self, config: DepthConfig) -> CachedDepth:
        if config not in self._networks:
            self._networks[config] = CachedDepth(open_depth(config, self._config.limits), self._depth_maps_cached)
        return self._networks[config]


INTERNAL_ERROR = "internal_error"
"""Code of the refusal if the program failed in the work."""


def answer_request(solver: Solver, message: dict[str, Any]) -> dict[str, Any]:
    """The answer to one question, under its number. If the solve of a window raises anything but a `CoecError`, the
    process ends; the service replaces it and tries again, a limited number of times."""
    number = message["id"]
    try:
        end = (
            solver.solve(Path(message["path"]))
            if message["kind"] == worker_jobs.Kind.SOLVE
            else _answer_once(solver, message)
        )
    except CoecError as error:
        end = types.Reason(error.reply_code, str(error))
    return worker_jobs.pack_answer(number, end)


def _answer_once(
    solver: Solver, message: dict[str, Any]
) -> worker_jobs.Answer | worker_jobs.Underway | types.Reason | None:
    """The answer to work that is tried only once. A fault of the program is an answer, too, because checks come every
    few seconds: if each of them ended the worker, it would solve no more windows.

    Raises:
        CoecError: the work has no result.
        MemoryError: the process has to end.
    """
    try:
        match message["kind"]:
            case worker_jobs.Kind.CHECK:
                return solver.observe(message["pair"], _configuration(message), message["pose"], message["frames"])
            case worker_jobs.Kind.OVERLAY if "poses" in message:
                return solver.comparison(Path(message["path"]), message["poses"], message["names"])
            case worker_jobs.Kind.OVERLAY:
                return solver.overlay(Path(message["path"]), message["pose"], message["title"])
            case worker_jobs.Kind.PICTURE:
                return solver.picture(
                    message["pair"], _configuration(message), message["pose"], message["frames"], message["title"]
                )
            case worker_jobs.Kind.COMMISSION:
                paths = [Path(path) for path in message["paths"]]
                return solver.commission(message["run"], _configuration(message), message["pose"], paths)
            case worker_jobs.Kind.REGISTER:
                return solver.register(message["lidars"], message["frames"])
            case worker_jobs.PREFETCH:
                solver.prefetch(message["pair"], message["frame"])
                return None
        raise ValueError(f"unknown kind of job: {message['kind']!r}")
    except (CoecError, MemoryError):
        raise
    except Exception as error:
        _log.exception("the work failed", extra={"fields": {"kind": message["kind"], "pair": message.get("pair")}})
        text = f"The program failed ({type(error).__name__}: {error}); the log has the traceback."
        return types.Reason(INTERNAL_ERROR, text)


def _configuration(message: dict[str, Any]) -> CalibrationConfig:
    return CalibrationConfig.model_validate(message["configuration"])
