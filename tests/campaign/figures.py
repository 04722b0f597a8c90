"""What the campaign reports: a figure required, a figure measured, as a table and as JSON."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class Figure:
    """One line of the table."""

    what: str
    required: str
    measured: str
    holds: bool


def at_most(what: str, limit: float, measured: float, unit: str) -> Figure:
    """A figure with an upper limit."""
    return Figure(what, f"≤ {limit:.3g} {unit}", f"{measured:.3g} {unit}", measured <= limit)


def exactly(what: str, expected: object, measured: object) -> Figure:
    """A figure that must be this one."""
    return Figure(what, str(expected), str(measured), expected == measured)


def is_long() -> bool:
    """Whether the long form was asked for: `CAMPAIGN=long`."""
    return os.environ.get("CAMPAIGN", "short") == "long"


def publish(name: str, folder: Path, figures: Sequence[Figure], details: dict[str, Any]) -> None:
    """Prints the table (`pytest -s` shows it), writes it with the details as JSON to `$CAMPAIGN_OUT`, else the folder
    of the test, and fails where a figure does not hold."""
    wide = max(len(figure.what) for figure in figures)
    needs = max(len(figure.required) for figure in figures)
    lines = [f"{name}"]
    for one in figures:
        lines.append(f"  {'ok ' if one.holds else 'NOT'}  {one.what:<{wide}}  {one.required:<{needs}}  {one.measured}")
    print("\n" + "\n".join(lines))
    out = Path(os.environ.get("CAMPAIGN_OUT", folder))
    out.mkdir(parents=True, exist_ok=True)
    document = {"name": name, "long": is_long(), "figures": [asdict(figure) for figure in figures], **details}
    (out / f"{name}.json").write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n")
    broken = [f"{one.what}: {one.required}, measured {one.measured}" for one in figures if not one.holds]
    assert not broken, "; ".join(broken)
