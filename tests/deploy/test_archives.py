"""The wheel and the source archive hold what the package reads when it runs, and what its tests read."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from coec.io.depth.model_cards import CARDS, built_in_cards
from conftest import REPOSITORY

PACKAGE = "service/coec/"
WITH_NEW = ("--cached", "--others", "--exclude-standard")
"""Files that are not yet under version control are shipped, too; those that .gitignore names are not."""
NOT_SHIPPED = (".ci/",)
"""Under version control, but only of use in a checkout."""


def listed(*options: str) -> set[str]:
    """Paths of existing files of the checkout, by `git ls-files`; an unpacked source archive has no such list."""
    if not (REPOSITORY / ".git").exists() or shutil.which("git") is None:
        pytest.skip("needs git, and a checkout: what is compared is the list of files under version control")
    command = ["git", "ls-files", "-z", *options]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    return {name for name in done.stdout.split("\0") if (REPOSITORY / name).is_file()}


def built(target: str, folder: Path) -> Path:
    """The archive, built offline by the hatchling of this environment."""
    command = [sys.executable, "-m", "hatchling", "build", "--target", target, "--directory", str(folder)]
    subprocess.run(command, cwd=REPOSITORY, check=True, capture_output=True, env={**os.environ, "PYTHONPATH": ""})
    (archive,) = folder.iterdir()
    return archive


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built("wheel", tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built("sdist", tmp_path_factory.mktemp("sdist"))


def test_the_wheel_holds_every_file_of_the_package(wheel: Path) -> None:
    files = {name.removeprefix("service/") for name in listed(*WITH_NEW) if name.startswith(PACKAGE)}
    with zipfile.ZipFile(wheel) as archive:
        assert {name for name in archive.namelist() if ".dist-info/" not in name} == files


def test_the_wheel_holds_the_networks_whose_cards_are_built_in(wheel: Path) -> None:
    """What is absent here cannot be missed there: the folder that the program reads is the one that is shipped."""
    shipped = [CARDS / f"{name}.onnx" for name in built_in_cards() if (CARDS / f"{name}.onnx").is_file()]
    assert [path.stem for path in shipped] == ["street"]
    with zipfile.ZipFile(wheel) as archive:
        for path in shipped:
            assert archive.read(f"coec/io/depth/cards/{path.name}") == path.read_bytes()


def test_the_source_archive_holds_every_file_under_version_control(sdist: Path) -> None:
    with tarfile.open(sdist) as archive:
        held = {member.name.partition("/")[2] for member in archive.getmembers() if member.isfile()}
    assert {name for name in listed() - held if not name.startswith(NOT_SHIPPED)} == set()
    assert held - listed(*WITH_NEW) == {"PKG-INFO"}, "nothing else of the folder gets into it"


@pytest.mark.parametrize("target", ["wheel", pytest.param("sdist", marks=pytest.mark.slow)])
def test_the_same_sources_give_the_same_bytes(target: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    archive: Path = request.getfixturevalue(target)
    assert built(target, tmp_path / target).read_bytes() == archive.read_bytes()
