"""What the lock files pin: all that is declared, with hashes, everything in one place."""

from __future__ import annotations

import platform
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Sequence
from importlib.metadata import Distribution, distribution
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import NormalizedName, canonicalize_name

from conftest import REPOSITORY

LOCK, DOCS, CHECKS = LOCKS = tuple(
    REPOSITORY / name for name in ("requirements.lock", "requirements-docs.lock", "requirements-checks.lock")
)
RELEASE = REPOSITORY / "requirements-release.lock"
"""For an environment of its own, so that it pins some packages that others pin, too."""

EXTRAS = ("fleet", "foxglove", "lidars")
"""Those that commands of the pages need. Stores, Ray and training are installed by who has them."""


@pytest.fixture(scope="module")
def project() -> Any:
    return tomllib.loads((REPOSITORY / "pyproject.toml").read_text())


def pinned_hashes(lock: Path) -> dict[tuple[str, str], list[str]]:
    """sha256 of the archives, by canonical name and version."""
    pins = re.findall(r"^([A-Za-z0-9._-]+)==(\S+)(.*(?:\n .*)*)", lock.read_text(), re.MULTILINE)
    return {
        (canonicalize_name(name), version): re.findall(r"--hash=sha256:([0-9a-f]{64})\b", rest)
        for name, version, rest in pins
    }


def pinned(lock: Path) -> dict[str, str]:
    """Versions by name."""
    return dict(pinned_hashes(lock).keys())


def missing(lines: list[str], *locks: Path) -> list[str]:
    """Requirements that none of the locks meets."""
    versions = {name: version for lock in locks for name, version in pinned(lock).items()}
    requirements = [Requirement(line) for line in lines]
    return [
        str(each)
        for each in requirements
        if (name := canonicalize_name(each.name)) not in versions or versions[name] not in each.specifier
    ]


def twice(*locks: str) -> set[str]:
    """What is pinned in each, for the same machines."""
    lines = (set(re.findall(r"^[^#\s].*(?= \\$)", lock, re.MULTILINE)) for lock in locks)
    return set.intersection(*lines)


def test_what_coec_and_its_demonstration_need_is_pinned(project: Any) -> None:
    assert missing(project["project"]["dependencies"], LOCK) == []
    assert missing(project["dependency-groups"]["demo"], LOCK) == []
    assert missing(project["build-system"]["requires"], LOCK) == []


@pytest.mark.parametrize("extra", EXTRAS)
def test_what_a_command_of_the_pages_needs_is_pinned(project: Any, extra: str) -> None:
    assert missing(project["project"]["optional-dependencies"][extra], LOCK) == []


def test_what_the_site_and_the_checks_need_is_pinned_next_to_it_and_nothing_twice(project: Any) -> None:
    assert missing(project["dependency-groups"]["docs"], LOCK, DOCS) == []
    assert missing(project["dependency-groups"]["checks"], *LOCKS) == []
    assert all(twice(*(lock.read_text() for lock in two)) == set() for two in combinations(LOCKS, 2))
    for unwanted in ("pytest", "mypy", "playwright", "mkdocs", "ray", "torch"):
        assert missing([unwanted], LOCK), "who only uses it fetches none of these"
    assert missing(["pytest"], LOCK, DOCS), "who only reads fetches no checks"


def test_what_lists_the_packages_of_an_image_is_pinned(project: Any) -> None:
    assert missing(project["dependency-groups"]["release"], RELEASE) == []


def needed(requirements: Iterable[str], extras: Sequence[str] = ("",)) -> dict[NormalizedName, Distribution]:
    """The installed distributions that these requirements come to on this machine, by name. `extras` are those of the
    package that states them."""
    result: dict[NormalizedName, Distribution] = {}
    waiting = [(Requirement(line), tuple(extras)) for line in requirements]
    visited = set[tuple[NormalizedName, tuple[str, ...]]]()
    while waiting:
        requirement, stated_by = waiting.pop()
        if requirement.marker is not None and not any(requirement.marker.evaluate({"extra": e}) for e in stated_by):
            continue
        name, requested = canonicalize_name(requirement.name), ("", *sorted(requirement.extras))
        if (name, requested) not in visited:
            visited.add((name, requested))
            result[name] = distribution(name)
            waiting += [(Requirement(line), requested) for line in result[name].requires or ()]
    return result


def test_the_table_of_licences_is_that_of_the_lock_file(project: Any) -> None:
    """docs/licences.md is written by `deploy/bill-of-materials` from an environment with what coec needs alone."""
    if (sys.version_info[:2], platform.machine(), sys.platform) != ((3, 11), "x86_64", "linux"):
        pytest.skip("the table is of the image: CPython 3.11 on x86-64 Linux")
    rows = re.findall(
        r"^\| (\S+) +\| (\S+) +\| (.+?) +\|$", (REPOSITORY / "docs" / "licences.md").read_text(), re.MULTILINE
    )
    shown = {canonicalize_name(name): version for name, version, _ in rows if version[0].isdigit()}
    assert shown.keys() == needed(project["project"]["dependencies"]).keys()
    assert shown.items() <= pinned_hashes(LOCK).keys()
    assert all(licence not in ("", "UNKNOWN") for _, _, licence in rows)


@pytest.mark.parametrize("lock", [*LOCKS, RELEASE], ids=lambda lock: lock.stem)
def test_every_pin_has_hashes_and_no_address(lock: Path) -> None:
    assert all(pinned_hashes(lock).values())
    assert re.findall(r"https?:|file:|--(?:extra-)?index", lock.read_text()) == []


def test_an_argument_that_is_not_known_is_refused_before_anything_is_made() -> None:
    done = subprocess.run([REPOSITORY / "deploy" / "setup", "--cheks"], capture_output=True, text=True)
    assert done.returncode == 1
    assert "--cheks" in done.stderr


@pytest.mark.parametrize(
    ("argument", "stamps"),
    [
        pytest.param("--docs", {"requirements", "docs"}, marks=pytest.mark.slow),
        ("--checks", {"requirements", "docs", "checks"}),
    ],
)
def test_what_was_installed_is_noted_for_each_lock(tmp_path: Path, argument: str, stamps: set[str]) -> None:
    """With locks that pin nothing, and a project that cannot be installed, so that nothing is fetched."""
    (tmp_path / "deploy").mkdir()
    shutil.copy2(REPOSITORY / "deploy" / "setup", tmp_path / "deploy")
    for lock in LOCKS:
        (tmp_path / lock.name).write_text("# nothing\n")
    (tmp_path / "service" / "coec_lab").mkdir(parents=True)
    for file in ("pyproject.toml", "service/coec_lab/pyproject.toml", "service/coec_lab/hatch_build.py"):
        (tmp_path / file).write_text("no project")
    done = subprocess.run([tmp_path / "deploy" / "setup", argument], capture_output=True, text=True)
    assert "could not install coec" in done.stderr
    assert {path.name for path in (tmp_path / ".venv").glob("coec-*")} == {f"coec-{name}" for name in stamps}
