"""What packages say of themselves, and what a lock file pins."""

from __future__ import annotations

import base64
from pathlib import Path

import pytest

from coec.errors import NotFoundError
from coec.io.installed_packages import NativeLibrary, bsd_licence, installed_packages, pinned_hashes

BSD = "Redistribution and use in source\nand binary forms, with or without modification, are permitted"
NAMES = "Neither the name of the copyright holder nor"


def package(folder: Path, name: str, *headers: str, files: str = "", texts: dict[str, str] | None = None) -> None:
    """An installed package, as far as its metadata go. The files of its record are there, but empty: importlib of
    Python 3.12 and later leaves out those that are not."""
    metadata = folder / f"{name}-1.0.dist-info"
    metadata.mkdir()
    lines = ("Metadata-Version: 2.4", f"Name: {name}", "Version: 1.0", *headers)
    (metadata / "METADATA").write_text("\n".join(lines) + "\n")
    (metadata / "RECORD").write_text(files)
    for line in files.splitlines():
        (folder / line.partition(",")[0]).parent.mkdir(parents=True, exist_ok=True)
        (folder / line.partition(",")[0]).touch()
    for file, text in (texts or {}).items():
        (metadata / "licenses").mkdir(exist_ok=True)
        (metadata / "licenses" / file).write_text(text)


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def test_what_is_needed_is_found_by_its_conditions(site: Path) -> None:
    package(site, "top", "Requires-Dist: mid[more]", 'Requires-Dist: old; python_version < "3"')
    package(site, "mid", 'Requires-Dist: leaf_one; extra == "more"', 'Requires-Dist: other; extra == "rest"')
    package(site, "leaf.One", "Requires-Dist: top")
    found = installed_packages("top")
    assert list(found) == ["leaf-one", "mid", "top"]
    assert found["mid"].requires == ("leaf-one",)
    assert found["leaf-one"].requires == ("top",), "a circle ends"


def test_what_is_needed_and_absent_is_named(site: Path) -> None:
    package(site, "top", "Requires-Dist: nowhere-to-be-found")
    with pytest.raises(NotFoundError, match="nowhere-to-be-found"):
        installed_packages("top")


@pytest.mark.parametrize(
    ("headers", "licence"),
    [
        (("License-Expression: MIT OR Apache-2.0", "License: BSD"), "MIT OR Apache-2.0"),
        (("License: Apache 2.0",), "Apache-2.0"),
        (
            (
                "Classifier: License :: OSI Approved :: Eclipse Public License 2.0 (EPL-2.0)",
                "Classifier: License :: OSI Approved :: Apache Software License",
            ),
            "Apache-2.0 OR EPL-2.0",
        ),
        (("License: BSD", "Classifier: License :: OSI Approved :: BSD License", "License-File: TEXT"), "BSD-3-Clause"),
        (("License: ask us",), None),
        ((), None),
    ],
    ids=["expression", "name", "classifiers", "text", "something", "nothing"],
)
def test_the_most_precise_word_on_the_licence_counts(site: Path, headers: tuple[str, ...], licence: str | None) -> None:
    package(site, "top", *headers, texts={"TEXT": f"{BSD} {NAMES}"})
    assert installed_packages("top")["top"].licence == licence


@pytest.mark.parametrize(
    ("text", "known"), [(f"{BSD} {NAMES}", "BSD-3-Clause"), (BSD, "BSD-2-Clause"), ("Permission is granted", None)]
)
def test_licences_of_the_bsd_family_differ_by_a_clause(text: str, known: str | None) -> None:
    assert bsd_licence(text) == known


def test_libraries_packed_in_are_named_with_their_digests(site: Path) -> None:
    digest = bytes(range(32))
    told = base64.urlsafe_b64encode(digest).decode().rstrip("=")
    files = f"top.libs/libav-0011aabb.so.62.28,sha256={told},9\ntop/_own.so,sha256={told},9\n"
    package(site, "top", files=files)
    (library,) = installed_packages("top")["top"].native
    assert library == NativeLibrary("libav-0011aabb.so.62.28", digest.hex())
    assert library.name == "libav"


def test_hashes_belong_to_the_version_that_is_pinned(tmp_path: Path) -> None:
    one, two, other = ("1" * 64, "2" * 64, "3" * 64)
    lock = tmp_path / "requirements.lock"
    lock.write_text(
        f"# made\nTwo_Words==1.0 \\\n    --hash=sha256:{two} \\\n    --hash=sha256:{one}\n    # via top\n"
        f'last==2 ; python_version < "4" \\\n    --hash=sha256:{other}\n'
    )
    assert pinned_hashes(lock) == {("two-words", "1.0"): (one, two), ("last", "2"): (other,)}
