"""What this version writes, read by earlier ones: with their own code where the history of the repository is there, and
always by the form that the oldest of them requires."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field

from coec.io.storage import StateFile
from conftest import REPOSITORY
from upgrade.write_state import write

Code = Literal["estimate", "extrinsic", "state", "command", "commissioned", "chain"]
Six = tuple[float, float, float, float, float, float]
Maybe6 = tuple[float | None, float | None, float | None, float | None, float | None, float | None]
Flags6 = tuple[bool, bool, bool, bool, bool, bool]
Three = tuple[float, float, float]
Row = tuple[float, float, float, float]
Rows = tuple[Row, Row, Row, Row]
Health = Literal["unknown", "healthy", "suspect", "miscalibrated", "degraded", "stale"]
Count = Annotated[int, Field(ge=0)]


# --- the form of 22 November 2026, commit 7a90385b --------------------------------------------------------------------
# Every field stands here that this version requires, or reads if it is there, with the type that it then must have.
class Old(BaseModel):
    model_config = ConfigDict(strict=True, allow_inf_nan=False)


class OldReason(Old):
    code: str
    text: str


class OldTransform(Old):
    matrix: Rows
    translation_m: Three
    quaternion_xyzw: Row


class OldMetric(Old):
    value: float | None
    limit: float | None
    at_least: bool
    passed: bool


class OldVerdict(Old):
    decision: Literal["accepted", "failed"]
    reasons: tuple[OldReason, ...]


class OldResult(Old):
    vehicle: str
    pair: str
    camera_frame: str
    lidar_frame: str
    window_id: str
    data_stamp_ns: int
    pairs: Count
    camera_from_lidar: OldTransform
    correction: Six
    sigma: Maybe6
    correction_rad_m: Six
    noise: tuple[Maybe6, Maybe6, Maybe6, Maybe6, Maybe6, Maybe6]
    systematic: dict[str, Six]
    correlation_pitch_height: float | None
    correlation_yaw_side: float | None
    independent_looks: float | None
    solved: Flags6
    unobservable: Flags6
    status: Literal["not_accepted", "accepted", "failed"]
    verdict: OldVerdict
    metrics: dict[str, OldMetric]
    score: float | None
    score_at_start: float | None
    mi: float | None
    overlap: float | None
    points_in_view: Count
    evaluations: Count
    stop_reason: Literal["tolerance_reached", "optimum_at_bound", "evaluations_exhausted"]
    first_derivative: Maybe6
    second_derivative: Maybe6
    compensation: dict[str, Count]
    depth_identity: str
    config_hash: str


class OldPosterior(Old):
    mean: Three
    variance: Three
    astray: float = 0.0


class OldHypothesis(Old):
    kind: int
    age: float
    evidence: float
    moved: OldPosterior
    right: OldPosterior


class OldHypotheses(Old):
    right: OldPosterior | None
    running: tuple[OldHypothesis, ...]
    before: Three | None


class OldMonitor(Old):
    outcome: Literal["unknown", "clear", "at_odds", "suspect", "confirmed"]
    turned: OldHypotheses
    shifted: OldHypotheses
    blind: dict[str, float]
    dirt: dict[str, float]
    at_odds: float
    last_stamps_ns: tuple[int, ...]
    stood: bool


class OldCandidate(Old):
    T_camera_lidar: Rows
    result: OldResult
    waits: OldReason
    contradicts: bool


class OldChange(Old):
    stamp_ns: int
    step: tuple[float, ...]


class OldSlow(Old):
    T_camera_lidar: Rows
    covariance: tuple[Six, Six, Six, Six, Six, Six]
    systematic: dict[str, Six]
    observed: tuple[bool, ...]
    windows: int


class OldTrack(Old):
    slow: OldSlow
    candidate: OldSlow | None
    prior_sigma: Six
    stamp_ns: int
    step: Literal["none", "suspected", "confirmed"]
    innovation: float
    chance: float


class OldPair(Old):
    rig_sha256: str
    T_camera_lidar: Rows
    provenance: Literal["nominal", "commissioned", "estimated", "restored"]
    status: Literal["not_accepted", "accepted", "failed"]
    valid_from_ns: int
    latest: OldResult | None
    accepted: OldResult | None
    failures: tuple[OldReason, ...]
    completed_wall_ns: int | None
    health: Health
    reasons: tuple[OldReason, ...]
    pending: OldCandidate | None
    frozen: bool
    proven: bool
    track: OldTrack | None
    monitor: OldMonitor
    flagged_since_ns: int | None
    poor_since_ns: int | None
    changes: tuple[OldChange, ...]
    since_wall_ns: int | None
    completed_stamp_ns: int | None
    history_heads: dict[str, str]


class OldEntry(Old):
    sequence: Count
    book: Literal["results", "states", "commands"]
    previous_sha256: str
    kind: Code
    code: str
    text: str
    wall_ns: int
    stamp_ns: int | None
    window_id: str | None
    sender: str | None
    camera_from_lidar: OldTransform | None
    result_sha256: str | None


class OldEdge(Old):
    nominal: Rows
    T_camera_lidar: Rows
    sigma: Maybe6


# --- since 23 November 2026, no field more and none less --------------------------------------------------------------
BASELINE = {
    "": "T_camera_lidar config_hash depth_identity detected dof false_alarm_rate limits monitor pair pairs pose "
    "rotation scene sensors windows",
    "rotation": "bias bias_sigma spread",
    "pose": "bias bias_sigma spread",
    "monitor": "insisted_share max_agreement_rad max_distance2_rotation max_f1 max_farthest2_pose min_edges_per_pair "
    "min_f2 min_mi min_overlap",
    "scene": "bands gradient range_edges sectors",
}
"""Fields of a baseline and of its parts. Versions until 26 November 2026 accept no others."""


@pytest.fixture(scope="module")
def now(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The state directory that this version writes, and what stands in it."""
    folder = tmp_path_factory.mktemp("now") / "state"
    return folder, write(folder)


def body(path: Path) -> dict[str, Any]:
    document = json.loads(path.read_bytes())
    assert document["schema_version"] == 1, "earlier versions refuse the whole file of another schema version"
    loaded = StateFile(path).load().body
    assert loaded is not None
    return loaded


@pytest.mark.fault(
    "a step back to an earlier version of the software", "it finds every field that it requires, in the form it knows"
)
def test_an_earlier_version_finds_what_it_requires(now: tuple[Path, dict[str, Any]]) -> None:
    folder, reported = now
    pairs = body(folder / "state.json")["pairs"]
    assert set(pairs) == set(reported["pairs"])
    for pair, document in pairs.items():
        stored = OldPair.model_validate_json(json.dumps(document))
        assert [list(row) for row in stored.T_camera_lidar] == reported["pairs"][pair]["T_camera_lidar"]
        assert stored.frozen == reported["pairs"][pair]["is_held"]
        assert stored.monitor.turned.running
    for edge in body(folder / "sensors.json")["edges"].values():
        OldEdge.model_validate_json(json.dumps(edge))


def test_an_earlier_version_verifies_the_history(now: tuple[Path, dict[str, Any]]) -> None:
    folder, reported = now
    texts = []
    for path in sorted(folder.glob("*-front.jsonl")):
        if path.name.startswith("checks"):
            continue
        for line in path.read_bytes().splitlines():
            document, _, result = line.partition(b" ")[2].partition(b"\t")
            entry = OldEntry.model_validate_json(document)
            texts.append((entry.sequence, entry.text))
            if entry.result_sha256 is not None:
                OldResult.model_validate_json(result)
    assert [text for _, text in sorted(texts)] == reported["pairs"]["front"]["history"]


def test_an_earlier_version_reads_the_baseline(now: tuple[Path, dict[str, Any]]) -> None:
    document = body(now[0] / "rig.json")["pairs"]["front"]
    for part, names in BASELINE.items():
        assert " ".join(sorted(document[part] if part else document)) == names


# --- with their own code ----------------------------------------------------------------------------------------------

COMMITS = ["7a90385b", "fb619c3b", "29ce6659", "c56bd4c8", "17dc249c", "b9fd6dd1"]
"""Earlier versions, oldest first."""

KEEPS_WHO_HOLDS = {"c56bd4c8", "17dc249c", "b9fd6dd1"}
"""Those that know who holds an extrinsic."""

REFUSES_BASELINE = {"7a90385b", "fb619c3b"}
"""Those whose checks gave other figures: they do not know the limits of today's."""


def sources_of(commit: str, folder: Path) -> Path:
    """The sources of a commit, unpacked; skips the test where they cannot be had."""
    git = shutil.which("git")
    if git is None:
        pytest.skip("git is not installed")
    command = [git, "-C", str(REPOSITORY), "archive", "--format=tar", commit, "service"]
    archive = subprocess.run(command, capture_output=True, check=False)
    if archive.returncode != 0:
        pytest.skip(f"the repository does not hold commit {commit}: it is a shallow clone or no clone")
    folder.mkdir()
    subprocess.run(["tar", "-x", "-C", str(folder)], input=archive.stdout, check=True)
    return folder / "service"


@pytest.mark.slow
@pytest.mark.fault(
    "a step back to the software of the days before, with its own code",
    "calibration, hold, history and evidence are kept, and nothing is green that was not",
)
@pytest.mark.parametrize("commit", COMMITS)
def test_an_earlier_version_reads_what_this_one_wrote(
    now: tuple[Path, dict[str, Any]], commit: str, tmp_path: Path
) -> None:
    folder, reported = now
    sources = sources_of(commit, tmp_path / "old")
    shutil.copytree(folder, tmp_path / "state")
    (tmp_path / "expected.json").write_text(json.dumps(reported), encoding="utf-8")
    script = Path(__file__).with_name("read_state.py")
    read = subprocess.run(
        [sys.executable, str(script), str(tmp_path / "state"), str(tmp_path / "expected.json")],
        env={**os.environ, "PYTHONPATH": str(sources)},
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        check=True,
    )
    back = json.loads(read.stdout)
    assert back["damage"] == []
    for pair, expected in reported["pairs"].items():
        detected = back["pairs"][pair]
        assert detected.get("error") is None
        assert detected["T_camera_lidar"] == expected["T_camera_lidar"]
        assert (detected["provenance"], detected["accepted"]) == ("restored", True)
        assert detected["is_held"] == expected["is_held"]
        if commit in KEEPS_WHO_HOLDS:
            assert detected["hold"] == expected["hold"]
        assert (detected["damage"], detected["history"], detected["results"]) == (None, expected["history"], 1)
        assert detected["windows_of_events"] == [f"{pair}-1"]
        assert detected["health"] == ("unknown" if expected["health"] == "healthy" else expected["health"])
        assert detected["evidence"] == expected["evidence"]
    assert (back["baseline"] is True) == (commit not in REFUSES_BASELINE)
