"""`coec export`: writes a calibration as a file of another program."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from coec.adapters.exports.extrinsic import Extrinsic
from coec.adapters.exports.told import Frames, intrinsics_config_of, of_reply, of_result, pose_of
from coec.adapters.files import output
from coec.adapters.files.rig import intrinsics_config
from coec.adapters.mcap.windows import read_result, read_window
from coec.calibration.types import Matrix4
from coec.cli.commands.export import Options
from coec.cli.one_pair import pair_named
from coec.config import CameraIntrinsics, Config, load_config
from coec.errors import DecodeError, SourceError, UsageError
from coec.library.exporting import MAX_BYTES, accepted, known, text_of
from coec.reports import console
from coec.runtime.api.exports import exported
from coec.runtime.decisions.state_store import STATE_FILE, read_pairs
from coec.runtime.nominal.kept import with_kept
from coec.schemas.base import from_json
from coec.schemas.replies import CalibrationResult, ExtrinsicReply
from coec.sources.reading import read_bytes


def run(options: Options) -> int:
    """Writes the file, or prints it.

    Raises:
        UsageError: no such format, or an option that does not fit.
        SourceError, WindowError, StateError: the source cannot be read, or holds no calibration.
        NotAcceptedError: the calibration is not accepted, and `--force` was not given.
        OutputError: the file cannot be written, or its content cannot be changed.
    """
    known(options.format)
    extrinsic = _read(options)
    accepted(extrinsic, str(options.source), "--force", force=options.force)
    text = text_of(extrinsic, options.format, options.output)
    if options.output is not None:
        output.replace(options.output, text.encode())
    if options.as_json:
        written = None if options.output is None else str(options.output)
        console.print_json({"format": options.format, "text": text, "written": written})
    elif options.output is None:
        console.write(text)
    else:
        console.show(f"{options.output}  {extrinsic.child} in {extrinsic.parent}, {extrinsic.origin.provenance}")
    return 0


def _read(options: Options) -> Extrinsic:
    config = None if options.config is None else with_kept(load_config(options.config))
    frames = Frames(options.parent, options.child, _pose(options.parent_pose))
    source = options.source
    if source.is_dir() or source.name == STATE_FILE:
        return _of_state(source if source.is_dir() else source.parent, options.pair, config, frames)
    if source.suffix == ".mcap":
        return _of_window(source, frames)
    return _of_document(source, None if config is None else pair_named(config, options.pair).camera.intrinsics, frames)


def _of_window(path: Path, frames: Frames) -> Extrinsic:
    result = read_result(path)
    if result is None:
        raise SourceError(f"{path} holds no result: `coec calibrate {path} --output DIR` makes one")
    window, _ = read_window(path)
    return of_result(result, intrinsics_config(window.rig.camera), frames)


def _of_document(path: Path, camera: CameraIntrinsics | None, frames: Frames) -> Extrinsic:
    data = read_bytes(path, MAX_BYTES)
    with suppress(DecodeError):
        return of_result(from_json(CalibrationResult, data), camera, frames)
    with suppress(DecodeError):
        return of_reply(from_json(ExtrinsicReply, data), camera, frames)
    raise SourceError(
        f"{path} is neither the result of `coec calibrate --json` nor a reply of `coec query extrinsic --json`, nor a "
        "state directory, nor a window (.mcap)"
    )


def _of_state(folder: Path, name: str | None, config: Config | None, frames: Frames) -> Extrinsic:
    """The calibration that the service of a state directory serves, with its full covariance."""
    pairs = read_pairs(folder)
    if name is None and len(pairs) != 1:
        raise UsageError(f"{folder} holds the pairs {', '.join(sorted(pairs))}: choose one with --pair")
    chosen = next(iter(pairs)) if name is None else name
    if chosen not in pairs:
        raise UsageError(f"{folder} holds no pair {chosen}; it holds {', '.join(sorted(pairs))}")
    stored, state = pairs[chosen]
    if config is not None:
        pair = pair_named(config, chosen)
        own = (pair.lidar.frame_id, pair.camera.frame_id)
        return exported(state, config.vehicle, chosen, own, pair.camera.intrinsics, frames)
    if stored.accepted is None:
        raise UsageError(f"{folder}: nothing was accepted yet; --config says which frames the nominal calibration has")
    own = (stored.accepted.lidar_frame, stored.accepted.camera_frame)
    camera = intrinsics_config_of(stored.accepted.intrinsics)
    return exported(state, stored.accepted.vehicle, chosen, own, camera, frames)


def _pose(text: str | None) -> Matrix4 | None:
    if text is None:
        return None
    try:
        return pose_of(text)
    except ValueError as error:
        raise UsageError(f"--parent-pose {text}: {error}") from error
