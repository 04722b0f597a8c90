"""A shell script for tf2's `static_transform_publisher`, with one command per transform."""

import re
import shlex

from coec.io.exported_extrinsic import ExportedExtrinsic, quaternion_xyzw, translation_m

ENCODING = "text/plain"
DIRECTION = "pose of the child (optical: z forward) in the parent; quaternion x y z w"

_MARK = "# coec: "


def text(extrinsic: ExportedExtrinsic, existing: str | None) -> str:
    """The script with this transform: its command replaces the one with the same child, or is added at the end."""
    x, y, z = translation_m(extrinsic.T_parent_child)
    qx, qy, qz, qw = quaternion_xyzw(extrinsic.T_parent_child)
    child = shlex.quote(extrinsic.child)
    fresh = [
        *(_MARK + comment for comment in extrinsic.remarks(DIRECTION)),
        f"ros2 run tf2_ros static_transform_publisher --x {x!r} --y {y!r} --z {z!r} "
        f"--qx {qx!r} --qy {qy!r} --qz {qz!r} --qw {qw!r} "
        f"--frame-id {shlex.quote(extrinsic.parent)} --child-frame-id {child} &",
    ]
    lines = ["#!/bin/sh", *fresh, "wait"] if existing is None else _replaced(existing.splitlines(), child, fresh)
    return "\n".join(lines) + "\n"


def _replaced(lines: list[str], child: str, fresh: list[str]) -> list[str]:
    command = re.compile(rf"--child-frame-id {re.escape(child)}(\s|$)")
    at = next((number for number, line in enumerate(lines) if command.search(line)), None)
    if at is None:
        end = len(lines) - 1 if lines and lines[-1].strip() == "wait" else len(lines)
        return [*lines[:end], *fresh, *lines[end:]]
    begin = at
    while begin and lines[begin - 1].startswith(_MARK):
        begin -= 1
    return [*lines[:begin], *fresh, *lines[at + 1 :]]
