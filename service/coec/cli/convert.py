"""`coec convert`: writes a recording for other tools, or a configuration that serves it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from math import floor
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from coec.cli.options import Force, Json, Source
from coec.errors import OutputError, UsageError
from coec.reports import console

if TYPE_CHECKING:
    from coec.calibration.types import CameraFrame, Frame, Matrix4, Rig
    from coec.config import CalibrationConfig, PairConfig, SweepConfig, WindowConfig
    from coec.io.recordings.layouts import RecordingSource

NS_PER_S = 1_000_000_000

ALWAYS = (
    "vehicle",
    "zenoh.connect",
    "zenoh.listen",
    "state.directory",
    "pairs.camera.frame_id",
    "pairs.lidar.frame_id",
)
"""Keys that a person has to see before the configuration is used elsewhere, whatever their defaults are."""

COMMENTS = {
    "vehicle": "unique in the fleet; a part of every key",
    "zenoh": "the router; where an embedded one listens",
    "state": "windows, and what survives a restart",
    "pairs.T_camera_lidar": "workshop calibration: LiDAR to camera",
    "pairs.window": "fits this recording; leave it out for longer drives",
}
"""Comments on keys of a short configuration."""


def convert(
    source: Source,
    out: Annotated[
        Path,
        typer.Argument(
            metavar="OUT",
            help="OUT.mcap: one ROS 2 MCAP of all frames. OUT.yaml: a daemon configuration for this recording.",
            show_default=False,
        ),
    ],
    full: Annotated[
        bool,
        typer.Option("--full", help="OUT.yaml with every key and a comment on each, not only what has no default."),
    ] = False,
    force: Force = False,
    as_json: Json = False,
) -> int:
    """Turn a recording into a ROS 2 MCAP, or into a configuration with which `run` serves it."""
    from coec.io import user_files
    from coec.io.recordings.layouts import open_source

    if out.suffix not in (".mcap", ".yaml", ".yml"):
        raise UsageError(f"{out}: OUT must end in .mcap (ROS 2 bag) or .yaml (daemon configuration)")
    if full and out.suffix == ".mcap":
        raise UsageError("--full belongs to a configuration, OUT.yaml")
    user_files.require_absent(out, force=force)
    recording = open_source(source)
    is_bag = out.suffix == ".mcap"
    written = _bag(recording, out) if is_bag else _configuration(recording, out, full=full, force=force)
    if as_json:
        console.print_json({"written": [str(path) for path in written]})
    else:
        for path in written:
            console.show(f"{path}  {path.stat().st_size} bytes")
    return 0


def configuration_for(recording: RecordingSource, T_camera_lidar: Matrix4, mask: Path | None) -> PairConfig:
    """A pair that accepts the frames of a recording as they are, on `sensors/<pair>/camera|lidar|ego`.

    Its window is one that the recording can fill, see `_window`.
    """
    from coec.calibration.types import CameraFrame, EgoMotion, LidarFrame
    from coec.config import CameraConfig, EgoConfig, LidarConfig, PairConfig
    from coec.io.rig_files import intrinsics_config, matrix_rows
    from coec.io.zenoh.player import StreamKeys

    rig = recording.rig
    streams = StreamKeys.default(rig.pair)
    first = first_frames(recording)
    motion = next((frame for frame in first if isinstance(frame, EgoMotion)), None)
    camera = next(frame for frame in first if isinstance(frame, CameraFrame))
    lidar = next(frame for frame in first if isinstance(frame, LidarFrame))
    return PairConfig(
        name=rig.pair,
        camera=CameraConfig(
            key=streams.camera,
            frame_id=camera.frame_id,
            intrinsics=intrinsics_config(rig.camera),
            mask=mask,
        ),
        lidar=LidarConfig(key=streams.lidar, frame_id=lidar.frame_id, sweep=_sweep(rig)),
        ego=None if motion is None else EgoConfig(key=str(streams.ego), T_lidar_ego=matrix_rows(rig.T_lidar_ego)),
        T_camera_lidar=matrix_rows(T_camera_lidar),
        window=_window(recording.camera_stamps_ns),
        calibration=recording.configuration or _calibration(camera),
    )


def _window(camera_stamps_ns: Sequence[int]) -> WindowConfig:
    """The default window, or one that the recording can fill.

    A recording that is shorter than a slice gets slices of half its length, so that one window is judged while the
    other half still passes, and as many pairs as such a half has frames. With fewer than twice the camera frames that a
    window needs, the whole recording is one slice, and half of the frames are enough: too few would be left as soon as
    some are refused, because the vehicle stood.
    """
    from coec.config import WindowConfig

    window = WindowConfig()
    frames = len(camera_stamps_ns)
    length_s = (camera_stamps_ns[-1] - camera_stamps_ns[0]) / NS_PER_S
    few = frames < 2 * window.min_pairs
    fitted: dict[str, float] = {"min_pairs": max(1, frames // 2)} if few else {}
    if 1e-3 <= length_s < window.slice_s:
        # Rounded down, because the first pair after a slice ends it.
        fitted["slice_s"] = floor((length_s if few else length_s / 2) * 1e3) / 1e3
        fitted["pairs"] = min(window.pairs, frames if few else frames // 2)
    return window.model_copy(update=fitted)


def _calibration(camera: CameraFrame) -> CalibrationConfig:
    """The defaults, with the depth maps of the recording where it has them."""
    from coec.config import CalibrationConfig, DepthConfig
    from coec.io.depth.depth_maps import STEREO

    return CalibrationConfig() if camera.depth is None else CalibrationConfig(depth=DepthConfig(model=STEREO))


def first_frames(recording: RecordingSource) -> list[Frame]:
    """The first camera frame, and the frames that are needed to pair it."""
    return list(recording.messages([0]))


def _configuration(recording: RecordingSource, out: Path, *, full: bool, force: bool) -> list[Path]:
    import numpy as np

    from coec.config import Config, StateConfig
    from coec.io import user_files
    from coec.io.rig_files import mask_to_png
    from coec.reports.commented_yaml import commented_yaml, short_yaml

    mask, mask_path = recording.rig.mask, out.with_name(f"{out.stem}-mask.png")
    if mask is not None:
        user_files.require_absent(mask_path, force=force)
    name = None if mask is None else Path(mask_path.name)
    pair = configuration_for(recording, recording.rig.T_camera_lidar_nominal, name)
    config = Config(state=StateConfig(), pairs=(pair,))
    head = f"# Configuration of coec for the recording {recording.name}. `coec play` publishes it on these keys.\n"
    if full:
        text = head + commented_yaml(config)
    else:
        text = f"{head}# Keys that are not here have their defaults: `coec check-config {out.name}` prints them all.\n"
        text += short_yaml(config, ALWAYS, COMMENTS)
    if mask is None:
        return [user_files.replace_output(out, text.encode())]
    had_mask = mask_path.exists()
    user_files.replace_output(mask_path, mask_to_png(np.asarray(mask)))
    try:
        user_files.replace_output(out, text.encode())
    except OutputError:
        if not had_mask:  # it would refuse the next try
            mask_path.unlink(missing_ok=True)
        raise
    return [mask_path, out]


def _bag(recording: RecordingSource, out: Path) -> list[Path]:
    from coec.calibration.types import CameraFrame
    from coec.io.mcap.writer import write_bag

    depth = any(isinstance(frame, CameraFrame) and frame.depth is not None for frame in first_frames(recording))
    if depth:
        console.say("coec: depth maps have no place in a ROS 2 bag of sensors and are left out")
    total = len(recording.camera_stamps_ns)
    part = out.with_name(f"{out.name}.part")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with console.progress() as bars:
            task = bars.add_task("camera frames", total=total, note="")
            write_bag(
                part,
                recording.rig,
                recording.T_camera_lidar_start,
                (replace(f, depth=None) if isinstance(f, CameraFrame) else f for f in recording.messages()),
                lambda frame: bars.advance(task) if isinstance(frame, CameraFrame) else None,
            )
        part.replace(out)
    except OSError as error:
        raise OutputError(f"cannot write {out}: {error.strerror}") from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
    return [out]


def _sweep(rig: Rig) -> SweepConfig | None:
    import numpy as np

    from coec.config import SweepConfig

    if rig.sweep is None:
        return None
    sign: Literal[-1, 1] = 1 if rig.sweep.sign > 0 else -1
    azimuth_deg = float(np.degrees(rig.sweep.stamp_azimuth_rad))
    return SweepConfig(period_s=rig.sweep.period_s, sign=sign, stamp_azimuth_deg=azimuth_deg)
