"""URDF (and xacro): a fixed joint. Format: http://wiki.ros.org/urdf/XML/joint."""

from dataclasses import dataclass, field
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from coec.errors import OutputError
from coec.io.exported_extrinsic import ExportedExtrinsic, roll_pitch_yaw, translation_m

ENCODING = "application/xml"
DIRECTION = "origin: pose of the child (optical: z forward) in the parent; rpy in rad, R = Rz(y) Ry(p) Rx(r)"


@dataclass(slots=True)
class _Joint:
    """A joint of a document: its name, its child link, and its place in bytes."""

    name: str
    begin: int
    child: str | None = None
    end: int = 0


@dataclass(slots=True)
class _JointScan:
    """The joints of a document, and where the root element ends."""

    joints: list[_Joint] = field(default_factory=list)
    open: list[str] = field(default_factory=list)
    root_end: int = 0


def text(extrinsic: ExportedExtrinsic, existing: str | None) -> str:
    """The robot with this joint: it replaces the one with the same child link, or is added as the last one.

    Raises:
        OutputError: the existing file is not XML.
    """
    if existing is None:
        joint = _joint(extrinsic, f"{extrinsic.child}_joint")
        links = "".join(f"  <link name={quoteattr(name)}/>\n" for name in (extrinsic.parent, extrinsic.child))
        return f'<?xml version="1.0"?>\n<robot name="{_ROBOT}">\n{links}  {joint}\n</robot>\n'
    data = existing.encode()
    scan = _joints(data)
    same = next((joint for joint in scan.joints if joint.child == extrinsic.child), None)
    if same is None:
        fresh = _joint(extrinsic, f"{extrinsic.child}_joint").encode()
        return (data[: scan.root_end] + b"  " + fresh + b"\n" + data[scan.root_end :]).decode()
    return (data[: same.begin] + _joint(extrinsic, same.name).encode() + data[same.end :]).decode()


_ROBOT = "vehicle"
"""Name of the robot in a new file."""


def _joint(extrinsic: ExportedExtrinsic, name: str) -> str:
    xyz = " ".join(repr(value) for value in translation_m(extrinsic.T_parent_child))
    rpy = " ".join(repr(value) for value in roll_pitch_yaw(extrinsic.T_parent_child))
    # Two hyphens in a row end a comment.
    remarks = "".join(f"    <!-- {comment.replace('--', '- -')} -->\n" for comment in extrinsic.remarks(DIRECTION))
    return (
        f'<joint name={quoteattr(name)} type="fixed">\n'
        f"{remarks}"
        f"    <parent link={quoteattr(extrinsic.parent)}/>\n"
        f"    <child link={quoteattr(extrinsic.child)}/>\n"
        f'    <origin xyz="{xyz}" rpy="{rpy}"/>\n'
        "  </joint>"
    )


def _joints(data: bytes) -> _JointScan:
    parser = expat.ParserCreate(encoding="utf-8")
    scan = _JointScan()

    def start(tag: str, attributes: dict[str, str]) -> None:
        # A joint is below the root or in a xacro macro; a joint in a transmission has no child.
        if tag == "joint":
            scan.joints.append(_Joint(attributes.get("name", ""), parser.CurrentByteIndex))
        elif tag == "child" and scan.open[-1:] == ["joint"]:
            scan.joints[-1].child = attributes.get("link")
        scan.open.append(tag)

    def end(tag: str) -> None:
        scan.open.pop()
        if tag == "joint":
            closing = data.index(b">", parser.CurrentByteIndex) + 1
            scan.joints[-1].end = closing
        if not scan.open:
            scan.root_end = parser.CurrentByteIndex

    parser.StartElementHandler, parser.EndElementHandler = start, end
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise OutputError(f"the file is no XML: {error}") from error
    return scan
