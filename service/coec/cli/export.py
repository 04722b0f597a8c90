"""`coec export`: writes a calibration as a file of another program."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coec.cli.options import Json, pair_named, suggesting
from coec.errors import DecodeError, SourceError, UsageError
from coec.io.exports import FORMATS
from coec.reports import console

if TYPE_CHECKING:
    from coec.calibration.types import Matrix4
    from coec.config import CameraIntrinsics, Config
    from coec.io.exported_extrinsic import ExportedExtrinsic, ExportFrames

NAMES = tuple(FORMATS)

CalibrationSource = Annotated[
    Path,
    typer.Argument(
        metavar="SOURCE",
        help="A state directory, a recorded window (.mcap), the JSON of `calibrate` or of `query extrinsic`.",
        show_default=False,
    ),
]
Format = Annotated[
    str,
    typer.Option(
        "--format",
        help=f"{', '.join(NAMES[:-1])} or {NAMES[-1]}.",
        metavar="NAME",
        autocompletion=suggesting(lambda: NAMES),
        show_default=False,
    ),
]
ParentPose = Annotated[
    str | None,
    typer.Option(
        help="Pose of the LiDAR in the parent: metres and a quaternion.",
        metavar="X,Y,Z,QX,QY,QZ,QW",
        show_default="the LiDAR is the parent",
    ),
]
OutputFile = Annotated[
    Path | None,
    typer.Option(
        help="File to write, completely or not at all; in a file with several entries only this one changes. "
        "Default: print it.",
        metavar="FILE",
    ),
]


def export(
    source: CalibrationSource,
    format: Format,
    parent: Annotated[str | None, typer.Option(help="Parent frame in the file.", show_default="the LiDAR's")] = None,
    child: Annotated[
        str | None, typer.Option(help="Name of the camera's frame in the file.", show_default="the camera's")
    ] = None,
    parent_pose: ParentPose = None,
    pair: Annotated[str | None, typer.Option(help="Pair, if there are several.")] = None,
    config: Annotated[
        Path | None, typer.Option(help="Configuration of the daemon, for intrinsics and frames.", metavar="FILE")
    ] = None,
    output: OutputFile = None,
    force: Annotated[
        bool, typer.Option("--force", help="Write a calibration that is not accepted, too; the file says so.")
    ] = False,
    as_json: Json = False,
) -> int:
    """Write a calibration into the files of other programs: exit 1 if it is not accepted."""
    from coec.io import user_files as files
    from coec.io.exported_extrinsic import ExportFrames, require_accepted
    from coec.io.exports import export_text, require_format

    require_format(format)
    frames = ExportFrames(parent, child, _pose(parent_pose))
    extrinsic = _read(source, config, pair, frames)
    require_accepted(extrinsic, str(source), "--force", force=force)
    text = export_text(extrinsic, format, output)
    if output is not None:
        files.replace_output(output, text.encode())
    if as_json:
        written = None if output is None else str(output)
        console.print_json({"format": format, "text": text, "written": written})
    elif output is None:
        console.write(text)
    else:
        console.show(f"{output}  {extrinsic.child} in {extrinsic.parent}, {extrinsic.origin.provenance}")
    return 0


def _read(source: Path, config: Path | None, pair: str | None, frames: ExportFrames) -> ExportedExtrinsic:
    from coec.config import load_config
    from coec.service.discovery import with_discovered
    from coec.service.records.state_store import STATE_FILE

    loaded = None if config is None else with_discovered(load_config(config))
    if source.is_dir() or source.name == STATE_FILE:
        return _of_state(source if source.is_dir() else source.parent, pair, loaded, frames)
    if source.suffix == ".mcap":
        return _of_window(source, frames)
    return _of_document(source, None if loaded is None else pair_named(loaded, pair).camera.intrinsics, frames)


def _of_window(path: Path, frames: ExportFrames) -> ExportedExtrinsic:
    from coec.io.exported_extrinsic import extrinsic_of_result
    from coec.io.mcap.windows import read_result, read_window
    from coec.io.rig_files import intrinsics_config

    result = read_result(path)
    if result is None:
        raise SourceError(f"{path} holds no result: `coec calibrate {path} --output DIR` makes one")
    window, _ = read_window(path)
    return extrinsic_of_result(result, intrinsics_config(window.rig.camera), frames)


def _of_document(path: Path, camera: CameraIntrinsics | None, frames: ExportFrames) -> ExportedExtrinsic:
    from coec.io.exported_extrinsic import extrinsic_of_reply, extrinsic_of_result
    from coec.io.exports import MAX_EXPORT_BYTES
    from coec.io.user_files import read_bytes
    from coec.schemas.message import from_json
    from coec.schemas.replies import CalibrationResult, ExtrinsicReply

    data = read_bytes(path, MAX_EXPORT_BYTES)
    with suppress(DecodeError):
        return extrinsic_of_result(from_json(CalibrationResult, data), camera, frames)
    with suppress(DecodeError):
        return extrinsic_of_reply(from_json(ExtrinsicReply, data), camera, frames)
    raise SourceError(
        f"{path} is neither the result of `coec calibrate --json` nor a reply of `coec query extrinsic --json`, nor a "
        "state directory, nor a window (.mcap)"
    )


def _of_state(folder: Path, name: str | None, config: Config | None, frames: ExportFrames) -> ExportedExtrinsic:
    """The calibration that the service of a state directory serves, with its full covariance."""
    from coec.io.exported_extrinsic import intrinsics_config_of
    from coec.service.api.reply_builders import exported
    from coec.service.records.state_store import read_pairs

    pairs = read_pairs(folder)
    if name is None and len(pairs) != 1:
        raise UsageError(f"{folder} holds the pairs {', '.join(sorted(pairs))}: name one with --pair")
    served = next(iter(pairs)) if name is None else name
    if served not in pairs:
        raise UsageError(f"{folder} holds no pair {served}; it holds {', '.join(sorted(pairs))}")
    accepted, state = pairs[served]
    if config is not None:
        pair = pair_named(config, served)
        own = (pair.lidar.frame_id, pair.camera.frame_id)
        return exported(state, config.vehicle, served, own, pair.camera.intrinsics, frames)
    if accepted is None:
        raise UsageError(f"{folder}: nothing was accepted yet; --config gives the frames of the nominal calibration")
    own = (accepted.lidar_frame, accepted.camera_frame)
    camera = intrinsics_config_of(accepted.intrinsics)
    return exported(state, accepted.vehicle, served, own, camera, frames)


def _pose(text: str | None) -> Matrix4 | None:
    from coec.io.exported_extrinsic import parse_pose

    if text is None:
        return None
    try:
        return parse_pose(text)
    except ValueError as error:
        raise UsageError(f"--parent-pose {text}: {error}") from error
