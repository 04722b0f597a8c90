"""Depth is inferred without telling anybody."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

INFER = """
import numpy as np
from coec.io.depth.depth_maps import open_depth
from coec.config import DepthConfig, LimitsConfig
open_depth(DepthConfig(), LimitsConfig())
"""


@pytest.mark.fault("an inference library that reports to its vendor", "opening a network leaves nothing to be sent")
def test_opening_a_network_leaves_no_report_to_be_sent(tmp_path: Path) -> None:
    quiet = {name: value for name, value in os.environ.items() if not name.startswith(("ORT_", "XDG_"))}
    subprocess.run([sys.executable, "-c", INFER], env={**quiet, "HOME": str(tmp_path)}, check=True, timeout=120)
    # The vendor's library keeps what it is about to send in a database below the caches of the user.
    retained = [path for path in tmp_path.rglob("*") if path.is_file() and "coec" not in path.parts]
    assert retained == []
