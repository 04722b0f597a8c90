"""`coec sbom`: what is installed, under which licences; the committed table is that of the lock file."""

from __future__ import annotations

import json
import platform
import re
import sys
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

from cli.conftest import Coec
from coec.cli.sbom import inventory_here
from coec.io.installed_packages import pinned_hashes
from coec.reports.bill_of_materials import NOT_STATED, Inventory, cyclonedx, licence_table
from conftest import REPOSITORY

LOCK = REPOSITORY / "requirements.lock"
NOON = datetime(2026, 11, 22, 12, tzinfo=UTC)
TYPES = {
    "application", "framework", "library", "container", "platform", "operating-system", "device", "device-driver",
    "firmware", "file", "machine-learning-model", "data", "cryptographic-asset",
}  # fmt: skip
"""Of components in CycloneDX 1.6."""


@pytest.fixture(scope="module")
def inventory() -> Inventory:
    return inventory_here()


@pytest.fixture(scope="module")
def document(inventory: Inventory) -> Any:
    return cyclonedx(inventory, pinned_hashes(LOCK), NOON)


def components(document: Any) -> list[Any]:
    """With what is packed into them."""
    return [one for outer in document["components"] for one in (outer, *outer.get("components", ()))]


def test_it_has_what_cyclonedx_demands(document: Any) -> None:
    """The required fields, enumerations and patterns of bom-1.6.schema.json, and that references lead somewhere."""
    assert (document["bomFormat"], document["specVersion"], document["version"]) == ("CycloneDX", "1.6", 1)
    assert re.fullmatch(r"urn:uuid:[0-9a-f]{8}-([0-9a-f]{4}-){3}[0-9a-f]{12}", document["serialNumber"])
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00", document["metadata"]["timestamp"])
    described = [document["metadata"]["component"], *components(document)]
    for component in described:
        assert component["type"] in TYPES
        assert component["name"]
        hashes = [*component.get("hashes", ())]
        for reference in component.get("externalReferences", ()):
            assert reference["type"] == "distribution"
            assert reference["url"]
            hashes += reference["hashes"]
        for one in hashes:
            assert one["alg"] == "SHA-256"
            assert re.fullmatch(r"[0-9a-f]{64}", one["content"])
        for licence in component.get("licenses", ()):
            assert set(licence) in ({"expression"}, {"license"})
    references = [component["bom-ref"] for component in described]
    assert len(set(references)) == len(references)
    for dependency in document["dependencies"]:
        assert {dependency["ref"], *dependency["dependsOn"]} <= set(references)


def test_every_package_is_there_with_the_hashes_it_was_pinned_by(document: Any) -> None:
    packages = {one["name"]: one for one in document["components"] if one["type"] == "library"}
    for name in ("numpy", "onnxruntime", "eclipse-zenoh", "typing_extensions"):
        assert packages[name]["version"] == version(name)
        (archives,) = packages[name]["externalReferences"]
        key = (name.replace("_", "-"), version(name))
        assert [one["content"] for one in archives["hashes"]] == list(pinned_hashes(LOCK)[key])
    assert "pytest" not in packages, "what only the checks need"


def test_nothing_is_without_a_licence(document: Any) -> None:
    stated = [one.get("licenses") for one in document["components"]]
    assert all(stated)
    assert not [one for one in stated if one == [{"license": {"name": NOT_STATED}}]]


def test_libraries_of_others_and_the_network_are_named(document: Any) -> None:
    (opencv,) = [one for one in document["components"] if one["name"] == "opencv-python-headless"]
    assert any(one["name"].startswith("libavcodec") for one in opencv["components"])
    (network,) = [one for one in document["components"] if one["type"] == "machine-learning-model"]
    assert (network["name"], network["licenses"]) == ("street", [{"expression": "Apache-2.0"}])


def test_the_same_installation_gives_the_same_bytes(coec: Coec, document: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SOURCE_DATE_EPOCH", raising=False)
    again = coec("sbom", "--lock", LOCK, "--json")
    assert again.out == coec("sbom", "--lock", LOCK, "--json").out
    assert "timestamp" not in again.document["metadata"]
    monkeypatch.setenv("SOURCE_DATE_EPOCH", str(int(NOON.timestamp())))
    assert coec("sbom", "--lock", LOCK, "--json").document == document


@pytest.mark.parametrize("epoch", ["yesterday", "1e9", "9" * 30])
def test_a_build_time_that_is_none_is_refused(coec: Coec, monkeypatch: pytest.MonkeyPatch, epoch: str) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", epoch)
    outcome = coec("sbom", "--json")
    assert outcome.status == 2
    assert f"SOURCE_DATE_EPOCH={epoch}" in outcome.err


def test_files_are_written_and_the_table_is_shown(coec: Coec, inventory: Inventory, tmp_path: Path) -> None:
    outcome = coec("sbom", "--output", tmp_path)
    assert outcome.status == 0
    assert re.search(r"^numba +\S+ +BSD-2-Clause", outcome.out, re.MULTILINE)
    assert json.loads((tmp_path / "coec.cdx.json").read_text())["bomFormat"] == "CycloneDX"
    assert (tmp_path / "licences.md").read_text() == licence_table(inventory)


def test_a_file_that_pins_nothing_is_refused(coec: Coec, tmp_path: Path) -> None:
    assert coec("sbom", "--lock", tmp_path / "absent.lock").status == 2
    (tmp_path / "empty.lock").write_text("# nothing\n")
    outcome = coec("sbom", "--lock", tmp_path / "empty.lock")
    assert outcome.status == 2
    assert "pins no package" in outcome.err


def test_the_committed_table_is_that_of_the_lock_file(inventory: Inventory) -> None:
    if (sys.version_info[:2], platform.machine(), sys.platform) != ((3, 11), "x86_64", "linux"):
        pytest.skip("the table is of the image: CPython 3.11 on x86-64 Linux")
    installed = {(name, package.version) for name, package in inventory.packages.items()}
    assert installed <= set(pinned_hashes(LOCK)), "this environment is not that of requirements.lock: run deploy/setup"
    shown = (REPOSITORY / "docs" / "licences.md").read_text()
    assert shown == licence_table(inventory), "run `coec sbom --output docs`"
