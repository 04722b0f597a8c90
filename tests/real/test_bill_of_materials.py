"""`deploy/bill-of-materials` as a release runs it: what is installed, under which licences."""

from __future__ import annotations

import base64
import json
import os
import sys
from pathlib import Path

import pytest
from packaging.utils import canonicalize_name

from conftest import REPOSITORY
from deploy.test_locks import needed
from real.packages import completed, require_index


@pytest.mark.slow
def test_everything_that_coec_needs_is_listed_with_its_licence(tmp_path: Path) -> None:
    require_index(tmp_path / "fetched")
    completed(sys.executable, "-m", "venv", tmp_path / "tools")
    lock = REPOSITORY / "requirements-release.lock"
    completed(tmp_path / "tools/bin/pip", "install", "--quiet", "--require-hashes", "--requirement", lock)
    path = f"{tmp_path}/tools/bin:{os.environ['PATH']}"
    for folder in ("one", "two"):
        completed(REPOSITORY / "deploy" / "bill-of-materials", sys.executable, tmp_path / folder, PATH=path)
    text = (tmp_path / "one/coec.cdx.json").read_bytes()
    assert text == (tmp_path / "two/coec.cdx.json").read_bytes(), "the same installation gives the same bytes"
    components = {canonicalize_name(each["name"]): each for each in json.loads(text)["components"]}
    assert needed(["coec"]).keys() <= components.keys()
    assert [name for name in needed(["coec"]) if not components[name].get("licenses")] == []
    texts = [
        each["license"].get("text", {}) for each in components[canonicalize_name("opencv-python-headless")]["licenses"]
    ]
    packed_in = b"".join(base64.b64decode(one["content"]) for one in texts if one)
    assert b"FFmpeg" in packed_in, "the libraries of others that it has packed in"
    assert "| numba " in (tmp_path / "one/licences.md").read_text()
