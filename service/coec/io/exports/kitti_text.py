"""KITTI's text files: `calib_velo_to_cam.txt` of the raw recordings, and KITTI-360's `calib_cam_to_velo.txt`."""

from __future__ import annotations

from coec.io.exports.exported_extrinsic import ExportedExtrinsic, utc

RAW_DIRECTION = "R, T: p_camera = R p_velo + T, rows of R; velo is the parent, the camera unrectified"
KITTI360_DIRECTION = "p_velo = M p_camera, three rows of M; velo is the parent, the camera unrectified"


def raw_text(extrinsic: ExportedExtrinsic, existing: str | None) -> str:  # noqa: ARG001  the file holds this one transform
    """The whole file. Its readers treat lines that are no numbers as text, such as `calib_time`."""
    T = extrinsic.T_child_parent
    lines = [
        f"calib_time: {utc(extrinsic.origin.data_stamp_ns)}",
        f"R: {_row(T[:3, :3].ravel().tolist())}",
        f"T: {_row(T[:3, 3].tolist())}",
        *(f"coec_{number}: {comment}" for number, comment in enumerate(extrinsic.remarks(RAW_DIRECTION))),
    ]
    return "\n".join(lines) + "\n"


def kitti360_text(extrinsic: ExportedExtrinsic, existing: str | None) -> str:  # noqa: ARG001  the file holds this one transform
    """The whole file: comments, and one line of twelve numbers."""
    lines = [
        *(f"# {comment}" for comment in extrinsic.remarks(KITTI360_DIRECTION)),
        _row(extrinsic.T_parent_child[:3].ravel().tolist()),
    ]
    return "\n".join(lines) + "\n"


def _row(values: list[float]) -> str:
    return " ".join(repr(value) for value in values)
