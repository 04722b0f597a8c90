"""A plain JSON document of our own."""

from coec.io.exported_extrinsic import ExportedExtrinsic, json_text, quaternion_xyzw, translation_m

ENCODING = "application/json"
DIRECTION = "T_child_parent maps coordinates in the parent to the optical camera frame (z forward); row-major"


def text(extrinsic: ExportedExtrinsic, existing: str | None) -> str:  # noqa: ARG001  the file holds this one transform
    """The whole file: the transform in both directions and in three forms."""
    document = {
        "parent": extrinsic.parent,
        "child": extrinsic.child,
        "T_child_parent": extrinsic.T_child_parent.tolist(),
        "pose_of_child_in_parent": {
            "translation_m": translation_m(extrinsic.T_parent_child),
            "quaternion_xyzw": quaternion_xyzw(extrinsic.T_parent_child),
        },
        "camera": None if extrinsic.camera is None else extrinsic.camera.model_dump(mode="json", exclude_none=True),
        **extrinsic.document(DIRECTION),
    }
    return json_text(document)
