"""Lines of the timeline: their schema is one that viewers read, and they keep to it."""

from __future__ import annotations

from typing import Any

from coec.io.viewer_scene import TimelineEntry, timeline_schema
from support.viewer import FULL

BARE = TimelineEntry(pair="front", state="not_served", level=3, why="Nobody serves the pair.")


def fits(value: Any, node: dict[str, Any]) -> bool:
    """As viewers read a schema: a type for every field that comes, nothing else (Lichtblick's parseJsonSchema)."""
    match node["type"]:
        case "object":
            known = node["properties"]
            return set(value) <= set(known) and all(fits(one, known[name]) for name, one in value.items())
        case "array":
            return all(fits(one, node["items"]) for one in value)
        case "string":
            return isinstance(value, str)
        case "boolean":
            return isinstance(value, bool)
        case "number" | "integer":
            return isinstance(value, int | float)
    return False


def test_what_is_reported_fits_the_schema_that_is_advertised() -> None:
    reported = FULL.document()
    assert fits(reported, timeline_schema())
    assert set(reported) == set(timeline_schema()["properties"]), "every field was tried"
    assert not fits({**reported, "state": None}, timeline_schema())


def test_what_is_not_known_is_left_out() -> None:
    reported = BARE.document()
    assert fits(reported, timeline_schema())
    assert reported["ages"] == {} == reported["correction"]
    assert "provenance" not in reported
