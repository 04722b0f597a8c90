"""COLMAP's `rig_config.json`. Remarks are under `coec`, which its readers ignore."""

from coec.errors import OutputError
from coec.io.exported_extrinsic import ExportedExtrinsic, json_text, parsed_json, quaternion_wxyz, translation_m

ENCODING = "application/json"
DIRECTION = "cam_from_rig maps the rig (the parent) to the optical camera frame; rotation w x y z"


def text(extrinsic: ExportedExtrinsic, existing: str | None) -> str:
    """The rigs with this camera, whose `image_prefix` is the child and a slash. It is put into the rig whose reference
    sensor is the parent, or into a new rig if there is none.

    COLMAP accepts a rig only with a reference sensor, to which all poses of its cameras relate. Here it is the parent,
    under a prefix that no image has.

    Raises:
        OutputError: the existing file is not such a list, or has this camera in a rig with another reference.
    """
    rigs = [] if existing is None else parsed_json(existing)
    reference, prefix = f"{extrinsic.parent}/", f"{extrinsic.child}/"
    camera = {
        "image_prefix": prefix,
        "cam_from_rig_rotation": quaternion_wxyz(extrinsic.T_child_parent),
        "cam_from_rig_translation": translation_m(extrinsic.T_child_parent),
        "coec": extrinsic.document(DIRECTION),
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
                return json_text(rigs)
            if same:
                raise OutputError(
                    f"camera {prefix!r} is in a rig whose reference is {references}: its pose there is not one from "
                    f"{reference!r}; write into another file, or name that reference with --parent and --parent-pose"
                )
        return json_text([*rigs, {"cameras": [{"image_prefix": reference, "ref_sensor": True}, camera]}])
    except (AttributeError, KeyError, TypeError) as error:
        raise OutputError("the file is no rig configuration of COLMAP") from error
