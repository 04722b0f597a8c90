"""Formats in JSON: nuScenes' `calibrated_sensor.json`, OpenLABEL's coordinate systems, COLMAP's `rig_config.json`, and
a plain one. As JSON has no comments, the remarks are under `coec`, which readers of these formats ignore."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from coec.errors import OutputError
from coec.io.exports.exported_extrinsic import ExportedExtrinsic, quaternion_wxyz, quaternion_xyzw, translation_m

NUSCENES_DIRECTION = "pose of the child (optical: z forward) in the parent (nuScenes: ego); rotation w x y z"
OPENLABEL_DIRECTION = "pose of the child (optical: z forward) in the parent; quaternion x y z w"
COLMAP_DIRECTION = "cam_from_rig maps the rig (the parent) to the optical camera frame; rotation w x y z"
PLAIN_DIRECTION = "T_child_parent maps coordinates in the parent to the optical camera frame (z forward); row-major"


def nuscenes_text(extrinsic: ExportedExtrinsic, existing: str | None) -> str:
    """The table with the record of this sensor, whose `sensor_token` is the child frame.

    Raises:
        OutputError: the existing file is not such a table.
    """
    table = [] if existing is None else _parsed(existing)
    if not isinstance(table, list) or not all(isinstance(record, dict) for record in table):
        raise OutputError("the file is no table of nuScenes: a list of records is expected")
    camera = extrinsic.camera
    intrinsic = [] if camera is None else [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    same = [record for record in table if record.get("sensor_token") == extrinsic.child]
    record = same[0] if same else {"token": hashlib.md5(extrinsic.child.encode(), usedforsecurity=False).hexdigest()}
    record.update(
        sensor_token=extrinsic.child,
        translation=translation_m(extrinsic.T_parent_child),
        rotation=quaternion_wxyz(extrinsic.T_parent_child),
        camera_intrinsic=intrinsic,
        coec=extrinsic.document(NUSCENES_DIRECTION),
    )
    return _written(table if same else [*table, record])


def openlabel_text(extrinsic: ExportedExtrinsic, existing: str | None) -> str:
    """The document with this coordinate system, and with its parent if that is missing.

    Raises:
        OutputError: the existing file is not an OpenLABEL document.
    """
    fresh: dict[str, Any] = {"openlabel": {"metadata": {"schema_version": "1.0.0"}, "coordinate_systems": {}}}
    document = fresh if existing is None else _parsed(existing)
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
            "coec": extrinsic.document(OPENLABEL_DIRECTION),
        }
    except (AttributeError, KeyError, TypeError) as error:
        raise OutputError("the file is no OpenLABEL document") from error
    return _written(document)


def colmap_text(extrinsic: ExportedExtrinsic, existing: str | None) -> str:
    """The rigs with this camera, whose `image_prefix` is the child and a slash. It is put into the rig whose reference
    sensor is the parent, or into a new rig if there is none.

    COLMAP accepts a rig only with a reference sensor, to which all poses of its cameras relate. Here it is the parent,
    under a prefix that no image has.

    Raises:
        OutputError: the existing file is not such a list, or has this camera in a rig with another reference.
    """
    rigs = [] if existing is None else _parsed(existing)
    reference, prefix = f"{extrinsic.parent}/", f"{extrinsic.child}/"
    camera = {
        "image_prefix": prefix,
        "cam_from_rig_rotation": quaternion_wxyz(extrinsic.T_child_parent),
        "cam_from_rig_translation": translation_m(extrinsic.T_child_parent),
        "coec": extrinsic.document(COLMAP_DIRECTION),
    }
    try:
        for rig in rigs:
            references = [one["image_prefix"] for one in rig["cameras"] if one.get("ref_sensor")]
            same = [one for one in rig["cameras"] if one["image_prefix"] == prefix]
            if references == [reference]:
                if same:
                    same[0].update(camera)
                else:
                    rig["cameras"].append(camera)
                return _written(rigs)
            if same:
                raise OutputError(
                    f"camera {prefix!r} is in a rig whose reference is {references}: its pose there is not one from "
                    f"{reference!r}; write into another file, or name that reference with --parent and --parent-pose"
                )
        return _written([*rigs, {"cameras": [{"image_prefix": reference, "ref_sensor": True}, camera]}])
    except (AttributeError, KeyError, TypeError) as error:
        raise OutputError("the file is no rig configuration of COLMAP") from error


def plain_text(extrinsic: ExportedExtrinsic, existing: str | None) -> str:  # noqa: ARG001  the file holds this one transform
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
        **extrinsic.document(PLAIN_DIRECTION),
    }
    return _written(document)


def _parsed(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise OutputError(f"the file is no JSON: {error}") from error


def _written(document: object) -> str:
    return json.dumps(document, indent=2) + "\n"
