"""OpenLABEL's coordinate systems. Remarks are under `coec`, which its readers ignore."""

from typing import Any

from coec.errors import OutputError
from coec.io.exported_extrinsic import ExportedExtrinsic, json_text, parsed_json, quaternion_xyzw, translation_m

ENCODING = "application/json"
DIRECTION = "pose of the child (optical: z forward) in the parent; quaternion x y z w"


def text(extrinsic: ExportedExtrinsic, existing: str | None) -> str:
    """The document with this coordinate system, and with its parent if that is missing.

    Raises:
        OutputError: the existing file is not an OpenLABEL document.
    """
    fresh: dict[str, Any] = {"openlabel": {"metadata": {"schema_version": "1.0.0"}, "coordinate_systems": {}}}
    document = fresh if existing is None else parsed_json(existing)
    try:
        systems = document["openlabel"].setdefault("coordinate_systems", {})
        parent = systems.setdefault(extrinsic.parent, {"type": "local", "parent": "", "children": []})
        children = parent.setdefault("children", [])
        if extrinsic.child not in children:
            children.append(extrinsic.child)
        systems[extrinsic.child] = {
            **systems.get(extrinsic.child, {"type": "sensor", "children": []}),
            "parent": extrinsic.parent,
            "pose_wrt_parent": {
                "quaternion": quaternion_xyzw(extrinsic.T_parent_child),
                "translation": translation_m(extrinsic.T_parent_child),
            },
            "coec": extrinsic.document(DIRECTION),
        }
    except (AttributeError, KeyError, TypeError) as error:
        raise OutputError("the file is no OpenLABEL document") from error
    return json_text(document)
