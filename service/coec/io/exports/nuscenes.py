"""nuScenes' table `calibrated_sensor.json`. Remarks are under `coec`, which its readers ignore."""

import hashlib

from coec.errors import OutputError
from coec.io.exported_extrinsic import ExportedExtrinsic, json_text, parsed_json, quaternion_wxyz, translation_m

ENCODING = "application/json"
DIRECTION = "pose of the child (optical: z forward) in the parent (nuScenes: ego); rotation w x y z"


def text(extrinsic: ExportedExtrinsic, existing: str | None) -> str:
    """The table with the record of this sensor, whose `sensor_token` is the child frame.

    Raises:
        OutputError: the existing file is not such a table.
    """
    table = [] if existing is None else parsed_json(existing)
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
        coec=extrinsic.document(DIRECTION),
    )
    return json_text(table if same else [*table, record])
