"""ROS's `camera_info` YAML, as camera_calibration writes it and camera_info_manager reads it: the intrinsics that
belong to the extrinsic, which stands in the comments. Format: http://wiki.ros.org/camera_calibration_parsers."""

from coec.errors import OutputError
from coec.geometry.cameras import intrinsics_of, name_of
from coec.io.exported_extrinsic import ExportedExtrinsic, quaternion_xyzw, translation_m
from coec.io.rig_files import camera_of
from coec.io.ros.message_encoding import DISTORTION, UnsupportedCameraError, ros_camera

ENCODING = "application/yaml"
DIRECTION = "pose of the child (optical: z forward) in the parent; quaternion x y z w"


def text(extrinsic: ExportedExtrinsic, existing: str | None) -> str:  # noqa: ARG001  the file holds this one camera
    """The whole file. A lens that ROS does not know is written as `equidistant`, if that fits.

    Raises:
        OutputError: the intrinsics are not known, or ROS has no model for them.
    """
    if extrinsic.camera is None:
        raise OutputError(
            "ros_camera_info needs the intrinsics of the camera, which are unknown here: export from a window, or give "
            "--config"
        )
    try:
        camera, residual_px = ros_camera(camera_of(extrinsic.camera))
    except UnsupportedCameraError as error:
        raise OutputError(str(error)) from error
    model, names = DISTORTION[name_of(camera)]
    parameters = intrinsics_of(camera)
    distortion = [float(parameters[name]) for name in names] or [0.0] * 5
    fx, fy, cx, cy = (float(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    remarks = [
        *extrinsic.remarks(DIRECTION),
        f"{extrinsic.child} in {extrinsic.parent}: translation {translation_m(extrinsic.T_parent_child)}, quaternion "
        f"{quaternion_xyzw(extrinsic.T_parent_child)}",
        *([f"the lens as equidistant, at most {residual_px:.2g} px off"] if residual_px > 0.0 else []),
    ]
    matrices = (
        ("camera_matrix", 3, 3, [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        ("distortion_coefficients", 1, len(distortion), distortion),
        ("rectification_matrix", 3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        ("projection_matrix", 3, 4, [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
    )
    lines = [
        *(f"# {comment}" for comment in remarks),
        f"image_width: {camera.width}",
        f"image_height: {camera.height}",
        f'camera_name: "{extrinsic.child}"',
        f"distortion_model: {model}",
        *(
            f"{name}:\n  rows: {rows}\n  cols: {columns}\n  data: [{', '.join(map(repr, values))}]"
            for name, rows, columns, values in matrices
        ),
    ]
    return "\n".join(lines) + "\n"
