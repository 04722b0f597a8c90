"""`docs/recordings.md` names everything that the readers of recordings read, recognise and let a person say."""

import re
from pathlib import Path

from coec.io.recordings.bag import KEYS
from coec.io.recordings.bag_recognition import READING_KEYS
from coec.io.ros.translations import _FOXGLOVE

REPOSITORY = Path(__file__).parents[2]
PAGE = (REPOSITORY / "docs" / "recordings.md").read_text(encoding="utf-8")


def test_every_schema_of_foxglove_is_on_the_page() -> None:
    names = {schema.removeprefix("foxglove.").removesuffix("s") for schema in _FOXGLOVE}
    assert {name for name in names if f"`{name}" not in PAGE} == set()


def test_every_key_of_a_bag_is_on_the_page() -> None:
    undocumented = {key for key in (*KEYS, *READING_KEYS) if f"`{key}=" not in PAGE}
    assert undocumented == {"moving"}, "`moving` stands with the motion of other pages"


def test_every_recognition_is_on_the_page() -> None:
    codes: set[str] = set()
    for path in (REPOSITORY / "service" / "coec").rglob("*.py"):
        codes.update(re.findall(r"\bRecognition\(\s*\"(\w+)\"", path.read_text(encoding="utf-8")))
    assert len(codes) > 10
    assert {code for code in codes if f"`{code}`" not in PAGE} == set()
