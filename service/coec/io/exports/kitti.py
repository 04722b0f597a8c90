"""`calib_velo_to_cam.txt` of KITTI's raw recordings."""

from coec.io.exported_extrinsic import ExportedExtrinsic, number_row, utc

ENCODING = "text/plain"
DIRECTION = "R, T: p_camera = R p_velo + T, rows of R; velo is the parent, the camera unrectified"


def text(extrinsic: ExportedExtrinsic, existing: str | None) -> str:  # noqa: ARG001  the file holds this one transform
    """The whole file. Its readers treat lines that are no numbers as text, such as `calib_time`."""
    T = extrinsic.T_child_parent
    lines = [
        f"calib_time: {utc(extrinsic.origin.data_stamp_ns)}",
        f"R: {number_row(T[:3, :3].ravel().tolist())}",
        f"T: {number_row(T[:3, 3].tolist())}",
        *(f"coec_{number}: {comment}" for number, comment in enumerate(extrinsic.remarks(DIRECTION))),
    ]
    return "\n".join(lines) + "\n"
