"""What users install: wheel and source archive, built in a fresh copy of the checkout by the commands of
docs/deployment.md, and used from environments that hold nothing else."""

from __future__ import annotations

import json
import re
import sys
import zipfile
from pathlib import Path

import pytest

from conftest import REPOSITORY
from real.packages import completed, copied_checkout, require_index

pytestmark = pytest.mark.slow

DRIVE = "sim:seed=3&seconds=60&camera_hz=0.4&lidar_hz=0.4"
START_OFF_DEG = (3.0, -3.0, 2.0)
MOST_OFF_DEG = 0.3
"""Five standard deviations of the worst axis of this drive's result."""

NOT_ABOUT_INSTALLING = ("systemctl", "coec doctor", "--install-completion")
"""Parts of lines of the page that need a systemd, a router, or a person's shell."""


def typed_lines() -> list[str]:
    """The lines by which the page installs a wheel under /opt/coec."""
    page = (REPOSITORY / "docs" / "deployment.md").read_text(encoding="utf-8")
    (block,) = (
        text for text in re.findall(r"^```text\n(.*?)^```", page, re.MULTILINE | re.DOTALL) if "hatchling build" in text
    )
    return [line for line in block.splitlines() if line and not any(part in line for part in NOT_ABOUT_INSTALLING)]


@pytest.fixture(scope="module")
def vehicle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The root of a vehicle's computer on which the page was typed; `checkout` in it is the folder where it was."""
    root = tmp_path_factory.mktemp("vehicle")
    require_index(root / "probe")
    checkout = copied_checkout(root / "checkout")
    for line in typed_lines():
        here = re.sub(r"(?<![\w.])/(opt|etc)/", rf"{root}/\1/", line).replace("python3.11", sys.executable)
        completed("bash", "-euc", here, cwd=checkout)
    return root


@pytest.fixture(scope="module")
def from_sdist(vehicle: Path) -> Path:
    """`coec` from the source archive, in another environment."""
    checkout, place = vehicle / "checkout", vehicle / "sdist"
    completed("tools/bin/hatchling", "build", "--target", "sdist", "--directory", place, cwd=checkout)
    completed(sys.executable, "-m", "venv", vehicle / "other")
    (archive,) = place.iterdir()
    pip = (vehicle / "other" / "bin" / "pip", "install", "--no-index", "--find-links", checkout / "packages")
    completed(*pip, archive, cwd=vehicle)
    return vehicle / "other" / "bin" / "coec"


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a simulated drive, by the programs of the checkout; its calibration is the truth."""
    path = tmp_path_factory.mktemp("drive") / "drive.mcap"
    service = str(REPOSITORY / "service")
    completed(sys.executable, "-m", "coec", "convert", DRIVE, path, PYTHONPATH=service)
    return path


def calibrated(coec: Path, drive: Path) -> dict[str, object]:
    """The result from a start that is some degrees off."""
    start = ",".join(str(value) for value in START_OFF_DEG)
    done = completed(coec, "calibrate", drive, "--perturb", start, "--json", cwd=drive.parent)
    result: dict[str, object] = json.loads(done.stdout)
    return result


def test_the_page_ends_in_an_installation_whose_configuration_is_valid(vehicle: Path) -> None:
    coec = vehicle / "opt" / "coec" / "bin" / "coec"
    assert "calibrate" in completed(coec, "--help", cwd=vehicle).stdout
    completed(coec, "check-config", vehicle / "etc" / "coec" / "coec.yaml", cwd=vehicle)


def test_a_wheel_calibrates_a_drive_with_the_network_that_is_in_it(vehicle: Path, drive: Path) -> None:
    result = calibrated(vehicle / "opt" / "coec" / "bin" / "coec", drive)
    assert result["verdict"] == {"decision": "accepted", "reasons": []}
    correction = result["correction"]
    assert isinstance(correction, list)
    assert max(abs(degrees) for degrees in correction[:3]) < MOST_OFF_DEG, "the correction is from the truth"


def test_a_source_archive_gives_the_same_result(vehicle: Path, from_sdist: Path, drive: Path) -> None:
    wheel = vehicle / "opt" / "coec" / "bin" / "coec"
    ours, theirs = calibrated(wheel, drive), calibrated(from_sdist, drive)
    assert {**ours, "elapsed_s": None} == {**theirs, "elapsed_s": None}


def test_an_installation_from_the_folder_holds_what_the_wheel_holds(vehicle: Path) -> None:
    """What `pip install .` installs is the wheel that pip builds there."""
    checkout, place = vehicle / "checkout", vehicle / "by-pip"
    find = ("--no-index", "--find-links", "packages")
    completed("tools/bin/pip", "wheel", *find, "--no-deps", "--wheel-dir", place, ".", cwd=checkout)
    (built,), (typed,) = place.glob("coec-*.whl"), (checkout / "dist").glob("coec-*.whl")
    with zipfile.ZipFile(built) as one, zipfile.ZipFile(typed) as other:
        assert sorted(one.namelist()) == sorted(other.namelist())
