"""What the pages show of files is read by what reads such files."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from coec.calibration.figures import FIGURES
from coec.calibration.types import INTRINSICS_OFF, MOVED
from coec.config import config_of
from coec.config.root import parse_yaml
from coec.io.depth.model_cards import ModelCard
from coec.io.recordings.manifest import ManifestDocument
from conftest import REPOSITORY

READERS: dict[str, Callable[[Any], object]] = {
    "own-data": ManifestDocument.model_validate,
    "own-network": ModelCard.model_validate,
    "rig": config_of,
    "ros2": config_of,
}
"""By page: of what kind its examples are."""


def examples() -> list[tuple[str, int, str]]:
    result = []
    for path in sorted((REPOSITORY / "docs").glob("*.md")):
        for index, part in enumerate(path.read_text(encoding="utf-8").split("```yaml\n")[1:]):
            result.append((path.stem, index, part.partition("```")[0]))
    return result


@pytest.mark.parametrize(("page", "index", "text"), examples())
def test_an_example_is_what_its_page_says(page: str, index: int, text: str) -> None:
    assert READERS[page](parse_yaml(text)), index


def test_dataset_yaml_is_explained_key_by_key() -> None:
    text = (REPOSITORY / "docs" / "own-data.md").read_text(encoding="utf-8")
    frame = ManifestDocument.model_fields["frames"].annotation.__args__[0].model_fields  # type: ignore[union-attr]
    named = [
        *(name for name in ManifestDocument.model_fields if name != "frames"),
        *(f"frames[].{one}" for one in frame),
    ]
    assert [name for name in named if text.count(f"| `{name}` |") != 1] == []
    whole = parse_yaml(text.split("```yaml\n")[2].partition("```")[0])
    assert set(whole) == set(ManifestDocument.model_fields)
    assert set(whole["frames"][0]) == set(frame)


def test_every_figure_of_a_verdict_is_explained() -> None:
    text = "".join((REPOSITORY / "docs" / name).read_text(encoding="utf-8") for name in ("verdict.md", "figures.md"))
    assert {MOVED, INTRINSICS_OFF} <= set(FIGURES)
    assert [figure for figure in FIGURES if f"`{figure}`" not in text] == []
