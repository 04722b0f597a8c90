"""Small windows, and what `coec.calibrate` decides of each."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import coec
from coec.schemas.replies import CalibrationResult
from golden.reference import DATA, plain, rounded, sha256
from golden.scene import LENSES, Drive, write

FILE = DATA / "windows.json"
NEAR, NEAR_6 = (-2.0, 1.5, 1.0), (-1.5, 1.0, 0.8, 0.02, -0.03, 0.05)
FAR = (0.0, 40.0, 0.0)

VALUES = (
    "status",
    "stop_reason",
    "pairs",
    "points_in_view",
    "solved",
    "unobservable",
    "correction",
    "sigma",
    "score",
    "score_at_start",
    "overlap",
    "moved",
    "compensation",
    "config_hash",
    "depth_identity",
)
"""What is stored of a result in readable form; the rest is in its hash."""


@dataclass(frozen=True)
class Case:
    """A window, and how it is calibrated. `fast`: in every run of the tests."""

    drive: Drive
    options: Mapping[str, Any] = field(default_factory=dict)
    fast: bool = False


def _cases() -> dict[str, Case]:
    fast = {
        ("pinhole", "fused", 3),
        ("mei", "mi", 3),
        ("eucm", "intensity", 6),
        ("double_sphere", "fused", 6),
    }
    cases = {
        f"{lens} {objective} {dof}": Case(
            Drive(lens),
            {"objective": objective, "dof": dof, "perturb": NEAR if dof == 3 else NEAR_6},
            (lens, objective, dof) in fast,
        )
        for lens in LENSES
        for objective in ("fused", "mi", "intensity")
        for dof in (3, 6)
    }
    three = {"objective": "fused", "dof": 3, "perturb": NEAR}
    cases |= {f"{objective} far": Case(Drive(), {**three, "objective": objective, "perturb": FAR}) for objective in (
        "fused", "mi", "intensity",
    )}  # fmt: skip
    return cases | {
        "turned": Case(Drive(turned_deg=1.5), three, fast=True),
        "turned 6": Case(Drive(turned_deg=1.5), {**three, "dof": 6}),
        "dark": Case(Drive(brightness=0.03), three),
        "standing": Case(Drive(speed_mps=0.0), three),
        "two pairs": Case(Drive(pairs=2), three),
        "sparse": Case(Drive(beams=16, columns=200), three),
        "not compensated": Case(Drive(), {**three, "motion_compensation": False}),
        "no start": Case(Drive(), {"objective": "fused"}),
        "time offset": Case(Drive(), {**three, "time_offset": True}),
        "fitted eucm": Case(Drive("eucm"), {**three, "camera_model": "double_sphere"}),
        "fitted kannala_brandt": Case(Drive("kannala_brandt"), {**three, "camera_model": "double_sphere"}),
        "network fused": Case(Drive(), {**three, "depth": None}),
        "network mi": Case(Drive(), {**three, "depth": None, "objective": "mi"}),
        "seed 2": Case(Drive(seed=2), three),
        "seed 3": Case(Drive(seed=3), three),
        "seed 2, 6": Case(Drive(seed=2, pairs=12), {**three, "dof": 6}),
    }


CASES: Mapping[str, Case] = MappingProxyType(_cases())


class Windows:
    """The windows of drives, each made once."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._windows: dict[Drive, coec.Window] = {}

    def of(self, drive: Drive) -> coec.Window:
        if drive not in self._windows:
            folder = write(drive, self._folder / str(len(self._windows)))
            self._windows[drive] = coec.open(folder).window()
        return self._windows[drive]

    def decide(self, case: Case) -> dict[str, Any]:
        """What is stored of a case: hash of the canonical bytes of its result, of each field, and values."""
        result = self.of(case.drive).calibrate(**{"depth": "stereo", **case.options})
        neighbour = [one for one in (result.camera_fit, result.time_offset) if one is not None]
        return stored(result.to_json()) | ({"beside": rounded(plain(neighbour))} if neighbour else {})


def fields_that_differ(golden: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Names of the fields of a result whose digits differ."""
    before, after = golden["fields"].split(), now["fields"].split()
    names = sorted(CalibrationResult.model_fields)
    if not len(names) == len(before) == len(after):
        return ["there are other fields"]
    return [name for name, a, b in zip(names, before, after, strict=True) if a != b]


def stored(text: str) -> dict[str, Any]:
    """Of the canonical JSON of a result."""
    document = json.loads(text)
    figures = {name: [figure["value"], figure["passed"]] for name, figure in document["metrics"].items()}
    verdict = document["verdict"]
    return {
        "sha256": sha256(text.encode()),
        "fields": " ".join(sha256(json.dumps(document[name]).encode())[:4] for name in sorted(document)),
        "values": rounded(
            {
                **{name: document[name] for name in VALUES},
                "decision": verdict["decision"],
                "reasons": [reason["code"] for reason in verdict["reasons"]],
                "figures": figures,
            }
        ),
    }
