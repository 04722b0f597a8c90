"""Changes one entry of a YAML file and leaves every other byte as it is.

A YAML library would rewrite the whole document, including the comments, quotes and number formats that people chose.
Here the library only finds the place of an entry, and the lines of that entry are replaced.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.error import YAMLError

from coec.errors import OutputError

INDENT = "  "


def set_yaml_entry(text: str, path: Sequence[str], lines: Sequence[str]) -> str:
    """The text with one entry set: replaced if it exists, else added at the end of the map that should hold it.

    Args:
        text: a YAML document whose root is a map in block style.
        path: keys from the root to the entry.
        lines: lines of the value below the key, without indentation.

    Raises:
        OutputError: not such a document, or the entry cannot be changed without touching others.
    """
    before = _parsed_yaml(text)
    parent, depth = _deepest(before, path)
    rows = text.splitlines()
    if depth == len(path):
        line, column = parent.lc.key(path[-1])
        if rows[line][:column].strip():
            raise OutputError(f"`{path[-1]}` stands among others on line {line + 1}: it cannot be changed alone")
        end = _end_of(rows, line, column)
        fresh = [" " * column + f"{path[-1]}:", *(" " * column + INDENT + row for row in lines)]
        rows[line:end] = fresh
    else:
        column, end = _room_in(parent, rows, path[:depth])
        fresh = []
        for level, key in enumerate(path[depth:]):
            fresh.append(" " * column + INDENT * level + f"{key}:")
        fresh += [" " * column + INDENT * len(path[depth:]) + row for row in lines]
        rows[end:end] = fresh
    after = "\n".join(rows) + "\n"
    if _without(_parsed_yaml(after), path) != _without(before, path):
        raise OutputError(f"`{path[-1]}` cannot be set without changing something else of the file")
    return after


def _parsed_yaml(text: str) -> CommentedMap:
    try:
        document = YAML().load(text)
    except (YAMLError, ValueError, RecursionError) as error:
        raise OutputError(f"the file is no YAML that can be changed: {str(error).splitlines()[0]}") from error
    if not isinstance(document, CommentedMap):
        raise OutputError("the file holds no map of names")
    return document


def _deepest(document: CommentedMap, path: Sequence[str]) -> tuple[CommentedMap, int]:
    """The map that holds the longest existing part of the path, and how many keys that part has."""
    deepest = document
    for depth, key in enumerate(path):
        if key not in deepest:
            return deepest, depth
        if depth + 1 == len(path):
            break
        inner = deepest[key]
        if not isinstance(inner, CommentedMap):
            raise OutputError(f"`{key}` is no map of names")
        deepest = inner
    return deepest, len(path)


def _end_of(rows: Sequence[str], line: int, column: int) -> int:
    """The line behind the entry that begins at a line and column."""
    end = line + 1
    for number in range(line + 1, len(rows)):
        row = rows[number]
        inside = len(row) - len(row.lstrip())
        if row.strip() and inside <= column and not (inside == column and row.lstrip().startswith("- ")):
            break
        if row.strip():
            end = number + 1
    return end


def _room_in(parent: CommentedMap, rows: Sequence[str], path: Sequence[str]) -> tuple[int, int]:
    """Column of the keys of a map in block style, and the line behind its last entry."""
    if not len(parent):
        raise OutputError(f"`{'.'.join(path)}` is an empty map: write into another file")
    last = list(parent)[-1]
    line, column = parent.lc.key(last)
    if rows[line][:column].strip():
        raise OutputError(f"the entries beside `{last}` stand on one line: another cannot be put among them")
    return column, _end_of(rows, line, column)


def _without(document: Any, path: Sequence[str]) -> Any:
    """Plain values of a document without the entry, and without maps that hold only the entry."""
    if not isinstance(document, CommentedMap) or not path:
        return document
    rest = {key: value for key, value in document.items() if key != path[0]}
    if len(path) > 1 and path[0] in document:
        inner = _without(document[path[0]], path[1:])
        if inner:
            rest[path[0]] = inner
    return rest
