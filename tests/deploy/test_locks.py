"""What the lock files pin: all that is declared, with hashes, everything in one place."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from coec.io.installed_packages import pinned_hashes
from conftest import REPOSITORY

LOCK, DOCS, CHECKS = LOCKS = tuple(
    REPOSITORY / name for name in ("requirements.lock", "requirements-docs.lock", "requirements-checks.lock")
)
EXTRAS = ("fleet", "foxglove", "lidars")
"""Those that commands of the pages need. Stores, Ray and training are installed by who has them."""


@pytest.fixture(scope="module")
def project() -> Any:
    return tomllib.loads((REPOSITORY / "pyproject.toml").read_text())


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


def test_what_the_site_and_the_checks_need_is_pinned_beside_it_and_nothing_twice(project: Any) -> None:
    assert missing(project["dependency-groups"]["docs"], LOCK, DOCS) == []
    assert missing(project["dependency-groups"]["checks"], *LOCKS) == []
    assert all(twice(*(lock.read_text() for lock in two)) == set() for two in combinations(LOCKS, 2))
    for unwanted in ("pytest", "mypy", "playwright", "mkdocs", "ray", "torch"):
        assert missing([unwanted], LOCK), "who only uses it fetches none of these"
    assert missing(["pytest"], LOCK, DOCS), "who only reads fetches no checks"


@pytest.mark.parametrize("lock", LOCKS, ids=lambda lock: lock.stem)
def test_every_pin_has_hashes_and_no_address(lock: Path) -> None:
    assert all(pinned_hashes(lock).values())
    assert re.findall(r"https?:|file:|--(?:extra-)?index", lock.read_text()) == []


def test_an_argument_that_is_not_known_is_refused_before_anything_is_made() -> None:
    done = subprocess.run([REPOSITORY / "deploy" / "setup", "--cheks"], capture_output=True, text=True)
    assert done.returncode == 1
    assert "--cheks" in done.stderr


@pytest.mark.parametrize(
    ("argument", "stamps"),
    [("--docs", {"requirements", "docs"}), ("--checks", {"requirements", "docs", "checks"})],
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
