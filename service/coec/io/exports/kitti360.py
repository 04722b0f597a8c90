"""KITTI-360's `calib_cam_to_velo.txt`."""

from coec.io.exported_extrinsic import ExportedExtrinsic, number_row

ENCODING = "text/plain"
DIRECTION = "p_velo = M p_camera, three rows of M; velo is the parent, the camera unrectified"


def text(extrinsic: ExportedExtrinsic, existing: str | None) -> str:  # noqa: ARG001  the file holds this one transform
    """The whole file: comments, and one line of twelve numbers."""
    lines = [
        *(f"# {comment}" for comment in extrinsic.remarks(DIRECTION)),
        number_row(extrinsic.T_parent_child[:3].ravel().tolist()),
    ]
    return "\n".join(lines) + "\n"
