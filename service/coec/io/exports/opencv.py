"""OpenCV's FileStorage (YAML 1.0): a 4×4 matrix, named after its frames."""

import re

from coec.errors import OutputError
from coec.io.exported_extrinsic import ExportedExtrinsic

ENCODING = "application/yaml"
HEAD = "%YAML:1.0\n---\n"
DIRECTION = "maps coordinates in the parent to the optical camera frame (z forward); row by row"


def text(extrinsic: ExportedExtrinsic, existing: str | None) -> str:
    """The file with this matrix: it replaces the one of the same name, or is added at the end.

    YAML libraries cannot read FileStorage, so that the lines of the matrix are found by the way OpenCV writes them: a
    name at the margin, and indented lines below it.

    Raises:
        OutputError: the existing file does not begin like OpenCV's files.
    """
    name = re.sub(r"\W", "_", f"T_{extrinsic.child}_{extrinsic.parent}")
    data = ", ".join(repr(value) for value in extrinsic.T_child_parent.ravel().tolist())
    block = "".join(
        (
            f"{name}: !!opencv-matrix\n",
            *(f"   # {comment}\n" for comment in extrinsic.remarks(DIRECTION)),
            f"   rows: 4\n   cols: 4\n   dt: d\n   data: [ {data} ]\n",
        )
    )
    if existing is None:
        return HEAD + block
    if not existing.startswith("%YAML"):
        raise OutputError("the file is none of OpenCV's: it does not begin with %YAML")
    pattern = re.compile(rf"^{re.escape(name)}:.*\n(?:[ \t]+.*\n)*", re.MULTILINE)
    whole = existing if existing.endswith("\n") else existing + "\n"
    return pattern.sub(lambda _: block, whole, count=1) if pattern.search(whole) else whole + block
