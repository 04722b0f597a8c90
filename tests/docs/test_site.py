"""The site as a reader gets it: built strictly, all of it, and nothing of it from elsewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import coec
from conftest import REPOSITORY

BUILD_S = 300.0
"""Most that a build may take; it takes 2 s of a core, and many times that where others have it."""

LOADED = {
    "script": "src",
    "img": "src",
    "iframe": "src",
    "source": "src",
    "video": "src",
    "audio": "src",
    "link": "href",
}
"""What a browser fetches by itself to show a page, by tag and attribute."""

NOT_LOADED = {"canonical", "next", "prev", "alternate"}
"""Values of `rel` of a `link` that only names another page."""


@dataclass
class Page(HTMLParser):
    """What a page links to, loads and has anchors for."""

    links: list[str] = field(default_factory=list)
    loaded: list[str] = field(default_factory=list)
    anchors: set[str] = field(default_factory=set)
    formulas: int = 0
    text: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        self.formulas += tag == "math"
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if tag in LOADED and LOADED[tag] in given and given.get("rel") not in NOT_LOADED:
            self.loaded.append(given[LOADED[tag]])
        self.loaded += re.findall(r"url\(([^)]+)\)", given.get("style", ""))

    def handle_data(self, data: str) -> None:
        self.text.append(data)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=REPOSITORY,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(REPOSITORY / "service")},
        capture_output=True,
        text=True,
        timeout=BUILD_S,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    assert "WARNING" not in built.stderr, built.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    read: dict[Path, Page] = {}
    for path in sorted(site.rglob("*.html")):
        read[path] = Page()
        read[path].feed(path.read_text(encoding="utf-8"))
    return read


def test_every_page_of_the_folder_is_built(site: Path) -> None:
    written = {path.stem for path in (REPOSITORY / "docs").glob("*.md")}
    assert {path.stem for path in site.glob("*.html")} - {"404"} == written


def test_a_page_loads_nothing_from_elsewhere(pages: dict[Path, Page], site: Path) -> None:
    for path, page in pages.items():
        for address in page.loaded:
            # The page of an error may stand at any depth: MkDocs gives it addresses from the root.
            there = (
                site / address.lstrip("/") if address.startswith("/") and path.stem == "404" else path.parent / address
            )
            assert not urlsplit(address).netloc, f"{path.name} loads {address}"
            assert address.startswith("data:") or Path(unquote(urlsplit(str(there)).path)).is_file(), (
                path.name,
                address,
            )


def test_a_style_sheet_loads_nothing_from_elsewhere(site: Path) -> None:
    for path in site.rglob("*.css"):
        addresses = re.findall(r"url\(\s*['\"]?([^'\")]+)|@import\s+['\"]([^'\"]+)", path.read_text(encoding="utf-8"))
        assert [one for pair in addresses for one in pair if urlsplit(one).netloc] == [], path.name


def test_every_link_within_the_site_leads_somewhere(pages: dict[Path, Page]) -> None:
    lost = []
    for path, page in pages.items():
        for link in page.links:
            address = urlsplit(link)
            if address.scheme or address.netloc or path.stem == "404":
                continue
            there = path if not address.path else (path.parent / unquote(address.path)).resolve()
            there = there / "index.html" if there.is_dir() else there
            anchor = unquote(address.fragment)
            if not there.is_file() or (anchor and there in pages and anchor not in pages[there].anchors):
                lost.append((path.name, link))
    assert lost == []


def test_formulas_are_written_out_when_the_site_is_built(pages: dict[Path, Page], site: Path) -> None:
    for name in ("method", "conventions", "uncertainty", "verdict", "change"):
        page = pages[site / f"{name}.html"]
        assert page.formulas > 0, name
        assert not re.search(r"\\\(|\\\[|\$\$", "".join(page.text)), name


def test_every_public_name_of_the_package_has_its_place(pages: dict[Path, Page], site: Path) -> None:
    anchors = pages[site / "python.html"].anchors
    assert {f"coec.{name}" for name in getattr(coec, "__all__", ("__version__",))} - anchors == set()


def test_the_readme_links_to_pages_that_there_are() -> None:
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    linked = re.findall(r"\]\(([^)#\s]+)[^)]*\)", text)
    assert [link for link in linked if not (REPOSITORY / link).is_file()] == []
    named = {Path(link).name for link in linked if link.endswith(".md")}
    assert named == {path.name for path in (REPOSITORY / "docs").glob("*.md")} - {"index.md"}
