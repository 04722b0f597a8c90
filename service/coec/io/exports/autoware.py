"""Autoware's `sensor_kit_calibration.yaml`: the pose of a camera's body frame (`<camera>/camera_link`) in the kit."""

from coec.io.exported_extrinsic import ExportedExtrinsic, roll_pitch_yaw, set_yaml_entry, translation_m

ENCODING = "application/yaml"
DIRECTION = (
    "pose in the parent of the camera's body frame (x forward, y left, z up); the optical frame is the body frame "
    "turned by the quaternion x y z w = -0.5 0.5 -0.5 0.5; rad, R = Rz(yaw) Ry(pitch) Rx(roll)"
)


def text(extrinsic: ExportedExtrinsic, existing: str | None) -> str:
    """The file with this camera below its parent.

    Raises:
        OutputError: the existing file cannot be changed.
    """
    T = extrinsic.T_parent_body
    names = ("x", "y", "z", "roll", "pitch", "yaw")
    values = [*translation_m(T), *roll_pitch_yaw(T)]
    lines = [
        *(f"# {comment}" for comment in extrinsic.remarks(DIRECTION)),
        *(f"{name}: {value!r}" for name, value in zip(names, values, strict=True)),
    ]
    if existing is None:
        rows = (f"    {line}" for line in lines)
        return "\n".join((f"{extrinsic.parent}:", f"  {extrinsic.child}:", *rows)) + "\n"
    return set_yaml_entry(existing, (extrinsic.parent, extrinsic.child), lines)
